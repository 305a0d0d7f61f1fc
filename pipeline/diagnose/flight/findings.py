"""What flights show: the effects that they lack, judged beside the errors that the tracks carry, and what is left.

Where errors of short windows are correlated, what all candidates together do not follow is first split into the errors
of whole flights (`slow_errors`), under which the search runs, so that an effect counts as far as it does the
same in all episodes. White noise is believed as long as it explains what is left beside the effects that it shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ...physics.parameters import effect_parameters
from ...physics.world import World
from ...segments.candidates import Candidate, admissible, variants_of
from ...segments.flights.repeated_forces import RepeatedForce, repeated_force
from ...segments.flights.residual_wrench import Omnibus, ResidualWrenches, dispersion
from ...segments.flights.slow_errors import SlowErrors, flight_errors, tell_errors
from ...segments.linearization import linearize
from ...segments.prepare import Prepared
from ...segments.segments import Segments
from ..evidence.effect_selection import SelectionStep, repeats
from ..evidence.evidence import Evidence
from ..evidence.falsification import Consistency
from ..thresholds import THRESHOLDS
from .omnibus import flight_windows, is_significant, worst_omnibus
from .other_forms import OtherForms
from .own_spin import SPIN_LIFT
from .own_tilt import TILTS, own_tilts
from .search import flight_search
from .selection import FlightSelection, completed, judged, reconsidered

LIMITS = THRESHOLDS.verdict


@dataclass(frozen=True, kw_only=True)
class FlightFindings:
    """Result of the search in flight."""

    prepared: Prepared
    """The episodes, with slow errors as part of their noise where there are any."""
    slow: SlowErrors | None
    """The slow errors; None where there are none."""
    scatter: float
    """Factor by which variances exceed those of the noise."""
    steps: tuple[SelectionStep, ...]
    """The selection steps; without a selected effect the one step that selected none."""
    world: World
    """The world with the selected effects."""
    segments: Segments | None
    """Flight segments with states fitted by it; None without flight."""
    before: Omnibus | None
    """Omnibus statistic without the selected effects, the worst over window lengths; None without flight."""
    after: Omnibus | None
    """The same with them."""
    agreement: Consistency | None
    """Whether the effects have the same parameters in all episodes; None without effects."""
    others: tuple[OtherForms, ...]
    """Other forms of each selected effect that is a force."""
    fleeting: tuple[str, ...]
    """The selected effects that are constant forces and do not act as much late in the flights as early."""
    left: RepeatedForce | None
    """What repeats from episode to episode beside the selected effects, as a law of any form; None where unknown."""
    common_share: float
    """Share of what repeats from episode to episode that the selected effects explain; 1 where nothing is left."""
    own_law: str | None = None
    """What accelerations that differ from episode to episode follow, so that they are none of each episode's own."""
    withheld: tuple[OtherForms, ...] = ()
    """Other forms of forces that `world` has and no step names, since their law is not known."""

    levelled: tuple[Evidence, ...] = ()
    """Tilts that all episodes have, and that are no more than errors of levelling."""

    @property
    def in_flight(self) -> list[str]:
        """Names of the selected effects with one value for all episodes."""
        return [step.best.name for step in self.steps if step.flagged and step.own_std is None]

    @property
    def own(self) -> list[str]:
        """Names of the selected effects with a value for each episode."""
        return [step.best.name for step in self.steps if step.flagged and step.own_std is not None]

    @property
    def remains(self) -> bool:
        """Whether a residual exceeds the noise beside the selected effects."""
        return is_significant(self.after) or self.recurs or bool(self.withheld)

    @property
    def recurs(self) -> bool:
        """Whether a residual beside the selected effects repeats, or follows a law where it differs."""
        return self.repeats or self.own_law is not None

    @property
    def explained_share(self) -> float:
        """Share of the excess of the omnibus statistic over 1 that the selected effects explain."""
        if self.before is None or self.after is None or self.before.statistic <= 1:
            return 0.0
        return 1 - (self.after.statistic - 1) / (self.before.statistic - 1)

    @property
    def repeats(self) -> bool:
        """Whether a residual repeats from episode to episode beside the selected effects."""
        return self.left is not None and self.left.p_value < LIMITS.repeated_p

    @property
    def untold(self) -> bool:
        """Whether what is left may be errors of the tracking that last, which too few flights cannot show."""
        return not (self.prepared.noise_model.correlated or tell_errors(self.prepared))

    @property
    def left_constant(self) -> bool:
        """Whether what repeats beside the selected effects is a constant force in world axes."""
        return self.left is not None and self.left.coordinate == "constant" and self.left.frame == "world"

    @property
    def predicts(self) -> bool:
        """Whether each selected effect repeats from episode to episode; False without any."""
        chosen = [step for step in self.steps if step.flagged]
        return bool(chosen) and all(any(repeats(e, len(one.evidence)) for e in one.equals) for one in chosen)

    @property
    def differs(self) -> bool:
        """Whether what is left differs from episode to episode and follows nothing, as slow errors of the tracking."""
        return self.slow is not None and not self.repeats and self.own_law is None

    @property
    def doubtful(self) -> bool:
        """Whether the selected effects imitate something else.

        Their parameters change from episode to episode, their law is another one, a law of any form explains more of
        what repeats than they do, they leave all that exceeds the noise, or what differs from episode to episode
        follows a law of the motion and they neither explain nearly all that the model lacks nor repeat with the same
        parameters.
        """
        inconsistent = self.agreement is not None and self.agreement.doubtful
        # what is left is known where it is a constant force: a candidate, and no other law that the effects imitate
        least = LIMITS.constant_share if self.left_constant else LIMITS.common_share
        imitated = self.repeats and self.common_share < least
        most = bool(self.in_flight) and self.explained_share >= LIMITS.enough_share
        steady = self.predicts and self.agreement is not None and self.agreement.share >= LIMITS.consistent_share
        follows = self.own_law is not None and not (most or steady)
        other = bool(self.fleeting) or any(one.likelier for one in self.others)
        useless = bool(self.in_flight) and is_significant(self.after) and self.explained_share <= 0
        return inconsistent or imitated or follows or other or useless


