"""Random effects: effect parameters that differ between groups (sessions or episodes), with a shared prior.

A descent with the widest prior finds where all parameters and states fit; there the problem is linearised, and
expectation-maximisation gives means, standard deviations between groups and the parameters of the groups
(`mixed_model.py`).

Residuals of neighbouring frames are not independent errors: what a model misses bends a whole episode. The variance of
the residuals and their correlation rho from frame to frame reduce the effective sample size of an episode to (1 - rho)
/ (1 + rho) of its frames (as for a first-order autoregression), and intervals are Student's with these degrees of
freedom.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.capture.tracks import Episode
from ...schemas import FittedParameter, ModelFile
from ..optimization.levenberg_marquardt import Solution, minimise
from ..optimization.tails import student_quantile
from ..optimization.uncertainty import correlation_of
from ..physics.effects.registry import effect_of
from ..physics.parameters import GROUND_SHIFT, Parameter, apply_parameters
from ..physics.world import World
from ..trajectories.correlated_noise import ROBUST_SCALE, WindowErrors
from ..trajectories.initial_state import flight_frames
from ..trajectories.observations import Observations
from ..trajectories.residuals import STATE_SIZE, TrajectoryResiduals, state_prior
from ..trajectories.track_noise import MAD_TO_STD, Noise
from .first_contact_fit import MODEL_ERROR, EffectEstimate, windows_of
from .fitted_parameters import fitted_parameter
from .group_parameters import group_of, group_parameters, with_known_groups
from .mixed_model import Array, GroupLayout, GroupPosterior, GroupPrior, posterior
from .segments import PARAMETER_STEP

REST_S = 0.1
"""Length [s] of the window at the end of an episode, where a body at rest shows the ground's height and tilt."""
FIRST_ITERATIONS, ITERATIONS = 6, 16
"""Steps of the first descent, which measures how large residuals are, and of the second one."""
STATE_INFORMATION = 1e-4
"""Weight of the prior on states relative to the usual one: the start of a long fall is far from the line through its
first frames."""


def fit_random_effects(
    world: World,
    episodes: Sequence[Episode],
    groups: Mapping[str, str],
    wanted: Sequence[tuple[Parameter, float]],
    along: Sequence[tuple[Parameter, float]],
    noise: Noise,
    flying: bool,
    after_s: float,
    ties: GroupPrior | None = None,
) -> EffectEstimate:
    """Fit parameters to flight, first contacts and ends of episodes, together with the states of the windows.

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        groups: Group of each episode that belongs to one.
        wanted: Parameters to estimate, and the values to start from.
        along: Nuisance parameters, with one value for all.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
        flying: Whether no body ever touches anything.
        after_s: Time [s] that a window continues after the first contact; 0 for flight alone, which is smooth.
        ties: The prior of group-specific parameters, for episodes that the fit has not seen; None to estimate it.

    Raises:
        InputDataError: If an episode belongs to no group, and a parameter differs between groups.
        NotConvergedError: If the rollouts diverge at the start.
    """
    batch, ends, stds = _batch(world, episodes, noise, flying, after_s)
    layout = GroupLayout.of([*wanted, *along], batch.names, groups, ties)
    solution, rows = _descend(world, batch, ends, stds, layout)
    errors = WindowErrors.of(rows, solution, batch, ends)
    found = posterior(solution, errors, layout, None if ties is None else layout.known_tau(ties))
    result = _result(world, wanted, layout, found, batch.names, groups, solution)
    if flying or GROUND_SHIFT not in layout.parameters:
        return result
    return _with_ground_shift(result, layout, found)


