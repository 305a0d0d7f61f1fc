"""Losses of a jointed body that is pushed by unknown forces, from where it glides.

While something pushes, any loss fits any path of it: the finger goes on, and the drawer with it. What is told of losses
then are the depths of their contact, some micrometres to tenths of a millimetre under the law, in which the shape and
path of the finger count as exact; so they are told wrongly, and too surely. Where nothing touches the links, they move
as a body that is let go, with no force but weight and losses:

    M(q) q'' + b(q, q') = -d q' - f s,

and the only unknown beside the losses is the start of each such part. Frames are kept as long as the track shows that
all joints move on, so that s is known. It tells losses by mass, of which the file's is taken, and nothing where a body
does not glide: then they are not observable.

The motion is linear in the losses, so that their likelihood is a normal density where they are positive. Where a part
tells friction + damping * speed alone, a prior for logarithms would say how the two share it; so intervals
are those of the profile of the likelihood here. A loss of which it tells a limit alone is not observable.
Contact time and damping ratio of what pushes are told by depths, too: without forces they are not observable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from ....datasets.capture.tracks import Episode
from ....schemas.materials import of_pair
from ...optimization.levenberg_marquardt import Solution, robust_loss
from ...optimization.uncertainty import REACH
from ...physics.chains.parameters import LOSSES, chain_parameters
from ...physics.parameters import CONTACT_TIME, DAMPING_RATIO, Parameter
from ...physics.world import World
from ...trajectories.initial_state import clearance
from ...trajectories.observations import Observations
from ...trajectories.track_noise import Noise, estimate_noise
from .driven_result import DrivenFit
from .force_driven import NEAR_M, ForceDriven, Grid
from .joint_losses import (
    FLAT,
    MOST_FRAMES,
    ROBUST_SCALE,
    JointLosses,
    information_root,
    starts,
    takes,
)
from .joint_tracks import JointTracks

FEWEST_FRAMES = 4
"""Frames of the shortest part: two are its start."""
NOISES = 4.0
"""Errors, in standard deviations, above which a gap is open and a joint moves."""
LAG_S = 0.03
"""Time over which a joint is seen to move on [s]: a speed of 40 mm/s where tracks have errors of 0.2 mm."""
OPEN = 100.0
"""Factor on the width of the prior of a start, which is that of a straight line: a part may be few frames long, over
which losses take most of the speed."""
WEAK = 1e-3
"""Information, as a root, that makes the density of losses one where the data tell nothing, in their units."""
LIMIT_ALONE = 50.0
"""Ratio of the ends of an interval from which on a loss is not observable: the lower one is 0 where a limit is told."""
BISECTIONS, TINY = 30, 1e-12
"""Halvings of the place of an end, and the least loss [SI], whose logarithm stands for that of none."""
Part = tuple[Episode, tuple[float, float]]
"""An episode, and the times of the first and the last frame of a part of it [s]."""


def fit_gliding_joints(world: World, episodes: Sequence[Episode], noise: Noise) -> DrivenFit | None:
    """Return losses, and a factor of inertia if there is one, of a jointed body that unknown forces drive.

    They have their priors where it does not glide; None for worlds other than one jointed body on a fixed root that
    driven bodies push.

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        noise: Of the tracks (position [m], rotation [rad]).
    """
    if not takes(world) or not world.driven:
        return None
    parameters, noise = chain_parameters(world), _own_noise(world, episodes, noise)
    parts = _moving(world, glides(world, episodes), noise)
    values = np.array([p.encode(p.prior[0]) for p in parameters])
    covariance, record = np.diag([p.prior[1] ** 2 for p in parameters]), {"parts": len(parts)}
    if parts:
        values, covariance, found = _fitted(_Parts.of(world, parameters, parts, noise))
        record |= found
    return DrivenFit(
        parameters=parameters,
        values=values,
        covariance=covariance,
        pressed=[],
        record=record,
        open=_laws_of_what_pushes(world),
    )


def _laws_of_what_pushes(world: World) -> frozenset[str]:
    """Return the names of contact times and damping ratios of links and driven bodies."""
    driven = [k for k, body in enumerate(world.bodies) if body.name in world.driven]
    pairs = [world.materials_of(link, k) for k in driven for link in world.tracked]
    return frozenset(of_pair(p.name, pair) for p in (CONTACT_TIME, DAMPING_RATIO) for pair in pairs)


def glides(world: World, episodes: Sequence[Episode]) -> list[Part]:
    """Return the parts of episodes in which links touch nothing."""
    seen, found = _observed(world, [(one, (-math.inf, math.inf)) for one in episodes]), []
    gaps = clearance(world, seen).numpy()
    for e, episode in enumerate(episodes):
        times = seen.times_s[e, : int(seen.frames[e])].numpy()
        for first, last in free_runs(gaps[e, : len(times)]):
            last_kept = min(last, first + MOST_FRAMES - 1)
            if last_kept - first + 1 >= FEWEST_FRAMES:
                found.append((episode, (float(times[first]), float(times[last_kept]))))
    return found


def free_runs(gap_m: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return first and last frame of each longest run in which nothing touches, from the gaps (T,) at the frames.

    Something may touch between two frames where the gap at one of them is below that at which a driven body may hit
    (`NEAR_M`), the way by which it came closer from one frame to the next, and the errors of the gap.
    """
    if len(gap_m) < 2:
        return []
    closer = np.maximum(-np.diff(gap_m), 0.0)
    before = np.maximum(closer, np.concatenate((closer[:1], closer[:-1])))
    return _runs(np.minimum(gap_m[1:], gap_m[:-1]) > NEAR_M + before + NOISES * roughness(gap_m))


