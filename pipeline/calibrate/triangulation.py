"""Robust triangulation of a point from its images in many registered photos, with its covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..geometry.sight_rays import least_squares_point, nearest_points, projection_jacobian, reprojection
from .reconstruction import Array, SfmModel

MAX_ERROR_PX = 4.0
"""Maximum reprojection error of an inlier [px], the bound of COLMAP's filter."""
_MAX_PAIRS = 300
_SELECTIONS = 10
"""Maximum number of choices of the views that agree."""
_PARALLEL = 1e-4
"""Minimum angle between the two rays of a hypothesis [rad]."""


@dataclass(frozen=True)
class TriangulatedPoint:
    """A triangulated point."""

    position: Array
    """Position [model unit], model frame, shape (3,)."""
    covariance: Array
    """Covariance from the measurement noise alone, with exact cameras [model unit squared], shape (3, 3)."""
    images: tuple[str, ...]
    """Names of the images that agree."""
    rms_px: float
    """Root mean square reprojection error in those images [px]."""


def triangulate(
    model: SfmModel, sightings: Mapping[str, tuple[float, float]], noise_px: float
) -> TriangulatedPoint | None:
    """Triangulate one point robustly.

    Each pair of views (at most 300, evenly chosen) gives a hypothesis, the midpoint of its rays. The one with most
    agreeing views is replaced by the least-squares point of these views.

    Args:
        model: The registered cameras.
        sightings: Pixel of the point by image name; unregistered images are ignored.
        noise_px: Standard deviation of a pixel coordinate [px], a lower bound of the residual noise.

    Returns:
        The point, or None if no two views agree on a point in front of them.
    """
    images = [name for name in sightings if name in model.T_cam_world]
    if len(images) < 2:
        return None
    pixels = np.array([sightings[name] for name in images], dtype=float)
    poses = np.array([model.T_cam_world[name] for name in images])
    cameras = [model.camera(name) for name in images]
    rays = np.array([camera.rays(xy[None])[0] for camera, xy in zip(cameras, pixels, strict=True)])
    focal = np.array([camera.focal_px for camera in cameras])
    point = _best_hypothesis(poses, rays, focal)
    if point is None:
        return None
    refined = _refined(point, poses, rays, focal)
    if refined is None:
        return None
    point, good = refined
    residual, jacobian = reprojection(point, poses[good], rays[good], focal[good])
    rms = float(np.sqrt(np.mean(residual**2) * 2.0))
    freedom = max(len(residual) - 3, 1)
    variance = max(float(residual @ residual) / freedom, noise_px**2)
    covariance = np.asarray(variance * np.linalg.pinv(jacobian.T @ jacobian), np.float64)
    return TriangulatedPoint(point, covariance, tuple(name for name, ok in zip(images, good, strict=True) if ok), rms)


def center_std(model: SfmModel, image: str, direction: Array, noise_px: float) -> float:
    """Return the standard deviation of an optical centre along a direction, by resection on the sparse points.

    The points are assumed exact, so this is a lower bound; derived from the normal equations of the pose.

    Args:
        model: The model.
        image: A registered image.
        direction: Unit vector, model frame, shape (3,).
        noise_px: Standard deviation of a pixel coordinate [px].

    Returns:
        Standard deviation [model unit].
    """
    pose = model.T_cam_world[image]
    points = model.points[model.observations[image][1]]
    local = points @ pose[:3, :3].T + pose[:3, 3]
    projection = projection_jacobian(local) * model.camera(image).focal_px
    # x_cam = R (p - c): moving the centre shifts it by -R dc, turning the camera by w shifts it by w x x_cam.
    turn = -cross_matrices(local)
    jacobian = np.concatenate([projection @ -pose[:3, :3], projection @ turn], axis=2).reshape(-1, 6)
    covariance = noise_px**2 * np.linalg.pinv(jacobian.T @ jacobian)[:3, :3]
    return float(np.sqrt(direction @ covariance @ direction))


def _best_hypothesis(poses: Array, rays: Array, focal: Array) -> Array | None:
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    homogeneous = np.column_stack([rays, np.ones(len(rays))])
    directions = np.einsum("vji,vj->vi", poses[:, :3, :3], homogeneous)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pairs = np.array(list(combinations(range(len(rays)), 2)))
    pairs = pairs[:: max(1, -(-len(pairs) // _MAX_PAIRS))]
    points = _midpoints(centers[pairs], directions[pairs])
    if len(points) == 0:
        return None
    errors = _errors(points, poses, rays, focal)
    agreeing = (errors < MAX_ERROR_PX).sum(axis=1)
    cost = np.minimum(errors, MAX_ERROR_PX).sum(axis=1)
    best = np.lexsort((cost, -agreeing))[0]
    return points[best] if agreeing[best] >= 2 else None


def _refined(point: Array, poses: Array, rays: Array, focal: Array) -> tuple[Array, NDArray[np.bool_]] | None:
    """Replace a point by the least-squares point of the views that agree with it, until these stay the same.

    Returns:
        The point and the views that agree, shape (view,); None if fewer than two do.
    """
    good = _errors(point, poses, rays, focal) < MAX_ERROR_PX
    for _ in range(_SELECTIONS):
        point = least_squares_point(point, poses[good], rays[good], focal[good])
        before, good = good, _errors(point, poses, rays, focal) < MAX_ERROR_PX
        if good.sum() < 2:
            return None
        if np.array_equal(good, before):
            break
    return point, good


def _midpoints(centers: Array, directions: Array) -> Array:
    """Return the points nearest to each pair of lines, shape (pair, 3), without pairs of parallel lines.

    Args:
        centers: A point on each line, shape (pair, 2, 3).
        directions: Unit directions, shape (pair, 2, 3).
    """
    crossing = np.linalg.norm(np.cross(directions[:, 0], directions[:, 1]), axis=1) > _PARALLEL
    centers, directions = centers[crossing], directions[crossing]
    return nearest_points(centers, directions)


def _errors(points: Array, poses: Array, rays: Array, focal: Array) -> Array:
    """Return reprojection errors [px], shape (..., view), of points (..., 3); infinite behind a camera."""
    local = np.einsum("vij,...j->...vi", poses[:, :3, :3], points) + poses[:, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.linalg.norm(local[..., :2] / local[..., 2:] - rays, axis=-1) * focal
    return np.where(local[..., 2] > 0, errors, np.inf)


def cross_matrices(vectors: Array) -> NDArray[np.float64]:
    """Return the matrices that multiply by vectors (point, 3) from the left, shape (point, 3, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(z)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
