"""Metric scale of a model from depth maps of its photos: those of an RGB-D camera or of a phone."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from ..reconstruction import SfmModel
from .metric_scale import MetricFrame, scaling

SENSOR_STD = 0.01
"""Standard error of the scale of a depth sensor, which no number of maps makes smaller: half of the 2 % that Intel
states as the largest error of a D400 within two metres."""
LEAST_MAPS, LEAST_POINTS = 3, 10
_OF_MEDIAN = 1.2533
"""Standard deviation of the median of many normal numbers over that of their mean: sqrt(pi / 2)."""


def from_depth(
    model: SfmModel, photos: Iterable[str], depth_of: Callable[[str], NDArray[np.float32] | None]
) -> MetricFrame | None:
    """Return the scale by which points lie at the measured depths, or None where too few maps show points.

    Each photo tells the median ratio of measured depth to that of its points, so that wrong points and edges do not
    count; the scale is the median over the photos.

    Args:
        model: The model.
        photos: Registered photos.
        depth_of: Gives the depth map of a photo along the optical axis [m], 0 where unknown, shape (H, W), or None.
    """
    ratios = [ratio for name in photos if (ratio := _ratio(model, name, depth_of(name))) is not None]
    if len(ratios) < LEAST_MAPS:
        return None
    scale = float(np.median(ratios))
    scatter = _OF_MEDIAN * float(np.std(np.array(ratios) / scale, ddof=1)) / np.sqrt(len(ratios))
    return MetricFrame(
        similarity=scaling(scale),
        source=f"depth maps of {len(ratios)} photos",
        relative_std=float(np.hypot(scatter, SENSOR_STD)),
        fixes_frame=False,
    )


def _ratio(model: SfmModel, name: str, depth_m: NDArray[np.float32] | None) -> float | None:
    """Return the median of measured depth over that of the points [m a unit], or None where few points have one."""
    camera = model.camera(name)
    if depth_m is None or depth_m.shape != (camera.height, camera.width):
        return None
    pixels, seen = model.observations[name]
    pose = model.T_cam_world[name]
    z = model.points[seen] @ pose[2, :3] + pose[2, 3]
    columns, rows = np.floor(pixels).astype(int).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height) & (z > 0)
    measured = depth_m[rows[inside], columns[inside]].astype(float)
    known = measured > 0
    return float(np.median(measured[known] / z[inside][known])) if known.sum() >= LEAST_POINTS else None
