"""Effects fitted to flight and first contacts, their constants chosen on their grids there."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from ..datasets.tracks import Track
from .first_contacts import AFTER_S, CONTACT_S, FirstContacts, fit_first_contacts
from .physics.effects import ActiveEffect
from .physics.parameters import Parameter, effect_parameters
from .physics.world import World


def fit_effect_windows(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    along: Sequence[tuple[Parameter, float]],
    noise: tuple[float, float],
) -> FirstContacts:
    """Fit the world's effects to flight and first contacts; the contact's numbers beside them.

    The open-loop search is for few numbers: with every effect its valley gets narrower; windows show effects well.
    A constant (a range, a speed) means nothing while its effect is neutral, so that it cannot be searched from there:
    it is tried at each value of its grid, and the one with the lowest cost on the windows is kept.

    Args:
        world: With effects.
        episodes: Name and tracks by body of each episode.
        along: The contact's numbers that are fitted along, and where they start.
        noise: Of the tracks (position [m], rotation [rad]).

    Raises:
        NotConvergedError: If the rollouts diverge at the start.
    """
    touching = any(active.effect.phase == "contact" for active in world.effects)
    grids = [(active.effect.name, constant) for active in world.effects for constant in active.effect.constants]
    best: FirstContacts | None = None
    tried = []
    for values in itertools.product(*(constant.grid for _, constant in grids)):
        chosen = {f"{effect}.{constant.name}": value for (effect, constant), value in zip(grids, values, strict=True)}
        at = _at(world, chosen)
        start = {f"{a.effect.name}.{name}": float(value) for a in at.effects for name, value in a.values.items()}
        wanted = [(parameter, start[parameter.name]) for parameter in effect_parameters(at)]
        found = fit_first_contacts(at, episodes, wanted, along, noise, True, CONTACT_S if touching else AFTER_S)
        tried.append(chosen | {"cost": found.record["costs"][-1]})
        if best is None or tried[-1]["cost"] < best.record["costs"][-1]:
            best = replace(found, constants=chosen)
    assert best is not None  # the product of no grids has one member
    return replace(best, record=best.record | {"constants_tried": tried}) if grids else best


def _at(world: World, constants: Mapping[str, float]) -> World:
    effects = []
    for active in world.effects:
        own = {c.name: constants[f"{active.effect.name}.{c.name}"] for c in active.effect.constants}
        like = next(iter(active.values.values()), torch.zeros(1))
        effects.append(ActiveEffect.of(active.effect, active.values | own, like))
    return replace(world, effects=tuple(effects))
