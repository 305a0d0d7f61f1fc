"""Distance of predicted from filmed bodies by the centroids of their masks alone: neither poses nor colours are used.

The centroid of a silhouette is not the image of a point of the body, but the centroids of the mask and of the predicted
silhouette are made in the same way: each set of centroids is triangulated from the calibrated cameras, and the two
points are compared. What the cameras disagree about bounds how exact the centroids are from below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.cameras import Camera
from ..geometry.sight_rays import least_squares_point, nearest_points, reprojection
from ..optimization.uncertainty import size_interval

Array = NDArray[np.float64]

SAME_INSTANT_S = 1e-6
"""Maximum difference of the times of frames at one instant [s]."""
MIN_CAMERAS = 2
_STEPS = 3
"""Number of linear systems to a point: each takes the depths of the one before."""
LEAST_STD = 2.2e-3
"""Minimum standard deviation of a centroid, as a share of the picture's width (0.7 px of 320): the middle of a
silhouette moves against the centre of mass when a body turns, which two cameras do not show as a disagreement. On the
15 episodes of `filmed_poses.SHARED_PX` the distance differs from that of the centres of mass by 1.0 mm (root mean
square), 2.8 times what the cameras' disagreement says; it is worst where the prediction is turned by 20 deg or more."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sighting:
    """What one camera shows of one episode: centroids of the nf free bodies in F frames."""

    time_s: Array
    """Times of the frames [s], shape (F,)."""
    cameras: Sequence[Camera]
    """Camera of each frame, without distortion."""
    real: Array
    """Centroids (x, y) of the masks [px], NaN where unknown, shape (F, nf, 2)."""
    predicted: Array
    """Centroids of the predicted silhouettes, the same."""


@dataclass(frozen=True)
class CentroidDistance:
    """Distance between predicted and filmed centroids, over the instants at which two cameras or more show both."""

    mean_m: float
    """Mean distance [m]."""
    final_m: float
    """Distance at the last of these instants [m]."""
    interval_95_m: tuple[float, float]
    """95 % interval of the mean [m], for errors of the centroids that last as long as the episode."""
    instants: int


def centroid_distance(sightings: Sequence[Sighting]) -> CentroidDistance | None:
    """Return the distance by triangulated centroids; None if no instant is shown by two cameras."""
    pairs = [pair for k, rows in enumerate(_instants(sightings)) for pair in _both(sightings, k, rows)]
    if not pairs:
        return None
    squares = sum(pair.square for pair in pairs)
    freedoms = sum(pair.freedoms for pair in pairs)
    std_px = max(float(np.sqrt(squares / freedoms)), LEAST_STD * sightings[0].cameras[0].width)
    distances = np.array([float(np.linalg.norm(pair.shift_m)) for pair in pairs])
    std_m = std_px * float(np.mean([_std_along(pair) for pair in pairs]))
    mean = float(distances.mean())
    instants = len({pair.instant for pair in pairs})
    return CentroidDistance(mean, float(distances[-1]), size_interval(mean, std_m), instants)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Predicted and filmed centroid of one body at one instant."""

    instant: int
    shift_m: Array
    """From the filmed to the predicted point [m], shape (3,)."""
    covariance: Array
    """Of the shift, for a standard deviation of 1 px of either coordinate of a centroid, shape (3, 3)."""
    square: float
    """Sum of squares of what the cameras disagree about [px2], for predicted minus filmed centroids."""
    freedoms: int
    """Number of coordinates above those of a point."""


def _std_along(pair: _Pair) -> float:
    """Return the standard deviation along the shift [m for 1 px]; of the mean direction where there is no shift."""
    length = float(np.linalg.norm(pair.shift_m))
    if length < 1e-9:
        return float(np.sqrt(np.trace(pair.covariance) / 3))
    along = pair.shift_m / length
    return float(np.sqrt(along @ pair.covariance @ along))


def _instants(sightings: Sequence[Sighting]) -> list[list[tuple[int, int]]]:
    """Return (camera, frame) of the frames of each instant that several cameras show."""
    frames = [(float(t), c, k) for c, seen in enumerate(sightings) for k, t in enumerate(seen.time_s)]
    groups: list[list[tuple[float, int, int]]] = []
    for frame in sorted(frames):
        if groups and frame[0] - groups[-1][0][0] <= SAME_INSTANT_S:
            groups[-1].append(frame)
        else:
            groups.append([frame])
    return [[(c, k) for _, c, k in group] for group in groups if len(group) >= MIN_CAMERAS]


def _both(sightings: Sequence[Sighting], instant: int, rows: list[tuple[int, int]]) -> list[_Pair]:
    """Return the pair of each body that two cameras or more show at an instant, by mask and by prediction."""
    found = []
    for body in range(sightings[0].real.shape[1]):
        seen = [
            (sightings[c].cameras[k], sightings[c].real[k, body], sightings[c].predicted[k, body])
            for c, k in rows
            if np.isfinite(sightings[c].real[k, body]).all() and np.isfinite(sightings[c].predicted[k, body]).all()
        ]
        if len(seen) >= MIN_CAMERAS:
            found.append(_pair(instant, seen))
    return found


def _pair(instant: int, seen: Sequence[tuple[Camera, Array, Array]]) -> _Pair:
    cameras = [camera for camera, _, _ in seen]
    points, found = [], []
    for kind in (1, 2):
        pixels = np.array([one[kind] for one in seen])
        points.append(triangulated(cameras, pixels))
        found.append(reprojection(points[-1], *_sight(cameras, pixels)))
    (real, slope), (predicted, _) = found
    covariance = np.asarray(np.linalg.inv(slope.T @ slope), np.float64)
    apart = predicted - real
    return _Pair(instant, points[1] - points[0], covariance, float(apart @ apart), 2 * len(cameras) - 3)


def triangulated(cameras: Sequence[Camera], pixels: Array) -> Array:
    """Return the point whose images are nearest to pixels.

    Args:
        cameras: Cameras without distortion.
        pixels: (x, y) in each of them, shape (cameras, 2).

    Returns:
        The point [m], world, shape (3,).
    """
    poses, rays, focal = _sight(cameras, pixels)
    directions = np.einsum("vji,vj->vi", poses[:, :3, :3], np.column_stack([rays, np.ones(len(rays))]))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    point = nearest_points(np.stack([camera.center for camera in cameras]), directions)
    for _ in range(_STEPS):
        point = least_squares_point(point, poses, rays, focal)
    return point


def _sight(cameras: Sequence[Camera], pixels: Array) -> tuple[Array, Array, Array]:
    """Return poses T_cam_world (v, 4, 4), rays (v, 2) through pixels (v, 2), and focal lengths (v, 2) [px]."""
    intrinsics = np.stack([camera.K for camera in cameras])
    focal = np.stack([intrinsics[:, 0, 0], intrinsics[:, 1, 1]], 1)
    return np.stack([camera.T_cam_world for camera in cameras]), (pixels - intrinsics[:, :2, 2]) / focal, focal
