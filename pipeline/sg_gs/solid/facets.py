"""Facets: flat faces of a solid, found where photos agree on a plane better than on the uneven surface.

The surface of a visual hull bulges by millimetres in the middle of a flat face, and patches that photos move one by one
leave it uneven; a body would rock on such bumps, and tip over them instead of its edges. On a plane the photos agree
about thousands of patches at once, so its three numbers are known ten times as well as the place of a patch. Whether a
region is a plane is left to photos that did not see the fit: of two halves, each judges the plane of the other against
the surface as it is, and against a bent plane (a quadric), which curved faces fit better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.flat_solid import flattened
from ...geometry.solid_grid import Array, Volume
from ..photos.views import View
from .depth_refinement import agreement, smooth_normals, tangents
from .planar_regions import Regions, planar_regions

_POINTS = 300
"""Patches of a region that are compared."""
_REACH_PX, _STEPS = 5.5, 45
"""How far from the surface a plane is looked for [px], and in how many steps."""
_LEAST_SEEN, _LEAST_PAIRS = 0.5, 6
"""Least share of a region's patches that each half of the photos must see, in so many ordered pairs: three photos."""
_BEND_GAIN = 4e-3
"""Largest gain in correlation by bending the plane, on photos not fitted."""
_APART_PX = 0.5
"""Largest root mean square distance between the planes of both halves [px]."""
_FLAT_PITCHES = 0.1
"""Standard deviation of a region that is flat as it is, in units of the grid's pitch; such as one cut by the ground."""


@dataclass(frozen=True)
class Facet:
    """What the photos say of a region."""

    plane: Array | None
    """Unit normal and offset [m] of its plane, n . x = h, shape (4,); None where it is not flat."""
    share: float
    """Share of the points of the surface."""
    moved_most_m: float
    """Largest distance between the surface and the plane [m]."""


@dataclass(frozen=True)
class FacetRecord:
    """Summary for fit.json."""

    regions: int
    """Regions near a plane."""
    flat: int
    """Those that are flat."""
    share: float
    """Share of the surface in flat ones."""
    moved_most_m: float
    """Largest distance between the surface and its plane [m]."""


def flatten_faces(solid: Volume, views: Sequence[View], body: int, seed: int) -> tuple[Volume, FacetRecord]:
    """Put the surface of a solid on planes where its faces are flat.

    Args:
        solid: The solid, world frame.
        views: The photos, with masks.
        body: Index of the body in the manifest.
        seed: Seed of the choice of patches.

    Returns:
        The solid and a summary.
    """
    normals = smooth_normals(solid, np.arange(len(solid.surface)))
    regions = planar_regions(solid, normals, seed)
    halves = (views[::2], views[1::2])
    facets = [_judged(solid, regions, k, normals, halves, body, seed) for k in range(len(regions.planes))]
    flat = [k for k, facet in enumerate(facets) if facet.plane is not None]
    record = FacetRecord(
        regions=len(facets),
        flat=len(flat),
        share=sum(facets[k].share for k in flat),
        moved_most_m=max((facets[k].moved_most_m for k in flat), default=0.0),
    )
    if not flat:
        return solid, record
    numbers = np.full(len(facets) + 1, -1)
    numbers[flat] = np.arange(len(flat))
    planes = np.array([facets[k].plane for k in flat])
    return flattened(solid, numbers[regions.region], planes), record


