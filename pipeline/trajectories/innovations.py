"""Models of correlated measurement errors, and the whitening of residuals by them.

The errors of one coordinate are the sum of white noise, a process of Matern's class (a filter, a marker that comes into
view; of order 1/2, Ornstein and Uhlenbeck's, it is not differentiable, of order 3/2 once, of order 5/2 twice, as what a
low pass leaves), a second, slower one of order 1/2 (a calibration with local errors, a marker that moves over the
body), and, across gravity, the path of an acceleration that is constant in a flight and differs from flight to flight
(a frame that is levelled anew for each episode). Residuals are replaced by their innovations, so that later steps may
assume independence: this is generalised least squares with these errors as random effects.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

RESOLUTION_S = 1e-12
"""Frame times [s] closer than this are the same: the times of recorded episodes share a grid up to rounding."""
FALLS = {0.5: 1.0, 1.5: 2.1461932, 2.5: 2.90463}
"""Rates of processes of each order, in which the correlation falls to 1/e in one unit of time."""
MOST_NUMBERS = 2_000_000
"""Maximum size of the whitening matrices of a batch; above it the filter runs over its frames."""


class CorrelatedNoise(NamedTuple):
    """Noise of one kind: white noise, a process of Matern's class, and slow errors."""

    share: float = 0.0
    """Share of the variance, without that of slow errors, that is correlated."""
    time_s: float = 1.0
    """Correlation time [s], in which the correlation falls to 1/e."""
    size: float = 1.0
    """Standard deviation of this model, without slow errors, in units of that of the tracks: windows determine the
    innovation of each frame much better than the correlated share."""
    slow: float = 0.0
    """Standard deviation of the slow errors, in units of that of the tracks."""
    slow_time_s: float = 1.0
    """Their correlation time [s]."""
    sway: float = 0.0
    """Standard deviation of each flight's own acceleration across gravity, in units of the tracks' per s2."""
    level: tuple[int, ...] = (0, 1)
    """Axes across gravity."""
    order: float = 0.5
    """Order of the process: 1/2, 3/2 or 5/2."""

    @property
    def white(self) -> bool:
        """Whether errors are independent and have the standard deviation of the tracks."""
        return not (self.share or self.slow or self.sway) and self.size == 1.0


class NoiseModel(NamedTuple):
    """Noise models of positions and of rotations."""

    position: CorrelatedNoise = CorrelatedNoise()
    """Noise of the positions."""
    rotation: CorrelatedNoise = CorrelatedNoise()
    """Noise of the rotations."""

    @property
    def slow(self) -> bool:
        """Whether slow errors are part of it."""
        return any(one.slow or one.sway for one in self)

    @property
    def correlated(self) -> bool:
        """Whether errors of neighbouring frames are correlated."""
        return any(one.share for one in self)


WHITE = NoiseModel()
"""Uncorrelated noise."""


def matern(gaps_s: Tensor, time_s: float, order: float) -> Tensor:
    """Return the correlation over gaps [s] of a process of an order, by Rasmussen & Williams (2006), eq. 4.16 f.

    Args:
        gaps_s: Times between two frames, not negative.
        time_s: In which the correlation falls to 1/e.
        order: 1/2, 3/2 or 5/2.
    """
    x = gaps_s * (FALLS[order] / time_s)
    if order == 0.5:
        return torch.exp(-x)
    x = x.clamp_max(700.0)  # where the exponential is not yet 0
    return (1 + x + (x.square() / 3 if order > 2 else 0.0)) * torch.exp(-x)


def with_white(alike: Tensor, share: float | Tensor) -> Tensor:
    """Return correlations (..., n, n) of errors of which a share of the variance has those given, and the rest none."""
    return share * alike + (1 - share) * torch.eye(alike.shape[-1], dtype=alike.dtype)


def matern_by_time(gaps_s: Tensor, time_s: float, order: float) -> Tensor:
    """Return the derivative of :func:`matern` by the logarithm of its time; arguments as there."""
    x = (gaps_s * (FALLS[order] / time_s)).clamp_max(700.0)
    if order == 0.5:
        return x * torch.exp(-x)
    return x.square() * ((1 + x) / 3 if order > 2 else 1.0) * torch.exp(-x)


