"""What `cgwm diagnose` reports."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from .base import FileModel
from .compare import Phase
from .described import NotDescribed

Verdict = Literal["missing_effect", "none_missing", "not_separable", "unexplained", "law_inexact", "not_described"]


class EffectParameterEstimate(FileModel):
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
    contact_score: float | None = None
    """What the verdict in contact rests on: the fall of the robust loss less the penalty of BIC."""
    delta_bic: float | None = None
    """BIC of the refit less that of the model without it, on the episodes that it was fitted to; negative is better."""
    cv_error_before_m: float | None = None
    cv_error_after_m: float | None = None
    """Error of predictions in episodes that the effect's numbers were not fitted to, without it and with it [m]."""
    parameters: tuple[EffectParameterEstimate, ...] = ()
    constants: dict[str, float] = {}
    held_out_nats: float | None = None
    """Gain of the log-likelihood of held-out episodes by the effect, linearised and summed over episodes; in flight."""
    held_out_nats_95: tuple[float, float] | None = None
    """Interval of 95 % of that sum, from its scatter between episodes (Student)."""
    spread: dict[str, float] = {}
    """Standard deviation between episodes, by parameter, of an effect with a value for each."""
    told_apart_by: str | None = None
    """What rules out the effects that flight does not tell from a selected one; None where nothing does."""


class Remaining(FileModel):
    """What is left in flight beside the selected effects."""

    phase: Literal["flight"] = "flight"
    position_rms_m: float
    """Mean distance of measurement and model, with the start of each whole flight fitted [m, root mean square]."""
    rotation_rms_rad: float | None = None
    slow_position_std_m: float = 0.0
    """Standard deviation of errors that change slowly and differ from episode to episode [m]; 0 where none show."""
    slow_time_s: float | None = None
    """Time in which they change [s]; a second or more: a curve in each flight."""
    own_acceleration_std_m_s2: float = 0.0
    """Standard deviation of accelerations across gravity that each flight has of its own [m/s2]."""
    repeats: bool
    """Whether a part of what is left is common to all episodes: a law of any form predicts held-out ones."""
    coordinate: str | None = None
    """Coordinate of the law that predicts held-out episodes best; "constant" for one wrench everywhere."""
    p_value: float | None = None
    """Probability of that prediction by chance."""
    share_explained: float
    """Share of what repeats from episode to episode that the selected effects explain."""


class ContactLimit(FileModel):
    """From which size on an effect of contact would have been named, had it been there; about, and on the safe side."""

    effect: str
    sizes: dict[str, float] = {}
    """By the names of its numbers, in their units; empty where no size would have shown."""
    units: dict[str, str] = {}
    constants: dict[str, float] = {}


class NextExperiment(FileModel):
    """The motion that tells rivals apart best."""

    what: str
    """In words: a throw, or what to do where no throw tells them apart."""
    initial_state: dict[str, Any]
    """position_m, quat_wxyz, velocity_m_s, omega_body_rad_s; empty where no throw tells the rivals apart."""
    separates: tuple[str, ...]
    expected_gain_nats: float
    """Worth of the throw for the pair of rivals that it separates least, of those that a throw can separate: the
    expected rises of the log-likelihood ratio if one is true and if the other is, added. Linearised, and from rough
    estimates: good for ranks."""
    least_gain_nats: float = 0.0
    """The smaller of the two."""
    not_separated: tuple[str, ...] = ()
    """Rivals that none of the throws tells apart."""
    ranked: tuple[dict[str, Any], ...] = ()
    """All throws, the best first: rank, what, initial_state, expected_gain_nats, least_gain_nats, and its
    order_of_magnitude (a power of 10; 0 below 1)."""


class ProposedMotion(FileModel):
    """A motion that a hand can make."""

    what: str
    """In words."""
    initial_state: dict[str, Any]
    """position_m, quat_wxyz, velocity_m_s, omega_body_rad_s."""
    duration_s: float
    """Of the recording."""


class RevealedEffect(FileModel):
    """About from which size on an effect of contact would be named, before and after the proposed motions."""

    effect: str
    unit: str
    """Of its first number."""
    seen_from: float | None
    """In the data so far; None where no size would show."""
    then_from: float
    """With the motions."""


class NextMotions(FileModel):
    """The motions to record next for contact, and what they show."""

    motions: tuple[ProposedMotion, ...]
    """Up to three; equal ones stand next to each other."""
    reveals: tuple[RevealedEffect, ...] = ()
    """What they show that the data do not, or that they tell apart."""
    separates: tuple[str, ...] = ()
    """Rivals that they tell apart; empty where nothing was found so far."""