def flight_findings(prepared: Prepared, world: World, candidates: Sequence[Candidate]) -> FlightFindings:
    """Search flights for the effects that a world lacks.

    Args:
        prepared: The episodes.
        world: The model's world.
        candidates: All candidates.
    """
    search = _Search(prepared, world, candidates)
    errors, law = search.errors(world) if prepared.noise_model.correlated else None, None
    beside = search.beside(errors)
    chosen = search.selection(beside)
    if errors is not None:
        errors, law, beside, chosen = search.settled(errors, beside, chosen)
    found = search.findings(beside, chosen, errors, law)
    if errors is None and not prepared.noise_model.correlated and (found.remains or found.doubtful):
        errors, law = search.told(found.world, search.errors(found.world))
        if errors is None:
            return replace(found, own_law=law)
        beside = search.beside(errors)
        found = search.findings(beside, search.selection(beside), errors, law)
    specific = {p.name.partition(".")[0]: p.shared for p in effect_parameters(found.world) if p.shared != "all"}
    by_group = {name for name, shared in specific.items() if shared == "group" or name == SPIN_LIFT}
    if not by_group - {active.effect.name for active in world.effects}:
        return found
    # what groups have of their own counted as slow errors of the tracks, and hid which effect it is
    own = replace(search, prepared=prepared.with_own(found.world))
    errors, law = own.told(found.world, own.errors(found.world), tilted=not by_group & set(TILTS))
    if SPIN_LIFT not in by_group and (errors is None or not errors.noise_model.slow):
        return found
    beside = search.beside(errors)
    return search.findings(beside, search.selection(beside), errors, law)


class _Beside(NamedTuple):
    """Episodes under one noise."""

    prepared: Prepared
    """The episodes, with errors of whole flights as part of their noise where there are any."""
    windows: list[tuple[Segments, ResidualWrenches]]
    """Windows of their flights with residual wrenches, by length."""

    @property
    def scatter(self) -> float:
        """Factor by which variances exceed those of the noise."""
        return max(self.prepared.slow, dispersion(*self.windows[-1])) if self.windows else 1.0


