"""How far camera centres and focal lengths of a model may be off, from the normal equations of its bundle adjustment.

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
from scipy import sparse

from .camera_models import LENS_PARAMETERS
from .focal_prior import EXIF_STD
from .mapping import noise_px
from .reconstruction import Array, SfmCamera, SfmModel, distort
from .triangulation import cross_matrices, projection_jacobian

SHARED_ERROR_PX = 0.015
"""Error that observations share [px], as root mean square: calibrated on photos of one scanned object with known
cameras, judged on those of others ([Thresholds](../../docs/thresholds.md))."""
_POSE = 6
_RIDGE = 1e-12
"""Relative weight that keeps a point with parallel rays from an infinite covariance."""


def center_stds(model: SfmModel, models: Map[str, str], with_exif: Collection[str] = ()) -> dict[str, float]:
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

    Returns:
        Standard deviation by image, as a fraction of the diagonal of the box around all centres; infinite where the
        observations do not determine the cameras.
    """
    variances, _ = _variances(model, models, with_exif)
    centers = model.centers()
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    sums = variances[: _POSE * len(centers)].reshape(-1, _POSE)[:, :3].sum(1) / extent**2
    return {image: _root(value) for image, value in zip(model.T_cam_world, sums, strict=True)}


def focal_stds(model: SfmModel, models: Map[str, str]) -> dict[str, float]:
    """Return the relative standard deviation of the focal length of each camera in `models`, from the matches alone."""
    variances, columns = _variances(model, models, ())
    # of OPENCV's two focal lengths the first stands for both: the pixels of photos are square
    return {name: _root(variances[columns[name]]) / model.cameras[name].focal_px for name in columns}


def _root(variance: float) -> float:
    return float(np.sqrt(variance)) if variance > 0 else np.inf


def _variances(model: SfmModel, models: Map[str, str], with_exif: Collection[str]) -> tuple[Array, dict[str, int]]:
    """Return the variances of poses and intrinsics under inner constraints, and the column of each focal length."""
    normal, columns, count, noise = _reduced_normal_matrix(model, list(model.T_cam_world), models)
    shared = noise**2 + 2 * count * SHARED_ERROR_PX**2
    for name in with_exif:
        normal[columns[name], columns[name]] += shared / (EXIF_STD * model.cameras[name].focal_px) ** 2
    return _inverse_diagonal(normal, model.centers()) * shared, columns


def _inverse_diagonal(normal: Array, centers: Array) -> Array:
    """Return the diagonal of the inverse of a normal matrix under inner constraints on the centres (image, 3)."""
    size, count = len(normal), len(centers)
    gauge = np.zeros((size, 7))
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    away = (centers - centers.mean(0)) / max(extent, np.finfo(float).tiny)
    rows = (_POSE * np.arange(count)[:, None] + np.arange(3)).ravel()
    gauge[rows, :3] = np.tile(np.eye(3), (count, 1))
    gauge[rows, 3:6] = -cross_matrices(away).reshape(-1, 3)
    gauge[rows, 6] = away.ravel()
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    gauge = gauge * scale[:, None]
    gauge /= np.maximum(np.linalg.norm(gauge, axis=0), np.finfo(float).tiny)
    bordered = np.block([[normal * scale[:, None] * scale, gauge], [gauge.T, np.zeros((7, 7))]])
    try:
        return np.diag(np.linalg.inv(bordered))[:size] * scale**2
    except np.linalg.LinAlgError:
        return np.full(size, np.inf)


