"""Losses in joints and mass of a jointed body from the measured forces that drive it, by its momentum.

A rollout through the contact law turns the path of a driven body into forces, so that shapes, paths and the law of the
contact, which are known to tenths of a millimetre at best, count as exact; what they cannot follow goes into losses
that are too sure. Here the measured forces are what drives the links (`force_driven.py`), and the tracks of the links
are what is fitted: gap, path and law do not enter. Fitted together are

- damping and dry friction of each joint, and one factor of all masses, which motion alone does not tell,
- how late forces are noted, unknown by half an interval between samples, whether they are samples or means, and the
  offset of a sensor's zero, known by what it reads apart from all links,
- of each episode: its start, and an unknown mean force on each of its parts.

All but the first are eliminated from the information. Where tracks differ from the model by more than their noise,
variances grow by the misfit and by what goes together in neighbouring frames; with many episodes their scatter counts,
as in `force_fit.py`.

It takes a jointed body on a fixed root, alone in its world, whose links touch nothing but driven bodies with forces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.tracks import Episode
from ...optimization.levenberg_marquardt import Solution, robust_loss
from ...physics.chains.parameters import LOSSES, chain_parameters, mass_factor
from ...physics.parameters import GAP, gap_parameters
from ...physics.world import World
from ...trajectories.initial_state import clearance
from ...trajectories.observations import Observations
from ...trajectories.track_noise import Noise, estimate_noise
from .driven_result import DrivenFit, Pressed
from .force_driven import LOADED, ForceDriven, Grid
from .force_intervals import impulse_variance, kicked_intervals, parts_of_force, senses_of_motion
from .joint_losses import FLAT, ROBUST_SCALE, JointLosses, information_root, starts, takes
from .joint_tracks import JointTracks
from .loss_posterior import posterior
from .pushed_episodes import APART_M, Pushed, pushed_link, pushes_of, sensor_zero
from .slip_friction import slip_friction

MANY_EPISODES = 8
"""Number of episodes from which on their scatter counts."""
NOTED = ((0.0, 1.0, 5.0), (0.5, 0.5, 1.5), (0.0, 1.0, 5.0))
"""Median, standard deviation and largest size of the delay, in half intervals between samples, of the part of a mean
that samples are, 0 for samples and 1 for means, and of the offset of the sensor's zero, in its standard deviation."""
MOST_MASS_ERROR = 0.1
"""Standard error of the factor of mass from which on it is not observable: where no push accelerates the body for many
samples, hits alone tell it, and impulses between samples are not known that well (1.8 for 1 with an error of 0.24)."""
MOST_CORRELATION = 0.98
"""Largest correlation of neighbouring residuals that is believed."""


def fit_driven_joints(
    world: World, episodes: Sequence[Episode], noise: Noise, force_std_n: float | None
) -> DrivenFit | None:
    """Return losses and mass of a jointed body from measured forces; None where these are not all that drives it.

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        noise: Of the tracks (position [m], rotation [rad]).
        force_std_n: Noise of a component of the forces [N]; estimated where None.
    """
    if not takes(world):
        return None
    pushed = [one for one in (Pushed.of(world, episode, force_std_n) for episode in episodes) if one is not None]
    data = _Data.of(world, pushed, noise) if pushed else None
    return None if data is None else _fitted(data)


