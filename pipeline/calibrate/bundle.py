"""Bundle adjustment, linearised: what poses, intrinsics and points of a model do to its observations.

The six numbers of a pose are the shift of its optical centre, along the axes of the world, and its rotation, about the
axes of the camera (from the left). The intrinsics of the cameras follow, in COLMAP's order, where asked with the
principal point behind them, then the points.
"""

from __future__ import annotations

from collections.abc import Mapping as Map
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from ..geometry.sight_rays import projection_jacobian
from .camera_models import LENS_PARAMETERS, focal_numbers
from .reconstruction import Array, SfmCamera, SfmModel, distort
from .triangulation import cross_matrices

POSE = 6
"""Numbers of a pose."""
PRINCIPAL = 2
"""Numbers of a principal point: its column and row."""
_RIDGE = 1e-12
"""Relative weight that keeps a point with parallel rays from an infinite covariance."""


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Weighted normal equations of all observations of a model, points kept apart."""

    matrix: Array
    """Of poses and intrinsics, shape (n, n)."""
    right: Array
    """Their right side, shape (n,)."""
    points: Array
    """Blocks of the points, shape (point, 3, 3)."""
    points_right: Array
    """Their right side, shape (point, 3)."""
    coupling: sparse.csr_array
    """Shape (n, 3 points)."""
    columns: dict[str, int]
    """First column of the intrinsics of each camera that has any."""
    residuals_px: Array
    """Reprojection errors, shape (observation,)."""

    def reduced(self, damping: float = 0.0) -> ReducedEquations:
        """Return the equations of poses and intrinsics, points eliminated.

        Args:
            damping: Relative increase of the diagonal of the points' blocks.
        """
        blocks = self.points + damping * self.points * np.eye(3)
        trace = np.trace(self.points, axis1=1, axis2=2)[:, None, None]
        blocks = blocks + (_RIDGE * trace + np.finfo(float).tiny) * np.eye(3)
        count = len(blocks)
        places = (np.arange(count), np.arange(count + 1))
        inverse = sparse.bsr_array((np.linalg.inv(blocks), *places), shape=(3 * count, 3 * count)).tocsr()
        matrix = self.matrix - (self.coupling @ inverse @ self.coupling.T).toarray()
        right = self.right - self.coupling @ (inverse @ self.points_right.ravel())
        return ReducedEquations(self, matrix, right, sparse.csr_array(inverse))


@dataclass(frozen=True)
class ReducedEquations:
    """Normal equations of poses and intrinsics alone."""

    whole: NormalEquations
    """The equations that they come from."""
    matrix: Array
    """Shape (n, n)."""
    right: Array
    """Shape (n,)."""
    inverse: sparse.csr_array
    """Inverse of the points' blocks."""

    def points_step(self, step: Array, share: float = 1.0) -> Array:
        """Return the step of the points (point, 3) that belongs to one of poses and intrinsics (n,).

        Args:
            step: The step of poses and intrinsics.
            share: Share of the whole step that it is.
        """
        slope = share * self.whole.points_right.ravel() - self.whole.coupling.T @ step
        return np.asarray(self.inverse @ slope).reshape(-1, 3)


