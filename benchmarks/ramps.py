"""Friction by pair of materials from tracks: a block that slides down two ramps of two materials, made by MuJoCo.

    python benchmarks/ramps.py FOLDER [--episodes N] [--seed N]

The capture is made in FOLDER, with noise of 0.2 mm and 1 mrad, and fitted by `cgwm fit`. Each episode is on one of two
ramps; friction is drawn by pair, and the capture gives none of it. One JSON line for each pair: what MuJoCo had,
estimate and 95 % interval, and how long the fit took.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import mujoco
import numpy as np
from cgwm.pipeline.fit import fit
from joints import EVERY, STEP_S, Recorder, print_found, write_tracks
from scipy.spatial.transform import Rotation

SLOPE_RAD = math.radians(24.0)
HALF_M, MASS_KG = (0.05, 0.035, 0.025), 0.35
"""Half the sides of the block, and its mass."""
RAMPS = {"wood": -0.3, "steel": 0.3}
"""Material of each ramp, and where it lies across the slope [m]."""
HALF_LENGTH_M, HALF_WIDTH_M = 0.5, 0.2
FRICTION = {"wood": (0.12, 0.22), "steel": (0.28, 0.38)}
"""Range of the friction of plastic on each; the slope's tangent is 0.445."""
LENGTH_S = 0.6
TURN = Rotation.from_euler("y", SLOPE_RAD)


def mjcf(friction: dict[str, float]) -> str:
    """Return the world with the friction of each pair."""
    half, quat = " ".join(map(str, HALF_M)), " ".join(map(str, TURN.as_quat(scalar_first=True)))
    planes = "".join(
        f'<geom name="{name}" type="box" size="{HALF_LENGTH_M} {HALF_WIDTH_M} 0.01" quat="{quat}" '
        f'pos="{" ".join(map(str, TURN.apply([0, place, -0.01])))}"/>'
        for name, place in RAMPS.items()
    )
    pairs = "".join(
        f'<pair geom1="block" geom2="{name}" friction="{mu} {mu} 0 0 0" solref="0.004 1"/>'
        for name, mu in friction.items()
    )
    return (
        f'<mujoco><option timestep="{STEP_S}" cone="elliptic" impratio="10"/><worldbody>{planes}'
        f'<body name="block"><freejoint/><geom name="block" type="box" size="{half}" mass="{MASS_KG}"/></body>'
        f"</worldbody><contact>{pairs}</contact></mujoco>"
    )


def slide(rng: np.random.Generator, model: mujoco.MjModel, ramp: str) -> list[str]:
    """Return the track of a block that slides down a ramp, from a speed and a turn of its own."""
    data, found = mujoco.MjData(model), Recorder(rng, False)
    place = [rng.uniform(-0.42, -0.3), RAMPS[ramp] + rng.uniform(-0.05, 0.05), HALF_M[2] + 1e-4]
    data.qpos[:3] = TURN.apply(place)
    data.qpos[3:] = (TURN * Rotation.from_euler("z", rng.uniform(-0.3, 0.3))).as_quat(scalar_first=True)
    data.qvel[:3] = TURN.apply([rng.uniform(0.1, 0.5), rng.uniform(-0.05, 0.05), 0.0])
    data.qvel[5] = rng.uniform(-0.5, 0.5)
    for step in range(round(LENGTH_S / STEP_S) + 1):
        if step % EVERY == 0:
            mujoco.mj_kinematics(model, data)
            found.pose(data, "block", True)
        mujoco.mj_step(model, data)
    return found.rows


def capture(folder: Path, motions: list[list[str]]) -> Path:
    """Write a capture of the slides, all of which are for the fit."""
    names = write_tracks(folder, motions)
    lines = ['format = "cgwm-capture/1"', "[world]", "gravity_m_s2 = [0.0, 0.0, -9.81]"]
    lines += [f'[[materials]]\nname = "{name}"' for name in ("plastic", *RAMPS)]
    lines += [
        f'[[bodies]]\nname = "block"\nmotion = "free"\nmaterial = "plastic"\nmass_kg = {MASS_KG}',
        f"shape = {{ box = {{ half_extents_m = {list(HALF_M)} }} }}",
    ]
    quat = [float(value) for value in TURN.as_quat(scalar_first=True)]
    for name, place in RAMPS.items():
        position = [float(value) for value in TURN.apply([0.0, place, 0.0])]
        lines += [
            f'[[surfaces]]\nname = "{name}_ramp"\nmaterial = "{name}"',
            f"pose = {{ position_m = {position}, quat_wxyz = {quat} }}",
            f"rectangle = {{ half_extents_m = [{HALF_LENGTH_M}, {HALF_WIDTH_M}] }}",
        ]
    (folder / "capture.toml").write_text("\n".join([*lines, "[splits]", f"train = {json.dumps(names)}"]) + "\n")
    return folder


def main() -> None:
    """Make the capture, fit it, and print what was found of each pair."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    truth = {name: float(rng.uniform(*bounds)) for name, bounds in FRICTION.items()}
    model = mujoco.MjModel.from_xml_string(mjcf(truth))
    motions = [slide(rng, model, list(RAMPS)[k % 2]) for k in range(given.episodes)]
    made = capture(given.folder / "ramps", motions)
    began = time.perf_counter()
    fit(made, given.folder / "model", overwrite=True)
    seconds = round(time.perf_counter() - began, 1)
    known = {f"friction[plastic,{name}]": value for name, value in truth.items()}
    print_found(given.folder / "model", known, {"seconds": seconds})


if __name__ == "__main__":
    main()