def _judged(
    solid: Volume,
    regions: Regions,
    number: int,
    normals: Array,
    halves: tuple[Sequence[View], Sequence[View]],
    body: int,
    seed: int,
) -> Facet:
    """Return what two halves of the photos say of a region."""
    members, plane = np.flatnonzero(regions.region == number), regions.planes[number]
    share = len(members) / len(solid.surface)
    off = solid.surface[members] @ plane[:3] - plane[3]
    if off.std() < _FLAT_PITCHES * solid.pitch:
        return Facet(plane, share, float(np.abs(off).max()))
    chosen = np.random.default_rng([seed, number]).permutation(members)[:_POINTS]
    sheet = _Sheet.of(solid, chosen, plane)
    pixel = _pixel(halves[0], solid)
    curves = [Curves.of(solid, sheet, half, body, pixel) for half in halves]
    if min(curve.seen for curve in curves) < _LEAST_SEEN:
        return Facet(None, share, 0.0)
    rest = [_at_rest(solid, chosen, normals, half, body) for half in halves]
    if not _is_flat(sheet, curves, rest, pixel):
        return Facet(None, share, 0.0)
    found = sheet.plane(Curves.joined(*curves).fitted(sheet.linear))
    moved = float(np.abs(solid.surface[chosen] @ found[:3] - found[3]).max())
    return Facet(found, share, moved) if moved < _REACH_PX * pixel else Facet(None, share, 0.0)


def _is_flat(sheet: _Sheet, curves: Sequence[Curves], rest: Sequence[Array], pixel_m: float) -> bool:
    """Return whether each half of the photos agrees with the plane of the other.

    Args:
        sheet: Points of the region, and coordinates on its plane.
        curves: What each half says of displacements.
        rest: Correlation of the patches where the surface is, by half, shape (n,) each.
        pixel_m: Width of a pixel [m].
    """
    flat = [curve.fitted(sheet.linear) for curve in curves]
    bent = [curve.fitted(sheet.bent, start) for curve, start in zip(curves, flat, strict=True)]
    apart = float(np.sqrt(np.mean((sheet.linear @ (flat[0] - flat[1])) ** 2)))
    judged = [(judge, rest[k], flat[1 - k], bent[1 - k]) for k, judge in enumerate(curves)]
    score = np.mean([judge.score(sheet.linear @ plane) for judge, _, plane, _ in judged])
    as_it_is = np.mean([judge.mean(values) for judge, values, _, _ in judged])
    if_bent = np.mean([judge.score(sheet.bent @ sag) for judge, _, _, sag in judged])
    return bool(score >= as_it_is and if_bent - score <= _BEND_GAIN and apart <= _APART_PX * pixel_m)


@dataclass(frozen=True)
class _Sheet:
    """Points of a region on its plane, with coordinates in it."""

    points: Array
    """Feet of the region's points on the plane [m], shape (n, 3)."""
    normal: Array
    middle: Array
    axes: Array
    """Two axes in the plane, so long that coordinates are at most 1 [m], shape (2, 3)."""
    linear: Array
    """1, u, v: displacements along the normal that keep a plane are linear in these, shape (n, 3)."""
    bent: Array
    """1, u, v, u^2, u v, v^2, shape (n, 6)."""

    @staticmethod
    def of(solid: Volume, chosen: NDArray[np.intp], plane: Array) -> _Sheet:
        normal, points = plane[:3], solid.surface[chosen]
        feet = points - (points @ normal - plane[3])[:, None] * normal
        middle = feet.mean(0)
        axes = np.concatenate(tangents(normal[None]))
        places = (feet - middle) @ axes.T
        axes = axes * np.abs(places).max()
        u, v = (places / np.abs(places).max()).T
        linear = np.stack([np.ones_like(u), u, v], 1)
        return _Sheet(
            feet, normal, middle, axes, linear, np.concatenate([linear, np.stack([u * u, u * v, v * v], 1)], 1)
        )

    def plane(self, shift: Array) -> Array:
        """Return the plane (4,) that displacements (3,) [m] make of this one."""
        along = [axis / (axis @ axis) for axis in self.axes]
        normal = self.normal - shift[1] * along[0] - shift[2] * along[1]
        normal = normal / np.linalg.norm(normal)
        return np.append(normal, normal @ (self.middle + shift[0] * self.normal))


