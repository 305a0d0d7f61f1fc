"""What stands before a background of one colour, as in photos of one object on a turntable or in a light box."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .graph_cut import Band, Mask, cut

_RIM_PX = 3.0
"""Half width of the band about what stands before the background, in which it is cut out [px]."""
_BORDER = 0.03
"""Width of the border whose colour is that of the background, of the shorter side of the photo."""
_PLAIN_SHARE = 0.9
"""Least share of the border's pixels with one colour, for a plain background."""
_SAME = 14.0
"""Largest difference of a channel from that colour, 8 bits."""
_CLOSED = 0.012
"""Radius of the gaps that are closed, of the longer side."""
_LEAST_AREA, _MOST_AREA = 0.002, 0.9
"""Least and largest share of a photo that a body fills."""


def cut_out(image: NDArray[np.uint8]) -> Mask | None:
    """Return the pixels (H, W) of what stands before a plain background, cut along its edges; None as `foreground`."""
    start = foreground(image)
    return None if start is None else cut(image, Band.about(start, start, _RIM_PX))


def foreground(image: NDArray[np.uint8]) -> Mask | None:
    """Return the pixels (H, W) of the largest thing before a plain background, holes filled; None without either.

    Args:
        image: RGB, shape (H, W, 3).
    """
    width = max(2, round(_BORDER * min(image.shape[:2])))
    border = np.ones(image.shape[:2], bool)
    border[width:-width, width:-width] = False
    color = np.median(image[border], axis=0)
    away = np.abs(image.astype(float) - color).max(axis=2)
    if (away[border] <= _SAME).mean() < _PLAIN_SHARE:
        return None
    differs = cv2.morphologyEx((away > _SAME).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    radius = max(1, round(_CLOSED * max(image.shape[:2])))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    closed = cv2.morphologyEx(differs, cv2.MORPH_CLOSE, disc)
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea, default=None)
    if largest is None:
        return None
    filled = np.zeros_like(closed)
    cv2.drawContours(filled, [largest], -1, 1, cv2.FILLED)
    return filled > 0 if _LEAST_AREA <= filled.mean() <= _MOST_AREA else None
