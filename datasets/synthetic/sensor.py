"""Camera model: exposure, white balance and noise (JPEG compression is applied on writing)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

READ_NOISE = 0.006
"""Standard deviation of the noise in the dark, on values in [0, 1]."""
SHOT_NOISE = 0.0003
"""Variance of the noise per unit of brightness."""


def expose(
    radiance: NDArray[np.float32], gain_rgb: tuple[float, float, float], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Convert ideal colours to the 8-bit values of a sensor.

    The noise has variance READ_NOISE² + SHOT_NOISE · value, the usual affine model of sensor noise.

    Args:
        radiance: Ideal colours, [0, 1] where well exposed, shape (height, width, 3).
        gain_rgb: Exposure gain of the camera, by channel.
        rng: Source of the noise.

    Returns:
        Image, uint8 (height, width, 3).
    """
    value = radiance * np.asarray(gain_rgb, np.float32)
    sigma = np.sqrt(READ_NOISE**2 + SHOT_NOISE * value)
    value = value + sigma * rng.standard_normal(value.shape, np.float32)
    return (value.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def draw_gain(rng: np.random.Generator, exposure: float) -> tuple[float, float, float]:
    """Draw the gain of a camera: exposure, and a white balance with an error of about 2 % in each channel."""
    red, green, blue = np.round(exposure * (1 + 0.02 * rng.standard_normal(3)), 4)
    return float(red), float(green), float(blue)
