"""Effects that act in flight fitted to flights alone, where nothing but noise stands between motion and model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ..datasets.tracks import Track
from .diagnosis.linear import linearised
from .diagnosis.prepared import prepare
from .diagnosis.refit import refit
from .first_contacts import UNOBSERVABLE_SHARE, FirstContacts, correlation_of, described, few_covariance, placed
from .physics.parameters import Parameter
from .physics.world import World

ITERATIONS = 25


def fit_effect_flights(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    wanted: Sequence[tuple[Parameter, float]],
    noise: tuple[float, float],
) -> FirstContacts | None:
    """Fit effects to the flights of episodes, each with a state of its own, as `cgwm diagnose` does.

    Impacts are left out: what the contact law misses in them would bend the effects' numbers.

    Args:
        world: With effects of which none acts in contact alone.
        episodes: Name and tracks by body of each episode.
        wanted: Their parameters, and the values that they start from.
        noise: Of the tracks (position [m], rotation [rad]).

    Returns:
        What was found; None where there are no flights, or they do not show all parameters.
    """
    prepared = prepare(world, episodes, noise)
    if prepared.flight is None:
        return None
    names = [parameter for parameter, _ in wanted]
    start = torch.tensor([parameter.encode(value) for parameter, value in wanted]).to(world.gravity)
    found = refit([prepared.flight], world, names, start, ITERATIONS)
    linear = linearised(found.segments[0], names, found.values)
    prior = torch.diag(torch.tensor([1 / p.prior[1] ** 2 for p in names])).to(start).numpy()
    information = linear.information.sum(0).numpy()
    # what a formula misses of the true effect is missed in all frames of an episode alike
    episode = torch.tensor([item.episode for item in prepared.flight.items])
    scores = torch.stack([linear.score[episode == one].sum(0) for one in episode.unique().tolist()])
    excess = max(prepared.slow, float(linear.chi2.sum() / linear.dof.sum().clamp_min(1.0)), 1.0)
    covariance = few_covariance(information / excess + prior, scores.numpy() / excess, prior)
    std = np.sqrt(np.diag(covariance))
    if any(s > UNOBSERVABLE_SHARE * p.prior[1] for s, p in zip(std, names, strict=True)):
        return None
    parameters = tuple(described(p, float(z), float(s)) for p, z, s in zip(names, found.values, std, strict=True))
    record = {"flights": len(prepared.flight.items), "costs": [found.cost], "chi2": excess}
    correlation = correlation_of([p.name for p in names], covariance)
    return FirstContacts(placed(world, names, found.values), parameters, record, (correlation,))
