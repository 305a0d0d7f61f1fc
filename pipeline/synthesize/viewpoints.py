"""Cameras of a rollout, drawn from a sampling plan.

Fixed values consume no random number, so a rollout keeps its draws when a plan gets another entry.
"""

from __future__ import annotations

import math

import numpy as np

from ...datasets.capture.cameras import Camera
from ...datasets.models.model import Model
from ...schemas import SamplingPlan, SynthesizeConfig
from ..geometry.viewpoint import look_at
from .distributions import draw
from .plan import StartRanges, extent, horizontal_direction, moving_wholes, up_direction
from .wholes import at_middle


def look_at_cameras(
    model: Model, plan: SamplingPlan, config: SynthesizeConfig, rng: np.random.Generator | None = None
) -> dict[str, Camera]:
    """Return the cameras of a plan, which look at the space of the free bodies from evenly spread directions.

    At the default distance the highest start and its surroundings fill most of the height of the image.

    Args:
        model: The model.
        plan: A resolved plan.
        config: The size of the images.
        rng: Source of randomness of varied entries; default: seed 0.
    """
    ranges = StartRanges.of(plan)
    rng = rng or np.random.default_rng(0)
    file, up = model.file, up_direction(model.file)
    whole = at_middle(model)
    free = moving_wholes(whole, file)
    radius = max(extent(whole, body).radius_m for body in free)
    middle = np.mean([body.photo_pose.position_m for body in free], axis=0)
    thrown = ranges.start == "throw"
    top = ranges.height_m.support[1] + 2 * radius if thrown else 3 * radius
    floor = file.ground.offset_m if file.ground else float(middle @ up) - radius
    middle = middle + up * (floor + 0.5 * top - middle @ up)
    offset = ranges.offset_m if thrown else max(ranges.offset_m, 0.5 * radius)
    reach = max(0.5 * top, offset + 2 * radius) * 1.15
    cameras = {}
    for number, direction in enumerate(np.radians(np.linspace(*plan.view_azimuth_deg, plan.views))):
        azimuth = direction + math.radians(draw(plan.view_shift_deg, rng))
        elevation, roll = (math.radians(draw(angle, rng)) for angle in (plan.view_elevation_deg, plan.view_roll_deg))
        half_angle = math.radians(draw(plan.view_angle_deg, rng)) / 2
        distance = reach / math.sin(half_angle) if plan.view_distance_m is None else draw(plan.view_distance_m, rng)
        target = middle if plan.view_aim_m == 0 else middle + _in_ball(plan.view_aim_m, rng)
        focal = 0.5 * config.height / math.tan(half_angle)
        K = np.array([[focal, 0, config.width / 2], [0, focal, config.height / 2], [0, 0, 1]])
        side = horizontal_direction(up, azimuth - math.pi / 2)
        eye = target + distance * (math.cos(elevation) * side + math.sin(elevation) * up)
        pose = look_at(eye, target, up)
        if roll:
            pose[:3, :2] = pose[:3, :2] @ [[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]]
        cameras[f"view{number}"] = Camera(
            width=config.width, height=config.height, K=K, distortion=np.zeros(0), T_world_cam=pose
        )
    return cameras


def _in_ball(radius: float, rng: np.random.Generator) -> np.ndarray:
    """Return a uniformly distributed point of a ball around the origin."""
    way = rng.normal(size=3)
    return way / np.linalg.norm(way) * radius * rng.random() ** (1 / 3)
