"""Selection of effects in flight: the search, its revision beside slow errors, and tests of the laws that it found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from ...physics.parameters import effect_parameters
from ...physics.world import World
from ...segments.candidates import Candidate, base_parameters, variants_of, without_effects
from ...segments.flights.slow_errors import SlowErrors
from ...segments.prepare import Prepared
from ...segments.segment_fit import refit
from ...segments.segments import Segments
from ..evidence.cross_validation import held_out_loss
from ..evidence.effect_selection import SelectionStep
from ..evidence.evidence import Evidence
from ..evidence.falsification import Consistency, consistency, fitted_numbers
from ..thresholds import THRESHOLDS
from .coupled_effects import DRAGS
from .group_values import with_group_values
from .lasting_forces import without_lasting
from .levelling import common_tilt_p
from .omnibus import flight_windows, is_significant, worst_omnibus
from .other_forms import OtherForms, other_forms
from .own_spin import with_own_spins
from .own_tilt import OWN_TILTS, TILTS, own_tilt_step
from .search import reselected

LIMITS = THRESHOLDS.verdict


class FlightSelection(NamedTuple):
    """The effects selected in flight."""

    steps: list[SelectionStep]
    """The selection steps; without a selected effect the one step that selected none."""
    world: World
    """The world with the selected effects."""
    flight: Segments | None
    """Flight segments with states fitted by it; None without flight."""

    @property
    def names(self) -> list[str]:
        """Names of the selected effects with one value for all episodes."""
        return [step.best.name for step in self.steps if step.flagged and step.own_std is None]

    @property
    def classes(self) -> list[tuple[str, ...]]:
        """Names of each of these effects and of its equals, its own the first."""
        shared = [step for step in self.steps if step.flagged and step.own_std is None]
        return [tuple(one.name for one in step.equals) for step in shared]

    def with_scatter(self, groups: Sequence[int], scatter: float) -> FlightSelection:
        """Give the numbers of the effects standard errors that hold the scatter between episodes."""
        if self.flight is None or not self.names:
            return self
        own = []
        for step in self.steps:
            if step.flagged and step.own_std is not None:
                variants = variants_of([step.best.candidate], self.world.gravity[0, :1])
                own += [(variants[0], step.best.name.endswith("@episode"))] if len(variants) == 1 else []
        numbers = fitted_numbers(self.flight, self.world, self.names, groups, scatter, own)
        return self._replace(steps=[_with_numbers(step, numbers) for step in self.steps])

    def without(self, names: set[str]) -> FlightSelection:
        """Leave out some effects, with those that act through them, and fit the others again."""
        if self.flight is None:
            return self
        world, flight = _without(self.flight, self.world, names)
        left = {active.effect.name for active in world.effects}
        gone = names | ({active.effect.name for active in self.world.effects} - left)
        return FlightSelection([step for step in self.steps if step.best.name not in gone], world, flight)

    def unnamed(self, names: frozenset[str]) -> FlightSelection:
        """Leave out the names of some effects, which stay in the world as forces of a law that is not known."""
        return self._replace(steps=[step for step in self.steps if step.best.name not in names])

    def without_idle(self) -> FlightSelection:
        """Leave out the effects that have no number, or without which held-out flights are predicted as well.

        Where none is left, the step that selected the first one stays, as one that selected none.
        """
        found = self
        for step in reversed(self.steps):
            name = step.best.name
            idle = name in found.names and (not step.best.is_number or _adds_nothing(found, name))
            if idle and not _carrying(found, name):
                found = found.without({name})
        return found.or_none_of(self)

    def or_none_of(self, before: FlightSelection) -> FlightSelection:
        """Return the selection; where none is left, with the first step of one before it, as one that selected none."""
        if self.steps or not before.steps:
            return self
        return self._replace(steps=[replace(before.steps[0], flagged=False)])

    def bic(self, scatter: float) -> float:
        """Return BIC, up to a constant of the flights; infinite without flight.

        Args:
            scatter: Factor by which variances exceed those of the noise.
        """
        if self.flight is None:
            return math.inf
        rows = self.flight.residuals([], self.world.gravity.new_zeros(0), jacobian=False)[0]
        own = len(effect_parameters(self.world))
        return float(rows.square().sum()) / scatter + own * math.log(max(float(self.flight.dof.sum()), 2.0))


@dataclass(frozen=True, kw_only=True)
class JudgedSelection:
    """What is left of a selection after tests of the laws of its effects, and the results of these tests."""

    selection: FlightSelection
    """The effects that are left."""
    others: Sequence[OtherForms] = ()
    """Other forms of each effect that is a force."""
    fleeting: frozenset[str] = frozenset()
    """The constant forces that do not act as much late in the flights as early."""
    agreement: Consistency | None = None
    """Whether the effects have the same parameters in all episodes; None without effects."""
    withheld: frozenset[str] = frozenset()
    """Effects whose law is another one, and beside which the others were judged: they stay in the world, unnamed."""
    levelled: tuple[Evidence, ...] = ()
    """Tilts that all episodes have, and that are no more than errors of levelling."""


def _with_numbers(step: SelectionStep, numbers: Mapping[str, Mapping[str, tuple[float, float]]]) -> SelectionStep:
    """Return a step with other numbers of its effect, where there are any."""
    if step.best.name not in numbers or step.own_std is not None:
        return step
    return replace(step, equals=(replace(step.best, numbers=dict(numbers[step.best.name])), *step.equals[1:]))


def completed(
    prepared: Prepared,
    found: FlightSelection,
    candidates: Sequence[Candidate],
    scatter: float,
    errors: SlowErrors | None,
) -> FlightSelection:
    """Return the needed effects of a search, and those with a value for each episode or group."""
    found = found if errors is None else _beside_errors(prepared, found, candidates, scatter, errors)
    return found if found.flight is None else _with_own_spins(prepared, found, candidates, scatter)


def _beside_errors(
    prepared: Prepared,
    found: FlightSelection,
    candidates: Sequence[Candidate],
    scatter: float,
    errors: SlowErrors,
) -> FlightSelection:
    """Return the needed effects and those with a value for each episode or group."""
    if found.flight is None:
        return found
    if errors.noise_model.slow:
        found = _with_own_tilts(prepared, found, candidates, errors)
    found = _reselected(prepared, found, _with_the_needed(found), candidates, scatter)
    if found.flight is None or not errors.noise_model.slow:
        return found
    grouped = with_group_values(prepared, found.steps, found.world, found.flight, candidates, scatter)
    return FlightSelection(*grouped)


def _with_own_spins(
    prepared: Prepared, found: FlightSelection, candidates: Sequence[Candidate], scatter: float
) -> FlightSelection:
    """Select a lift by a spin of each episode's own, where flights ask for it, and the other effects beside it."""
    if found.flight is None:
        return found
    steps, world, flight = with_own_spins(prepared, found.steps, found.world, found.flight, candidates)
    if world is found.world:
        return found
    again = reselected(prepared, steps[:-1], steps[-1:], (world, flight), candidates, scatter)
    return FlightSelection(*again)