Several = Annotated[tuple[Annotated[float, Field(ge=0, le=1e5)], ...], Field(min_length=1, max_length=1000)]
Angles = Annotated[tuple[Annotated[float, Field(ge=-3600, le=3600)], ...], Field(min_length=1, max_length=1000)]


MOST_COMBINATIONS = 100_000
"""Most combinations of values in a file of throws, before equal ones are put together."""


class ThrowGrid(FileModel):
    """`[[throws]]`: all combinations of what is given."""

    on_ground: bool = False
    """The body starts on the ground, and slides or rolls; its height and elevation count for nothing."""
    height_m: Several = (0.4,)
    """Of the body's lowest point over the ground at the start."""
    speed_m_s: Several = (2.0,)
    """0: the body is dropped."""
    elevation_deg: Angles = (0.0,)
    """Of the velocity over the horizontal."""
    heading_deg: Angles = (0.0,)
    """Of the velocity about the vertical, from the world's x towards y."""
    spin_rad_s: Several = (0.0,)
    spin_axis: Annotated[tuple[Literal["up", "along", "across"], ...], Field(min_length=1, max_length=1000)] = (
        "across",
    )
    """Against gravity; along the heading; horizontally across it."""
    duration_s: Annotated[float, Field(ge=1e-6, le=10)] = 0.6


class ThrowsFile(FileModel):
    """The TOML file of `cgwm diagnose --throws`."""

    throws: Annotated[tuple[ThrowGrid, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _countable(self) -> ThrowsFile:
        count = sum(
            math.prod(len(value) for value in vars(grid).values() if isinstance(value, tuple)) for grid in self.throws
        )
        if count > MOST_COMBINATIONS:
            raise ValueError(f"{count} combinations; at most {MOST_COMBINATIONS}, of which equal throws count once")
        return self


class LawTerm(FileModel):
    """A term of a law found by regression."""

    term: str
    coefficient: float
    std_error: float
    unit: str


class PhaseMisfit(FileModel):
    """How the law of contact describes one phase, beside the selected effects: medians over its short segments."""

    phase: Phase
    segments: int
    segment_s: float
    """Length of a segment, whose start is fitted to it [s]."""
    reduced_chi2: float
    """Mean square error in units of the noise: 1 where the law is exact."""
    position_rms_m: float
    rotation_rms_rad: float | None
    then: str
    """What to record and check next where the phase is badly described."""


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
    not_described: NotDescribed | None = None
    """Why the model does not describe the motion at all; None where it does."""
    ranking: tuple[RankedEffect, ...] = ()
    aliases: tuple[tuple[str, ...], ...] = ()
    """Groups of effects that these data cannot tell apart, a selected one the first of each."""
    next_experiment: NextExperiment | None = None
    next_motions: NextMotions | None = None
    """What to record next for contact; None where no effect of contact is left open, or no motion would help."""
    remaining: Remaining | None = None
    """What is left in flight; None without flight."""
    residual_law: ResidualLaw | None = None
    saved_law: str | None = None
    """What to pass to `fit --effects` for the residual law, where it was saved."""
    report: str | None = None
    """The page that was written."""
    episodes: int
    phases: dict[str, int] = {}
    """Number of frames in flight and in contact."""
    noise: dict[str, float] = {}
    """position_m and rotation_rad, as used."""
    flight_before: FlightTest | None = None
    flight_after: FlightTest | None = None
    contact_chi2: float | None = None
    """Mean chi2 of short contact segments: what the contact law cannot do counts in it."""
    contact_misfits: tuple[PhaseMisfit, ...] = ()
    """How the law of contact describes each phase, the worst first; none where an effect of contact is selected."""
    contact_limits: tuple[ContactLimit, ...] = ()
    """What contact could have shown, where it shows nothing: a verdict says nothing about smaller effects."""
    not_tested: dict[str, str] = {}
    """Candidates that these data cannot judge, and why."""
    left_out_s: dict[str, tuple[float, ...]] = {}
    """Times [s] of the frames of flight that were left out as wrong measurements, by episode."""
    warnings: tuple[str, ...] = ()

    def equals_of(self, name: str) -> tuple[str, ...]:
        """Return the effects that these data cannot tell from a selected one, itself among them."""
        return next((group for group in self.aliases if name in group), (name,))