def _reduced_normal_matrix(
    model: SfmModel, images: list[str], models: Map[str, str]
) -> tuple[Array, dict[str, int], int, float]:
    """Return the normal matrix of poses and intrinsics without the points, and what belongs to it.

    That is the first column of the intrinsics of each camera, the number of observations, and their noise [px].
    The 6 numbers of a pose are the shift of its centre, world axes, and its rotation, camera axes; those of the cameras
    with estimated intrinsics follow.
    """
    first: dict[str, int] = {}
    size = _POSE * len(images)
    for camera, name in models.items():
        first[camera], size = size, size + LENS_PARAMETERS[name]
    normal, points = np.zeros((size, size)), np.zeros((len(model.points), 3, 3))
    crossed, lengths = [], []
    for k, image in enumerate(images):
        camera = model.image_camera[image]
        pose, point, lens, residual = _jacobians(model, image, models.get(camera))
        columns = np.arange(_POSE * k, _POSE * (k + 1))
        if camera in first:
            columns = np.r_[columns, first[camera] + np.arange(lens.shape[2])]
        mine, seen = np.concatenate([pose, lens], 2), model.observations[image][1]
        normal[np.ix_(columns, columns)] += np.einsum("oai,oaj->ij", mine, mine)
        np.add.at(points, seen, np.einsum("oai,oaj->oij", point, point))
        block = np.einsum("oai,oaj->ioj", mine, point).reshape(len(columns), -1)
        places = (3 * seen[:, None] + np.arange(3)).ravel()
        crossed.append((block.ravel(), np.repeat(columns, len(places)), np.tile(places, len(columns))))
        lengths.append(np.linalg.norm(residual, axis=1))
    value, row, column = (np.concatenate(parts) for parts in zip(*crossed, strict=True))
    coupling = sparse.csr_array((value, (row, column)), shape=(size, 3 * len(points)))
    points += _RIDGE * np.trace(points, axis1=1, axis2=2)[:, None, None] * np.eye(3) + np.finfo(float).tiny * np.eye(3)
    inverse = sparse.block_diag(list(np.linalg.inv(points)), format="csr")
    eliminated = (coupling @ inverse @ coupling.T).toarray()
    residuals = np.concatenate(lengths)
    freedom = 2 * len(residuals) - size - 3 * len(points)
    noise = noise_px(residuals) * np.sqrt(2 * len(residuals) / max(freedom, 1))
    return normal - eliminated, first, len(residuals), noise


def _jacobians(model: SfmModel, image: str, lens: str | None) -> tuple[Array, Array, Array, Array]:
    """Return derivatives of an image's observed pixels by pose (o, 2, 6), point (o, 2, 3) and lens, and residuals."""
    camera, pose = model.camera(image), model.T_cam_world[image]
    pixels, seen = model.observations[image]
    local = model.points[seen] @ pose[:3, :3].T + pose[:3, 3]
    slopes = local[:, :2] / local[:, 2:]
    bent, bending = distort(slopes, camera.distortion)
    focal = np.array([camera.fx, camera.fy])
    by_local = focal[:, None] * (bending @ projection_jacobian(local))
    by_pose = np.concatenate([by_local @ -pose[:3, :3], by_local @ -cross_matrices(local)], 2)
    by_lens = np.stack(_lens_columns(slopes, bent, camera, lens), -1) if lens else np.zeros((len(seen), 2, 0))
    residual = bent * focal + [camera.cx, camera.cy] - pixels
    return by_pose, by_local @ pose[:3, :3], by_lens, residual


def _lens_columns(slopes: Array, bent: Array, camera: SfmCamera, lens: str) -> list[Array]:
    """Return the derivatives (observation, 2) of the pixels by the free numbers of a camera, as COLMAP orders them."""
    x, y = slopes.T
    zero, r2 = np.zeros_like(x), x**2 + y**2
    focal = np.array([camera.fx, camera.fy])
    focals = [bent]
    if lens == "OPENCV":
        focals = [np.stack([bent[:, 0], zero], 1), np.stack([zero, bent[:, 1]], 1)]
    lenses = [
        slopes * r2[:, None],
        slopes * r2[:, None] ** 2,
        np.stack([2 * x * y, r2 + 2 * y**2], 1),
        np.stack([r2 + 2 * x**2, 2 * x * y], 1),
    ]
    return [*focals, *(focal * column for column in lenses[: LENS_PARAMETERS[lens] - len(focals)])]
