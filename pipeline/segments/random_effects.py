"""Numbers of effects that each session, or episode, has for its own, with a prior that ties them.

A number of unit u is normal about the mean over units, with a standard deviation tau that is estimated along (a linear
mixed model, Laird & Ware, "Random-effects models for longitudinal data", 1982). A descent with the widest prior finds
where all numbers and states fit; there the problem is taken as linear, and expectation-maximisation gives means, tau
and the numbers. A unit of which the data say little is drawn to the others.

Residuals of neighbouring frames are no independent errors: what a model misses bends a whole episode. The variance of
the residuals, and their correlation rho from frame to frame, make an episode count (1 - rho) / (1 + rho) of its frames
(as for a first-order autoregression), and intervals are Student's, of so many degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datasets.tracks import Track
from ..schemas import InputDataError
from .diagnosis.segments import PARAMETER_STEP
from .estimation.least_squares import Solution, minimise
from .estimation.noise import MAD_TO_STD
from .estimation.observations import Observations
from .estimation.trajectory import STATE_SIZE, TrajectoryResiduals, state_prior
from .first_contacts import ITERATIONS, MODEL_ERROR, FirstContacts, correlation_of, described, windows_of
from .physics.parameters import GROUND_SHIFT, Parameter, apply_parameters
from .physics.world import World
from .tails import student_quantile
from .window_errors import ROBUST_SCALE, WindowErrors

Array = NDArray[np.float64]

REST_S = 0.1
"""The end of an episode, where a body that came to rest shows the ground's height and tilt."""
FIRST_ITERATIONS = 6
"""Before it is known how large residuals usually are."""
ROUNDS = 300
LEAST_SHARE = 1e-3
"""Of the widest prior: where units do not differ, tau goes to 0 and is held here."""
STATE_INFORMATION = 1e-4
"""Of the usual prior on states: a straight line through a few frames of a long fall begins far from where it did."""


@dataclass(frozen=True)
class Ties:
    """The prior of own numbers that a fit has found: mean and standard deviation by `effect.parameter`."""

    mean: Mapping[str, float]
    spread: Mapping[str, float]


def unit_of(shared: str, episode: str, groups: Mapping[str, str]) -> str:
    """Return the unit that an episode belongs to, for numbers that are shared so.

    Raises:
        InputDataError: If the numbers are those of a group and the episode has none.
    """
    if shared == "episode":
        return episode
    if shared == "group" and episode not in groups:
        raise InputDataError(
            f"an effect has numbers of its own for each group, and episode '{episode}' belongs to none.",
            f"[episodes.{episode}] group in capture.toml, for every episode.",
            "name the groups, or let each episode have its own: NAME@episode.",
        )
    return groups[episode] if shared == "group" else ""


def fit_own_numbers(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    groups: Mapping[str, str],
    wanted: Sequence[tuple[Parameter, float]],
    along: Sequence[tuple[Parameter, float]],
    noise: tuple[float, float],
    flying: bool,
    after_s: float,
    ties: Ties | None = None,
) -> FirstContacts:
    """Fit parameters to flight, first contacts and the ends of episodes, with the windows' states.

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        groups: Group of each episode that belongs to one.
        wanted: What is to be found, and the values that it starts from.
        along: What is fitted along, one value for all.
        noise: Of the tracks (position [m], rotation [rad]).
        flying: Whether nothing ever touches anything.
        after_s: How long a window goes on after the first contact [s]; 0 for flight alone, which is smooth.
        ties: The prior of own numbers, for episodes that the fit has not seen; None to estimate it.

    Raises:
        InputDataError: If an episode belongs to no group, and a number is one of the group's.
        NotConvergedError: If the rollouts diverge at the start.
    """
    batch, ends, stds = _batch(world, episodes, noise, flying, after_s)
    start = [*wanted, *along]
    numbers = [p for p, _ in start]
    units = [[unit_of(p.shared, name, groups) for name in batch.names] for p in numbers]
    names = [list(dict.fromkeys(column)) for column in units]
    first = np.cumsum([0, *(len(column) for column in names)])
    place = np.stack([[first[k] + names[k].index(u) for u in column] for k, column in enumerate(units)], 1)
    owner = np.repeat(np.arange(len(numbers)), [len(column) for column in names])
    steps = [(0.0, PARAMETER_STEP * p.prior[1]) for p in numbers]
    given = {p.name: p.encode(value) for p, value in start} | dict(ties.mean if ties else {})
    width = np.array([numbers[k].prior[1] for k in owner])
    centre = np.array([given[numbers[k].name] for k in owner])
    shared, states = torch.as_tensor(centre), torch.zeros(len(batch.names), STATE_SIZE * len(batch.free))
    states, prior = states.to(world.gravity), (torch.as_tensor(centre), torch.as_tensor(width**-2.0))
    for iterations in (FIRST_ITERATIONS, ITERATIONS):
        residuals = TrajectoryResiduals(world, numbers, batch, *stds, True, steps)
        problem = _Gathered(residuals, torch.as_tensor(place), len(owner))
        solution = minimise(
            problem,
            shared,
            states,
            torch.tensor([numbers[k].limits for k in owner]).to(world.gravity),
            robust_scale=ROBUST_SCALE,
            iterations=iterations,
            prior_information=STATE_INFORMATION * state_prior(len(batch.free)),
            shared_prior=prior,
        )
        shared, states = solution.shared, solution.states
        rows, _ = problem(shared, states, False)
        if iterations == ITERATIONS:
            break
        # where all frames are missed by more than the noise, none of them is an outlier
        scale = _usual(rows, ends)
        stds = (stds[0] * scale, stds[1] * scale)
    tied = [np.flatnonzero(owner == k) for k, p in enumerate(numbers) if p.shared != "all"]
    known = (
        None if ties is None else np.array([ties.spread.get(numbers[k].name, width[i]) for i, k in enumerate(owner)])
    )
    found = _tied(solution, WindowErrors.of(rows, solution, batch, ends), centre, width, tied, known)
    result = _result(world, wanted, names, owner, found, batch.names, groups, solution)
    if flying or GROUND_SHIFT not in numbers or result.world.ground_offset is None:
        return result
    at = int(np.flatnonzero(owner == numbers.index(GROUND_SHIFT))[0])
    z, std = float(found.values[at]), float(np.sqrt(found.covariance[at, at]))
    ground = described(GROUND_SHIFT, z, std, student_quantile(0.975, found.dof))
    moved = replace(result.world, ground_offset=result.world.ground_offset + ground.estimate)
    record = result.record | {"ground_shift_m": ground.estimate}
    return replace(result, world=moved, ground=ground, record=record)


