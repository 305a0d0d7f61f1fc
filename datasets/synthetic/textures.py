"""Procedural textures: seeded, rich in blobs and corners, and band-limited to their resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]
Floats = NDArray[np.float32]
_REMAP_WIDTH = 8192  # cv2.remap accepts sides up to 32767, so that points are arranged in rows
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


@dataclass(frozen=True)
class Sheet:
    """A flat printed sheet with its mip levels, sampled at metric coordinates.

    Args:
        levels: Colours in [0, 255], uint8 (row, column, 3), each level half as fine as the one before.
        texel: Side of a texel of level 0 [m].
        half: Half the side of the sheet [m]; u runs right and v up from its centre.
    """

    levels: tuple[NDArray[np.uint8], ...]
    texel: float
    half: float

    def sample(self, uv: Floats, footprint: Floats) -> Floats:
        """Return colours in [0, 1], shape (point, 3).

        Args:
            uv: Coordinates on the sheet [m], shape (point, 2); outside of the sheet the colour of its edge.
            footprint: Width that one ray covers on the surface [m], shape (point,).
        """
        level = np.log2(np.maximum(footprint, 1e-9) / self.texel).clip(0, len(self.levels) - 1)
        lower = np.minimum(level.astype(np.int32), len(self.levels) - 2)
        blend = (level - lower).astype(np.float32)[:, None]
        colours = np.empty((len(uv), 3), np.float32)
        for index in np.unique(lower):
            chosen = np.flatnonzero(lower == index)
            fine, coarse = (self._lookup(uv[chosen], int(index) + step) for step in (0, 1))
            colours[chosen] = fine + blend[chosen] * (coarse - fine)
        return colours

    def _lookup(self, uv: Floats, level: int) -> Floats:
        size = self.texel * 2**level
        column = (uv[:, 0] + self.half) / size - 0.5
        row = (self.half - uv[:, 1]) / size - 0.5
        width = min(len(uv), _REMAP_WIDTH)
        rows = -(-len(uv) // width)
        padded = np.zeros((2, rows * width), np.float32)
        padded[0, : len(uv)], padded[1, : len(uv)] = column, row
        maps = padded.reshape(2, rows, width)
        image = cv2.remap(self.levels[level], maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(image, np.float32).reshape(-1, 3)[: len(uv)] / np.float32(255)


def make_sheet(image: NDArray[np.uint8], side: float) -> Sheet:
    """Return the sheet of a square image with a given side [m], with mip levels by area averaging."""
    levels = [image]
    while len(levels[-1]) >= 16:
        size = len(levels[-1]) // 2
        levels.append(np.asarray(cv2.resize(levels[-1], (size, size), interpolation=cv2.INTER_AREA), np.uint8))
    return Sheet(tuple(levels), side / len(image), side / 2)


def paint(
    rng: np.random.Generator,
    pixels: int,
    side: float,
    palette: Sequence[Colour],
    spots_per_m2: float,
    spot_radius: tuple[float, float],
) -> NDArray[np.uint8]:
    """Paint a square: cloudy base colour, specks and angular patches in several tones.

    Args:
        rng: Source of randomness.
        pixels: Side of the image [px].
        side: Side of the painted square [m].
        palette: Colours in [0, 1]; the first is the base.
        spots_per_m2: Number of specks and patches per square metre.
        spot_radius: Smallest and largest radius of a speck [m]; small ones are more frequent.

    Returns:
        Colours in [0, 255], uint8 (pixels, pixels, 3).
    """
    per_m = pixels / side
    canvas = np.full((pixels, pixels, 3), np.array(palette[0]) * 255, np.uint8)
    count = int(spots_per_m2 * side * side)
    low, high = spot_radius
    radii = np.sort(low * (high / low) ** (rng.random(count) ** 1.5))[::-1] * per_m
    tones = np.array(palette)[rng.integers(len(palette), size=count)] * rng.uniform(0.75, 1.25, (count, 1))
    colours = (tones * 255).clip(8, 240).round()
    for outline, colour in zip(_outlines(rng, radii, pixels), colours, strict=True):
        cv2.fillPoly(canvas, [outline], colour.tolist(), cv2.LINE_AA, _SHIFT)
    noise = sum(
        (0.5**octave * _value_noise(rng, pixels, max(2, round(side / (0.06 / 2**octave)))) for octave in range(4)),
        np.zeros((pixels, pixels), np.float32),
    )
    gain = 1 + np.float32(0.16) * noise
    for channel in range(3):
        # Less than a texel of blur keeps edges below the sampling limit of level 0.
        shaded = cv2.GaussianBlur(canvas[..., channel] * gain, (0, 0), 0.7)
        canvas[..., channel] = (shaded.clip(5, 245) + 0.5).astype(np.uint8)
    return canvas


def _outlines(rng: np.random.Generator, radii_px: NDArray[np.float64], pixels: int) -> list[NDArray[np.int32]]:
    """Draw ellipses and irregular polygons of given radii at random places, in OpenCV's fixed-point pixels."""
    count = len(radii_px)
    centres, stretch = rng.uniform(0, pixels, (count, 1, 2)), rng.uniform(0.6, 1.0, (count, 1, 2))
    corners = np.where(rng.random(count) < 0.6, rng.integers(3, 7, count), 16)
    outlines: list[NDArray[np.int32]] = [np.zeros((0, 2), np.int32)] * count
    for number in (3, 4, 5, 6, 16):
        chosen = np.flatnonzero(corners == number)
        angles = np.tile(np.linspace(0, 2 * np.pi, 16, endpoint=False), (len(chosen), 1))
        if number < 16:
            angles = np.sort(rng.uniform(0, 2 * np.pi, (len(chosen), number)), axis=1)
        rim = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * stretch[chosen] * radii_px[chosen, None, None]
        fixed = np.round((centres[chosen] + rim) * 2**_SHIFT).astype(np.int32)
        for index, outline in zip(chosen, fixed, strict=True):
            outlines[index] = outline
    return outlines


