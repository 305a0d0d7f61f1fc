"""A body and what is behind it in a photo, cut apart by GrabCut within a band.

GrabCut: Rother, Kolmogorov, Blake 2004, "GrabCut: interactive foreground extraction using iterated graph cuts". Colour
models of both are learned, and a minimal cut runs along the edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

_WINDOW_PX = 400
"""Maximum size of the window of a body for a cut [px]."""
_SURROUNDINGS = 0.25
"""Width of the surroundings of the band that the background's colour model learns from, in units of its size."""
_CUTS = 4


@dataclass(frozen=True)
class Band:
    """Constraints on a mask."""

    inside: Mask
    """Pixels certainly inside, shape (H, W)."""
    outside: Mask
    """Pixels certainly outside, shape (H, W)."""
    start: Mask
    """Initial mask, shape (H, W)."""

    def without(self, other: Mask) -> Band:
        """Return the band with further pixels that are certainly outside."""
        return Band(self.inside & ~other, self.outside | other, self.start & ~other)

    @staticmethod
    def about(start: Mask, core: Mask, width_px: float) -> Band:
        """Return a band that extends by `width_px` outside of `start` and inside of `core`."""
        return Band(eroded(core, width_px), ~dilated(start, width_px), start)


@dataclass(frozen=True)
class ColorModels:
    """What GrabCut has learned of the colours of a photo: mixtures of five normal distributions."""

    background: NDArray[np.float64]
    """Of what is behind the body, shape (1, 65), in OpenCV's order."""
    body: NDArray[np.float64]
    """Of the body."""

    @staticmethod
    def none() -> ColorModels:
        """Return models that are yet to be learned."""
        return ColorModels(np.zeros((1, 65)), np.zeros((1, 65)))

    @property
    def known(self) -> bool:
        """Whether they are learned."""
        return bool(self.body.any())


def cut(image: NDArray[np.uint8], band: Band) -> Mask:
    """Return the mask of a body within a band, by GrabCut in a window around it."""
    return cut_like(image, band, ColorModels.none())[0]


def cut_like(image: NDArray[np.uint8], band: Band, models: ColorModels) -> tuple[Mask, ColorModels]:
    """Return the mask of a body within a band, by GrabCut in a window around it, and the colours then.

    Args:
        image: RGB, shape (H, W, 3).
        band: Constraints.
        models: Colours of another photo of the same body, by which the first labels are given; without them the start
            of the band gives these.
    """
    rows, columns = np.nonzero(~band.outside)
    if len(rows) == 0 or not band.start.any():
        return np.zeros(band.start.shape, bool), models
    more = 4 + int(_SURROUNDINGS * max(np.ptp(rows), np.ptp(columns)))
    window = (
        slice(max(rows.min() - more, 0), rows.max() + more + 1),
        slice(max(columns.min() - more, 0), columns.max() + more + 1),
    )
    state = np.where(band.start, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    state[band.outside], state[band.inside & ~band.outside] = cv2.GC_BGD, cv2.GC_FGD
    part, state = image[window], state[window]
    height, width = state.shape
    scale = min(1.0, _WINDOW_PX / max(height, width))
    if scale < 1:
        size = max(1, round(scale * width)), max(1, round(scale * height))
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        state = cv2.resize(state, size, interpolation=cv2.INTER_NEAREST)
    part, state = np.ascontiguousarray(part), np.ascontiguousarray(state)
    outer = (state == cv2.GC_BGD) | (state == cv2.GC_PR_BGD)
    if not outer.any() or outer.all():  # GrabCut needs colours of both.
        return band.start & ~band.outside, models
    cv2.setRNGSeed(0)
    learned = ColorModels(models.background.copy(), models.body.copy())
    how = cv2.GC_EVAL if models.known else cv2.GC_INIT_WITH_MASK
    cv2.grabCut(part, state, (0, 0, 1, 1), learned.background, learned.body, _CUTS, how)
    inner = ((state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)).astype(np.float32)
    mask = np.zeros(band.start.shape, bool)
    mask[window] = cv2.resize(inner, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
    return mask, learned


def dilated(mask: Mask, radius_px: float) -> Mask:
    """Return a mask (H, W) grown by a disc."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _disc(radius_px))) > 0


def eroded(mask: Mask, radius_px: float) -> Mask:
    """Return a mask (H, W) shrunk by a disc, not at the borders of the photo."""
    # Space beyond the picture is unknown: a body that extends beyond it is not eroded at that border.
    return np.asarray(cv2.erode(mask.astype(np.uint8), _disc(radius_px), borderValue=1)) > 0


def _disc(radius_px: float) -> NDArray[np.uint8]:
    side = 2 * max(0, round(radius_px)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
