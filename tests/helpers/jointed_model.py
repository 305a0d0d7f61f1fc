"""A jointed body as a fitted model, built from numbers: two links of small spheres and a hinge."""

from dataclasses import replace

import numpy as np
from cgwm.datasets.models.model import Model
from cgwm.datasets.shapes.ply import Splats
from cgwm.schemas import (
    ArticulationModel,
    BodyModel,
    ContactParameters,
    FittedParameter,
    Ground,
    JointModel,
    ModelFile,
    Pose,
    Provenance,
    Solver,
)

from .small_model import small_model

RADIUS = 0.01
HEIGHT_M = 0.3
"""Height of the root of a fixed base [m]."""


def _spheres(*rows: tuple[float, float, float]) -> Splats:
    count = len(rows)
    return Splats(np.array(rows), np.full(count, RADIUS), np.full(count, 0.9), np.full((count, 3), 0.5))


def jointed_model(base: str = "free", limits: tuple[float, float] | None = None, cube: bool = False) -> Model:
    """Return two rods of 0.1 m, joined by a hinge about y at the end of the first, over the ground.

    Args:
        base: How the first rod moves.
        limits: Limits of the hinge [rad].
        cube: Whether the small model's cube is there, too.
    """
    low, high = limits or (None, None)
    joint = JointModel(
        name="elbow", kind="hinge", link="lower", parent="upper", position_m=(0.1, 0, 0), axis=(0, 1, 0),
        lower=low, upper=high, damping=1e-4, friction=1e-4,
    )  # fmt: skip
    body = {"motion": "link", "inertia_kg_m2": (1e-5, 2e-4, 2e-4, 0, 0, 0), "com_m": (0.05, 0, 0)}
    height = HEIGHT_M if base == "fixed" else 0.05
    links = (
        BodyModel(name="upper", mass_kg=0.2, photo_pose=Pose(position_m=(0, 0, height)), material="wood", **body),
        BodyModel(name="lower", mass_kg=0.3, material="wood", **body),
    )
    file = ModelFile(
        ground=Ground(),
        bodies=links,
        articulations=(ArticulationModel(name="arm", root="upper", base=base, joints=(joint,)),),
        contact=ContactParameters(friction=0.4, contact_time_s=0.008, damping_ratio=0.3),
        parameters=(
            FittedParameter(name="friction", unit="1", estimate=0.4, std_error=0.05, bounds=(0.01, 2.0)),
            FittedParameter(name="elbow.damping", unit="N m s/rad", estimate=1e-4, std_error=2e-5, bounds=(1e-6, 1e-2)),
            FittedParameter(name="lower.mass_factor", unit="1", estimate=1.2, std_error=0.1, bounds=(0.2, 5.0)),
            FittedParameter(name="arm.inertia_factor", unit="1", estimate=0.9, std_error=0.1, bounds=(0.2, 5.0)),
        ),
        solver=Solver(step_s=0.002),
        provenance=Provenance(capture="none"),
    )
    collision = {"upper": _spheres((0, 0, 0), (0.05, 0, 0)), "lower": _spheres((0.02, 0, 0), (0.1, 0, 0))}
    if not cube:
        return Model(root=None, file=file, body_splats={}, collision=collision, scene=None)
    plain = small_model(visible=False)
    first = plain.file.bodies[0].model_copy(update={"photo_pose": Pose(position_m=(0.3, 0, 0.05))})
    file = file.model_copy(update={"bodies": (first, *links)})
    return replace(plain, file=file, collision=plain.collision | collision)
