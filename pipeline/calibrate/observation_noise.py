"""How exactly the photos show a model's points: noise by photo, before observations that are far off are dropped.

Errors of features have long tails. What is left after observations beyond three standard deviations are dropped, with a
standard deviation that shrinks as they are, agrees with the cameras by selection, most of all in a photo with few
observations, whose pose follows those that are kept. So the noise is that of the residuals before, photo by photo, as
a few oblique or glossy patches may make one photo several times as noisy as the others.
"""

from __future__ import annotations

import numpy as np

from .reconstruction import Array, SfmModel
from .world_frame.metric_scale import umeyama

LEAST_NOISE_PX = 0.05
"""Lower bound of the noise of a coordinate [px]; without one, exact observations would have no scale."""
_MEDIAN_OF_RAYLEIGH = 1.1774
"""Median length of a vector of two normal numbers with standard deviation 1: sqrt(2 ln 2)."""
_POSE = 6
"""Numbers of a pose."""
_LEAST_IMAGES = 3
"""Least number of centres that a similarity is found from."""
_LEAST_FREE = 0.1
"""Least share of a photo's coordinates that its pose and points leave free, for the estimate of its noise."""


def noise_px(residuals_px: Array) -> float:
    """Return the standard deviation of a coordinate of the residuals from their median length [px]."""
    return max(float(np.median(residuals_px)) / _MEDIAN_OF_RAYLEIGH, LEAST_NOISE_PX)


def noise_by_image(model: SfmModel) -> dict[str, float]:
    """Return the standard deviation of a coordinate of the observations in each image [px].

    It is that of normal errors with the median of the residuals, more than these by what the fit takes: six numbers of
    the pose, and of each point three, shared by the images that see it.
    """
    count = np.bincount(np.concatenate([seen for _, seen in model.observations.values()]), minlength=len(model.points))
    noise = {}
    for image, (_, seen) in model.observations.items():
        taken = _POSE + (3.0 / count[seen]).sum()
        free = max(1.0 - taken / (2 * len(seen)), _LEAST_FREE) if len(seen) else _LEAST_FREE
        errors = model.errors_px(image) if len(seen) else np.zeros(1)
        noise[image] = noise_px(errors) / float(np.sqrt(free))
    return noise


def moved_by_dropping(before: SfmModel, after: SfmModel) -> dict[str, tuple[float, float]]:
    """Return how far each centre is from where it was, as a fraction of their extent, and the turn of the camera [rad].

    Args:
        before: The model before observations were dropped.
        after: The same images afterwards; the similarity that brings the centres together best does not count.
    """
    images = [image for image in after.T_cam_world if image in before.T_cam_world]
    old, new = (np.array([model.center(image) for image in images]) for model in (before, after))
    extent = float(np.linalg.norm(np.ptp(new, axis=0)))
    if len(images) < _LEAST_IMAGES or extent == 0.0:
        return {}
    aligned, moves = umeyama(old, new), {}
    for image, was, now in zip(images, aligned.points(old), new, strict=True):
        turn = aligned.pose(before.T_cam_world[image])[:3, :3] @ after.T_cam_world[image][:3, :3].T
        moves[image] = (
            float(np.linalg.norm(was - now)) / extent,
            float(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))),
        )
    return moves
