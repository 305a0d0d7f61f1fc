"""Friction consistency test: does the friction of sliding segments agree with that of impacts?

A ground that attracts the body presses a sliding body harder than its weight, so sliding shows a friction larger by the
factor 1 + F / m g; in an impact the attraction is negligible against the impulse. Every candidate is fitted to the
sliding segments together with a friction. A candidate is selected if it brings this friction to that of the impacts,
within the share by which the two differ where nothing is missing. The test does not apply to a ball: its impacts
usually end sticking and do not show the friction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ...physics.parameters import CONTACT_PARAMETERS, Parameter
from ...physics.world import World
from ...segments.candidates import Candidate, Variant
from ...segments.contact_phases import is_round
from ...segments.segment_fit import refit
from ...segments.sliding_descent import SlidingFit
from ...segments.sliding_fit import StartedSliding, fit_sliding
from ...trajectories.segmentation import Segment
from ..evidence import Evidence
from ..thresholds import THRESHOLDS, FrictionThresholds
from .contact_test import Bar, ContactData, ContactTest, Lead, fitted_evidence, ranked
from .sliding import FIRST_ITERATIONS, batches


@dataclass(frozen=True)
class _ImpactFriction:
    """Friction estimated from impacts."""

    friction: float
    """Friction coefficient [1]."""
    width: float
    """Standard error of its logarithm, including the model error."""
    spread: float
    """Factor by which chi2 of the sliding segments is divided."""

    def joint(self, fit: SlidingFit) -> float:
        """Return chi2 of the sliding segments plus that of the discrepancy between the frictions."""
        return fit.cost / self.spread + self.between(fit)

    def between(self, fit: SlidingFit) -> float:
        """Return chi2 of the discrepancy, with the error of the sliding friction given the fitted effect."""
        variance = float(self.covariance(fit)[0, 0])
        return self.apart(fit.values[0, 0]) ** 2 / (self.width**2 + variance)

    def discrepancy(self, value: Tensor) -> float:
        """Return chi2 of the discrepancy between a friction, given by its logarithm, and that of the impacts."""
        return (self.apart(value) / self.width) ** 2

    def apart(self, value: Tensor) -> float:
        """Return the difference between the logarithm of a friction and that of the impacts."""
        return float(value) - math.log(self.friction)

    def covariance(self, fit: SlidingFit) -> Tensor:
        """Return the covariance (P, P) of the parameters fitted to the sliding segments."""
        return torch.linalg.pinv(fit.information[0], hermitian=True) * self.spread


@dataclass(frozen=True)
class FrictionConsistencyTest(ContactTest):
    """Comparison of candidates by how well they reconcile the frictions of sliding and of impacts."""

    name: ClassVar[str] = "friction_consistency"
    lists_all: ClassVar[bool] = False

    limits: FrictionThresholds = THRESHOLDS.friction
    """What decides."""

    def evidence(self, data: ContactData, candidates: Sequence[Candidate]) -> list[Evidence]:
        """Return the evidence of candidates fitted with both frictions, the best first.

        It is empty without a discrepancy between the frictions, without sliding segments or enough impacts, and for a
        round body.

        Args:
            data: Motions and model.
            candidates: Candidates that the world admits.
        """
        started = data.sliding
        impacts = None if started is None else _discrepancy(data, started, self.limits)
        if started is None or impacts is None:
            return []
        own, known, soft_world = started.friction, started.flight_parameters, started.segments.world
        alone = fit_sliding(soft_world, [], [(started.segments, own[None])], known)[0]
        degrees = float(started.segments.dof.sum())
        impacts = replace(impacts, spread=max(1.0, alone.cost / degrees))
        # chi2 of the sliding segments falls no further below its mean by chance
        surplus = alone.cost - degrees + THRESHOLDS.sliding.surplus_sigmas * math.sqrt(2 * degrees)
        most = impacts.discrepancy(own) + surplus / impacts.spread
        variants = [
            v for v in data.variants(candidates) if len(v.parameters) * math.log(degrees) + self.limits.score < most
        ]
        found = _fits(soft_world, variants, alone, impacts, known)
        if not found:
            return []
        # the friction alone, fitted again from the states of the best candidate: what both gain is no sign of an effect
        _, ended = min(found, key=lambda one: impacts.joint(one[1]))
        again = fit_sliding(soft_world, [], [(ended.segments, own[None])], known)[0]
        least = min((alone, again), key=impacts.joint)
        return ranked(_judged(variant, fit, candidates, least, degrees, impacts) for variant, fit in found)

    def leads(self, best: Evidence) -> tuple[Lead, ...]:
        """Return the lead in score over effects that reconcile the frictions, too."""
        return (Lead(score=self.limits.lead, rival=Bar(share=self.limits.resolved)),)

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> tuple[Bar, ...]:
        """Return the bar."""
        return (Bar(score=self.limits.score, share=self.limits.resolved),)


def _discrepancy(data: ContactData, started: StartedSliding, thresholds: FrictionThresholds) -> _ImpactFriction | None:
    """Return the friction of the impacts if it contradicts that of sliding; None else, or if impacts do not show it."""
    if data.segments is None or is_round(data.world.bodies[data.world.free[0]]):
        return None
    struck = [k for k, item in enumerate(data.segments.items) if not _within(item, started.segments.items)]
    if len(struck) < thresholds.fewest:
        return None
    friction, error = refit([data.segments.select(struck)], data.world, CONTACT_PARAMETERS).number("friction")
    impacts = _ImpactFriction(friction, math.hypot(thresholds.spread, error / friction), 1.0)
    return None if impacts.discrepancy(started.friction) < thresholds.score else impacts


def _fits(
    soft_world: World,
    variants: Sequence[Variant],
    alone: SlidingFit,
    impacts: _ImpactFriction,
    known: Sequence[Parameter],
) -> list[tuple[Variant, SlidingFit]]:
    """Fit the variants; those that are far behind after the first iterations are not continued."""
    own = alone.values[0]
    pulls = [v for v in variants if len(v.parameters) == 1 and v.active.effect.has("wrench")]
    found: list[tuple[Variant, SlidingFit]] = []
    for part in batches([v for v in variants if v not in pulls]):
        tried = fit_sliding(soft_world, part, [(alone.segments, own)] * len(part), known, FIRST_ITERATIONS)
        costs = [impacts.joint(fit) for fit in tried]
        for variant, fit, cost in zip(part, tried, costs, strict=True):
            close = cost == min(costs)
            again = fit_sliding(soft_world, [variant], [(fit.segments, fit.values[0])], known)[0] if close else fit
            found.append((variant, again))
    # an attracting ground acts on sliding as more friction does: start at the force that explains the discrepancy
    body = soft_world.bodies[soft_world.free[0]]
    press = float(body.mass[0] * soft_world.gravity[0].norm()) * math.expm1(impacts.apart(own[0]))
    for variant in pulls if press > 0 else []:
        start = torch.cat([own, torch.tensor([press]).to(own)])
        start[0] = math.log(impacts.friction)
        found.append(
            (variant, fit_sliding(soft_world, [variant], [(alone.segments, start)], known, FIRST_ITERATIONS)[0])
        )
    return found


def _judged(
    variant: Variant,
    fit: SlidingFit,
    candidates: Sequence[Candidate],
    alone: SlidingFit,
    degrees: float,
    impacts: _ImpactFriction,
) -> Evidence:
    """Return the evidence of a fit; its share is that of the discrepancy between the frictions."""
    number, spread = len(variant.parameters), impacts.covariance(fit)
    # the residual discrepancy is distributed over all fitted parameters
    share = spread[:, 0] / (impacts.width**2 + spread[0, 0])
    moved = fit.values[0] - share * impacts.apart(fit.values[0, 0])
    spread = spread - share[:, None] * spread[0]
    one = fitted_evidence(
        candidates[variant.place],
        variant,
        gain=max(0.0, impacts.joint(alone) - impacts.joint(fit)),
        values=moved[-number:].numpy().astype(np.float64),
        covariance=spread[-number:, -number:].numpy().astype(np.float64),
        penalty=math.log(degrees),
    )
    resolved = 1 - impacts.between(fit) / impacts.between(alone)
    return replace(one, share=resolved, contact={"friction": float(moved[0].exp())})


def _within(item: Segment, sliding: Sequence[Segment]) -> bool:
    """Return whether a contact segment lies within a sliding segment, up to one frame."""
    return any(item.episode == g.episode and item.first >= g.first - 1 and item.last <= g.last + 1 for g in sliding)
