"""Slow errors of tracked flights: what differs from flight to flight, and no physical effect explains.

A window of a few frames cannot tell an error that changes within tenths of a second from motion. Whole flights can: a
physical effect does the same in all of them, an error of the tracking does not. The residuals of whole flights are
therefore split into what common effects can follow (all candidates at once, linearised, and the state of each flight)
and the rest, whose variance components are estimated by restricted maximum likelihood (Patterson & Thompson 1971):

    white noise + a fast process + a slow process + an acceleration across gravity of each flight's own

The last is what a frame that is levelled anew for each episode makes of gravity. Effects are then judged by generalised
least squares with these errors (`innovations`): evidence adds up over episodes, not over the frames of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.io.progress import note
from ..physics.world import World
from ..trajectories.innovations import WHITE, CorrelatedNoise, NoiseModel
from ..trajectories.segmentation import Segment
from ..trajectories.track_noise import FLOOR_M, FLOOR_RAD
from .candidates import Variant
from .linearization import derivatives
from .prepare import Prepared, whole_flights
from .segment_states import fit_states
from .segments import Segments
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.slow_errors

Array = NDArray[np.float64]

FLIGHTS, FRAMES = 24, 80
"""Maximum number of flights, and of frames of each, that the estimate uses, evenly spread: the components differ by
their times, which 80 frames show."""
FASTEST_S, FAST_S, SLOW_S = 0.002, 0.06, (0.06, 1.0)
"""Shortest and longest time of the fast process [s], and the range of the slow one: a process of more than a second is
a curve in a flight, whose size and time cannot be told apart."""
STARTS_S = (0.1, 0.4)
"""Times of the slow process from which the likelihood is climbed [s]."""
LEAST_STD = 0.02
"""Smallest standard deviation of a component, in units of that of the tracks."""
SHORTEST = 12
"""Minimum number of frames of a flight."""
KEPT = 1e-3
"""Directions of the common effects that move no frame by more than this many standard deviations are left out."""
COMMON_S = 0.1
"""Length [s] of the intervals in each of which one force may act in all episodes alike."""
STEPS = 260
"""Maximum number of likelihoods of a climb."""


@dataclass(frozen=True)
class SlowErrors:
    """The variance components of tracked flights."""

    noise_model: NoiseModel
    """The noise model, with its slow part."""
    without_sway: NoiseModel
    """The likeliest one without accelerations of the flights' own."""
    evidence: float
    """Twice the gain of the log-likelihood by the slow process."""
    sway_evidence: float
    """Twice the gain by accelerations of the flights' own, beside the slow process."""

    def position_m(self, std_m: float) -> float:
        """Return the standard deviation [m] of the slow errors of positions, from that of the tracks [m]."""
        return self.noise_model.position.slow * std_m

    def tiltless(self) -> SlowErrors | None:
        """Return the slow errors without accelerations of the flights' own; None where nothing is left."""
        if not self.without_sway.slow:
            return None
        return SlowErrors(self.without_sway, self.without_sway, self.evidence, 0.0)

    def sway_m_s2(self, std_m: float) -> float:
        """Return the standard deviation [m/s2] of the flights' own accelerations, from that of the tracks [m]."""
        return self.noise_model.position.sway * std_m


def slow_errors(prepared: Prepared, world: World, variants: Sequence[Variant]) -> SlowErrors | None:
    """Return the variance components of whole flights; None where the tracks' noise explains them.

    Args:
        prepared: The episodes.
        world: The world with the effects found so far.
        variants: The candidates, all of which are allowed for.
    """
    if prepared.flight is None:
        return None
    items = [i for i in whole_flights(prepared.flight.items) if i.last - i.first + 1 >= SHORTEST]
    if len({item.episode for item in items}) < LIMITS.least_episodes:
        return None
    chosen = np.linspace(0, len(items) - 1, min(len(items), FLIGHTS)).round().astype(int)
    note(f"slow errors of the tracks: {len(chosen)} whole flights")
    return _of_flights(prepared, world, variants, [items[k] for k in chosen])


