"""Which motions to record next for contact: those that show best what the data could not, or tell rivals apart.

An effect counts as seen if one of its usual size, times `experiment.seen_sizes`, would reach the score of its test
with the margin of a detection limit, and as told apart if every other effect of contact, fitted in its stead, would
leave a lead that suffices. Both follow from noncentralities (`contact_information`), which grow with the square of the
size. How large an effect is, is not known: its size is taken as log-uniform from that size to `SIZES` times it. The
worth of motions is the expected number of effects that are seen then, and told apart, each counted half, and the one
that the data suggest more than others; motions are chosen one after the other (greedily).

A friction pyramid has no number, so that it is no effect that is to be told apart. Where slides fit it as well as the
friction by direction that they show, those along its axes and between them are asked for: it brakes all along an axis
alike, and those between more.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ....schemas import NextMotions, ProposedMotion, RevealedEffect
from ...physics.contact_law import ContactLaw
from ...physics.world import World
from ...segments.candidates import Candidate, Variant, admissible, variants_of, without_effects
from ...segments.contact_phases import is_round
from ...segments.prepare import Prepared
from ..thresholds import THRESHOLDS
from ..verdict import Findings
from .contact_information import Channel, Reduced, contact_information
from .experiments import described
from .hand_motions import HandMotion, face_down, hand_motions

Array = NDArray[np.float64]

LIMITS = THRESHOLDS.experiment
SIZES = 10.0
"""Largest size of an effect for which motions are chosen, in smallest ones: where the noise hides small effects of all
kinds, motions that show large ones are asked for."""
WORTH_TELLING = 0.8
"""Share to which the smallest visible size of an effect must fall for the report to name it."""
MOST_MOTIONS = 3
"""Number of motions that are asked for at a time."""


@dataclass(frozen=True, eq=False)
class Question:
    """What the effects of contact need to be seen and told apart, and what data and motions have."""

    variants: tuple[Variant, ...]
    """The effects at each choice of their constants (V)."""
    names: tuple[str, ...]
    """Name of each one's effect (V)."""
    sizes: tuple[Array, ...]
    """Sizes of each one's parameters."""
    channels: tuple[Channel, ...]
    """Information by kind of motion."""
    rivals: frozenset[str] = frozenset()
    """Effects that have to be told apart; empty for all effects of contact."""
    leading: str = ""
    """Effect that the data suggest, without enough evidence to name it; empty for none."""

    def shares(self, chosen: list[int], more: Sequence[int], times: int = 1) -> tuple[Array, Array]:
        """Return shares (V, M) of what each effect needs to be seen, and to be told apart; 1 is enough.

        Args:
            chosen: Motions that count with the data.
            more: Motions (M), each of which is added alone; -1 adds none.
            times: How often each of these is made.
        """
        seen, apart = (np.zeros((len(self.variants), len(more))) for _ in range(2))
        for channel in self.channels:
            information = _each(channel, chosen, more, times)
            every = channel.reduced(information.reshape(-1, *information.shape[2:]))
            first = Reduced(left=every.left[: len(more)], weak=every.weak[: len(more)])
            for place, name in enumerate(self.names):
                if channel.name == "sliding" and name in THRESHOLDS.sliding.as_friction:
                    continue  # slides follow it by friction
                own = channel.noncentrality(every, self.sizes[place], place).reshape(information.shape[:2])
                full, rest = _needed(channel, self.variants[place])
                # the others have to show it, too
                enough = np.minimum(own[0] / full, own[1:].min(0) / rest)
                rivals = [k for k, rival in enumerate(self.names) if rival != name and self._asked(name, rival)]
                left = channel.noncentrality(first, self.sizes[place], place, rivals)
                better = enough > seen[place]
                lead = np.minimum(left / _lead(channel), 1e6)
                seen[place] = np.where(better, enough, seen[place])
                apart[place] = np.where(better, lead, apart[place])
        return seen, apart

    def _asked(self, name: str, rival: str) -> bool:
        return not self.rivals or (name in self.rivals and rival in self.rivals)


