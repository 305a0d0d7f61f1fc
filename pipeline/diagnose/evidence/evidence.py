"""Evidence for a missing effect: what any test, in flight or in contact, found out about one candidate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ...physics.effects.effect import Effect, EffectParameter
from ...segments.candidates import Candidate
from ...segments.segment_fit import Refit
from ..thresholds import THRESHOLDS
from .falsification import Repetition
from .score_test import ScoreTest

NEARLY = 0.999
"""Share of the limit of a parameter from which it counts as at its limit."""


def implausible(effect: Effect, values: Mapping[str, float]) -> list[EffectParameter]:
    """Return the parameters whose values are larger than instruments or nature usually have them."""
    return [p for p in effect.parameters if abs(values.get(p.name, 0.0)) > p.plausible]


def prior_odds(effect: Effect, values: Mapping[str, float]) -> float:
    """Return what chi2 has to fall by for an effect of such values, in addition to that of a plausible one.

    A size that no mistake has, such as a lift by a third of the weight, counts twice.
    """
    impossible = [p for p in effect.parameters if abs(values.get(p.name, 0.0)) > p.possible]
    return THRESHOLDS.flight.implausible * (len(implausible(effect, values)) + len(impossible))


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Evidence for one candidate in one kind of segments, in addition to a model."""

    candidate: Candidate
    """The candidate."""
    constants: dict[str, float]
    """Its constants with the best test."""
    test: ScoreTest
    """Score test at these constants."""
    p_value: float
    """P-value of the test, corrected for the number of constants that were tried."""
    gains: tuple[float, ...] = ()
    """Gain of chi2 in each held-out episode; empty where it was not computed."""
    refitted: Refit | None = None
    """Refit with the effect; None where it was not refitted."""
    delta_bic: float | None = None
    """Change of BIC against the model without the effect; None where it was not refitted."""
    repetition: Repetition | None = None
    """Whether it repeats beside the scatter between episodes; None where it was not refitted."""
    numbers: dict[str, tuple[float, float]] | None = None
    """Estimate and standard error by parameter; None where only the score test was made."""
    first_score: float = math.inf
    """Score in contact segments that were linearised without it, where it was judged at its fit."""
    beside_errors: bool = False
    """Whether it was judged beside errors of the impulses of impacts."""
    score: float = -math.inf
    """Fall of the loss of a contact test less the penalty of BIC; minus infinity in flight."""
    share: float = 0.0
    """Share of what the model leaves unexplained in a contact test that the candidate explains."""
    spread: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation between episodes, by parameter, of an effect with a value for each."""
    without_best: float = math.inf
    """Fall of chi2 without the episode in which it falls most; infinite where it was not computed."""
    pyramid_share: float = 0.0
    """Share of its fall of chi2 that a friction pyramid in its place reaches; 0 where it was not compared with one."""
    line_share: float = 0.0
    """The same for a friction that changes at a line across the ground."""
    way_share: float | None = None
    """How far it moves a body that fixed surfaces carry, as a share of its way; None where it was not computed."""
    contact: Mapping[str, float] = field(default_factory=dict)
    """Contact parameters fitted jointly, by their name in the contact law, that a world with the effect takes over."""

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.candidate.effect.name

    @property
    def estimates(self) -> dict[str, tuple[float, float]]:
        """Estimate and standard error by parameter; empty where only the score test was made."""
        return self.numbers or {}

    @property
    def odds(self) -> float:
        """What its estimates are worth before the data, in chi2: 0, or more where they are implausibly large."""
        return prior_odds(self.candidate.effect, {name: value for name, (value, _) in self.estimates.items()})

    @property
    def size(self) -> float:
        """Size of the largest parameter, in usual sizes; 0 where only the score test was made."""
        scale = {p.name: p.scale for p in self.candidate.effect.parameters}
        return max((abs(value) / scale[name] for name, (value, _) in self.estimates.items()), default=0.0)

    @property
    def falls_at_rest(self) -> bool:
        """Whether it is a friction at rest below that of sliding, which dry friction does not have."""
        return self.name in THRESHOLDS.sliding.higher_at_rest and bool((self.test.estimate < 0).any())

    @property
    def is_pyramid(self) -> bool:
        """Whether slides are explained as well by a friction pyramid, which has no number of its own."""
        return self.pyramid_share > THRESHOLDS.sliding.pyramid_share

    @property
    def is_line(self) -> bool:
        """Whether slides are explained as well by a friction that changes at a line across the ground."""
        return self.line_share > THRESHOLDS.sliding.pyramid_share

    @property
    def is_number(self) -> bool:
        """Whether its estimates say how large it is: not all are within their errors of zero, none is at its limit."""
        numbers = self.estimates
        within = THRESHOLDS.verdict.zero_errors
        zero = bool(numbers) and all(abs(value) <= within * error for value, error in numbers.values())
        pinned = any(abs(numbers[p.name][0]) >= NEARLY * p.limit for p in self.candidate.effect.parameters if numbers)
        return not (zero or pinned)

    @property
    def gain(self) -> float:
        """Gain of all held-out episodes together; 0 where it was not computed."""
        return float(np.sum(self.gains))

    @property
    def gain_t(self) -> float:
        """Mean gain of the held-out episodes in its standard errors; 0 for fewer than two episodes."""
        if len(self.gains) < 2:
            return 0.0
        error = float(np.std(self.gains, ddof=1)) / math.sqrt(len(self.gains))
        return float(np.mean(self.gains)) / error if error > 0 else 0.0
