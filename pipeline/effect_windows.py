"""Effects in a fit: those of flight found in flights, the others about first contacts, constants on their grids."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch

from ..datasets.tracks import Track
from .effect_flights import fit_effect_flights
from .first_contacts import AFTER_S, CONTACT_S, FirstContacts, fit_first_contacts
from .own_numbers import fit_own_numbers
from .physics.effects import ActiveEffect
from .physics.parameters import GROUND_SHIFT, Parameter, effect_parameters
from .physics.world import World

Start = list[tuple[Parameter, float]]


def fit_effect_windows(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    along: Sequence[tuple[Parameter, float]],
    noise: tuple[float, float],
    groups: Mapping[str, str] | None = None,
) -> FirstContacts:
    """Fit the world's effects: to flights those that they show, the others to flight and first contacts.

    The open-loop search is for few numbers: with every effect its valley gets narrower; flights and windows show
    effects well. A constant (a range, a speed) means nothing while its effect is neutral, so that it cannot be searched
    from there: it is tried at each value of its grid, and the one with the lowest cost is kept.

    Args:
        world: With effects.
        episodes: Name and tracks by body of each episode.
        along: The contact's numbers that are fitted along in contact, and where they start.
        noise: Of the tracks (position [m], rotation [rad]).
        groups: Group of each episode that belongs to one, for effects with numbers of each group's own.

    Raises:
        InputDataError: If an effect has numbers of each group's own, and an episode belongs to none.
        NotConvergedError: If the rollouts diverge at the start.
    """
    contact = [active.effect.name for active in world.effects if active.effect.phase == "contact"]
    others = [active.effect.name for active in world.effects if active.effect.name not in contact]
    after_s = CONTACT_S if contact else AFTER_S
    if any(parameter.shared != "all" for parameter in effect_parameters(world)):
        return _with_own_numbers(world, episodes, along, noise, groups or {}, bool(contact))

    def about_contacts(at: World, wanted: Start) -> FirstContacts:
        return fit_first_contacts(at, episodes, wanted, along, noise, True, after_s)

    flown = _best(world, others, lambda at, wanted: fit_effect_flights(at, episodes, wanted, noise)) if others else None
    if flown is not None and not contact:
        return flown
    # what flights show stands: in contact it would be bent by what the contact law misses
    touched = _best(world if flown is None else flown.world, contact if flown else [*others, *contact], about_contacts)
    assert touched is not None  # windows always give something
    if flown is None:
        return touched
    record = touched.record | {"in_flight": flown.record}
    parameters, constants = (*flown.parameters, *touched.parameters), flown.constants | touched.constants
    return FirstContacts(touched.world, parameters, record, (*flown.correlations, *touched.correlations), constants)


def _with_own_numbers(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    along: Sequence[tuple[Parameter, float]],
    noise: tuple[float, float],
    groups: Mapping[str, str],
    touching: bool,
) -> FirstContacts:
    # steps through a first contact are rough, and would hold up those of all the others
    others = [(p, value) for p, value in along if touching and p != GROUND_SHIFT]
    if along and world.ground_normal is not None:
        others.append((GROUND_SHIFT, 0.0))

    def own(at: World, _: Start) -> FirstContacts:
        # from where the effects stand: there the prior of units has its middle
        values = {f"{a.effect.name}.{name}": float(value) for a in at.effects for name, value in a.values.items()}
        wanted = [(parameter, values[parameter.name]) for parameter in effect_parameters(at)]
        return fit_own_numbers(at, episodes, groups, wanted, others, noise, not along, CONTACT_S if touching else 0.0)

    found = _best(world, [active.effect.name for active in world.effects], own)
    assert found is not None  # windows always give something
    return found


def _best(
    world: World, names: Sequence[str], fit: Callable[[World, Start], FirstContacts | None]
) -> FirstContacts | None:
    """Return the fit of some effects at those of their constants that fit best; None where a fit gives nothing."""
    grids = [
        (a.effect.name, constant) for a in world.effects if a.effect.name in names for constant in a.effect.constants
    ]
    best: FirstContacts | None = None
    tried = []
    for values in itertools.product(*(constant.grid for _, constant in grids)):
        chosen = {f"{effect}.{constant.name}": value for (effect, constant), value in zip(grids, values, strict=True)}
        at = _at(world, chosen)
        found = fit(at, _starts(at, names))
        if found is None:
            return None
        tried.append(chosen | {"cost": found.record["costs"][-1]})
        if best is None or tried[-1]["cost"] < best.record["costs"][-1]:
            best = replace(found, constants=chosen)
    assert best is not None  # the product of no grids has one member
    return replace(best, record=best.record | {"constants_tried": tried}) if grids else best


def _starts(world: World, names: Sequence[str]) -> Start:
    """Return the parameters of some effects and where they start: an effect that is neutral at the size that matters.

    Only numbers that cannot be negative: others have no sign yet. From nothing, what acts through another effect, as
    wind does through drag, would have no slope.
    """
    found = {parameter.name: parameter for parameter in effect_parameters(world)}
    starts = []
    for active in world.effects:
        if active.effect.name not in names:
            continue
        neutral = all(float(active.values[p.name]) == 0.0 for p in active.effect.parameters)
        for number in active.effect.parameters:
            value = float(active.values[number.name])
            begun = number.scale if neutral and number.nonnegative else value
            starts.append((found[f"{active.effect.name}.{number.name}"], begun))
    return starts


def _at(world: World, constants: Mapping[str, float]) -> World:
    effects = []
    for active in world.effects:
        own = {c.name: constants.get(f"{active.effect.name}.{c.name}") for c in active.effect.constants}
        chosen = {name: value for name, value in own.items() if value is not None}
        like = next(iter(active.values.values()), torch.zeros(1))
        effects.append(ActiveEffect.of(active.effect, active.values | chosen, like))
    return replace(world, effects=tuple(effects))
