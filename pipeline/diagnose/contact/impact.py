"""Impact test: is a contact effect missing where a ball meets the ground and leaves it again?

Every candidate is fitted to the same impacts, together with one restitution and one friction for all of them
(`impact_law.py`). The velocities before and after an impact are those of the flights (`segments/impacts`), so no
contact law enters. Only impacts whose contact point slides show the friction; one that sticks ends the same whatever
the friction is. Effects that no impact shows are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from ...optimization.tails import f_tail
from ...physics.contact_law import ContactLaw
from ...segments.candidates import Candidate, Variant
from ...segments.impacts.fit import BASE, ImpactBase, ImpactFit, fit_impacts
from ...segments.impacts.velocities import Impacts, measured_impacts
from ...segments.thresholds import SEGMENT_THRESHOLDS
from ..evidence.evidence import Evidence
from ..thresholds import THRESHOLDS, ImpactThresholds
from .contact_test import Bar, ContactData, ContactTest, Lead, fitted_evidence, ranked, tries_of, variant_of
from .rebound_by_slip import gains_beside_slip

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImpactTest(ContactTest):
    """Comparison of candidates by their residuals in the impacts of a ball."""

    name: ClassVar[str] = "impact"
    lists_all: ClassVar[bool] = True

    limits: ImpactThresholds = THRESHOLDS.impact
    """What decides."""

    def evidence(self, data: ContactData, candidates: Sequence[Candidate]) -> list[Evidence]:
        """Return the evidence of the candidates that impacts show, the best first; empty without enough impacts.

        Gains in held-out episodes are computed for the best candidate alone, and only where it passes the other
        thresholds, because they take most of the time.

        Args:
            data: Motions and model.
            candidates: Candidates that the world admits.
        """
        if not isinstance(data.world.contact, ContactLaw):
            return []
        impacts = self.impacts(data)
        if impacts is None or len(impacts) < SEGMENT_THRESHOLDS.impact_data.least:
            return []
        base = ImpactBase.of(data.world, impacts)
        found, variants = [], data.variants(candidates)
        for variant, change in zip(variants, _changes(base, variants), strict=True):
            if change > self.limits.shown:
                problem, start = base.beside(variant)
                found.append((variant, fit_impacts(problem, start, centre=base.centre_of(start))))
        if not found:
            return []
        fits = _Fits.of(base, found, candidates)
        order = ranked(fits.evidence())
        if not order[0].test.admissible or not self._without_gains.passed(order[0]):
            return order
        return [fits.with_gains(order[0]), *order[1:]]

    def impacts(self, data: ContactData) -> Impacts | None:
        """Return the impacts that the test judges; None without any."""
        return measured_impacts(data.prepared, data.world)

    @property
    def _without_gains(self) -> Bar:
        """All thresholds but that of held-out episodes."""
        return Bar(score=self.limits.score, share=self.limits.explained, size=self.limits.size)

    def leads(self, best: Evidence) -> tuple[Lead, ...]:
        """Return the lead in score over effects of a size that matters."""
        return (
            Lead(
                score=self.limits.lead,
                share=self.limits.lead_share,
                rival=Bar(score=0.0, size=self.limits.size),
            ),
        )

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> tuple[Bar, ...]:
        """Return the bar, held-out episodes included, of which several must carry an effect of several parameters."""
        slides = THRESHOLDS.sliding
        flexible = len(equals[0].candidate.effect.parameters) > slides.few_parameters
        carriers = slides.carriers if flexible else 0
        return (replace(self._without_gains, gain_t=self.limits.gain_t, carriers=carriers, carries=slides.carries),)


def _changes(base: ImpactBase, variants: Sequence[Variant]) -> list[float]:
    """Return the change of the impacts [chi2] by each effect of the usual size, of either sign where both may be."""
    if not variants:
        return []
    problem, together, start = base.beside_each(variants)
    first, starts = len(base.parameters), start.repeat(len(variants), 1)
    together.set_constants(starts, first)
    moves, owner = [], []
    for k, columns in enumerate(together.columns):
        for column in columns:
            parameter = together.parameters[column]
            for sign in (1.0,) if parameter.bounds[0] == 0 else (1.0, -1.0):
                moved = starts[k].clone()
                moved[first + column] += sign * parameter.prior[1] / 5
                moves.append(moved)
                owner.append(k)
    rows = problem.rows(torch.cat([starts, torch.stack(moves)]))
    change = (rows[len(variants) :] - rows[owner]).square().sum((1, 2))
    return [float(change[[k == one for one in owner]].max()) for k in range(len(variants))]


@dataclass(frozen=True, kw_only=True)
class _Fits:
    """Fits of all candidates to the same impacts."""

    base: ImpactBase
    """The fit without candidates."""
    found: Sequence[tuple[Variant, ImpactFit]]
    """The variants with their fits."""
    candidates: Sequence[Candidate]
    """The candidates."""
    degrees: Array
    """Degrees of freedom (2,) of the rebounds, and of the rest."""
    spread: Array
    """Factor (2,) by which chi2 is divided: smallest residuals of all fits; more scatter means less weight."""

    @staticmethod
    def of(base: ImpactBase, found: Sequence[tuple[Variant, ImpactFit]], candidates: Sequence[Candidate]) -> _Fits:
        """Return the fits with the scatter that the best of them leave."""
        count = len(base.problem.impacts)
        degrees = np.array([count - 1, 5 * count - 1], dtype=float)
        spread = np.maximum(1.0, np.min([fit.chi2 for _, fit in found], axis=0) / degrees)
        return _Fits(base=base, found=found, candidates=candidates, degrees=degrees, spread=spread)

    def evidence(self) -> Iterator[Evidence]:
        """Yield the evidence of the fits, without gains in held-out episodes."""
        tries, alone = tries_of(variant for variant, _ in self.found), self.base.fit
        place = [p.name for p in BASE].index("damping_ratio")
        for variant, fit in self.found:
            number = len(variant.parameters)
            falls = alone.chi2 - fit.chi2
            fall = max(0.0, float((falls / self.spread).sum()) + alone.prior - fit.prior)
            part = int(np.argmax(falls / self.spread))
            freedom = max(float(self.degrees.sum()) - number, 1.0)
            one = fitted_evidence(
                self.candidates[variant.place],
                variant.constants,
                gain=fall,
                values=fit.values[-number:],
                covariance=np.linalg.inv(fit.information)[-number:, -number:] * self.spread[part],
                penalty=math.log(len(self.base.problem.impacts)),
                tries=tries[variant.place],
                p_value=f_tail(fall / number, number, freedom),
            )
            # the friction is not taken over: impacts seldom show it, and it was fitted to sliding and other contacts
            share = float(falls[part] / max(alone.chi2[part] - self.degrees[part], 1.0))
            yield replace(one, share=share, contact={"damping_ratio": float(np.exp(fit.values[place]))})

    def with_gains(self, one: Evidence) -> Evidence:
        """Return the evidence with its gains in held-out episodes."""
        variant = variant_of(one, (v for v, _ in self.found), self.candidates)
        fit = next(fit for own, fit in self.found if own is variant)
        problem = self.base.beside(variant)[0]
        gains = self.base.gains(problem, fit.values) / float(self.spread.max())
        alone = replace(one, gains=tuple(gains.tolist()))
        if int(np.argmax((self.base.fit.chi2 - fit.chi2) / self.spread)) > 0:
            return alone
        # an effect on the rebound has to predict what slip does not
        beside = gains_beside_slip(self.base, problem, fit, float(self.spread[0]))
        return min(alone, replace(one, gains=tuple(beside.tolist())), key=lambda found: found.gain_t)
