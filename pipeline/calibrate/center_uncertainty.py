"""How far centres, rotations and focal lengths of a model may be off: from the normal equations of its adjustment.

The covariance of least squares counts the errors of all matches as independent. They are not: a feature's place shifts
with the direction from which it is seen, by hundredths of a pixel, and all features of a surface shift alike. Through
a long lens, or where few matches tie some photos to the others, such shifts bend the whole path of the camera while
every match still agrees with it, so that no residual and no second half of the matches shows it. An allowance for
shared errors is added, in the pattern that moves the cameras most.
"""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Mapping as Map

import numpy as np

from .bundle import POSE, linearized
from .focal_prior import EXIF_STD
from .mapping import noise_px
from .reconstruction import Array, SfmModel
from .triangulation import cross_matrices
from .turntable_motion import TurntableMotion

SHARED_ERROR_PX = 0.015
"""Error that observations share [px], as root mean square: calibrated on photos of one scanned object with known
cameras, judged on those of others ([Thresholds](../../docs/thresholds.md))."""

PRINCIPAL_STD = 0.003
"""Standard deviation of a coordinate of the principal point about the middle, as a fraction of the picture's diagonal:
a lens is centred on a sensor to some tenths of a millimetre. Matches on one object hardly tell it from a rotation."""

UNCERTAIN_CENTER = 0.005
"""Standard deviation of an optical centre, as a fraction of the extent of all, above which a warning is given; where
one would be, places of points in the photos are aligned first."""

_FLOOR = 1e-9
"""Least information of a number that scales it, relative to the largest."""


def center_stds(
    model: SfmModel, models: Map[str, str], with_exif: Collection[str] = (), motion: TurntableMotion | None = None
) -> dict[str, float]:
    """Return the standard deviation of each optical centre, after the best similarity alignment of all centres.

    With H the normal matrix of poses and intrinsics after elimination of the points, and C the displacements of the
    centres under a similarity transform, the covariance is the upper left block of [[H, C], [C^T, 0]]^-1 (inner
    constraints; Triggs et al. 2000, "Bundle adjustment - a modern synthesis", section 9) times sigma^2 + 2 n b^2: n
    observations with independent noise sigma, and an error b that they share. The second term is derived: a pattern of
    errors with root mean square b over 2 n numbers moves a direction of H with eigenvalue l by at most b sqrt(2 n / l).

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
    return pose_stds(model, models, with_exif, motion)[0]


def pose_stds(
    model: SfmModel, models: Map[str, str], with_exif: Collection[str] = (), motion: TurntableMotion | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Return what `center_stds` and `rotation_stds` do, from one covariance; arguments as there."""
    variances, _ = _variances(model, models, with_exif, motion)
    return _of_centers(model, variances), _of_rotations(model, models, variances)


def _of_centers(model: SfmModel, variances: Array) -> dict[str, float]:
    centers = model.centers()
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    sums = variances[: POSE * len(centers)].reshape(-1, POSE)[:, :3].sum(1) / extent**2
    return {image: _root(value) for image, value in zip(model.T_cam_world, sums, strict=True)}


def rotation_stds(
    model: SfmModel, models: Map[str, str], with_exif: Collection[str] = (), motion: TurntableMotion | None = None
) -> dict[str, float]:
    """Return the standard deviation of each camera's rotation [rad], after the alignment of `center_stds`.

    A principal point that is not in the middle of the picture, where estimated cameras have it, counts as a rotation.

    Args:
        model: As in `center_stds`.
        models: As there.
        with_exif: As there.
        motion: As there.
    """
    return pose_stds(model, models, with_exif, motion)[1]


def _of_rotations(model: SfmModel, models: Map[str, str], variances: Array) -> dict[str, float]:
    turns = variances[: POSE * len(model.T_cam_world)].reshape(-1, POSE)[:, 3:].sum(1)
    stds = {}
    for image, variance in zip(model.T_cam_world, turns, strict=True):
        camera = model.camera(image)
        shift = PRINCIPAL_STD * np.hypot(camera.width, camera.height) if model.image_camera[image] in models else 0.0
        stds[image] = float(np.hypot(_root(variance), np.sqrt(2.0) * shift / camera.focal_px))
    return stds