def _reselected(
    prepared: Prepared, found: FlightSelection, needed: FlightSelection, candidates: Sequence[Candidate], scatter: float
) -> FlightSelection:
    """Select the needed effects again where others have gone: rivals in the presence of what has gone are none."""
    if needed.flight is None or len(needed.steps) == len(found.steps):
        return needed
    common = [step for step in needed.steps if step.flagged and step.own_std is None]
    own = [step for step in needed.steps if step not in common]
    return FlightSelection(*reselected(prepared, common, own, (needed.world, needed.flight), candidates, scatter))


def reconsidered(
    prepared: Prepared, found: FlightSelection, candidates: Sequence[Candidate], scatter: float
) -> FlightSelection:
    """Select the effects of a search again, each beside the others, under the noise that episodes have now."""
    steps = [step for step in found.steps if step.flagged]
    if prepared.flight is None or not steps:
        return found._replace(flight=None)
    fitted = refit([prepared.flight], found.world, base_parameters(found.world, "flight"))
    return FlightSelection(*reselected(prepared, steps, [], (fitted.world, fitted.segments[0]), candidates, scatter))


def judged(
    prepared: Prepared,
    found: FlightSelection,
    candidates: Sequence[Candidate],
    scatter: float,
    slow: SlowErrors | None,
    followed: bool,
) -> JudgedSelection:
    """Leave out the effects whose law is another one, and beside slow errors those that episodes contradict.

    Args:
        prepared: The episodes.
        found: The selected effects.
        candidates: All candidates.
        scatter: Factor by which variances exceed those of the noise.
        slow: The slow errors.
        followed: Whether what is left is known to be a force that differs from episode to episode.
    """
    if found.flight is None:
        return JudgedSelection(selection=found)
    others = other_forms(
        found.flight, found.world, found.classes, scatter, candidates, prepared.has_orientation, prepared.groups
    )
    fleeting = frozenset(without_lasting(found.flight, found.world, found.names, scatter))
    wrong = _imitating(others, found.names) | fleeting
    withheld: frozenset[str] = frozenset()
    if wrong and set(found.names) - wrong and not _is_mostly_other(found, others):
        if _most_evident(found) in wrong or any(_carrying(found, name) for name in wrong):
            left = found.without(wrong)
            found = left if left.names else found  # a wind is none without the drag through which it acts
        else:
            # what is left of a force without its name would count against the name of another one
            withheld = frozenset(wrong & set(found.names))
            found = found.unnamed(withheld)
    before, found = found, _without_levelling(prepared, found, scatter)
    levelled = tuple(step.best for step in before.steps if step.best.name in set(before.names) - set(found.names))
    agreement = _agreement(prepared, found, found.names, scatter)
    if slow is not None and agreement is not None and (agreement.doubtful or followed):
        found = _without_contradicted(prepared, found, scatter, followed)
        agreement = _agreement(prepared, found, found.names, scatter)
    if withheld and not found.names:
        found, withheld = found.without(set(withheld)), frozenset()
    return JudgedSelection(
        selection=found,
        others=others,
        fleeting=fleeting,
        agreement=agreement,
        withheld=withheld,
        levelled=levelled,
    )


