"""Photos of what turns before a camera that stands: whether photos are such, and which of their pixels turn.

The surroundings are then at the same pixels in all photos, and their features contradict those of what turns. They are
found without masks: a pixel shows the surroundings where it has the colour that it has most often.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SIZE_PX = 480
"""Longer side to which photos are reduced for this."""
STANDING_SHARE = 0.3
"""Least share of corners that look the same at the same pixels of another photo, for a standing camera."""
_LEAST_CORNERS, _MOST_CORNERS = 20, 300
_PROBES = 5
LEAST_PLACE = 5
"""Least number of photos from one place of the camera."""
_LEAST_STANDING = 0.8
"""Least share of the photos that such places hold."""
_PATCH = 5
"""Half the side of the patches that are compared [px]."""
_ALIKE = 0.9
"""Least correlation of patches that look the same."""
_VOTED = 32
"""Most photos that tell the colour of the surroundings."""
_NOISE = 14.0
"""Largest difference of a channel between two photos of the same surroundings, 8 bits."""
_LEAST_VOTES = 0.25
"""Least share of the photos in which a pixel has the colour of the surroundings."""
_CLOSED_PX, _MARGIN_PX = 12, 3
_LEAST_PART = 0.002
"""Least area of a part that turns, as a share of the photo."""


def probes(names: list[str]) -> list[tuple[str, str]]:
    """Return pairs of neighbours that tell whether the camera stands, evenly spread."""
    starts = np.unique(np.linspace(0, len(names) - 2, _PROBES).astype(int)) if len(names) > 1 else ()
    return [(names[k], names[k + 1]) for k in starts]


def reduced(photo: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a photo (H, W, 3) whose longer side is at most `SIZE_PX`."""
    scale = min(1.0, SIZE_PX / max(photo.shape[:2]))
    size = (max(1, round(scale * photo.shape[1])), max(1, round(scale * photo.shape[0])))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)


def seems_to_stand(pairs: Sequence[tuple[NDArray[np.uint8], NDArray[np.uint8]]]) -> bool:
    """Return whether most pairs of reduced photos show much at the same pixels.

    Before a black or white background no corner stands, and the answer is no: there is nothing to leave out.
    """
    shares = [float(_standing_shares(first, [other])[0]) for first, other in pairs]
    return bool(shares) and float(np.median(shares)) >= STANDING_SHARE


def places_of_camera(photos: Sequence[NDArray[np.uint8]]) -> list[list[int]]:
    """Return the indices of the reduced photos that were taken from each place of a camera that stands.

    From one place, much is at the same pixels. Empty where places of at least five photos hold less than 80 % of all.
    """
    left, found = list(range(len(photos))), []
    while left:
        shares = _standing_shares(photos[left[0]], [photos[k] for k in left])
        place = [k for k, share in zip(left, shares, strict=True) if k == left[0] or share >= STANDING_SHARE]
        found.append(place)
        left = [k for k in left if k not in set(place)]
    found = [place for place in found if len(place) >= LEAST_PLACE]
    return found if sum(map(len, found)) >= _LEAST_STANDING * len(photos) else []


def _standing_shares(first: NDArray[np.uint8], others: Sequence[NDArray[np.uint8]]) -> Array:
    """Return the share of the corners of a photo around which each other photo looks the same, shape (photo,)."""
    grey = np.asarray(cv2.cvtColor(first, cv2.COLOR_RGB2GRAY), np.uint8)
    corners = cv2.goodFeaturesToTrack(grey, _MOST_CORNERS, 0.01, 8)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return np.zeros(len(others))
    pixels = corners.reshape(-1, 2).round().astype(int)
    greys = [np.asarray(cv2.cvtColor(other, cv2.COLOR_RGB2GRAY), np.uint8) for other in others]
    return np.array([_alike(grey, other, pixels) if other.shape == grey.shape else 0.0 for other in greys])


def _alike(first: NDArray[np.uint8], other: NDArray[np.uint8], pixels: NDArray[np.int64]) -> float:
    """Return the share of the pixels (n, 2) around which two photos look the same."""
    patches = [_standardized(_patches(image, pixels)) for image in (first, other)]
    return float((np.mean(patches[0] * patches[1], axis=1) > _ALIKE).mean())


def _patches(image: NDArray[np.uint8], pixels: NDArray[np.int64]) -> Array:
    steps = np.arange(-_PATCH, _PATCH + 1)
    rows = np.clip(pixels[:, 1, None] + steps, 0, image.shape[0] - 1)
    columns = np.clip(pixels[:, 0, None] + steps, 0, image.shape[1] - 1)
    return image[rows[:, :, None], columns[:, None, :]].reshape(len(pixels), -1).astype(float)


def _standardized(patches: Array) -> Array:
    centered = patches - patches.mean(axis=1, keepdims=True)
    return centered / np.maximum(centered.std(axis=1, keepdims=True), 1.0)


def surroundings(photos: Sequence[NDArray[np.uint8]]) -> tuple[NDArray[np.uint8], Mask]:
    """Return the most frequent colour of each pixel (H, W, 3), and where it is frequent enough (H, W).

    Args:
        photos: Reduced photos from one place of the camera.
    """
    chosen = np.stack([photos[k] for k in np.unique(np.linspace(0, len(photos) - 1, _VOTED).astype(int))])
    votes = np.zeros(chosen.shape[:3], np.int64)
    for k, photo in enumerate(chosen):
        votes[k] = np.sum([_same(photo, other) for other in chosen], axis=0)
    best = votes.argmax(axis=0)
    rows, columns = np.indices(best.shape)
    color = chosen[best, rows, columns]
    return color, votes.max(axis=0) >= max(_LEAST_VOTES * len(chosen), 2)


def _same(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> Mask:
    return (cv2.absdiff(first, second).max(axis=2)) <= _NOISE


def turning(photo: NDArray[np.uint8], color: NDArray[np.uint8], known: Mask) -> Mask:
    """Return the pixels (H, W) of a reduced photo that differ from the surroundings, holes filled, with a margin."""
    differs = (~_same(photo, color) | ~known).astype(np.uint8)
    differs = cv2.morphologyEx(differs, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    closed = cv2.morphologyEx(differs, cv2.MORPH_CLOSE, _disc(_CLOSED_PX))
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [one for one in contours if cv2.contourArea(one) > _LEAST_PART * closed.size]
    filled = np.zeros_like(closed)
    cv2.drawContours(filled, large, -1, 1, cv2.FILLED)
    return cv2.dilate(filled, _disc(_MARGIN_PX)).astype(bool)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2), np.uint8)
