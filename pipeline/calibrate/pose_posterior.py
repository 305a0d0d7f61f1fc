"""Poses and intrinsics given the observations and what is known of lenses: how far the model is off, and how certain.

With A the normal matrix of poses and intrinsics after elimination of the points, weighted as the robust loss of the
adjustment weighs, the posterior's information is A / (f sigma^2) + 1 / s^2 on each number of which a prior with
standard deviation s is known. It is inverted on the directions that are no similarity transform of the optical centres
(inner constraints; Triggs et al. 2000, "Bundle adjustment - a modern synthesis", section 9), so that the covariance is
that after the best similarity alignment of all centres.

The factor f is there since observations share errors. Neighbouring patches hold the same pixels, a feature's place
shifts with the direction of view, and what all observations of a place have in common is fitted by poses and points: no
residual shows it, and no scatter between parts of the points does.

The noise sigma is that of each image's observations before those far off were dropped (`observation_noise`): what is
left agrees with the cameras by selection. It is at least the noise of the residuals of all images, with a factor for
what dropping hides.

What a camera model leaves out is not known to be zero: where it has no distortion, k1 has a prior.
"""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Mapping as Map
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .bundle import POSE, PRINCIPAL, ReducedEquations, all_errors_px, linearized, told_by_points
from .camera_models import LADDER, LENS_PARAMETERS
from .colmap.mapping import LOSS_SCALE
from .focal_prior import EXIF_STD
from .observation_noise import LEAST_NOISE_PX
from .observation_noise import noise_px as common_noise_px
from .reconstruction import Array, SfmModel
from .triangulation import cross_matrices
from .turntable.motion import TurntableMotion

SHARED_VARIANCE = 2.0
"""Variance of the errors of poses, in units of that of independent errors: calibrated on photos of scanned objects with
known cameras ([Thresholds](../../docs/thresholds.md))."""
HIDDEN_VARIANCE = 2.0
"""Variance of observations, in units of what the residuals of those that were kept show of it."""

PRINCIPAL_STD = 0.005
"""Standard deviation of a coordinate of the principal point about the middle, as a fraction of the picture's diagonal:
a lens is centred on a sensor to some tenths of a millimetre."""

DISTORTION_STD = 0.1
"""Standard deviation of k1 about zero where the observations ask for no distortion: a lens has some."""

DOUBTED = 0.005
"""Share of all observations that may be wrong, wherever they do most harm (twice, `center_uncertainty`)."""
DOUBTED_OF_PHOTO = 0.25
"""Largest share of a photo's observations among them, so that a photo with few matches keeps most of these."""
ONE_PHOTO = 0.5
"""Share of the squared displacement of all centres above which a direction is that of one photo."""
TOLD_ELSEWHERE_DEG = 20.0
"""Angle between the rays of two other photos to a point from which on it is where they see it: an outline that glides
over a surface would leave residuals there."""

_STILL = 0.3
"""Standard deviations by which a principal point is off before it is moved."""
_SIMILARITY = 7
"""Numbers of a similarity transform."""
_FLOOR = 1e-9
"""Least information of a number that scales it, relative to the largest."""
_UNDETERMINED = 1e-12
"""Least information of a direction, relative to that of the numbers."""


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """Poses and intrinsics, principal points among them, given all that is known."""

    step: Array
    """From the model to the most probable numbers, shape (n,): in the order of `bundle.linearized`."""
    variances: Array
    """After the best similarity alignment of the centres, shape (n,)."""
    focal_columns: dict[str, int]
    """Column of the focal length of each camera whose intrinsics are estimated."""
    principal_columns: dict[str, int]
    """First column of its principal point."""


@dataclass(frozen=True, kw_only=True)
class _Solution:
    """The posterior's equations on the directions that are no similarity of the centres, solved."""

    models: dict[str, str]
    reduced: ReducedEquations
    basis: Array
    inverse: Array
    pull: Array
    principal: dict[str, int]
    loss_px: float
    noise_px: dict[str, float] | None

    def weakest(self, images: int) -> Array:
        """Return the direction in which the centres are least certain, shape (n,)."""
        centers = self.basis[(POSE * np.arange(images)[:, None] + np.arange(3)).ravel()]
        worst = np.linalg.eigh(centers @ self.inverse @ centers.T)[1][:, -1]
        return self.basis @ (self.inverse @ (centers.T @ worst))


def posterior(
    model: SfmModel,
    models: Map[str, str],
    with_exif: Collection[str] = (),
    motion: TurntableMotion | None = None,
    noise_px: Map[str, float] | None = None,
) -> Posterior:
    """Return how far a model is from the most probable poses and intrinsics, and how certain these are.

    Args:
        model: The model, about at the minimum of its adjustment.
        models: COLMAP's camera model of each camera whose intrinsics were estimated.
        with_exif: Those cameras among them whose focal length EXIF data have told, too.
        motion: The turntable that the poses were constrained to, whose axis is z; the numbers are then those of it.
        noise_px: Noise of observations by image [px], before some were dropped; where it is less, and for None, all
            images have one, that of the observations of the model with what dropping hides.
    """
    found = _solved(model, models, with_exif, motion, noise_px)
    return Posterior(
        step=found.basis @ (found.inverse @ found.pull),
        variances=np.einsum("ij,jk,ik->i", found.basis, found.inverse, found.basis, optimize=True),
        focal_columns=found.reduced.whole.columns,
        principal_columns=found.principal,
    )


