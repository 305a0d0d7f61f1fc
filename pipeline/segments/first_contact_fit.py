"""Fits to short windows around first contacts, where the motion is a smooth function of every parameter.

Open-loop errors over many impacts are rough; over a window that ends one tumble after the first contact, with the state
at its start fitted too, they are smooth, and exact derivatives find in a few steps what flight and first impacts
determine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.capture.tracks import Episode
from ...schemas import Correlation, FittedParameter
from ..optimization.levenberg_marquardt import Solution, minimise
from ..optimization.tails import student_quantile
from ..optimization.uncertainty import ENOUGH_EPISODES, REACH, correlation_of, few_covariance, inverse, raised
from ..physics.parameters import Parameter, apply_parameters
from ..physics.world import World
from ..trajectories.correlated_noise import ROBUST_SCALE, WindowErrors
from ..trajectories.initial_state import flight_frames
from ..trajectories.observations import Observations
from ..trajectories.residuals import STATE_SIZE, TrajectoryResiduals, state_prior
from ..trajectories.track_noise import Noise
from .fitted_parameters import fitted_parameter

Array = NDArray[np.float64]

LEAD_FRAMES = 6
"""Frames of flight before the first contact that determine the velocities at its start."""
AFTER_S = 0.1
"""Time [s] that a window continues after the first contact: about one tumble of a thrown body."""
CONTACT_S = 1.5
"""The same for effects that act in contact [s]: a roll or a slide to rest determines them best."""
MODEL_ERROR = (0.0005, 0.01)
"""Model error of rigid bodies and this contact law in such a window (position [m], rotation [rad]), in addition to the
tracks' noise. Mainly their ratio matters; the residuals are weighted robustly, and intervals come from the scatter
between episodes."""
MAX_WINDOWS = 100
"""Maximum number of windows, which determines second moments of mass within 2 %."""
ITERATIONS, TOLERANCE = 48, 1e-3
"""Maximum number of steps of a fit, and the relative fall of the cost below which it has converged: states at impacts
settle slowly (12 and 100 tosses of a real cube need 32 and 38 steps)."""


@dataclass(frozen=True, kw_only=True)
class EffectEstimate:
    """The result of a fit of effects."""

    world: World
    """The world with the estimates."""
    parameters: tuple[FittedParameter, ...]
    """The parameters as `model.json` has them."""
    record: dict[str, Any]
    """How the fit went, for `fit.json`."""
    correlations: tuple[Correlation, ...] = ()
    """Correlations of the parameters, in blocks."""
    constants: dict[str, float] = field(default_factory=dict)
    """Constants of effects, `effect.constant` by name."""
    ground: FittedParameter | None = None
    """Ground shift in this world, where ends of episodes determined its height; else None."""
    own_values: dict[str, dict[str, float]] = field(default_factory=dict)
    """By group or episode, values of the parameters `effect.parameter` that differ between groups."""
    spread: dict[str, float] = field(default_factory=dict)
    """Standard deviation of these between groups, by parameter."""
    contact_start: dict[str, float] = field(default_factory=dict)
    """Contact parameters that were fitted too, where a search for them may start."""


def fit_first_contacts(
    world: World,
    episodes: Sequence[Episode],
    wanted: Sequence[tuple[Parameter, float]],
    along: Sequence[tuple[Parameter, float]],
    noise: Noise,
    whole_flight: bool = False,
    after_s: float = AFTER_S,
) -> EffectEstimate:
    """Fit parameters to a window around the first contact of each episode, together with the windows' states.

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        wanted: Parameters to estimate, and the values to start from.
        along: Nuisance parameters, which are found again later, open loop: those of the contact law.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
        whole_flight: Whether a window contains all frames before the contact, not only the last few.
        after_s: Time [s] that a window continues after the first contact.

    Raises:
        NotConvergedError: If the rollouts diverge at the start.
    """
    start, count = [*wanted, *along], len(wanted)
    names = [parameter for parameter, _ in start]
    residuals = window_residuals(world, episodes, names, noise, None if whole_flight else LEAD_FRAMES, after_s)
    coordinates = torch.tensor([parameter.encode(value) for parameter, value in start]).to(world.gravity)
    solution = solved_windows(residuals, coordinates, None, _prior(names, count, world.gravity))
    covariance = _covariance(solution, residuals, whole_flight)
    std_errors = np.sqrt(np.diag(covariance))[:count]
    found, coordinates = names[:count], solution.shared[:count]
    record = {"windows": len(residuals.observations.names), "costs": solution.costs, "converged": solution.converged}
    return EffectEstimate(
        world=placed(world, found, coordinates),
        parameters=tuple(
            fitted_parameter(p, float(z), float(s)) for p, z, s in zip(found, coordinates, std_errors, strict=True)
        ),
        record=record,
        correlations=(correlation_of([p.name for p in found], covariance[:count, :count]),),
    )


def window_residuals(
    world: World,
    episodes: Sequence[Episode],
    names: Sequence[Parameter],
    noise: Noise,
    lead_frames: int | None,
    after_s: float,
) -> TrajectoryResiduals:
    """Return the residuals of the windows around first contacts; see :func:`fit_first_contacts`.

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        names: Parameters that are varied.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
        lead_frames: Frames before the contact; None for all.
        after_s: Time [s] that a window continues after it.
    """
    picked, windows, _ = windows_of(world, episodes, lead_frames, after_s)
    position_std, rotation_std = (float(np.hypot(e, sigma)) for e, sigma in zip(MODEL_ERROR, noise, strict=True))
    return TrajectoryResiduals(
        world=world,
        parameters=names,
        observations=Observations.of(world, picked, windows),
        position_std_m=position_std,
        rotation_std_rad=rotation_std,
    )


def solved_windows(
    residuals: TrajectoryResiduals,
    shared: Tensor,
    states: Tensor | None,
    shared_prior: tuple[Tensor, Tensor],
    iterations: int = ITERATIONS,
) -> Solution:
    """Return the robust fit of parameters and the windows' states; with 0 iterations, the linearization at the start.

    Args:
        residuals: Those of the windows (B).
        shared: Start of the parameters, in fitted coordinates, shape (P,).
        states: Start of the changes of the states, shape (B, S); None for 0.
        shared_prior: Centre (P,) and information (P,) of the prior on the parameters.
        iterations: Maximum number of steps.

    Raises:
        NotConvergedError: If the rollouts diverge at the start.
    """
    seen = residuals.observations
    if states is None:
        states = torch.zeros(len(seen.names), STATE_SIZE * len(seen.free)).to(shared)
    return minimise(
        residuals,
        shared,
        states,
        torch.tensor([parameter.limits for parameter in residuals.parameters]).to(shared),
        robust_scale=ROBUST_SCALE,
        iterations=iterations,
        tolerance=TOLERANCE,
        prior_information=state_prior(len(seen.free)),
        shared_prior=shared_prior,
    )


def _covariance(solution: Solution, residuals: TrajectoryResiduals, whole_flight: bool) -> Array:
    """Return the covariance (P, P) of fitted coordinates; with few episodes at least that from the residuals.

    So it is with whole flights, however many, whose length makes the noise small beside what the contact law misses.
    """
    covariance = few_covariance(solution.information.numpy(), solution.scores.numpy())
    if len(residuals.observations.names) >= ENOUGH_EPISODES and not whole_flight:
        return covariance
    factor, dof = error_factor(residuals, solution)
    missed = factor * (student_quantile(0.975, dof) / REACH) ** 2 * inverse(solution.information.numpy())
    return raised(covariance, missed)


def error_factor(residuals: TrajectoryResiduals, solution: Solution) -> tuple[float, float]:
    """Return the factor by which the windows' error variance exceeds the assumed one, and its degrees of freedom."""
    rows, _ = residuals(solution.shared, solution.states, False)
    windows = residuals.observations
    errors = WindowErrors.of(rows, solution, windows, np.zeros(len(windows.names), bool))
    return errors.factor(len(residuals.parameters))


