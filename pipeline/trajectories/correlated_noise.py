"""Errors of a measurement that last for several frames: how much of them, for how long, and residuals without them.

A tracker that filters, a marker that wanders over a ball or a calibration that is off in places make errors that
neighbouring frames share. Forces are found by what is slow, and errors that last are slow: of a share s of the variance
that is forgotten within tau, the covariance of two frames is s exp(-|dt| / tau), plus 1 - s of each alone. Of residuals
the innovations are taken, so that what follows may take them for independent.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..estimation.noise import FLOOR_M, FLOOR_RAD
from ..estimation.observations import Observations
from ..physics.rotation import quat_conjugate, quat_log, quat_multiply
from .cuts import Segment

Array = NDArray[np.float64]

LONGEST_S = 0.4
"""Of a window: a longer one shows more of what lasts, and a force that changes within it may be taken for errors."""
LEAST_DEGREE, MOST_DEGREE = 4, 12
CIRCLE_LEFT = 1e-3
"""Share of the circle of a point about the centre of mass that polynomials of the degree chosen leave."""
LARGEST_TURN = 2.5
"""Of a window of rotations [rad]: rotation vectors of a tumbling body are polynomials near none only."""
LEAST = 4
"""Frames of a window beyond the numbers of its polynomial."""
REMEMBERED = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""What is left of an error after one frame, of those that last, which are tried; and shares of the variance."""
SHARES = (1.0, 0.75, 0.5, 0.25)
SURE, SURE_ALONE = 20.0, 6.0
"""Errors last where twice the log-likelihood grows by more than this of positions and rotations together, and by more
than that of the kind itself. Noise that does not last, four times larger along one axis, reached 10."""
LIKELY = 2.0
"""Of memories whose evidence is within this of the largest (two thirds of the true ones are), the slowest is taken."""
FLOORS = (FLOOR_M, FLOOR_RAD)
WRONG = 9.0
"""Windows whose mean square is so many times the median's hold more than errors: a contact, or an outlier."""
ENOUGH = 60
"""So few numbers beside the polynomials tell nothing."""


class Lasting(NamedTuple):
    """Share of the variance that lasts, and the time [s] in which it is forgotten to 1/e.

    size: standard deviation that goes with these, in units of the likeliest one, which is that of the tracks: windows
    tell what is new in each frame much better than how much lasts.
    """

    share: float = 0.0
    time_s: float = 1.0
    size: float = 1.0


class Memory(NamedTuple):
    """Of the errors of positions and of rotations."""

    position: Lasting = Lasting()
    rotation: Lasting = Lasting()


FORGETFUL = Memory()
"""Errors that do not last."""


def without_memory(rows: Tensor, times_s: Tensor, mask: Tensor, lasting: Lasting) -> Tensor:
    """Return residuals as innovations over their standard deviations: what each frame adds to those before it.

    Those of errors that last as given are independent and of variance 1 (Kalman 1960).

    Args:
        rows: Residuals in sigmas, or their derivatives, (B, T, ...); 0 where a frame does not count.
        times_s: Of the frames (B, T).
        mask: Which of them count (B, T).
        lasting: The errors.
    """
    share = lasting.share
    kept = torch.exp(-times_s.diff(dim=1) / lasting.time_s)
    rows = rows / lasting.size
    variance, expected = torch.full_like(times_s[:, 0], share), torch.zeros_like(rows[:, 0])
    found = []
    for frame in range(rows.shape[1]):
        counted = mask[:, frame] > 0
        spread = variance + 1 - share
        gain = torch.where(counted, variance / spread, torch.zeros_like(spread))
        away = rows[:, frame] - expected * _beside(counted.to(rows), rows)
        found.append(away * _beside(torch.where(counted, spread.rsqrt(), torch.ones_like(spread)), rows))
        if frame < rows.shape[1] - 1:
            factor = kept[:, frame]
            expected = _beside(factor, rows) * (expected + _beside(gain, rows) * away)
            variance = factor.square() * variance * (1 - gain) + share * (1 - factor.square())
    return torch.stack(found, 1)


