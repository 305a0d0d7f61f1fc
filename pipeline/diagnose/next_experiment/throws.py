"""Optimal experiment design: the throw that separates rival effects best, or advice where no throw can.

Rivals A and B have estimates th. Data with information M show A's effect, in the presence of all that could imitate it
(S: the model's parameters and B), by NC_A|B(M) = th_A' (M_AA - M_AS M_SS^-1 M_SA) th_A, the noncentrality of the test
of A against B: twice the expected log-likelihood ratio if A is true. A throw adds its information and is worth
1/2 [dNC_A|B + dNC_B|A] nats (T-optimality: Atkinson & Fedorov 1975), the sum of its gains if A is true and if B is. One
of the two may be a tenth of the other, so the smaller one is reported as well. The parameters are known within their
standard errors C only, so NC is its mean over them, th' R th + tr(R C) with R the matrix in brackets: estimates near
zero, because these data hardly show the effect, would otherwise give all throws the same value.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ....schemas import NextExperiment
from ...physics.world import World
from ...report.page import listed
from ...segments.candidates import Variant, variants_of, without_effects
from ...segments.prepare import Prepared
from ..evidence.evidence import Evidence
from ..thresholds import THRESHOLDS
from ..verdict import Findings
from .experiments import Experiment, described
from .fisher_information import Layout, experiment_states, information_of_data, information_of_experiments, layout_of

LIMITS = THRESHOLDS.experiment

Array = NDArray[np.float64]
Pairs = list[tuple[str, str]]

OTHERWISE = {
    "gravity_scale": "look gravity up for where you are, or drop another body: it changes all alike",
    "buoyancy": "repeat with a heavier body of the same shape: buoyancy lessens the acceleration of that one less",
    "constant_force": "turn the whole set-up about the vertical, or repeat with a body of another mass",
    "length_scale": "measure a known length of the tracks with a ruler",
    "clock_scale": "compare the times with those of a second clock",
    "gravity_tilt": "put a spirit level on the ground: where that is not level, gravity leans",
    "frame_tilt": "put a spirit level on the ground: if that is level, the measured frame is turned",
    "wind": "keep the air still, or turn the whole set-up: the wind does not turn with it",
    "com_offset": "balance the body on an edge: that shows where its mass is",
    "marker_offset": "measure with a ruler where in the body the tracked point lies",
    "inertia_shape": "hang the body up by two threads and time its swings about different axes",
    "time_offset": "record one sharp event with both clocks",
    "linear_drag": "repeat with a heavier body of the same shape: drag slows it less",
    "quadratic_drag": "repeat with a heavier body of the same shape: drag slows it less",
}
"""Advice for effects that no throw separates, by name; other effects give the motion that reveals them."""


@dataclass(frozen=True)
class Rivals:
    """Effects that explain the data about equally well."""

    evidence: tuple[Evidence, ...]
    """Evidence of the effects, at least two."""
    world: World
    """World without any of them."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects as the user gives them."""
        return tuple(e.candidate.spec for e in self.evidence)


@dataclass(frozen=True)
class RankedExperiment:
    """Experiment with its gain for each pair of rivals."""

    throw: Experiment
    """The experiment."""
    state: dict[str, list[float]]
    """Its initial state as in the report."""
    by_pair: dict[tuple[str, str], float]
    """Gain for each pair [nats], the sum of both directions."""
    least: dict[tuple[str, str], float]
    """Expected log-likelihood ratio [nats] for each pair if the effect that shows less is true."""

    def gain(self, pairs: Sequence[tuple[str, str]]) -> float:
        """Return the gain [nats] for the pair that is separated least."""
        return min((self.by_pair[pair] for pair in pairs), default=0.0)

    def least_gain(self, pairs: Sequence[tuple[str, str]]) -> float:
        """Return the gain [nats] for the pair that is separated least, whichever effect is true."""
        return min((self.least[pair] for pair in pairs), default=0.0)

    def order(self, pairs: Sequence[tuple[str, str]]) -> tuple[float, ...]:
        """Return the sort key: the gain in steps of the factor `nearly`, then the simplicity of the throw."""
        step = round(math.log(max(self.gain(pairs), 1e-9)) / math.log(LIMITS.nearly))
        return -step, self.throw.spin_rad_s, self.throw.speed_m_s, self.throw.height_m


