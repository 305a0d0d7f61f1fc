"""All thresholds that decide a verdict of `cgwm diagnose`, with what they were calibrated on and their error rates.

Those of flight and of what follows stand here, those of the contact tests in `contact_thresholds`.

"Development" and "report N" are sets of seeds of `benchmarks/diagnose.py`, a null is a capture without an effect.
Thresholds were chosen on development seeds; those of a report were unseen until it was run. `docs/thresholds.md` is
written from this table, and `benchmarks/thresholds.py` calibrates it again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..trajectories.thresholds import BY_ARGUMENT, threshold
from .contact_thresholds import FlatImpactThresholds, ImpactThresholds, SegmentsThresholds, SlidingThresholds


@dataclass(frozen=True, kw_only=True)
class FlightThresholds:
    """An effect that acts in flight is named."""

    alpha: float = threshold(
        0.002,
        "probability",
        "level of all score tests of a diagnosis together (Bonferroni over candidates and their grids): no p-value "
        "below it, no effect",
        "by argument: p-values are exact in flight (a prototype had p < 0.05 in 6.0 % of nulls)",
        "1 of 1,000 nulls of reports 4 to 8 (a lift by spin, p = 4e-5). Missed on report8: 2 of 44 silent, noise of "
        "1.4 mm and more",
        (1, 1000),
    )
    repeated_alpha: float = threshold(
        0.005,
        "probability",
        "beside correlated errors, the same beside the scatter between episodes, which few episodes tell",
        "real-like development, first step: the largest of 0.002 to 0.02 at which none of 158 captures without an "
        "effect in flight is significant",
        "the same captures: 88 of 119 effects of flight and measurement are significant, 82 with 0.002, 90 with 0.02 "
        "and two false ones",
    )
    shortlist: int = threshold(5, "effects", "how many of the most significant candidates are refitted")
    shortlist_share: float = threshold(
        0.4, "1", "down to which share of the largest score statistic candidates are refitted"
    )
    unfitted: float = threshold(
        1.5,
        "chi2 / dof",
        "where every refit is above it, other constants (ranges, speeds) of large effects are tried",
        "a large magnet on development seeds (chi2 / dof 72, then 1.3)",
        "of 8 large magnets 6 exact, 1 with a second effect, 1 wrong",
    )
    alias_chi2: float = threshold(
        6.0, "chi2", "another effect that is worse by less is reported as not separable: odds of 20", BY_ARGUMENT
    )
    implausible: float = threshold(
        2 * math.log(100),
        "chi2",
        "an effect is worse by this for each value that is larger than instruments or nature have it (`plausible` of "
        "its parameter), and by as much again where no mistake is that large (`possible`): odds of 100 each",
        "by argument; a clock that runs fast by 7.5 % explained 7 measured drops better than drag by 9 in BIC",
    )
    contained: float = threshold(
        0.995, "correlation", "above it an effect with more parameters counts as able to imitate the best one"
    )
    slight: float = threshold(
        0.15,
        "usual sizes",
        "effects that explain the data equally well, one of which has all parameters below it, need the BIC of the "
        "likeliest of them to fall by more than `slight_bic`",
        "development, reports 4 to 7",
        "takes away 5 names there, all false (sizes 0.03 to 0.11, changes of BIC -15 to 0); the smallest true one was "
        "0.22; on fresh seeds not measured alone",
    )
    slight_bic: float = threshold(
        -20.0,
        "BIC",
        "change of BIC below which a slight effect is named",
        "development, reports 4 to 7",
        "see `slight`",
    )
    most_equals: int = threshold(
        5,
        "effects",
        "an effect in flight, with one value or one in each group, is named where at most so many do the same: to name "
        "everything is to name nothing",
        BY_ARGUMENT,
        "the largest class that flights cannot tell apart has five; one of 149 nulls of real-like development had nine "
        "with a value in each group, and one of 10 seven with one value",
    )
    own_parameters: int = threshold(
        3,
        "parameters",
        "an effect with more has no value in each group: it is a body's, which is the same in all groups",
        BY_ARGUMENT,
    )
    own_shortlist: int = threshold(
        5,
        "effects",
        "how many effects with a value in each group, no two of which do the same, are refitted in each place",
        "by argument: as `shortlist`; a step from neutral ranks them badly",
    )
    most_effects: int = threshold(3, "effects", "how many effects are looked for in flight")
    share: float = threshold(
        0.6,
        "1",
        "share of the remaining excess of chi2 that a second effect must explain, unless it repeats from episode to "
        "episode",
        "development: true ones at least 0.83, false ones at most 0.42",
        "report8: 1 of 44 named with an effect too many; 305 captures of real-like development: of ten seconds that "
        "explain less, six repeat, three hidden ones and three times the scale that sessions carry",
    )
    paired_t: float = threshold(
        3.0,
        "standard errors",
        "beside correlated errors a rival is ruled out where it is worse by this much in the mean over episodes, or by "
        "its square in chi2 beside the scatter between episodes",
        "by argument: with 12 episodes 0.6 % of rivals that are as good lie farther off",
    )
    without_best: float = threshold(
        0.05,
        "probability",
        "beside correlated errors, largest p-value of an effect without the episode that speaks most for it",
        "by argument: one episode shows the smeared edge of a contact or a hand as well; real-like development, "
        "captures 0 to 35 of a row: 16, 18 and 18 of 35 effects of flight and measurement significant with 0.01, 0.02 "
        "and 0.05",
        "captures 36 to 60 of a row, first step: 0 of 65 nulls wrong with each of the three",
        (0, 65),
    )
    beyond_one: float = threshold(
        2 * math.log(100),
        "2 log odds",
        "an effect that one episode shows above all, and that the others rather show than not (`rather`), counts where "
        "it is likelier by more than this than a misfit of one episode, in which all effects may do anything: odds of "
        "100",
        "by argument: as `implausible`",
    )
    rather: float = threshold(0.5, "probability", "see `beyond_one`", BY_ARGUMENT)
    measured: float = threshold(
        0.04,
        "1",
        "a direction of parameter space counts as measured where information times prior variance is above this (five "
        "prior widths)",
    )


@dataclass(frozen=True, kw_only=True)
class VerdictThresholds:
    """The verdict: something is missing that no candidate explains."""

    omnibus_limit: float = threshold(
        1.6,
        "chi2 / dof",
        "flight has an unexplained remainder where the mean chi2 of the residual wrench is above it and the p-value "
        "below `omnibus_p`",
        "study of diagnosis: 1.0 +- 0.2 on data without an effect",
        "0 of 1,000 nulls of reports 4 to 8 were `unexplained`; 15 of 16 with correlated tracking errors were, until "
        "these were modelled (0 of 16 since, the same seeds)",
        (0, 1000),
    )
    omnibus_p: float = threshold(1e-4, "probability", "see `omnibus_limit`", BY_ARGUMENT, "see `omnibus_limit`")
    misfit_chi2: float = threshold(
        9.0,
        "chi2 / dof",
        "a phase of contact is badly described, so that no verdict says that nothing is missing, where half of its "
        "segments are above it",
        "by argument: an error of three standard deviations of the noise is seen by eye in a plot",
    )
    slide_chi2: float = threshold(
        4.0,
        "chi2 / dof",
        "the same of segments of `slide_s` and more: an error that lasts so long is seen at two standard deviations",
        "by argument",
    )
    slide_s: float = threshold(0.2, "s", "length of such segments: those of contact last half as long", BY_ARGUMENT)
    moved_sigmas: float = threshold(
        20.0, "sigma", "way from the first to the last frame of a slide that moves", BY_ARGUMENT
    )
    misfit_segments: int = threshold(4, "segments", "fewest segments of such a phase", BY_ARGUMENT)
    omnibus_s: tuple[float, ...] = threshold(
        (0.3, 0.15), "s", "lengths of the pieces of flight for that test: slow forces and short ones"
    )
    enough_share: float = threshold(
        0.9, "1", "share of the excess that the named effects must remove; below it the verdict is `unexplained`"
    )
    nearest_share: float = threshold(
        0.6,
        "1",
        "share of the excess in flight below which effects that leave a significant remainder are called the nearest "
        "in the library, not the missing ones",
        "by argument: as `common_share`",
    )
    repeated_p: float = threshold(
        0.01,
        "probability",
        "what is left repeats from episode to episode where a law of any form predicts held-out episodes with a "
        "p-value below it (Student's t over episodes, Bonferroni over the laws)",
        BY_ARGUMENT,
    )
    needed_share: float = threshold(
        0.02,
        "1",
        "beside correlated errors, one of several effects is left out if the loss of held-out flights rises by less",
        "by argument, as in `improve`; looked at on one recording of throws, it takes away the second of two drags",
    )
    needed_chi2: float = threshold(
        50.0,
        "chi2",
        "it is not left out where the loss rises by this much: no error of the noise model is as large in many flights",
        "by argument: seven standard errors; of 300 real-like captures of development `needed_share` alone took away "
        "two effects, both true (87 and 88)",
    )
    zero_errors: float = threshold(
        1.0,
        "standard errors",
        "an effect all of whose parameters lie within so many of zero is not named, nor is one with a parameter at the "
        "limit of its range",
        BY_ARGUMENT,
    )
    same_error: float = threshold(
        1.25,
        "1",
        "factor of a standard error from which flights are searched again, under the errors beside the effects found",
        BY_ARGUMENT,
    )
    common_share: float = threshold(
        0.6,
        "1",
        "share of what repeats from episode to episode that the named effects must explain where something else "
        "repeats, too; below it the verdict is `unexplained`",
    )
    constant_share: float = threshold(
        0.3,
        "1",
        "the same where what repeats beside them is a constant force, which is a candidate itself",
        "by argument; in 6 of 12 measured throws a drag explains 0.597 of what repeats, and a tilt the rest",
    )
    lasting_share: float = threshold(
        0.6,
        "1",
        "share that one tilt in each episode must explain of what tilts of all pieces of its flights do",
    )
    lasting_ratio: float = threshold(
        0.5,
        "1",
        "a constant force that is smaller by this factor late in the flights than early, or the reverse, beyond chance "
        "(`lasting_p`), is none",
        BY_ARGUMENT,
    )
    lasting_p: float = threshold(
        0.02,
        "probability",
        "see `lasting_ratio`",
        "real-like development, even seeds: a gust named a tilt (0.016), gravity that sets in named buoyancy (0.011); "
        "forces that last had 0.03 or more",
        "a gust that fills the flights (0.15 of 0.37 s) passes: early and late differ by less than their errors",
    )
    law_episodes: int = threshold(
        4,
        "episodes",
        "fewest whose own accelerations are tested for a law that they follow",
        "by argument: three leave two degrees of freedom beside a law",
    )
    own_episodes: int = threshold(
        8,
        "episodes",
        "fewest in which a tilt of each episode's own is named: fewer values fit a force that follows the heading by "
        "its first and second harmonic",
        BY_ARGUMENT,
    )
    own_spins: int = threshold(
        5,
        "episodes",
        "fewest in which a lift by an unmeasured spin of each episode's own is named",
        BY_ARGUMENT,
    )
    own_spin_gain: float = threshold(
        2.0,
        "1",
        "least factor by which such a lift, fitted to the first halves of flights, lowers the errors of their second "
        "halves, against no force and against a constant one",
        BY_ARGUMENT,
    )
    levelling_rad: float = threshold(
        math.radians(1.0),
        "rad",
        "in fewer episodes, tilts below it count as errors of levelling, larger ones as a force that nothing explains",
        "by argument: a degree is seen by eye",
    )
    levelled_rad: float = threshold(
        3e-3,
        "rad",
        "usual standard deviation between episodes of how level frames are, which counts for `model_counts` degrees of "
        "freedom beside their scatter; a tilt that all have is judged beside it at `flight.repeated_alpha`, which is "
        "not divided by the number of effects: levels look like a tilt alone",
        "by argument: a spirit level shows 0.5 to 1 mm/m, boards and grounds are worse",
        "real-like development: none of 4 forces in no library stays that was named a tilt, and of 4 tilts the one is "
        "lost that moves the body by 8 slow errors",
    )
    levelled_told: float = threshold(
        0.05,
        "1",
        "information of an episode in that of a usual tilt (`levelled_rad`) from which it counts as a degree of "
        "freedom of the episodes' scatter",
        "by argument: a tilt with an error above 4.5 usual ones says nothing of how these scatter",
    )
    usual_scale: float = threshold(
        3e-3,
        "1",
        "usual standard deviation between the scales of lengths of sessions, which counts for `model_counts` degrees "
        "of freedom beside what flights show of it",
        "by argument: calibrations with a board or a wand agree to some tenths of a per cent",
    )
    rest_frames: int = threshold(8, "frames", "fewest at the end of an episode that show how a body lies", BY_ARGUMENT)
    still_rad: float = threshold(
        0.005, "rad", "change of orientation over these frames that is rest, beside the noise", BY_ARGUMENT
    )
    face_rad: float = threshold(
        0.1, "rad", "angle to the ground up to which a face lies on it", "by argument: as `most_tilt`"
    )
    rest_times: tuple[float, float] = threshold(
        (0.5, 2.0),
        "1",
        "tilts at rest times gravity, in units of the accelerations of the flights, that show these to be tilts",
        "by argument: the ground itself need not be level",
    )
    consistent_p: float = threshold(
        3e-6,
        "probability",
        "an effect whose parameters differ between groups or episodes (p below it, shared part below "
        "`consistent_share`) imitates another one: `unexplained`",
        "real-like development, 254 captures: p is at most 1e-6 for the laws in no library that it withholds, and 1e-5 "
        "and 3e-5 for two effects that act, beside smoothed tilts and bursts",
        "in the same captures 8 of laws in no library are withheld, as with 1e-4, and 3 of effects that act, not 5",
    )
    model_counts: float = threshold(
        4.0,
        "episodes",
        "degrees of freedom for which the noise model counts in the scatter of an effect between episodes, beside "
        "correlated errors, where no other effects tell the usual scatter",
        "real-like development, half of the captures, of 2, 4, 6 and 8: the largest without a wrong name in 35 nulls",
        "as estimated from the scatter of all candidates in 102 captures without an effect in flight (Smyth 2004): 3.2 "
        "and 6.0 on halves",
    )
    effects_count: float = threshold(
        9.0,
        "episodes",
        "degrees of freedom for which the usual scatter of all effects counts in that of one",
        "real-like development: the median over ten effects of what the scatter in 165 captures without an effect in "
        "flight says (Smyth 2004; 4 to 18), where the noise model alone counts for 3 to 9",
        "first step, the same captures: significant in 29 of 38 with an effect, and 2 false ones of 164; 28 and 3 with "
        "the noise model alone",
    )
    consistent_share: float = threshold(0.9, "1", "see `consistent_p`", error_rates="see `consistent_p`")
    form_odds: float = threshold(
        -2 * math.log(3),
        "2 log odds",
        "a force is not named, and alone it is `unexplained`, unless its own law is likelier by odds of 3 than other "
        "forms of it (during a part of the flights, above a height, on one side of a place, by another power of speed "
        "or spin, above or below one of these alone, or swinging)",
        "of 68 names that flights ask for in real-like development captures, large and small, and in captures of "
        "report11 and report12 that were looked at again, 59 right ones stand (44 of 49 above 17 slow errors), and 7 "
        "of 47 names of what is in no library (5 act on one side of a speed or spin); at odds of 4 52 and 7. Where "
        "families were alike and the likelihood was Student's, 47 (37 of 49) and 6 at odds of 4, 52 and 9 at 3",
        "real-like report13: 2 of 35 in no library get a wrong name, and 0 of 39 effects of flight and measurement, 18 "
        "of which get their own; report11 and report12, at odds of 4 then: 1 of 36, and 0 and 19 of 48",
    )
    other_law: float = threshold(
        2 * math.log(100),
        "2 log odds",
        "where other forms of the effect with the most evidence are likelier than its own law by more than this, no "
        "effect beside it is named either: it was fitted beside a wrong law",
        "by argument: as `flight.implausible`; a force below a height in real-like report13, called a scale of lengths "
        "with a tilt beside it, was looked at",
        "takes away none of the names in 250 real-like captures of development",
    )
    unlike_fall: tuple[float, float] = threshold(
        (0.5, 8.0),
        "weights, standard deviations",
        "an episode is left out whose fall differs from the median of all by more than both, the second by the median "
        "of the differences",
        "by argument: no effect makes one episode fall otherwise by half of its weight",
        "0 of 7 measured drops of balls that differ by 0 to 7 m/s2",
        (0, 7),
    )
    unlike_episodes: tuple[int, float] = threshold(
        (5, 0.2), "episodes, 1", "fewest of all, and largest share of them that is left out", BY_ARGUMENT
    )
    min_episodes: int = threshold(3, "episodes", "fewer are refused: none would be left to hold out", BY_ARGUMENT)


@dataclass(frozen=True, kw_only=True)
class FormThresholds:
    """A named force is compared with other forms of it."""

    usual_flight: float = threshold(
        0.75,
        "quantile",
        "of the lengths of the flights: the usual flight, of which times are shares, and over which a constant force "
        "fades or grows (`verdict.lasting_ratio`)",
        "by argument: shorter flights show less of a late force",
    )
    shares: tuple[float, ...] = threshold(
        (0.15, 0.3, 0.45, 0.6),
        "usual flights",
        "when a force sets in or ends: a name that these forms imitate is withheld by `verdict.form_odds`",
        "0.3 to 0.6 by argument, in the middle of flights; 0.15 after a capture of real-like report8 (gravity that "
        "sets in) was looked at again",
        "with the other forms: see `verdict.form_odds`",
    )
    powers: tuple[int, ...] = threshold(
        (-1, 1, 2),
        "1",
        "powers of speed and spin, in their medians, that the force of another form is multiplied by",
        "by argument: they make a force that is linear in speed one that does not grow with it, a quadratic or a cubic "
        "one",
        "with the other forms: see `verdict.form_odds`",
    )
    slowest: tuple[float, float] = threshold(
        (0.05, 0.3),
        "m/s, rad/s",
        "speed and spin below which their powers are those there",
        "by argument: the direction of what rests is unknown",
    )
    edges: tuple[float, ...] = threshold(
        (0.2, 0.4, 0.6, 0.8),
        "quantiles",
        "of the speeds, or the spins, of all frames of flight: where the force of another form begins or ends to act",
        "by argument: a fifth of the frames show what acts on them",
        "with the other forms: see `verdict.form_odds`",
    )
    own_edges: tuple[float, ...] = threshold(
        (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9),
        "quantiles",
        "the same where the law of the force follows the speed or the spin, of one likelihood together with `edges`",
        "by argument: steps of a tenth of the frames; between `edges` a drag above a speed alone of real-like report18 "
        "was missed (chi2 35 higher at the next of them), which fits better than the drag that was named (by 3)",
    )
    periods: tuple[float, ...] = threshold(
        (1.0, 1.5, 2.0, 3.0),
        "1 / usual flight",
        "how often the force of another form swings in a usual flight",
        "by argument: less than one period is a force that grows or fades, and more than three move a body little",
        "with the other forms: see `verdict.form_odds`",
    )
    phases: tuple[float, ...] = threshold(
        (0.0, 0.25, 0.5, 0.75),
        "half turns",
        "phases at the begin of a flight in which it does",
        "by argument: half a turn more is the other sign, and an eighth of a turn leaves 15 % of chi2",
        "with the other forms: see `verdict.form_odds`",
    )


@dataclass(frozen=True, kw_only=True)
class ExperimentThresholds:
    """Detection limits, the next experiment and the residual law."""

    safe: float = threshold(
        1.5,
        "1",
        "factor between where an effect would reach its score and the stated limit",
        "78 development effects",
        "18 of 19 above their limits were named (the other stops the spin, then acts no more), 14 of 59 below; "
        "report8: none of 15 silent ones above",
    )
    near_bic: float = threshold(
        2 * math.log(1000), "BIC", "a second effect within these odds (1,000) is a rival", BY_ARGUMENT
    )
    enough_nats: float = threshold(
        3.0, "nats", "an experiment that gains less separates nothing: odds of 20", BY_ARGUMENT
    )
    nearly: float = threshold(
        1.15,
        "1",
        "gains within this factor count as equal",
        error_rates="predicted gains are right within a factor of 6 where both effects act in flight or measurement; "
        "the first experiment gains three times what the last does in 17 of 20 pairs",
    )
    seen_sizes: float = threshold(
        2.0,
        "usual sizes",
        "motions are asked for until an effect of contact of this size would be named",
        BY_ARGUMENT,
    )
    least_worth: float = threshold(
        0.05,
        "1",
        "least worth of a motion that is asked for, in effects of contact that it shows",
        BY_ARGUMENT,
    )
    suggested: float = threshold(
        3.0,
        "1",
        "how much more the effect counts that ranks first in contact, with a positive score that does not suffice",
        BY_ARGUMENT,
        "experiments in sequence, development: looked at in two cases; one is named after a round as before, the other "
        "silent as before with a larger score",
    )
    law_margin: float = threshold(
        10.0, "chi2", "a term enters a residual law if chi2 falls by this more than its penalty"
    )
    exponent_chi2: float = threshold(3.84, "chi2", "interval of the exponent of a residual law: 95 %", BY_ARGUMENT)
    most_terms: int = threshold(4, "terms", "most terms of a residual law")


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """All thresholds of a diagnosis."""

    flight: FlightThresholds = field(default_factory=FlightThresholds)
    """Forward selection in flight."""
    verdict: VerdictThresholds = field(default_factory=VerdictThresholds)
    """What remains unexplained."""
    forms: FormThresholds = field(default_factory=FormThresholds)
    """Other forms of a named force."""
    sliding: SlidingThresholds = field(default_factory=SlidingThresholds)
    """Sliding test."""
    impact: ImpactThresholds = field(default_factory=ImpactThresholds)
    """Impact test."""
    flat_impact: FlatImpactThresholds = field(default_factory=FlatImpactThresholds)
    """Impact test of a body that falls flat on a face."""
    segments: SegmentsThresholds = field(default_factory=SegmentsThresholds)
    """Test in contact segments, and separation of flight equals."""
    experiment: ExperimentThresholds = field(default_factory=ExperimentThresholds)
    """Detection limits, next experiment and residual law."""


THRESHOLDS = Thresholds()
"""The thresholds in use."""
