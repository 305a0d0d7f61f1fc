"""The model of benchmarks/synthesize.py: a body of 5,000 visual spheres that is thrown over a scene of 20,000."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.shapes.ply import Splats
from cgwm.schemas import BodyModel, ContactParameters, FittedParameter, Ground, ModelFile, Pose, Provenance, Solver

BODY_SPHERES, SCENE_SPHERES, COLLISION_PER_SIDE = 5_000, 20_000, 4
HALF_M, MASS_KG, SCENE_HALF_M, WALL_M = 0.05, 0.4, 0.8, 0.8


def body_splats(count: int = BODY_SPHERES, seed: int = 0) -> Splats:
    """Return spheres on the surface of a cube, with a pattern of colours that has edges."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-HALF_M, HALF_M, (count, 3))
    axis = rng.integers(0, 3, count)
    rows = np.arange(count)
    points[rows, axis] = np.sign(points[rows, axis]) * HALF_M
    radius = 1.2 * np.sqrt(24 * HALF_M**2 / count)
    cells = np.floor(points / 0.025).astype(int).sum(1) % 2
    colors = np.where(cells[:, None] == 0, [0.85, 0.3, 0.2], [0.2, 0.4, 0.8]) + rng.normal(0, 0.03, (count, 3))
    return Splats(points, np.full(count, 0.6 * radius), np.full(count, 0.9), colors.clip(0, 1))


def scene_splats(count: int = SCENE_SPHERES, seed: int = 1) -> Splats:
    """Return a floor and two walls with a texture of low and of high frequency."""
    rng = np.random.default_rng(seed)
    floor = count // 2
    wall = (count - floor) // 2
    walls = count - floor - wall
    along = rng.uniform(-SCENE_HALF_M, SCENE_HALF_M, (count, 2))
    height = rng.uniform(0, WALL_M, count)
    means = np.c_[along, np.zeros(count)]
    back, left = slice(floor, floor + wall), slice(floor + wall, count)
    means[back] = np.c_[along[back, 0], np.full(wall, SCENE_HALF_M), height[back]]
    means[left] = np.c_[np.full(walls, -SCENE_HALF_M), along[left, 1], height[left]]
    scale = np.sqrt(4 * SCENE_HALF_M**2 / floor)
    means += rng.normal(0, 0.1 * scale, means.shape)
    means[:floor, 2] -= scale
    tint = 0.5 + 0.2 * np.sin(means @ rng.normal(0, 12, (3, 3)))
    colors = (tint + rng.normal(0, 0.05, (count, 3))).clip(0, 1)
    return Splats(means, np.full(count, 0.8 * scale), np.full(count, 0.9), colors)


def model() -> Model:
    """Return the model, with the uncertainty of a fit to a few tosses."""
    inertia = MASS_KG / 6 * (2 * HALF_M) ** 2
    body = BodyModel(
        name="cube",
        motion="free",
        mass_kg=MASS_KG,
        inertia_kg_m2=(inertia, inertia, inertia, 0, 0, 0),
        com_m=(0, 0, 0),
        photo_pose=Pose(position_m=(0, 0, HALF_M)),
    )
    radius = 1.2 * HALF_M / COLLISION_PER_SIDE
    line = np.linspace(-1, 1, COLLISION_PER_SIDE) * (HALF_M - radius)
    centers = np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    count = len(centers)
    collision = Splats(centers, np.full(count, radius / 2), np.full(count, 0.9), np.full((count, 3), 0.5))
    file = ModelFile(
        ground=Ground(),
        bodies=(body,),
        contact=ContactParameters(friction=0.3, contact_time_s=0.004, damping_ratio=0.3),
        parameters=(
            FittedParameter(name="friction", unit="1", estimate=0.3, std_error=0.03, bounds=(0.01, 2.0)),
            FittedParameter(name="contact_time_s", unit="s", estimate=0.004, std_error=0.0004, bounds=(0.001, 0.03)),
            FittedParameter(name="damping_ratio", unit="1", estimate=0.3, std_error=0.03, bounds=(0.02, 3.0)),
        ),
        solver=Solver(step_s=0.001),
        provenance=Provenance(capture="none"),
    )
    return Model(
        root=None, file=file, body_splats={"cube": body_splats()}, collision={"cube": collision}, scene=scene_splats()
    )


def write(path: Path) -> Path:
    """Write the model where it is not there yet, and return its path."""
    if not path.exists():
        write_model(path, model())
    return path