def _prior(parameters: Sequence[Parameter], wanted: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return centre and information (P,) of the priors: of the wanted parameters, which come first; 0 for the others.

    Without priors a parameter that no window determines drifts to a bound, driven by the small errors of the contact
    law.
    """
    centre = [p.encode(p.prior[0]) for p in parameters]
    information = [1 / p.prior[1] ** 2 if k < wanted else 0.0 for k, p in enumerate(parameters)]
    return torch.tensor(centre).to(like), torch.tensor(information).to(like)


def windows_of(
    world: World, episodes: Sequence[Episode], lead_frames: int | None, after_s: float
) -> tuple[list[Episode], list[tuple[float, float]], list[float]]:
    """Return episodes (at most `MAX_WINDOWS`, evenly spread), windows about their first contacts, and these [s].

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        lead_frames: Frames before the contact; None for all.
        after_s: Time [s] that a window continues after it.
    """
    chosen = np.linspace(0, len(episodes) - 1, min(len(episodes), MAX_WINDOWS)).round().astype(int)
    picked = [episodes[i] for i in chosen]
    whole = Observations.of(world, picked, [(-np.inf, np.inf)] * len(picked))
    flying = flight_frames(world, whole).sum(1)
    windows, contacts = [], []
    for times, count in zip(whole.times_s, flying.tolist(), strict=True):
        first = times[0] if lead_frames is None else times[max(0, count - lead_frames)]
        contacts.append(float(times[count]) if count < len(times) else np.inf)
        windows.append((float(first) - 1e-9, float(times[min(count, len(times) - 1)]) + after_s))
    return picked, windows, contacts


def placed(world: World, names: Sequence[Parameter], coordinates: Tensor) -> World:
    """Return the world with parameters at fitted coordinates (P,)."""
    values = torch.stack([p.decode(z) for p, z in zip(names, coordinates, strict=True)])[None]
    moved = apply_parameters(world, names, values)
    bodies = [replace(b, com=b.com.clone(), inertia=b.inertia.clone()) for b in moved.bodies]
    return replace(moved, bodies=tuple(bodies))