def _imitating(others: Sequence[OtherForms], names: Sequence[str]) -> set[str]:
    """Return the effects whose law is another one, and those that flights do not ask for beside such a law.

    A law that fits better than that of an effect may also do what a further effect was found for.
    """
    wrong = [one for one in others if one.likelier]
    return {one.effect for one in wrong} | {name for one in wrong if one.gain > 0 for name in one.instead} & set(names)


def _most_evident(found: FlightSelection) -> str:
    """Return the name of the selected effect with the most evidence."""
    named = [step.best for step in found.steps if step.best.name in found.names]
    return min(named, key=lambda one: math.inf if one.delta_bic is None else one.delta_bic).name


def _is_mostly_other(found: FlightSelection, others: Sequence[OtherForms]) -> bool:
    """Return whether the selected effect with the most evidence is known to be a force of another law.

    The others are then fitted beside a law that is wrong, and what it leaves may look like any of them.
    """
    most = _most_evident(found)
    return any(one.effect == most and one.odds > LIMITS.other_law for one in others)


def _without_levelling(prepared: Prepared, found: FlightSelection, scatter: float) -> FlightSelection:
    """Leave out effects of which flights do not tell a tilt that is no more than errors of levelling."""
    left = found
    for step in found.steps:
        named = {one.name for one in step.equals}
        if step.best.name not in left.names or not named & set(OWN_TILTS) or _carrying(left, step.best.name):
            continue
        other = left.without({step.best.name})
        if other.flight is not None:
            # levels look like a tilt alone, so that the number of effects that were tested does not matter
            p_value = common_tilt_p(other.flight, other.world, prepared.groups, scatter)
            if p_value > THRESHOLDS.flight.repeated_alpha:
                left = other
    return left.or_none_of(found)


