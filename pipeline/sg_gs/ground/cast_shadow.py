"""The shadow that bodies cast on the ground in the photos: found by its shape, and how much darker it is.

One lamp far away darkens the ground where a body is before it, by one factor for each colour channel. The direction of
the lamp is that whose shadow, of the bodies' hulls, separates the ground best into a dark and a bright part (Otsu's
criterion, 1979). It is taken if the same search with the bodies moved to other places of the ground finds nothing
nearly as dark: textures have dark places, too. The shadow itself is that of the bodies, in whose notches the ground is
lit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ...geometry.solid_grid import Array
from .ground_photo import CELLS, GroundPhoto

_AZIMUTHS, _ELEVATIONS_DEG = 36, np.arange(20.0, 86.0, 5.0)
_STEPS_DEG = (4.0, 2.0, 1.0)
"""Steps of the refinement of azimuth and elevation."""
_LEAST_CELLS = 30
"""Fewest cells of a shadow."""
_PLACES = 12
"""Other places at which the search is repeated."""
_STANDS_OUT = 2.0
"""Otsu's criterion of a shadow, of the largest that the search finds elsewhere."""
_DARKEST, _BRIGHTEST = 0.2, 0.9
"""Range of factors of a lamp in a room. What is brighter hardly shows, and a texture is often as dark in places."""
_TINT_STD = 0.05
"""Standard deviation of the logarithm of a channel's factor about the mean of the channels: shadows are nearly grey."""
_OUTLYING = 2.5

_FINER = 2
"""Parts of a cell, along and across, in which the shadows of spheres are drawn."""
_HALF_ALPHA = float(np.sqrt(2 * np.log(2)))
"""Distance from the middle of an opaque sphere at which its alpha is a half, in scales."""

Angles = tuple[float, float]
"""Azimuth and elevation of a lamp [deg], in the axes of the ground."""


@dataclass(frozen=True, kw_only=True)
class CastShadow:
    """A shadow on the ground."""

    to_lamp: Array
    """Unit vector to the lamp, world frame, shape (3,)."""
    factors: Array
    """Brightness in the shadow over that outside, by colour channel, shape (3,)."""
    cover: NDArray[np.float32]
    """Share of each cell of the ground that lies in it, shape (CELLS, CELLS)."""
    contrast: float
    """Its value of Otsu's criterion over the largest that the same search finds elsewhere."""


@dataclass(frozen=True, eq=False)
class Caster:
    """A body that casts a shadow: spheres on its surface."""

    means: Array
    """Their centres, world frame [m], shape (n, 3)."""
    scales: Array
    """Their scales [m], shape (n,)."""

    @cached_property
    def corners(self) -> Array:
        """Return the corners of the hull of points one scale from the centres [m], shape (m, 3)."""
        ways = np.concatenate([np.eye(3), -np.eye(3)])
        points = (self.means[:, None] + self.scales[:, None, None] * ways).reshape(-1, 3)
        return points[ConvexHull(points).vertices]


def find_shadow(photo: GroundPhoto, bodies: Sequence[Caster]) -> CastShadow | None:
    """Return the shadow of bodies on the ground, or None if none stands out."""
    usable = photo.seen
    if usable.sum() < 2 * _LEAST_CELLS:
        return None
    light = _light(photo, usable)
    hulls = [body.corners for body in bodies]
    criterion = _Criterion(photo, hulls, light, usable)
    angles = criterion.refined(criterion.coarse())
    cover = _cover(photo, bodies, angles)
    inside = (cover > 0.5) & usable
    if not _LEAST_CELLS <= inside.sum() < usable.sum() - _LEAST_CELLS:
        return None
    around = np.maximum(cover, _hull_cover(photo, hulls, angles))
    rest = usable & (cv2.dilate(around, np.ones((3, 3))) < 0.02)
    elsewhere = []
    for shift in _shifts(photo, hulls, cover):
        moved = _Criterion(photo, [points + shift for points in hulls], light, rest)
        elsewhere.append(moved.value(moved.coarse()))
    contrast = criterion.value(angles) / max([1e-9, *elsewhere])
    factors = _factors(photo, inside, rest)
    if contrast < _STANDS_OUT or not ((factors > _DARKEST) & (factors < _BRIGHTEST)).all():
        return None
    return CastShadow(to_lamp=_direction(photo, angles), factors=factors, cover=cover, contrast=contrast)


def _light(photo: GroundPhoto, usable: NDArray[np.bool_]) -> Array:
    """Return the logarithm of the brightness of each cell; prints and markers count as outliers."""
    light = np.log(np.maximum(photo.colors.mean(-1), 1e-3)).astype(np.float64)
    middle = float(np.median(light[usable]))
    spread = 1.4826 * float(np.median(np.abs(light[usable] - middle))) or 1e-3
    return np.clip(light, middle - _OUTLYING * spread, middle + _OUTLYING * spread)


