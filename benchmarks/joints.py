"""Losses in passive joints from tracks: a door that swings and a drawer that a finger pushes, simulated by MuJoCo.

    python benchmarks/joints.py FOLDER [--episodes N] [--seed N] [--only door|drawer]

The captures are made in FOLDER, with noise of 0.2 mm and 1 mrad, and fitted by `cgwm fit`. The door hangs on a hinge
with a level axis and touches nothing; the finger moves at a speed of its own in each episode, and carries the force
that it exerts, with noise of 0.05 N. One JSON line for each parameter: what MuJoCo had, estimate and 95 % interval.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from cgwm.datasets import read_model
from cgwm.pipeline.fit import fit
from scipy.spatial.transform import Rotation

POSITION_STD_M, ROTATION_STD_RAD, FORCE_STD_N = 2e-4, 1e-3, 0.05
STEP_S, EVERY = 1e-4, 100
FINGER_M, FINGER_KG = 0.01, 100.0
"""Radius and mass of the finger, which is too heavy to be slowed down by more than some mm/s."""
HINGE = {"damping": 0.004, "friction": 0.01}
RAIL = {"damping": 8.0, "friction": 2.0}

DOOR_URDF = """<robot name="door">
  <link name="frame"><collision><geometry><box size="0.04 0.04 0.04"/></geometry></collision></link>
  <link name="leaf">
    <inertial><origin xyz="0 0 -0.1"/><mass value="0.5"/><inertia ixx="0.002" iyy="0.002" izz="0.0002"/></inertial>
    <collision><origin xyz="0 0 -0.1"/><geometry><box size="0.05 0.01 0.16"/></geometry></collision>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="frame"/><child link="leaf"/><origin xyz="0 0.05 0"/><axis xyz="0 1 0"/>
  </joint>
</robot>
"""
DRAWER_URDF = """<robot name="cabinet">
  <link name="case">
    <collision><origin xyz="-0.3 0 0"/><geometry><box size="0.05 0.3 0.2"/></geometry></collision>
  </link>
  <link name="drawer">
    <inertial><mass value="1.5"/><inertia ixx="0.01" iyy="0.01" izz="0.01"/></inertial>
    <collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision>
  </link>
  <joint name="rail" type="prismatic">
    <parent link="case"/><child link="drawer"/><axis xyz="1 0 0"/>
    <limit lower="-0.2" upper="0.2" effort="10" velocity="1"/>
  </joint>
</robot>
"""
DOOR = f"""<mujoco><option timestep="{STEP_S}" integrator="implicitfast"/><worldbody><body name="frame" pos="0 0 0.5">
  <body name="leaf" pos="0 0.05 0">
    <joint name="hinge" axis="0 1 0" damping="{HINGE["damping"]}" frictionloss="{HINGE["friction"]}"/>
    <inertial pos="0 0 -0.1" mass="0.5" diaginertia="0.002 0.002 0.0002"/>
  </body></body></worldbody></mujoco>"""
DRAWER = f"""<mujoco><option timestep="{STEP_S}" integrator="implicitfast" gravity="0 0 0"/>
  <default><geom solref="0.004 1" friction="0.3 0 0"/></default><worldbody>
  <body name="finger" pos="0.27 0 0.5"><joint name="finger" type="slide" axis="1 0 0"/>
    <geom type="sphere" size="{FINGER_M}" mass="{FINGER_KG}"/></body>
  <body name="case" pos="0 0 0.5"><body name="drawer">
    <joint name="rail" type="slide" axis="1 0 0" damping="{RAIL["damping"]}" frictionloss="{RAIL["friction"]}"/>
    <geom type="box" size="0.1 0.1 0.05" mass="0"/><inertial pos="0 0 0" mass="1.5" diaginertia="0.01 0.01 0.01"/>
  </body></body></worldbody></mujoco>"""
HEAD = 'format = "cgwm-capture/1"\n[world]\ngravity_m_s2 = [0.0, 0.0, -9.81]\n'
FINGER = f'[[bodies]]\nname = "finger"\nmotion = "driven"\nshape = {{ sphere = {{ radius_m = {FINGER_M} }} }}\n'
COLUMNS = "time_s,body,px_m,py_m,pz_m,qw,qx,qy,qz"


class Recorder:
    """Rows of a track file, with noise on what is measured."""

    def __init__(self, rng: np.random.Generator, forces: bool) -> None:
        self.rng, self.forces = rng, forces
        self.rows = [COLUMNS + (",force_x_n,force_y_n,force_z_n" if forces else "")]

    def pose(self, data: mujoco.MjData, name: str, noisy: bool, force: np.ndarray | None = None) -> None:
        """Add the pose of a body, and its force where it is given."""
        place, turn = data.body(name).xpos.copy(), Rotation.from_quat(data.body(name).xquat, scalar_first=True)
        if noisy:
            place += POSITION_STD_M * self.rng.standard_normal(3)
            turn = turn * Rotation.from_rotvec(ROTATION_STD_RAD * self.rng.standard_normal(3))
        numbers = [*place, *turn.as_quat(scalar_first=True)]
        texts = [f"{data.time:.4f}", name, *(f"{value:.6f}" for value in numbers)]
        if self.forces:
            exerted = (
                [""] * 3 if force is None else [f"{f + FORCE_STD_N * self.rng.standard_normal():.4f}" for f in force]
            )
            texts += exerted
        self.rows.append(",".join(texts))


def door(rng: np.random.Generator) -> list[str]:
    """Return the track of two seconds of a door that is let go."""
    model = mujoco.MjModel.from_xml_string(DOOR)
    data, found = mujoco.MjData(model), Recorder(rng, False)
    data.qpos[0], data.qvel[0] = rng.choice([-1, 1]) * rng.uniform(1.2, 2.2), rng.uniform(-2, 2)
    for step in range(round(2.0 / STEP_S) + 1):
        if step % EVERY == 0:
            mujoco.mj_kinematics(model, data)
            found.pose(data, "frame", False)
            found.pose(data, "leaf", True)
        mujoco.mj_step(model, data)
    return found.rows


def force_of_finger(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the force (3,) [N] in the world frame that a finger, the first geom of all contacts, exerts."""
    force, wrench = np.zeros(3), np.zeros(6)
    for contact in range(data.ncon):
        mujoco.mj_contactForce(model, data, contact, wrench)
        force += data.contact[contact].frame.reshape(3, 3).T @ wrench[:3]
    return force


