"""Scene `ramp`: a block slides and a ball rolls down a ramp of one material onto a floor of another one."""

from __future__ import annotations

import math

import numpy as np

from ....schemas import Ground, Pose, Surface
from ....schemas.surfaces import SurfaceBoxShape
from .scene import Thing, WorldContact, WorldEpisode, WorldPlan

SLOPE_DEG = 24.0
HALF_LENGTH_M, HALF_WIDTH_M, HALF_THICK_M = 0.30, 0.20, 0.02
"""Half the sides of the ramp [m]; the lower edge of its upper face lies on the floor, at x = 0."""
BLOCK_M = (0.05, 0.035, 0.025)
"""Half the sides of the block."""
BALL_M = 0.03
"""Radius of the ball."""
LENGTH_S = 1.0
TRAIN, TEST = 4, 3
_ABOVE_M = 0.002
"""Gap to the ramp at the start: bodies are let go just above it."""


def plan_ramp(seed: int) -> WorldPlan:
    """Draw the friction of the pairs, and starts on the upper half of the ramp."""
    rng = np.random.default_rng([seed, *b"ramp"])
    ramp, floor = float(rng.uniform(0.15, 0.25)), float(rng.uniform(0.35, 0.55))
    names = [f"{k:03d}" for k in range(TRAIN + TEST)]
    return WorldPlan(
        name="ramp",
        seed=seed,
        things=(
            Thing(
                name="block",
                mass_kg=0.35,
                color=(0.80, 0.34, 0.22),
                half_extents_m=BLOCK_M,
                place=_on_ramp(BLOCK_M[2], 1.2 * HALF_LENGTH_M, 0.1),
            ),
            Thing(
                name="ball",
                mass_kg=0.15,
                color=(0.26, 0.44, 0.68),
                radius_m=BALL_M,
                place=_on_ramp(BALL_M, 1.2 * HALF_LENGTH_M, -0.1),
            ),
        ),
        surfaces=(_ramp(),),
        ground=Ground(material="rubber"),
        material="plastic",
        contact=WorldContact(
            natural_time_s=0.002,
            damping_ratio=0.5,
            stated=False,
            friction={("plastic", "plastic"): 0.3, ("plastic", "rubber"): floor, ("plastic", "wood"): ramp},
        ),
        episodes=tuple(_release(name, "train" if k < TRAIN else "test", rng) for k, name in enumerate(names)),
        look_from_m=(0.75, -1.0, 0.55),
        look_at_m=(-0.05, 0.0, 0.05),
    )


def _ramp() -> Surface:
    """Return the ramp, which falls towards +x."""
    angle = math.radians(SLOPE_DEG)
    along, up = np.array([math.cos(angle), 0.0, -math.sin(angle)]), np.array([math.sin(angle), 0.0, math.cos(angle)])
    x, y, z = (float(v) for v in -HALF_LENGTH_M * along - HALF_THICK_M * up)
    return Surface(
        name="ramp",
        pose=Pose(position_m=(x, y, z), quat_wxyz=_turned(angle)),
        box=SurfaceBoxShape(half_extents_m=(HALF_LENGTH_M, HALF_WIDTH_M, HALF_THICK_M)),
        material="wood",
    )


def _on_ramp(half_m: float, back_m: float, side_m: float) -> Pose:
    """Return the pose of a body just above the ramp, a distance `back_m` up from the ramp's foot."""
    angle = math.radians(SLOPE_DEG)
    along, up = np.array([math.cos(angle), 0.0, -math.sin(angle)]), np.array([math.sin(angle), 0.0, math.cos(angle)])
    x, _, z = (float(v) for v in -back_m * along + (half_m + _ABOVE_M) * up)
    return Pose(position_m=(x, side_m, z), quat_wxyz=_turned(angle))


def _turned(angle: float) -> tuple[float, float, float, float]:
    """Return the quaternion (w, x, y, z) of a turn about y [rad]."""
    return math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0


def _release(name: str, split: str, rng: np.random.Generator) -> WorldEpisode:
    """Draw places on the upper half of the ramp, on either side, and speeds down the slope and aside."""
    angle = math.radians(SLOPE_DEG)
    along = np.array([math.cos(angle), 0.0, -math.sin(angle)])
    side = rng.choice([-1.0, 1.0])
    rows, speeds = [], []
    for half, place in ((BLOCK_M[2], side * 0.1), (BALL_M, -side * 0.1)):
        pose = _on_ramp(half, rng.uniform(1.0, 1.4) * HALF_LENGTH_M, place + rng.uniform(-0.02, 0.02))
        rows.append([*pose.position_m, *pose.quat_wxyz])
        velocity = rng.uniform(0.1, 0.4) * along + [0.0, rng.uniform(-0.05, 0.05), 0.0]
        speeds.append([*velocity, 0.0, 0.0, 0.0])
    return WorldEpisode(
        name=name, split=split, length_s=LENGTH_S, qpos=np.asarray(rows), qvel=np.asarray(speeds, float)
    )
