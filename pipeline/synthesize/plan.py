"""Resolution of sampling plans: missing entries are filled in from the size of the bodies and the vertical."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...datasets.models.model import Model
from ...schemas import BodyModel, Distribution, InputDataError, ModelFile, SamplingPlan, UsageError
from .wholes import at_middle

GRAVITY_M_S2 = 9.81
"""Gravity for the default speeds of a model without gravity [m/s2]."""


@dataclass(frozen=True)
class Extent:
    """Bounding sphere of a body."""

    center_m: np.ndarray
    """Centre [m], body frame, shape (3,)."""
    radius_m: float
    """Radius [m]."""


def extent(model: Model, body: BodyModel) -> Extent:
    """Return the bounding sphere of a body, centred at the middle of its collision spheres."""
    spheres = model.collision[body.name]
    if not len(spheres):
        return Extent(np.zeros(3), 0.0)
    means = np.asarray(spheres.means, float)
    radii = np.asarray(spheres.scales, float) * body.radius_factor
    center = 0.5 * ((means - radii[:, None]).min(0) + (means + radii[:, None]).max(0))
    return Extent(center, float((np.linalg.norm(means - center, axis=1) + radii).max()))


def up_direction(file: ModelFile) -> np.ndarray:
    """Return the unit vector away from the ground, or against gravity without a ground; world frame, shape (3,)."""
    if file.ground is not None:
        return np.asarray(file.ground.normal, float)
    gravity = np.asarray(file.gravity_m_s2, float)
    norm = np.linalg.norm(gravity)
    return -gravity / norm if norm > 0 else np.array([0.0, 0.0, 1.0])


def horizontal_direction(up: np.ndarray, angle: float) -> np.ndarray:
    """Return the unit vector at `angle` [rad] in the plane normal to `up`; for up = z, 0 is x and pi/2 is y."""
    helper = np.array([0.0, 1.0, 0.0]) if abs(up[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    first = np.cross(helper, up)
    first /= np.linalg.norm(first)
    return math.cos(angle) * first + math.sin(angle) * np.cross(up, first)


def moving_wholes(whole: Model, file: ModelFile) -> list[BodyModel]:
    """Return the bodies that start anywhere, or where there are none the jointed ones, which move about a fixed root.

    Args:
        whole: The model with each jointed body as one, see `wholes.at_middle`.
        file: The model.
    """
    roots = {one.root for one in file.articulations}
    free = [body for body in whole.file.bodies if body.motion == "free"]
    return free or [body for body in whole.file.bodies if body.name in roots]


def resolve_plan(model: Model, plan: SamplingPlan) -> SamplingPlan:
    """Return the plan with its missing entries filled in from the size of the free bodies.

    Raises:
        InputDataError: If the model has no free body, or the plan requires a ground and the model has none.
    """
    file = model.file
    radii = [extent(whole, body).radius_m for whole in (at_middle(model),) for body in moving_wholes(whole, file)]
    if not radii or not file.tracked:
        raise InputDataError(
            f"{model.place}: no body is free, so there is nothing to simulate.",
            'a body with the motion "free".',
            "take a model with one, or fit one.",
        )
    radius = max(radii)
    gravity = float(np.linalg.norm(file.gravity_m_s2)) or GRAVITY_M_S2
    speed = math.sqrt(2 * gravity * 3 * radius)
    start = plan.start
    if start == "auto":
        start = "rest" if any(body.motion == "driven" for body in file.bodies) else "throw"
    if start == "slide" and file.ground is None:
        raise InputDataError(
            f'{plan.source}: start is "slide", and {model.place} has no ground.',
            '"throw", "rest".',
            "choose another start.",
        )
    defaults: dict[str, object] = {
        "height_m": (0.5 * radius, 3.0 * radius),
        "offset_m": 0.0 if start == "rest" else 0.5 * radius,
        "horizontal_speed_m_s": (0.0, 0.5 * speed),
        "vertical_speed_m_s": (-0.5 * speed, 0.5 * speed),
        "spin_rad_s": (0.0, 0.5 * speed / radius),
    }
    left_out = {name: value for name, value in defaults.items() if getattr(plan, name) is None}
    resolved = SamplingPlan(**{**plan.model_dump(), **left_out, "start": start})
    return plan.model_copy(update=dict(resolved))  # a copy keeps where the plan comes from


@dataclass(frozen=True, kw_only=True)
class StartRanges:
    """Distributions of the initial states: the entries of a sampling plan that `resolve_plan` fills in."""

    start: Literal["throw", "rest", "slide"]
    """Kind of start of the free bodies."""
    height_m: Distribution
    """Gap between the bounding sphere of a thrown body and the ground [m]."""
    offset_m: float
    """Largest horizontal distance from the place in the photos [m]."""
    horizontal_speed_m_s: Distribution
    """Initial horizontal speed of thrown and sliding bodies [m/s]."""
    vertical_speed_m_s: Distribution
    """Initial vertical velocity of thrown bodies, positive upwards [m/s]."""
    spin_rad_s: Distribution
    """Initial angular speed of thrown and sliding bodies [rad/s]."""

    @classmethod
    def of(cls, plan: SamplingPlan) -> StartRanges:
        """Return the ranges of a resolved plan.

        Raises:
            UsageError: If the plan is not resolved.
        """
        height, offset, spin = plan.height_m, plan.offset_m, plan.spin_rad_s
        level, vertical = plan.horizontal_speed_m_s, plan.vertical_speed_m_s
        if (
            plan.start == "auto"
            or height is None
            or offset is None
            or level is None
            or vertical is None
            or spin is None
        ):
            raise UsageError("the sampling plan is not resolved.", todo="call resolve_plan(model, plan) first.")
        return cls(
            start=plan.start,
            height_m=height,
            offset_m=offset,
            horizontal_speed_m_s=level,
            vertical_speed_m_s=vertical,
            spin_rad_s=spin,
        )
