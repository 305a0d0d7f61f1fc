"""How exactly the photos show a model's points: noise by photo, before observations that are far off are dropped.

Errors of features have long tails. What is left after observations beyond three standard deviations are dropped, with a
standard deviation that shrinks as they are, agrees with the cameras by selection, most of all in a photo with few
observations, whose pose follows those that are kept. So the noise is that of the residuals before, photo by photo, as
a few oblique or glossy patches may make one photo several times as noisy as the others.
"""

from __future__ import annotations

import numpy as np

from .reconstruction import Array, SfmModel

LEAST_NOISE_PX = 0.05
"""Lower bound of the noise of a coordinate [px]; without one, exact observations would have no scale."""
_MEDIAN_OF_RAYLEIGH = 1.1774
"""Median length of a vector of two normal numbers with standard deviation 1: sqrt(2 ln 2)."""
_POSE = 6
"""Numbers of a pose."""
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