def _beside(values: Tensor, rows: Tensor) -> Tensor:
    """Return values (B,) in the shape of a frame of rows (B, T, ...)."""
    return values.view(-1, *[1] * (rows.ndim - 2))


def memory_of(whole: Observations, flight: Sequence[Segment]) -> tuple[Memory, tuple[float | None, float | None]]:
    """Return how long the errors of tracks last, from flight and without any model, and their standard deviations.

    Positions and rotations tell of it together: what makes one of them last, a filter, does so to the other.

    Returns:
        The memory; standard deviations of position [m] and rotation [rad], None of those that do not last.
    """
    found = [_lasting(whole, flight, kind) for kind in (0, 1)]
    if sum(one.evidence for one in found) < SURE:
        return FORGETFUL, (None, None)
    # what is exact but for rounding errs alike from frame to frame, too
    sure = [one.evidence > SURE_ALONE and one.std > floor for one, floor in zip(found, FLOORS, strict=True)]
    if not any(sure):
        return FORGETFUL, (None, None)
    lasting = Memory(*(one.lasting if yes else Lasting() for one, yes in zip(found, sure, strict=True)))
    position, rotation = (one.std if yes else None for one, yes in zip(found, sure, strict=True))
    return lasting, (position, rotation)


def told_memory(memory: Memory) -> str:
    """Say how long errors last, and what follows."""
    times = [
        f"those of {name} for {1e3 * lasting.time_s:.0f} ms"
        for name, lasting in zip(("position", "rotation"), memory, strict=True)
        if lasting.share
    ]
    return (
        f"errors of the tracks last from frame to frame, {' and '.join(times)}, as of smoothed tracks: they are "
        "counted as such, and so much less is seen of slow forces. Give tracks as they were measured, if there are any."
    )


def _lasting(whole: Observations, flight: Sequence[Segment], kind: int) -> _Found:
    """Return the likeliest memory of positions (kind 0) or rotations (1).

    Restricted maximum likelihood (Patterson & Thompson 1971): of what a polynomial leaves of every window.
    """
    windows = _windows(whole, flight, kind)
    if sum(w.left.size for w in windows) < ENOUGH:
        return _Found(Lasting(), 0.0, 0.0)
    sizes = np.concatenate([(w.left**2).mean((1, 2)) for w in windows])
    kept = [w.without(WRONG * float(np.median(sizes))) for w in windows]
    windows = [w for w in kept if len(w.left)]
    step = float(np.median([np.median(np.diff(w.times_s, axis=1)) for w in windows]))
    alone = _likelihood(windows, Lasting())[0]
    tried = []
    for remembered, share in itertools.product(REMEMBERED, SHARES):
        lasting = Lasting(share, -step / math.log(remembered))
        likelihood, std = _likelihood(windows, lasting)
        slow = std**2 * (1 - share + share * (1 + remembered) / (1 - remembered))
        tried.append((2 * (likelihood - alone), slow, lasting, std))
    most, _, _, likeliest = max(tried)
    # what forces are found by is the slow part of the errors, which windows show least: rather too much of it
    likely = [(slow, lasting, std) for evidence, slow, lasting, std in tried if evidence > most - LIKELY]
    _, lasting, std = max(likely)
    return _Found(lasting._replace(size=std / likeliest), likeliest, most)


@dataclass(frozen=True)
class _Found:
    """Errors of one kind: lasting; std of one frame [m or rad]; evidence: twice the log-likelihood gained."""

    lasting: Lasting
    std: float
    evidence: float


@dataclass(frozen=True, eq=False)
class _Windows:
    """Windows of n frames each (W): times (W, n) [s]; basis (W, n, m) of what no polynomial holds; left (W, m, c)."""

    times_s: Array
    basis: Array
    left: Array

    def without(self, above: float) -> _Windows:
        kept = (self.left**2).mean((1, 2)) <= above
        return _Windows(self.times_s[kept], self.basis[kept], self.left[kept])


