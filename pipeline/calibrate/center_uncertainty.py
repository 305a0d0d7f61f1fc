"""How far optical centres, rotations and focal lengths of a model may be off, from their posterior."""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Mapping as Map

import numpy as np

from .bundle import POSE
from .pose_posterior import Posterior, posterior, without_most_telling
from .reconstruction import Array, SfmModel
from .turntable.motion import TurntableMotion

UNCERTAIN_CENTER = 0.0012
"""Standard deviation of an optical centre, as a fraction of the extent of all, above which a warning is given."""

_TIMES_DOUBTED = 2
"""Directions, in turn, whose most telling points are left out."""


def center_stds(
    model: SfmModel, models: Map[str, str], with_exif: Collection[str] = (), motion: TurntableMotion | None = None
) -> dict[str, float]:
    """Return the standard deviation of each optical centre, after the best similarity alignment of all centres.

    Args:
        model: The model.
        models: COLMAP's camera model of each camera whose intrinsics were estimated.
        with_exif: Those cameras among them whose focal length EXIF data have told, too.
        motion: The turntable that the poses were constrained to, whose axis is z; the covariance is then that of its
            numbers.

    Returns:
        Standard deviation by image, as a fraction of the diagonal of the box around all centres; infinite where the
        observations do not determine the cameras.
    """
    return _stds(model, posterior(model, models, with_exif, motion))[0]


def pose_stds(
    model: SfmModel,
    models: Map[str, str],
    with_exif: Collection[str] = (),
    motion: TurntableMotion | None = None,
    noise_px: Map[str, float] | None = None,
    moved: Map[str, tuple[float, float]] | None = None,
) -> tuple[dict[str, float], dict[str, float]]:
    """Return what `center_stds` does, and the standard deviation of each camera's rotation [rad] after that alignment.

    The points that tell most of what is least certain are left out for it, `pose_posterior.DOUBTED` of all observations
    at a time: where few points tie the cameras, all of these may be wrong.

    Args:
        model: As in `center_stds`.
        models: As there.
        with_exif: As there.
        motion: As there.
        noise_px: Noise of observations by image [px], before some were dropped; None takes that of those left.
        moved: How far that moved each centre, of the extent, and turned each camera [rad]: a draw of their errors,
            whose variance is added.
    """
    for _ in range(_TIMES_DOUBTED):
        model = without_most_telling(model, models, with_exif, motion, noise_px)
    stds = _stds(model, posterior(model, models, with_exif, motion, noise_px))
    shifts, turns = ({image: both[k] for image, both in (moved or {}).items()} for k in (0, 1))
    return _with(stds[0], shifts), _with(stds[1], turns)


def _with(stds: dict[str, float], errors: Map[str, float]) -> dict[str, float]:
    return {image: float(np.hypot(std, errors.get(image, 0.0))) for image, std in stds.items()}


def _stds(model: SfmModel, found: Posterior) -> tuple[dict[str, float], dict[str, float]]:
    sums = found.variances[: POSE * len(model.T_cam_world)].reshape(-1, 2, 3).sum(2)
    extent = float(np.linalg.norm(np.ptp(model.centers(), axis=0)))
    return _by_image(model, sums[:, 0] / extent**2), _by_image(model, sums[:, 1])


def focal_stds(model: SfmModel, models: Map[str, str]) -> dict[str, float]:
    """Return the relative standard deviation of the focal length of each camera in `models`, from the matches alone."""
    found = posterior(model, models)
    # of OPENCV's two focal lengths the first stands for both: the pixels of photos are square
    return {
        name: _root(found.variances[column]) / model.cameras[name].focal_px
        for name, column in found.focal_columns.items()
    }


def _by_image(model: SfmModel, variances: Array) -> dict[str, float]:
    return {image: _root(value) for image, value in zip(model.T_cam_world, variances, strict=True)}


def _root(variance: float) -> float:
    return float(np.sqrt(variance)) if variance > 0 else np.inf