@dataclass(frozen=True, kw_only=True)
class _Data(JointLosses):
    """Pushed episodes (E), whose last parameter is the factor of mass; forces act in parts of them."""

    pushed: Sequence[Pushed]
    """The episodes."""
    part: Tensor
    """Part of the episode with a force of its own in which each interval is, shape (E, T - 1)."""
    part_std: Tensor
    """Standard deviation of that generalised force, shape (E, parts, J)."""
    late_s: float
    """Standard deviation of the time by which forces are noted too late [s]."""
    common: ClassVar[int] = len(NOTED)

    @staticmethod
    def of(world: World, pushed: Sequence[Pushed], noise: Noise) -> _Data | None:
        """Collect them; None where links touch something else, or it is not clear which link is pushed."""
        seen = Observations.of(world, [one.episode for one in pushed], [(-math.inf, math.inf)] * len(pushed))
        alone = clearance(world, replace(seen, drives={}))
        if not bool((alone > APART_M)[seen.seen.amax(-1) > 0].all()):
            return None
        chain = world.chains[0]
        tracks = JointTracks.of(world, chain, seen, noise)
        grid = Grid.of(tracks.times_s, tracks.shown)
        names = [body.name for body in world.bodies if body.motion == "driven" and body.name in seen.drives]
        links = {name: pushed_link(world, seen, pushed, name) for name in names}
        if any(link is None for link in links.values()):
            return None
        zeros = {name: sensor_zero(world, seen, pushed, name) for name in names}
        pushed = [one.from_zero({name: zero for name, (zero, _) in zeros.items()}) for one in pushed]
        pushes = [
            pushes_of(pushed, name, link, grid, zeros[name][1]) for name, link in links.items() if link is not None
        ]
        variance = impulse_variance(world, seen, pushed, tracks, grid, dict(zip(names, pushes, strict=True)))
        kicks = kicked_intervals(tracks, variance)
        tracks = tracks.kicked(kicks)
        sense, size = senses_of_motion(tracks, pushes, grid)
        part, std = parts_of_force(tracks, sense, kicks, variance, size)
        interval = [float(np.median(np.diff(t.time_s))) for one in pushed for n in names if (t := one.force(n))]
        losses = [p for p in chain_parameters(world) if p.name.endswith(LOSSES)]
        return _Data(
            pushed=pushed,
            driven=ForceDriven(world=world, chain=chain, root=tracks.root, grid=grid, pushes=pushes, sense=sense),
            tracks=tracks,
            parameters=[*losses, mass_factor(chain)],
            root=information_root(tracks.information),
            start=starts(tracks),
            part=part,
            part_std=std,
            late_s=0.5 * float(np.median(interval)),
            units=torch.tensor([*(p.prior[0] for p in losses), 0.0], dtype=torch.float64),
        )

    def forces(self, values: Tensor, common: Tensor, states: Tensor, episode: Tensor) -> tuple[Tensor, Tensor]:
        """Return the unknown forces of the parts, and what is not known of the sensor; see `JointLosses`."""
        # in proportion to the masses, so that a factor of these leaves what unknown forces move where it is
        force = self.part_std[episode] * states * values[:, -1, None, None]
        more = force.gather(1, self.part[episode][..., None].expand(-1, -1, force.shape[2]))
        return more, torch.tensor([self.late_s, 1.0, 1.0]).to(common) * common

    @property
    def size(self) -> int:
        """Number of coordinates of an episode."""
        return (2 + self.part_std.shape[1]) * self.part_std.shape[2]


def _first_losses(data: _Data) -> NDArray[np.float64]:
    """Return a first guess (P,): losses by the change of momentum between frames that move, 1 for factors."""
    from scipy.optimize import nnls  # dear to import, and seldom needed

    tracks, driven = data.tracks, data.driven
    balance, shape = tracks.balance, tracks.values.shape
    total = sum((p.at_frames(balance, tracks, driven.grid) for p in driven.pushes), torch.zeros_like(tracks.values))
    total = total - balance.bias.unflatten(0, shape[:2])
    mass = balance.mass.unflatten(0, shape[:2])[:, 1:]
    length = tracks.times_s.diff(dim=1)[..., None]
    change = (mass @ (tracks.speeds.diff(dim=1) / length)[..., None])[..., 0]
    lost = 0.5 * (total[:, 1:] + total[:, :-1]) - change
    speed = 0.5 * (tracks.speeds[:, 1:] + tracks.speeds[:, :-1])
    found = np.array([p.prior[0] for p in data.parameters])
    for j, name in enumerate(driven.chain.joint_names):
        moves = (driven.sense[..., j] != 0) & lost[..., j].isfinite()
        if not bool(moves.any()):
            continue
        rows = torch.stack((speed[..., j][moves], driven.sense[..., j][moves]), 1)
        for number, value in zip(
            ("damping", "friction"), nnls(rows.numpy(), lost[..., j][moves].numpy())[0], strict=True
        ):
            k = [p.name for p in data.parameters].index(f"{name}.{number}")
            found[k] = np.clip(float(value), *data.parameters[k].bounds)
    return found


def _pressed(data: _Data) -> list[Pressed]:
    """Return what forces tell of each driven body and the link that it pushes."""
    found, tracks, pushed = [], data.tracks, data.pushed
    fitted_gaps = {p.name for p in gap_parameters(tracks.world)}
    balance, names = tracks.balance, tracks.world.body_names
    driven = [name for name in names if any(name in one.std_n for one in pushed)]
    for name, push in zip(driven, data.driven.pushes, strict=True):
        seen = [(e, t, one.std_n[name]) for e, one in enumerate(pushed) if (t := one.force(name)) is not None]
        arms = push.arms(balance, tracks, data.driven.grid).flatten(0, 1)
        along = torch.stack([push.direction(e) for e in range(len(pushed))]).repeat_interleave(
            tracks.values.shape[1], 0
        )
        row = torch.einsum("kcj,kc->kj", arms, along)
        lightness = torch.einsum("ki,kij,kj->k", row, torch.linalg.inv(balance.mass), row)
        size = push.at_force(data.driven.grid, tracks).flatten()
        acts = size > LOADED * float(np.median([std for _, _, std in seen]))
        rate = float((size * lightness)[acts].median()) if bool(acts.any()) else 0.0
        path = float(np.median([estimate_noise([track]).position_m for _, track, _ in seen]))
        pair = tracks.world.materials_of(names.index(tracks.chain.links[push.link]), names.index(name))
        friction = slip_friction(tracks, name, push.link, seen)
        fitted = f"{name}.{GAP.name}" in fitted_gaps
        gap = path if fitted else math.hypot(path, GAP.prior[1])
        found.append(Pressed(pair=pair, friction=friction, rate_m_s2=rate, gap_std_m=gap))
    return found