def _descend(
    world: World, batch: Observations, ends: NDArray[np.bool_], stds: tuple[Tensor, Tensor], layout: GroupLayout
) -> tuple[Solution, Tensor]:
    """Return the solution with the widest priors, and its residuals (B, F, 6) in sigmas.

    Args:
        world: The world.
        batch: The windows (B).
        ends: Which windows (B,) are ends of episodes.
        stds: Standard deviations of the rows (B, F, 1) of position [m] and rotation [rad] to begin with.
        layout: The values that are fitted.
    """
    parameters = layout.parameters
    steps = [(0.0, PARAMETER_STEP * p.prior[1]) for p in parameters]
    shared, states = torch.as_tensor(layout.centre), torch.zeros(len(batch.names), STATE_SIZE * len(batch.free))
    states, prior = states.to(world.gravity), (torch.as_tensor(layout.centre), torch.as_tensor(layout.width**-2.0))

    def descended(
        shared: Tensor, states: Tensor, stds: tuple[Tensor, Tensor], iterations: int
    ) -> tuple[Solution, Tensor]:
        residuals = TrajectoryResiduals(world, parameters, batch, *stds, differences=True, parameter_steps=steps)
        problem = _Gathered(residuals, torch.as_tensor(layout.place), len(layout.owner))
        solution = minimise(
            problem,
            shared,
            states,
            torch.tensor([parameters[k].limits for k in layout.owner]).to(world.gravity),
            robust_scale=ROBUST_SCALE,
            iterations=iterations,
            prior_information=STATE_INFORMATION * state_prior(len(batch.free)),
            shared_prior=prior,
        )
        return solution, problem(solution.shared, solution.states, False)[0]

    first, rows = descended(shared, states, stds, FIRST_ITERATIONS)
    # where all residuals exceed the noise, none of them is an outlier
    scale = _usual(rows, ends)
    return descended(first.shared, first.states, (stds[0] * scale, stds[1] * scale), ITERATIONS)


def _with_ground_shift(result: EffectEstimate, layout: GroupLayout, found: GroupPosterior) -> EffectEstimate:
    """Return the estimate with the ground moved to the height that the ends of episodes show."""
    world = result.world
    if world.ground_offset is None:
        return result
    at = int(layout.places(layout.parameters.index(GROUND_SHIFT))[0])
    z, std = float(found.values[at]), float(np.sqrt(found.covariance[at, at]))
    ground = fitted_parameter(GROUND_SHIFT, z, std, student_quantile(0.975, found.dof))
    moved = replace(world, ground_offset=world.ground_offset + ground.estimate)
    record = result.record | {"ground_shift_m": ground.estimate}
    return replace(result, world=moved, ground=ground, record=record)


@dataclass(frozen=True)
class _Gathered:
    """Residuals in which each item picks its parameters among the values of all groups."""

    problem: TrajectoryResiduals
    """Residuals of items (B) with separate parameters (B, P)."""
    place: Tensor
    """Index of the value that each item uses, shape (B, P)."""
    size: int
    """Number of values N."""

    def __call__(self, shared: Tensor, states: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor | None]:
        """Return residuals (B, F, 6) and, their Jacobian (B, F, 6, N + S) for values (N,) and states (B, S)."""
        rows, jacobian = self.problem(shared[self.place], states, with_jacobian)
        if jacobian is None:
            return rows, None
        count = self.place.shape[1]
        every = torch.zeros(*rows.shape, self.size).to(rows)
        index = self.place[:, None, None].expand(*rows.shape, count)
        every.scatter_(-1, index, jacobian[..., :count])
        return rows, torch.cat((every, jacobian[..., count:]), -1)


def _usual(rows: Tensor, ends: NDArray[np.bool_]) -> Tensor:
    """Return the factor (B, 1, 1) by which the typical residual of each kind of window exceeds its sigma."""
    size = rows.abs()
    factor = torch.ones(len(rows)).to(rows)
    for kind in (False, True):
        some = size[torch.as_tensor(ends == kind)]
        if (some > 0).any():
            factor[torch.as_tensor(ends == kind)] = (MAD_TO_STD * some[some > 0].median()).clamp_min(1.0)
    return factor[:, None, None]