@dataclass(frozen=True)
class _Search:
    """What each step of the search in flight needs."""

    prepared: Prepared
    """The episodes, without errors of whole flights as part of their noise."""
    world: World
    """The model's world."""
    candidates: Sequence[Candidate]
    """All candidates."""

    def errors(self, world: World) -> SlowErrors | None:
        """Return the errors of whole flights beside the effects of a world and all candidates; None for known ones."""
        kept, _ = admissible(world, self.candidates, self.prepared.has_orientation)
        return flight_errors(self.prepared, world, variants_of(kept, world.gravity[0, :1]))

    def beside(self, errors: SlowErrors | None) -> _Beside:
        """Return the episodes with errors as part of their noise."""
        prepared = self.prepared
        if errors is not None:
            prepared = prepared.with_slow_noise(self.world, errors.noise_model, flights=errors.flights)
        return _Beside(prepared, flight_windows(prepared, self.world))

    def selection(self, beside: _Beside) -> FlightSelection:
        """Return the effects with one value for all episodes that flights ask for."""
        return FlightSelection(*flight_search(beside.prepared, self.world, self.candidates, beside.scatter))

    def settled(
        self, errors: SlowErrors, beside: _Beside, chosen: FlightSelection
    ) -> tuple[SlowErrors | None, str | None, _Beside, FlightSelection]:
        """Return errors, what accelerations follow, episodes and effects, searched again where the errors are others.

        Errors are estimated beside all candidates, but each of them as small: what is not linear in a large effect
        counts as an error until this effect is found.
        """
        told, law = self.told(chosen.world, self.errors(chosen.world) if chosen.names else errors)
        # accelerations of the flights' own that only show beside the effects are part of the errors, too
        if told is None or _sways(told) != _sways(errors) or _differ(chosen, told):
            beside = self.beside(told)
            return told, law, beside, self.likelier(beside, self.selection(beside), chosen)
        return replace(told, noise_model=errors.noise_model), law, beside, chosen

    def likelier(self, beside: _Beside, found: FlightSelection, before: FlightSelection) -> FlightSelection:
        """Return the likelier (by BIC) of two selections: of a search, and of one before it, under other errors.

        A search takes one effect at a time: where two together explain what is left, a third one may come first that
        imitates both.
        """
        if set(before.names) == set(found.names):
            return found
        again = reconsidered(beside.prepared, before, self.candidates, beside.scatter)
        return min(found, again, key=lambda one: one.bic(beside.scatter))

    def told(
        self, world: World, errors: SlowErrors | None, tilted: bool = True
    ) -> tuple[SlowErrors | None, str | None]:
        """Return errors without what nothing may hide, and what accelerations follow that are no tilts.

        Args:
            world: The world with the effects found so far.
            errors: The errors beside these.
            tilted: Whether episodes may have a tilt of their own; not where their groups have one.
        """
        if errors is None or not errors.sway_evidence:
            return errors, None
        if not tilted:
            return errors.tiltless(), None
        own = own_tilts(self.prepared, world, self.candidates, errors)
        if own.kind == "tilts":
            return errors, own.law
        # what is not named as a tilt counts as an error all the same, unless it is a force
        return (errors.tiltless() if own.kind == "force" else replace(errors, sway_evidence=0.0)), own.law

    def findings(
        self, beside: _Beside, chosen: FlightSelection, errors: SlowErrors | None, own_law: str | None
    ) -> FlightFindings:
        """Return the findings of a selection.

        What repeats is looked for in short windows, whose errors differ from episode to episode whatever their law.

        Args:
            beside: The episodes, with the errors as part of their noise.
            chosen: The effects with one value for all episodes.
            errors: The errors of whole flights; None for those of short windows.
            own_law: What accelerations that differ from episode to episode follow.
        """
        slow = errors if errors is not None and errors.noise_model.slow else None
        scatter, before = beside.scatter, worst_omnibus(beside.windows, beside.scatter)
        found = completed(beside.prepared, chosen, self.candidates, scatter, errors)
        prepared, quick = beside.prepared.with_own(found.world), self.prepared.with_own(found.world)
        tested = judged(prepared, found, self.candidates, scatter, slow, own_law is not None)
        found = tested.selection.with_scatter(prepared.groups, scatter).without_idle()
        changed = found.world is not self.world
        left, share = _left(quick, self.world, found.world, changed)
        return FlightFindings(
            prepared=prepared,
            slow=slow,
            scatter=scatter,
            steps=tuple(found.steps),
            world=found.world,
            segments=found.flight,
            before=before,
            after=worst_omnibus(flight_windows(prepared, found.world), scatter) if changed else before,
            agreement=tested.agreement if found.names else None,
            fleeting=tuple(sorted(tested.fleeting & set(found.names))),
            others=tuple(one for one in tested.others if one.effect in found.names),
            left=left,
            common_share=share,
            own_law=own_law,
            withheld=tuple(one for one in tested.others if one.effect in tested.withheld),
            levelled=tested.levelled,
        )


def _sways(errors: SlowErrors) -> bool:
    """Return whether flights have accelerations of their own among the errors."""
    return errors.noise_model.position.sway > 0


def _differ(chosen: FlightSelection, errors: SlowErrors) -> bool:
    """Return whether errors change the standard error of a selected effect by more than `LIMITS.same_error`."""
    if chosen.flight is None or not chosen.names:
        return False
    stds = []
    for flight in (chosen.flight, replace(chosen.flight, noise_model=errors.noise_model)):
        linear = linearize(flight, chosen.world, (), [0] * (1 + max(i.episode for i in flight.items)), robust=False)
        information = (linear.information * linear.weight[:, None, None]).sum(0) + np.diag(linear.prior)
        own = [k for k, p in enumerate(linear.parameters) if p.name.partition(".")[0] in chosen.names]
        stds.append(np.sqrt(np.diag(np.linalg.inv(information))[own]))
    return bool((np.abs(np.log(stds[1] / stds[0])) > math.log(LIMITS.same_error)).any())


def _left(prepared: Prepared, world: World, after_flight: World, selected: bool) -> tuple[RepeatedForce | None, float]:
    """Return what repeats beside the selected effects, and the share of all that repeats that these explain."""
    if prepared.flight is None:
        return None, 1.0
    worlds = [world, after_flight] if selected else [world]
    found = [one.once(prepared.short_windows) for one in worlds]
    laws = [None if one is None else repeated_force(one) for one in found]
    last = laws[-1]
    if last is None or found[0] is None or found[-1] is None:
        return None, 1.0
    explained = _square(found[0]) - _square(found[-1])
    gain = max(last.gain, 0.0)
    return last, explained / (explained + gain) if explained + gain > 0 and selected else float(gain <= 0)


def _square(found: ResidualWrenches) -> float:
    """Return chi2 of residual wrenches."""
    return float(np.einsum("ni,nij,nj->", found.wrench, found.information, found.wrench))
