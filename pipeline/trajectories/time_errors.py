"""Errors of the frames' times: how large they are, how far they move the measurements, and residuals without them.

A time that is wrong by e moves a body of velocity v by e v, and turns it by e w at an angular velocity w: the error
lies along the motion and grows with the speed. With independent errors of times of standard deviation s beside those of
the tracking, of standard deviation q along each axis, the covariance of a position is q^2 I + s^2 v v^T. Both are
estimated from what polynomials leave of short windows of flight, along the motion and across it, by maximum
likelihood.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry.rotation import quat_turn
from .innovations import WHITE, NoiseModel, body_innovations
from .observations import Observations
from .segmentation import Segment
from .thresholds import TRACK_THRESHOLDS
from .track_noise import MAD_TO_STD, polynomial_residuals

Array = NDArray[np.float64]
LIMITS = TRACK_THRESHOLDS.track_noise

FRAMES, DEGREES = 9, (3, 5)
"""Frames of a window of flight, and degree of the polynomial that follows a centroid, and a point that may turn about
the centre of mass."""
TRIED_S = np.concatenate(([0.0], np.geomspace(1e-6, 5e-3, 75)))
"""Standard deviations of errors of times [s] that are tried."""
FACTORS = np.geomspace(0.4, 2.5, 45)
"""Standard deviations across the motion that are tried, in units of a robust one."""
BINS = 50
"""Number of groups of frames of nearly one speed, whose sums the likelihood needs."""
FAR = 5.0
"""Standard deviations from which a residual counts as a wrong measurement."""


def time_errors(whole: Observations, flight: Sequence[Segment]) -> tuple[float, float]:
    """Return the standard deviation [s] of errors of the frames' times that flights show, 0 for none.

    Args:
        whole: The episodes (E).
        flight: Their flight segments.

    Returns:
        The standard deviation, and that of the tracking beside it [m].
    """
    parts = [part for item in flight for part in _flight_residuals(whole, item)]
    if FRAMES * sum(len(speed) for speed, _, _ in parts) < LIMITS.enough:
        return 0.0, 0.0
    speed, along, across = (np.concatenate(every) for every in zip(*parts, strict=True))
    kept = 1 - (1 + DEGREES[int(bool(whole.has_orientation.any()))]) / FRAMES  # degrees of freedom of a frame
    time_s, std_m, evidence = _likeliest(speed.ravel(), along.ravel(), across.ravel(), kept)
    seen = evidence > LIMITS.sure_both and time_s * float(np.median(speed)) > LIMITS.seen_jitter * std_m
    return (time_s, std_m) if seen and _usual(speed, along, across) > LIMITS.usual_jitter * time_s else (0.0, std_m)


def _usual(speed: Array, along: Array, across: Array) -> float:
    """Return the standard deviation of errors of times [s] that the median of fast windows (W, n) shows.

    The smeared edge of a contact, or the rest of a hand, lies along the motion, too, but in the windows at the ends of
    flights alone.
    """
    square, more = (speed**2).mean(1), (along**2 - across**2).mean(1)
    fast = square >= np.median(square)
    return float(np.sqrt(max(np.median(more[fast] / np.maximum(square[fast], 1e-12)), 0.0)))


def _flight_residuals(whole: Observations, item: Segment) -> Iterator[tuple[Array, Array, Array]]:
    """Yield speeds [m/s], residuals along the motion and across it [m] of windows of a flight, each (W, n)."""
    for column in range(len(whole.free)):
        frames = torch.arange(item.first, item.last + 1)
        frames = frames[whole.seen[item.episode, frames, column] > 0]
        number, degree = len(frames) // FRAMES, DEGREES[int(bool(whole.has_orientation[:, :, column].any()))]
        if not number or float(whole.measured_axes[item.episode, column].min()) == 0:
            continue
        rows = frames[: number * FRAMES].reshape(number, FRAMES)
        t = whole.times_s[item.episode, rows].numpy().astype(np.float64)
        places = whole.position_m[item.episode, rows, column].numpy().astype(np.float64)
        t = t - t.mean(1, keepdims=True)
        left = polynomial_residuals(t, places, degree)
        velocity = np.gradient(places - left / np.sqrt(FRAMES / (FRAMES - degree - 1)), axis=1)
        velocity = velocity / np.gradient(t, axis=1)[..., None]
        speed = np.linalg.norm(velocity, axis=-1)
        forward = velocity / np.maximum(speed, 1e-12)[..., None]
        along = (left * forward).sum(-1)
        rest = left - along[..., None] * forward
        yield speed, along, np.linalg.norm(rest, axis=-1) / np.sqrt(2)


def _likeliest(speed: Array, along: Array, across: Array, kept: float) -> tuple[float, float, float]:
    """Return the likeliest standard deviations of times [s] and of the tracking [m], and the evidence for the former.

    Args:
        speed: Speeds (n,) [m/s].
        along: Residuals along the motion (n,) [m].
        across: Root of the mean square of the two across it (n,) [m].
        kept: Degrees of freedom of a frame of a window.

    Returns:
        Both, and twice the gain of the log-likelihood by errors of times.
    """
    rough = max(MAD_TO_STD * float(np.median(np.abs(across))), 1e-9)
    good = across < FAR * rough
    for _ in range(2):
        tried = (rough * FACTORS)[:, None] ** 2, TRIED_S[None] ** 2
        loss = 2 * (good.sum() * np.log(tried[0]) + (across[good] ** 2).sum() / tried[0]) + 0 * tried[1]
        for some in np.array_split(np.flatnonzero(good)[np.argsort(speed[good])], BINS):  # of nearly one speed each
            if len(some):
                total = tried[0] + tried[1] * (speed[some] ** 2).mean()
                loss += len(some) * np.log(total) + (along[some] ** 2).sum() / total
        row, column = np.unravel_index(int(loss.argmin()), loss.shape)
        std_m, time_s = float(rough * FACTORS[row]), float(TRIED_S[column])
        good = (across < FAR * std_m) & (np.abs(along) < FAR * np.hypot(std_m, time_s * speed))
    return time_s, std_m, kept * float(loss[:, 0].min() - loss.min())


def time_shifts(whole: Observations, time_s: float) -> Tensor:
    """Return how far one standard deviation of the errors of times moves what is measured, shape (E, T, nf, 6).

    Positions [m] along the world's axes, rotations [rad] along the body's. The velocity of a frame is the larger one of
    those to its two neighbours: at a bounce, one of them is that of before or after it.

    Args:
        whole: The episodes (E).
        time_s: Standard deviation of the errors of the frames' times [s].
    """
    parts = [_faster(whole, kind) for kind in (0, 1)]
    return time_s * torch.cat(parts, -1)


def _faster(whole: Observations, kind: int) -> Tensor:
    """Return velocities [m/s] (kind 0) or angular velocities [rad/s] (1), shape (E, T, nf, 3), 0 where unmeasured."""
    mask = (whole.seen, whole.has_orientation)[kind] > 0
    found = torch.zeros(*mask.shape, 3).to(whole.position_m)
    for episode, body in ((e, k) for e in range(len(mask)) for k in range(mask.shape[2])):
        frames = torch.nonzero(mask[episode, :, body])[:, 0]
        if len(frames) < 2:
            continue
        steps = whole.times_s[episode, frames].diff().clamp_min(1e-9)[:, None]
        if kind:
            quat = whole.quat_wxyz[episode, frames, body]
            moved = quat_turn(quat[:-1], quat[1:])
        else:
            moved = whole.position_m[episode, frames, body].diff(dim=0)
        rates = moved / steps
        before, after = torch.cat((rates[:1], rates)), torch.cat((rates, rates[-1:]))
        larger = before.norm(dim=-1, keepdim=True) > after.norm(dim=-1, keepdim=True)
        found[episode, frames, body] = torch.where(larger, before, after)
    return found


def without_time_errors(rows: Tensor, shifts: Tensor, times_s: Tensor, masks: Tensor, memory: NoiseModel) -> Tensor:
    """Return innovations (B, T nf, 6, ...) of the errors of tracking, less what errors of times do to them.

    With the innovations A (m, T) of what the error of each time does, the covariance of the innovations is I + A A^T.
    With the Cholesky factor L of I + A^T A, I - A L^-T (L + I)^-1 A^T is a square root of its inverse (Andrews 1968),
    whose transpose makes the innovations independent, of variance 1.

    Args:
        rows: Residuals as innovations, or their derivatives.
        shifts: What one standard deviation of the error of each time does, in sigmas, shape (B, T, nf, 6).
        times_s: Frame times (B, T).
        masks: Frames that count, of positions and of rotations, shape (B, T, nf, 2).
        memory: The model of the errors of tracking.
    """
    if memory == WHITE:  # A^T A is diagonal
        by_time = rows.unflatten(1, (shifts.shape[1], -1))
        along = shifts.view(*shifts.shape, *[1] * (rows.ndim - 3))
        root = (1 + along.square().sum((2, 3), keepdim=True)).sqrt()
        return (by_time - along * ((along * by_time).sum((2, 3), keepdim=True) / (root * (1 + root)))).flatten(1, 2)
    axes = torch.nonzero(shifts.abs().amax((0, 1, 2)))[:, 0].tolist()
    numbers = [part.numpy(force=True).astype(np.float64).tobytes() for part in (shifts, times_s, masks)]
    moved, taken = (part.to(rows) for part in _moved(tuple(shifts.shape), tuple(axes), *numbers, memory))
    part = rows[:, :, axes]
    flat = part.reshape(len(part), moved.shape[1], -1)
    found = rows.clone()
    found[:, :, axes] = (flat - moved @ (taken @ flat)).view_as(part)
    return found


@lru_cache(maxsize=4)
def _moved(
    shape: tuple[int, ...], axes: tuple[int, ...], shifts: bytes, times_s: bytes, masks: bytes, memory: NoiseModel
) -> tuple[Tensor, Tensor]:
    """Return A (B, m, T), of some axes, and (L^T + I)^-1 L^-1 A^T, see `without_time_errors`."""
    batch, count, bodies, _ = shape
    moves, times, counted = (torch.tensor(np.frombuffer(part)) for part in (shifts, times_s, masks))
    unit = torch.eye(count, dtype=torch.float64)
    each = (moves.view(shape)[..., None] * unit[:, None, None]).flatten(1, 2)
    every = body_innovations(each, times.view(batch, count), counted.view(batch, count, bodies, 2), memory)
    moved = every[:, :, list(axes)].flatten(1, 2)
    root = torch.linalg.cholesky(unit + moved.mT @ moved)
    inside = torch.linalg.solve_triangular(root, moved.mT, upper=False)
    return moved, torch.linalg.solve_triangular((root + unit).mT, inside, upper=True)