def next_motions(prepared: Prepared, findings: Findings, candidates: Sequence[Candidate]) -> NextMotions | None:
    """Return the motions to record next for contact; None where nothing of contact is left open, or none helps.

    Args:
        prepared: The data.
        findings: The findings of the diagnosis.
        candidates: All candidates.
    """
    world = _world_without_contact_effects(findings)
    rivals = _rivals(findings)
    if rivals is None or not _can_be_made(world, prepared):
        return None
    kept, _ = admissible(world, candidates, prepared.has_orientation)
    acting = [c for c in kept if c.effect.phase == "contact"]
    if not acting:
        return None
    motions = hand_motions(is_round(world.bodies[world.free[0]]))
    variants = variants_of(acting, world.gravity[0, :1])
    flat = [k for k, v in enumerate(variants) if acting[v.place].effect.name in THRESHOLDS.flat_impact.told]
    channels, state = contact_information(prepared, world, findings.sliding, variants, motions, flat)
    question = Question(
        variants=tuple(variants),
        names=tuple(acting[v.place].effect.name for v in variants),
        sizes=tuple(
            LIMITS.seen_sizes * np.array([p.scale for p in acting[v.place].effect.parameters]) for v in variants
        ),
        channels=tuple(channels),
        rivals=rivals,
        leading=_leading(findings),
    )
    chosen = of_pyramid(motions) if findings.as_pyramid else best_motions(question, len(motions))
    if not chosen:
        return None
    before, after = (question.shares(some, [-1])[0][:, 0] for some in ([], chosen))
    face = face_down(world, world.free[0])[1]
    counted = {k: chosen.count(k) for k in chosen}
    return NextMotions(
        motions=tuple(
            ProposedMotion(
                what=motions[k].what(face),
                initial_state=described(state, k, world.free[0]),
                duration_s=motions[k].duration_s,
            )
            for k in counted
            for _ in range(counted[k])
        ),
        reveals=tuple(_revealed(acting, question, before, after)),
        separates=tuple(sorted(rivals)),
    )


def best_motions(question: Question, count: int) -> list[int]:
    """Return up to three of `count` motions, the most valuable first; one may come several times.

    A motion is worth what it adds, or half of what it adds when it is made twice, where one alone proves nothing.
    """
    chosen: list[int] = []
    worth = float(_worth(question, *question.shares(chosen, [-1]))[0])
    for _ in range(MOST_MOTIONS):
        once = _worth(question, *question.shares(chosen, range(count)))
        twice = _worth(question, *question.shares(chosen, range(count), times=2))
        gains = np.maximum(once - worth, 0.5 * (twice - worth))
        best = int(gains.argmax())
        if gains[best] < LIMITS.least_worth:
            break
        chosen.append(best)
        worth = float(once[best])
    return chosen


def of_pyramid(motions: Sequence[HandMotion]) -> list[int]:
    """Return the fastest slides along the two axes of a friction pyramid, and between them."""
    slides = [k for k, one in enumerate(motions) if one.manner in ("slide", "push") and not one.aside_m]
    return [
        max((k for k in slides if motions[k].heading_deg == heading), key=lambda k: motions[k].speed_m_s)
        for heading in (0.0, 90.0, 45.0)
    ]


def _worth(question: Question, seen: Array, apart: Array) -> Array:
    """Return the worth (M) of motions: the mean over each effect's constants, summed over the effects."""
    total = np.zeros(seen.shape[1])
    for name in dict.fromkeys(question.names):
        if question.rivals and name not in question.rivals:
            continue
        rows = [k for k, other in enumerate(question.names) if other == name]
        weight = LIMITS.suggested if name == question.leading else 1.0
        total += weight * 0.5 * (_chance(seen[rows]) + _chance(np.minimum(seen[rows], apart[rows]))).mean(0)
    return total


def _chance(share: Array) -> Array:
    """Return the share of sizes, log-uniform, at which an effect has what it needs; share: that of the smallest one."""
    return (1 + 0.5 * np.log(np.maximum(share, 1e-300)) / math.log(SIZES)).clip(0.0, 1.0)