def innovations(rows: Tensor, times_s: Tensor, mask: Tensor, noise: CorrelatedNoise) -> Tensor:
    """Return residuals as innovations over their standard deviations: what each frame adds to those before it.

    For noise of the given model they are independent and of variance 1 (Kalman 1960). The own acceleration of a flight
    is not part of it where the rows have no axes, see `axis_innovations`.

    Args:
        rows: Residuals in sigmas, or their derivatives, (B, T, ...); 0 where a frame does not count.
        times_s: Frame times (B, T).
        mask: Frames that count (B, T).
        noise: The noise model.
    """
    grids, place = _grids(times_s, mask)
    length = max(map(len, grids)) // 8
    # a row that is not finite would spoil earlier ones in a product
    if len(grids) * length**2 > MOST_NUMBERS or not bool(rows.isfinite().all()):
        return _filtered(rows, times_s, mask, noise)
    matrices = _whitening(grids, noise).to(rows)
    flat = rows.flatten(2) if rows.ndim > 2 else rows[..., None]
    found = (matrices[0] if len(grids) == 1 else matrices[place]) @ flat[:, :length]
    found = torch.where(mask[:, :length, None] > 0, found, flat[:, :length])
    return torch.cat((found, flat[:, length:]), 1).reshape(rows.shape)


def _grids(times_s: Tensor, mask: Tensor) -> tuple[tuple[bytes, ...], list[int]]:
    """Return the different grids of the items' frames, longest first, and which of them begins as each item does.

    A grid is the bytes of one integer for each frame: twice the time since the first frame in units of `RESOLUTION_S`,
    plus 1 where the frame counts. Frames after the last one that counts do not matter.
    """
    counted = mask.detach().cpu().numpy() > 0
    times = times_s.detach().cpu().numpy()
    codes: NDArray[np.int64] = 2 * np.rint((times - times[:, :1]) / RESOLUTION_S).astype(np.int64) + counted
    lengths = np.maximum((counted * np.arange(1, counted.shape[1] + 1)).max(1), 1)
    grids: list[bytes] = []
    place = [0] * len(codes)
    for item in np.argsort(-lengths, kind="stable").tolist():
        own = codes[item, : lengths[item]].tobytes()
        found = next((k for k, grid in enumerate(grids) if grid.startswith(own)), len(grids))
        if found == len(grids):
            grids.append(own)
        place[item] = found
    return tuple(grids), place


