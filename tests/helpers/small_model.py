"""A small textured cube on a table, as a fitted model: built from numbers, in no time."""

from pathlib import Path

import numpy as np
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.shapes.ply import Splats
from cgwm.schemas import BodyModel, ContactParameters, FittedParameter, Ground, ModelFile, Pose, Provenance, Solver

HALF = 0.05
MASS = 0.37


def cube_splats(count: int = 400, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-HALF, HALF, (count, 3))
    axis = rng.integers(0, 3, count)
    rows = np.arange(count)
    points[rows, axis] = np.sign(points[rows, axis]) * 0.94 * HALF
    return Splats(points, np.full(count, 0.12 / np.sqrt(count)), np.full(count, 0.9), rng.random((count, 3)))


def collision_splats(per_side: int = 3) -> Splats:
    line = np.linspace(-0.9 * HALF, 0.9 * HALF, per_side)
    centres = np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    count = len(centres)
    return Splats(centres, np.full(count, 0.05 * HALF), np.full(count, 0.9), np.full((count, 3), 0.5))


def table_splats(per_side: int = 20, side: float = 0.6) -> Splats:
    rng = np.random.default_rng(1)
    line = np.linspace(-side, side, per_side)
    xy = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    scale = 1.2 * side / per_side
    means = np.c_[xy, np.full(len(xy), -0.5 * scale)]
    return Splats(means, np.full(len(xy), scale), np.full(len(xy), 0.95), rng.uniform(0.3, 0.7, (len(xy), 3)))


def small_model(driven: bool = False, visible: bool = True, com_m: tuple[float, float, float] = (0, 0, 0)) -> Model:
    inertia = MASS / 6 * (2 * HALF) ** 2
    bodies = [
        BodyModel(
            name="cube",
            motion="free",
            mass_kg=MASS,
            inertia_kg_m2=(inertia, inertia, inertia, 0, 0, 0),
            com_m=com_m,
            photo_pose=Pose(position_m=(0, 0, HALF)),
        )
    ]
    splats, collision = {"cube": cube_splats()}, {"cube": collision_splats()}
    if driven:
        tip = Splats(np.zeros((1, 3)), np.array([0.006]), np.array([0.95]), np.array([[1.0, 0, 0]]))
        pose = Pose(position_m=(0.2, 0, 0.04))
        inertia_tip = (1e-5, 1e-5, 1e-5, 0, 0, 0)
        bodies.append(
            BodyModel(
                name="tip", motion="driven", mass_kg=0.1, inertia_kg_m2=inertia_tip, com_m=(0, 0, 0), photo_pose=pose
            )
        )
        splats["tip"] = collision["tip"] = tip
    file = ModelFile(
        ground=Ground(),
        bodies=tuple(bodies),
        contact=ContactParameters(friction=0.4, contact_time_s=0.008, damping_ratio=0.3),
        parameters=(
            FittedParameter(name="friction", unit="1", estimate=0.4, std_error=0.05, bounds=(0.01, 2.0)),
            FittedParameter(name="damping_ratio", unit="1", estimate=0.3, std_error=0.02, bounds=(0.02, 3.0)),
            FittedParameter(name="cube.mass_kg", unit="kg", estimate=MASS, state="given"),
        ),
        solver=Solver(step_s=0.002),
        provenance=Provenance(capture="none"),
    )
    if not visible:
        return Model(root=None, file=file, body_splats={}, collision=collision, scene=None)
    return Model(root=None, file=file, body_splats=splats, collision=collision, scene=table_splats())


def write_small_model(path: Path, **options: object) -> Path:
    write_model(path, small_model(**options))  # pyright: ignore[reportArgumentType]
    return path