def roughness(values: NDArray[np.float64]) -> float:
    """Return the standard deviation of the errors of values (T,), from what is not smooth in them."""
    bends = np.abs(np.diff(values, 3))
    bends = bends[np.isfinite(bends)]
    return float(np.median(bends)) / 0.6745 / math.sqrt(20.0) if len(bends) else 0.0


def moves_on(
    time_s: NDArray[np.float64], values: NDArray[np.float64], error: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sense (T - 1, J) in which joints move on intervals between frames, 0 where one may have stopped.

    A joint moves for sure between two frames if it goes on by more than its errors after both, in the sense of before.

    Args:
        time_s: Times [s], shape (T,).
        values: Of the joints, shape (T, J).
        error: Their standard deviations, shape (T, J).
    """
    frames = np.arange(len(time_s))
    lag = max(1, round(LAG_S / float(np.median(np.diff(time_s)))))
    after, before = np.minimum(frames + lag, frames[-1]), np.maximum(frames - lag, 0)
    sure = NOISES * np.hypot(error[after], error)
    ahead = values[after] - values
    ahead = np.where((np.abs(ahead) > sure) & (frames + lag <= frames[-1])[:, None], np.sign(ahead), 0.0)
    behind = np.where(frames[:, None] > 0, np.sign(values - values[before]), ahead)
    same = (ahead[1:] == ahead[:-1]) & (behind[:-1] == ahead[:-1])
    return np.where(same, ahead[:-1], 0.0)


@dataclass(frozen=True, kw_only=True)
class _Parts(JointLosses):
    """Parts (E) of episodes in which nothing pushes; fitted are losses, and the factor of inertia, if there is one."""

    @staticmethod
    def of(world: World, parameters: Sequence[Parameter], parts: Sequence[Part], noise: Noise) -> _Parts:
        """Collect them."""
        tracks = JointTracks.of(world, world.chains[0], _observed(world, parts), noise)
        grid, last = Grid.of(tracks.times_s, tracks.shown), tracks.shown.sum(1) - 1
        every, (middle, speed, *std) = torch.arange(len(parts)), starts(tracks)
        sense = (tracks.values[every, last] - tracks.values[:, 0]).sign()[:, None].expand_as(tracks.values[:, 1:])
        return _Parts(
            driven=ForceDriven(
                world=world, chain=tracks.chain, root=tracks.root, grid=grid, pushes=[], sense=sense.contiguous()
            ),
            tracks=tracks,
            parameters=parameters,
            root=information_root(tracks.information),
            start=(middle, speed, OPEN * std[0], OPEN * std[1]),
            units=torch.tensor([p.prior[0] if p.name.endswith(LOSSES) else 0.0 for p in parameters]).double(),
        )


def _fitted(data: _Parts) -> tuple[NDArray[np.float64], NDArray[Any], dict[str, Any]]:
    """Return values (P,) and covariance (P, P) in fitted coordinates, and a record."""
    first = [
        ((p.bounds[0] / unit, p.bounds[1] / unit), 1.0, 1 / FLAT) if unit else (p.limits, 0.0, p.prior[1])
        for p, unit in zip(data.parameters, data.units.tolist(), strict=True)
    ]
    states = data.tracks.values.new_zeros(len(data.root), 2 * data.tracks.values.shape[2])
    best, _, _ = data.descent(states, first)
    misfit = _misfit(data, best)
    over = max(1.0, misfit)
    information, slope = best.information.numpy() / over, best.scores.sum(0).numpy() / over
    values, covariance = _posterior(data, best.shared.numpy(), information, slope)
    return values, covariance, {"misfit": misfit, "information_over": over, "converged": best.converged}


def _posterior(
    data: _Parts, best: NDArray[np.float64], information: NDArray[Any], slope: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Return middle (P,) and covariance (P, P) of the intervals in fitted coordinates, with priors for untold losses.

    Args:
        data: The parts.
        best: The end of the descent: losses in their units, and logarithms of factors, shape (P,).
        information: Of the data on these coordinates there, shape (P, P).
        slope: Of the logarithm of the data's likelihood there, shape (P,).
    """
    units, names = data.units.numpy(), data.parameters
    linear, width = units > 0, np.array([p.prior[1] for p in names])
    precision = information + np.diag(np.where(linear, WEAK, 1 / width) ** 2)
    middle = best + np.linalg.solve(precision, slope + np.where(linear, 0.0, -best / width**2))
    inside = np.where(linear, 0.0, -np.inf)
    ends = np.array([interval(middle, precision, inside, k) for k in range(len(middle))])
    ends[linear] = np.log(np.maximum(ends[linear] * units[linear, None], TINY))
    std = (ends[:, 1] - ends[:, 0]) / (2 * REACH)
    both = np.linalg.inv(precision)
    own = np.sqrt(np.diag(both))
    covariance, values = both / np.outer(own, own) * np.outer(std, std), ends.mean(1)
    for k in np.flatnonzero(linear & (ends[:, 1] - ends[:, 0] > math.log(LIMIT_ALONE))).tolist():
        values[k], covariance[k], covariance[:, k] = names[k].encode(names[k].prior[0]), 0.0, 0.0
        covariance[k, k] = width[k] ** 2
    return values, covariance


def interval(
    middle: NDArray[np.float64], precision: NDArray[Any], least: NDArray[np.float64], k: int
) -> tuple[float, float]:
    """Return the interval of coordinate k of a normal likelihood, whose others take the best values above `least`.

    The profile of the likelihood falls by half of the square of `REACH` from its highest value to the ends.
    """
    root = np.linalg.cholesky(precision).T
    others = [j for j in range(len(middle)) if j != k]

    def height(value: float) -> float:
        wanted = root @ middle - root[:, k] * value
        if not others:
            return float(np.square(wanted).sum())
        bounds = (least[others], np.full(len(others), np.inf))
        return 2 * float(lsq_linear(root[:, others], wanted, bounds).cost)

    best = lsq_linear(root, root @ middle, (least, np.full(len(middle), np.inf)))
    limit, at = 2 * float(best.cost) + REACH**2, float(best.x[k])
    std = float(np.linalg.inv(precision)[k, k] ** 0.5)
    ends = []
    for side in (-1, 1):
        near, far = at, at + side * std * (REACH + 1 + abs(at - middle[k]) / std)
        far = max(far, least[k])
        while side > 0 and height(far) < limit:
            far += far - near
        if side < 0 and height(far) <= limit:
            near = far
        for _ in range(BISECTIONS):
            half = 0.5 * (near + far)
            near, far = (half, far) if height(half) < limit else (near, half)
        ends.append(near)
    return ends[0], ends[1]


def _misfit(data: _Parts, end: Solution) -> float:
    """Return the mean square of the residuals by their degrees of freedom."""
    found, _ = data.residuals(end.shared, end.states, False)
    cost = float(robust_loss(found.square().sum(-1), ROBUST_SCALE)[0].sum())
    free = int(data.tracks.shown.sum()) * found.shape[-1] - end.states.numel() - len(end.shared)
    return cost / max(free, 1)


def _own_noise(world: World, episodes: Sequence[Episode], noise: Noise) -> Noise:
    """Return the noise of links that move, where it is larger than that of all tracks: fixed ones may have none."""
    moving = {n for n in world.chains[0].links if world.chains[0].moves(n)}
    own = estimate_noise([track for _, tracks in episodes for name, track in tracks.items() if name in moving])
    return Noise(max(own.position_m, noise.position_m), max(own.rotation_rad, noise.rotation_rad))


def _moving(world: World, parts: Sequence[Part], noise: Noise) -> list[Part]:
    """Return the parts of parts in which all joints move for sure."""
    if not parts:
        return []
    tracks, found = JointTracks.of(world, world.chains[0], _observed(world, parts), noise), []
    known = tracks.information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
    for e, (episode, _) in enumerate(parts):
        at = tracks.shown[e]
        if int(at.sum()) < FEWEST_FRAMES:
            continue
        times, values = tracks.times_s[e, at].numpy(), tracks.values[e, at].numpy()
        sense = moves_on(times, values, np.maximum(known[e, at].numpy(), [roughness(one) for one in values.T]))
        for sign in sorted({tuple(row) for row in sense.tolist() if all(row)}):
            runs = _runs((sense == np.array(sign)).all(-1))
            # without the frames whose errors say where a part begins and ends
            inner = [(i + 1, k - 1) for i, k in runs if k - i - 1 >= FEWEST_FRAMES]
            found += [(episode, (float(times[i]), float(times[k]))) for i, k in inner]
    return found


def _observed(world: World, parts: Sequence[Part]) -> Observations:
    """Return the frames of parts."""
    return Observations.of(
        world, [one for one, _ in parts], [(first - 1e-9, last + 1e-9) for _, (first, last) in parts]
    )


def _runs(holds: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and last frame of each longest run of intervals (T - 1) on which something holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], holds.astype(int), [0]))))
    return [(int(begin), int(end)) for begin, end in zip(edges[::2], edges[1::2], strict=True)]
