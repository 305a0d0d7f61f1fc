"""What `cgwm diagnose` reports."""

from __future__ import annotations

from typing import Any, Literal

from .base import FileModel

Verdict = Literal["missing_effect", "none_missing", "not_separable", "unexplained"]


class EffectEstimate(FileModel):
    """A number of an effect as these data show it, beside the model and the other selected effects."""

    name: str
    unit: str
    estimate: float
    std_error: float


class RankedEffect(FileModel):
    """A candidate and what the data say of it."""

    effect: str
    """What to pass to `fit --effects`."""
    acts_in: tuple[Literal["flight", "contact", "measurement"], ...]
    judged_in: Literal["flight", "contact"]
    """Where the evidence is from."""
    score_p: float
    """p-value of the score test, corrected for the grid of the effect's constants, not for the number of candidates.
    In flight it assumes normal noise, independent from frame to frame, and nothing else; in contact variances are
    scaled by the misfit of the contact law, and the verdict does not rest on it."""
    delta_bic: float | None = None
    """BIC of the refit less that of the model without it, on the episodes that it was fitted to; negative is better."""
    cv_error_before_m: float | None = None
    cv_error_after_m: float | None = None
    """Error of predictions in episodes that the effect's numbers were not fitted to, without it and with it [m]."""
    parameters: tuple[EffectEstimate, ...] = ()
    constants: dict[str, float] = {}


class NextExperiment(FileModel):
    """The motion that tells rivals apart best."""

    what: str
    initial_state: dict[str, Any]
    separates: tuple[str, ...]
    expected_gain_nats: float
    ranked: tuple[dict[str, Any], ...] = ()


class LawTerm(FileModel):
    """A term of a law found by regression."""

    term: str
    coefficient: float
    std_error: float
    unit: str


class ResidualLaw(FileModel):
    """The law that the residual wrench follows, where none of the candidates explains it."""

    terms: tuple[LawTerm, ...]
    exponent: dict[str, tuple[float, float, float]] = {}
    """By term: the best exponent of the speed, and its interval of 95 %."""
    left_chi2: float
    """Mean chi2 of what is left of the residual wrench; 1 if nothing."""
    where: str
    """The coordinate that organises it."""


class FlightTest(FileModel):
    """Whether a constant wrench in short pieces of flight improves the model: mean chi2 per number, 1 if not."""

    statistic: float
    degrees_of_freedom: float
    p_value: float


class DiagnoseResult(FileModel):
    """`cgwm diagnose --json`."""

    verdict: Verdict
    sentence: str
    """The verdict in words."""
    selected: tuple[str, ...] = ()
    """What to pass to `fit --effects`; one name of a group that cannot be told apart."""
    remaining_unexplained: bool = False
    ranking: tuple[RankedEffect, ...] = ()
    aliases: tuple[tuple[str, ...], ...] = ()
    """Groups of effects that these data cannot tell apart, a selected one the first of each."""
    next_experiment: NextExperiment | None = None
    residual_law: ResidualLaw | None = None
    episodes: int
    phases: dict[str, int] = {}
    """Number of frames in flight and in contact."""
    noise: dict[str, float] = {}
    """position_m and rotation_rad, as used."""
    flight_before: FlightTest | None = None
    flight_after: FlightTest | None = None
    contact_chi2: float | None = None
    """Mean chi2 of short contact segments: what the contact law cannot do counts in it."""
    not_tested: dict[str, str] = {}
    """Candidates that these data cannot judge, and why."""
    warnings: tuple[str, ...] = ()
