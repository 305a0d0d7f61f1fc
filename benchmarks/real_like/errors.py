"""What real-like tracks carry. THE LIST IS FIXED: no threshold of `cgwm diagnose` was tuned before it was.

White noise and a slow error are in every capture; one to four of the other five are drawn beside them:

- slow: errors correlated over 5 to 50 ms, 0.2 to 0.8 mm for each coordinate and 0.05 to 0.3 degrees about each axis,
  of one of two kinds: Ornstein and Uhlenbeck's (not differentiable) or Matern's of order 3/2 (once differentiable);
- bursts: one to three in an episode, of 20 to 80 ms, 1 to 5 mm and 0.5 to 2 degrees;
- tilt: each episode is turned about a horizontal axis through the world's origin, by 2 to 10 mrad about x and y;
- height: each episode is shifted upwards, by 0.2 to 0.5 mm;
- scale: each of two sessions has its own scale of lengths, off by 0.3 to 1 %;
- hand: 30 to 120 ms before the release are recorded, the body carried by a hand (dropped bodies are held still);
- smoothed: tracks were smoothed, by parabolas over 5 to 11 frames (Savitzky & Golay 1964) or by a Butterworth low pass
  of second order, run forwards and backwards, at 12 to 40 Hz but at most 0.35 of the frame rate.

Ranges are of standard deviations, drawn log-uniformly once for a capture; the values of an episode or session are
normal. Nothing of `cgwm.pipeline` is used here.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from cgwm.datasets.synthetic.hidden_effects.rotation import turn
from cgwm.datasets.synthetic.hidden_effects.things import Array

Rng = np.random.Generator
OPTIONAL = ("bursts", "tilt", "height", "scale", "hand", "smoothed")
"""Errors beside white noise and the slow one; tilt and height count as one in the draw, and exclude each other."""
SESSIONS = ("a", "b")


@dataclass(frozen=True, kw_only=True)
class Errors:
    """The errors of one capture; standard deviations, 0 for what it does not carry.

    white_m, slow_m, burst_m: of each coordinate; white_rad, slow_rad, burst_rad: about each body axis; slow_s:
    correlation time; slow_kind: see above; tilt_rad, height_m: of each episode; scale: of each session; hand: whether
    a hand is recorded; window: frames of the smoothing parabolas; cutoff_hz: of the low pass.
    """

    white_m: float
    white_rad: float
    slow_m: float
    slow_rad: float
    slow_s: float
    slow_kind: Literal["ou", "matern"]
    burst_m: float = 0.0
    burst_rad: float = 0.0
    tilt_rad: float = 0.0
    height_m: float = 0.0
    scale: float = 0.0
    hand: bool = False
    window: int = 0
    cutoff_hz: float = 0.0

    def carried(self) -> list[str]:
        """Return the names of the errors that the capture carries."""
        own = {"bursts": self.burst_m, "tilt": self.tilt_rad, "height": self.height_m, "scale": self.scale}
        own |= {"hand": self.hand, "smoothed": self.window or self.cutoff_hz}
        return ["slow", *(name for name in OPTIONAL if own[name])]

    def facts(self) -> dict[str, Any]:
        """Return all numbers for the truth."""
        return {"carried": self.carried(), **asdict(self)}


def draw_errors(rng: Rng, rate_hz: float) -> Errors:
    """Draw the errors of a capture."""
    level = ("tilt", "height")[int(rng.integers(2))]
    choices = ["bursts", level, "scale", "hand", "smoothed"]
    chosen = set(rng.permutation(choices)[: int(rng.integers(1, 5))].tolist())
    low_pass = rng.uniform() < 0.5
    drawn: dict[str, float] = {
        "white_m": between(rng, 0.05e-3, 0.3e-3),
        "white_rad": between(rng, np.radians(0.03), np.radians(0.15)),
        "slow_m": between(rng, 0.2e-3, 0.8e-3),
        "slow_rad": between(rng, np.radians(0.05), np.radians(0.3)),
        "slow_s": between(rng, 0.005, 0.05),
    }
    optional: dict[str, float] = {
        "burst_m": between(rng, 1e-3, 5e-3),
        "burst_rad": between(rng, np.radians(0.5), np.radians(2.0)),
        "tilt_rad": between(rng, 2e-3, 1e-2),
        "height_m": between(rng, 0.2e-3, 0.5e-3),
        "scale": between(rng, 0.003, 0.01),
    }
    of = {"burst_m": "bursts", "burst_rad": "bursts", "tilt_rad": "tilt", "height_m": "height", "scale": "scale"}
    window, cutoff_hz = 2 * int(rng.integers(2, 6)) + 1, min(between(rng, 12.0, 40.0), 0.35 * rate_hz)
    smoothed = "smoothed" in chosen
    return Errors(
        **drawn,
        **{key: value for key, value in optional.items() if of[key] in chosen},
        slow_kind="ou" if rng.uniform() < 0.5 else "matern",
        hand="hand" in chosen,
        window=window if smoothed and not low_pass else 0,
        cutoff_hz=cutoff_hz if smoothed and low_pass else 0.0,
    )


def between(rng: Rng, low: float, high: float) -> float:
    """Draw log-uniformly."""
    return float(low * (high / low) ** rng.uniform())


def session_scales(errors: Errors, rng: Rng) -> dict[str, float]:
    """Return for each session measured over true lengths."""
    return {name: 1.0 + errors.scale * float(rng.standard_normal()) for name in SESSIONS}


def seen(errors: Errors, position: Array, rotation: Array, scale: float, rng: Rng) -> tuple[Array, Array, Any]:
    """Return positions and rotations as the tracking system of an episode places them, and what it did.

    Args:
        errors: Of the capture.
        position: True, (T, 3).
        rotation: True, body to world (T, 3, 3).
        scale: Of the session.
        rng: Of the episode.
    """
    tilt, height = errors.tilt_rad * rng.standard_normal(2), errors.height_m * float(rng.standard_normal())
    matrix = turn(np.array([tilt[0], tilt[1], 0.0]))
    placed = scale * position @ matrix.T + (0.0, 0.0, height)
    return placed, matrix @ rotation, {"tilt_rad": tilt.tolist(), "height_m": height, "scale": scale}


def noise(errors: Errors, times_s: Array, rng: Rng) -> tuple[Array, Array, Any]:
    """Return the errors of positions (T, 3) [m] and rotation vectors (T, 3) [rad], and the bursts' times [s]."""
    root = _root(times_s, errors.slow_s, errors.slow_kind)
    count = len(times_s)
    metres = errors.white_m * rng.standard_normal((count, 3)) + errors.slow_m * root @ rng.standard_normal((count, 3))
    angles = errors.white_rad * rng.standard_normal((count, 3))
    angles += errors.slow_rad * root @ rng.standard_normal((count, 3))
    bursts = []
    for _ in range(int(rng.integers(1, 4)) if errors.burst_m else 0):
        width = rng.uniform(0.02, 0.08)
        begin = rng.uniform(times_s[0], max(times_s[-1] - width, times_s[0]))
        inside = (times_s >= begin) & (times_s <= begin + width)
        bursts.append([float(begin), float(begin + width)])
        metres[inside] += errors.burst_m * rng.standard_normal((int(inside.sum()), 3))
        angles[inside] += errors.burst_rad * rng.standard_normal((int(inside.sum()), 3))
    return metres, angles, bursts


def smooth(errors: Errors, values: Array, rate_hz: float) -> Array:
    """Return rows (T, n), smoothed if the capture is."""
    from scipy.signal import butter, filtfilt, savgol_filter

    if errors.window:
        return np.asarray(savgol_filter(values, errors.window, 2, axis=0))
    if errors.cutoff_hz:
        coefficients: Any = butter(2, errors.cutoff_hz, fs=rate_hz)
        b, a = coefficients
        return np.asarray(filtfilt(b, a, values, axis=0), float)
    return values


def _root(times_s: Array, scale_s: float, kind: str) -> Array:
    """Return a root (T, T) of the correlation of slow errors."""
    return np.asarray(np.linalg.cholesky(slow_correlation(times_s, scale_s, kind) + 1e-9 * np.eye(len(times_s))), float)


def slow_correlation(times_s: Array, scale_s: float, kind: str) -> Array:
    """Return the correlation (T, T) of slow errors at times [s]."""
    apart = np.abs(times_s[:, None] - times_s) / scale_s
    if kind == "matern":
        apart = np.sqrt(3.0) * apart
        return (1 + apart) * np.exp(-apart)
    return np.exp(-apart)