@lru_cache(maxsize=16)
def _whitening(grids: tuple[bytes, ...], noise: CorrelatedNoise) -> Tensor:
    """Return the matrices (K, T, T) whose products with residuals are their innovations, for grids as of `_grids`."""
    codes = [np.frombuffer(grid, np.int64) for grid in grids]
    length = len(codes[0])
    padded = np.stack([np.concatenate((code, code[-1] + 2 * np.arange(1, length - len(code) + 1))) for code in codes])
    times, mask = torch.from_numpy(padded // 2 * RESOLUTION_S), torch.from_numpy((padded % 2).astype(np.float64))
    return _filtered(torch.eye(length, dtype=torch.float64).expand(len(grids), -1, -1), times, mask, noise)


def _filtered(rows: Tensor, times_s: Tensor, mask: Tensor, noise: CorrelatedNoise) -> Tensor:
    """Return the innovations by a filter that runs over the frames; arguments as of `innovations`."""
    if noise.slow or noise.sway or noise.order != 0.5:
        return _state_innovations(rows, times_s, mask, noise)
    share = noise.share
    kept = torch.exp(-times_s.diff(dim=1) / noise.time_s)
    rows = rows / noise.size
    variance, expected = torch.full_like(times_s[:, 0], share), torch.zeros_like(rows[:, 0])
    found = []
    for frame in range(rows.shape[1]):
        counted = mask[:, frame] > 0
        spread = variance + 1 - share
        gain = torch.where(counted, variance / spread, torch.zeros_like(spread))
        away = rows[:, frame] - expected * _expanded(counted.to(rows), rows)
        found.append(away * _expanded(torch.where(counted, spread.rsqrt(), torch.ones_like(spread)), rows))
        if frame < rows.shape[1] - 1:
            factor = kept[:, frame]
            expected = _expanded(factor, rows) * (expected + _expanded(gain, rows) * away)
            variance = factor.square() * variance * (1 - gain) + share * (1 - factor.square())
    return torch.stack(found, 1)


def axis_innovations(rows: Tensor, times_s: Tensor, mask: Tensor, noise: CorrelatedNoise) -> Tensor:
    """Return the innovations of rows (B, T, 3, ...) whose third dimension are axes; see `innovations`."""
    if not noise.sway:
        return innovations(rows, times_s, mask, noise)
    upright = [axis for axis in range(rows.shape[2]) if axis not in noise.level]
    found = torch.empty_like(rows)
    found[:, :, list(noise.level)] = innovations(rows[:, :, list(noise.level)], times_s, mask, noise)
    if upright:
        found[:, :, upright] = innovations(rows[:, :, upright], times_s, mask, noise._replace(sway=0.0))
    return found


def body_innovations(rows: Tensor, times_s: Tensor, masks: Tensor, memory: NoiseModel) -> Tensor:
    """Return the innovations of rows (B, T nf, 6, ...) of bodies: three axes of positions, three of rotations.

    Args:
        rows: Residuals in sigmas, or their derivatives.
        times_s: Frame times (B, T).
        masks: Frames that count, of positions and of rotations, shape (B, T, nf, 2).
        memory: The noise model.
    """
    if memory == WHITE:
        return rows
    bodies = masks.shape[2]
    by_body = rows.unflatten(1, (-1, bodies)).movedim(2, 1).flatten(0, 1)  # (B nf, T, 6, ...)
    times, counted = times_s.repeat_interleave(bodies, 0), masks.movedim(2, 1).flatten(0, 1)
    parts = [
        part if noise.white else axis_innovations(part, times, mask, noise)
        for part, mask, noise in zip(by_body.split(3, 2), counted.unbind(-1), memory, strict=True)
    ]
    return torch.cat(parts, 2).unflatten(0, (-1, bodies)).movedim(1, 2).flatten(1, 2)


def _state_innovations(rows: Tensor, times_s: Tensor, mask: Tensor, noise: CorrelatedNoise) -> Tensor:
    """Return the innovations by a filter whose states are both processes and the acceleration of the flight."""
    square = noise.size**2
    white, size = square * (1 - noise.share), round(noise.order + 0.5)
    still = torch.zeros(size + 2, size + 2).to(times_s)
    still[:size, :size] = square * noise.share * _stationary(size).to(times_s)
    still[size, size], still[-1, -1] = noise.slow**2, noise.sway**2
    since, steps = times_s - times_s[:, :1], times_s.diff(dim=1)
    kept = torch.zeros(*steps.shape, size + 2, size + 2).to(times_s)
    kept[..., :size, :size] = _transition(steps * (FALLS[noise.order] / noise.time_s), size)
    kept[..., size, size], kept[..., -1, -1] = torch.exp(-steps / noise.slow_time_s), 1.0
    fresh = still - kept @ still @ kept.mT
    covariance = still.expand(len(rows), -1, -1)
    expected = rows.new_zeros(len(rows), size + 2, *rows.shape[2:])
    seen = torch.zeros(len(rows), size + 2).to(times_s)
    seen[:, 0] = seen[:, size] = 1.0
    found = []
    for frame in range(rows.shape[1]):
        counted = (mask[:, frame] > 0).to(rows)
        seen[:, -1] = 0.5 * since[:, frame].square()
        along = (covariance @ seen[..., None])[..., 0]
        spread = (seen * along).sum(-1) + white
        gain = along / spread[:, None] * counted[:, None]
        ahead = torch.einsum("bk,bk...->b...", seen, expected)
        away = rows[:, frame] - ahead * _expanded(counted, rows)
        found.append(away * _expanded(torch.where(counted > 0, spread.rsqrt(), torch.ones_like(spread)), rows))
        if frame < rows.shape[1] - 1:
            expected = expected + gain.view(*gain.shape, *[1] * (rows.ndim - 2)) * away[:, None]
            expected = torch.einsum("bjk,bk...->bj...", kept[:, frame], expected)
            covariance = covariance - gain[:, :, None] * along[:, None]
            covariance = kept[:, frame] @ covariance @ kept[:, frame].mT + fresh[:, frame]
    return torch.stack(found, 1)


def _stationary(size: int) -> Tensor:
    """Return the covariance of a process of variance 1 and of its derivatives, each over the rate."""
    if size < 3:
        return torch.eye(size)
    third = 1 / 3
    return torch.tensor([[1.0, 0.0, -third], [0.0, third, 0.0], [-third, 0.0, 1.0]], dtype=torch.float64)


def _transition(u: Tensor, size: int) -> Tensor:
    """Return how a process and its derivatives, each over the rate, go on: the exponential of its companion matrix.

    Args:
        u: Rate times time.
        size: Number of states, the order plus 1/2.
    """
    if size == 1:
        entries = [[torch.ones_like(u)]]
    elif size == 2:
        entries = [[1 + u, u], [-u, 1 - u]]
    else:
        half = 0.5 * u.square()
        entries = [
            [1 + u + half, u + 2 * half, half],
            [-half, 1 + u - 2 * half, u - half],
            [half - u, 2 * half - 3 * u, 1 - 2 * u + half],
        ]
    return torch.stack([torch.stack(row, -1) for row in entries], -2) * torch.exp(-u)[..., None, None]


def _expanded(values: Tensor, rows: Tensor) -> Tensor:
    """Return values (B,) in the shape of a frame of rows (B, T, ...)."""
    return values.view(-1, *[1] * (rows.ndim - 2))
