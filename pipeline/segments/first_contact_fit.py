"""Fits on short windows about first contacts, where the motion is a smooth function of every number.

Open-loop errors over many impacts are rough; over a window that ends a tumble after the first contact, with the state
at its start fitted too, they are smooth, and exact derivatives find in a few steps what flight and first impacts show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datasets.tracks import Track
from ..schemas import Correlation
from ..schemas import Parameter as FittedParameter
from .estimation.least_squares import minimise
from .estimation.observations import Observations
from .estimation.trajectory import STATE_SIZE, TrajectoryResiduals, state_prior
from .estimation.warmup import flight_frames
from .physics.parameters import Parameter, apply_parameters
from .physics.world import World
from .tails import student_quantile
from .window_errors import ROBUST_SCALE, WindowErrors

Array = NDArray[np.float64]

LEAD_FRAMES = 6
"""Frames of flight before the first contact that give the velocities with which it begins."""
AFTER_S = 0.1
"""How long a window goes on after the first contact: about one tumble of a thrown body."""
CONTACT_S = 1.5
"""How long it goes on where what is wanted acts in contact: a roll or a slide to rest shows it best."""
MODEL_ERROR = (0.0005, 0.01)
"""What a rigid body and this contact law miss in such a window (position [m], rotation [rad]) beside the tracks' noise.
Only their ratio matters much; the residuals are weighed robustly, and intervals come from the episodes' scatter."""
REACH = 1.96
"""Half of a 95 % interval of a normal number, in standard errors."""
MAX_WINDOWS = 100
"""So many give second moments of mass within 2 %."""
ITERATIONS = 16
LEAST_INFORMATION, ROUNDING = 1e-30, 1e-10
"""Less information is none, and so is one of less than this share of the largest, in units of the numbers' own."""
ENOUGH_EPISODES = 8
"""From so many episodes on their scatter gives the intervals."""
UNOBSERVABLE_SHARE = 0.8
"""A parameter that the data leave with more than this share of its prior's width is called not observable."""


@dataclass(frozen=True)
class FirstContacts:
    """What was found: the world with it, the parameters for `model.json`, and how the fit went for `fit.json`.

    correlations: of the parameters, in blocks; constants: of effects, `effect.constant` by name.
    ground: how far the ground was moved in this world, where ends of episodes showed its height; own: by session or
    episode, values of `effect.parameter` that are its own; spread: of these from unit to unit; along: numbers of the
    contact that were found beside, where a search for them may start.
    """

    world: World
    parameters: tuple[FittedParameter, ...]
    record: dict[str, Any]
    correlations: tuple[Correlation, ...] = ()
    constants: dict[str, float] = field(default_factory=dict)
    ground: FittedParameter | None = None
    own: dict[str, dict[str, float]] = field(default_factory=dict)
    spread: dict[str, float] = field(default_factory=dict)
    along: dict[str, float] = field(default_factory=dict)


def fit_first_contacts(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    wanted: Sequence[tuple[Parameter, float]],
    along: Sequence[tuple[Parameter, float]],
    noise: tuple[float, float],
    whole_flight: bool = False,
    after_s: float = AFTER_S,
) -> FirstContacts:
    """Fit parameters to a window about the first contact of each episode, with the windows' states.

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        wanted: What is to be found, and the values that it starts from.
        along: What is fitted along, and found again later, open loop: the contact's numbers.
        noise: Of the tracks (position [m], rotation [rad]).
        whole_flight: Whether a window holds all frames before the contact, not the last few.
        after_s: How long a window goes on after the first contact [s].

    Raises:
        NotConvergedError: If the rollouts diverge at the start.
    """
    picked, windows, _ = windows_of(world, episodes, None if whole_flight else LEAD_FRAMES, after_s)
    observations = Observations.of(world, picked, windows)
    start, count = [*wanted, *along], len(wanted)
    names = [parameter for parameter, _ in start]
    position_std, rotation_std = (float(np.hypot(e, sigma)) for e, sigma in zip(MODEL_ERROR, noise, strict=True))
    residuals = TrajectoryResiduals(world, names, observations, position_std, rotation_std)
    solution = minimise(
        residuals,
        torch.tensor([parameter.encode(value) for parameter, value in start]).to(world.gravity),
        torch.zeros(len(observations.names), STATE_SIZE * len(observations.free)).to(world.gravity),
        torch.tensor([parameter.limits for parameter in names]).to(world.gravity),
        robust_scale=ROBUST_SCALE,
        iterations=ITERATIONS,
        prior_information=state_prior(len(observations.free)),
        shared_prior=_prior(names, count, world.gravity),
    )
    covariance = few_covariance(solution.information.numpy(), solution.scores.numpy())
    if len(observations.names) < ENOUGH_EPISODES:
        rows, _ = residuals(solution.shared, solution.states, False)
        errors = WindowErrors.of(rows, solution, observations, np.zeros(len(observations.names), bool))
        factor, dof = errors.factor(len(names))
        missed = factor * (student_quantile(0.975, dof) / REACH) ** 2 * inverse(solution.information.numpy())
        covariance = _wider(covariance, missed)
    std_errors = np.sqrt(np.diag(covariance))[:count]
    found, coordinates = names[:count], solution.shared[:count]
    record = {"windows": len(observations.names), "costs": solution.costs, "converged": solution.converged}
    return FirstContacts(
        placed(world, found, coordinates),
        tuple(described(p, float(z), float(s)) for p, z, s in zip(found, coordinates, std_errors, strict=True)),
        record,
        (correlation_of([p.name for p in found], covariance[:count, :count]),),
    )