@dataclass(frozen=True)
class Curves:
    """Mean correlation of patches between photos, by displacement from a plane."""

    offsets: Array
    """Displacements [m], evenly spaced, shape (K,)."""
    scores: Array
    """Correlation by patch and displacement, shape (n, K)."""
    pairs: Array
    """Number of pairs of photos that see each patch, shape (n,)."""

    @staticmethod
    def of(solid: Volume, sheet: _Sheet, views: Sequence[View], body: int, pixel_m: float) -> Curves:
        """Compare patches in photos, up to `_REACH_PX` pixels of a width [m] from a plane."""
        offsets = _REACH_PX * pixel_m * np.linspace(-1, 1, _STEPS)
        normals = np.tile(sheet.normal, (len(sheet.points), 1))
        return Curves(offsets, *agreement(solid, sheet.points, normals, offsets, views, body))

    @staticmethod
    def joined(first: Curves, second: Curves) -> Curves:
        """Return the curves of all photos, but for pairs of one photo of each."""
        pairs = first.pairs + second.pairs
        total = first.pairs[:, None] * first.scores + second.pairs[:, None] * second.scores
        return Curves(first.offsets, total / np.maximum(pairs, 1)[:, None], pairs)

    @property
    def seen(self) -> float:
        """Share of the patches that three photos see."""
        return float((self.pairs >= _LEAST_PAIRS).mean())

    def mean(self, values: Array) -> float:
        """Return the mean of values (n,) of the patches, weighted with the pairs of photos."""
        return float(values @ self.pairs / self.pairs.sum())

    def score(self, shift: Array) -> float:
        """Return the mean correlation at displacements (n,) [m]; smooth, by quadratic B-splines."""
        last = len(self.offsets) - 2
        place = ((shift - self.offsets[0]) / (self.offsets[1] - self.offsets[0])).clip(1, last)
        middle = np.rint(place).astype(np.intp).clip(1, last)
        part, rows = place - middle, np.arange(len(shift))
        low, mid, high = (self.scores[rows, middle + k] for k in (-1, 0, 1))
        return self.mean(0.5 * (0.5 - part) ** 2 * low + (0.75 - part**2) * mid + 0.5 * (0.5 + part) ** 2 * high)

    def fitted(self, columns: Array, start: Array | None = None) -> Array:
        """Return the coefficients (c,) of columns (n, c) whose displacements agree best, by simplex descent.

        From `start`, whose columns come first, or from the best plane of a coarse grid.
        """
        from scipy.optimize import minimize  # dear to import, and seldom needed

        step = float(self.offsets[1] - self.offsets[0])
        if start is None:
            tilts = (-5 * step, 0.0, 5 * step)
            tried = [np.array([a, b, c]) for a in self.offsets[4:-4] for b in tilts for c in tilts]
            start = max(tried, key=lambda one: self.score(columns @ one))
        found = np.append(start, np.zeros(columns.shape[1] - len(start)))
        for size in (1.6 * step, step):
            corners = np.concatenate([found[None], found + size * np.eye(len(found))])
            limits = {"initial_simplex": corners, "xatol": 0.03 * step, "fatol": 1e-6, "maxiter": 600}
            found = minimize(lambda x: -self.score(columns @ x), found, method="Nelder-Mead", options=limits).x
        return found


def _at_rest(solid: Volume, chosen: NDArray[np.intp], normals: Array, views: Sequence[View], body: int) -> Array:
    """Return the correlation (n,) of patches of the surface where it is."""
    return agreement(solid, solid.surface[chosen], normals[chosen], np.zeros(1), views, body)[0][:, 0]


def _pixel(views: Sequence[View], solid: Volume) -> float:
    """Return the median width of a pixel of the grey photos at the solid [m]."""
    middle = solid.surface.mean(0)
    depths = [abs(v.camera.T_cam_world[2, :3] @ middle + v.camera.T_cam_world[2, 3]) / v.camera.K[0, 0] for v in views]
    shrunk = [view.camera.width / view.grey.shape[1] for view in views]
    return float(np.median(np.array(depths) * np.array(shrunk)))