def drawer(rng: np.random.Generator) -> list[str]:
    """Return the track of a drawer that a finger pushes by some centimetres, at one speed."""
    model = mujoco.MjModel.from_xml_string(DRAWER)
    data, found = mujoco.MjData(model), Recorder(rng, True)
    data.joint("rail").qpos[0], data.joint("finger").qvel[0] = 0.15, -rng.uniform(0.03, 0.25)
    exerted: list[np.ndarray] = []
    for step in range(round(0.9 / STEP_S) + 1):
        mujoco.mj_forward(model, data)
        exerted.append(force_of_finger(model, data))
        if step % EVERY == 0:
            found.pose(data, "case", False)
            found.pose(data, "drawer", True)
            found.pose(data, "finger", False, np.mean(exerted[-EVERY:], 0))
        mujoco.mj_step(model, data)
    return found.rows


def write_tracks(folder: Path, motions: list[list[str]]) -> list[str]:
    """Write the tracks of a capture, and return the names of their episodes."""
    (folder / "tracks").mkdir(parents=True, exist_ok=True)
    names = [f"{k:03d}" for k in range(len(motions))]
    for name, rows in zip(names, motions, strict=True):
        (folder / "tracks" / f"{name}.csv").write_text("\n".join(rows) + "\n")
    return names


def print_found(model: Path, truth: Mapping[str, float], more: Mapping[str, float]) -> None:
    """Print what a fit found of parameters whose true values are known, one JSON line each, with more numbers.

    Those that it did not fit are left out.
    """
    fitted = {p.name: p for p in read_model(model).file.parameters}
    for name, value in truth.items():
        if name not in fitted:
            continue
        one = fitted[name]
        row = {
            "parameter": name,
            "true": value,
            "estimate": one.estimate,
            "interval_95": one.interval_95 and list(one.interval_95),
            "state": one.state,
        }
        print(json.dumps({**row, **more}), flush=True)


def capture(folder: Path, body: str, urdf: str, motions: list[list[str]]) -> Path:
    """Write a capture of a jointed body on a fixed root, all of whose episodes are for the fit."""
    names = write_tracks(folder, motions)
    (folder / "body.urdf").write_text(urdf)
    (folder / "capture.toml").write_text(
        f'{HEAD}{body}[[articulations]]\nname = "jointed"\nurdf = "body.urdf"\nbase = "fixed"\n'
        f"pose = {{ position_m = [0.0, 0.0, 0.5] }}\n[splits]\ntrain = {json.dumps(names)}\n"
    )
    return folder


def main() -> None:
    """Make both captures, fit them, and print what was found of the joints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=("door", "drawer"), help="fit one of the two alone")
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    for name, body, urdf, motion, joint, truth in (
        ("door", "", DOOR_URDF, door, "hinge", HINGE),
        ("drawer", FINGER, DRAWER_URDF, drawer, "rail", RAIL),
    ):
        motions = [motion(rng) for _ in range(given.episodes)]  # of both, so that seeds give the same ones
        if given.only not in (None, name):
            continue
        made = capture(given.folder / name, body, urdf, motions)
        fit(made, given.folder / f"{name}_model", overwrite=True)
        known = {f"{joint}.{number}": value for number, value in truth.items()}
        print_found(given.folder / f"{name}_model", known, {})


if __name__ == "__main__":
    main()
