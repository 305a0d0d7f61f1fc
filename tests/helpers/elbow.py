"""Tosses of an elbow of two boxes with a hinge, in the format of dair_pll."""

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

URDF = """<robot name="elbow">
  <link name="upper">
    <inertial><mass value="0.4"/><inertia ixx="0.0002" iyy="0.0004" izz="0.0004"/></inertial>
    <collision><geometry><box size="0.1 0.05 0.05"/></geometry></collision>
  </link>
  <link name="lower">
    <inertial><origin xyz="0.035 0 0"/><mass value="0.3"/><inertia ixx="0.0002" iyy="0.0004" izz="0.0004"/></inertial>
    <collision><origin xyz="0.035 0 0"/><geometry><box size="0.1 0.05 0.05"/></geometry></collision>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="upper"/><child link="lower"/><origin xyz="-0.035 0.06 0"/><axis xyz="0 1 0"/>
  </joint>
</robot>
"""


def toss(seed: int, frames: int = 6) -> np.ndarray:
    """Return a toss (T, 15) that turns about a fixed axis and falls freely, with a hinge that turns evenly."""
    rng = np.random.default_rng(seed)
    time = 0.0068 * np.arange(frames)[:, None]
    omega, velocity, rate = rng.normal(size=3), rng.normal(size=3), rng.normal()
    turns = Rotation.from_rotvec(time * omega).as_quat(scalar_first=True)
    position = np.array([0.0, 0.0, 0.3]) + time * velocity - 0.5 * 9.81 * time**2 * np.array([0, 0, 1.0])
    speeds = np.broadcast_to(np.concatenate([omega, velocity]), (frames, 6))
    return np.concatenate([turns, position, 0.5 + rate * time, speeds, np.full((frames, 1), rate)], 1)


def write_tosses(folder: Path, numbers: list[int], urdf: str = URDF) -> Path:
    """Write tosses and their URDF, and return the folder."""
    (folder / "tosses").mkdir(parents=True)
    (folder / "elbow.urdf").write_text(urdf)
    for number in numbers:
        torch.save(torch.from_numpy(toss(number)), folder / "tosses" / f"{number}.pt")
    return folder
