"""The ground as it is without the bodies: their shadows in the photos lifted, and what they hid filled in.

The background is fitted to photos in which the bodies stand. Where a body then moves away, its shadow would stay on the
ground, and what no photo shows would have any colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from torch import Tensor

from ....datasets.io.progress import note
from ....schemas import GroundShadow
from ...geometry.ground_spheres import NODE_WEIGHTS, NODES, THIN, dimmed, on_plane
from ...geometry.solid_grid import Array
from ...geometry.spheres import Spheres
from ..appearance.initialization import to_spheres
from ..context import Stage
from ..photos.views import View
from .cast_shadow import Caster, CastShadow, find_shadow
from .ground_photo import CELLS, GroundPhoto, near_mask, photograph_ground

_LARGEST = 0.15
"""Largest scale of a sphere of the ground, of the side of the grid; larger ones are backdrop."""
_INPAINT_CELLS = 5
_SPACING_CELLS, _SCALE_CELLS = 1, 0.65
"""Distance and scale of the spheres that fill hidden ground, in cells."""
_SUNK = 0.9 * THIN
"""Depth of their centres below the ground, in scales: on it they would cover the foot of a body that moves there, and
deeper they would no longer count as spheres of the ground, which shadows dim."""
_GAP_CELLS = 2


class BareGround(NamedTuple):
    """A background without the traces of the bodies that move."""

    scene: Spheres
    """The background."""
    shadow: GroundShadow | None
    """The shadow that was lifted; None if none stands out."""


def bare_ground(stage: Stage, scene: Spheres, bodies: list[Spheres]) -> BareGround:
    """Return the background with the ground under and beside the bodies as it is without them.

    Args:
        stage: The photos, and the ground; without a ground or bodies the background stays as it is.
        scene: The fitted background.
        bodies: Visual spheres of the bodies as they stand in the photos, world frame.
    """
    if stage.ground is None or not bodies:
        return BareGround(scene, None)
    casters = [Caster(*_places(body)) for body in bodies]
    solid = [caster.corners for caster in casters]
    even = [stage.exposures.even(view) for view in stage.train]
    photo = photograph_ground(stage.ground, np.concatenate(solid), even)
    if photo is None:
        return BareGround(scene, None)
    shadow = find_shadow(photo, casters)
    hidden = _hidden(photo, solid)
    lit = photo.colors if shadow is None else photo.colors / dimmed(shadow.cover, shadow.factors).astype(np.float32)
    bare = _inpainted(lit, photo.seen, hidden)
    scene = _without_insides(scene, solid, stage.train)
    if shadow is not None:
        scene = _lifted(scene, photo, shadow)
    scene = _filled(scene, photo, hidden, bare)
    stage.record["bare_ground"] = _record(photo, hidden, shadow)
    note(f"sg-gs: {_said(photo, hidden, shadow)}")
    return BareGround(scene, None if shadow is None else _for_model(shadow))


def _for_model(shadow: CastShadow) -> GroundShadow:
    x, y, z = map(float, shadow.to_lamp)
    red, green, blue = map(float, shadow.factors)
    return GroundShadow(to_lamp=(x, y, z), brightness_rgb=(red, green, blue))


def _places(spheres: Spheres) -> tuple[Array, Array]:
    """Return the centres (n, 3) [m] and the scales (n,) [m] of spheres."""
    means, scales = (values.detach().cpu().numpy().astype(float) for values in (spheres.means, spheres.scales))
    return means, scales


def _without_insides(scene: Spheres, bodies: list[Array], views: Sequence[View]) -> Spheres:
    """Return the background without spheres that lie within a body and have its colours.

    They lie within the hull of its corners, to one scale of theirs, and no photo shows them beside the masks, as it
    shows what stands in a notch of the body.
    """
    means, scales = _places(scene)
    inside = np.zeros(len(scales), bool)
    for corners in bodies:
        planes = ConvexHull(corners).equations
        inside |= (means @ planes[:, :3].T + planes[:, 3] < scales[:, None]).all(1)
    rows = np.flatnonzero(inside)
    inside[rows] = _behind_masks(means[rows], views)
    return _rows(scene, torch.as_tensor(np.flatnonzero(~inside), device=scene.means.device))


def _behind_masks(points: Array, views: Sequence[View]) -> NDArray[np.bool_]:
    """Return which points (n, 3) [m], world frame, lie on a mask, or close to one, in all photos that hold them."""
    kept = np.ones(len(points), bool)
    for view in views:
        if view.cover is None or not len(points):
            continue
        held, columns, rows = view.camera.resized(*view.size).pixels_of(points)
        kept[held] &= near_mask(view)[rows[held], columns[held]]
    return kept


def _hidden(photo: GroundPhoto, bodies: list[Array]) -> NDArray[np.bool_]:
    """Return the cells under and close to the bodies that no photo shows: holes in what is seen, not its far edge."""
    places = np.concatenate([photo.places(points) for points in bodies])
    low, high = places.min(0), places.max(0)
    columns, rows = np.meshgrid(np.arange(CELLS) + 0.5, np.arange(CELLS) + 0.5)
    margin = 0.5 * (high - low)
    near = (columns > low[0] - margin[0]) & (columns < high[0] + margin[0])
    near &= (rows > low[1] - margin[1]) & (rows < high[1] + margin[1])
    # between the pixels of coarse photos single cells are empty: they are no hidden ground
    kernel = np.ones((2 * _GAP_CELLS + 1,) * 2, np.uint8)
    closed = cv2.morphologyEx(photo.seen.astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    return ~closed & near


def _inpainted(colors: NDArray[np.float32], seen: NDArray[np.bool_], hidden: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the colours (CELLS, CELLS, 3) with hidden cells filled from their surroundings (Telea, 2004)."""
    picture = np.clip(255 * colors, 0, 255).astype(np.uint8)
    missing = (~seen | hidden).astype(np.uint8)
    filled = cv2.inpaint(picture, missing, _INPAINT_CELLS, cv2.INPAINT_TELEA)
    return (filled / np.float32(255)).astype(np.float32)


