"""Scene `bin`: five objects are dropped into a tray, hit each other and its walls, and come to rest in it."""

from __future__ import annotations

import numpy as np

from ....schemas import Pose, Surface
from ..objects import make_object
from .scene import Color, Thing, WorldContact, WorldEpisode, WorldPlan, random_quat

INSIDE_M, WALL_M, THICK_M = 0.21, 0.12, 0.01
"""Half the inner side of the tray, the height of its walls, and half their thickness [m]."""
FAMILIES = (0, 1, 2, 3, 6)
"""Seeds of the objects modulo their number of families: a box, two wedges, an L-shaped block and a hexagonal prism."""
LENGTH_S = 0.6
TRAIN, TEST = 2, 1
_COLORS: tuple[Color, ...] = (
    (0.80, 0.34, 0.22),
    (0.93, 0.72, 0.25),
    (0.27, 0.55, 0.39),
    (0.26, 0.44, 0.68),
    (0.55, 0.35, 0.58),
)
_NAMES = ("box", "wedge", "ell", "prism", "chock")
_PLACES = 0.1 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (0, 0)])
"""Where the objects are dropped [m]."""
_LOW_M, _HIGH_M = (0.10, 0.13), (0.24, 0.28)
"""Heights of the middles of the four objects over the corners, and of the fifth, which falls onto them [m]."""


def plan_bin(seed: int) -> WorldPlan:
    """Draw five objects, their friction, and drops from random places in random orientations."""
    rng = np.random.default_rng([seed, *b"bin"])
    solids = [make_object(5 * int(rng.integers(1000)) + family) for family in FAMILIES]
    things = tuple(
        Thing(
            name=name,
            mass_kg=solid.mass,
            color=color,
            solid=solid,
            place=Pose(position_m=(float(place[0]), float(place[1]), 0.1)),
        )
        for name, solid, color, place in zip(_NAMES, solids, _COLORS, _PLACES, strict=True)
    )
    friction = {("felt", "paint"): float(rng.uniform(0.4, 0.6)), ("paint", "paint"): float(rng.uniform(0.25, 0.4))}
    names = [f"{k:03d}" for k in range(TRAIN + TEST)]
    return WorldPlan(
        name="bin",
        seed=seed,
        things=things,
        surfaces=tray(),
        ground=None,
        material="paint",
        contact=WorldContact(
            natural_time_s=0.0006,
            damping_ratio=0.9,
            stated=True,
            friction=friction,
        ),
        episodes=tuple(_drop(name, "train" if k < TRAIN else "test", rng) for k, name in enumerate(names)),
        look_from_m=(0.5, -0.62, 0.62),
        look_at_m=(0.0, -0.02, 0.03),
    )


def tray() -> tuple[Surface, ...]:
    """Return the floor and the four walls of the tray; the floor's upper side is at height 0."""

    def part(name: str, position: tuple[float, ...], half: tuple[float, ...]) -> Surface:
        return Surface.model_validate(
            {"name": name, "pose": {"position_m": position}, "box": {"half_extents_m": half}, "material": "felt"}
        )

    far, out, high = INSIDE_M + THICK_M, INSIDE_M + 2 * THICK_M, WALL_M / 2
    return (
        part("floor", (0, 0, -THICK_M), (out, out, THICK_M)),
        part("left", (-far, 0, high), (THICK_M, out, high)),
        part("right", (far, 0, high), (THICK_M, out, high)),
        part("front", (0, -far, high), (INSIDE_M, THICK_M, high)),
        part("back", (0, far, high), (INSIDE_M, THICK_M, high)),
    )


def _drop(name: str, split: str, rng: np.random.Generator) -> WorldEpisode:
    qpos, qvel = np.zeros((5, 7)), np.zeros((5, 6))
    for place, body in enumerate(rng.permutation(5)):
        heights = _LOW_M if place < 4 else _HIGH_M
        qpos[body] = [*(_PLACES[place] + rng.uniform(-0.01, 0.01, 2)), rng.uniform(*heights), *random_quat(rng)]
        qvel[body, 3:] = rng.uniform(-2, 2, 3)
    return WorldEpisode(name=name, split=split, length_s=LENGTH_S, qpos=qpos, qvel=qvel)