def _value_noise(rng: np.random.Generator, pixels: int, cells: int) -> Floats:
    lattice = rng.uniform(-1, 1, (cells, cells)).astype(np.float32)
    return np.asarray(cv2.resize(lattice, (pixels, pixels), interpolation=cv2.INTER_CUBIC), np.float32)


def paste_marker(
    image: NDArray[np.uint8], side: float, code: NDArray[np.uint8], marker_side: float, T_sheet_marker: NDArray
) -> None:
    """Print a marker with a white margin of one module onto the image of a sheet, in place.

    Args:
        image: The sheet's image, uint8 (row, column, 3).
        side: Side of the sheet [m].
        code: Black (0) and white (255) modules with the black border, uint8 (module, module).
        marker_side: Side of the black square [m].
        T_sheet_marker: Pose of the marker (x right, y up as printed) on the sheet, shape (4, 4).
    """
    modules = len(code)
    card = np.pad(code, 1, constant_values=255)
    texel = side / len(image)
    centre = T_sheet_marker[:2, 3]
    reach = marker_side * (modules + 2) / modules * 0.75
    column, row = ((centre[0] + side / 2) / texel, (side / 2 - centre[1]) / texel)
    first = int(row - reach / texel), int(column - reach / texel)
    count = int(np.ceil(2 * reach / texel))
    fine = (np.arange(count * 4) + 0.5) / 4 * texel
    x, y = np.meshgrid(first[1] * texel - side / 2 + fine, side / 2 - first[0] * texel - fine)
    local = np.stack([x, y], axis=-1) - centre
    local = local @ T_sheet_marker[:2, :2]
    module = np.floor(local / marker_side * modules + modules / 2 + 1).astype(int)
    inside = ((module >= 0) & (module < modules + 2)).all(axis=-1)
    i, j = (modules + 1 - module[..., 1]).clip(0, modules + 1), module[..., 0].clip(0, modules + 1)
    value = np.where(card[i, j] > 0, 225.0, 18.0)
    block = (count, 4, count, 4)
    cover = inside.reshape(block).mean(axis=(1, 3))[..., None]
    ink = (inside * value).reshape(block).mean(axis=(1, 3))[..., None]
    rows, columns = slice(first[0], first[0] + count), slice(first[1], first[1] + count)
    image[rows, columns] = (ink + (1 - cover) * image[rows, columns] + 0.5).astype(np.uint8)
