"""What flights show of errors: residuals, beside what their states and the effects common to all can follow."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..segments import Segments
from ..thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.slow_errors

FRAMES = 80
"""Maximum number of frames of a flight that are looked at, evenly spread: components differ by their times, which these
frames show."""
KEPT = 1e-3
"""Directions of the common effects, of unit length, that are shorter than this beside all others are left out."""
LEAST_MOVE = 0.02
"""Smallest movement of all frames together, in standard deviations, of an effect of usual size that counts: a tilt of
the frame turns the residuals that it leaves, and what is proportional to these would explain them."""


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
    timed: Tensor | None = None
    """Variances that errors of the frames' times add, in sigmas squared, shape (B, n, 3); None where times are right.
    What they add to the covariance of two axes is left out: the axes of each flight are those along and across its
    motion, of which one has hardly any errors of times."""

    @property
    def count(self) -> float:
        """Number of measured values beside what states and common effects take."""
        measured = float((self.mask.sum(1) * self.axes.sum(1)).sum())
        return measured - self.own.shape[0] * self.own.shape[-1] - self.common.shape[-1]

    @staticmethod
    def of(
        segments: Segments,
        rows: Tensor,
        jacobian: Tensor,
        count: int,
        kind: int,
        spacing_s: float = 0.0,
        alike: tuple[int, ...] = (0, 1, 2),
    ) -> FlightContrasts | None:
        """Choose frames and axes of positions (kind 0) or rotations (1) of the first free body; None without any.

        Args:
            segments: The flights.
            rows: Residuals (B, F, 6) in sigmas of white noise.
            jacobian: Their derivatives (B, F, 6, P + S) by effects, of usual size, and states.
            count: Number P of the effects' parameters.
            kind: 0 or 1.
            spacing_s: Least time between the frames.
            alike: Axes of which errors are alike, so that a flight's may be turned.
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
        timed = None
        if seen.time_shift is not None:
            shift = seen.time_shift[:, :, 0][item, place][..., columns] / segments.noise[kind] * weight
            turn = _turns(shift, alike) if bool((axes > 0).all()) else torch.eye(3).to(rows).expand(len(picked), 3, 3)
            timed, at = (shift @ turn).square(), at @ turn
            slopes = torch.einsum("bnaq,bac->bncq", slopes, turn)
        common, own = slopes[..., :count], slopes[..., count:]
        other = jacobian[:, ::bodies][item, place][:, :, slice(3 - 3 * kind, 6 - 3 * kind), count:]
        seen_there = (seen.has_orientation, seen.seen)[kind][:, :, 0][item, place] * inside
        own = own[..., moving(own, torch.nan_to_num(other) * seen_there[:, :, None, None])]
        return FlightContrasts(seen.times_s[item, place], inside, at, own, _spanned(common, own), axes, timed)


def _turns(shift: Tensor, alike: tuple[int, ...]) -> Tensor:
    """Return the turns (B, 3, 3) of some axes, by which these lie along and across motions (B, n, 3)."""
    turn = torch.eye(3).to(shift).repeat(len(shift), 1, 1)
    if len(alike) > 1:
        places = torch.tensor(alike)
        turn[:, places[:, None], places] = torch.linalg.svd(shift[..., places], full_matrices=False)[2].mT
    return turn


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