def _batch(
    world: World,
    episodes: Sequence[Episode],
    noise: Noise,
    flying: bool,
    after_s: float,
) -> tuple[Observations, NDArray[np.bool_], tuple[Tensor, Tensor]]:
    """Return the windows, which of them are ends of episodes, and the standard deviations of their rows (B, F, 1)."""
    picked, windows, contact = windows_of(world, episodes, None, after_s)
    every = picked
    if after_s == 0:
        picked, windows, contact = _flights(picked, windows, contact)
    ends = np.zeros(len(picked), dtype=bool)
    if not flying:
        last = [max(float(track.time_s[-1]) for track in tracks.values()) for _, tracks in every]
        windows = [*windows, *((t - REST_S, t + 1e-9) for t in last)]
        picked, contact = [*picked, *every], [*contact, *[np.inf] * len(last)]
        ends = np.concatenate((ends, np.ones(len(last), dtype=bool)))
    batch = Observations.of(world, picked, windows)
    # model error is added after the first contact; flight and the rest at the end have the tracks' noise alone
    free = batch.times_s < torch.tensor(contact)[:, None].to(batch.times_s)
    free = free.repeat_interleave(len(batch.free), 1)[..., None]
    rough = [float(np.hypot(e, sigma)) for e, sigma in zip(MODEL_ERROR, noise, strict=True)]
    stds = [torch.where(free, fine, coarse).to(world.gravity) for fine, coarse in zip(noise, rough, strict=True)]
    return batch, ends, (stds[0], stds[1])


def _flights(
    episodes: Sequence[Episode], windows: Sequence[tuple[float, float]], contact: Sequence[float]
) -> tuple[list[Episode], list[tuple[float, float]], list[float]]:
    """Return episodes with their windows [s] up to the first contact [s], without those that begin in contact."""
    cut = [(a, b if np.isinf(at) else at - 1e-6) for (a, b), at in zip(windows, contact, strict=True)]
    some = [k for k, (a, b) in enumerate(cut) if b > a]
    return [episodes[k] for k in some], [cut[k] for k in some], [contact[k] for k in some]


@dataclass(frozen=True)
class _Reported:
    """The wanted parameters as `model.json` has them."""

    rows: list[FittedParameter] = field(default_factory=list)
    """Parameters, and those of groups after their mean."""
    centres: list[float] = field(default_factory=list)
    """Value of each wanted parameter, or mean over its groups, in fitted coordinates."""
    own: dict[str, dict[str, float]] = field(default_factory=dict)
    """By group, values of the parameters that differ between groups."""
    spread: dict[str, float] = field(default_factory=dict)
    """By parameter, standard deviation between groups in fitted coordinates."""

    def add_shared(self, p: Parameter, z: Array, std: Array, reach: float) -> None:
        """Add a parameter with one value for all."""
        self.rows.append(fitted_parameter(p, float(z[0]), float(std[0]), reach))
        self.centres.append(float(z[0]))

    def add_groups(
        self, p: Parameter, groups: Sequence[str], z: Array, std: Array, prior: tuple[float, float], reach: float
    ) -> None:
        """Add a parameter that differs between groups: its mean, and its value in each.

        Args:
            p: The parameter.
            groups: Names (n).
            z: Values (n,) in fitted coordinates.
            std: Their standard errors (n,).
            prior: Mean and standard deviation between groups.
            reach: Half of the interval, in standard errors.
        """
        count, (mean, tau) = len(groups), prior
        centre = float(np.clip(mean, *p.limits))
        self.spread[p.name] = tau
        error = float(np.sqrt((tau**2 + (std**2).mean()) / count))
        row = fitted_parameter(p, centre, error, student_quantile(0.975, max(count - 1, 1)))
        note = f"mean over {count} {p.shared}s, which differ by {tau:.3g} {p.unit} (standard deviation)"
        self.rows.append(row.model_copy(update={"note": note}))
        self.centres.append(centre)
        for group, value, error in zip(groups, z, std, strict=True):
            self.own.setdefault(group, {})[p.name] = float(p.decode(torch.tensor(value)))
            if p.shared == "group":
                one = fitted_parameter(p, float(value), float(error), reach)
                update = {"name": f"{p.name}[{group}]", "note": f"of {group} alone"}
                self.rows.append(one.model_copy(update=update))