class _Criterion:
    """Otsu's criterion of the shadow of bodies, by the direction of the lamp: the variance between dark and bright."""

    def __init__(self, photo: GroundPhoto, hulls: Sequence[Array], light: Array, usable: NDArray[np.bool_]) -> None:
        self._photo, self._hulls = photo, hulls
        self._weights = usable.astype(np.float32).ravel()
        self._values = ((light - light[usable].mean()) * usable).astype(np.float32).ravel()
        self._count = float(self._weights.sum())

    def value(self, angles: Angles) -> float:
        """Return the criterion; 0 where the shadow is brighter than the rest, or too small."""
        if not 5.0 <= angles[1] <= 89.0:
            return 0.0
        inside = _hull_cover(self._photo, self._hulls, angles).ravel()
        count, dark = float(inside @ self._weights), float(inside @ self._values)
        if not _LEAST_CELLS <= count <= self._count - _LEAST_CELLS or dark >= 0:
            return 0.0
        # the values have mean 0: the means of both parts are dark / count and -dark / (total - count)
        return dark**2 * self._count / (count * (self._count - count))

    def coarse(self) -> Angles:
        """Return the best direction of a coarse grid."""
        around = 360.0 * np.arange(_AZIMUTHS) / _AZIMUTHS
        return max(((float(a), float(e)) for a in around for e in _ELEVATIONS_DEG), key=self.value)

    def refined(self, best: Angles) -> Angles:
        """Return the best direction near one."""
        for step in _STEPS_DEG:
            near = [(best[0] + i * step, best[1] + j * step) for i in range(-2, 3) for j in range(-2, 3)]
            best = max(near, key=self.value)
        return best


def _factors(photo: GroundPhoto, inside: NDArray[np.bool_], outside: NDArray[np.bool_]) -> Array:
    """Return the brightness in the shadow by that outside for each channel, shape (3,).

    Textures of several colours scatter the channels; their differences shrink to the mean by the scatter of blocks of
    the ground.
    """
    colors = np.log(np.maximum(photo.colors.astype(float), 1e-3))
    ratio = np.median(colors[inside], axis=0) - np.median(colors[outside], axis=0)
    side = max(1, round(np.sqrt(inside.sum())))
    blocks = [
        np.median(colors[r : r + side, c : c + side][part], axis=0)
        for r in range(0, CELLS, side)
        for c in range(0, CELLS, side)
        if (part := outside[r : r + side, c : c + side]).mean() > 0.5
    ]
    tints = np.array([block - block.mean() for block in blocks])
    scatter = float(np.square(tints - tints.mean(0)).mean()) if len(tints) > 1 else np.inf
    weight = _TINT_STD**2 / (_TINT_STD**2 + scatter)
    return np.exp(ratio.mean() + weight * (ratio - ratio.mean()))


def _direction(photo: GroundPhoto, angles: Angles) -> Array:
    a, e = np.radians(angles)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]) @ photo.axes


def _hull_cover(photo: GroundPhoto, hulls: Sequence[Array], angles: Angles) -> NDArray[np.float32]:
    """Return the share of each cell in the shadow of hulls, each given by points (n, 3) [m]."""
    image = np.zeros((CELLS, CELLS), np.uint8)
    for points in hulls:
        hull = cv2.convexHull(_fallen(photo, points, angles).astype(np.float32))
        cv2.fillConvexPoly(image, np.round((hull - 0.5) * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
    return (image / np.float32(255)).astype(np.float32)


def _cover(photo: GroundPhoto, bodies: Sequence[Caster], angles: Angles) -> NDArray[np.float32]:
    """Return the share of each cell in the shadow of bodies: discs for their spheres, moved along the light."""
    fine = _FINER * CELLS
    image = np.zeros((fine, fine), np.uint8)
    for body in bodies:
        cells = np.floor(_FINER * _fallen(photo, body.means, angles)).astype(int)
        radii = np.round(_FINER * _HALF_ALPHA * body.scales / photo.cell).astype(int).clip(max=fine // 4)
        inside = ((cells >= 0) & (cells < fine)).all(1)
        for radius in np.unique(radii[inside]):
            part = np.zeros_like(image)
            chosen = cells[inside & (radii == radius)]
            part[chosen[:, 1], chosen[:, 0]] = 255
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(radius) + 1, 2 * int(radius) + 1))
            image = np.maximum(image, np.asarray(cv2.dilate(part, disc), np.uint8))
    closed = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((2 * _FINER + 1,) * 2, np.uint8))
    share = closed.astype(np.float32) / np.float32(255)
    return np.asarray(cv2.resize(share, (CELLS, CELLS), interpolation=cv2.INTER_AREA), np.float32)


def _fallen(photo: GroundPhoto, points: Array, angles: Angles) -> Array:
    """Return the cells (n, 2) on which the shadows of points (n, 3) [m] fall."""
    to_lamp = _direction(photo, angles)
    above = points @ photo.axes[2] - photo.height
    return photo.places(points - (above / (to_lamp @ photo.axes[2]))[:, None] * to_lamp)


def _shifts(photo: GroundPhoto, bodies: Sequence[Array], cover: NDArray[np.float32]) -> list[Array]:
    """Return shifts (3,) [m] of the bodies along the ground to places around, clear of the bodies and their shadow."""
    rows, columns = np.nonzero(cover > 0.5)
    cells = np.concatenate([photo.places(np.concatenate(bodies)), np.stack([columns, rows], 1)])
    reach = float(np.linalg.norm(np.ptp(cells, axis=0))) * photo.cell
    reach = min(reach, 0.35 * CELLS * photo.cell)  # within the grid
    angles = 2 * np.pi * np.arange(_PLACES) / _PLACES
    return [reach * (np.cos(a) * photo.axes[0] + np.sin(a) * photo.axes[1]) for a in angles]
