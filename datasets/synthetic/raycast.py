"""Renderer without OpenGL: MuJoCo's ray casting, procedural textures, one lamp with shadows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture.cameras import Camera
from .dynamics import BODY_GROUP, MjModel, mujoco
from .textures import Sheet

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Window = tuple[int, int, int, int]
"""First row, first column, end row and end column [px] of a part of an image."""
_SIDES = np.array([1.0, 0.731, 0.417])  # a generic direction: two sides of an object have different components along it
_GRAZING = 0.05  # below this cosine the lamp contributes almost nothing on a smooth surface, in shadow or not


class Material(Protocol):
    """The colour of a surface, in the frame of its body."""

    def albedo(self, points: Floats, normals: Floats, footprint: Floats) -> Floats:
        """Return colours in [0, 1], shape (point, 3).

        Args:
            points: On the surface, body frame [m], shape (point, 3).
            normals: Outward unit normals, body frame, shape (point, 3).
            footprint: Width that one ray covers on the surface [m], shape (point,).
        """
        ...


@dataclass(frozen=True)
class Plain:
    """A uniform colour."""

    color: tuple[float, float, float]

    def albedo(self, points: Floats, normals: Floats, footprint: Floats) -> Floats:
        """See `Material`."""
        return np.tile(np.asarray(self.color, np.float32), (len(points), 1))


@dataclass(frozen=True)
class Printed:
    """A sheet in the xy plane of the body frame."""

    sheet: Sheet

    def albedo(self, points: Floats, normals: Floats, footprint: Floats) -> Floats:
        """See `Material`."""
        return self.sheet.sample(points[:, :2], footprint)


@dataclass(frozen=True)
class Faceted:
    """A printed sheet for each facet direction of a polyhedron, projected along that direction.

    Args:
        normals: Outward unit normals of the facets, body frame, shape (facet, 3).
        sheets: One for each facet.
    """

    normals: Array
    sheets: tuple[Sheet, ...]

    @cached_property
    def _bases(self) -> Floats:
        """Axes u and v of the sheets, body frame, shape (facet, 3, 2)."""
        away = np.eye(3)[np.abs(self.normals).argmin(axis=1)]
        first = np.cross(self.normals, away)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(self.normals, first)], axis=2).astype(np.float32)

    def albedo(self, points: Floats, normals: Floats, footprint: Floats) -> Floats:
        """See `Material`."""
        facet = (normals @ self.normals.T.astype(np.float32)).argmax(axis=1)
        colours = np.empty((len(points), 3), np.float32)
        for index in np.unique(facet):
            chosen = facet == index
            colours[chosen] = self.sheets[index].sample(points[chosen] @ self._bases[index], footprint[chosen])
        return colours


@dataclass(frozen=True)
class Lamp:
    """A distant lamp and ambient light.

    Args:
        position: World [m], shape (3,); so distant that its light is nearly parallel.
        diffuse: Brightness of a white surface that faces it [1].
        ambient: Brightness of a white surface that faces up, in the shadow [1].
        underneath: The same for a surface that faces down [1].
    """

    position: Array
    diffuse: float = 0.42
    ambient: float = 0.60
    underneath: float = 0.42


@dataclass(frozen=True)
class Hits:
    """First hit of each ray, in the order of the rays.

    Args:
        geom: MuJoCo's geometry id, -1 for none, shape (ray,).
        distance: Along the unit ray [m], -1 for none, shape (ray,).
        normal: Outward unit normals, world frame, shape (ray, 3).
    """

    geom: NDArray[np.int32]
    distance: Array
    normal: Array


@dataclass(frozen=True)
class Rendering:
    """An image, or a window of one.

    Args:
        color: Ideal colours, [0, 1] where well exposed, shape (height, width, 3).
        label: Label of the surface at each pixel's centre, uint8 (height, width).
        depth: Depth along the optical axis at each pixel's centre [m], 0 without a hit, shape (height, width).
    """

    color: Floats
    label: NDArray[np.uint8]
    depth: Floats


class Raycaster:
    """Renders the bodies of a MuJoCo model at the poses of its data.

    Args:
        model: Geometries in group 0 (the ground) and BODY_GROUP (what moves).
        materials: Materials by geometry id.
        labels: Value in the masks by geometry id; absent: background.
        lamp: The light.
        backdrop: Colour where rays hit nothing, in [0, 1].
        smooth: Geometry ids that together are one smooth surface of one body and one material: its facets and
            parts are not distinguished.
    """

    def __init__(
        self,
        model: MjModel,
        materials: Mapping[int, Material],
        labels: Mapping[int, int],
        lamp: Lamp,
        backdrop: tuple[float, float, float],
        smooth: Iterable[int] = (),
    ) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.materials, self.lamp = dict(materials), lamp
        self.backdrop = np.asarray(backdrop, np.float32)
        one = list(smooth)
        self.smooth = min(one, default=-2)
        self._surface_of = np.arange(model.ngeom + 1, dtype=np.int32)
        self._surface_of[one] = self.smooth
        self._surface_of[-1] = -1
        # The last entry is for geometry -1.
        self.label_of = np.array([labels.get(geom, 0) for geom in range(model.ngeom)] + [0], np.uint8)

    def apart(self) -> Raycaster:
        """Return a renderer of the same bodies that can be placed elsewhere, by another thread."""
        other = copy(self)
        other.data = mujoco.MjData(self.model)
        return other

    def place(self, qpos: Array) -> None:
        """Put the bodies at MuJoCo positions `qpos`, shape (nq,)."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def cast(self, origin: Array, directions: Array, bodies_only: bool = False) -> Hits:
        """Cast rays from one point.

        Args:
            origin: World [m], shape (3,).
            directions: Unit vectors, world, shape (ray, 3).
            bodies_only: Whether to ignore the ground.
        """
        count = len(directions)
        geom, distance, normal = np.empty(count, np.int32), np.empty(count), np.empty((count, 3))
        groups = np.zeros(6, np.uint8)
        groups[BODY_GROUP], groups[0] = 1, not bodies_only
        mujoco.mj_multiRay(
            self.model, self.data, np.ascontiguousarray(origin, float), directions.ravel(), groups, 1, -1,
            geom, distance, normal.reshape(-1), count, mujoco.mjMAXVAL,
        )  # fmt: skip
        return Hits(geom, distance, normal)

    def render(self, camera: Camera, window: Window | None = None, samples: int = 3) -> Rendering:
        """Render an image, or a window of it.

        One ray is cast through each pixel's centre. If surface, side or shadow differ between neighbouring pixels,
        samples x samples rays are averaged instead (textures are already band-limited within a surface).
        """
        top, left, bottom, right = window or whole(camera)
        shape = (bottom - top, right - left)
        x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
        centres = np.asarray(np.stack([x, y], axis=-1), np.float64).reshape(-1, 2)
        directions, axial = rays_through(camera, centres)
        hits = self.cast(camera.T_world_cam[:3, 3], directions)
        colours, code = self._shade(camera, directions, hits)
        edge = np.flatnonzero(_changes(code.reshape(shape)))
        if len(edge):
            steps = (np.arange(samples) + 0.5) / samples - 0.5
            offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
            spread: Array = np.asarray(centres[edge, None] + offsets, np.float64).reshape(-1, 2)
            fine, _ = rays_through(camera, spread)
            drawn, _ = self._shade(camera, fine, self.cast(camera.T_world_cam[:3, 3], fine))
            colours[edge] = drawn.reshape(len(edge), -1, 3).mean(axis=1)
        depth = np.where(hits.geom >= 0, hits.distance * axial, 0).astype(np.float32)
        return Rendering(colours.reshape(*shape, 3), self.label_of[hits.geom].reshape(shape), depth.reshape(shape))

    def _shade(self, camera: Camera, directions: Array, hits: Hits) -> tuple[Floats, Floats]:
        """Return colours (ray, 3), and an id for each combination of surface, side and shadow (ray,)."""
        origin, angle = camera.T_world_cam[:3, 3], 1 / camera.K[0, 0]
        colours = np.tile(self.backdrop, (len(directions), 1))
        code = np.full(len(directions), -1, np.float32)
        surfaces = self._surface_of[hits.geom]
        for geom in np.flatnonzero(np.bincount(surfaces + 1)) - 1:
            if geom < 0:
                continue
            chosen = np.flatnonzero(surfaces == geom)
            distance, ray, normals = hits.distance[chosen], directions[chosen], hits.normal[chosen]
            points = origin + distance[:, None] * ray
            # A slanted surface stretches the footprint in one direction; the root is the geometric mean of both widths.
            slant = np.abs(np.einsum("ij,ij->i", ray, normals)).clip(0.06)
            footprint = (distance * angle / np.sqrt(slant)).astype(np.float32)
            body = self.model.geom_bodyid[geom]
            turn = self.data.xmat[body].reshape(3, 3)
            local = ((points - self.data.xpos[body]) @ turn).astype(np.float32)
            facing = (normals @ turn).astype(np.float32)
            albedo = self.materials[int(geom)].albedo(local, facing, footprint)
            smooth = geom == self.smooth
            light, lit = self._light(points, normals, facing_only=smooth)
            colours[chosen] = albedo * light[:, None]
            code[chosen] = 10 * geom + (0 if smooth else normals @ _SIDES) + 5 * lit
        return colours, code

    def _light(self, points: Array, normals: Array, facing_only: bool) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the brightness of a white surface by Lambert's law, and whether the lamp reaches it, each (point,).

        With `facing_only`, no ray is cast for points that face away from the lamp; they count as reached.
        """
        lamp = self.lamp
        ray = points - lamp.position
        distance = np.linalg.norm(ray, axis=1)
        ray /= distance[:, None]
        cosine = -np.einsum("ij,ij->i", ray, normals).clip(-1, 0)
        asked = cosine > _GRAZING if facing_only else np.ones(len(points), bool)
        lit = np.ones(len(points), bool)
        first = self.cast(lamp.position, ray[asked], bodies_only=True).distance
        lit[asked] = (first < 0) | (first > distance[asked] - 2e-4)
        room = lamp.underneath + (lamp.ambient - lamp.underneath) * (normals[:, 2] + 1) / 2
        return (room + lamp.diffuse * cosine * lit).astype(np.float32), lit


def _changes(code: Floats) -> NDArray[np.bool_]:
    """Return a mask of the pixels (height, width) that differ from one of their four neighbours."""
    edge = np.zeros(code.shape, bool)
    down, right = np.abs(np.diff(code, axis=0)) > 1e-4, np.abs(np.diff(code, axis=1)) > 1e-4
    edge[1:] |= down
    edge[:-1] |= down
    edge[:, 1:] |= right
    edge[:, :-1] |= right
    return edge


def whole(camera: Camera) -> Window:
    """Return the window that covers the whole image."""
    return 0, 0, camera.height, camera.width


def rays_through(camera: Camera, pixels: Array) -> tuple[Array, Array]:
    """Return the rays through image points.

    Args:
        camera: With or without distortion.
        pixels: Image points (x, y) [px], shape (ray, 2); the top-left pixel's centre is (0.5, 0.5).

    Returns:
        Unit directions, world frame, shape (ray, 3), and their cosines with the optical axis, shape (ray,).
    """
    K = camera.K
    if np.any(camera.distortion):
        plane = cv2.undistortPoints(pixels[:, None], K, np.asarray(camera.distortion, float)).reshape(-1, 2)
    else:
        plane = (pixels - K[:2, 2]) / np.diag(K)[:2]
    axial = 1 / np.sqrt((plane * plane).sum(axis=1) + 1)
    local = np.concatenate([plane, np.ones((len(plane), 1))], axis=1) * axial[:, None]
    return local @ camera.T_world_cam[:3, :3].T, axial


def window_around(camera: Camera, points: Array, margin: int = 2) -> Window | None:
    """Return the smallest window that contains the convex hull of world points (point, 3); None if it is out of view.

    Where a point lies behind the camera, or the lens distorts, the window is the whole image.
    """
    local = (points - camera.T_world_cam[:3, 3]) @ camera.T_world_cam[:3, :3]
    if local[:, 2].min() < 1e-3 or np.any(camera.distortion):
        return whole(camera)
    pixel = (local @ camera.K.T)[:, :2] / local[:, 2:]
    low = np.floor(pixel.min(axis=0)).astype(int) - margin
    high = np.ceil(pixel.max(axis=0)).astype(int) + margin
    column, end_column = max(low[0], 0), min(high[0], camera.width)
    row, end_row = max(low[1], 0), min(high[1], camera.height)
    if column >= end_column or row >= end_row:
        return None
    return int(row), int(column), int(end_row), int(end_column)