def _likelihood(windows: Sequence[_Windows], lasting: Lasting) -> tuple[float, float]:
    """Return the largest restricted log-likelihood of errors that last as given, and their standard deviation."""
    square, logs, count = 0.0, 0.0, 0
    for w in windows:
        gap = np.abs(w.times_s[:, :, None] - w.times_s[:, None])
        together = lasting.share * np.exp(-gap / lasting.time_s) + (1 - lasting.share) * np.eye(gap.shape[1])
        factor = np.linalg.cholesky(np.swapaxes(w.basis, 1, 2) @ together @ w.basis)
        white = np.linalg.solve(factor, w.left)
        square += float((white**2).sum())
        logs += 2 * w.left.shape[2] * float(np.log(np.diagonal(factor, axis1=1, axis2=2)).sum())
        count += w.left.size
    variance = square / max(count, 1)
    return -0.5 * (logs + count * np.log(max(variance, 1e-300))), float(np.sqrt(variance))


def _windows(whole: Observations, flight: Sequence[Segment], kind: int) -> list[_Windows]:
    mask = (whole.seen, whole.turned)[kind]
    found: dict[tuple[int, int, int], list[tuple[Array, Array, Array]]] = {}
    for segment in flight:
        for column in range(len(whole.free)):
            frames = torch.arange(segment.first, segment.last + 1)
            frames = frames[mask[segment.episode, frames, column] > 0]
            length, degree = _window(whole, segment.episode, column, frames, kind)
            if length < degree + 1 + LEAST:
                continue
            axes = whole.measured_axes[segment.episode, column].numpy() > 0
            for start in range(0, len(frames) - length + 1, length):
                chosen = frames[start : start + length]
                t = whole.times_s[segment.episode, chosen].numpy()
                if kind == 0:
                    values = whole.position_m[segment.episode, chosen, column].numpy()[:, axes]
                else:
                    quat = whole.quat_wxyz[segment.episode, chosen, column]
                    values = quat_log(quat_multiply(quat_conjugate(quat[length // 2]), quat)).numpy()
                scaled = 2 * (t - t[0]) / (t[-1] - t[0]) - 1
                basis = np.linalg.qr(np.vander(scaled, degree + 1), mode="complete")[0][:, degree + 1 :]
                found.setdefault((length, degree, values.shape[1]), []).append((t, basis, basis.T @ values))
    return [_Windows(*(np.stack(parts) for parts in zip(*some, strict=True))) for some in found.values()]


def _window(whole: Observations, episode: int, column: int, frames: Tensor, kind: int) -> tuple[int, int]:
    """Return how many frames a window of a flight has, and the degree of its polynomials."""
    if len(frames) < LEAST_DEGREE + 1 + LEAST:
        return 0, LEAST_DEGREE
    times, known = whole.times_s[episode, frames], frames[whole.turned[episode, frames, column] > 0]
    spin = 0.0
    if len(known) > 1:
        quat = whole.quat_wxyz[episode, known, column]
        turns = quat_log(quat_multiply(quat_conjugate(quat[:-1]), quat[1:])).norm(dim=-1)
        spin = float((turns / whole.times_s[episode, known].diff()).median())
    longest = min(LONGEST_S, LARGEST_TURN / max(spin, 1e-9)) if kind else LONGEST_S
    number = max(1, -(-float(times[-1] - times[0]) // longest))
    length = int(len(frames) // number)
    turn = spin * float(times[max(length - 1, 0)] - times[0])
    # Chebyshev's series of exp(i turn x / 2) on [-1, 1]: the first term left out has 2 (turn / 4)^n / n!
    degree = next((d for d in range(LEAST_DEGREE, MOST_DEGREE) if _circle_left(turn, d) < CIRCLE_LEFT), MOST_DEGREE)
    return length, degree


def _circle_left(turn: float, degree: int) -> float:
    return 2 * (turn / 4) ** (degree + 1) / math.factorial(degree + 1)