def _of_flights(
    prepared: Prepared, world: World, variants: Sequence[Variant], items: Sequence[Segment]
) -> SlowErrors | None:
    """Return the variance components of chosen flights; None where the tracks' noise explains them."""
    fitted = fit_states(prepared.segments("flight", world, items))
    plain = Segments.of("flight", world, prepared.observations, items, prepared.noise, WHITE)
    plain = plain.with_state(fitted.observations.state)
    parameters, rows, jacobian = derivatives(plain, world, variants)
    timed = _timed_forces(plain)
    jacobian = torch.cat((timed, jacobian), -1)
    kinds = [_Contrasts.of(plain, rows, jacobian, len(parameters) + timed.shape[-1], kind) for kind in (0, 1)]
    found, plain_found, evidence, sway_evidence = [], [], 0.0, 0.0
    for kind, contrasts in enumerate(kinds):
        if contrasts is None:
            found.append(prepared.noise_model[kind])
            plain_found.append(prepared.noise_model[kind])
            continue
        level = tuple(_level_axes(world)) if kind == 0 else ()
        noise, still, slow, sway = _components(contrasts, prepared.noise_model[kind], level)
        floor = (FLOOR_M, FLOOR_RAD)[kind] / prepared.noise[kind]
        real = max(noise.slow, noise.size) > floor
        found.append(noise if real else prepared.noise_model[kind])
        plain_found.append(still if real else prepared.noise_model[kind])
        evidence, sway_evidence = max(evidence, slow * real), max(sway_evidence, sway * real)
    model = NoiseModel(*found)
    return SlowErrors(model, NoiseModel(*plain_found), evidence, sway_evidence) if model.slow else None


def _timed_forces(segments: Segments) -> Tensor:
    """Return the derivatives (B, F, 6, P) of residuals by forces that act in one interval of time in all episodes.

    A force that follows the clock, as a gust or a shaking, does the same in all episodes and is no error of tracks.
    """
    seen = segments.observations
    times, bodies = seen.times_s, len(seen.free)
    found = times.new_zeros(*times.shape, 6, 0)
    if len({item.episode for item in segments.items}) >= LIMITS.least_episodes:
        ends = [float(times[k, n - 1]) for k, n in enumerate(segments.lengths)]
        edges = torch.arange(float(times[:, 0].min()), max(ends), COMMON_S).to(times)
        late = (times[..., None] - edges).clamp_min(0.0)
        path = 0.5 * (late.square() - (late - COMMON_S).clamp_min(0.0).square())
        # a residual is the model less the measurement, or the reverse: only the space that they span matters
        path = path / segments.noise.position_m
        found = torch.stack(
            [torch.nn.functional.one_hot(torch.tensor(a), 6).to(path)[:, None] * path[..., None, :] for a in range(3)],
            -1,
        )
        found = found.flatten(-2)
    return found.repeat_interleave(bodies, 1)


def _level_axes(world: World) -> list[int]:
    """Return the axes across gravity, all without gravity."""
    gravity = world.gravity[0].abs()
    return [axis for axis in range(3) if float(gravity[axis]) < float(gravity.max()) or float(gravity.max()) == 0]


