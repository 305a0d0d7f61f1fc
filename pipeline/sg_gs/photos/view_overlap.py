"""Checks that photos show the given points and shapes, which detect wrong conventions or scales of the cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ....schemas import InputDataError
from ...geometry.solid_grid import Array
from .views import View

LEAST_SHARE = 0.05
"""Minimum share of the points that lie in view of some photo."""
LEAST_COVERED = 0.1
"""Minimum share of a shape's visible surface that lies inside its masks; below it shape and masks do not agree."""
_HINT = (
    "compare the conventions: poses camera to world with OpenCV axes (x right, y down, z forward), and one unit of "
    "length for all; 'cgwm validate' reprojects what it can."
)


def require_points_in_view(points: Array, views: Sequence[View], what: str) -> float:
    """Return the share of points (n, 3), world frame, that lie in view of some photo.

    Raises:
        InputDataError: If the share is less than `LEAST_SHARE`.
    """
    share = float(np.mean(np.any([view.camera.pixels_of(points)[0] for view in views], 0))) if len(points) else 1.0
    if share < LEAST_SHARE:
        raise InputDataError(
            f"{what}: {share:.0%} of its {len(points)} points lie in view of any of the {len(views)} photos.",
            f"at least {LEAST_SHARE:.0%}.",
            _HINT,
        )
    return share


def require_body_in_masks(surface: Array, views: Sequence[View], body: int, name: str) -> None:
    """Check that the shape of a body, at its given pose, lies inside its masks.

    Args:
        surface: Points of its surface [m], world frame, shape (n, 3).
        views: Photos with masks that show it.
        body: Index of the body in the manifest.
        name: Name of the body.

    Raises:
        InputDataError: If less than `LEAST_COVERED` of its surface in view lies inside its masks.
    """
    seen, covered = 0, 0
    for view in views:
        inside, column, row = view.camera.pixels_of(surface)
        seen += np.count_nonzero(inside)
        if view.labels is not None:
            covered += np.count_nonzero(inside & (view.labels[row, column] == body + 1))
    if covered < LEAST_COVERED * seen or seen == 0:
        raise InputDataError(
            f"body '{name}': {seen / (len(surface) * len(views)):.0%} of the surface of its shape lies in view of the "
            f"{len(views)} photos whose masks show it, and {covered / max(seen, 1):.0%} of that inside those masks.",
            f"at least {LEAST_COVERED:.0%}.",
            f"correct photo_pose, the body's pose while the photos were taken; and {_HINT}",
        )
