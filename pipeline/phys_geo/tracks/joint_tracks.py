"""Tracks of a jointed body's links as values and speeds of its joints, with their errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.rotation import quat_conjugate, quat_log, quat_multiply
from ...physics.chains.chain import Chain
from ...physics.chains.dynamics import Balance, ChainDynamics, ChainMotion
from ...physics.chains.state import joint_values
from ...physics.state import State
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.track_noise import Noise

SPEED_S, SPEED_FRAMES = 0.06, 5
"""Least length [s] and number of frames of the parabola that gives a speed."""


@dataclass(frozen=True, kw_only=True)
class JointTracks:
    """Joints (J) of a chain on a fixed root in episodes (E) at frames (T)."""

    world: World
    chain: Chain
    root: Tensor
    """Pose of the root: place [m] and quaternion, shape (7,)."""
    times_s: Tensor
    """Times of the frames, shape (E, T) [s]."""
    shown: Tensor
    """Whether an episode has the frame, and no joint has come to a limit, shape (E, T)."""
    values: Tensor
    """Values that fit the measured poses of the links best [rad or m], shape (E, T, J)."""
    information: Tensor
    """Information of these poses on them, shape (E, T, J, J)."""
    speeds: Tensor
    """Speeds by a parabola over neighbouring frames, shape (E, T, J)."""
    speed_std: Tensor
    """Their standard deviations, shape (E, T, J)."""

    @staticmethod
    def of(world: World, chain: Chain, seen: Observations, noise: Noise) -> JointTracks:
        """Return the joints of a chain.

        Args:
            world: The world.
            chain: The chain.
            seen: The observations.
            noise: Of the tracks (position [m], rotation [rad]).
        """
        at = world.body_names.index(chain.root)
        root = torch.cat((seen.state.position_m[:, at].median(0).values, seen.state.quat_wxyz[0, at]))
        values, information = _values(world, chain, root, seen, noise)
        shown = torch.arange(values.shape[1]) < seen.frames[:, None]
        shown = shown & ~_at_limit(chain, values, information, shown)
        information = information * shown[..., None, None]
        speeds, std = _speeds(seen.times_s, values, information, shown)
        return JointTracks(
            world=world,
            chain=chain,
            root=root,
            times_s=seen.times_s,
            shown=shown,
            values=values,
            information=information,
            speeds=speeds,
            speed_std=std,
        )

    def kicked(self, intervals: Tensor) -> JointTracks:
        """Return the tracks with speeds that may jump in some intervals (E, T - 1)."""
        speeds, std = _speeds(self.times_s, self.values, self.information, self.shown, intervals)
        return replace(self, speeds=speeds, speed_std=std)

    @cached_property
    def balance(self) -> Balance:
        """The terms of the equation of motion at rest at all frames (E T)."""
        return balance_at(self.world, self.chain, self.root, self.values.flatten(0, 1))


def balance_at(world: World, chain: Chain, root: Tensor, values: Tensor) -> Balance:
    """Return the terms of the equation of motion of a chain at rest at values of its joints (B, J)."""
    still = values.new_zeros(len(values), 3)
    at = ChainMotion(root[:3].expand_as(still), root[3:].expand(len(values), 4), still, still, values, 0 * values)
    return ChainDynamics(chain, world.bodies).balance(at, world.gravity)


def _values(world: World, chain: Chain, root: Tensor, seen: Observations, noise: Noise) -> tuple[Tensor, Tensor]:
    """Return values (E, T, J) that fit the poses of links best, by one step from those that joints admit, and (.., J).

    The second are the information (E, T, J, J) that the poses have on them.
    """
    names, size = world.body_names, seen.times_s.shape
    position = seen.state.position_m[:, None].repeat(1, size[1], 1, 1)
    quat = seen.state.quat_wxyz[:, None].repeat(1, size[1], 1, 1)
    position[:, :, list(seen.free)], quat[:, :, list(seen.free)] = seen.position_m, seen.quat_wxyz
    position[:, :, names.index(chain.root)], quat[:, :, names.index(chain.root)] = root[:3], root[3:]
    position, quat = position.flatten(0, 1), quat.flatten(0, 1)
    guess, _ = joint_values(names, State(position, quat, 0 * position, 0 * position), chain, exact=False)
    places, turns = chain.poses(root[:3].expand(len(guess), 3), root[3:].expand(len(guess), 4), guess)
    links = [names.index(name) for name in chain.links]
    turned = quat_log(quat_multiply(quat[:, links], quat_conjugate(turns)))
    off = torch.cat((position[:, links] - places, turned), -1)
    weight = torch.zeros_like(off)
    for column, index in enumerate(seen.free):
        link = links.index(index)
        if link:  # the root does not move
            weight[:, link, :3] = (seen.seen[..., column] / noise.position_m**2).flatten()[:, None]
            weight[:, link, 3:] = (seen.has_orientation[..., column] / noise.rotation_rad**2).flatten()[:, None]
    rows = balance_at(world, chain, root, guess).rows
    heavy = (rows * weight[..., None]).transpose(-1, -2)
    information, slope = (heavy @ rows).sum(1), (heavy @ off[..., None]).sum(1)
    values = guess + (torch.linalg.pinv(information, hermitian=True) @ slope)[..., 0]
    return values.unflatten(0, size), information.unflatten(0, size)


def _at_limit(chain: Chain, values: Tensor, information: Tensor, shown: Tensor) -> Tensor:
    """Return the frames (E, T) from the first one on at which a joint may be at a limit."""
    error = 3 * information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
    ends = (values - error <= chain.numbers("lower")) | (values + error >= chain.numbers("upper"))
    return (ends.any(-1) & shown).cumsum(1) > 0


def parabola_speeds(
    time_s: NDArray[np.float64],
    values: NDArray[np.float64],
    error: NDArray[np.float64],
    kicked: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the speeds of values at times (K,) by parabolas over neighbouring ones, and their standard deviations.

    Args:
        time_s: Times [s], shape (K,).
        values: Values, shape (K, n).
        error: Their standard deviations, shape (K, n).
        kicked: Intervals (K - 1,) in which speeds may jump: a parabola does not go on behind the one that is nearest.
    """
    speeds, std = np.zeros_like(values), np.full_like(values, np.inf)
    if len(time_s) < SPEED_FRAMES:
        return speeds, std
    reach = max(SPEED_FRAMES // 2, int(np.ceil(0.5 * SPEED_S / np.median(np.diff(time_s)))))
    jumps = np.flatnonzero(kicked) if kicked is not None else np.zeros(0, int)
    for k in range(len(time_s)):
        low, high = 0, len(time_s)
        nearest = jumps[np.abs(jumps + 0.5 - k).argmin()] if len(jumps) else -len(time_s)
        if abs(nearest + 0.5 - k) < reach:
            low, high = (0, nearest + 1) if k <= nearest else (nearest + 1, high)
        first = min(max(k - reach, low), max(high - 2 * reach - 1, low))
        rows = slice(first, min(first + 2 * reach + 1, high))
        t = time_s[rows] - time_s[k]
        if len(t) < SPEED_FRAMES:
            continue
        inverse = np.linalg.pinv(np.stack((np.ones_like(t), t, t**2), 1))[1]
        speeds[k] = inverse @ values[rows]
        std[k] = float(np.linalg.norm(inverse)) * error[k]
    return speeds, std


def _speeds(
    times_s: Tensor, values: Tensor, information: Tensor, shown: Tensor, kicked: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return speeds at the frames and their standard deviations, each (E, T, J)."""
    speeds, std = torch.zeros_like(values), torch.full_like(values, torch.inf)
    error = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
    for e, at in enumerate(shown):
        jumps = None if kicked is None else kicked[e, : max(int(at.sum()) - 1, 0)].numpy()
        found = parabola_speeds(times_s[e, at].numpy(), values[e, at].numpy(), error[e, at].numpy(), jumps)
        speeds[e, at], std[e, at] = (torch.as_tensor(one) for one in found)
    return speeds, std
