"""Noise of the tracks measured in their flights, without a motion model, and detection of outliers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..geometry.rotation import continuous_turns
from .bursts import bursts
from .observations import Observations
from .segmentation import Segment
from .thresholds import TRACK_THRESHOLDS
from .track_noise import FLOOR_M, FLOOR_RAD, LONG_S, MAD_TO_STD, Noise, moves

LIMITS = TRACK_THRESHOLDS.track_noise
WINDOW = 9
"""Frames of a window that a cubic follows in free flight: 0.09 s at 100 Hz, within 0.1 mm for 6 mm at 20 rad/s."""
DEGREE = 3
"""Degree of the polynomial that is removed from a window."""
SLOW_DEGREE = 7
"""Orders from the fourth to this one contain slow errors of a window and almost nothing of the flight."""
STEPS = 100
"""Number of steps in which the noise beside errors of times is found."""
MOST_CORRELATED = 0.95
"""Maximum correlation from frame to frame that is considered."""


def flight_noise(whole: Observations, flight: Sequence[Segment]) -> tuple[float | None, float | None]:
    """Return the standard deviations of position [m] and rotation [rad] by axis; None with too little flight.

    Each window of consecutive frames is fitted by a cubic; residuals are scaled to the same variance, and those beyond
    `keep_sigmas` of a first, robust estimate are left out. Windows of a body with measured orientation are short,
    because a point away from its centre of mass does not follow a long cubic. A cubic follows a part of errors that are
    correlated over several frames, such as those of smoothed tracks; the result is the standard deviation of the full
    errors, without those of the frames' times.
    """
    found = [_spread(*_residuals(whole, flight, kind), (FLOOR_M, FLOOR_RAD)[kind]) for kind in (0, 1)]
    for kind in (0, 1):
        alone = found[kind]
        if alone is not None:
            found[kind] = alone * _hidden(whole, flight, kind, alone)
    return found[0], found[1]


def slow_noise(whole: Observations, flight: Sequence[Segment]) -> float:
    """Return the factor by which the variance of slow errors of a centroid exceeds that of all; 1 where it is unknown.

    Independent errors have the same variance in every orthogonal polynomial over a window; errors correlated over many
    frames have more in the low orders, which identify forces.
    """
    slow, all_orders = [], []
    for segment in flight:
        for column in range(len(whole.free)):
            if bool(whole.has_orientation[segment.episode, :, column].any()):
                continue
            for chosen in _frames(whole, segment, column, 0):
                if len(chosen) <= SLOW_DEGREE + 1:
                    continue
                t = whole.times_s[segment.episode, chosen].numpy()
                values = _steadiest(whole, segment.episode, column, chosen)
                q, _ = np.linalg.qr(np.vander((t - t.mean()) / (t[-1] - t[0]), SLOW_DEGREE + 1, increasing=True))
                parts = (q.T @ values)[DEGREE + 1 :]
                left = values - q[:, : DEGREE + 1] @ (q.T @ values)[: DEGREE + 1]
                slow.append((parts**2).mean())
                all_orders.append((left**2).sum() / (len(t) - DEGREE - 1) / values.shape[1])
    # medians, so that a window with a bounce or an outlier does not dominate
    return max(1.0, float(np.median(slow) / max(np.median(all_orders), FLOOR_M**2))) if len(slow) >= 10 else 1.0


def without_outliers(whole: Observations, flight: Sequence[Segment], noise: Noise) -> tuple[Observations, int, Tensor]:
    """Remove wrong measurements in flight, and find flight frames in which something touched the body.

    A single frame off the cubic through its neighbours is a wrong measurement, and marked as not seen; so are several
    in a row where the frames before and after them lie on one cubic, or the whole flight on one smooth path. Where they
    do not, something touched the body: a bounce on a ground at another height than stated, or a hand.

    Returns:
        The episodes; the number of wrong measurements; frames (E, T) of flight in which something touched the body.
    """
    seen, turned = whole.seen.clone(), whole.has_orientation.clone()
    kinked = torch.zeros_like(seen[..., 0], dtype=torch.bool)
    wrong: set[tuple[int, int, int, int]] = set()
    for kind in (0, 1):
        mask = (seen, turned)[kind]
        for episode, frames, column in _bursts(whole, flight, noise, kind):
            mask[episode, frames, column] = 0.0
            wrong |= {(kind, episode, int(frame), column) for frame in frames}
    for kind in (1, 0):  # a wrong turn would move a marker beside the centre of mass
        whole = replace(whole, seen=seen.clone(), has_orientation=turned.clone())
        for episode, frames, column in bursts(whole, flight, noise, kind):
            (seen, turned)[kind][episode, frames, column] = 0.0
            wrong |= {(kind, episode, int(frame), column) for frame in frames}
    count, whole = len(wrong), replace(whole, seen=seen.clone(), has_orientation=turned.clone())
    wrong.clear()
    for kind in (0, 1):
        for segment, column, frames, away in _windows(whole, flight, noise, kind):
            size = np.abs(away).max(1)
            if size.max() <= LIMITS.outlier_sigmas:
                continue
            worst = int(size.argmax())
            rest = torch.as_tensor(np.delete(frames, worst))
            left = _cubic(whole, segment.episode, column, rest, kind)
            left = left / np.hypot(noise[kind], _shifts(whole, segment.episode, column, rest, kind))
            if np.abs(left).max() <= LIMITS.outlier_sigmas:
                wrong.add((kind, segment.episode, int(frames[worst]), column))
            else:
                kinked[segment.episode, torch.as_tensor(frames)] = True
    for kind, episode, frame, column in wrong:
        if not bool(kinked[episode, frame]):
            (seen, turned)[kind][episode, frame, column] = 0.0
            count += 1
    return replace(whole, seen=seen, has_orientation=turned), count, kinked


def _bursts(
    whole: Observations, flight: Sequence[Segment], noise: Noise, kind: int
) -> Iterator[tuple[int, np.ndarray, int]]:
    """Yield episode, frames and body of bursts: rows of wrong measurements between frames that lie on one cubic."""
    rough: dict[tuple[int, int, int, int], set[int]] = {}
    for segment, column, frames, away in _windows(whole, flight, noise, kind):
        if np.abs(away).max() > LIMITS.outlier_sigmas:
            rough.setdefault((segment.episode, segment.first, segment.last, column), set()).update(frames.tolist())
    mask = (whole.seen, whole.has_orientation)[kind]
    for (episode, first, last, column), found in rough.items():
        frames = np.array(sorted(found))
        for run in np.split(frames, np.nonzero(np.diff(frames) > 1)[0] + 1):
            # a window that holds one wrong frame reaches beyond it by its own length
            inner = run[WINDOW // 2 : len(run) - WINDOW // 2]
            if not len(inner) or inner[0] - WINDOW < first or inner[-1] + WINDOW > last:
                continue
            frames = np.arange(inner[0] - WINDOW, inner[-1] + 1 + WINDOW)
            frames = frames[mask[episode, torch.as_tensor(frames), column].numpy() > 0]
            outside = (frames < inner[0]) | (frames > inner[-1])
            times = whole.times_s[episode].numpy()
            if times[inner[-1]] - times[inner[0]] > LIMITS.longest_burst_s or outside.sum() < WINDOW or outside.all():
                continue
            more = np.hypot(noise[kind], _shifts(whole, episode, column, torch.as_tensor(frames), kind))
            away = _off_cubic(whole, episode, column, frames, kind, outside, more)
            wrong = frames[~outside & (away > LIMITS.keep_sigmas)]
            if away[outside].max() <= LIMITS.outlier_sigmas and len(wrong) >= LIMITS.least_burst:
                yield episode, wrong, column


def _off_cubic(
    whole: Observations, episode: int, column: int, frames: np.ndarray, kind: int, fitted: np.ndarray, std: np.ndarray
) -> np.ndarray:
    """Return how far each of the frames (n) is from the cubic through the fitted ones, in any coordinate.

    In standard deviations, of which `std` has each value's, shape (n, 1 to 3) [m or rad].
    """
    chosen = torch.as_tensor(frames)
    t, values = _values(whole, episode, column, chosen, kind)
    powers = np.vander((t - t.mean()) / (t[-1] - t[0]), DEGREE + 1)
    coefficients = np.linalg.lstsq(powers[fitted], values[fitted], rcond=None)[0]
    return (np.abs(values - powers @ coefficients) / std).max(1)


def _hidden(whole: Observations, flight: Sequence[Segment], kind: int, noise: float) -> float:
    """Return the ratio of the standard deviation of correlated errors to that of independent ones with equal residuals.

    With r = Q e, Q the projector on the residuals of a cubic in a window, and errors e of correlation rho^|i-j|, C: the
    expectation of r'r is tr(QC), that of r'Lr, neighbours multiplied, is tr(QLQC); their ratio gives rho.
    """
    t = np.linspace(-1, 1, WINDOW)
    basis, _ = np.linalg.qr(np.vander(t, DEGREE + 1))
    left = np.eye(WINDOW) - basis @ basis.T
    pair = 0.5 * (np.eye(WINDOW, k=1) + np.eye(WINDOW, k=-1))
    square, product, count = 0.0, 0.0, 0
    for segment in flight:
        for column in range(len(whole.free)):
            if not bool(whole.has_orientation[segment.episode, :, column].any()):
                continue  # long windows see all of a centroid's errors, see `slow_noise`
            frames = _frames(whole, segment, column, kind)
            if frames.shape[1] < WINDOW:
                continue
            away = _cubic(whole, segment.episode, column, frames, kind)
            raw = away[np.abs(away).max((1, 2)) <= LIMITS.keep_sigmas * noise] * np.sqrt(np.diag(left))[:, None]
            square, product = square + float((raw**2).sum()), product + float((raw * (pair @ raw)).sum())
            count += raw.shape[0] * raw.shape[2]
    seen = left @ pair @ left
    alone, known = np.trace(seen), np.trace(left)
    if count == 0 or square <= 0:
        return 1.0
    # with independent errors the ratio has this scatter
    scatter = np.sqrt(2 * ((seen @ seen).trace() - alone**2 / known) / count) / known
    if product / square < alone / known + LIMITS.neighbours * scatter:
        return 1.0
    gap = np.abs(np.subtract.outer(np.arange(WINDOW), np.arange(WINDOW)))
    rhos = np.linspace(0.0, MOST_CORRELATED, 200)
    ratios = [np.trace(seen @ rho**gap) / np.trace(left @ rho**gap) for rho in rhos]
    rho = rhos[int(np.abs(np.array(ratios) - product / square).argmin())]
    return float(np.sqrt(known / np.trace(left @ rho**gap)))


def _residuals(whole: Observations, flight: Sequence[Segment], kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the scaled residuals of positions [m] (kind 0) or rotations [rad] of all windows, and what times do."""
    parts, shifts = [np.zeros(0)], [np.zeros(0)]
    for segment in flight:
        for column in range(len(whole.free)):
            frames = _frames(whole, segment, column, kind)
            parts.append(_cubic(whole, segment.episode, column, frames, kind).ravel())
            shifts.append(_shifts(whole, segment.episode, column, frames, kind).ravel())
    return np.concatenate(parts), np.concatenate(shifts)


