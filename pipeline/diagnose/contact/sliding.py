"""Sliding test: is a contact effect missing while the body slides, rolls or spins on the ground?

Every candidate is refitted to the same sliding segments from the same starts, together with one friction for all of
them, and the candidates are compared by their residuals. The contact law hardly matters during sliding, so data without
an effect leave little more than noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch

from ...segments.candidates import Candidate, Variant, with_added, with_variants
from ...segments.contact_phases import is_round
from ...segments.sliding.descent import SlidingFit, information_by_segment
from ...segments.sliding.fit import StartedSliding, fit_sliding, nuisance_parameters
from ...segments.sliding.support import on_surfaces
from ...segments.sliding.variant_fits import fits_of_variants
from ...segments.thresholds import SEGMENT_THRESHOLDS
from ..evidence.evidence import Evidence
from ..thresholds import THRESHOLDS, SlidingThresholds
from .contact_test import Bar, ContactData, ContactTest, Lead, fitted_evidence, ranked, tries_of
from .friction_pyramid import FrictionPyramid
from .friction_step import lines_across

TURNS = frozenset(("orientation", "spin", "unmeasured_spin"))
"""Needs of effects that show in turns alone."""


@dataclass(frozen=True)
class SlidingTest(ContactTest):
    """Comparison of candidates by their residuals in sliding segments."""

    name: ClassVar[str] = "sliding"
    lists_all: ClassVar[bool] = True

    limits: SlidingThresholds = THRESHOLDS.sliding
    """What decides."""

    def evidence(self, data: ContactData, candidates: Sequence[Candidate]) -> list[Evidence]:
        """Return the evidence of the candidates, the best first; empty where none can reach a score.

        Where the flights are too short to show a force of the size of friction, candidates that act in flight are
        tested, too: along the ground a drag slows a ball much as rolling resistance does.

        Args:
            data: Motions and model.
            candidates: Candidates that the world admits.
        """
        blind = data.prepared.least_force_m_s2 > self.limits.flight_tells_m_s2
        if on_surfaces(data.world) and all(is_round(body) for body in data.world.bodies):
            # turns of a ball do not count there, whose spin is that of its way, measured or not
            candidates = [one for one in candidates if not TURNS.intersection(one.effect.needs)]
        started, variants = data.sliding, data.variants(candidates, ("contact", "flight") if blind else ("contact",))
        if started is None or not variants:
            return []
        base, degrees = started.base, float(started.segments.dof.sum())
        if base.cost - (degrees - self.limits.surplus_sigmas * math.sqrt(2 * degrees)) < self.limits.score_sure:
            return []
        limits = self.limits
        found = fits_of_variants(variants, started, limits.score_sure, limits.close_share, limits.converged)
        # the model alone, fitted again from the states of the best candidate: what both gain is no sign of an effect
        _, best = min(found, key=lambda one: one[1].cost)
        again = (best.segments, best.values[0, : base.values.shape[1]])
        least = min(base.cost, fit_sliding(started.segments.world, [], [again], started.flight_parameters)[0].cost)
        evidence = ranked(_judged(found, candidates, base, least, degrees))
        best = next((one for one in evidence if one.test.admissible), None)
        if best is None or best.score < self.limits.score_sure:
            return evidence
        variant, fit = next(
            one for one in found if candidates[one[0].place] is best.candidate and one[0].constants == best.constants
        )
        told = replace(best, gains=held_out_gains(variant, fit, started))
        if on_surfaces(data.world):
            told = replace(told, way_share=way_share(started, variant, fit))
        if data.world.ground_normal is not None and any(bar.passed(told) for bar in self.bars([told], data)):
            told = replace(told, pyramid_share=pyramid_share(started, variant, fit, least))
        evidence = [told if one is best else one for one in evidence]
        if data.world.ground_normal is None:
            return evidence
        # contact segments may confirm what passes no bar here
        return [self._beside_lines(one, candidates, found, started, least) for one in evidence]

    def _beside_lines(
        self,
        one: Evidence,
        candidates: Sequence[Candidate],
        found: Sequence[tuple[Variant, SlidingFit]],
        started: StartedSliding,
        least: float,
    ) -> Evidence:
        """Return the evidence of an effect with what a friction that changes at a line reaches in its place.

        Args:
            one: The evidence.
            candidates: The candidates.
            found: Variants with their fits.
            started: The sliding segments and their fit without effects.
            least: Smallest chi2 without effects.
        """
        if one.name not in self.limits.by_speed or one.score < self.limits.score_sure:
            return one
        fits = [(v, fit) for v, fit in found if candidates[v.place] is one.candidate and v.constants == one.constants]
        return replace(one, line_share=line_share(started, *fits[0], least)) if fits else one

    def leads(self, best: Evidence) -> tuple[Lead, ...]:
        """Return the leads in score, the second over effects that explain nearly as much.

        A rival is ruled out where it leaves twice what the best effect leaves, since no law is wrong by more than
        itself; or else where it is behind by a share of the score.
        """
        left = best.score * (1 - best.share) / max(best.share, 1e-9)
        share = min(self.limits.lead_share, max(left, 0.0) / max(best.score, 1e-9))
        return (
            Lead(score=self.limits.lead, share=share),
            Lead(score=self.limits.misled, rival=Bar(share=self.limits.rival_share * best.share)),
        )

    def outdone(self, best: Evidence, one: Evidence) -> bool:
        """Return whether an effect that can fit almost anything fits less than the best one, which has few numbers."""
        few, many = (len(e.candidate.effect.parameters) for e in (best, one))
        fits = one.score > best.score - self.limits.misled
        return few <= self.limits.few_parameters and many > self.limits.many_parameters and not fits

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> tuple[Bar, ...]:
        """Return the bars for an effect, and for one that leaves next to nothing unexplained."""
        best = equals[0]
        if best.falls_at_rest or best.is_pyramid or best.is_line:
            return ()
        if data.sliding is not None and not _unexplained(data.sliding, self.limits.surplus_sigmas):
            return ()
        if best.way_share is not None and data.sliding is not None:
            if best.way_share < self.limits.least_way or not _explained(best, data.sliding):
                return ()
        parameters = len(best.candidate.effect.parameters)
        flexible = parameters > self.limits.few_parameters
        mapped = any(len(one.candidate.effect.parameters) > self.limits.many_parameters for one in equals)
        doubted = mapped and best.name in self.limits.braked_otherwise
        usual = Bar(
            score=self.limits.score_flexible if flexible or data.flown or doubted else self.limits.score,
            # what is unexplained in flight also acts during sliding
            share=self.limits.explained if data.explained else self.limits.share_sure,
            size=self.limits.least_size if best.way_share is None else 0.0,
            # each slide tells how it is braked; what has more numbers than slides fits any
            carriers=min(parameters + 1, self.limits.carriers),
            carries=self.limits.carries,
            without_best=self.limits.without_best if data.flown else -math.inf,
            without_share=self.limits.without_share if best.gains else 0.0,
            gain_t=self.limits.gain_t if best.gains else None,
        )
        pressed = best.name in self.limits.as_friction
        if doubted or pressed or parameters > self.limits.many_parameters or (flexible and data.flown):
            return (usual,)
        return usual, replace(usual, score=self.limits.score_sure, share=self.limits.share_sure)


def _unexplained(started: StartedSliding, sigmas: float) -> bool:
    """Return whether the model alone leaves more than noise in sliding segments.

    Where it does not, a fall of chi2 far below its expectation is no effect: errors of smoothed tracks are smaller
    between frames, and slower, than their noise model says.
    """
    degrees = float(started.segments.dof.sum())
    return started.base.cost - degrees > sigmas * math.sqrt(2 * degrees)


def _explained(best: Evidence, started: StartedSliding) -> bool:
    """Return whether an effect leaves little on fixed surfaces: where their shapes are wrong, any force may help."""
    degrees = float(started.segments.dof.sum())
    left = started.base.cost - best.share * (started.base.cost - degrees)
    return left < SEGMENT_THRESHOLDS.sliding_data.well_fitted * degrees


def held_out_gains(variant: Variant, fit: SlidingFit, started: StartedSliding) -> tuple[float, ...]:
    """Return the gain of each episode by an effect that is estimated from the slides of the others.

    The nuisance parameters are estimated from the others, too. Without the effect they are those of all episodes, so
    that the gain is, if anything, too small. It is twice that of the logarithm of a likelihood of Student's t: the fall
    of chi2 where chi2 is near its degrees of freedom; where a model is wrong by many times the noise, by how many is
    no evidence, or one episode would outweigh all others.

    Args:
        variant: The effect at its constants.
        fit: Its fit.
        started: The sliding segments and their fit without effects.
    """
    world, own = with_variants(started.segments.world, [variant], "contact")
    known = nuisance_parameters(started.segments.world, started.flight_parameters)
    segments = fit.segments.in_world(world)
    information, score = information_by_segment(segments, [*known, *own], fit.values[0])
    prior = torch.diag(torch.tensor([1 / p.prior[1] ** 2 for p in (*known, *own)]).to(information))
    episode = torch.tensor([item.episode for item in segments.items])
    degrees, gains = segments.dof, []
    for one in episode.unique():
        mine = episode == one
        step = torch.linalg.solve(information[~mine].sum(0) + prior, score[~mine].sum(0))
        predicted = step @ information[mine].sum(0) @ step - 2 * score[mine].sum(0) @ step
        count, before, after = (float(one[mine].sum()) for one in (degrees, started.base.chi2, fit.chi2))
        gains.append(2 * count * math.log((before + count) / (max(after + float(predicted), 0.0) + count)))
    return tuple(gains)


def way_share(started: StartedSliding, variant: Variant, fit: SlidingFit) -> float:
    """Return how far an effect moves the body in the slides, as a share of their length, in the mean.

    Args:
        started: The sliding segments and their fit without effects.
        variant: The effect.
        fit: Its fit.
    """
    world, own = with_variants(started.segments.world, [variant], "contact")
    known = nuisance_parameters(started.segments.world, started.flight_parameters)
    segments = fit.segments.in_world(world)
    values = fit.values.expand(len(segments.items), -1)
    neutral = torch.cat((values[:, : len(known)], torch.zeros_like(values[:, len(known) :])), 1)
    place = torch.tensor(segments.lengths) - 1
    item = torch.arange(len(place))
    ends = [segments.positions([*known, *own], one)[item, place, 0] for one in (values, neutral)]
    start = segments.observations.state.position_m[:, segments.observations.free[0]]
    moved, way = (ends[0] - ends[1]).norm(dim=-1), (ends[0] - start).norm(dim=-1)
    return float(moved.nan_to_num(nan=0.0).sum() / way.sum().clamp_min(1e-9))


def pyramid_share(started: StartedSliding, variant: Variant, fit: SlidingFit, base: float) -> float:
    """Return the share of an effect's fall of chi2 that a friction pyramid in its place reaches.

    Args:
        started: The sliding segments and their fit without effects.
        variant: The effect.
        fit: Its fit, from whose states the fit of the pyramid starts.
        base: Smallest chi2 without either.
    """
    soft = started.segments.world
    world = with_added(soft, FrictionPyramid())
    own = fit.values[0, : fit.values.shape[1] - len(variant.parameters)]
    found = fit_sliding(world, [], [(fit.segments.in_world(world), own)], started.flight_parameters)[0]
    return (base - found.cost) / max(base - fit.cost, 1e-9)


def line_share(started: StartedSliding, variant: Variant, fit: SlidingFit, base: float) -> float:
    """Return the share of an effect's fall of chi2 that a friction which changes at a line reaches in its place.

    Arguments as of `pyramid_share`.
    """
    own = fit.values[0, : fit.values.shape[1] - len(variant.parameters)]
    lines = [
        fit_sliding(started.segments.world, [one], [(fit.segments, own)], started.flight_parameters)[0].cost
        for one in lines_across(fit.segments)
    ]
    return (base - min(lines, default=base)) / max(base - fit.cost, 1e-9)


def _judged(
    found: Sequence[tuple[Variant, SlidingFit]],
    candidates: Sequence[Candidate],
    alone: SlidingFit,
    base: float,
    degrees: float,
) -> Iterator[Evidence]:
    """Yield the evidence of the fits.

    Args:
        found: Variants with their fits.
        candidates: The candidates.
        alone: Fit without candidates.
        base: Smallest chi2 without candidates.
        degrees: Degrees of freedom of the sliding segments.
    """
    tries = tries_of(variant for variant, _ in found)
    spread = max(1.0, min(fit.cost for _, fit in found) / degrees)
    episode = np.array([item.episode for item in alone.segments.items])
    for variant, fit in found:
        number = len(variant.parameters)
        covariance = torch.linalg.pinv(fit.information[0], hermitian=True)[-number:, -number:].numpy() * spread
        one = fitted_evidence(
            candidates[variant.place],
            variant.constants,
            gain=max(0.0, (base - fit.cost) / spread),
            values=fit.values[0, -number:].numpy().astype(np.float64),
            covariance=covariance,
            penalty=math.log(max(degrees, 2.0)),
            tries=tries[variant.place],
        )
        falls = (alone.chi2 - fit.chi2).numpy()
        by_episode = [float(falls[episode == own].sum()) for own in np.unique(episode)]
        yield replace(
            one,
            share=(base - fit.cost) / max(base - degrees, 1.0),
            without_best=(sum(by_episode) - max(by_episode)) / spread,
            contact={"friction": float(fit.values[0, 0].exp())},
        )
