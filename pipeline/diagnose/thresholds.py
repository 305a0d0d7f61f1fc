"""All thresholds that decide a verdict of `cgwm diagnose`, with what they were calibrated on and their error rates.

"Development" and "report N" are sets of seeds of `benchmarks/diagnose.py`, a null is a capture without an effect.
Thresholds were chosen on development seeds; those of a report were unseen until it was run. `docs/thresholds.md` is
written from this table, and `benchmarks/thresholds.py` calibrates it again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..segments.thresholds import BY_ARGUMENT, threshold


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
    contained: float = threshold(
        0.995, "correlation", "above it an effect with more parameters counts as able to imitate the best one"
    )
    slight: float = threshold(
        0.15,
        "usual sizes",
        "an effect whose parameters all are below it needs BIC to fall by more than `slight_bic`",
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
    most_effects: int = threshold(3, "effects", "how many effects are looked for in flight")
    share: float = threshold(
        0.6,
        "1",
        "share of the remaining excess of chi2 that a second effect must explain",
        "development: true ones at least 0.83, false ones at most 0.42",
        "report8: 1 of 44 named with an effect too many",
    )
    paired_t: float = threshold(
        3.0,
        "standard errors",
        "beside slow errors a rival is ruled out where it is worse by this much in the mean over episodes",
        "by argument: with 12 episodes 0.6 % of rivals that are as good lie farther off",
    )
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
    omnibus_s: tuple[float, ...] = threshold(
        (0.3, 0.15), "s", "lengths of the pieces of flight for that test: slow forces and short ones"
    )
    enough_share: float = threshold(
        0.9, "1", "share of the excess that the named effects must remove; below it the verdict is `unexplained`"
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
        "beside slow errors, of several effects one is left out if the loss of held-out flights then rises by less",
        "by argument, as in `improve`; looked at on one recording of throws, it takes away the second of two drags",
    )
    common_share: float = threshold(
        0.6,
        "1",
        "share of what repeats from episode to episode that the named effects must explain where something else "
        "repeats, too; below it the verdict is `unexplained`",
    )
    lasting_share: float = threshold(
        0.6,
        "1",
        "share that one tilt in each episode must explain of what tilts of all pieces of its flights do",
    )
    own_episodes: int = threshold(
        8,
        "episodes",
        "fewest in which a tilt of each episode's own is named: fewer values fit a force that follows the heading by "
        "its first and second harmonic",
        BY_ARGUMENT,
    )
    levelling_rad: float = threshold(
        math.radians(1.0),
        "rad",
        "in fewer episodes, tilts below it count as errors of levelling, larger ones as a force that nothing explains",
        "by argument: a degree is seen by eye",
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
        1e-4,
        "probability",
        "an effect whose parameters differ between groups or episodes (p below it, shared part below "
        "`consistent_share`) imitates another one: `unexplained`",
    )
    consistent_share: float = threshold(0.9, "1", "see `consistent_p`", error_rates="see `consistent_p`")
    better_chi2: float = threshold(
        12.0,
        "chi2",
        "an alternative law of a detected effect fits better (`unexplained`) or equally well (a note): odds of 400",
        BY_ARGUMENT,
        "development: a quadratic spin drag `unexplained` in 4 of 4 (named `spin_damping` in 2 of 3 before), spin "
        "damping right in 6 of 6",
    )
    min_episodes: int = threshold(3, "episodes", "fewer are refused: none would be left to hold out", BY_ARGUMENT)


@dataclass(frozen=True, kw_only=True)
class SlidingThresholds:
    """An effect of contact is named in sliding."""

    score: float = threshold(
        220.0,
        "chi2",
        "score from which an effect with one parameter is named",
        "14 large effects and 13 nulls of development (nulls at most 170)",
        "wrong names reached 165; for 31 of 36 missed development effects the largest score that the data allow is "
        "below this threshold",
        (0, 13),
    )
    explained: float = threshold(
        0.5, "1", "share of the excess of chi2 that a named effect explains", "as `score`", "see `score`"
    )
    few_parameters: int = threshold(
        1, "parameters", "an effect with more needs `score_flexible`", "as `score_flexible`"
    )
    score_flexible: float = threshold(
        400.0,
        "chi2",
        "score of an effect with more parameters, or next to an effect of flight",
        "development nulls: friction map at most 270, friction by direction 240",
        "report3 to report4: false names of cubes 3 of 100, then 0 of 100; report4: friction against spinning named "
        "friction by direction (827)",
        (0, 100),
    )
    score_sure: float = threshold(
        80.0,
        "chi2",
        "lower score for an effect that explains at least `share_sure`",
        "development: false ones reached 165 at a share of 0.69, any share up to 50, and (friction by direction with "
        "a drag in wind) 179 at a share of 0.94",
        "report5: 2 of 200 nulls with scores of 81 and 101; `braked_otherwise` has excluded the second since",
        (2, 200),
    )
    share_sure: float = threshold(
        0.78, "1", "see `score_sure`; also needed where flight is not explained", "as `score_sure`", "see `score_sure`"
    )
    many_parameters: int = threshold(
        4, "parameters", "`score_sure` does not apply to an effect with more: a friction map can fit almost anything"
    )
    least_size: float = threshold(
        0.3,
        "usual sizes",
        "an effect whose parameters all are below it is not named",
        "by argument: engines differ by as much",
        "with `score_flexible`: 3 of 100 cubes on report3, 0 of 100 on report4",
    )
    without_best: float = threshold(
        80.0,
        "chi2",
        "next to an effect of flight, chi2 must fall by this much in other episodes than the best one",
        "report4 and report5: false ones 18 and 33 (of scores of 1,044 and 823), true ones 114 to 34,000",
        "one true effect (26) became silent; on fresh seeds not measured alone",
    )
    lead: float = threshold(12.0, "chi2", "another effect within this score is not separable")
    lead_share: float = threshold(0.1, "1", "another effect within this share of the best score is not separable")
    misled: float = threshold(
        165.0,
        "chi2",
        "nor is one whose score is lower by less than this (the largest score of a false effect) and that explains "
        "`rival_share`",
        "development, report3",
        "named as a near relative: 3 of 30 on report3, 0 of 30 on report4, where 2 were `not_separable`",
    )
    rival_share: float = threshold(
        0.5,
        "1",
        "explained share of a rival, as a fraction of the best one's; see `misled`",
        "as `misled`",
        "see `misled`",
    )
    braked_otherwise: tuple[str, ...] = threshold(
        ("torsional_friction",),
        "effects",
        "not named below `score_flexible` where a friction map explains the same: engines differ in the spin of a "
        "sliding body",
        "report4 to report6: 3 of 4 such names were false (101 to 260)",
        "the fourth, true one is silent, too",
    )
    flight_tells_m_s2: float = threshold(
        0.3,
        "m/s2",
        "where flights could not have shown a force of this size, effects in flight are candidates in sliding, too",
        "by argument: a tenth of usual friction",
        "development: a drag on a rolling ball was `rolling_resistance` in 2 of 2 cases before the rule, in none since",
    )
    surplus_sigmas: float = threshold(
        3.0,
        "sigma",
        "no candidate is fitted where even a chi2 this far below its expectation would leave the score too low",
        BY_ARGUMENT,
    )
    close_share: float = threshold(
        0.3, "1", "after the first steps only candidates with this share of the best gain are followed"
    )
    converged: float = threshold(
        3.0,
        "chi2",
        "a fit that falls by less in a pass of steps has converged",
        "by argument: a quarter of `lead`",
    )


@dataclass(frozen=True, kw_only=True)
class ImpactThresholds:
    """An effect of contact is named in impacts of a ball."""

    score: float = threshold(
        6.0,
        "chi2",
        "score from which an effect is named",
        "development: 30 balls without an effect at most 4.1 (size 0.26) and 2.7 (0.33)",
        "0 of 30 nulls of development; named 14 of 16 effects of restitution, rolling and spinning, none of 16 of "
        "friction and adhesion. Reports 4 to 8: restitution by speed named in 2 of 1,000 nulls",
        (2, 1000),
    )
    size: float = threshold(0.35, "usual sizes", "size from which an effect is named", "as `score`", "see `score`")
    explained: float = threshold(0.5, "1", "share of the excess of chi2 that it explains", "as `score`", "see `score`")
    gain_t: float = threshold(1.0, "standard errors", "mean gain of held-out episodes", "as `score`", "see `score`")
    lead: float = threshold(6.0, "chi2", "another effect within this score is not separable")
    lead_share: float = threshold(0.1, "1", "another effect within this share of the best score is not separable")
    shown: float = threshold(
        1.0, "chi2", "an effect of usual size must change the impacts by this much, or they do not test it"
    )


@dataclass(frozen=True, kw_only=True)
class FrictionThresholds:
    """Friction of sliding against friction of impacts: adhesion is named."""

    spread: float = threshold(
        0.13,
        "logarithm",
        "difference of the two frictions that counts as the contact model's error",
        "14 cubes without an effect: 0.13 root mean square, at most 0.33",
        "one engine only",
    )
    score: float = threshold(
        8.0,
        "chi2",
        "discrepancy from which effects are fitted, and score from which one is named",
        "development: without an effect at most 6, with one 13 to 29",
        "0 of 14 nulls; 4 of 4 large adhesions of cubes; small ones (3 m/s2) are missed",
        (0, 14),
    )
    resolved: float = threshold(
        0.75, "1", "share of the discrepancy that a named effect must remove", "as `score`", "see `score`"
    )
    lead: float = threshold(6.0, "chi2", "another effect within this score is not separable")
    fewest: int = threshold(6, "segments", "fewest segments with impacts that show their friction")


@dataclass(frozen=True, kw_only=True)
class SegmentsThresholds:
    """An effect of contact is named under the model's contact law."""

    own_share: float = threshold(
        0.1,
        "widths of the prior",
        "standard deviation of each contact's own friction, contact time and damping: no law of contact is exact, and "
        "what such deviations explain is no evidence",
    )
    score: float = threshold(
        22.0,
        "chi2",
        "score of an effect that sliding cannot show",
        "41 nulls of development: at most 18.9",
        "0 of 41 nulls of the first report (at most 7.6); 17 of 19 contact effects were missed by this test alone",
        (0, 41),
    )
    gain_t: float = threshold(
        1.0, "standard errors", "mean gain of held-out episodes of a named effect", "as `score`", "see `score`"
    )
    agreed_score: float = threshold(
        40.0, "chi2", "score where sliding segments can detect the effect: it must rank first there, with this score"
    )
    alone_score: float = threshold(
        120.0,
        "chi2",
        "score where there are no sliding segments that could confirm the effect",
        "friction by direction has reached 113 where there was none",
    )
    in_impacts_alone: tuple[str, ...] = threshold(("velocity_restitution",), "effects", "what sliding cannot show")
    lead_share: float = threshold(0.5, "1", "another effect within this share of the best score is not separable")
    confirmed: float = threshold(2.0, "standard errors", "distance from zero that a refit must leave")
    separate_chi2: float = threshold(
        12.0, "chi2", "contact rules out an equal of flight that is worse by more than this: odds of 400", BY_ARGUMENT
    )
    separate_t: float = threshold(
        1.5, "standard errors", "and whose mean difference between episodes is above this", BY_ARGUMENT
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
    law_margin: float = threshold(
        10.0, "chi2", "a term enters a residual law if chi2 falls by this more than its penalty"
    )
    exponent_chi2: float = threshold(3.84, "chi2", "interval of the exponent of a residual law: 95 %", BY_ARGUMENT)
    most_terms: int = threshold(4, "terms", "most terms of a residual law")


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """All thresholds of a diagnosis."""

    flight: FlightThresholds = FlightThresholds()
    """Forward selection in flight."""
    verdict: VerdictThresholds = VerdictThresholds()
    """What remains unexplained."""
    sliding: SlidingThresholds = SlidingThresholds()
    """Sliding test."""
    impact: ImpactThresholds = ImpactThresholds()
    """Impact test."""
    friction: FrictionThresholds = FrictionThresholds()
    """Friction consistency test."""
    segments: SegmentsThresholds = SegmentsThresholds()
    """Test in contact segments, and separation of flight equals."""
    experiment: ExperimentThresholds = ExperimentThresholds()
    """Detection limits, next experiment and residual law."""


THRESHOLDS = Thresholds()
"""The thresholds in use."""