def _shifts(whole: Observations, episode: int, column: int, frames: Tensor, kind: int) -> np.ndarray:
    """Return what errors of the frames' times do to what is measured (..., n, 1 to 3) [m or rad]."""
    axes = _moved(whole, episode, column) if kind == 0 else np.ones(3, bool)
    if whole.time_shift is None:
        return np.zeros((*frames.shape, int(axes.sum())))
    return whole.time_shift[episode, frames, column, 3 * kind : 3 * kind + 3].numpy()[..., axes]


def _steadiest(whole: Observations, episode: int, column: int, frames: Tensor) -> np.ndarray:
    """Return measured coordinates (n, 1 to 3) [m]: that which errors of times move least, all where times are right."""
    values = _positions(whole, episode, column, frames)
    if whole.time_shift is None:
        return values
    least = int((_shifts(whole, episode, column, frames, 0) ** 2).sum(0).argmin())
    return values[:, least : least + 1]


def _windows(whole: Observations, flight: Sequence[Segment], noise: Noise, kind: int):
    """Yield segment, body, frames and residuals (n, 1 to 3) of a cubic, in standard deviations, window by window."""
    mask = (whole.seen, whole.has_orientation)[kind]
    for segment in flight:
        for column in range(len(whole.free)):
            frames = torch.arange(segment.first, segment.last + 1)
            windows = _split(frames[mask[segment.episode, frames, column] > 0], WINDOW, 1)
            away = _cubic(whole, segment.episode, column, windows, kind)
            away = away / np.hypot(noise[kind], _shifts(whole, segment.episode, column, windows, kind))
            for chosen, residuals in zip(windows.numpy(), away, strict=True):
                yield segment, column, chosen, residuals