def _lifted(scene: Spheres, photo: GroundPhoto, shadow: CastShadow) -> Spheres:
    """Return the background with the colours of the ground's spheres as outside of the shadow.

    A sphere is in the shadow by the share of its weight there: the cover under nine points of it.
    """
    means, scales = _places(scene)
    ground = _of_ground(means, scales, photo)
    cover = np.zeros(len(scales))
    for i, u in enumerate(NODES):
        for j, v in enumerate(NODES):
            places = photo.places(means) + (scales / photo.cell)[:, None] * [u, v]
            cover += NODE_WEIGHTS[i] * NODE_WEIGHTS[j] * _at(shadow.cover, places)
    dimming = dimmed((cover * ground).astype(np.float32), shadow.factors).astype(np.float32)
    return _brightened(scene, torch.as_tensor(dimming).to(scene.colors))


def _brightened(scene: Spheres, dimming: Tensor) -> Spheres:
    higher = None if scene.harmonics is None else scene.harmonics / dimming[:, None]
    return replace(scene, colors=(scene.colors / dimming).clamp(0, 1), harmonics=higher)


def _of_ground(means: Array, scales: Array, photo: GroundPhoto) -> NDArray[np.bool_]:
    return on_plane(means, photo.axes[2], photo.height, scales, _LARGEST * CELLS * photo.cell)


def _at(grid: NDArray[np.float32], places: Array) -> Array:
    """Return values of a grid at places (n, 2) in cells, 0 outside."""
    maps = (places - 0.5).astype(np.float32)
    parts = [
        cv2.remap(grid, maps[k : k + 8192, :1], maps[k : k + 8192, 1:], cv2.INTER_LINEAR)[:, 0]
        for k in range(0, len(maps), 8192)
    ]
    return np.concatenate(parts).astype(float) if parts else np.zeros(0)


def _filled(scene: Spheres, photo: GroundPhoto, hidden: NDArray[np.bool_], bare: NDArray[np.float32]) -> Spheres:
    """Return the background with hidden ground covered by small spheres, in place of those that lie in it."""
    means, scales = _places(scene)
    inner = cv2.erode(hidden.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    gone = (_at(inner, photo.places(means)) > 0.5) & _of_ground(means, scales, photo)
    rows, columns = np.nonzero(hidden)
    chosen = (rows % _SPACING_CELLS == 0) & (columns % _SPACING_CELLS == 0)
    rows, columns = rows[chosen], columns[chosen]
    kept = _rows(scene, torch.as_tensor(np.flatnonzero(~gone), device=scene.means.device))
    if not len(rows):
        return kept
    points = photo.points(np.stack([columns + 0.5, rows + 0.5], 1))
    points = points - _SUNK * _SCALE_CELLS * photo.cell * photo.axes[2]
    fill = to_spheres(points, np.full(len(rows), _SCALE_CELLS * photo.cell), 0.95, scene.means.device)
    colors = torch.as_tensor(bare[rows, columns]).to(scene.colors)
    return Spheres.joined([kept, replace(fill, colors=colors)])


def _rows(spheres: Spheres, rows: Tensor) -> Spheres:
    higher = None if spheres.harmonics is None else spheres.harmonics[rows]
    return Spheres(spheres.means[rows], spheres.scales[rows], spheres.opacities[rows], spheres.colors[rows], higher)


def _record(photo: GroundPhoto, hidden: NDArray[np.bool_], shadow: CastShadow | None) -> dict[str, Any]:
    """Return the entry of fit.json."""
    cell_m2 = photo.cell**2
    found = None if shadow is None else {
        "to_lamp": [round(float(value), 4) for value in shadow.to_lamp],
        "brightness_rgb": [round(float(value), 4) for value in shadow.factors],
        "area_m2": round(float(shadow.cover.sum()) * cell_m2, 6),
        "contrast": round(shadow.contrast, 2),
    }  # fmt: skip
    return {"filled_m2": round(float(hidden.sum()) * cell_m2, 6), "shadow": found}


def _said(photo: GroundPhoto, hidden: NDArray[np.bool_], shadow: CastShadow | None) -> str:
    filled = f"{1e4 * float(hidden.sum()) * photo.cell**2:.0f} cm2 of ground that no photo shows filled in"
    if shadow is None:
        return f"{filled}; no cast shadow stands out"
    return f"{filled}; a cast shadow (brightness {float(shadow.factors.mean()):.2f}) lifted"
