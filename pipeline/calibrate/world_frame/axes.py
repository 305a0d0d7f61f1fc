"""World frame for cameras without a reference to the world: from the dominant plane, or from how photos are held."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..reconstruction import Array, SfmModel, Similarity

_TRIALS = 500
_THICKNESS = 0.005
"""Half thickness of the plane, as a fraction of the median distance between camera and point."""
_MIN_SHARE = 0.1
"""Minimum share of the sparse points on the plane."""
_MAX_BELOW = 0.05
"""Maximum share of the sparse points below the plane."""
_LEAST_SPREAD = 0.02
"""Least spread of the second of the three axes of the photos' rows of pixels: those of a walk straight on are parallel,
and do not tell by how much cameras look down."""
_LEAST_UPRIGHT = 0.5
"""Least length of the mean of the cameras' up directions: photos on their side or from below and above cancel it."""
Sides = tuple[tuple[float, float], tuple[float, float]]
"""Where a photo's right and its lower side, as viewers show it, are in its file: steps along columns and rows."""
_AS_THE_FILE: Sides = ((1.0, 0.0), (0.0, 1.0))


def ground_frame(model: SfmModel, normal_world: Array, seed: int = 0) -> Similarity | None:
    """Return the rigid motion that aligns the dominant plane with the ground, with the cameras above it.

    The origin is the point of the plane below the focus of the cameras; x is along the first camera's right.

    Args:
        model: The model, in any frame.
        normal_world: The ground's unit normal in the world frame, shape (3,).
        seed: Seed of the search.

    Returns:
        The transform, of scale 1, or None if no plane has a tenth of the points on it and nearly none below it.
    """
    plane = dominant_plane(model.points, model.centers(), _view_distance(model), seed)
    if plane is None:
        return None
    normal, offset = plane
    first = next(iter(model.T_cam_world.values()))
    target = _basis(normal_world, np.array([1.0, 0.0, 0.0]))
    rotation = target @ _basis(normal, first[0, :3]).T
    focus = _focus(model)
    origin = focus - (normal @ focus - offset) * normal
    return Similarity(1.0, rotation, -rotation @ origin)


def upright_frame(model: SfmModel, up_world: Array, sides: Mapping[str, Sides]) -> Similarity | None:
    """Return the rotation that puts the cameras upright: rows of pixels, which people hold level, become horizontal.

    A camera may look down or up without turning this direction, in which the cameras' rows have least extent. Of
    cameras whose rows are parallel it is the mean of their up directions. It is a guess that suits a view, not a
    measurement.

    Args:
        model: The model, in any frame.
        up_world: The vertical of the world frame, unit vector, shape (3,).
        sides: How photos are turned that are not shown as their file has them.

    Returns:
        The transform, of scale 1 about the origin, or None if the photos were taken at all angles.
    """
    shown = [np.array(sides.get(name, _AS_THE_FILE)) @ pose[:2, :3] for name, pose in model.T_cam_world.items()]
    rows, mean = np.array([right for right, _ in shown]), -np.mean([down for _, down in shown], axis=0)
    if np.linalg.norm(mean) < _LEAST_UPRIGHT:
        return None
    up = mean / np.linalg.norm(mean)
    spread, axes = np.linalg.eigh(rows.T @ rows / len(rows))
    level = axes[:, 0] * np.sign(axes[:, 0] @ up)
    if spread[1] > _LEAST_SPREAD and level @ up > _LEAST_UPRIGHT:
        up = level
    return Similarity(1.0, _basis(up_world, np.array([1.0, 0.0, 0.0])) @ _basis(up, rows[0]).T, np.zeros(3))


def dominant_plane(points: Array, centers: Array, distance: float, seed: int = 0) -> tuple[Array, float] | None:
    """Return the plane with most points that has all cameras and nearly all other points above it.

    Args:
        points: Sparse points, shape (point, 3).
        centers: Optical centres, shape (camera, 3).
        distance: Typical distance between a camera and a point, which sets the plane's thickness.
        seed: Seed of the search.

    Returns:
        Upward unit normal (3,) and offset, so that normal . p = offset on the plane; or None.
    """
    if len(points) < 3:
        return None
    rng = np.random.default_rng(seed)
    best, best_count = None, _MIN_SHARE * len(points)
    for _ in range(_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        plane = _oriented(np.cross(b - a, c - a), a, centers)
        if plane is None:
            continue
        count = _support(points, plane, _THICKNESS * distance)
        if count > best_count:
            best, best_count = plane, count
    return _refined(points, centers, best, _THICKNESS * distance) if best is not None else None


def _support(points: Array, plane: tuple[Array, float], thickness: float) -> int:
    height = points @ plane[0] - plane[1]
    below = np.mean(height < -3.0 * thickness)
    return int(np.sum(np.abs(height) < thickness)) if below <= _MAX_BELOW else 0


def _refined(points: Array, centers: Array, plane: tuple[Array, float], thickness: float) -> tuple[Array, float] | None:
    for _ in range(5):
        near = points[np.abs(points @ plane[0] - plane[1]) < thickness]
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        plane = _oriented(normal, middle, centers) or plane
    return plane


def _oriented(normal: Array, point: Array, centers: Array) -> tuple[Array, float] | None:
    """Return the plane with its normal towards the cameras, or None if they are on both sides."""
    length = np.linalg.norm(normal)
    if length == 0.0:
        return None
    normal = normal / length
    side = (centers - point) @ normal
    if not (np.all(side > 0) or np.all(side < 0)):
        return None
    normal = normal * np.sign(side[0])
    return normal, float(normal @ point)


def _basis(normal: Array, forward: Array) -> Array:
    """Return a right-handed basis (columns x, y, z) with z along `normal` and x near `forward`."""
    x = forward - (forward @ normal) * normal
    if np.linalg.norm(x) < 1e-6:
        x = np.eye(3)[np.argmin(np.abs(normal))]
        x = x - (x @ normal) * normal
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(normal, x), normal])


def _focus(model: SfmModel) -> Array:
    """Return the point nearest to all optical axes, shape (3,); the median of the points for parallel axes."""
    axes = np.array([pose[2, :3] for pose in model.T_cam_world.values()])
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix = projectors.sum(axis=0)
    if np.linalg.cond(matrix) > 1e4:
        return np.median(model.points, axis=0)
    return np.linalg.solve(matrix, np.einsum("vij,vj->i", projectors, model.centers()))


def _view_distance(model: SfmModel) -> float:
    distances = [
        np.linalg.norm(model.points[index] - model.center(image), axis=1)
        for image, (_, index) in model.observations.items()
    ]
    return float(np.median(np.concatenate(distances)))
