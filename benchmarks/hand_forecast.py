"""How far predictions of a cube in a LEAP hand are from MuJoCo, by shapes of the links and steps.

python benchmarks/hand_forecast.py --scene FOLDER [--seeds 200,201] [--seconds 15]

FOLDER as for `hand.py`. cgwm's controller turns the cube in the scene `xml/leap_cube_sim.xml` without a clock. From
every third of the states that occur, the commands that followed are applied again in the predicting model. Given are
medians over states of distance and turn between its cube and that of the scene and of the largest error of a joint,
after 0.1, 0.25 and 0.5 s, and CPU time a step. `still` is a cube that stays; `MuJoCo, 10 ms` is the scene in which
judo plans, `xml/leap_cube.xml`.
"""

from __future__ import annotations

import argparse
import importlib
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import hand
import numpy as np
import torch
from cgwm.pipeline.control.hand.controller import HandController
from cgwm.pipeline.control.hand.loop import run_hand
from cgwm.pipeline.control.hand.plant import HandScenePlant, HandTruth
from cgwm.pipeline.control.horizon import Array
from cgwm.pipeline.geometry.rotation import quat_turn
from cgwm.pipeline.physics.chains.joint_command import JointCommand
from cgwm.pipeline.physics.chains.state import joints_of
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.sg_gs.collision import link_hulls
from cgwm.schemas import HandTask

mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs

INTERVAL_S, AHEAD, EVERY = 0.05, 10, 3
CHECKED = (2, 5, 10)
"""Commands after the start at which predictions are compared."""
COMPARED = (
    (0.002, 24, 0.01, True), (0.0003, 12, 0.01, True), (0.0003, 24, 0.02, True), (0.0003, 24, 0.01, False),
    (0.0003, 24, 0.01, True), (0.0003, 24, 0.005, True), (0.0003, 24, 0.002, True),
)  # fmt: skip
"""Radius by which corners are rounded [m], corners of a part, step [s] and whether fingers touch each other, of the
predictions compared."""
COLUMNS = {
    "position_m": "position_m", "quat_wxyz": "quat_wxyz", "velocity_m_s": "velocity_m_s",
    "omega_body_rad_s": "omega_body_rad_s", "joints": "joints_rad", "speeds": "speeds_rad_s",
}  # fmt: skip
"""Columns of a recording with the state before each command, and the fields of the state."""
Motion = tuple[Array, Array, Array]
"""Positions (starts, AHEAD + 1, 3) [m] and orientations (starts, AHEAD + 1, 4) of the cube, and joints [rad]."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """A state from which predictions start."""

    truths: list[HandTruth]
    """True states at the start and after each command."""
    targets_rad: Array
    """Targets before the start and at the end of each command, shape (AHEAD + 1, joints)."""


def task_of(
    folder: str, scene: Path, corners: int, step_s: float, seconds: float = 60.0, touching: bool = True
) -> HandTask:
    """Return the task of `hand.py` with plans of 64 samples over 0.5 s."""
    given = argparse.Namespace(
        corners=corners,
        hz=1 / INTERVAL_S,
        samples=64,
        horizon=0.5,
        step=step_s,
        seconds=seconds,
        touching=touching,
        plant="",
    )
    return hand.task_in(Path(folder), scene, given)


def moments_of(scene: Path, seed: int, seconds: float) -> Iterator[Moment]:
    """Yield the starts of one run of the controller."""
    with tempfile.TemporaryDirectory() as folder:
        controller = HandController(hand.cube(), task_of(folder, scene, 24, 0.01, seconds))
        found = run_hand(controller, HandScenePlant(controller.hand), seed, "ideal")
        columns = {name: found.column(name) for name in COLUMNS}
        targets, names = found.column("target"), controller.joints
    truths = [HandTruth(names=names, **{COLUMNS[k]: v[row] for k, v in columns.items()}) for row in range(len(targets))]
    for k in range(2, len(truths) - AHEAD, EVERY):
        yield Moment(truths=truths[k : k + AHEAD + 1], targets_rad=targets[k - 1 : k + AHEAD])


def still(moments: list[Moment]) -> Motion:
    """Return the motion of a cube that stays."""
    starts = [moment.truths[0] for moment in moments]
    fields = ([getattr(start, name) for start in starts] for name in ("position_m", "quat_wxyz", "joints_rad"))
    position, quat, joints = (np.repeat(np.stack(values)[:, None], AHEAD + 1, 1) for values in fields)
    return position, quat, joints


def predicted(moments: list[Moment], scene: Path, corners: int, step_s: float, touching: bool) -> Motion:
    """Return what cgwm predicts."""
    with tempfile.TemporaryDirectory() as folder:
        found = HandController(hand.cube(), task_of(folder, scene, corners, step_s, touching=touching)).hand
        starts = [
            moment.truths[0].measured(0.0, moment.truths[0].position_m, moment.truths[0].quat_wxyz)
            for moment in moments
        ]
        states = [
            found.state(
                x.position_m, x.quat_wxyz, x.joints, _given(x.velocity_m_s), _given(x.omega_body_rad_s), x.joint_speeds
            )
            for x in starts
        ]
        state = State(*(torch.cat(parts) for parts in zip(*(one.tensors for one in states), strict=True)))
        times = INTERVAL_S * torch.arange(AHEAD + 1, dtype=torch.float64)
        knots = torch.as_tensor(np.stack([moment.targets_rad for moment in moments]))
        motion = rollout(found.planning(), state, times, {found.chain.name: JointCommand.targets(times[None], knots)})
    fields = (motion.position_m, motion.quat_wxyz, motion.velocity_m_s, motion.omega_body_rad_s)
    joints, _ = joints_of(found.world, State(*(x.flatten(0, 1) for x in fields)), found.chain, exact=False)
    position, quat = (x[:, :, found.object].numpy() for x in fields[:2])
    return position, quat, joints.unflatten(0, position.shape[:2]).numpy()


def simulated(moments: list[Moment], path: Path) -> Motion:
    """Return what a scene of MuJoCo predicts."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    names = [model.joint(name).id for name in moments[0].truths[0].names]
    places, speeds = model.jnt_qposadr[names], model.jnt_dofadr[names]
    servos = [next(k for k in range(model.nu) if model.actuator_trnid[k, 0] == name) for name in names]
    joint = model.body_jntadr[model.body("cube").id]
    first, moving = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
    steps = round(INTERVAL_S / model.opt.timestep)
    poses = []
    for moment in moments:
        start = moment.truths[0]
        mujoco.mj_resetData(model, data)
        data.qpos[places], data.qvel[speeds] = start.joints_rad, start.speeds_rad_s
        data.qpos[first : first + 7] = [*start.position_m, *start.quat_wxyz]
        data.qvel[moving : moving + 6] = [*start.velocity_m_s, *start.omega_body_rad_s]
        poses.append(np.concatenate((data.qpos[first : first + 7], data.qpos[places])))
        for before, after in zip(moment.targets_rad[:-1], moment.targets_rad[1:], strict=True):
            for step in range(1, steps + 1):
                data.ctrl[servos] = before + (after - before) * step / steps
                mujoco.mj_step(model, data)
            poses.append(np.concatenate((data.qpos[first : first + 7], data.qpos[places])))
    found = np.stack(poses).reshape(len(moments), AHEAD + 1, -1)
    return found[..., :3], found[..., 3:7], found[..., 7:]