def _each(channel: Channel, chosen: Sequence[int], more: Sequence[int], times: int) -> Array:
    """Return the information (1 + E, M, P, P) of data and motions, first of all, then without each episode (E).

    Arguments are those of `Question.shares`.
    """
    both = channel.data + channel.motions[list(chosen)].sum(0)
    extra = np.stack([channel.motions[k] if k >= 0 else np.zeros_like(both) for k in more])
    information = both + times * extra
    parts = [np.broadcast_to(one, extra.shape) for one in (*channel.episodes, *channel.motions[list(chosen)])]
    return np.stack([information, *(information - part for part in (*parts, extra))])


def _needed(channel: Channel, variant: Variant) -> tuple[float, float]:
    """Return the falls of chi2 from which a test names an effect, of all episodes and without any one of them.

    Both have the margin of a detection limit.
    """
    number, limits = len(variant.parameters), THRESHOLDS.sliding
    if channel.name == "impact":
        scores = (THRESHOLDS.impact.score, THRESHOLDS.impact.score)
    else:
        flexible = number > limits.few_parameters
        scores = (limits.score_flexible if flexible else limits.score, limits.score_sure)
    full, rest = (LIMITS.safe**2 * (one + number * math.log(max(channel.count, 2))) for one in scores)
    return full, rest


def _lead(channel: Channel) -> float:
    """Return the lead in chi2 over a rival that a test asks for, with the margin of a detection limit."""
    return LIMITS.safe**2 * (THRESHOLDS.impact.lead if channel.name == "impact" else THRESHOLDS.sliding.misled)


def _rivals(findings: Findings) -> frozenset[str] | None:
    """Return the effects of contact to tell apart, none for all of them; None where contact leaves nothing open."""
    if findings.verdict == "unexplained":
        return None
    contact = [one for one in findings.chosen if one.where == "contact"]
    if any(len(one.equals) > 1 for one in contact):
        return frozenset(itertools.chain.from_iterable((e.name for e in one.equals) for one in contact))
    return None if contact else frozenset()


def _leading(findings: Findings) -> str:
    """Return the effect that ranks first in contact where its score is positive, but none was selected; or nothing."""
    first = next((one for one in findings.contact if one.test.admissible), None)
    selected = any(one.where == "contact" for one in findings.chosen)
    return first.name if first is not None and first.score > 0 and not selected else ""


def _world_without_contact_effects(findings: Findings) -> World:
    """Return the world with the effects of flight that were selected, and without those of contact."""
    return without_effects(findings.world, *(one.evidence.name for one in findings.chosen if one.where == "contact"))


def _can_be_made(world: World, prepared: Prepared) -> bool:
    """Return whether the model can simulate one free body on a ground, whose orientation was measured."""
    alone = len(world.bodies) == 1 and len(world.free) == 1 and world.ground_normal is not None
    return alone and isinstance(world.contact, ContactLaw) and prepared.has_orientation


def _revealed(acting: Sequence[Candidate], question: Question, before: Array, after: Array) -> list[RevealedEffect]:
    """Return from which size effects are seen now, and with the motions, where these show it: means over constants."""
    found = []
    for candidate in acting:
        name = candidate.effect.name
        if question.rivals and name not in question.rivals:
            continue
        rows = [k for k, other in enumerate(question.names) if other == name]
        first = candidate.effect.parameters[0]
        sizes = []
        for shares in (before, after):
            share = float(np.sqrt(shares[rows]).mean()) ** 2
            size = LIMITS.seen_sizes * first.scale / math.sqrt(share) if share > 0 else math.inf
            sizes.append(float(f"{size:.2g}") if size <= first.limit else None)
        if sizes[1] is not None and (sizes[0] is None or sizes[1] < WORTH_TELLING * sizes[0]):
            found.append(RevealedEffect(effect=candidate.spec, unit=first.unit, seen_from=sizes[0], then_from=sizes[1]))
    return found