def rivals_of(findings: Findings) -> Rivals | None:
    """Return the effects that a diagnosis could not separate, or only just; None if all were separated."""
    if findings.verdict not in ("missing_effect", "not_separable"):
        return None
    shared = [one for one in findings.chosen if not one.evidence.spread]
    if not shared:
        return None
    for one in shared:
        if len(one.equals) > 1:
            return Rivals(one.equals, without_effects(findings.world, one.evidence.name))
    first = shared[0]
    second = _second_in_contact(findings) if first.where == "contact" else _second_in_flight(findings)
    if second is None:
        return None
    return Rivals((first.evidence, second), without_effects(findings.world, first.evidence.name))


def next_experiment(prepared: Prepared, findings: Findings, throws: Sequence[Experiment]) -> NextExperiment | None:
    """Return the experiment that separates the rivals of a diagnosis best; None without rivals.

    Where no throw separates them, the result has advice in words instead.

    Args:
        prepared: The data so far.
        findings: The findings of the diagnosis.
        throws: Experiments to choose from.
    """
    rivals = rivals_of(findings)
    if rivals is None:
        return None
    ranked = ranked_experiments(prepared, rivals, throws, findings.contact_chi2)
    open_pairs, closed_pairs = _pairs_by_separation(ranked, rivals)
    left = _names_in(closed_pairs, rivals)
    advice = _advice(rivals, left)
    unseparated = f"no throw tells {listed(left)} apart"
    if not open_pairs:
        what = f"{unseparated}; {advice}" if ranked else advice
        return NextExperiment(what=what, initial_state={}, separates=left, expected_gain_nats=0.0, not_separated=left)
    ranked = sorted(ranked, key=lambda r: r.order(open_pairs))
    best = ranked[0]
    return NextExperiment(
        what=f"{best.throw.what}; {unseparated}: {advice}" if left else best.throw.what,
        initial_state=best.state,
        separates=_names_in(open_pairs, rivals),
        expected_gain_nats=float(f"{best.gain(open_pairs):.3g}"),
        least_gain_nats=float(f"{best.least_gain(open_pairs):.3g}"),
        not_separated=left,
        ranked=tuple(_entry(place, one, open_pairs) for place, one in enumerate(ranked)),
    )


def _pairs_by_separation(ranked: Sequence[RankedExperiment], rivals: Rivals) -> tuple[Pairs, Pairs]:
    """Return the pairs of rivals that some throw separates, and the other pairs."""
    pairs = list(itertools.combinations(rivals.names, 2))
    open_pairs = [pair for pair in pairs if max((r.least[pair] for r in ranked), default=0.0) >= LIMITS.enough_nats]
    return open_pairs, [pair for pair in pairs if pair not in open_pairs]


def _names_in(pairs: Pairs, rivals: Rivals) -> tuple[str, ...]:
    """Return the rivals that are in at least one of the pairs, in their order."""
    found = {name for pair in pairs for name in pair}
    return tuple(name for name in rivals.names if name in found)


def _entry(place: int, one: RankedExperiment, pairs: Sequence[tuple[str, str]]) -> dict[str, object]:
    """Return the entry of an experiment in the report; place: counted from 0."""
    return {
        "rank": place + 1,
        "what": one.throw.what,
        "initial_state": one.state,
        "expected_gain_nats": float(f"{one.gain(pairs):.3g}"),
        "least_gain_nats": float(f"{one.least_gain(pairs):.3g}"),
        "order_of_magnitude": magnitude(one.least_gain(pairs)),
    }


def magnitude(gain: float) -> float:
    """Return the power of ten nearest to a gain [nats]; 0 for less than one nat."""
    return 0.0 if gain < 1 else 10.0 ** round(math.log10(gain))