def linearized(
    model: SfmModel,
    models: Map[str, str],
    loss_px: float = np.inf,
    principal: bool = False,
    noise_px: Map[str, float] | None = None,
) -> NormalEquations:
    """Return the normal equations of a model.

    Args:
        model: The model.
        models: COLMAP's camera model of each camera whose intrinsics are free.
        loss_px: Scale of a Cauchy loss [px], by which the observations are weighted.
        principal: Whether the principal points of these cameras are free, too.
        noise_px: Noise by image [px], of which errors are then multiples, and the scale of the loss one; None if all
            have one.
    """
    columns: dict[str, int] = {}
    size = POSE * len(model.T_cam_world)
    for camera, name in models.items():
        columns[camera], size = size, size + LENS_PARAMETERS[name] + (PRINCIPAL if principal else 0)
    matrix, right = np.zeros((size, size)), np.zeros(size)
    points, points_right = np.zeros((len(model.points), 3, 3)), np.zeros((len(model.points), 3))
    crossed, lengths = [], []
    for k, image in enumerate(model.T_cam_world):
        camera = model.image_camera[image]
        pose, point, lens, residual = _jacobians(model, image, models.get(camera))
        own = np.arange(POSE * k, POSE * (k + 1))
        if camera in columns:
            if principal:
                lens = np.concatenate([lens, np.broadcast_to(np.eye(2), (len(lens), 2, PRINCIPAL))], 2)
            own = np.r_[own, columns[camera] + np.arange(lens.shape[2])]
        mine, seen = np.concatenate([pose, lens], 2), model.observations[image][1]
        lengths.append(np.linalg.norm(residual, axis=1))
        weight = _weights(lengths[-1], loss_px, 1.0 if noise_px is None else noise_px[image])
        matrix[np.ix_(own, own)] += np.einsum("o,oai,oaj->ij", weight, mine, mine)
        right[own] -= np.einsum("o,oai,oa->i", weight, mine, residual)
        np.add.at(points, seen, np.einsum("o,oai,oaj->oij", weight, point, point))
        np.add.at(points_right, seen, -np.einsum("o,oai,oa->oi", weight, point, residual))
        block = np.einsum("o,oai,oaj->ioj", weight, mine, point).reshape(len(own), -1)
        places = (3 * seen[:, None] + np.arange(3)).ravel()
        crossed.append((block.ravel(), np.repeat(own, len(places)), np.tile(places, len(own))))
    value, row, column = (np.concatenate(parts) for parts in zip(*crossed, strict=True))
    return NormalEquations(
        matrix=matrix,
        right=right,
        points=points,
        points_right=points_right,
        coupling=sparse.csr_array((value, (row, column)), shape=(size, 3 * len(points))),
        columns=columns,
        residuals_px=np.concatenate(lengths),
    )


def _weights(lengths_px: Array, loss: float, noise_px: float) -> Array:
    """Return the weights of observations with errors of these lengths under a Cauchy loss."""
    return 1.0 / (noise_px**2 + (lengths_px / loss) ** 2)


def told_by_points(
    model: SfmModel,
    models: Map[str, str],
    reduced: ReducedEquations,
    direction: Array,
    loss_px: float,
    noise_px: Map[str, float] | None = None,
) -> Array:
    """Return how much the observations of each point tell of a change of poses and intrinsics, shape (point,).

    They are the parts of d' N d, N the reduced matrix and d the change.

    Args:
        model: The model.
        models: As in `linearized`.
        reduced: Its reduced equations, with principal points.
        direction: The change, shape (n,).
        loss_px: As in `linearized`.
        noise_px: As there.
    """
    moves = (reduced.whole.coupling.T @ direction).reshape(-1, 3)
    told = -np.einsum("pi,pi->p", moves, np.asarray(reduced.inverse @ moves.ravel()).reshape(-1, 3))
    for k, image in enumerate(model.T_cam_world):
        camera = model.image_camera[image]
        pose, _, lens, residual = _jacobians(model, image, models.get(camera))
        change = pose @ direction[POSE * k : POSE * (k + 1)]
        if camera in models:
            at, free = reduced.whole.columns[camera], lens.shape[2]
            change += lens @ direction[at : at + free] + direction[at + free : at + free + PRINCIPAL]
        weight = _weights(np.linalg.norm(residual, axis=1), loss_px, 1.0 if noise_px is None else noise_px[image])
        np.add.at(told, model.observations[image][1], weight * (change**2).sum(1))
    return told


def all_errors_px(model: SfmModel) -> Array:
    """Return the reprojection errors of all observations [px], image by image, shape (observation,)."""
    return np.concatenate([model.errors_px(image) for image in model.T_cam_world])


def moved_lens(camera: SfmCamera, lens: str, step: Array) -> SfmCamera:
    """Return a camera after a step of the free numbers that its camera model has."""
    focals = focal_numbers(lens)
    distortion = np.array(camera.distortion)
    distortion[: len(step) - focals] += step[focals:]
    k1, k2, p1, p2 = (float(value) for value in distortion)
    fx, fy = camera.fx + float(step[0]), camera.fy + float(step[focals - 1])
    return replace(camera, fx=fx, fy=fy, distortion=(k1, k2, p1, p2))


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
    if focal_numbers(lens) == 2:
        focals = [np.stack([bent[:, 0], zero], 1), np.stack([zero, bent[:, 1]], 1)]
    lenses = [
        slopes * r2[:, None],
        slopes * r2[:, None] ** 2,
        np.stack([2 * x * y, r2 + 2 * y**2], 1),
        np.stack([r2 + 2 * x**2, 2 * x * y], 1),
    ]
    return [*focals, *(focal * column for column in lenses[: LENS_PARAMETERS[lens] - len(focals)])]