def _prior(parameters: Sequence[Parameter], wanted: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return centre and information (P,) of the priors of what is wanted; the rest, which comes after it, has none.

    Without them a number that no window shows wanders to a bound, by what little the contact law misses.
    """
    centre = [p.encode(p.prior[0]) for p in parameters]
    information = [1 / p.prior[1] ** 2 if k < wanted else 0.0 for k, p in enumerate(parameters)]
    return torch.tensor(centre).to(like), torch.tensor(information).to(like)


def correlation_of(names: Sequence[str], covariance: Array) -> Correlation:
    """Return the correlations of fitted coordinates with a covariance (P, P), as `model.json` has them."""
    std = np.sqrt(np.clip(np.diag(covariance), 1e-300, None))
    return Correlation(parameters=tuple(names), matrix=tuple(map(tuple, (covariance / np.outer(std, std)).tolist())))


def few_covariance(information: Array, scores: Array, prior: Array | None = None) -> Array:
    """Return the covariance (P, P) from the information (P, P) and the scatter of the episodes' gradients (E, P).

    prior: the part of the information (P, P) that is a prior's. It pulls in no episode, so that without its own scatter
    what no episode shows would seem exact.

    From `ENOUGH_EPISODES` on the scatter alone (Huber 1967). Of few it may be small by chance, and the curvature, which
    rests on the noise, counts where it is wider. But what a model misses is missed in all frames of an episode alike,
    and then the curvature is far too narrow: the scatter counts, with what few samples ask for (n / (n - 1), and
    Student's t in the normal law's place).
    """
    curvature = inverse(information)
    count = len(scores)
    spread = scores.T @ scores + (0.0 if prior is None else prior)
    scatter = curvature @ spread @ curvature
    if count >= ENOUGH_EPISODES:
        return scatter
    if count < 2:
        return curvature
    return _wider(curvature, count / (count - 1) * (student_quantile(0.975, count - 1) / REACH) ** 2 * scatter)


def _wider(covariance: Array, other: Array) -> Array:
    """Return a covariance (P, P) with the larger one of its variances and another's, and its own correlations."""
    width = np.sqrt(np.maximum(1.0, np.diag(other) / np.diag(covariance).clip(1e-300)))
    return covariance * np.outer(width, width)


def inverse(information: Array) -> Array:
    """Return the inverse of an information (P, P); of what carries none the variance is huge, and never negative.

    What states fitted along take away may leave a direction with less than nothing, by rounding.
    """
    scale = np.sqrt(np.diag(information).clip(LEAST_INFORMATION))
    sizes, directions = np.linalg.eigh(information / np.outer(scale, scale))
    sizes = sizes.clip(ROUNDING * max(float(sizes[-1]), 1.0))
    return (directions / sizes) @ directions.T / np.outer(scale, scale)


def windows_of(
    world: World, episodes: Sequence[tuple[str, dict[str, Track]]], lead_frames: int | None, after_s: float
) -> tuple[list[tuple[str, dict[str, Track]]], list[tuple[float, float]], list[float]]:
    """Return episodes, at most `MAX_WINDOWS` evenly spread ones, windows [s] about their first contacts, and these [s].

    Args:
        world: The world.
        episodes: Name and tracks by body of each.
        lead_frames: Frames before the contact; None for all.
        after_s: How long a window goes on after it [s].
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


def described(parameter: Parameter, coordinate: float, std: float, reach: float = REACH) -> FittedParameter:
    """Return a parameter as `model.json` has it, from its estimate and standard error in fitted coordinates.

    reach: half of the interval, in standard errors.
    """
    low, high = parameter.limits
    estimate, *interval = (
        float(parameter.decode(torch.tensor(z, dtype=torch.float64)))
        for z in (coordinate, *(min(max(coordinate + k * reach * std, low), high) for k in (-1, 1)))
    )
    estimate = min(max(estimate, parameter.bounds[0]), parameter.bounds[1])  # rounding may lead past a bound
    state = "on_bound" if min(coordinate - low, high - coordinate) < 1e-6 * (high - low) else "fitted"
    if std > UNOBSERVABLE_SHARE * parameter.prior[1]:
        state = "not_observable"
    factor = "factor of the second moment of mass given or derived before; " if ".moment_" in parameter.name else ""
    return FittedParameter(
        name=parameter.name,
        unit=parameter.unit,
        estimate=estimate,
        std_error=std * (estimate if parameter.logarithmic else 1.0),
        interval_95=(interval[0], interval[1]),
        bounds=parameter.bounds,
        state=state,
        note=f"{factor}{parameter.reveals} would reveal it",
    )


def bound_warnings(parameters: Sequence[Parameter], fitted: Sequence[FittedParameter]) -> list[str]:
    """Say of each parameter that ended on a bound which one it is, and what that means."""
    meaning = {parameter.name: parameter.at_bounds for parameter in parameters}
    texts = []
    for found in fitted:
        if found.state != "on_bound" or found.bounds is None:
            continue
        upper = found.estimate - found.bounds[0] > found.bounds[1] - found.estimate
        side, unit = ("upper" if upper else "lower"), "" if found.unit == "1" else f" {found.unit}"
        texts.append(
            f"{found.name} ended on its {side} bound ({found.estimate:.3g}{unit}), which is no estimate: "
            f"{meaning[found.name.partition('[')[0]][upper]}."
        )
    return texts
