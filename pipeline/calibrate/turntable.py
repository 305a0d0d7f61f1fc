"""Photos of what turns before a camera that stands: whether photos are such, and which of their pixels turn.

The surroundings are then at the same pixels in all photos, and their features contradict those of what turns. They are
found without masks: a pixel shows the surroundings where it has the colour that it has most often.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SIZE_PX = 480
"""Longer side to which photos are reduced for this."""
STANDING_SHARE = 0.3
"""Least share of corners that look the same at the same pixels of another photo, for a standing camera."""
_LEAST_CORNERS, _MOST_CORNERS = 20, 300
_PROBES = 6
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
_SAME_PLACE_PX = 1.5
"""Distance of features of two photos that are at the same place [px]."""
_STANDING_IN = 0.15
"""Least share of the other photos in which a feature of the surroundings is found again; what turns looks alike at the
same place in its neighbours alone."""
_LEAST_PART = 0.002
"""Least area of a part that turns, as a share of the photo."""


def probes(names: list[str]) -> list[str]:
    """Return the photos from which it is told whether the camera stands, evenly spread."""
    return [names[k] for k in np.unique(np.linspace(0, len(names) - 1, _PROBES).astype(int))]


def reduced(photo: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a photo (H, W, 3) whose longer side is at most `SIZE_PX`."""
    scale = min(1.0, SIZE_PX / max(photo.shape[:2]))
    size = (max(1, round(scale * photo.shape[1])), max(1, round(scale * photo.shape[0])))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)


def camera_stands(photos: Sequence[NDArray[np.uint8]]) -> bool:
    """Return whether reduced photos show much at the same pixels.

    Before a black or white background no corner stands, and the answer is no: there is nothing to leave out.
    """
    if len(photos) < 2 or len({photo.shape for photo in photos}) > 1:
        return False
    grey = [np.asarray(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), np.uint8) for photo in photos]
    corners = cv2.goodFeaturesToTrack(grey[0], _MOST_CORNERS, 0.01, 8)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return False
    pixels = corners.reshape(-1, 2).round().astype(int)
    shares = [_alike(grey[0], other, pixels) for other in grey[1:]]
    return float(np.median(shares)) >= STANDING_SHARE


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
        photos: Reduced photos of one size.
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


def standing_features(places: Sequence[NDArray[Any]], descriptors: Sequence[NDArray[Any]]) -> list[Mask]:
    """Return which features of each photo are at the same place in many others, with a like descriptor.

    Args:
        places: Pixels of the features of each photo, shape (feature, 2).
        descriptors: Their descriptors, shape (feature, 128), each of the same length.

    Returns:
        Shape (feature,) for each photo.
    """
    trees = [KDTree(place) if len(place) else None for place in places]
    units = [_unit(np.asarray(one, np.float32)) for one in descriptors]
    found = []
    for k, place in enumerate(places):
        count = np.zeros(len(place), np.int64)
        for other, tree in enumerate(trees):
            if other == k or tree is None or not len(place):
                continue
            near = np.asarray(tree.query(place, distance_upper_bound=_SAME_PLACE_PX)[1])
            there = np.flatnonzero(near < len(places[other]))
            alike = np.einsum("ij,ij->i", units[k][there], units[other][near[there]]) > _ALIKE
            count[there[alike]] += 1
        found.append(count >= max(_STANDING_IN * (len(places) - 1), 2))
    return found


def _unit(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2), np.uint8)