def _split(frames: Tensor, length: int, step: int) -> Tensor:
    """Return windows (W, n) of frames, each `step` after the one before: one of all that are fewer, none of too few."""
    if len(frames) <= DEGREE + 2:
        return frames.new_zeros(0, length)
    return frames.unfold(0, min(length, len(frames)), step)


def _frames(whole: Observations, segment: Segment, column: int, kind: int) -> Tensor:
    """Return the frames (W, n) of half-overlapping windows of a flight: long ones where no orientation was measured."""
    mask = (whole.seen, whole.has_orientation)[kind]
    frames = torch.arange(segment.first, segment.last + 1)
    frames = frames[mask[segment.episode, frames, column] > 0]
    length = WINDOW
    if len(frames) > 1 and not bool(whole.has_orientation[segment.episode, :, column].any()):
        step = float(whole.times_s[segment.episode, frames].diff().median())
        length = max(WINDOW, round(LONG_S / step))
    return _split(frames, length, length // 2)


def _positions(whole: Observations, episode: int, column: int, frames: Tensor) -> np.ndarray:
    """Return the measured coordinates (..., n, 1 to 3) [m]: those that change anywhere in the episode."""
    return whole.position_m[episode, frames, column].numpy()[..., _moved(whole, episode, column)]


def _moved(whole: Observations, episode: int, column: int) -> np.ndarray:
    """Return which coordinates (3) change anywhere in an episode."""
    return moves(whole.position_m[episode, whole.seen[episode, :, column] > 0, column].numpy())


def _cubic(whole: Observations, episode: int, column: int, frames: Tensor, kind: int) -> np.ndarray:
    """Return the residuals of cubics in windows of frames (..., n), (..., n, 1 to 3) [m or rad], of equal variance."""
    t, values = _values(whole, episode, column, frames, kind)
    scaled = (t - t.mean(-1, keepdims=True)) / (t[..., -1:] - t[..., :1])
    q, _ = np.linalg.qr(np.stack((scaled * scaled * scaled, scaled * scaled, scaled, np.ones_like(t)), -1))
    left = 1 - (q * q).sum(-1, keepdims=True)
    return (values - q @ (q.swapaxes(-1, -2) @ values)) / np.sqrt(left.clip(1e-6))


def _spread(residuals: np.ndarray, shifts: np.ndarray, floor: float) -> float | None:
    """Return the standard deviation without outliers, at least a floor; None for too few residuals.

    Args:
        residuals: What cubics leave.
        shifts: Standard deviations of what errors of times add to each; the likeliest one beside them is found by
            expectation and maximisation (Dempster, Laird & Rubin 1977).
        floor: Of the standard deviation.
    """
    if len(residuals) < LIMITS.enough:
        return None
    first = MAD_TO_STD * float(np.median(np.abs(residuals)))
    kept = np.abs(residuals) < LIMITS.keep_sigmas * np.hypot(max(first, floor), shifts)
    square, more = residuals[kept] ** 2, shifts[kept] ** 2
    variance = float(np.mean(square))
    for _ in range(STEPS if more.any() else 0):
        share = variance / (variance + more)
        variance = max(float(np.mean(share**2 * square + share * more)), floor**2)
    return max(float(np.sqrt(variance)), floor)


def _values(whole: Observations, episode: int, column: int, frames: Tensor, kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times (..., n) [s] and what is measured then (..., n, 1 to 3): positions [m] or rotation vectors [rad]."""
    times = whole.times_s[episode, frames]
    if kind == 0:
        return times.numpy(), _positions(whole, episode, column, frames)
    quat = whole.quat_wxyz[episode, frames, column]
    middle = torch.full(frames.shape[:-1], frames.shape[-1] // 2)
    return times.numpy(), continuous_turns(times, quat, reference=middle).numpy()