def _fitted(data: _Data) -> DrivenFit:
    """Return the estimate with its covariance."""
    start, units = _first_losses(data), data.units.numpy()
    units = np.where(units > 0, np.maximum(start, units), 0.0)
    data = replace(data, units=torch.as_tensor(units))
    first = [
        ((p.bounds[0] / unit, p.bounds[1] / unit), value / unit, 1 / FLAT)
        if unit
        else (p.limits, p.encode(p.prior[0]), p.prior[1])
        for p, unit, value in zip(data.parameters, units, start, strict=True)
    ]
    every = first + [((-most, most), middle, std) for middle, std, most in NOTED]
    states = torch.zeros(len(data.part), data.size, dtype=torch.float64)
    # forces on many parts take each other's place: damped steps would be short
    best, centre, known = data.descent(states, every, damp_states=False)
    count = len(data.parameters)
    record = _misfit(data, best)
    information, slopes = best.information.numpy() / record["information_over"], best.scores.numpy()
    own, slope = _without_noted(information, slopes.sum(0) / record["information_over"], best, centre, known, count)
    values, covariance = posterior(best.shared[:count].numpy(), units, own, slope, data.parameters)
    wider = _scatter(information, slopes / record["information_over"], np.diag(known.numpy()))[:count]
    covariance = covariance * np.outer(wider, wider)
    if covariance[-1, -1] > MOST_MASS_ERROR**2:
        mass = data.parameters[-1]
        values[-1], covariance[-1], covariance[:, -1] = mass.encode(mass.prior[0]), 0.0, 0.0
        covariance[-1, -1] = mass.prior[1] ** 2
    record |= {
        "episodes": len(data.part),
        "frames": int(data.tracks.shown.sum()),
        "moving": float((data.driven.sense != 0).to(centre).mean()),
        "late_s": float(best.shared[count]) * data.late_s,
        "cost": best.cost,
        "converged": best.converged,
        "used": True,
        "described": True,
        "apart": [],
    }
    return DrivenFit(
        parameters=data.parameters,
        values=values,
        covariance=covariance,
        pressed=_pressed(data),
        record=record,
    )


def _without_noted(
    information: NDArray[Any], slope: NDArray[Any], end: Solution, centre: Tensor, known: Tensor, count: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return information (P, P) and slope (P,) of the data with what is not known of the sensor eliminated."""
    rest = slice(count, None)
    own = information[rest, rest] + np.diag(known.numpy()[rest])
    pull = slope[rest] + (known * (centre - end.shared)).numpy()[rest]
    follow = np.linalg.solve(own, np.concatenate((information[rest, :count], pull[:, None]), 1))
    across = information[:count, rest]
    return information[:count, :count] - across @ follow[:, :-1], slope[:count] - across @ follow[:, -1]


def _misfit(data: _Data, end: Solution) -> dict[str, Any]:
    """Return how far tracks and model differ, and by how much their information is divided.

    The misfit is that of the residuals by their degrees of freedom. A state whose variance is a share v of its prior's
    takes 1 - v of one.
    """
    seen = data.tracks.shown
    found, _ = data.residuals(end.shared, end.states, False)
    cost = robust_loss(found.square().sum(-1), ROBUST_SCALE)[0].sum()
    absorbed = end.states.numel() - float(end.state_cov.diagonal(dim1=-2, dim2=-1).sum())
    free = int(seen.sum()) * found.shape[-1] - len(end.shared) - absorbed
    misfit = float(cost) / max(free, 1.0)
    pairs = seen[:, 1:] & seen[:, :-1]
    ahead = float((found[:, 1:] * found[:, :-1])[pairs].sum())
    correlation = min(max(ahead / max(float(found.square()[seen].sum()), 1e-30), 0.0), MOST_CORRELATION)
    grown = max(1.0, misfit * (1 + correlation) / (1 - correlation))
    return {"misfit": misfit, "correlation": correlation, "information_over": grown}


def _scatter(information: NDArray[Any], slopes: NDArray[Any], prior: NDArray[Any]) -> NDArray[Any]:
    """Return the factors of standard errors by which episodes (E) scatter more than they should; 1 for few of them."""
    episodes = len(slopes)
    if episodes < MANY_EPISODES:
        return np.ones(len(prior))
    plain, off = np.linalg.inv(information + prior), slopes - slopes.mean(0)
    scatter = plain @ (episodes / (episodes - 1) * off.T @ off + prior) @ plain
    return np.sqrt(np.maximum(1.0, np.diag(scatter) / np.diag(plain)))
