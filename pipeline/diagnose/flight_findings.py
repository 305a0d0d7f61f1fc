"""What flights show: the effects that they lack, judged beside the errors that the tracks carry, and what is left.

The search runs once under the noise of short windows. What neither its effects nor all candidates together follow is
then split into the errors of whole flights (`segments/slow_errors`), unless white noise explains what is left; where
there are any, the search runs again under them, so that an effect counts as far as it does the same in all episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..physics.parameters import effect_parameters
from ..physics.world import World
from ..segments.candidates import Candidate, admissible, variants_of
from ..segments.prepare import Prepared
from ..segments.repeated_forces import RepeatedForce, repeated_force
from ..segments.residual_wrench import Omnibus, ResidualWrenches, dispersion, wrench_windows
from ..segments.segments import Segments
from ..segments.slow_errors import SlowErrors, flight_errors
from .alternative_laws import OtherLaw
from .effect_selection import SelectionStep, predicts_episodes
from .falsification import Consistency
from .flight_omnibus import flight_windows, is_significant, worst_omnibus
from .flight_selection import judged, selected
from .own_tilt import TILTS, own_tilts
from .thresholds import THRESHOLDS

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
    others: tuple[OtherLaw, ...]
    """Alternative laws of the selected effects."""
    fleeting: tuple[str, ...]
    """The selected effects that are constant forces and do not act as much late in the flights as early."""
    left: RepeatedForce | None
    """What repeats from episode to episode beside the selected effects, as a law of any form; None where unknown."""
    common_share: float
    """Share of what repeats from episode to episode that the selected effects explain; 1 where nothing is left."""
    own_law: str | None = None
    """What accelerations that differ from episode to episode follow, so that they are none of each episode's own."""

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
        return is_significant(self.after) or self.repeats or self.own_law is not None

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
    def predicts(self) -> bool:
        """Whether each selected effect predicts more than one held-out episode; False without any."""
        chosen = [step.best for step in self.steps if step.flagged]
        return bool(chosen) and all(predicts_episodes(one) for one in chosen)

    @property
    def differs(self) -> bool:
        """Whether what is left differs from episode to episode and follows nothing, as slow errors of the tracking."""
        return self.slow is not None and not self.repeats and self.own_law is None

    @property
    def doubtful(self) -> bool:
        """Whether the selected effects imitate something else.

        Their parameters change from episode to episode, their law is another one, a law of any form explains more of
        what repeats than they do, or what differs from episode to episode follows a law of the motion and they do not
        explain nearly all that the model lacks.
        """
        inconsistent = self.agreement is not None and self.agreement.doubtful
        imitated = self.repeats and self.common_share < LIMITS.common_share
        most = bool(self.in_flight) and self.explained_share >= LIMITS.enough_share
        follows = self.own_law is not None and not most
        other = bool(self.fleeting) or any(one.better for one in self.others)
        return inconsistent or imitated or follows or other


def flight_findings(prepared: Prepared, world: World, candidates: Sequence[Candidate]) -> FlightFindings:
    """Search flights for the effects that a world lacks.

    Args:
        prepared: The episodes.
        world: The model's world.
        candidates: All candidates.
    """
    found = _searched(prepared, prepared, world, candidates, None)
    if not (prepared.noise_model.correlated or found.remains or found.doubtful):
        return found
    errors, law = _told_errors(prepared, found.world, candidates)
    if errors is None:
        return replace(found, own_law=law)
    beside = prepared.with_slow_noise(world, errors.noise_model, flights=errors.flights)
    found = _searched(beside, prepared, world, candidates, errors, law)
    by_group = [p.name.partition(".")[0] for p in effect_parameters(found.world) if p.shared == "group"]
    if not by_group or not set(by_group) - {active.effect.name for active in world.effects}:
        return found
    # what groups have of their own counted as slow errors of the tracks, and hid which effect it is
    errors, own_law = _told_errors(
        prepared.with_own(found.world), found.world, candidates, not set(by_group) & set(TILTS)
    )
    if errors is None or not errors.noise_model.slow:
        return found
    beside = prepared.with_slow_noise(world, errors.noise_model, flights=errors.flights)
    return _searched(beside, prepared, world, candidates, errors, own_law)


