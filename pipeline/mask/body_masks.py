"""Masks of one body in photos without cameras: before one colour, on a turntable, or from a box in one photo."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets.io.progress import progress
from ..foreground.graph_cut import Band, ColorModels, Mask, cut, cut_like, dilated
from ..foreground.plain_background import cut_out
from ..foreground.standing_camera import places_of_camera, surroundings, turning

Photo = NDArray[np.uint8]

_TURNING_RIM = 0.02
"""Half width of the band about what turns, of the longer side of the photo."""
_REACH = 0.3
"""How far a body reaches beyond where it is in the photo before, of its own size."""
_LEAST_PART = 0.05
"""Least size of a part of a mask, of its largest."""
_SPECK = 0.002
"""Largest size of a hole that is filled, of the mask."""


def before_plain(photos: Sequence[Photo]) -> list[Mask] | None:
    """Return the masks (H, W) of what all photos show before a background of one colour; None where one does not."""
    masks = []
    for photo in progress(photos, "masks", unit="photo"):
        mask = cut_out(photo)
        if mask is None:
            return None
        masks.append(_tidy(mask))
    return masks


def on_turntable(photos: Sequence[Photo]) -> list[Mask] | None:
    """Return the masks (H, W) of what turns before a camera that stands; None where it does not stand in all photos."""
    places = places_of_camera(photos)
    if sum(map(len, places)) < len(photos):
        return None
    masks = [np.zeros(photo.shape[:2], bool) for photo in photos]
    for place in places:
        color, known = surroundings([photos[k] for k in place])
        for k in progress(place, "masks", unit="photo"):
            start = turning(photos[k], color, known)
            hull = _hull(start)  # what has one colour all around looks as if it stood: the cut decides on it
            band = Band(np.zeros_like(start), ~dilated(hull, _TURNING_RIM * max(start.shape)), start)
            masks[k] = _tidy(cut(photos[k], band))
    return masks


def from_box(photos: Sequence[Photo], reference: int, box: tuple[float, float, float, float]) -> list[Mask]:
    """Return the masks (H, W) of what a box holds in one photo.

    From that photo on, in both directions, each photo is cut with the colours that the one before it had, near where
    the body was there.

    Args:
        photos: In the order in which they were taken.
        reference: Index of the photo with the box.
        box: Left, upper, right and lower border [px].
    """
    within = np.zeros(photos[reference].shape[:2], bool)
    left, upper, right, lower = (round(value) for value in box)
    within[upper:lower, left:right] = True
    first, colors = cut_like(photos[reference], Band(np.zeros_like(within), ~within, within), ColorModels.none())
    masks: dict[int, Mask] = {reference: _tidy(first)}
    with progress(range(len(photos)), "masks", total=len(photos), unit="photo") as bar:
        bar.update(1)
        for order in (range(reference + 1, len(photos)), range(reference - 1, -1, -1)):
            before, own = masks[reference], colors
            for k in order:
                if before.shape != photos[k].shape[:2] or not before.any():
                    masks[k] = np.zeros(photos[k].shape[:2], bool)
                else:
                    found, after = cut_like(photos[k], _near(before), own)
                    masks[k] = _tidy(found)
                    if masks[k].any():
                        before, own = masks[k], after
                bar.update(1)
    return [masks[k] for k in range(len(photos))]


def _near(before: Mask) -> Band:
    """Return the band of a body that was at `before` in the photo before."""
    rows, columns = np.nonzero(before)
    reach = _REACH * max(float(np.ptp(rows)), float(np.ptp(columns)))
    within = np.zeros_like(before)
    low, high = max(int(rows.min() - reach), 0), int(rows.max() + reach) + 1
    within[low:high, max(int(columns.min() - reach), 0) : int(columns.max() + reach) + 1] = True
    return Band(np.zeros_like(before), ~within, before)


def _hull(mask: Mask) -> Mask:
    """Return the convex hull of a mask (H, W)."""
    points = cv2.findNonZero(mask.astype(np.uint8))
    filled = np.zeros(mask.shape, np.uint8)
    if points is not None:
        cv2.fillConvexPoly(filled, cv2.convexHull(points), 1)
    return filled > 0


def _tidy(mask: Mask) -> Mask:
    """Return a mask without small parts and without small holes."""
    count, label, figures, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if count < 2:
        return mask
    sizes = figures[:, cv2.CC_STAT_AREA].copy()
    sizes[0] = 0
    kept = np.isin(label, np.flatnonzero(sizes >= _LEAST_PART * sizes.max()))
    kept &= label > 0
    count, label, figures, _ = cv2.connectedComponentsWithStats((~kept).astype(np.uint8), connectivity=4)
    small = np.flatnonzero(figures[:, cv2.CC_STAT_AREA] <= _SPECK * kept.sum())
    return kept | (np.isin(label, small) & ~kept)
