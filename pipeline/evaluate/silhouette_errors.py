"""Errors of a predicted silhouette against a mask: overlap, centroids, and distance of the outlines."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteErrors:
    """Errors of the silhouettes of the nf free bodies in F frames of one camera; NaN where a body is not in sight."""

    iou: Array
    """Intersection over union, shape (F, nf); NaN where neither the mask nor the prediction has a pixel."""
    centroid_px: Array
    """Distance of the centroids [px], shape (F, nf); NaN where one of the two is missing."""
    outline_px: Array
    """Mean distance of the points of either outline from the other [px], shape (F, nf)."""
    real_centroids: Array
    """Centroids (x, y) of the masks [px], shape (F, nf, 2); NaN where the edge of the picture cuts the mask."""
    predicted_centroids: Array
    """Centroids of the predicted silhouettes, the same."""


def silhouette_errors(
    real: NDArray[np.uint8], predicted: NDArray[np.uint8], valid: Mask, bodies: int
) -> SilhouetteErrors:
    """Compare the masks of a camera's frames with the predicted silhouettes.

    Args:
        real: 0, or k for the k-th free body, counted from 1, by the masks, shape (F, H, W).
        predicted: The same by the prediction.
        valid: Pixels that the original frames cover, shape (H, W).
        bodies: Number nf of free bodies.
    """
    frames = len(real)
    figures = np.full((3, frames, bodies), np.nan)
    centroids = np.full((2, frames, bodies, 2), np.nan)
    inside = cv2.erode(valid.astype(np.uint8), np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    for body in range(bodies):
        for frame in range(frames):
            cut = _around(real[frame] == body + 1, predicted[frame] == body + 1)
            if cut is None:
                continue
            pair = [(labels[frame][cut] == body + 1) & valid[cut] for labels in (real, predicted)]
            figures[:, frame, body] = _pair_errors(*pair)
            corner = (cut[1].start, cut[0].start)
            for kind, mask in enumerate(pair):
                if mask.any() and not (mask & ~inside[cut]).any():
                    centroids[kind, frame, body] = _centroid(mask) + corner
    return SilhouetteErrors(
        iou=figures[0],
        centroid_px=figures[1],
        outline_px=figures[2],
        real_centroids=centroids[0],
        predicted_centroids=centroids[1],
    )


def _around(a: Mask, b: Mask) -> tuple[slice, slice] | None:
    """Return the rectangle (rows, columns) around two masks, grown by a pixel; None if both are empty."""
    x, y, width, height = cv2.boundingRect((a | b).view(np.uint8))
    if width == 0:
        return None
    return slice(max(y - 1, 0), y + height + 1), slice(max(x - 1, 0), x + width + 1)


def _pair_errors(real: Mask, predicted: Mask) -> tuple[float, float, float]:
    """Return intersection over union, and the distances of centroids and outlines [px], of two masks (H, W)."""
    union = int((real | predicted).sum())
    if union == 0:
        return float("nan"), float("nan"), float("nan")
    iou = int((real & predicted).sum()) / union
    if not real.any() or not predicted.any():
        return iou, float("nan"), float("nan")
    apart = float(np.linalg.norm(_centroid(real) - _centroid(predicted)))
    return iou, apart, _outline_distance(real, predicted)


def _centroid(mask: Mask) -> Array:
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) + 0.5  # the top-left pixel's centre is (0.5, 0.5)


def _outline_distance(a: Mask, b: Mask) -> float:
    """Return the mean distance of the pixels of either outline from the nearest of the other [px]."""
    outlines = [_outline(mask) for mask in (a, b)]
    away = [
        cv2.distanceTransform((~outline).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for outline in outlines
    ]
    return float(0.5 * (away[1][outlines[0]].mean() + away[0][outlines[1]].mean()))


def _outline(mask: Mask) -> Mask:
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return mask & (inner == 0)
