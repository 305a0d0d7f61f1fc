"""Search for a missing effect in contact, and separation of flight equals by the contact data.

The tests run in the order of what they assume: sliding segments, where the contact law hardly matters; impacts of a
ball, or of a body that falls flat on a face, which need no contact law; and last the contact segments under the model's
contact law, which confirm what slides show. The first that selects an effect ends the search.

The friction of slides is not compared with that of impacts, although a ground that attracts the body makes the former
larger: laws of contact differ as much. Where friction acts on the whole impulse it takes mu (1 + e) v off a sliding
contact, where restitution is applied after friction mu v alone (Rapier 0.36.1, measured with e of 0, 0.5 and 0.8: 1.00,
0.66 and 0.55 of the friction).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from ...physics.world import World
from ...segments.candidates import Candidate, admissible
from ...segments.prepare import Prepared
from ...segments.segments import Segments
from ...segments.sliding.fit import StartedSliding
from ..evidence.effect_selection import SelectionStep
from ..evidence.evidence import Evidence
from ..thresholds import THRESHOLDS
from .contact_test import ContactData, ContactTest, selected
from .detection_limits import DetectionLimit, detection_limits
from .flat_impact import FlatImpactTest
from .flight_equals import resolved_flight
from .impact import ImpactTest
from .segments import SegmentsTest
from .sliding import SlidingTest

TESTS: tuple[ContactTest, ...] = (SlidingTest(), ImpactTest(), FlatImpactTest(), SegmentsTest())
"""The contact tests in the order in which they run."""


@dataclass(frozen=True)
class Chosen:
    """Selected effect and its equals."""

    evidence: Evidence
    """Evidence of the selected effect."""
    equals: tuple[Evidence, ...]
    """Effects that explain the data equally well, the selected one first."""
    where: Literal["flight", "contact"]
    """Motion that the evidence comes from."""


@dataclass(frozen=True, kw_only=True)
class ContactFindings:
    """Result of the searches in flight and contact together."""

    chosen: list[Chosen]
    """Selected effects, those of flight first."""
    evidence: list[Evidence]
    """Evidence of the candidates in contact."""
    world: World
    """World with the selected effects."""
    chi2: float | None = None
    """Chi2 per degree of freedom of the contact segments; None without contact."""
    segments: Segments | None = None
    """Contact segments with fitted states; None without contact."""
    limits: tuple[DetectionLimit, ...] = ()
    """Detection limits of the contact effects, where contact selected none."""
    sliding: StartedSliding | None = None
    """The sliding segments and their fit without effects of contact; None without any."""
    as_pyramid: tuple[str, ...] = ()
    """Effects that slides show no better than a friction pyramid does, so that none is selected."""
    as_line: tuple[str, ...] = ()
    """The same for a friction that changes at a line across the ground."""


def with_contact(
    prepared: Prepared,
    world: World,
    after_flight: World,
    steps: Sequence[SelectionStep],
    candidates: Sequence[Candidate],
    flight: Segments | None,
    explained: bool,
    tests: Sequence[ContactTest] = TESTS,
) -> ContactFindings:
    """Resolve the flight equals with the contact data, then return the first contact effect that a test selects.

    Args:
        prepared: The episodes.
        world: The model's world.
        after_flight: The world with the effects selected in flight.
        steps: Selection steps of the flight search.
        candidates: All candidates.
        flight: Flight segments with fitted states; None without flight.
        explained: Whether the flight segments are explained down to the noise.
        tests: The contact tests, in the order in which they run.
    """
    resolved = resolved_flight(prepared, after_flight, steps)
    chosen = [Chosen(equals[0], equals, "flight") for equals in resolved.chosen]
    if resolved.segments is None:
        return ContactFindings(chosen=chosen, evidence=[], world=after_flight)
    data = ContactData(
        prepared=prepared,
        world=resolved.world,
        segments=resolved.segments,
        sliding=StartedSliding.of(prepared, resolved.world, flight),
        flown=bool(chosen),
        explained=explained,
    )
    kept, _ = admissible(data.world, candidates, prepared.has_orientation)
    common = ContactFindings(
        chosen=chosen,
        evidence=[],
        world=resolved.world,
        chi2=resolved.chi2,
        segments=resolved.segments,
        sliding=data.sliding,
    )
    shaped: set[str] = set()
    lined: set[str] = set()
    for test in tests:
        evidence = test.evidence(data, kept)
        equals = [] if (shaped | lined) & {one.name for one in evidence[:1]} else selected(test, evidence, data)
        added = test.added(data, equals[0]) if equals else None
        if added is not None:
            final, best = added
            every = (best, *equals[1:])
            listed = evidence if test.lists_all else list(every)
            contact = Chosen(best, every, "contact")
            return replace(common, chosen=[*chosen, contact], evidence=listed, world=final)
        shaped |= {one.name for one in evidence if one.is_pyramid}
        lined |= {one.name for one in evidence if one.is_line}
        data = replace(data, earlier={**data.earlier, test.name: evidence})
    return replace(
        common,
        evidence=list(data.earlier[tests[-1].name]),
        world=replace(resolved.after_flight, contact=data.world.contact),
        limits=tuple(_limits(data, candidates)),
        as_pyramid=tuple(sorted(shaped)),
        as_line=tuple(sorted(lined)),
    )


def _limits(data: ContactData, candidates: Sequence[Candidate]) -> list[DetectionLimit]:
    """Return the detection limits in sliding segments; effects that only measured impacts show are left out."""
    limits = THRESHOLDS.sliding
    unseen, scores = limits.in_impacts_alone, (limits.score, limits.score_flexible)
    judged = data.earlier.get("impact") or data.earlier.get("flat impact")
    asked = [c for c in candidates if not judged or c.effect.name not in unseen]
    return detection_limits(data.sliding, data.world, asked, scores, data.prepared.has_orientation, unseen)