def _told_errors(
    prepared: Prepared, world: World, candidates: Sequence[Candidate], tilted: bool = True
) -> tuple[SlowErrors | None, str | None]:
    """Return the errors of flights beside the effects of a world, and what accelerations follow that are no tilts.

    Args:
        prepared: The episodes.
        world: The world with the effects found so far.
        candidates: All candidates.
        tilted: Whether episodes may have a tilt of their own; not where their groups have one.
    """
    kept, _ = admissible(world, candidates, prepared.has_orientation)
    slow = flight_errors(prepared, world, variants_of(kept, world.gravity[0, :1]))
    if slow is None or not slow.sway_evidence:
        return slow, None
    if not tilted:
        return slow.tiltless(), None
    own = own_tilts(prepared, world, candidates, slow)
    if own.kind == "tilts":
        return slow, own.law
    # what is not named as a tilt counts as an error all the same, unless it is a force, which nothing may hide
    return (slow.tiltless() if own.kind == "force" else replace(slow, sway_evidence=0.0)), own.law


def _searched(
    prepared: Prepared,
    quick: Prepared,
    world: World,
    candidates: Sequence[Candidate],
    errors: SlowErrors | None,
    own_law: str | None = None,
) -> FlightFindings:
    """Return the findings under the noise of prepared episodes.

    Args:
        prepared: The episodes, with slow errors as part of their noise where there are any.
        quick: The same without them: what repeats is looked for in short windows, whose errors differ from episode to
            episode whatever their law.
        world: The model's world.
        candidates: All candidates.
        errors: The errors of whole flights; None for those of short windows.
        own_law: What accelerations that differ from episode to episode follow.
    """
    slow = errors if errors is not None and errors.noise_model.slow else None
    windows = flight_windows(prepared, world)
    scatter = max(prepared.slow, dispersion(*windows[-1])) if windows else 1.0
    before = worst_omnibus(windows, scatter)
    found = selected(prepared, world, candidates, scatter, errors)
    prepared, quick = prepared.with_own(found.world), quick.with_own(found.world)
    tested = judged(prepared, found, scatter, slow, own_law is not None)
    found, changed = tested.selection, tested.selection.world is not world
    left, share = _left(quick, world, found.world, changed)
    return FlightFindings(
        prepared=prepared,
        slow=slow,
        scatter=scatter,
        steps=tuple(found.steps),
        world=found.world,
        segments=found.flight,
        before=before,
        after=worst_omnibus(flight_windows(prepared, found.world), scatter) if changed else before,
        agreement=tested.agreement,
        fleeting=tuple(sorted(tested.fleeting & set(found.names))),
        others=tuple(one for one in tested.others if one.effect in found.names),
        left=left,
        common_share=share,
        own_law=own_law,
    )


def _left(prepared: Prepared, world: World, after_flight: World, selected: bool) -> tuple[RepeatedForce | None, float]:
    """Return what repeats beside the selected effects, and the share of all that repeats that these explain."""
    if prepared.flight is None:
        return None, 1.0
    worlds = [world, after_flight] if selected else [world]
    found = [_wrenches(prepared, one) for one in worlds]
    laws = [None if one is None else repeated_force(one) for one in found]
    last = laws[-1]
    if last is None or found[0] is None or found[-1] is None:
        return None, 1.0
    explained = _square(found[0]) - _square(found[-1])
    gain = max(last.gain, 0.0)
    return last, explained / (explained + gain) if explained + gain > 0 and selected else float(gain <= 0)


def _wrenches(prepared: Prepared, world: World) -> ResidualWrenches | None:
    """Return the residual wrenches of short windows of flight; None without any."""
    if prepared.flight is None:
        return None
    items, noise = prepared.flight.items, prepared.noise
    return wrench_windows(world, prepared.observations, items, noise, prepared.noise_model)


def _square(found: ResidualWrenches) -> float:
    """Return chi2 of residual wrenches."""
    return float(np.einsum("ni,nij,nj->", found.wrench, found.information, found.wrench))
