"""Photos of the calibration target through a known camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from cgwm.pipeline.calibrate.target.board import COLUMNS, ROWS, SHEET_MM, SQUARE_MM, black_rectangles

WIDTH, HEIGHT, FOCAL = 640, 480, 600.0
K = np.array([[FOCAL, 0, 330.0], [0, FOCAL, 236.0], [0, 0, 1.0]])
"""In OpenCV's pixels, whose first centre is (0, 0)."""
LENS = np.array([-0.12, 0.05, 0.0, 0.0])
SCALE = 4
"""Pixels of the drawn sheet in a millimetre."""


def sheet() -> np.ndarray:
    """Return the sheet as it is printed, uint8."""
    image = np.full((round(SHEET_MM[1] * SCALE), round(SHEET_MM[0] * SCALE)), 255, np.uint8)
    for x, y, w, h in black_rectangles():
        image[round(y * SCALE) : round((y + h) * SCALE), round(x * SCALE) : round((x + w) * SCALE)] = 0
    return image


def poses(count: int, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rotation vectors and shifts [mm] of the board: tilted to all sides, and everywhere in the picture."""
    rng = np.random.default_rng(seed)
    middle = np.array([0.5 * COLUMNS * SQUARE_MM, 0.5 * ROWS * SQUARE_MM, 0.0])
    found = []
    for k in range(count):
        angle = 2 * np.pi * k / count + rng.normal(0, 0.1)
        turn = 0.6 * np.array([np.cos(angle), np.sin(angle), 0.2 * rng.normal()])
        way = np.array([70 * np.cos(2 * angle), 55 * np.sin(2 * angle), 340 + 30 * rng.normal()])
        found.append((turn, way - cv2.Rodrigues(turn)[0] @ middle))
    return found


def write_photos(folder: Path, count: int, seed: int = 0) -> None:
    """Write photos of the board with noise, as PNG."""
    folder.mkdir(parents=True)
    drawn, rng = sheet(), np.random.default_rng(seed)
    margin = 0.5 * (np.array(SHEET_MM) - [COLUMNS * SQUARE_MM, ROWS * SQUARE_MM])
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).reshape(-1, 1, 2).astype(float)
    rays = cv2.undistortPoints(pixels, K, LENS).reshape(-1, 2)
    for k, (turn, shift) in enumerate(poses(count, seed)):
        to_camera = np.column_stack([cv2.Rodrigues(turn)[0][:, :2], shift])
        flat = np.column_stack([rays, np.ones(len(rays))]) @ np.linalg.inv(to_camera).T
        places = (flat[:, :2] / flat[:, 2:] + margin) * SCALE - 0.5
        maps = places.reshape(HEIGHT, WIDTH, 2).astype(np.float32)
        image = cv2.remap(drawn, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=200)
        noisy = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 2, image.shape)
        cv2.imwrite(str(folder / f"{k:02d}.png"), noisy.clip(0, 255).astype(np.uint8))