def without_most_telling(
    model: SfmModel,
    models: Map[str, str],
    with_exif: Collection[str],
    motion: TurntableMotion | None,
    noise_px: Map[str, float] | None = None,
) -> SfmModel:
    """Return a model without the points that tell most of the direction in which its centres are least certain.

    Where two sides of an object share little, some twenty points tell how they lie to each other. Most of them may be
    wrong alike, as on an outline that glides over the surface, and then cameras bend until these agree with all others.
    Where that direction is one photo's alone, as of one that is hidden in part, points stay whose places other photos
    tell: they do not glide, and the photo's errors at them are its own.

    Args:
        model: As in `posterior`; as are the others.
        models: As there.
        with_exif: As there.
        motion: As there.
        noise_px: As there.
    """
    found, images = _solved(model, models, with_exif, motion, noise_px), list(model.T_cam_world)
    weakest = found.weakest(len(images))
    told = told_by_points(model, found.models, found.reduced, weakest, found.loss_px, found.noise_px)
    photo = np.repeat(np.arange(len(images)), [len(model.observations[image][1]) for image in images])
    point = np.concatenate([model.observations[image][1] for image in images])
    seen = np.split(photo[np.argsort(point, kind="stable")], np.cumsum(np.bincount(point, minlength=len(told)))[:-1])
    room, left = DOUBTED_OF_PHOTO * np.bincount(photo, minlength=len(images)), DOUBTED * len(point)
    kept, moved = np.ones(len(told), bool), _squares(weakest, len(images))
    alone = images[moved.argmax()] if moved.max() > ONE_PHOTO * moved.sum() else None
    certain = _told_elsewhere(model, alone) if alone else np.zeros(len(told), bool)
    for index in np.argsort(-told, kind="stable"):
        if certain[index]:
            continue
        left -= len(seen[index])
        if left < 0:
            break
        if (room[seen[index]] >= 1.0).all():
            room[seen[index]] -= 1.0
            kept[index] = False
    return model.with_points(kept)


def _squares(direction: Array, images: int) -> Array:
    """Return the squared displacements of the centres along a direction (n,), shape (image,)."""
    return (direction[: POSE * images].reshape(-1, POSE)[:, :3] ** 2).sum(1)


def _told_elsewhere(model: SfmModel, image: str) -> NDArray[np.bool_]:
    """Return whether two photos but one see a point from directions that are far apart, shape (point,)."""
    own, apart = np.unique(model.observations[image][1]), np.zeros(len(model.points), bool)
    place = np.full(len(model.points), -1)
    place[own] = np.arange(len(own))
    rays = np.full((len(own), len(model.T_cam_world), 3), np.nan)
    for k, (other, (_, seen)) in enumerate(model.observations.items()):
        if other != image:
            shared = seen[place[seen] >= 0]
            away = model.center(other) - model.points[shared]
            rays[place[shared], k] = away / np.linalg.norm(away, axis=1, keepdims=True)
    for point, ray in zip(own, rays, strict=True):
        mine = ray[~np.isnan(ray[:, 0])]
        apart[point] = len(mine) > 1 and (mine @ mine.T).min() < np.cos(np.radians(TOLD_ELSEWHERE_DEG))
    return apart


def _solved(
    model: SfmModel,
    models: Map[str, str],
    with_exif: Collection[str],
    motion: TurntableMotion | None,
    noise_px: Map[str, float] | None,
) -> _Solution:
    lengths = all_errors_px(model)
    weights = _weights(lengths)
    lenses = {camera: max(name, "SIMPLE_RADIAL", key=LADDER.index) for camera, name in models.items()}
    size = POSE * len(model.T_cam_world) + sum(LENS_PARAMETERS[lens] + PRINCIPAL for lens in lenses.values())
    design = np.eye(size) if motion is None else _design(model, motion, size)
    shown_px = float(np.sqrt(HIDDEN_VARIANCE)) * _noise_px(model, lengths, weights, design.shape[1])
    by_image, loss_px, variance = None, LOSS_SCALE * common_noise_px(lengths), shown_px**2
    if noise_px is not None and np.isfinite(shown_px):
        by_image = {image: max(shown_px, noise_px.get(image, 0.0)) for image in model.T_cam_world}
        loss_px, variance = LOSS_SCALE, 1.0  # errors are multiples of the noise
    reduced = linearized(model, lenses, loss_px, principal=True, noise_px=by_image).reduced()
    focal = reduced.whole.columns
    principal = {camera: column + LENS_PARAMETERS[lenses[camera]] for camera, column in focal.items()}
    scale = 1.0 / (SHARED_VARIANCE * variance)
    # the loss is curved less than its weights say, by sum w^2 / sum w for Cauchy's; steps are longer by as much
    information, pull = scale * reduced.matrix, scale * reduced.right * (weights.sum() / (weights**2).sum())
    for camera, column in principal.items():
        offset, std = _about_the_middle(model, camera)
        information[column : column + PRINCIPAL, column : column + PRINCIPAL] += np.eye(PRINCIPAL) / std**2
        pull[column : column + PRINCIPAL] -= offset / std**2
        if lenses[camera] != models[camera]:
            information[column - 1, column - 1] += 1.0 / DISTORTION_STD**2
    for camera in with_exif:
        known = 1.0 / (EXIF_STD * model.cameras[camera].focal_px) ** 2
        information[focal[camera], focal[camera]] += known  # its mean is in the focal length already
    basis = _basis(design, information, model.centers())
    return _Solution(
        models=lenses,
        reduced=reduced,
        basis=basis,
        inverse=_inverse(basis.T @ information @ basis),
        pull=basis.T @ pull,
        principal=principal,
        loss_px=loss_px,
        noise_px=by_image,
    )


