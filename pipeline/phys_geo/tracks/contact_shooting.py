"""Estimate of the contact parameters by multiple shooting, checked against that of the search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ....datasets.capture.tracks import Episode
from ....datasets.io.progress import progress
from ....schemas import PhysConfig
from ...optimization.importance_sampling import SearchResult
from ...physics.parameters import CONTACT_TIME, FRICTION, GROUND_SHIFT, Parameter, base_name
from ...physics.world import World
from ...trajectories.track_noise import Noise
from .contact_result import ContactEstimate, ShootingRecord
from .multiple_shooting import Shooting, ShootingFit, ShootingPrior
from .open_loop_search import SEVERAL_EPISODES, SearchBatch, open_loop_errors
from .tempered_posterior import tempered, with_friction_law_error

OPEN_LOOP_TOLERANCE = 8.0
"""Maximum ratio of the open-loop error of shooting to that of the search, for bodies that nothing drives; above it the
search's estimate is kept. In a rough motion over impacts the search makes up for what the contact model lacks by a
friction that is a fifth too low, and predicts other tosses no better (102 motions of MuJoCo, DART and Rapier)."""
GLIDING_TOLERANCE = 1.0
"""The same where all bodies slide or roll from the first frame on: such motion is smooth, and the search finds its best
friction. Ties that let the spin jump from segment to segment make up for a friction that is too low to roll with, and
above the one with which a ball just rolls no friction predicts better than another."""
STARTS = ((0.5, 1.0), (1.0, 1.0), (1.7, 1.0), (1.0, 0.6), (1.0, 1.6))
"""Further starts of shooting: friction and contact time as multiples of the priors' medians."""
BEST = 3
"""Number of descents that are continued. From `SEVERAL_EPISODES` on the cost has a single basin, and one is
continued."""
SHOT_ITERATIONS = 12
"""Minimum value of the limit on steps in each descent of shooting."""
CONTINUED = 8
"""Limit on steps in a continued descent as a multiple of that of the others. Contacts that begin and end make kinks in
the cost, at which more than half of all steps are rejected: descents converge in 20 to 60 steps, and where twelve ended
them, rounding changed the friction by up to a third."""
MODEL_EXCESS = 20.0
"""Additional division of the information of the data by each unit of the ties' misfit (`tempered`): where the ties are
violated, the contact model errs by more than noise, and the errors of one episode are not independent. Chosen on the
built-in scenes fall 0 to 5 (MuJoCo's contact); data that the model explains have no misfit and are unaffected."""


@dataclass(frozen=True, kw_only=True)
class ShootingEpisodes:
    """Episodes for multiple shooting."""

    episodes: Sequence[Episode]
    """Name and tracks by body of each episode."""
    spans: Sequence[tuple[float, float]]
    """Start and end of the part of each episode that is fitted [s]."""
    batch: SearchBatch
    """The same episodes with the initial states of the search."""


def shoot_contact(
    world: World,
    data: ShootingEpisodes,
    search: SearchResult,
    names: Sequence[Parameter],
    ground_known: bool,
    noise: Noise,
    config: PhysConfig,
    tolerance: float = OPEN_LOOP_TOLERANCE,
) -> tuple[ContactEstimate, ShootingRecord]:
    """Fit the contact parameters by multiple shooting, and keep the search's estimate if shooting predicts worse.

    The scatter of the search's samples knows neither of the errors of the start state nor of those of the contact
    model. Where its estimate is kept, the covariance is that of shooting and of how far the two lie apart.

    Args:
        world: The world.
        data: The episodes.
        search: Result of the search for the same parameters.
        names: Parameters that were searched.
        ground_known: Whether the height of the ground was fitted before.
        noise: Of the tracks (position [m], rotation [rad]).
        config: The stage's settings.
        tolerance: Maximum ratio of the open-loop error of shooting to that of the search.
    """
    parameters = _with_ground(world, names, ground_known)
    prior = ShootingPrior.of(parameters)
    shots = _descended(
        world, data, parameters, _starts(parameters, prior, search, len(data.episodes)), prior, noise, config
    )
    shot = shots[0]
    shared, covariance, growth = tempered(shot, prior, MODEL_EXCESS)
    covariance = with_friction_law_error(covariance, parameters, shot.misfit)
    errors = open_loop_errors(world, data.batch.observations, data.batch.warm, parameters)
    cost = float(errors(shared[None]).mean())
    finite = math.isfinite(shot.cost) and math.isfinite(cost)
    pushed = bool(data.batch.observations.drives)
    keep = finite and (pushed or cost <= tolerance * search.lowest)
    record = ShootingRecord(
        costs=[one.cost for one in shots],
        converged=shot.converged,
        misfit_ties=shot.misfit,
        misfit_frames=shot.chi2,
        information_over=growth,
        search_open_loop_m=search.lowest,
        open_loop_m=cost,
        kept=keep,
    )
    if not keep:
        covariance = _apart(search, shared, covariance) if finite else search.covariance
        return ContactEstimate(parameters=names, values=search.mean, covariance=covariance), record
    first = data.batch.observations
    starts = {
        name: (float(time), shot.state.at([row]))
        for row, (name, time) in enumerate(zip(first.names, first.times_s[:, 0], strict=True))
    }
    return ContactEstimate(parameters=parameters, values=shared, covariance=covariance, starts=starts), record


def _apart(search: SearchResult, shared: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the covariance of the search's estimate (P, P) by that of shooting, which may have one parameter more."""
    count = len(search.mean)
    apart = search.mean - shared[:count]
    return covariance[:count, :count] + np.outer(apart, apart)


def _with_ground(world: World, names: Sequence[Parameter], ground_known: bool) -> list[Parameter]:
    """Return the parameters of the search, with the height of the ground if it has not been fitted."""
    lacking = world.ground_normal is not None and GROUND_SHIFT not in names and not ground_known
    return [*names, GROUND_SHIFT] if lacking else list(names)


def _starts(
    parameters: Sequence[Parameter], prior: ShootingPrior, search: SearchResult, episodes: int
) -> list[np.ndarray]:
    """Return the starts of the descents (P,): the search's result and, with few episodes, `STARTS`."""
    middle = prior.mean.numpy()
    starts = [np.concatenate([search.mean, middle[len(search.mean) :]])]
    for friction, contact_time in () if episodes >= SEVERAL_EPISODES else STARTS:
        times = {FRICTION.name: friction, CONTACT_TIME.name: contact_time}
        starts.append(middle + np.log([times.get(base_name(p.name), 1.0) for p in parameters]))
    return starts


def _descended(
    world: World,
    data: ShootingEpisodes,
    parameters: Sequence[Parameter],
    starts: Sequence[np.ndarray],
    prior: ShootingPrior,
    noise: Noise,
    config: PhysConfig,
) -> list[ShootingFit]:
    """Return the ends of the continued descents, the lowest cost first."""
    several = len(data.episodes) >= SEVERAL_EPISODES
    whole = data.batch.observations
    problem = Shooting.of(world, parameters, data.episodes, data.spans, noise, prior, several, whole=whole)
    best = 1 if several else BEST
    bar = progress(range(2 * len(starts) + best), "phys-geo: multiple shooting", total=2 * len(starts) + best)
    shown = iter(bar)
    most = max(config.iterations, SHOT_ITERATIONS)
    shots = problem.fit(
        [torch.as_tensor(start) for start in starts],
        most,
        best,
        CONTINUED * most,
        lambda: next(shown, None),
    )
    bar.close()
    return shots