def focal_stds(model: SfmModel, models: Map[str, str]) -> dict[str, float]:
    """Return the relative standard deviation of the focal length of each camera in `models`, from the matches alone."""
    variances, columns = _variances(model, models, (), None)
    # of OPENCV's two focal lengths the first stands for both: the pixels of photos are square
    return {name: _root(variances[columns[name]]) / model.cameras[name].focal_px for name in columns}


def _root(variance: float) -> float:
    return float(np.sqrt(variance)) if variance > 0 else np.inf


def _variances(
    model: SfmModel, models: Map[str, str], with_exif: Collection[str], motion: TurntableMotion | None
) -> tuple[Array, dict[str, int]]:
    """Return the variances of poses and intrinsics under inner constraints, and the column of each focal length."""
    equations = linearized(model, models)
    normal, columns = equations.reduced().matrix, equations.columns
    design = np.eye(len(normal)) if motion is None else _design(model, motion, len(normal))
    count = len(equations.residuals_px)
    freedom = 2 * count - design.shape[1] - 3 * len(model.points)
    noise = noise_px(equations.residuals_px) * np.sqrt(2 * count / max(freedom, 1))
    shared = noise**2 + 2 * count * SHARED_ERROR_PX**2
    for name in with_exif:
        normal[columns[name], columns[name]] += shared / (EXIF_STD * model.cameras[name].focal_px) ** 2
    return _inverse_diagonal(normal, model.centers(), design) * shared, columns


def _design(model: SfmModel, motion: TurntableMotion, size: int) -> Array:
    """Return how poses and intrinsics change with the numbers of a turntable, and with its axis: four more numbers.

    The axis is fixed in an adjustment. Here it may move, since centres are compared after the best similarity.
    """
    names = list(model.T_cam_world)
    along = np.zeros((size, 4))
    for k, pose in enumerate(model.T_cam_world.values()):
        at = POSE * k
        along[at : at + 2, :2] = np.eye(2)
        along[at : at + 3, 2:] = -cross_matrices(model.center(names[k])[None])[0][:, :2]
        along[at + 3 : at + 6, 2:] = -pose[:3, :2]
    return np.concatenate([motion.design(names, size - POSE * len(names)), along], axis=1)


def _inverse_diagonal(normal: Array, centers: Array, design: Array) -> Array:
    """Return the diagonal of the inverse of a normal matrix under inner constraints on the centres (image, 3).

    Args:
        normal: Of poses and intrinsics, shape (n, n).
        centers: Optical centres, shape (image, 3).
        design: How these numbers change with those that are free, shape (n, m).
    """
    size, count = design.shape[1], len(centers)
    gauge = np.zeros((len(normal), 7))
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    away = (centers - centers.mean(0)) / max(extent, np.finfo(float).tiny)
    rows = (POSE * np.arange(count)[:, None] + np.arange(3)).ravel()
    gauge[rows, :3] = np.tile(np.eye(3), (count, 1))
    gauge[rows, 3:6] = -cross_matrices(away).reshape(-1, 3)
    gauge[rows, 6] = away.ravel()
    free = design.T @ normal @ design
    diagonal = np.diag(free)  # about zero for a motion of the axis, which moves no image of a point
    scale = 1.0 / np.sqrt(np.maximum(diagonal, max(_FLOOR * diagonal.max(), np.finfo(float).tiny)))
    gauge = design.T @ gauge * scale[:, None]
    gauge /= np.maximum(np.linalg.norm(gauge, axis=0), np.finfo(float).tiny)
    bordered = np.block([[free * scale[:, None] * scale, gauge], [gauge.T, np.zeros((7, 7))]])
    try:
        inverse = np.linalg.inv(bordered)[:size, :size] * scale[:, None] * scale
    except np.linalg.LinAlgError:
        return np.full(len(normal), np.inf)
    return np.einsum("ij,jk,ik->i", design, inverse, design, optimize=True)