def ranked_experiments(
    prepared: Prepared, rivals: Rivals, throws: Sequence[Experiment], contact_chi2: float | None = None
) -> list[RankedExperiment]:
    """Rank experiments by their gain for the pair of rivals that is hardest to separate, the best first.

    Args:
        prepared: The data so far.
        rivals: The rivals.
        throws: Experiments to compare; those on the ground are left out if the world has none.
        contact_chi2: Misfit of the contact law, mean chi2 per degree of freedom, by which the information of contact
            is divided.

    Returns:
        The experiments; empty if the world has kinematic bodies or several free ones, which cannot be thrown alone.
    """
    world = rivals.world
    chosen = [t for t in throws if not t.on_ground or world.ground_normal is not None]
    if len(world.free) != 1 or any(body.motion == "driven" for body in world.bodies) or not chosen:
        return []
    variants = _variants(rivals, world)
    sizes = layout_of(world, variants)
    discount = max(1.0, contact_chi2 or 1.0)
    known = information_of_data(prepared, world, variants, sizes, discount)
    state = experiment_states(prepared, world, chosen)
    added = information_of_experiments(prepared, world, variants, sizes, chosen, state, discount)
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
        found.append(RankedExperiment(throw, described(state, item, world.free[0]), gains, least))
    return sorted(found, key=lambda r: r.order(list(r.by_pair)))


def _noncentralities(
    information: Array, layout: Layout, rivals: Rivals, variants: Sequence[Variant], pair: tuple[int, int]
) -> Array:
    """Return NC_A|B and NC_B|A, with priors on S so that unmeasured parameters cannot imitate every effect."""
    found = []
    for a, b in (pair, pair[::-1]):
        own = [layout.names.index(name) for name in variants[a].parameters]
        nuisance = [*range(layout.base), *(layout.names.index(name) for name in variants[b].parameters)]
        inner = information[np.ix_(nuisance, nuisance)] + np.diag(layout.prior[nuisance])
        mixed = information[np.ix_(nuisance, own)]
        reduced = information[np.ix_(own, own)] - mixed.T @ np.linalg.solve(inner, mixed)
        value, std_error = _estimate(rivals.evidence[a])
        found.append(float(value @ reduced @ value + std_error**2 @ np.diag(reduced)))
    return np.array(found)


def _estimate(evidence: Evidence) -> tuple[Array, Array]:
    """Return the parameters of an effect and their standard errors, which are limited to the usual sizes.

    Where each episode has its own parameters, those of a new episode have the usual sizes.
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
    """Return the variant of each rival with its best constants."""
    chosen = [e.candidate for e in rivals.evidence]
    everything = variants_of(chosen, world.gravity[0, :1])
    return [
        next(v for v in everything if chosen[v.place] is e.candidate and v.constants == e.constants)
        for e in rivals.evidence
    ]


def _second_in_flight(findings: Findings) -> Evidence | None:
    """Return the second best effect in flight by BIC; None where the best one is clearly better."""
    first = findings.chosen[0].evidence
    others = [e for e in findings.ranking if e.delta_bic is not None and e.name != first.name]
    others = [e for e in others if e.name not in {one.evidence.name for one in findings.chosen}]
    second = min(others, key=lambda e: (e.delta_bic, e.name), default=None)
    if second is None or second.delta_bic is None or first.delta_bic is None:
        return None
    return second if second.delta_bic - first.delta_bic < LIMITS.near_bic else None


def _second_in_contact(findings: Findings) -> Evidence | None:
    """Return the second best effect in contact by score; None where the best one is clearly better."""
    first = findings.chosen[0].evidence
    score = next((one.score for one in findings.contact if one.name == first.name), None)
    others = [one for one in findings.contact if one.name != first.name and one.test.admissible]
    second = max(others, key=lambda one: one.score, default=None)
    if second is None or score is None:
        return None
    return second if score - second.score < LIMITS.near_bic else None


def _advice(rivals: Rivals, left: Sequence[str]) -> str:
    """Return the advice for rivals that no throw separates."""
    words = []
    for evidence in rivals.evidence:
        effect, spec = evidence.candidate.effect, evidence.candidate.spec
        if spec in left:
            words.append(f"{spec}: {OTHERWISE.get(effect.name, effect.reveals)}")
    return "; ".join(words)
