"""Intervals between frames by what measured forces tell of them: hits between samples, joints that may stand still.

Neighbouring intervals are joined to parts of an episode, each with an unknown mean force of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ...physics.world import World
from ...trajectories.observations import Observations
from .force_driven import Grid, Pushes, hit_errors, impulse_errors
from .joint_tracks import JointTracks
from .pushed_episodes import Pushed, gaps_to_links

MOST_PARTS = 60
"""Number of parts of equal length of an episode with an unknown mean force each; parts end at kicks, too, and where the
sense changes."""
KICK = 4.0
"""Variance of an impulse, relative to the usual one, from which on an interval is a part of its own."""
OPEN = 10.0
"""Standard deviation of a force of which only the size is known, dry friction where a joint may stand still or a hit
between samples, in that size: such forces have a sign, and a narrow prior about 0 would draw the other numbers."""
MOVES = 4.0
"""Speed, in standard deviations, above which a joint moves; beside what it may lose between frames."""


def impulse_variance(
    world: World,
    seen: Observations,
    pushed: Sequence[Pushed],
    tracks: JointTracks,
    grid: Grid,
    pushes: Mapping[str, Pushes],
) -> Tensor:
    """Return the variance (E, T - 1, J) of the mean generalised force on intervals that samples do not tell."""
    balance, shape = tracks.balance, tracks.values.shape
    mass = balance.mass.diagonal(dim1=-2, dim2=-1).unflatten(0, shape[:2])[:, :-1]
    variance = torch.zeros_like(mass)
    for name, push in pushes.items():
        arms = push.arms(balance, tracks, grid)[:, :-1]
        gaps = gaps_to_links(world, seen, name)
        for e, one in enumerate(pushed):
            track, times = one.force(name), tracks.times_s[e].numpy()
            if track is not None:
                known = impulse_errors(track, one.std_n[name], times)
                hits = OPEN * hit_errors(track, one.std_n[name], times, gaps[e])
                variance[e] += (torch.as_tensor(known)[:, None, None] * arms[e]).square().sum(1)
                moved = torch.einsum("kcj,c->kj", arms[e], push.direction(e)).abs().clamp_min(1e-6)
                variance[e] += (mass[e] * torch.as_tensor(hits)[:, None] / moved).square()
    return variance


def kicked_intervals(tracks: JointTracks, variance: Tensor) -> Tensor:
    """Return the intervals (E, T - 1) whose impulse samples tell much worse than that of most."""
    seen = tracks.shown[:, 1:, None].expand_as(variance)
    usual = torch.stack([variance[..., j][seen[..., j]].median() for j in range(variance.shape[2])])
    return ((variance > KICK * usual) & seen).any(-1)


def senses_of_motion(tracks: JointTracks, pushes: Sequence[Pushes], grid: Grid) -> tuple[Tensor, Tensor]:
    """Return the sense (E, T - 1, J) in which joints move on intervals, 0 where one may stand, and what drives them.

    The latter is the root of the mean square (J,) of the generalised force. A joint moves for sure where it is faster
    than the errors of its speed and than what such a force takes from it in an interval.
    """
    balance, shape = tracks.balance, tracks.values.shape
    total = sum((push.at_frames(balance, tracks, grid) for push in pushes), torch.zeros(shape).to(tracks.values))
    acts = tracks.shown[..., None] & (total != 0)
    size = ((total * acts).square().sum((0, 1)) / acts.sum((0, 1)).clamp_min(1)).sqrt().clamp_min(1e-9)
    mass = balance.mass.diagonal(dim1=-2, dim2=-1).unflatten(0, shape[:2])
    lost = (size / mass)[:, :-1] * tracks.times_s.diff(dim=1)[..., None]
    fast = tracks.speeds.abs() - MOVES * tracks.speed_std
    both = torch.minimum(fast[:, 1:], fast[:, :-1]) > lost
    sense = tracks.speeds.sign()
    same = (sense[:, 1:] == sense[:, :-1]) & tracks.shown[:, 1:, None]
    return torch.where(both & same, sense[:, :-1], torch.zeros_like(lost)), size


def parts_of_force(
    tracks: JointTracks, sense: Tensor, kicks: Tensor, variance: Tensor, size: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the part (E, T - 1) of each interval, and the standard deviation (E, parts, J) of its mean force.

    Args:
        tracks: The joints.
        sense: Sense in which they move, shape (E, T - 1, J).
        kicks: Intervals that are parts of their own, shape (E, T - 1).
        variance: Variance of the mean generalised force on each interval, shape (E, T - 1, J).
        size: Size of the friction of a joint that may stand still, which lasts, shape (J,).
    """
    each = max(1, -(-sense.shape[1] // MOST_PARTS))
    new = torch.zeros_like(sense[..., 0], dtype=torch.bool)
    since = torch.zeros(len(sense), dtype=torch.long)
    for k in range(1, sense.shape[1]):
        since = since + 1
        new[:, k] = (since >= each) | (sense[:, k] != sense[:, k - 1]).any(-1) | kicks[:, k] | kicks[:, k - 1]
        since = torch.where(new[:, k], torch.zeros_like(since), since)
    part = new.to(torch.long).cumsum(1)
    length = (tracks.times_s.diff(dim=1) * tracks.shown[:, 1:])[..., None]
    place = part[..., None].expand_as(sense)
    none = sense.new_zeros(len(sense), int(part.max()) + 1, sense.shape[2])
    impulse = none.scatter_add(1, place, variance * length.square()).sqrt()
    whole = none.scatter_add(1, place, length.expand_as(sense))
    stands = none.scatter_add(1, place, (sense == 0) * length)
    std = torch.hypot(impulse / whole.clamp_min(1e-9), OPEN * size * stands / whole.clamp_min(1e-9))
    return part, torch.where(whole > 0, std, none).clamp_min(1e-9)