def _reported(wanted: Sequence[Parameter], layout: GroupLayout, found: GroupPosterior) -> _Reported:
    """Return the wanted parameters, which come first in the layout, with intervals."""
    reach, reported = student_quantile(0.975, found.dof), _Reported()
    for k, p in enumerate(wanted):
        at = layout.places(k)
        z = np.clip(found.values[at], *p.limits)
        std = np.sqrt(np.diag(found.covariance)[at])
        if p.shared == "all":
            reported.add_shared(p, z, std, reach)
        else:
            prior = float(found.mean[at[0]]), float(found.tau[at[0]])
            reported.add_groups(p, layout.groups[k], z, std, prior, reach)
    return reported


def _result(
    world: World,
    wanted: Sequence[tuple[Parameter, float]],
    layout: GroupLayout,
    found: GroupPosterior,
    episodes: Sequence[str],
    groups: Mapping[str, str],
    solution: Solution,
) -> EffectEstimate:
    """Return the estimate: the world with the parameters found, and how they and the fit are reported."""
    parameters = [p for p, _ in wanted]
    reported = _reported(parameters, layout, found)
    centres, own = reported.centres, reported.own
    values = torch.stack(
        [p.decode(torch.tensor(z).to(world.gravity)) for p, z in zip(parameters, centres, strict=True)]
    )
    by_episode = {
        name: {p.name: own[group_of(p.shared, name, groups)][p.name] for p in parameters if p.shared != "all"}
        for name in dict.fromkeys(episodes)
    }
    moved = replace(apply_parameters(world, parameters, values[None]), own_values=dict(world.own_values) | by_episode)
    record = {
        "windows": len(episodes),
        "costs": solution.costs,
        "converged": solution.converged,
        "errors_variance": found.errors.tolist(),
        "degrees_of_freedom": found.dof,
        "spread": reported.spread,
    }
    single = [k for k, p in enumerate(parameters) if p.shared == "all"]
    places = [int(layout.places(k)[0]) for k in single]
    blocks = (
        [correlation_of([parameters[k].name for k in single], found.covariance[np.ix_(places, places)])]
        if single
        else []
    )
    return EffectEstimate(
        world=moved,
        parameters=tuple(reported.rows),
        record=record,
        correlations=tuple(blocks),
        own_values=own,
        spread=reported.spread,
    )


def with_fitted_groups(
    world: World,
    episodes: Sequence[Episode],
    file: ModelFile,
    groups: Mapping[str, str],
    noise: Noise,
) -> World:
    """Return the world in which every episode has group-specific parameters: known from the fit, else fitted.

    Parameters fitted to an episode make no prediction of it: like its fitted initial state, they use its data.
    """
    own = group_parameters(world)
    known = with_known_groups(world, file, [name for name, _ in episodes], groups)
    unknown = [episode for episode in episodes if len(known.own_values.get(episode.name, {})) < len(own)]
    if not own or not unknown:
        return known
    centre = {f"{a.effect.name}.{name}": float(value) for a in world.effects for name, value in a.values.items()}
    spread = {f"{effect_of(e).name}.{name}": std for e in file.effects for name, std in e.spread.items()}
    whole = Observations.of(known, unknown, [(-float("inf"), float("inf"))] * len(unknown))
    flying = bool(flight_frames(known, whole)[whole.seen.amax(-1) > 0].all())
    ties = GroupPrior({p.name: centre[p.name] for p in own}, spread)
    found = fit_random_effects(known, unknown, groups, [(p, centre[p.name]) for p in own], (), noise, flying, 0.0, ties)
    return replace(known, own_values=dict(found.world.own_values))
