"""Images for reports: strips of real and predicted frames, contact sheets, false-colour depth and masks."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.images import encoded_image

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]

TILE_WIDTH = 264
"""Width of a frame in a report [px]; six fit side by side on a page of 1100 px."""
MAX_SIDE = 4096
"""Longest side of a picture that is placed frame by frame [px]: some browsers show a longer one, which is no texture of
their GPU, blank."""
SHEET_BYTES = 3_000_000
"""Maximum size of a contact sheet in a model [bytes]."""
PNG_LEVEL = 6
"""Effort of compression: 9 takes six times as long for 3 % fewer bytes."""
_ASPECT = 4 / 3
_MARGIN = 0.2
_COLUMNS = 4
_OUTLINE = (255, 214, 10)
_LABEL_COLORS = np.array([[32, 36, 44], [240, 165, 40], [70, 160, 220], [120, 200, 120], [220, 110, 150]], np.uint8)


@dataclass(frozen=True, kw_only=True)
class FrameStrip:
    """Frames of one episode from one camera."""

    episode: str
    """Name of the episode."""
    camera: str
    """Name of the video camera."""
    times_s: NDArray[np.float64]
    """Times of the frames [s], shape (T,)."""
    real: Image
    """Real frames, uint8 RGB, shape (T, H, W, 3)."""
    predicted: Image
    """Renders of the model at the same times, same shape."""
    masks: Image | None = None
    """True masks, 0 for the background, shape (T, H, W); None where they are unknown."""


@dataclass(frozen=True, kw_only=True)
class RolloutTile:
    """One moment of one synthesized rollout."""

    rollout: int
    """Number of the rollout."""
    time_s: float
    """Time [s]."""
    image: Image
    """uint8 RGB, shape (H, W, 3)."""
    depth_m: NDArray[np.float32]
    """Depth [m], 0 without a surface, shape (H, W)."""
    mask: Image
    """Labels of the bodies, shape (H, W)."""


def tiles(strip: FrameStrip, width: int = TILE_WIDTH, outlined: bool = True) -> tuple[Image, Image]:
    """Return the real and the predicted frames, cropped to the motion of the object and resized to `width` pixels.

    If `outlined` and masks are known, the outline of the true mask is drawn on the predicted frames.

    Returns:
        Two arrays, uint8 RGB, shape (T, 3/4 width, width, 3).
    """
    x, y, w, h = _window(strip)
    size = (width, round(width / _ASPECT))
    cut = (slice(None), slice(y, y + h), slice(x, x + w))
    real = np.stack([resized(frame, size) for frame in strip.real[cut]])
    predicted = np.stack([resized(frame, size) for frame in strip.predicted[cut]])
    if outlined and strip.masks is not None:
        for frame, mask in zip(predicted, strip.masks[cut], strict=True):
            _outline(frame, mask)
    return real, predicted


def telling(strip: FrameStrip, wanted: int) -> list[int]:
    """Return frame numbers between which the object moves about equally far, evenly spread without masks."""
    if strip.masks is None:
        return evenly(len(strip.real), wanted)
    seen = strip.masks > 0
    changed = (seen[1:] != seen[:-1]).sum((1, 2)) / max(1.0, float(seen.sum((1, 2)).mean()))
    # A small constant is added for an object at rest, so that its final pose is included.
    way = np.concatenate([[0.0], np.cumsum(changed + 0.05)])
    return [int(k) for k in np.unique(np.searchsorted(way, np.linspace(0, way[-1], wanted)))]


def evenly(count: int, wanted: int) -> list[int]:
    """Return `wanted` frame numbers spread evenly over `count` frames, including the first and the last.

    >>> evenly(36, 6)
    [0, 7, 14, 21, 28, 35]
    """
    return [int(k) for k in np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))]


def columns_and_rows(count: int, width: int) -> tuple[int, int]:
    """Return how `sprite` arranges frames: in as few rows as keep it at most `MAX_SIDE` wide."""
    columns = max(1, min(count, MAX_SIDE // width))
    return columns, -(-count // columns)


def sprite(frames: Image) -> Image:
    """Arrange frames (T, H, W, 3) in rows without gutters; the last row may end black."""
    count, height, width = frames.shape[:3]
    columns, rows = columns_and_rows(count, width)
    filled = np.concatenate([frames, np.zeros((rows * columns - count, height, width, 3), np.uint8)])
    return filled.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)


def contact_sheet(rows: Sequence[Image], gutter: int = 4) -> Image:
    """Arrange rows of equal length, each (T, H, W, 3), below each other with white gutters."""
    count, height, width = rows[0].shape[:3]
    sheet = np.full((len(rows) * (height + gutter) - gutter, count * (width + gutter) - gutter, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for k, frame in enumerate(row):
            top, left = i * (height + gutter), k * (width + gutter)
            sheet[top : top + height, left : left + width] = frame
    return sheet


def compared(photos: Sequence[Image], renders: Sequence[Image], wanted: int = 8, width: int = TILE_WIDTH) -> Image:
    """Return a contact sheet with rows of photos, renders and errors.

    The error is the mean difference of the channels in false colour (magma), saturated at a quarter of full scale.

    Args:
        photos: uint8 RGB, each (H, W, 3); sizes may differ.
        renders: Renders of the same sizes.
        wanted: Maximum number of columns.
        width: Width of a tile [px]; its height is that of the first photo at this width.
    """
    chosen = evenly(len(photos), wanted)
    size = (width, round(width * photos[chosen[0]].shape[0] / photos[chosen[0]].shape[1]))
    rows: list[list[Image]] = [[], [], []]
    for k in chosen:
        error = np.abs(photos[k].astype(np.float32) - renders[k]).mean(-1)
        colors = cv2.applyColorMap((error * 4).clip(0, 255).astype(np.uint8), cv2.COLORMAP_MAGMA)[..., ::-1]
        for row, picture in zip(rows, (photos[k], renders[k], np.asarray(colors, np.uint8)), strict=True):
            row.append(_fitted(picture, size))
    return contact_sheet([np.stack(row) for row in rows])


def separated(photos: Sequence[Image], masks: Sequence[Mask], wanted: int = 12, width: int = TILE_WIDTH) -> Image:
    """Return a contact sheet of photos, four per row, with outlined bodies on a dimmed background.

    Args:
        photos: uint8 RGB, each (H, W, 3); sizes may differ.
        masks: Whether each pixel shows a body, (H, W).
        wanted: Maximum number of photos.
        width: Width of a tile [px]; its height is that of the first photo at this width.
    """
    chosen = evenly(len(photos), wanted)
    size = (width, round(width * photos[chosen[0]].shape[0] / photos[chosen[0]].shape[1]))
    found: list[Image] = []
    for k in chosen:
        picture = np.where(masks[k][..., None], photos[k], photos[k] // 3)
        _outline(picture, masks[k].astype(np.uint8))
        found.append(_fitted(picture, size))
    columns = min(_COLUMNS, len(found))
    found += [np.full_like(found[0], 255)] * (-len(found) % columns)
    return contact_sheet([np.stack(found[k : k + columns]) for k in range(0, len(found), columns)])


def depth_colors(depth_m: NDArray[np.float32], near_m: float, far_m: float) -> Image:
    """Return depth (H, W) [m] in false colour (H, W, 3): viridis, near bright, black without a surface."""
    place = np.clip((far_m - depth_m) / max(far_m - near_m, 1e-9), 0, 1)
    colors = cv2.applyColorMap((255 * place).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    colors[depth_m <= 0] = 0
    return np.asarray(colors, np.uint8)


def label_colors(labels: Image) -> Image:
    """Return a mask (H, W) in colours (H, W, 3), one per body on a dark background."""
    return _LABEL_COLORS[np.where(labels == 0, 0, (labels.astype(int) - 1) % (len(_LABEL_COLORS) - 1) + 1)]


def jpeg_uri(image: Image, quality: int = 78) -> str:
    """Return an RGB image as a data URI (JPEG)."""
    return _uri(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality], "image/jpeg")


def png_uri(image: Image) -> str:
    """Return an RGB image as a data URI (PNG)."""
    return _uri(image, ".png", [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL], "image/png")


def encoded(image: Image, suffix: str, options: Sequence[int] = ()) -> bytes:
    """Encode an RGB image in OpenCV's format for a suffix, ".png" or ".jpg"."""
    return encoded_image(suffix, np.ascontiguousarray(image[..., ::-1]), options).tobytes()


