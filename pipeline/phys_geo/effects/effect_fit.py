"""Effects in a fit: found in flights, glides, impacts or about first contacts, where they show; constants on grids."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch

from ..datasets.tracks import Track
from .diagnosis.prepared import prepare
from .effect_flights import fit_effect_flights
from .effect_glides import EffectGlides
from .effect_impacts import EffectImpacts
from .first_contacts import AFTER_S, CONTACT_S, FirstContacts, fit_first_contacts
from .own_numbers import fit_own_numbers
from .physics.effects import ActiveEffect
from .physics.parameters import GROUND_SHIFT, Parameter, effect_parameters
from .physics.world import World

Start = list[tuple[Parameter, float]]


def fit_effect_motions(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    along: Sequence[tuple[Parameter, float]],
    noise: tuple[float, float],
    groups: Mapping[str, str] | None = None,
) -> FirstContacts:
    """Fit the world's effects: to flights, glides and impacts those that they show, the others about first contacts.

    The open-loop search is for few numbers: with every effect its valley gets narrower; these show effects well. A
    constant (a range, a speed) means nothing while its effect is neutral, so that it cannot be searched from there: it
    is tried at each value of its grid, and the one with the lowest cost is kept.

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

    parts: dict[str, FirstContacts] = {}
    left, at = [*others, *contact], world
    flown = _best(at, others, lambda at, wanted: fit_effect_flights(at, episodes, wanted, noise)) if others else None
    if flown is not None:
        # what flights show stands: in contact it would be bent by what the contact law misses
        parts["in_flight"], left, at = flown, contact, flown.world
    prepared = prepare(_without(at, contact), episodes, noise) if contact else None
    for where, kind in (("in_glides", EffectGlides), ("in_impacts", EffectImpacts)):
        # not those of flight that flights do not show
        names = [a.effect.name for a in at.effects if a.effect.name in left and kind.may_tell(a.effect)]
        motion = kind.of(prepared, _without(at, names)) if prepared is not None and names else None
        if motion is None:
            continue
        told = _best(at, names, lambda at, _, motion=motion, names=names: motion.fit(at, names))
        assert told is not None  # these always give something
        shown = {parameter.name.partition(".")[0] for parameter in told.parameters}
        if shown:
            kept = {name: value for name, value in told.constants.items() if name.partition(".")[0] in shown}
            parts[where], at = replace(told, constants=kept), told.world
            left = [name for name in left if name not in shown]
            along = [(p, told.along.get(p.name, value)) for p, value in along]
    if left:
        about_contacts = _best(
            at, left, lambda at, wanted: fit_first_contacts(at, episodes, wanted, along, noise, True, after_s)
        )
        assert about_contacts is not None  # windows always give something
        parts["about_contacts"] = about_contacts
    return _joined(parts)


def _without(world: World, names: Sequence[str]) -> World:
    """Return the world without some of its effects."""
    return replace(world, effects=tuple(a for a in world.effects if a.effect.name not in names))


def _joined(parts: Mapping[str, FirstContacts]) -> FirstContacts:
    """Return what fits found one after the other, each in the world of the one before; by where they looked."""
    *before, (_, last) = parts.items()
    return replace(
        last,
        parameters=tuple(parameter for part in parts.values() for parameter in part.parameters),
        record=last.record | {where: part.record for where, part in before},
        correlations=tuple(block for part in parts.values() for block in part.correlations),
        constants={name: value for part in parts.values() for name, value in part.constants.items()},
        along={name: value for part in parts.values() for name, value in part.along.items()},
    )


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