def row(name: str, moments: list[Moment], predict: Callable[[], Motion], step_s: float | None) -> list[str]:
    """Return a row of the table."""
    begun = time.process_time()
    position, quat, joints = predict()
    spent = time.process_time() - begun
    cells = [name]
    for ahead in CHECKED:
        away = [np.linalg.norm(x[ahead] - m.truths[ahead].position_m) for x, m in zip(position, moments, strict=True)]
        turned = [_turn_deg(x[ahead], m.truths[ahead].quat_wxyz) for x, m in zip(quat, moments, strict=True)]
        off = [np.abs(x[ahead] - m.truths[ahead].joints_rad).max() for x, m in zip(joints, moments, strict=True)]
        cells.append(
            f"{1e3 * np.median(away):.1f} mm, {np.median(turned):.1f} deg, {np.degrees(np.median(off)):.1f} deg"
        )
    steps = len(moments) * AHEAD * INTERVAL_S / step_s if step_s else math.inf
    return [*cells, f"{1e6 * spent / steps:.0f} us"]


def _turn_deg(quat_wxyz: Array, goal_wxyz: Array) -> float:
    return math.degrees(float(quat_turn(torch.as_tensor(goal_wxyz), torch.as_tensor(quat_wxyz)).norm()))


def _given(values: Array | None) -> Array:
    assert values is not None  # the plant measures them
    return values


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, required=True, help="judo/models of judo-rai 0.1.0, with meshes/leap/")
    parser.add_argument("--seeds", default="200,201")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a run")
    given = parser.parse_args()
    torch.set_num_threads(1)
    scene = given.scene.resolve()
    moments = [found for seed in given.seeds.split(",") for found in moments_of(scene, int(seed), given.seconds)]
    print(f"{len(moments)} states\n\n| | 0.1 s | 0.25 s | 0.5 s | a step, CPU |\n| --- | --- | --- | --- | --- |")
    print(f"| {' | '.join(row('still', moments, lambda: still(moments), None))} |")
    predicted(moments[:1], scene, 24, 0.005, True)  # compiles
    usual = link_hulls.ROUNDING_M
    for rounding, corners, step_s, touching in COMPARED:
        link_hulls.ROUNDING_M = rounding
        name = f"cgwm, {corners} corners rounded by {1e3 * rounding:g} mm, {1e3 * step_s:g} ms"
        name += "" if touching else ", fingers pass through each other"
        cells = row(name, moments, partial(predicted, moments, scene, corners, step_s, touching), step_s)
        print(f"| {' | '.join(cells)} |")
    link_hulls.ROUNDING_M = usual
    xml = scene / "xml"
    print(f"| {' | '.join(row('MuJoCo, 10 ms', moments, lambda: simulated(moments, xml / 'leap_cube.xml'), 0.01))} |")


if __name__ == "__main__":
    main()