@dataclass(frozen=True)
class _Gathered:
    """Residuals in which each item picks its numbers among those of all units: place (B, P) of `size` numbers."""

    problem: TrajectoryResiduals
    place: Tensor
    size: int

    def __call__(self, shared: Tensor, states: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor | None]:
        rows, jacobian = self.problem(shared[self.place], states, with_jacobian)
        if jacobian is None:
            return rows, None
        count = self.place.shape[1]
        every = torch.zeros(*rows.shape, self.size).to(rows)
        index = self.place[:, None, None].expand(*rows.shape, count)
        every.scatter_(-1, index, jacobian[..., :count])
        return rows, torch.cat((every, jacobian[..., count:]), -1)


def _usual(rows: Tensor, ends: NDArray[np.bool_]) -> Tensor:
    """Return by what factor (B, 1, 1) the usual residual of each kind of window exceeds its standard deviation."""
    size = rows.abs()
    factor = torch.ones(len(rows)).to(rows)
    for kind in (False, True):
        some = size[torch.as_tensor(ends == kind)]
        if (some > 0).any():
            factor[torch.as_tensor(ends == kind)] = (MAD_TO_STD * some[some > 0].median()).clamp_min(1.0)
    return factor[:, None, None]


def _batch(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    noise: tuple[float, float],
    flying: bool,
    after_s: float,
) -> tuple[Observations, NDArray[np.bool_], tuple[Tensor, Tensor]]:
    """Return the windows, which of them are ends, and the standard deviations of their rows (B, F, 1)."""
    picked, windows, contact = windows_of(world, episodes, None, after_s)
    ends = [False] * len(picked)
    if after_s == 0:
        windows = [(a, b if np.isinf(at) else at - 1e-6) for (a, b), at in zip(windows, contact, strict=True)]
    if not flying:
        last = [max(float(track.time_s[-1]) for track in tracks.values()) for _, tracks in picked]
        windows, ends = [*windows, *((t - REST_S, t + 1e-9) for t in last)], [*ends, *(True for _ in last)]
        picked, contact = [*picked, *picked], [*contact, *(np.inf for _ in last)]
    batch = Observations.of(world, picked, windows)
    # a flight is followed to the noise, and a rest as well as it turns out; what a contact law misses comes between
    free = batch.times_s < torch.tensor(contact)[:, None].to(batch.times_s)
    free = free.repeat_interleave(len(batch.free), 1)[..., None]
    rough = [float(np.hypot(e, sigma)) for e, sigma in zip(MODEL_ERROR, noise, strict=True)]
    stds = [torch.where(free, fine, coarse).to(world.gravity) for fine, coarse in zip(noise, rough, strict=True)]
    return batch, np.array(ends), (stds[0], stds[1])


@dataclass(frozen=True)
class _Tied:
    """Numbers (n,) with their covariance, means and tau (n,) of their priors, degrees of freedom, effective errors."""

    values: Array
    covariance: Array
    mean: Array
    tau: Array
    dof: float
    errors: Array


