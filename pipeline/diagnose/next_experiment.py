"""What to measure next: the throw that tells rival effects apart best, and what does where no throw can.

Rivals A and B with estimates th. Data with information M let A's effect be seen beside everything that could stand for
it, S = the model's numbers and B, by NC_A|B(M) = th_A' (M_AA - M_AS M_SS^-1 M_SA) th_A, the noncentrality of the test
of A against B: twice the expected log-likelihood ratio if A is true. A throw adds its information, and is worth
1/2 [dNC_A|B + dNC_B|A] (T-optimality: Atkinson & Fedorov 1975), in nats: the sum of what it gives if A is true and
if B is. One of the two may be a tenth of the other, so the smaller one is said beside it. The numbers are not known
but within their standard errors C, so that NC is its mean over them, th' R th + tr(R C): numbers that came out as
nothing, because these data hardly show them, would make all throws alike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...schemas import NextExperiment
from ..physics.world import World
from .candidates import Variant, variants_of
from .prepared import Prepared
from .slots import Evidence
from .throw_information import Layout, information_of_data, information_of_throws, layout_of, throw_states
from .throws import Throw, described
from .verdict import Findings

Array = NDArray[np.float64]

NEAR_BIC = 2 * math.log(1000)
"""A second effect within these odds of the first is its rival, though it was not called its equal."""
ENOUGH_NATS = 3.0
"""Less than this, odds of 20, whichever of two is true, separates nothing: one that contains the other always gains a
little if it is true, for the noise of its own numbers."""
NEARLY = 1.15
"""Gains within this factor are not told apart: they are estimates."""
OTHERWISE = {
    "gravity_scale": "look gravity up for where you are, or drop another body: it changes all alike",
    "buoyancy": "repeat with a heavier body of the same shape: buoyancy lessens the acceleration of that one less",
    "constant_force": "turn the whole set-up about the vertical, or repeat with a body of another mass",
    "length_scale": "measure a known length of the tracks with a ruler",
    "clock_scale": "compare the times with those of a second clock",
    "gravity_tilt": "put a spirit level on the ground",
    "frame_tilt": "put a spirit level on the ground: if that is level, the measured frame is turned",
    "wind": "turn the table, or keep the air still",
    "com_offset": "balance the body on an edge: that shows where its mass is",
    "marker_offset": "measure with a ruler where in the body the tracked point lies",
    "inertia_shape": "hang the body up by two threads and time its swings about different axes",
    "time_offset": "record one sharp event with both clocks",
    "linear_drag": "repeat with a heavier body of the same shape: drag slows it less",
    "quadratic_drag": "repeat with a heavier body of the same shape: drag slows it less",
}
"""What settles an effect where no throw does; of others, what the effect itself says reveals it."""


@dataclass(frozen=True)
class Rivals:
    """Effects (at least two) that explain the data about equally, and the world without any of them."""

    evidence: tuple[Evidence, ...]
    world: World

    @property
    def names(self) -> tuple[str, ...]:
        """What the user types for them."""
        return tuple(e.candidate.spec for e in self.evidence)


@dataclass(frozen=True)
class RankedThrow:
    """A throw and its gain [nats] for each pair of rivals.

    state: as a report has it; by_pair: both directions added; least: the log-likelihood ratio to expect if that one of
    the two is true that shows less.
    """

    throw: Throw
    state: dict[str, list[float]]
    by_pair: dict[tuple[str, str], float]
    least: dict[tuple[str, str], float]

    def gain(self, pairs: Sequence[tuple[str, str]]) -> float:
        """Return the gain for the pair that is separated least."""
        return min((self.by_pair[pair] for pair in pairs), default=0.0)

    def least_gain(self, pairs: Sequence[tuple[str, str]]) -> float:
        """Return what is gained in any case, for the pair that is separated least."""
        return min((self.least[pair] for pair in pairs), default=0.0)

    def order(self, pairs: Sequence[tuple[str, str]]) -> tuple[float, ...]:
        """Return what throws are sorted by: gains that are nearly equal count as equal, and the simpler throw wins."""
        step = round(math.log(max(self.gain(pairs), 1e-9)) / math.log(NEARLY))
        return -step, self.throw.spin_rad_s, self.throw.speed_m_s, self.throw.height_m


def rivals_of(findings: Findings) -> Rivals | None:
    """Return the effects between which a diagnosis could not decide, or hardly; None where there are none."""
    if findings.verdict not in ("missing_effect", "not_separable"):
        return None
    for one in findings.chosen:
        if len(one.equals) > 1:
            return Rivals(one.equals, _without(findings.world, one.evidence.name))
    first = findings.chosen[0]
    second = _second_in_contact(findings) if first.where == "contact" else _second_in_flight(findings)
    if second is None:
        return None
    return Rivals((first.evidence, second), _without(findings.world, first.evidence.name))


def next_experiment(prepared: Prepared, findings: Findings, throws: Sequence[Throw]) -> NextExperiment | None:
    """Return what to measure next for the rivals of a diagnosis; None where nothing is open or can be thrown."""
    rivals = rivals_of(findings)
    if rivals is None:
        return None
    ranked = ranked_throws(prepared, rivals, throws, findings.contact_chi2)
    pairs = list(itertools.combinations(rivals.names, 2))
    open_pairs = [pair for pair in pairs if max((r.least[pair] for r in ranked), default=0.0) >= ENOUGH_NATS]
    closed = {name for pair in pairs if pair not in open_pairs for name in pair}
    words = [_otherwise(e) for e in rivals.evidence if e.candidate.spec in closed]
    left = tuple(name for name in rivals.names if name in closed)
    if not open_pairs:
        none = f"no throw tells {' and '.join(left)} apart; " if ranked else ""
        what = none + "; ".join(words)
        return NextExperiment(what=what, initial_state={}, separates=left, expected_gain_nats=0.0, not_separated=left)
    ranked = sorted(ranked, key=lambda r: r.order(open_pairs))
    best = ranked[0]
    rest = f"; no throw tells {' and '.join(left)} apart: {'; '.join(words)}" if left else ""
    entries = []
    for place, one in enumerate(ranked):
        entries.append(
            {
                "rank": place + 1,
                "what": one.throw.what,
                "initial_state": one.state,
                "expected_gain_nats": float(f"{one.gain(open_pairs):.3g}"),
                "least_gain_nats": float(f"{one.least_gain(open_pairs):.3g}"),
                "order_of_magnitude": magnitude(one.least_gain(open_pairs)),
            }
        )
    separates = {name for pair in open_pairs for name in pair}
    return NextExperiment(
        what=f"{best.throw.what}{rest}",
        initial_state=best.state,
        separates=tuple(name for name in rivals.names if name in separates),
        expected_gain_nats=float(f"{best.gain(open_pairs):.3g}"),
        least_gain_nats=float(f"{best.least_gain(open_pairs):.3g}"),
        not_separated=left,
        ranked=tuple(entries),
    )


def magnitude(gain: float) -> float:
    """Return the power of ten next to a gain; 0 for less than one nat."""
    return 0.0 if gain < 1 else 10.0 ** round(math.log10(gain))


def ranked_throws(
    prepared: Prepared, rivals: Rivals, throws: Sequence[Throw], contact_chi2: float | None = None
) -> list[RankedThrow]:
    """Return throws with what each adds for every pair of rivals, the best for the hardest pair first.

    Args:
        prepared: The data so far.
        rivals: The rivals.
        throws: To be compared; those on the ground are left out where there is none.
        contact_chi2: Misfit of the contact law, mean chi2 per degree of freedom: contact counts less by it.

    Returns:
        The throws; none where the world has driven or several free bodies, which nobody throws alone.
    """
    world = rivals.world
    chosen = [t for t in throws if not t.on_ground or world.ground_normal is not None]
    if len(world.free) != 1 or any(body.motion == "driven" for body in world.bodies) or not chosen:
        return []
    variants = _variants(rivals, world)
    sizes = layout_of(world, variants)
    discount = max(1.0, contact_chi2 or 1.0)
    known = information_of_data(prepared, world, variants, sizes, discount)
    state = throw_states(prepared, world, chosen)
    added = information_of_throws(prepared, world, variants, sizes, chosen, state, discount)
    found = []
    for item, (throw, more) in enumerate(zip(chosen, added, strict=True)):
        if more is None:
            continue
        gains, least = {}, {}
        for a, b in itertools.combinations(range(len(variants)), 2):
            after, before = (_noncentralities(m, sizes, rivals, variants, (a, b)) for m in (known + more, known))
            both = 0.5 * (after - before).clip(0.0)
            pair = rivals.names[a], rivals.names[b]
            gains[pair], least[pair] = float(both.sum()), float(both.min())
        found.append(RankedThrow(throw, described(state, item, world.free[0]), gains, least))
    return sorted(found, key=lambda r: r.order(list(r.by_pair)))


def _noncentralities(
    information: Array, layout: Layout, rivals: Rivals, variants: Sequence[Variant], pair: tuple[int, int]
) -> Array:
    """Return NC_A|B and NC_B|A. The priors of S keep what was not measured from standing for everything."""
    found = []
    for a, b in (pair, pair[::-1]):
        own = [layout.names.index(name) for name in variants[a].parameters]
        beside = [*range(layout.base), *(layout.names.index(name) for name in variants[b].parameters)]
        inner = information[np.ix_(beside, beside)] + np.diag(layout.prior[beside])
        mixed = information[np.ix_(beside, own)]
        reduced = information[np.ix_(own, own)] - mixed.T @ np.linalg.solve(inner, mixed)
        value, std_error = _estimate(rivals.evidence[a])
        found.append(float(value @ reduced @ value + std_error**2 @ np.diag(reduced)))
    return np.array(found)


def _estimate(evidence: Evidence) -> tuple[Array, Array]:
    """Return an effect's numbers and their standard errors, these at most the size that matters.

    Where each episode has its own numbers, those of a new one are of that size.
    """
    parameters = evidence.candidate.effect.parameters
    scales = np.array([p.scale for p in parameters])
    if evidence.numbers is not None:
        values, errors = np.array([evidence.numbers[p.name] for p in parameters]).T
    elif len(evidence.test.estimate) == len(parameters):
        values, errors = evidence.test.estimate, np.sqrt(np.diag(evidence.test.covariance))
    else:
        return scales, np.zeros_like(scales)
    return values, np.minimum(errors, scales)


def _variants(rivals: Rivals, world: World) -> list[Variant]:
    chosen = [e.candidate for e in rivals.evidence]
    everything = variants_of(chosen, world.gravity[0, :1])
    return [
        next(v for v in everything if chosen[v.place] is e.candidate and v.constants == e.constants)
        for e in rivals.evidence
    ]


def _second_in_flight(findings: Findings) -> Evidence | None:
    first = findings.chosen[0].evidence
    others = [e for e in findings.ranking if e.delta_bic is not None and e.name != first.name]
    others = [e for e in others if e.name not in {one.evidence.name for one in findings.chosen}]
    second = min(others, key=lambda e: (e.delta_bic, e.name), default=None)
    if second is None or second.delta_bic is None or first.delta_bic is None:
        return None
    return second if second.delta_bic - first.delta_bic < NEAR_BIC else None


def _second_in_contact(findings: Findings) -> Evidence | None:
    first = findings.chosen[0].evidence
    score = next((one.score for one in findings.contact if one.evidence.name == first.name), None)
    others = [one for one in findings.contact if one.evidence.name != first.name and one.evidence.test.admissible]
    second = max(others, key=lambda one: one.score, default=None)
    if second is None or score is None:
        return None
    return second.evidence if score - second.score < NEAR_BIC else None


def _otherwise(evidence: Evidence) -> str:
    effect = evidence.candidate.effect
    return f"{evidence.candidate.spec}: {OTHERWISE.get(effect.name, effect.reveals)}"


def _without(world: World, name: str) -> World:
    return replace(world, effects=tuple(a for a in world.effects if a.effect.name != name))
