"""The measured motion of one body in one episode, and its distance from a plane, whatever their units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...schemas import Body, InputDataError
from ..shapes.interpolation import by_column
from ..shapes.meshes import read_mesh
from ..shapes.ply import read_splats
from ..shapes.turns import matrix_of
from .folder import CaptureFolder
from .motion_windows import MotionWindows, motion_windows
from .tracks import Track
from .unit_mistakes import Order

Array = NDArray[np.float64]

MOST_MOTIONS = 40
"""Number of tracks that are looked at; they are spread evenly over the episodes."""
MOST_PRODUCTS = 2_000_000
"""Frames times points of a shape for which the lowest point is computed; more frames are interpolated."""
RADIUS_FACTOR = 2.0
"""Radius of a sphere of a shape in units of its Gaussian scale."""


@dataclass(frozen=True, eq=False)
class Outline:
    """Points with radii whose convex hull is a shape, body frame."""

    points: Array
    """Centres [m], shape (P, 3)."""
    radii: Array
    """Radii [m], shape (P,)."""

    @property
    def size_m(self) -> float:
        """Largest distance of the shape from the origin of its frame [m]."""
        return float((np.linalg.norm(self.points, axis=1) + self.radii).max())


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedMotion:
    """The track of a free body in an episode."""

    episode: str
    """Name of the episode."""
    body: Body
    """The body, as in the manifest."""
    track: Track
    """Its poses."""
    windows: MotionWindows
    """Accelerations in windows of the track."""
    outline: Outline | None
    """The shape; None where the manifest has none, or where it needs an orientation that the track lacks."""
    others: tuple[tuple[Array, float], ...] = ()
    """Positions of the other bodies at the times of the track, shape (T, 3), and their sizes (inf: not known)."""
    _lowest: dict[tuple[tuple[float, ...], Order], Array] = field(default_factory=dict)

    def lowest(self, normal: Array, order: Order) -> Array:
        """Return the smallest projection onto `normal` of the shape's points from the body's origin, shape (T,)."""
        key = (tuple(normal.tolist()), order)
        if key not in self._lowest:
            self._lowest[key] = self._lowest_of(normal, order)
        return self._lowest[key]

    def _lowest_of(self, normal: Array, order: Order) -> Array:
        if self.outline is None:
            return np.zeros(len(self.track))
        quat = self.track.quat_wxyz
        if quat is None or not self.outline.points.any():
            return np.full(len(self.track), float((self.outline.points @ normal - self.outline.radii).min()))
        step = max(1, len(quat) * len(self.outline.points) // MOST_PRODUCTS)
        some = np.unique(np.append(np.arange(0, len(quat), step), len(quat) - 1))
        down = normal @ _matrices(quat[some], order)
        found = (down @ self.outline.points.T - self.outline.radii).min(axis=1)
        return np.interp(np.arange(len(quat)), some, found)


def _matrices(quat_wxyz: Array, order: Order) -> Array:
    """Return rotation matrices (T, 3, 3), body to world, of a track's columns (T, 4) in an assumed order."""
    if order == "xyzw":
        return matrix_of(np.roll(quat_wxyz, 1, axis=1))
    turn = matrix_of(quat_wxyz)
    return turn.swapaxes(1, 2) if order == "inverse" else turn


def tracked_motions(capture: CaptureFolder) -> list[TrackedMotion]:
    """Return the motions of free bodies with at least five frames, of some of the episodes, without faulty files."""
    outlines = {body.name: outline_of(capture, body) for body in capture.manifest.bodies}
    episodes = capture.episodes()
    free = [body for body in capture.manifest.bodies if body.motion == "free"]
    count = max(1, MOST_MOTIONS // max(len(free), 1))
    chosen = np.unique(np.linspace(0, len(episodes) - 1, min(count, len(episodes))).round().astype(int))
    motions = []
    for name in (episodes[k] for k in chosen):
        tracks = _sound_tracks(capture, name)
        long = [body for body in free if body.name in tracks and len(tracks[body.name]) >= 5]
        motions += [_motion(capture, name, body, tracks, outlines) for body in long]
    return motions


def _sound_tracks(capture: CaptureFolder, episode: str) -> dict[str, Track]:
    try:
        return capture.tracks(episode)
    except InputDataError:
        return {}  # a fault of its own


def _motion(
    capture: CaptureFolder,
    episode: str,
    body: Body,
    tracks: dict[str, Track],
    outlines: dict[str, Outline | None],
) -> TrackedMotion:
    track, outline = tracks[body.name], outlines[body.name]
    if outline is not None and track.quat_wxyz is None and outline.points.any():
        outline = None
    others = tuple(
        _neighbour(other, tracks.get(other.name), outlines[other.name], track.time_s)
        for other in capture.manifest.bodies
        if other.name != body.name
    )
    windows = motion_windows(track)
    return TrackedMotion(episode=episode, body=body, track=track, windows=windows, outline=outline, others=others)


def _neighbour(body: Body, track: Track | None, outline: Outline | None, time_s: Array) -> tuple[Array, float]:
    """Return the positions of another body at times (T,), and its size [m]: infinite where either is not known."""
    place = _positions(body, track, time_s)
    if place is None:
        return np.zeros((len(time_s), 3)), np.inf
    return place, np.inf if outline is None else outline.size_m


def _positions(body: Body, track: Track | None, time_s: Array) -> Array | None:
    """Return the positions of a body at times (T,), or None where they are not known."""
    if track is not None:
        return by_column(time_s, track.time_s, track.position_m)
    if body.motion == "fixed" and body.photo_pose is not None:
        return np.tile(body.photo_pose.position_m, (len(time_s), 1))
    return None


def outline_of(capture: CaptureFolder, body: Body) -> Outline | None:
    """Return the outline of a body's shape; None without a shape, or with a file that cannot be read."""
    shape = body.shape
    if shape is None:
        return None
    if shape.sphere is not None:
        return Outline(np.zeros((1, 3)), np.array([shape.sphere.radius_m]))
    if shape.box is not None:
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return Outline(signs * np.array(shape.box.half_extents_m), np.zeros(8))
    try:
        return _outline_in_file(capture, body, shape.mesh is not None)
    except InputDataError:
        return None  # a fault of its own


def _outline_in_file(capture: CaptureFolder, body: Body, is_mesh: bool) -> Outline | None:
    path = capture.shape_file(body)
    if path is None:
        return None
    if is_mesh:
        corners = _hull(read_mesh(path).vertices)
        return Outline(corners, np.zeros(len(corners)))
    splats = read_splats(path)
    return Outline(np.asarray(splats.means, float), RADIUS_FACTOR * np.asarray(splats.scales, float))


def _hull(points: Array) -> Array:
    from scipy.spatial import ConvexHull, QhullError  # dear to import, and seldom needed

    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return points  # flat, or too few