def _tied(
    solution: Solution,
    errors: WindowErrors,
    centre: Array,
    width: Array,
    tied: Sequence[NDArray[np.int64]],
    known_tau: Array | None,
) -> _Tied:
    """Return numbers and priors where the likelihood of the linearised problem is largest.

    The size of the errors is that of the widest prior: drawn to the others, units fit worse, and would count for less.
    """
    parts, slopes, at = solution.by_item.numpy(), solution.scores.numpy(), solution.shared.numpy()
    factor = _factors(parts, slopes, at, errors, centre, width)
    matrix = (parts / factor[:, None, None]).sum(0)
    right = ((slopes + parts @ at) / factor[:, None]).sum(0)
    mean, tau = centre.copy(), width.copy() if known_tau is None else known_tau
    values, covariance = _solved(matrix, right, mean, tau)
    for _ in range(ROUNDS if known_tau is None else 0):
        for places in tied:
            if len(places) > 1:
                mean[places] = values[places].mean()
                square = ((values[places] - mean[places]) ** 2 + np.diag(covariance)[places]).sum() / (len(places) - 1)
                tau[places] = np.clip(np.sqrt(square), LEAST_SHARE * width[places], width[places])
        values, covariance = _solved(matrix, right, mean, tau)
    dof = float(errors.independent.sum()) - len(values)
    return _Tied(values, covariance, mean, tau, max(dof, 1.0), factor)


def _factors(parts: Array, slopes: Array, at: Array, errors: WindowErrors, centre: Array, width: Array) -> Array:
    """Return by what factor the errors of each item (B,) exceed independent ones of its standard deviations."""
    factor = np.ones(len(parts))
    for _ in range(10):
        matrix = (parts / factor[:, None, None]).sum(0)
        right = ((slopes + parts @ at) / factor[:, None]).sum(0)
        values, covariance = _solved(matrix, right, centre, width)
        away = values - at
        chi2 = errors.chi2 - 2 * slopes @ away + np.einsum("p,bpq,q->b", away, parts, away)
        lost = np.einsum("pq,bqp->b", covariance, parts) / factor
        free = errors.independent - lost
        for k in np.unique(errors.kind):
            some = errors.kind == k
            pooled = max(chi2[some].sum(), 1e-12) / max(free[some].sum(), 1.0)
            # an episode that fits worse than the others counts less than they do
            factor[some] = np.maximum(pooled, chi2[some] / np.maximum(free[some], 1.0))
    return factor


def _solved(matrix: Array, right: Array, mean: Array, tau: Array) -> tuple[Array, Array]:
    covariance = np.linalg.inv(matrix + np.diag(tau**-2.0))
    return (covariance @ (right + mean / tau**2)).astype(np.float64), covariance.astype(np.float64)


def _result(
    world: World,
    wanted: Sequence[tuple[Parameter, float]],
    names: Sequence[Sequence[str]],
    owner: NDArray[np.int64],
    found: _Tied,
    episodes: Sequence[str],
    groups: Mapping[str, str],
    solution: Solution,
) -> FirstContacts:
    reach, rows, centres = student_quantile(0.975, found.dof), [], []
    own: dict[str, dict[str, float]] = {}
    spread: dict[str, float] = {}
    for k, (p, _) in enumerate(wanted):
        at = np.flatnonzero(owner == k)
        z = np.clip(found.values[at], *p.limits)
        std = np.sqrt(np.diag(found.covariance)[at])
        if p.shared == "all":
            rows.append(described(p, float(z[0]), float(std[0]), reach))
            centres.append(float(z[0]))
            continue
        centre, count = float(np.clip(found.mean[at[0]], *p.limits)), len(at)
        spread[p.name] = float(found.tau[at[0]])
        error = float(np.sqrt((found.tau[at[0]] ** 2 + (std**2).mean()) / count))
        mean = described(p, centre, error, student_quantile(0.975, max(count - 1, 1)))
        note = f"mean over {count} {p.shared}s, which differ by {spread[p.name]:.3g} {p.unit} (standard deviation)"
        rows.append(mean.model_copy(update={"note": note}))
        centres.append(centre)
        for unit, value, error in zip(names[k], z, std, strict=True):
            own.setdefault(unit, {})[p.name] = float(p.decode(torch.tensor(value)))
            if p.shared == "group":
                one = described(p, float(value), float(error), reach)
                rows.append(one.model_copy(update={"name": f"{p.name}[{unit}]", "note": f"of {unit} alone"}))
    numbers = [p for p, _ in wanted]
    values = torch.stack([p.decode(torch.tensor(z).to(world.gravity)) for p, z in zip(numbers, centres, strict=True)])
    by_episode = {
        name: {p.name: own[unit_of(p.shared, name, groups)][p.name] for p in numbers if p.shared != "all"}
        for name in dict.fromkeys(episodes)
    }
    moved = replace(apply_parameters(world, numbers, values[None]), own=dict(world.own) | by_episode)
    record = {
        "windows": len(episodes),
        "costs": solution.costs,
        "converged": solution.converged,
        "errors_variance": found.errors.tolist(),
        "degrees_of_freedom": found.dof,
        "spread": spread,
    }
    single = [k for k, p in enumerate(numbers) if p.shared == "all"]
    places = [int(np.flatnonzero(owner == k)[0]) for k in single]
    blocks = (
        [correlation_of([numbers[k].name for k in single], found.covariance[np.ix_(places, places)])] if single else []
    )
    return FirstContacts(moved, tuple(rows), record, tuple(blocks), own=own, spread=spread)
