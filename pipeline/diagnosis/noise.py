"""The noise of the tracks, measured on flight without any model, and the frames that are no measurement at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..estimation.noise import FLOOR_M, FLOOR_RAD, MAD_TO_STD
from ..estimation.observations import Observations
from ..physics.rotation import quat_conjugate, quat_log, quat_multiply
from .cuts import Segment

WINDOW = 9
"""Frames of a window that a cubic follows in free flight: 0.09 s at 100 Hz, within 0.1 mm for 6 mm at 20 rad/s."""
DEGREE = 3
OUTLIER_SIGMAS = 6.0
"""A frame so far from the cubic through the others of its window is no measurement: 2e-9 of normal ones lie there."""
KEEP_SIGMAS = 4.0
ENOUGH = 60
"""So few residuals give a standard deviation within 10 %."""


def flight_noise(whole: Observations, flight: Sequence[Segment]) -> tuple[float | None, float | None]:
    """Return the standard deviations of position [m] and rotation [rad], per axis; None where too little is flight.

    Each window of consecutive frames is fitted by a cubic; residuals are scaled to the same variance, those beyond
    `KEEP_SIGMAS` of a first, robust estimate are left out.
    """
    position, rotation = _residuals(whole, flight)
    return _spread(position, FLOOR_M), _spread(rotation, FLOOR_RAD)


def without_outliers(
    whole: Observations, flight: Sequence[Segment], noise: tuple[float, float]
) -> tuple[Observations, int, Tensor]:
    """Return the episodes without wrong measurements in flight, how many there were, and where flight is none.

    A single frame off the cubic through its neighbours is a wrong measurement, and marked as not seen. Where the
    others of a window do not lie on a cubic either, something touched: a bounce on a ground that is not where it was
    said to be, or a hand.

    Returns:
        The episodes; the number of wrong measurements; frames (E, T) of flight in which something touched.
    """
    seen, turned = whole.seen.clone(), whole.turned.clone()
    kinked = torch.zeros_like(seen[..., 0], dtype=torch.bool)
    wrong: set[tuple[int, int, int, int]] = set()
    for kind in (0, 1):
        for segment, column, frames, away in _windows(whole, flight, kind, step=1):
            size = np.abs(away).max(1) / noise[kind]
            if size.max() <= OUTLIER_SIGMAS:
                continue
            worst = int(size.argmax())
            rest = torch.as_tensor(np.delete(frames, worst))
            left = _cubic(whole, segment.episode, column, rest, kind)
            if np.abs(left).max() / noise[kind] <= OUTLIER_SIGMAS:
                wrong.add((kind, segment.episode, int(frames[worst]), column))
            else:
                kinked[segment.episode, torch.as_tensor(frames)] = True
    count = 0
    for kind, episode, frame, column in wrong:
        if not bool(kinked[episode, frame]):
            (seen, turned)[kind][episode, frame, column] = 0.0
            count += 1
    return replace(whole, seen=seen, turned=turned), count, kinked


def _residuals(whole: Observations, flight: Sequence[Segment]) -> tuple[np.ndarray, np.ndarray]:
    found = []
    for kind in (0, 1):
        parts = [away.ravel() for _, _, _, away in _windows(whole, flight, kind, step=WINDOW // 2)]
        found.append(np.concatenate(parts) if parts else np.zeros(0))
    return found[0], found[1]


def _windows(whole: Observations, flight: Sequence[Segment], kind: int, step: int = 2):
    """Yield segment, body, frames and standardised residuals (n, 3) [m or rad] of a cubic, window by window."""
    mask = (whole.seen, whole.turned)[kind]
    for segment in flight:
        for column in range(len(whole.free)):
            frames = torch.arange(segment.first, segment.last + 1)
            frames = frames[mask[segment.episode, frames, column] > 0]
            starts = range(0, max(len(frames) - WINDOW, 0) + 1, step) if len(frames) > DEGREE + 2 else ()
            for start in starts:
                chosen = frames[start : start + WINDOW]
                yield segment, column, chosen.numpy(), _cubic(whole, segment.episode, column, chosen, kind)


def _cubic(whole: Observations, episode: int, column: int, frames: Tensor, kind: int) -> np.ndarray:
    t = whole.times_s[episode, frames].numpy()
    if kind == 0:
        values = whole.position_m[episode, frames, column].numpy()
    else:
        quat = whole.quat_wxyz[episode, frames, column]
        values = quat_log(quat_multiply(quat_conjugate(quat[len(quat) // 2]), quat)).numpy()
    scaled = (t - t.mean()) / (t[-1] - t[0])
    q, _ = np.linalg.qr(np.vander(scaled, DEGREE + 1))
    left = 1 - (q * q).sum(1)
    return (values - q @ (q.T @ values)) / np.sqrt(left.clip(1e-6))[:, None]


def _spread(residuals: np.ndarray, floor: float) -> float | None:
    if len(residuals) < ENOUGH:
        return None
    first = MAD_TO_STD * float(np.median(np.abs(residuals)))
    kept = residuals[np.abs(residuals) < KEEP_SIGMAS * max(first, floor)]
    return max(float(np.sqrt(np.mean(kept**2))), floor)