def _inverse(information: Array) -> Array:
    """Return the inverse of a matrix whose diagonal is one; directions that nothing determines get a large variance."""
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    return (vectors / np.maximum(values, _UNDETERMINED)) @ vectors.T


def principal_points(model: SfmModel, models: Map[str, str]) -> dict[str, Array]:
    """Return the most probable principal points [px], shape (2,), by camera, where they are not those of the model yet.

    Args:
        model: The model, about at the minimum of its adjustment with the principal points that it has.
        models: COLMAP's camera model of each camera whose intrinsics were estimated.
    """
    found, points = posterior(model, models), {}
    for camera, column in found.principal_columns.items():
        own, one = slice(column, column + PRINCIPAL), model.cameras[camera]
        step, variance = found.step[own], found.variances[own]
        # none is less certain than what is known of it without a photo, but for rounding where nothing is determined
        known = (variance <= 1.001 * _about_the_middle(model, camera)[1] ** 2).all()
        if known and (step**2 > _STILL**2 * variance).any():
            points[camera] = np.array([one.cx, one.cy]) + step
    return points


def _about_the_middle(model: SfmModel, camera: str) -> tuple[Array, float]:
    """Return the principal point from the middle of the picture [px], shape (2,), and its standard deviation [px]."""
    one = model.cameras[camera]
    offset = np.array([one.cx - 0.5 * one.width, one.cy - 0.5 * one.height])
    return offset, PRINCIPAL_STD * float(np.hypot(one.width, one.height))


def _weights(lengths: Array) -> Array:
    """Return the weights of errors [px] under the loss of the adjustment."""
    return 1.0 / (1.0 + (lengths / (LOSS_SCALE * common_noise_px(lengths))) ** 2)


def _noise_px(model: SfmModel, lengths: Array, weights: Array, numbers: int) -> float:
    """Return the noise of a coordinate [px] of observations as the loss weighs them; infinite where all are used up.

    Args:
        model: The model.
        lengths: Its reprojection errors [px], shape (observation,).
        weights: Their weights.
        numbers: Free numbers of poses and intrinsics.
    """
    seen = np.unique(np.concatenate([points for _, points in model.observations.values()]))
    used = (numbers - _SIMILARITY + 3 * len(seen)) / (2 * len(lengths))
    freedom = 2 * float(weights.sum()) * (1.0 - used)
    if freedom <= 0:
        return np.inf
    return max(float(np.sqrt((weights * lengths**2).sum() / freedom)), LEAST_NOISE_PX)


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


def _basis(design: Array, information: Array, centers: Array) -> Array:
    """Return the directions (n, m - 7) of the free numbers that are no similarity of the centres, scaled alike.

    Args:
        design: How poses and intrinsics change with the numbers that are free, shape (n, m).
        information: Of poses and intrinsics, shape (n, n).
        centers: Optical centres, shape (image, 3).
    """
    diagonal = np.einsum("ia,ij,ja->a", design, information, design, optimize=True)
    # about zero for a motion of the axis of a turntable, which moves no image of a point
    scale = 1.0 / np.sqrt(np.maximum(diagonal, max(_FLOOR * diagonal.max(), np.finfo(float).tiny)))
    along = design * scale
    fixed = along.T @ _similarities(len(information), centers)
    fixed /= np.maximum(np.linalg.norm(fixed, axis=0), np.finfo(float).tiny)
    return along @ np.linalg.qr(fixed, mode="complete")[0][:, _SIMILARITY:]


def _similarities(size: int, centers: Array) -> Array:
    """Return the displacements of the centres under the seven similarities, in the rows of poses, shape (size, 7)."""
    count, moves = len(centers), np.zeros((size, _SIMILARITY))
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    away = (centers - centers.mean(0)) / max(extent, np.finfo(float).tiny)
    rows = (POSE * np.arange(count)[:, None] + np.arange(3)).ravel()
    moves[rows, :3] = np.tile(np.eye(3), (count, 1))
    moves[rows, 3:6] = -cross_matrices(away).reshape(-1, 3)
    moves[rows, 6] = away.ravel()
    return moves
