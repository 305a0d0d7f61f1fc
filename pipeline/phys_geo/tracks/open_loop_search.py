"""Global search for the contact parameters on the open-loop error of rollouts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ....datasets.io.progress import progress
from ....schemas import NotConvergedError, PhysConfig
from ...geometry.rotation import geodesic_angle
from ...optimization.importance_sampling import NormalPrior, SearchResult, importance_search
from ...physics.observation_model import measure
from ...physics.parameters import FRICTION, Parameter, apply_parameters
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.track_noise import Noise

ERRORS_PER_EPISODE = 3.0
"""Number of independent errors in one episode's open-loop error; `docs/results-fits.md` has the resulting coverage of
the intervals."""
MAX_ROLLOUTS = 1200
"""Maximum number of rollouts in one batch of the search."""
POPULATION = (24, 96)
"""Minimum and maximum number of samples in a generation, chosen for about `MAX_ROLLOUTS` rollouts if the settings give
none."""
USUAL_PARAMETERS = 5
"""Number of parameters up to which `POPULATION` is enough."""
LEAST_GENERATIONS = 2
"""Minimum number of generations of a search that starts at an earlier fit."""
SEVERAL_EPISODES = 3
"""Minimum number of episodes whose joint cost has a single basin: shooting then starts at the search's result only."""
ENOUGH_EPISODES = 8
"""Minimum number of episodes for using the search alone: their mean error is smooth, and their scatter gives intervals
that do not rely on the model."""

ICE, ICE_SHARE = (0.004, 0.01, 0.02, 0.04, 0.08), 0.8
"""Frictions that are tried where bodies glide from the start, and the share of the error at the usual start to which
one of them has to bring it: to fall by less, a plateau of noise suffices."""


@dataclass(frozen=True)
class SearchBatch:
    """Episodes with their initial states, as one batch of rollouts."""

    observations: Observations
    """Observations of the episodes (E), with their initial states."""
    warm: Tensor
    """Frames of the warm-up, which the open-loop error leaves out, shape (E, T)."""
    start_cov: Tensor
    """Covariance (E, 12 nf, 12 nf) of the initial states."""