def _agreement(prepared: Prepared, found: FlightSelection, names: Sequence[str], scatter: float) -> Consistency | None:
    """Return whether effects have the same parameters in all episodes; None without effects or flight."""
    if found.flight is None:
        return None
    return consistency(found.flight, found.world, names, prepared.groups, scatter)


def _with_own_tilts(
    prepared: Prepared, found: FlightSelection, candidates: Sequence[Candidate], slow: SlowErrors
) -> FlightSelection:
    """Select a tilt of each episode's own, where the slow errors have one, in place of a common one."""
    names = {step.best.name for step in found.steps if step.flagged}
    if not slow.sway_evidence or ("wind" in names and names & set(DRAGS)):
        return found  # a drag in wind pushes a box that turns as if each flight were tilted
    level = found.without(names & set(TILTS))
    if level.flight is None:
        return found
    own, world, flight = own_tilt_step(prepared, level.flight, level.world, candidates, slow)
    return FlightSelection([*(step for step in level.steps if step.flagged), own], world, flight)


def _with_the_needed(found: FlightSelection) -> FlightSelection:
    """Leave out each of several effects without which the others predict held-out flights as well.

    Beside correlated errors, whose model is not exact, the fall of BIC alone also takes an effect that adds nothing.
    """
    for step in reversed(found.steps):
        name = step.best.name
        if name in found.names and not _alone_or_carrying(found, name):
            found = _unless_needed(found, name)
    return found


def _alone_or_carrying(found: FlightSelection, name: str) -> bool:
    """Return whether no effect is left without one, or only such as act through it."""
    others = set(found.names) - {name}
    own = any(step.own_std is not None for step in found.steps)
    return not (others or own) or _carrying(found, name)


def _carrying(found: FlightSelection, name: str) -> bool:
    """Return whether another effect acts through one: wind acts through a drag."""
    others = set(found.names) - {name}
    return name in DRAGS and "wind" in others and not others & set(DRAGS)


def _adds_nothing(found: FlightSelection, name: str) -> bool:
    """Return whether held-out flights are predicted as well without an effect, its parameters from the others."""
    other = found.without({name})
    if found.flight is None or other.flight is None:
        return False
    return held_out_loss(other.flight, other.world) <= held_out_loss(found.flight, found.world)


def _unless_needed(found: FlightSelection, name: str) -> FlightSelection:
    """Leave out an effect without which the others predict held-out flights as well."""
    other = found.without({name})
    if found.flight is None or other.flight is None:
        return found
    loss = held_out_loss(found.flight, found.world)
    limit = loss + min(LIMITS.needed_share * loss, LIMITS.needed_chi2)
    return other if held_out_loss(other.flight, other.world) < limit else found


def _without_contradicted(
    prepared: Prepared, found: FlightSelection, scatter: float, followed: bool
) -> FlightSelection:
    """Leave out the effects whose parameters differ from episode to episode, where flights do not ask for them.

    Such an effect imitates something else; the others stand where what is left without it does not exceed the noise,
    or is known to be a force that differs from episode to episode (`followed`).
    """
    alone = {name: _agreement(prepared, found, [name], scatter) for name in found.names}
    wrong = {name for name, agreement in alone.items() if agreement is not None and agreement.doubtful}
    if not wrong or not any(step.flagged and step.best.name not in wrong for step in found.steps):
        return found
    other = found.without(wrong)
    if not followed and is_significant(worst_omnibus(flight_windows(prepared, other.world), scatter)):
        return found
    return other._replace(steps=[step for step in other.steps if step.flagged])


def _without(flight: Segments, world: World, names: set[str]) -> tuple[World, Segments]:
    """Return the world without some effects, the others fitted again, and the segments with states fitted by it."""
    if not names:
        return world, flight
    world = without_effects(world, *names)
    found = refit([flight], world, base_parameters(world, "flight"))
    return found.world, found.segments[0]
