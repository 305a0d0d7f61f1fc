"""Fit of a world's effects to flights, sliding segments, impacts or first contacts, with constants from grids."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from ....datasets.capture.tracks import Episode
from ...physics.parameters import GROUND_SHIFT, Parameter, effect_parameters
from ...physics.world import World
from ...segments.candidates import without_effects
from ...segments.first_contact_fit import AFTER_S, CONTACT_S, EffectEstimate, fit_first_contacts
from ...segments.prepare import Prepared, prepare
from ...segments.random_effects import fit_random_effects
from ...trajectories.track_noise import Noise
from .by_motion import ImpactStart, SlidingStart, fit_effect_flights
from .identified_effects import with_constants

Start = list[tuple[Parameter, float]]
"""Parameters of effects, and their start."""
Episodes = Sequence[Episode]
"""Name and tracks by body of each episode."""


def fit_effects(
    world: World,
    episodes: Episodes,
    along: Sequence[tuple[Parameter, float]],
    noise: Noise,
    groups: Mapping[str, str] | None = None,
    held: Sequence[str] = (),
) -> EffectEstimate:
    """Fit the world's effects to flights, sliding segments and impacts, and the remaining ones around first contacts.

    The open-loop search suits few parameters, as each effect narrows its basin; single kinds of motion identify effects
    well. A constant (a range, a speed) has no influence while its effect is neutral, so that it cannot be searched from
    there: each value of its grid is tried, and the one with the lowest cost is kept.

    Args:
        world: World with effects.
        episodes: Name and tracks by body of each episode.
        along: Contact parameters that are fitted with the effects in contact, and their start.
        noise: Noise of the tracks (position [m], rotation [rad]).
        groups: Group of each episode that belongs to one, for effects with group-specific parameters.
        held: Effects that keep their values; none of those with group-specific parameters.

    Raises:
        InputDataError: If an effect has group-specific parameters, and an episode belongs to no group.
        NotConvergedError: If the rollouts diverge at the start.
    """
    free = [active.effect for active in world.effects if active.effect.name not in held]
    contact = [effect.name for effect in free if effect.phase == "contact"]
    others = [effect.name for effect in free if effect.phase != "contact"]
    after_s = CONTACT_S if contact else AFTER_S
    if any(parameter.shared != "all" for parameter in effect_parameters(world)):
        return _with_segment_parameters(world, episodes, along, noise, groups or {}, bool(contact))

    progress = _Progress(world, [*others, *contact], list(along), {})
    if others:
        progress = progress.with_flights(episodes, others, noise, groups or {})
    if contact:
        progress = progress.with_contacts(episodes, contact, noise)
    if progress.missing:
        progress = progress.with_first_contacts(episodes, noise, after_s)
    return _joined(progress.parts)


@dataclass(frozen=True)
class _Progress:
    """Effects found so far, each kind of motion fitted in the world that the one before has left."""

    world: World
    """The world with the effects found so far."""
    missing: list[str]
    """Names of the effects that are not identified yet."""
    along: list[tuple[Parameter, float]]
    """Contact parameters that are fitted with the effects, and their start."""
    parts: dict[str, EffectEstimate]
    """Estimates by the key of the kind of motion in `fit.json`."""

    def with_flights(
        self, episodes: Episodes, names: Sequence[str], noise: Noise, groups: Mapping[str, str]
    ) -> _Progress:
        """Add the effects that flights identify."""
        flown = _best(self.world, names, lambda at, wanted: fit_effect_flights(at, episodes, wanted, noise, groups))
        if flown is None:
            return self
        # these estimates are final: in contact the errors of the contact law would bias them
        identified = {parameter.name.partition(".")[0] for parameter in flown.parameters}
        missing = [name for name in self.missing if name not in identified]
        return replace(self, world=flown.world, missing=missing, parts=self.parts | {"in_flight": flown})

    def with_contacts(self, episodes: Episodes, contact: Sequence[str], noise: Noise) -> _Progress:
        """Add the effects that sliding segments identify, then those that impacts identify."""
        prepared = prepare(without_effects(self.world, *contact), episodes, noise)
        progress = self
        for where, kind in (("in_glides", SlidingStart), ("in_impacts", ImpactStart)):
            progress = progress._with_contact_motion(where, kind, prepared)
        return progress

    def _with_contact_motion(self, where: str, kind: type[SlidingStart | ImpactStart], prepared: Prepared) -> _Progress:
        """Add the effects that one kind of contact motion identifies."""
        missing = [a.effect for a in self.world.effects if a.effect.name in self.missing]
        # a force that no flight identified would be taken for the effects of contact: all are fitted together then
        names = [] if any(e.phase == "flight" for e in missing) else [e.name for e in missing if kind.may_identify(e)]
        motion = kind.of(prepared, without_effects(self.world, *names)) if names else None
        if motion is None:
            return self
        if len(names) == 1 and isinstance(motion, SlidingStart):
            found = motion.fit_one(self.world, names[0])
        else:
            found = _best_of(self.world, names, lambda at, _: motion.fit(at, names))
        identified = {parameter.name.partition(".")[0] for parameter in found.parameters}
        if not identified:
            return self
        kept = {name: value for name, value in found.constants.items() if name.partition(".")[0] in identified}
        return _Progress(
            found.world,
            [name for name in self.missing if name not in identified],
            [(p, found.contact_start.get(p.name, value)) for p, value in self.along],
            self.parts | {where: replace(found, constants=kept)},
        )

    def with_first_contacts(self, episodes: Episodes, noise: Noise, after_s: float) -> _Progress:
        """Add the effects that are still missing, from windows around first contacts."""
        found = _best_of(
            self.world,
            self.missing,
            lambda at, wanted: fit_first_contacts(at, episodes, wanted, self.along, noise, True, after_s),
        )
        return replace(self, missing=[], parts=self.parts | {"about_contacts": found})


def _joined(parts: Mapping[str, EffectEstimate]) -> EffectEstimate:
    """Return successive estimates, each in the world of the one before, as one; the last record holds the others."""
    *before, (_, last) = parts.items()
    return replace(
        last,
        parameters=tuple(parameter for part in parts.values() for parameter in part.parameters),
        record=last.record | {where: part.record for where, part in before},
        correlations=tuple(block for part in parts.values() for block in part.correlations),
        constants={name: value for part in parts.values() for name, value in part.constants.items()},
        contact_start={name: value for part in parts.values() for name, value in part.contact_start.items()},
    )


def _with_segment_parameters(
    world: World,
    episodes: Episodes,
    along: Sequence[tuple[Parameter, float]],
    noise: Noise,
    groups: Mapping[str, str],
    touching: bool,
) -> EffectEstimate:
    """Return the effects with group- or episode-specific parameters, as random effects."""
    # the cost is rough in parameters that move a first contact, which would slow down the steps of all others
    others = [(p, value) for p, value in along if touching and p != GROUND_SHIFT]
    if along and world.ground_normal is not None:
        others.append((GROUND_SHIFT, 0.0))

    def with_groups(at: World, _: Start) -> EffectEstimate:
        # start at the present values, where the prior of the groups has its mean
        values = {f"{a.effect.name}.{name}": float(value) for a in at.effects for name, value in a.values.items()}
        wanted = [(parameter, values[parameter.name]) for parameter in effect_parameters(at)]
        return fit_random_effects(
            at, episodes, groups, wanted, others, noise, not along, CONTACT_S if touching else 0.0
        )

    return _best_of(world, [active.effect.name for active in world.effects], with_groups)


def _best(
    world: World, names: Sequence[str], fit: Callable[[World, Start], EffectEstimate | None]
) -> EffectEstimate | None:
    """Return the fit of effects with the best values of their constants; None if a fit returns None."""
    grids = _grids(world, names)
    found: list[EffectEstimate] = []
    for chosen in grids:
        at = with_constants(world, chosen)
        one = fit(at, _starts(at, names))
        if one is None:
            return None
        found.append(replace(one, constants=chosen))
    return _lowest(found)


def _best_of(world: World, names: Sequence[str], fit: Callable[[World, Start], EffectEstimate]) -> EffectEstimate:
    """Return the fit of effects with the best values of their constants, for a fit that never returns None."""
    found: list[EffectEstimate] = []
    for chosen in _grids(world, names):
        at = with_constants(world, chosen)
        found.append(replace(fit(at, _starts(at, names)), constants=chosen))
    return _lowest(found)


def _grids(world: World, names: Sequence[str]) -> list[dict[str, float]]:
    """Return each combination of values of the effects' constants, by `effect.constant`; without any, an empty one."""
    grids = [
        (a.effect.name, constant) for a in world.effects if a.effect.name in names for constant in a.effect.constants
    ]
    return [
        {f"{effect}.{constant.name}": value for (effect, constant), value in zip(grids, values, strict=True)}
        for values in itertools.product(*(constant.grid for _, constant in grids))
    ]


