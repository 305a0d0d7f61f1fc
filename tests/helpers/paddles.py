"""A hand in small: a palm with a paddle on a hinge, which turns a cube that lies beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cgwm.schemas import HandTask
from helpers.small_model import HALF

JOINTS = ("swing", "lift")
HAND = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="palm"><geom type="box" size="0.12 0.12 0.01" pos="0 0 -0.01"/>
    <body name="arm" pos="-0.08 0 0.035">
      <joint name="swing" axis="0 0 1" range="-1.5 1.5" damping="0.01" armature="0.001"/>
      <geom type="box" size="0.04 0.006 0.015" pos="0.04 0 0" mass="0.05"/>
      <body name="tip" pos="0.09 0 0"><joint name="lift" axis="0 1 0" range="-0.5 0.5" damping="0.01" armature="0.001"/>
        <geom type="box" size="0.02 0.006 0.01" pos="0.015 0 0" mass="0.02"/></body></body></body>%s
</worldbody><actuator>%s</actuator></mujoco>"""
SERVOS = "".join(f'<position joint="{name}" kp="2" kv="0.1"/>' for name in JOINTS)
PLACE = (0.0, 0.06, HALF)


def write_hand(folder: Path, servos: str = SERVOS) -> Path:
    """Write the hand, and a scene with it and the cube, and return the file of the hand."""
    (folder / "hand.xml").write_text(HAND % ("", servos))
    cube = (
        f'<body name="thing" pos="{PLACE[0]} {PLACE[1]} {PLACE[2]}"><freejoint/>'
        f'<geom type="box" size="{HALF} {HALF} {HALF}" mass="0.2"/></body>'
    )
    (folder / "scene.xml").write_text(HAND % (cube, servos))
    return folder / "hand.xml"


def hand_task(folder: Path, **sections: dict[str, Any]) -> HandTask:
    """Return a task with short plans, in which some sections differ from the defaults."""
    small: dict[str, dict[str, Any]] = {
        "start": {"position_m": PLACE},
        "goal": {"kind": "turn", "turn_deg": 20.0},
        "planner": {"control_hz": 20.0, "horizon_s": 0.4, "knots": 2, "samples": 12},
        "success": {"turn_deg": 5.0, "goals": 1, "timeout_s": 0.3, "goal_s": 10.0},
        "plant": {"scene": "scene.xml", "body": "thing"},
    }
    given = {name: {**small.get(name, {}), **sections.get(name, {})} for name in {*small, *sections}}
    task = HandTask.model_validate(given)
    task._source = str(folder / "task.toml")
    return task
