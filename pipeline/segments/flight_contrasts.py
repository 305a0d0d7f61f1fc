"""What flights show of errors: residuals, beside what their states and the effects common to all can follow.

The restricted likelihood (Patterson & Thompson 1971) is that of the residuals after generalised least squares with flat
priors on states and effects (Harville 1974).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..trajectories.innovations import CorrelatedNoise, matern
from .segments import Segments
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.slow_errors

FRAMES = 80
"""Maximum number of frames of a flight that are looked at, evenly spread: components differ by their times, which these
frames show."""
LEAST_WHITE = 0.03
"""Smallest variance of the white noise beside that of the fast process: what a filter leaves of fast changes is less
than any process of a finite order has, and would decide how large the slow ones are."""
KEPT = 1e-3
"""Directions of the common effects, of unit length, that are shorter than this beside all others are left out."""
LEAST_MOVE = 0.02
"""Smallest movement of all frames together, in standard deviations, of an effect of usual size that counts: a tilt of
the frame turns the residuals that it leaves, and what is proportional to these would explain them."""


class Components(NamedTuple):
    """Variance components: variances in units of that of the tracks, and times [s]; numbers that are climbed."""

    white: Tensor
    """Variance of the white noise."""
    fast: Tensor
    """Variance of the fast process."""
    time_s: Tensor
    """Its correlation time."""
    order: float
    """Its order."""
    slow: Tensor | None = None
    """Variance of the slow process."""
    slow_time_s: Tensor | None = None
    """Its correlation time."""
    sway: Tensor | None = None
    """Variance of the flights' own accelerations, in units of the tracks' per s4."""

    @staticmethod
    def of(z: Tensor, kinds: Sequence[str], order: float) -> Components:
        """Return the components of coordinates; see `_coded`."""
        white, fast, time_s, *rest = z
        slow, slow_time_s = (rest.pop(0), rest.pop(0)) if "slow" in kinds else (None, None)
        sway = rest.pop(0) if "sway" in kinds else None
        return Components(
            white=(2 * white).exp() + LEAST_WHITE * (2 * fast).exp(),
            fast=(2 * fast).exp(),
            time_s=time_s.exp(),
            order=order,
            slow=None if slow is None else (2 * slow).exp(),
            slow_time_s=None if slow_time_s is None else slow_time_s.exp(),
            sway=None if sway is None else (2 * sway).exp(),
        )

    def noise(self, level: tuple[int, ...]) -> CorrelatedNoise:
        """Return the noise model."""
        white, fast = float(self.white), float(self.fast)
        return CorrelatedNoise(
            share=fast / (white + fast),
            time_s=float(self.time_s),
            size=float(np.sqrt(white + fast)),
            slow=0.0 if self.slow is None else float(self.slow.sqrt()),
            slow_time_s=1.0 if self.slow_time_s is None else float(self.slow_time_s),
            sway=0.0 if self.sway is None else float(self.sway.sqrt()),
            level=level or (0, 1),
            order=self.order,
        )


@dataclass(frozen=True, eq=False)
class FlightContrasts:
    """Residuals of one kind of flights (B) at chosen frames (n), with what states and effects can follow."""

    times_s: Tensor
    """Frame times, shape (B, n) [s]."""
    mask: Tensor
    """Frames that count, shape (B, n)."""
    rows: Tensor
    """Residuals in sigmas, shape (B, n, 3)."""
    own: Tensor
    """Derivatives by the states, shape (B, n, 3, S)."""
    common: Tensor
    """Directions that all effects together span, shape (B, n, 3, P)."""
    axes: Tensor
    """Measured axes, shape (B, 3)."""

    @staticmethod
    def of(
        segments: Segments, rows: Tensor, jacobian: Tensor, count: int, kind: int, spacing_s: float = 0.0
    ) -> FlightContrasts | None:
        """Choose frames and axes of positions (kind 0) or rotations (1) of the first free body; None without any.

        Args:
            segments: The flights.
            rows: Residuals (B, F, 6) in sigmas of white noise.
            jacobian: Their derivatives (B, F, 6, P + S) by effects, of usual size, and states.
            count: Number P of the effects' parameters.
            kind: 0 or 1.
            spacing_s: Least time between the frames.
        """
        seen = segments.observations
        mask = (seen.seen, seen.has_orientation)[kind][:, :, 0]
        if float(mask.sum()) < LIMITS.least_frames:
            return None
        bodies = len(seen.free)
        picked = [_spread_frames(one, t, spacing_s) for one, t in zip(mask, seen.times_s, strict=True)]
        longest = max(len(p) for p in picked)
        place = torch.stack([torch.cat((p, p[-1:].expand(longest - len(p)))) for p in picked])
        inside = torch.stack([(torch.arange(longest) < len(p)).to(rows) for p in picked])
        item, columns = torch.arange(len(picked))[:, None], slice(3 * kind, 3 * kind + 3)
        axes = seen.measured_axes[:, 0].to(rows) if kind == 0 else torch.ones(len(picked), 3).to(rows)
        weight = inside[:, :, None] * axes[:, None]
        at = rows[:, ::bodies][item, place][..., columns] * weight
        slopes = torch.nan_to_num(jacobian[:, ::bodies][item, place][:, :, columns]) * weight[..., None]
        common, own = slopes[..., :count], slopes[..., count:]
        other = jacobian[:, ::bodies][item, place][:, :, slice(3 - 3 * kind, 6 - 3 * kind), count:]
        seen_there = (seen.has_orientation, seen.seen)[kind][:, :, 0][item, place] * inside
        own = own[..., moving(own, torch.nan_to_num(other) * seen_there[:, :, None, None])]
        return FlightContrasts(seen.times_s[item, place], inside, at, own, _spanned(common, own), axes)

    def likelihood(self, sizes: Components, level: Sequence[int]) -> Tensor:
        """Return the restricted log-likelihood of variance components, up to a constant.

        Args:
            sizes: The components.
            level: Axes across gravity.
        """
        logs, whitened = self.times_s.new_zeros(()), []
        still = self._covariance(sizes)
        level = tuple(level) if sizes.sway is not None else ()
        for axes in (level, tuple(a for a in range(3) if a not in level)):
            if not axes:
                continue
            sway = sizes.sway if axes == level else None
            factor = torch.linalg.cholesky(still if sway is None else still + sway * self._paths)
            flat = torch.linalg.solve_triangular(factor, self._joined(axes), upper=False)
            whitened.append(flat.unflatten(2, (len(axes), -1)).flatten(1, 2))
            diagonal = factor.diagonal(dim1=1, dim2=2).log() * self.mask
            logs = logs + 2 * (diagonal.sum(1) * self.axes[:, axes].sum(1)).sum()
        white = whitened[0] if len(whitened) == 1 else torch.cat(whitened, 1)
        own = self.own.shape[-1]
        left, free = white[..., own:], white[..., :own]
        if own:
            chol = _root(free.mT @ free)
            logs = logs + 2 * chol.diagonal(dim1=1, dim2=2).log().sum()
            left = left - free @ torch.cholesky_solve(free.mT @ left, chol)
        flat = left.flatten(0, 1)
        normal = flat.mT @ flat
        square, slope, matrix = normal[0, 0], normal[1:, 0], normal[1:, 1:]
        if len(matrix):
            chol = _root(matrix)
            square = square - torch.linalg.solve_triangular(chol, slope[:, None], upper=False).square().sum()
            logs = logs + 2 * chol.diagonal().log().sum()
        return -0.5 * (logs + square)

    def _covariance(self, sizes: Components) -> Tensor:
        """Return the covariance (B, n, n) of the frames of one axis without accelerations of the flights' own.

        It is the unit matrix where a frame does not count.
        """
        found = sizes.fast * matern(self._gaps, sizes.time_s, sizes.order)
        if sizes.slow is not None and sizes.slow_time_s is not None:
            found = found + sizes.slow * torch.exp(-self._gaps / sizes.slow_time_s)
        missing = self.mask <= 0
        found = torch.where(missing[:, :, None] | missing[:, None], 0.0, found)
        return found + torch.diag_embed(torch.where(missing, 1.0, sizes.white + 1e-6))

    @cached_property
    def _gaps(self) -> Tensor:
        """Times between frames, shape (B, n, n) [s]."""
        return (self.times_s[:, :, None] - self.times_s[:, None]).abs()

    @cached_property
    def _paths(self) -> Tensor:
        """Covariance (B, n, n) of the path of an acceleration of variance 1."""
        path = 0.5 * (self.times_s - self.times_s[:, :1]).square() * self.mask
        return path[:, :, None] * path[:, None]

    @cached_property
    def _by_axes(self) -> dict[tuple[int, ...], Tensor]:
        """What `_joined` has returned, by axes."""
        return {}

    def _joined(self, axes: tuple[int, ...]) -> Tensor:
        """Return derivatives by states, residuals and common directions of some axes, shape (B, n, axes * all)."""
        if axes not in self._by_axes:
            every = torch.cat((self.own, self.rows[..., None], self.common), -1)
            self._by_axes[axes] = every[:, :, axes].flatten(2).mT.contiguous().mT
        return self._by_axes[axes]


def moving(own: Tensor, other: Tensor) -> list[int]:
    """Return the states that these residuals (B, n, 3, S) determine: those that move them in every flight.

    A state that moves the residuals of the other kind more is determined by these: a turn moves the tracked point of a
    body about its centre of mass by less than its errors, and would take the place of six coefficients of a path.
    """
    size = own.square().sum((1, 2))
    moves, better = size.amin(0) > 1e-12, size.sum(0) > other.square().sum((1, 2)).sum(0)
    return torch.nonzero(moves & better)[:, 0].tolist()


def _spanned(common: Tensor, own: Tensor) -> Tensor:
    """Return orthogonal directions (B, n, 3, p) that the effects (B, n, 3, P) span beside the states (B, n, 3, S).

    The effects are those of usual size.
    """
    flat, states = common.flatten(1, 2), own.flatten(1, 2)
    basis = torch.linalg.qr(states)[0]
    left = flat - basis @ (basis.mT @ flat)
    every = left.flatten(0, 1)
    scale = every.norm(dim=0)
    some = scale > LEAST_MOVE
    if not bool(some.any()):
        return common[..., :0]
    every = every[:, some] / scale[some]
    u, s, _ = torch.linalg.svd(every, full_matrices=False)
    return u[:, s > KEPT * s.max()].unflatten(0, left.shape[:2]).unflatten(1, common.shape[1:3])


def _spread_frames(mask: Tensor, times_s: Tensor, spacing_s: float) -> Tensor:
    """Return at most `FRAMES` of the frames (T,) that count, evenly spread, one in each interval of a length [s]."""
    frames = torch.nonzero(mask > 0)[:, 0]
    if len(frames) and spacing_s > 0:
        interval = ((times_s[frames] - times_s[frames[0]]) / spacing_s + 1e-6).floor()
        frames = frames[torch.cat((interval[:1] >= 0, interval.diff() > 0))]
    if not len(frames):
        return torch.zeros(1, dtype=torch.long)
    count = min(len(frames), FRAMES)
    return frames[torch.linspace(0, len(frames) - 1, count).round().long()]


def _root(matrix: Tensor) -> Tensor:
    """Return the Cholesky factor of a normal matrix, with a hint of a prior."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1).detach()
    return torch.linalg.cholesky(matrix + torch.diag_embed(1e-9 * diagonal + 1e-12))