@dataclass(frozen=True, eq=False)
class _Contrasts:
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
    def of(segments: Segments, rows: Tensor, jacobian: Tensor, count: int, kind: int) -> _Contrasts | None:
        """Choose frames and axes of positions (kind 0) or rotations (1) of the first free body; None without any."""
        seen = segments.observations
        mask = (seen.seen, seen.has_orientation)[kind][:, :, 0]
        if float(mask.sum()) < LIMITS.least_frames:
            return None
        bodies = len(seen.free)
        picked = [_spread_frames(one) for one in mask]
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
        return _Contrasts(seen.times_s[item, place], inside, at, own, _spanned(common, own), axes)

    def likelihood(self, noise: CorrelatedNoise) -> float:
        """Return the restricted log-likelihood of a noise model."""
        logs, whitened = 0.0, []
        still = self._covariance(noise)
        level = noise.level if noise.sway else ()
        for axes in (tuple(level), tuple(a for a in range(3) if a not in level)):
            if not axes:
                continue
            factor = torch.linalg.cholesky(still + noise.sway**2 * self._paths if axes == level else still)
            flat = torch.linalg.solve_triangular(factor, self._joined(axes), upper=False)
            whitened.append(flat.unflatten(2, (len(axes), -1)).flatten(1, 2))
            diagonal = factor.diagonal(dim1=1, dim2=2).log() * self.mask
            logs += 2 * float((diagonal.sum(1) * self.axes[:, axes].sum(1)).sum())
        white = whitened[0] if len(whitened) == 1 else torch.cat(whitened, 1)
        own = self.own.shape[-1]
        basis, triangle = torch.linalg.qr(white[..., :own])
        logs += 2 * float(triangle.diagonal(dim1=1, dim2=2).abs().clamp_min(1e-12).log().sum())
        left = white[..., own:]
        left = (left - basis @ (basis.mT @ left)).flatten(0, 1)
        normal = left.mT @ left
        square, slope, matrix = float(normal[0, 0]), normal[1:, 0], normal[1:, 1:]
        if len(matrix):
            chol = torch.linalg.cholesky(matrix + 1e-9 * torch.diag(matrix.diagonal()) + 1e-12 * torch.eye(len(matrix)))
            solved = torch.linalg.solve_triangular(chol, slope[:, None], upper=False)
            square -= float(solved.square().sum())
            logs += 2 * float(chol.diagonal().log().sum())
        return -0.5 * (logs + square)

    def _covariance(self, noise: CorrelatedNoise) -> Tensor:
        """Return the covariance (B, n, n) of the frames of one axis without accelerations of the flights' own.

        It is the unit matrix where a frame does not count.
        """
        square = noise.size**2
        found = torch.exp(self._gaps / -noise.time_s).mul_(square * noise.share)
        if noise.slow:
            found.add_(torch.exp(self._gaps / -noise.slow_time_s), alpha=noise.slow**2)
        found.diagonal(dim1=1, dim2=2).add_(torch.where(self.mask > 0, square * (1 - noise.share) + 1e-6, 1.0))
        return found

    @cached_property
    def _gaps(self) -> Tensor:
        """Times between frames, shape (B, n, n) [s]; infinite where one does not count."""
        gap = (self.times_s[:, :, None] - self.times_s[:, None]).abs()
        return torch.where(self.mask[:, :, None] * self.mask[:, None] > 0, gap, torch.inf)

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
    """Return orthogonal directions (B, n, 3, p) that the effects (B, n, 3, P) span beside the states (B, n, 3, S)."""
    flat, states = common.flatten(1, 2), own.flatten(1, 2)
    basis = torch.linalg.qr(states)[0]
    left = flat - basis @ (basis.mT @ flat)
    every = left.flatten(0, 1)
    scale = every.norm(dim=0)
    some = scale > 1e-9 * scale.max().clamp_min(1e-30)
    if not bool(some.any()):
        return common[..., :0]
    every = every[:, some] / scale[some]
    u, s, _ = torch.linalg.svd(every, full_matrices=False)
    return u[:, s > KEPT * s.max()].unflatten(0, left.shape[:2]).unflatten(1, common.shape[1:3])


def _spread_frames(mask: Tensor) -> Tensor:
    """Return at most `FRAMES` of the frames (T,) that count, evenly spread."""
    frames = torch.nonzero(mask > 0)[:, 0]
    if not len(frames):
        return torch.zeros(1, dtype=torch.long)
    count = min(len(frames), FRAMES)
    return frames[torch.linspace(0, len(frames) - 1, count).round().long()]


