"""Models of correlated measurement errors, and the whitening of residuals by them.

The errors of one coordinate are the sum of white noise, an Ornstein-Uhlenbeck process (a filter, a marker that comes
into view), a second, slower one (a calibration with local errors, a marker that moves over the body), and, across
gravity, the path of an acceleration that is constant in a flight and differs from flight to flight (a frame that is
levelled anew for each episode). Residuals are replaced by their innovations, so that later steps may assume
independence: this is generalised least squares with these errors as random effects.
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
MOST_NUMBERS = 2_000_000
"""Maximum size of the whitening matrices of a batch; above it the filter runs over its frames."""


class CorrelatedNoise(NamedTuple):
    """Noise of one kind: white noise, an Ornstein-Uhlenbeck process, and slow errors."""

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


WHITE = NoiseModel()
"""Uncorrelated noise."""


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
    if noise.slow or noise.sway:
        return _slow_innovations(rows, times_s, mask, noise)
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


def _slow_innovations(rows: Tensor, times_s: Tensor, mask: Tensor, noise: CorrelatedNoise) -> Tensor:
    """Return the innovations by a filter with three states: both processes, and the acceleration of the flight."""
    square = noise.size**2
    fast, white = square * noise.share, square * (1 - noise.share)
    still = times_s.new_tensor([fast, noise.slow**2, noise.sway**2])
    since, steps = times_s - times_s[:, :1], times_s.diff(dim=1)
    kept = torch.stack(
        [torch.exp(-steps / noise.time_s), torch.exp(-steps / noise.slow_time_s), torch.ones_like(steps)], -1
    )
    covariance = torch.diag(still).expand(len(rows), 3, 3)
    expected = rows.new_zeros(len(rows), 3, *rows.shape[2:])
    found = []
    for frame in range(rows.shape[1]):
        counted = (mask[:, frame] > 0).to(rows)
        seen = torch.stack([torch.ones_like(counted), torch.ones_like(counted), 0.5 * since[:, frame].square()], -1)
        along = (covariance @ seen[..., None])[..., 0]
        spread = (seen * along).sum(-1) + white
        gain = along / spread[:, None] * counted[:, None]
        ahead = torch.einsum("bk,bk...->b...", seen, expected)
        away = rows[:, frame] - ahead * _expanded(counted, rows)
        found.append(away * _expanded(torch.where(counted > 0, spread.rsqrt(), torch.ones_like(spread)), rows))
        if frame < rows.shape[1] - 1:
            factor = kept[:, frame]
            expected = expected + gain.view(*gain.shape, *[1] * (rows.ndim - 2)) * away[:, None]
            expected = expected * factor.view(*factor.shape, *[1] * (rows.ndim - 2))
            covariance = covariance - gain[:, :, None] * along[:, None]
            covariance = factor[:, :, None] * factor[:, None] * covariance + torch.diag_embed(
                still * (1 - factor.square())
            )
    return torch.stack(found, 1)


def _expanded(values: Tensor, rows: Tensor) -> Tensor:
    """Return values (B,) in the shape of a frame of rows (B, T, ...)."""
    return values.view(-1, *[1] * (rows.ndim - 2))