def _lowest(found: Sequence[EffectEstimate]) -> EffectEstimate:
    """Return the fit with the lowest cost, the first of equal ones; its record lists all constants that were tried."""
    costs = [one.record["costs"][-1] for one in found]
    best = found[min(range(len(costs)), key=lambda k: costs[k])]
    if not best.constants:
        return best
    tried = [one.constants | {"cost": cost} for one, cost in zip(found, costs, strict=True)]
    return replace(best, record=best.record | {"constants_tried": tried})


def _starts(world: World, names: Sequence[str]) -> Start:
    """Return the parameters of effects and their start; a neutral effect starts at the scale of its parameters.

    That applies to nonnegative parameters, as the sign of others is unknown. From a neutral start an effect that acts
    through another one, as wind does through drag, would have no gradient.
    """
    found = {parameter.name: parameter for parameter in effect_parameters(world)}
    starts = []
    for active in world.effects:
        if active.effect.name not in names:
            continue
        neutral = all(float(active.values[p.name]) == 0.0 for p in active.effect.parameters)
        for parameter in active.effect.parameters:
            value = float(active.values[parameter.name])
            start = parameter.scale if neutral and parameter.nonnegative else value
            starts.append((found[f"{active.effect.name}.{parameter.name}"], start))
    return starts