def search_contact(
    world: World,
    batch: SearchBatch,
    start: Sequence[tuple[Parameter, float]],
    noise: Noise,
    config: PhysConfig,
    warm_started: bool,
    near: bool = False,
) -> SearchResult:
    """Search for the parameters with the lowest open-loop error.

    Args:
        world: The world.
        batch: The episodes.
        start: Parameters to search, and their start.
        noise: Of the tracks (position [m], rotation [rad]).
        config: The stage's settings.
        warm_started: Whether the start comes from an earlier fit, which halves the number of generations.
        near: Whether the search is of what is near the start, not of all that the priors allow.

    Raises:
        NotConvergedError: If the rollouts diverge everywhere.
    """
    episodes, names = len(batch.observations.names), [p for p, _ in start]
    generations = max(LEAST_GENERATIONS, config.generations // 2) if warm_started else config.generations
    prior = NormalPrior(
        np.array([p.encode(p.prior[0]) for p in names]),
        np.array([p.prior[1] for p in names]),
        np.array([p.limits for p in names]),
    )
    bar = progress(range(generations), "phys-geo: search", total=generations)
    steps = iter(bar)

    def advance(_: int, cost: float) -> None:
        next(steps, None)
        bar.set_postfix_str(f"open loop {1e3 * cost:.1f} mm")

    result = importance_search(
        open_loop_errors(world, batch.observations, batch.warm, names),
        prior,
        seed=config.seed,
        population=config.population or default_population(episodes, len(names)),
        generations=generations,
        first=np.array([p.encode(value) for p, value in start]),
        near=near,
        errors=ERRORS_PER_EPISODE * episodes,
        floor=_noise_floor(world, batch.observations, noise),
        on_generation=advance,
    )
    bar.close()
    if not math.isfinite(result.lowest):
        raise NotConvergedError(
            "phys-geo: every rollout of the search diverged.", todo="check the masses, the units and the step_s."
        )
    return result


def friction_on_ice(world: World, batch: SearchBatch, start: Sequence[tuple[Parameter, float]]) -> float | None:
    """Return a friction far below that of usual materials with which bodies that glide are predicted better; or None.

    A ball rolls with any friction from two sevenths of the slope on, and a puck on air has almost none: above, the
    error of a prediction is a plateau, and no sample of a search falls into the valley below.
    """
    names = [p for p, _ in start]
    place = next((k for k, p in enumerate(names) if p.name == FRICTION.name), None)
    if place is None:
        return None
    tried = np.stack([np.array([p.encode(value) for p, value in start])] * (1 + len(ICE)))
    tried[1:, place] = [names[place].encode(friction) for friction in ICE]
    errors = open_loop_errors(world, batch.observations, batch.warm, names)(tried).mean(1)
    lowest = int(np.nan_to_num(errors, nan=np.inf).argmin())
    return ICE[lowest - 1] if lowest and errors[lowest] < ICE_SHARE * errors[0] else None


def default_population(episodes: int, parameters: int = USUAL_PARAMETERS) -> int:
    """Return the number of samples in a generation, more for more parameters than a rigid body on a ground has."""
    rollouts = MAX_ROLLOUTS
    if SEVERAL_EPISODES <= episodes < ENOUGH_EPISODES:  # shooting follows, and the cost has a single basin
        rollouts //= 5
    usual = min(max(rollouts // episodes, POPULATION[0]), POPULATION[1])
    return usual * max(parameters, USUAL_PARAMETERS) // USUAL_PARAMETERS


def _noise_floor(world: World, observations: Observations, noise: Noise) -> float:
    """Return the displacement of a surface point [m] that the noise of the tracks alone produces."""
    size = float(torch.stack([_surface_radius(world, index) for index in observations.free]).mean())
    return math.sqrt(3 * noise.position_m**2 + 3 * (size * noise.rotation_rad) ** 2)


def open_loop_errors(
    world: World, observations: Observations, warm: Tensor, names: Sequence[Parameter]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from samples (K, P), in fitted coordinates, to the open-loop error of each episode (K, E).

    The error is the mean displacement [m] of a point on the surface after the warm-up.

    Args:
        world: The world.
        observations: The episodes (E) with their initial states.
        warm: Frames of the warm-up, shape (E, T).
        names: Parameters (P) of the samples.
    """
    after = observations.seen * (~warm)[..., None].to(observations.seen.dtype)
    frames = after.sum((1, 2)).clamp_min(1.0)
    size = torch.stack([_surface_radius(world, index) for index in observations.free])

    def costs(samples: np.ndarray) -> np.ndarray:
        chunk = max(1, MAX_ROLLOUTS // len(observations.names))
        parts = [one(samples[first : first + chunk]) for first in range(0, len(samples), chunk)]
        return np.concatenate(parts)

    def one(samples: np.ndarray) -> np.ndarray:
        repeats = len(samples)
        values = torch.as_tensor(samples).repeat_interleave(len(observations.names), 0)
        decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(names)], -1)
        base = observations.state.repeat(repeats)
        drives = {name: drive.repeat(repeats) for name, drive in observations.drives.items()}
        with torch.no_grad():
            rollout = measure(
                apply_parameters(observations.world(world, repeats), names, decoded),
                base,
                observations.times_s.repeat(repeats, 1),
                drives,
            )
        free = list(observations.free)
        shift = rollout.position_m[:, :, free] - observations.position_m.repeat(repeats, 1, 1, 1)
        angle = geodesic_angle(rollout.quat_wxyz[:, :, free], observations.quat_wxyz.repeat(repeats, 1, 1, 1))
        turned = observations.has_orientation.repeat(repeats, 1, 1)
        error = (shift.square().sum(-1) + (turned * angle * size).square()).sqrt()
        weight = after.repeat(repeats, 1, 1)
        return ((error * weight).sum((1, 2)) / frames.repeat(repeats)).view(repeats, -1).numpy()

    return costs


def _surface_radius(world: World, index: int) -> Tensor:
    """Return the mean distance of the collision surface from the centre of mass [m]."""
    body = world.bodies[index]
    return ((body.centers[0] - body.com[0]).square().sum(-1).sqrt() + body.radii[0]).mean()