def small_png(image: Image, most_bytes: int = 400_000) -> bytes:
    """Encode an RGB image as PNG below a size, with as many grey levels and pixels as fit."""
    for bits in range(8, 3, -1):
        step = 1 << (8 - bits)
        reduced = image if bits == 8 else np.minimum(cv2.medianBlur(image, 3) // step * step + step // 2, 255)
        data = encoded(np.asarray(reduced, np.uint8), ".png", [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
        if len(data) <= most_bytes:
            return data
    height, width = image.shape[:2]
    return small_png(resized(image, (round(0.8 * width), round(0.8 * height))), most_bytes)


def resized(image: Image, size: tuple[int, int]) -> Image:
    """Resize an image to (width, height) [px], by area averaging if it shrinks and linear interpolation otherwise."""
    shrinks = size[0] < image.shape[1]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8)


def _window(strip: FrameStrip) -> tuple[int, int, int, int]:
    """Return left, top, width, height [px] of the region in which the object moves, at the tiles' aspect ratio."""
    height, width = strip.real.shape[1:3]
    if strip.masks is None or not strip.masks.any():
        low, high = np.zeros(2), np.array([width, height], float)
    else:
        seen = (strip.masks > 0).any(0)
        rows, columns = np.nonzero(seen)
        low, high = np.array([columns.min(), rows.min()], float), np.array([columns.max() + 1, rows.max() + 1], float)
    middle, extent = (low + high) / 2, (high - low) * (1 + 2 * _MARGIN)
    w = min(max(extent[0], extent[1] * _ASPECT), width, height * _ASPECT)
    h = w / _ASPECT
    left = int(np.clip(middle[0] - w / 2, 0, width - w))
    top = int(np.clip(middle[1] - h / 2, 0, height - h))
    return left, top, int(w), int(h)


def _outline(frame: Image, mask: Image) -> None:
    """Draw the outline of a mask onto a frame, in place; their sizes may differ."""
    height, width = frame.shape[:2]
    reduced = cv2.resize((mask > 0).astype(np.uint8), (width, height), interpolation=cv2.INTER_AREA)
    contours, _ = cv2.findContours(reduced, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(frame, contours, -1, _OUTLINE, 1, cv2.LINE_AA)


def _fitted(image: Image, size: tuple[int, int]) -> Image:
    """Resize an image to fit into a tile (width, height) [px], with white margins."""
    scale = min(size[0] / image.shape[1], size[1] / image.shape[0])
    small = resized(image, (max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0]))))
    tile = np.full((size[1], size[0], 3), 255, np.uint8)
    top, left = (size[1] - small.shape[0]) // 2, (size[0] - small.shape[1]) // 2
    tile[top : top + small.shape[0], left : left + small.shape[1]] = small
    return tile


def _uri(image: Image, suffix: str, options: list[int], kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(encoded(image, suffix, options)).decode('ascii')}"