def _components(
    contrasts: _Contrasts, known: CorrelatedNoise, level: tuple[int, ...]
) -> tuple[CorrelatedNoise, CorrelatedNoise, float, float]:
    """Return the likeliest components, those without accelerations of the flights' own, and twice the gains by both.

    Components without evidence are left out; without a slow one the known noise is returned.
    """
    plain, without = _climbed(contrasts, [_coded(known)], (), level)
    starts = [[*_coded(plain), np.log(max(plain.size, 0.3)), np.log(t)] for t in STARTS_S]
    slow, with_slow = _climbed(contrasts, starts, ("slow",), level)
    gain = 2 * (with_slow - without)
    best, reached, sway_gain = (slow, with_slow, 0.0) if gain > LIMITS.evidence else (plain, without, 0.0)
    still = best if best.slow else known
    if level:
        span = float((contrasts.times_s[:, -1] - contrasts.times_s[:, 0]).median())
        kinds = ("slow", "sway") if best.slow else ("sway",)
        start = [*_coded(best), *([np.log(best.slow), np.log(best.slow_time_s)] if best.slow else [])]
        usual = np.log(4 * max(best.slow, best.size) / span**2)
        swaying, higher = _climbed(contrasts, [[*start, usual + more] for more in (0.0, 1.5)], kinds, level)
        sway_gain = 2 * (higher - reached)
        if sway_gain > LIMITS.sway_evidence:
            best = swaying
    gain = gain if best.slow else 0.0
    return (best if best.slow or best.sway else known), still, gain, sway_gain if best.sway else 0.0


def _coded(noise: CorrelatedNoise) -> list[float]:
    """Return the coordinates of white and fast noise: logarithms of two standard deviations and a time."""
    white = noise.size * np.sqrt(max(1 - noise.share, 0.0))
    fast = noise.size * np.sqrt(max(noise.share, 0.0))
    return [np.log(max(white, 0.1)), np.log(max(fast, 0.1)), np.log(np.clip(noise.time_s, 2 * FASTEST_S, FAST_S / 1.5))]


def _decoded(z: Array, kinds: Sequence[str], level: tuple[int, ...]) -> CorrelatedNoise:
    """Return the noise model of coordinates; times are within their ranges."""
    white, fast = np.exp(2 * np.clip(z[:2], np.log(LEAST_STD), 12.0))
    rest = list(z[3:])
    slow, time_s = (np.exp(np.clip(rest.pop(0), -9, 12)), rest.pop(0)) if "slow" in kinds else (0.0, 0.0)
    sway = float(np.exp(np.clip(rest.pop(0), -20, 20))) if "sway" in kinds else 0.0
    return CorrelatedNoise(
        share=float(fast / (white + fast)),
        time_s=float(np.clip(np.exp(np.clip(z[2], -9, 2)), FASTEST_S, FAST_S)),
        size=float(np.sqrt(white + fast)),
        slow=float(slow),
        slow_time_s=float(np.clip(np.exp(np.clip(time_s, -9, 2)), *SLOW_S)) if slow else 1.0,
        sway=sway,
        level=level or (0, 1),
    )


def _climbed(
    contrasts: _Contrasts, starts: Sequence[Sequence[float]], kinds: Sequence[str], level: tuple[int, ...]
) -> tuple[CorrelatedNoise, float]:
    """Return the likeliest noise model with components of some kinds, and its restricted log-likelihood."""

    def cost(z: Array) -> float:
        try:
            return -contrasts.likelihood(_decoded(z, kinds, level))
        except RuntimeError:  # a covariance that is singular to rounding is not one of measurements
            return 1e12

    from scipy.optimize import minimize

    options = {"maxfev": STEPS, "xatol": 0.03, "fatol": 0.1}
    ends = [minimize(cost, np.array(start), method="Nelder-Mead", options=options) for start in starts]
    best = min(ends, key=lambda end: end.fun)
    return _decoded(best.x, kinds, level), -float(best.fun)
