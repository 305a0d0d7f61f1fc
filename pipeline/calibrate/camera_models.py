"""Choice of the camera model: from simple to rich, as rich as the observations support.

A model with many free numbers can bend to a few matches until no further photo fits, which happens with photos of one
object through a long lens; a model with too few leaves an error that grows towards the corners. So cameras are first
estimated with simple models, and the result is then adjusted with richer ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .observation_noise import noise_px
from .reconstruction import Array

LADDER = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""COLMAP's camera models, from simple to rich: each holds those before it."""
LENS_PARAMETERS = {"SIMPLE_PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 6}
"""Free numbers of a camera: focal lengths and lens; the principal point comes last (`pose_posterior`)."""
FIRST_TRIED = ("SIMPLE_RADIAL", "SIMPLE_PINHOLE", "OPENCV")
"""Camera models of the mapping, in this order until all images are registered."""
LEAST_GAIN = 0.01
"""Least relative decrease of the robust sum of squares for which a richer model is taken. Systematic errors of matches
(gloss, blur) are no noise: they let rich models gain a little on any photos, so that a test for noise alone would take
the richest always."""
_TRUNCATE = 3.0
"""Residuals count as at most this many standard deviations."""


def focal_numbers(model: str) -> int:
    """Return how many of the free numbers of a camera model are focal lengths; they come first."""
    return 2 if model == "OPENCV" else 1


def richer(model: str, limit: str) -> tuple[str, ...]:
    """Return a camera model and those richer than it, up to `limit`."""
    return LADDER[LADDER.index(model) : max(LADDER.index(limit), LADDER.index(model)) + 1]


def supported(residuals_px: Sequence[tuple[str, Array]], cameras: int) -> str:
    """Return the simplest camera model that no richer one beats.

    A richer model is taken if it lowers the truncated sum of squares, in units of the noise of the richest model, by
    more than its further parameters cost under the Bayesian information criterion (Schwarz, 1978), ln(n) each, and by
    at least 1 %.

    Args:
        residuals_px: Camera models from simple to rich, each with the lengths of the reprojection
            errors of the same observations [px].
        cameras: Number of cameras that have such a model.
    """
    noise = noise_px(residuals_px[-1][1])
    taken, least = residuals_px[0][0], robust_cost(residuals_px[0][1], noise)
    for model, lengths in residuals_px[1:]:
        cost = robust_cost(lengths, noise)
        price = cameras * (LENS_PARAMETERS[model] - LENS_PARAMETERS[taken]) * np.log(2 * len(lengths))
        if least - cost > max(price, LEAST_GAIN * least):
            taken, least = model, cost
    return taken


def robust_cost(lengths_px: Array, noise: float) -> float:
    """Return the truncated sum of squares of errors [px], in units of their noise [px]."""
    return float(np.minimum((lengths_px / noise) ** 2, _TRUNCATE**2).sum())
