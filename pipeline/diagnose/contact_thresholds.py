"""Thresholds of the contact tests of `cgwm diagnose`; `thresholds` says what is stated of each."""

from __future__ import annotations

from dataclasses import dataclass

from ..trajectories.thresholds import BY_ARGUMENT, threshold


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
        4,
        "parameters",
        "`score_sure` does not apply to an effect with more, nor is it a rival of one with `few_parameters` whose "
        "score is higher by `misled`: a friction map can fit almost anything",
    )
    gain_t: float = threshold(
        1.0,
        "standard errors",
        "mean gain of held-out episodes",
        "by argument: as `impact.gain_t`",
        "real-like development: a map that three episodes speak for and one against was the only false name of sliding "
        "in 119 captures without an effect (757); of 9 other effects that slides named in 151 captures and 14 "
        "experiments in sequence the one below it (0.77) is false, a drag in no library that was called a rolling "
        "resistance",
    )
    least_size: float = threshold(
        0.3,
        "usual sizes",
        "an effect whose parameters all are below it is not named",
        "by argument: engines differ by as much",
        "with `score_flexible`: 3 of 100 cubes on report3, 0 of 100 on report4",
    )
    least_way: float = threshold(
        0.02,
        "1",
        "on fixed surfaces, instead of `least_size`: an effect is named that moves the body by this share of its way "
        "in a piece",
        "by argument: balls of MuJoCo that roll down a plate or a groove with nothing hidden are slower by 0.05 % to "
        "0.3 % by the time constant of their contacts, and by 1 to 2 % with the smallest resistance that it takes",
    )
    without_best: float = threshold(
        80.0,
        "chi2",
        "next to an effect of flight, chi2 must fall by this much in other episodes than the best one",
        "report4 and report5: false ones 18 and 33 (of scores of 1,044 and 823), true ones 114 to 34,000",
        "one true effect (26) became silent; on fresh seeds not measured alone",
    )
    without_share: float = threshold(
        0.1,
        "1",
        "where the slides of several episodes are compared, chi2 must fall by this share of the score in other "
        "episodes than the best one",
        "by argument: what one episode misfits is one error; real-like development: the two wrong names of 295 "
        "captures have 0.01 and 0.07",
        "the same captures: named by slides in three more, 0.43 to 0.61, none of which is a true name",
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
    higher_at_rest: tuple[str, ...] = threshold(
        ("stribeck_friction",),
        "effects",
        "not named with a negative parameter: dry friction at rest is not below that of sliding, and a filter that "
        "smears the end of a slip looks so",
        BY_ARGUMENT,
        "real-like development: the only false name of sliding in 234 captures, in tracks smoothed at 60 Hz",
    )
    pyramid_share: float = threshold(
        0.9,
        "1",
        "an effect is not named where a friction pyramid, which has no number of its own, reaches this share of its "
        "fall of chi2",
        "by argument: as `lead_share`",
        "two nulls of real-like development in an engine with a pyramid: 1.12 and 1.43 of friction by direction",
    )
    by_speed: tuple[str, ...] = threshold(
        ("stribeck_friction", "viscous_friction"),
        "effects",
        "compared with a friction that changes at a line across the ground, and not named where that reaches "
        "`pyramid_share`",
        "by argument: beyond the line a body is slower",
        "a bowling ball on a lane whose first 4 m are oiled: named in 3 of 3 before",
    )
    line_width: float = threshold(
        0.02, "spans", "width over which friction changes at such a line, as a share of the places' span", BY_ARGUMENT
    )
    line_places: tuple[float, ...] = threshold(
        (-0.08, 0.0, 0.08), "spans", "places that are tried, from where braking changes most", BY_ARGUMENT
    )
    line_slides: float = threshold(
        0.1, "1", "deceleration from which a piece slides, as a share of the larger ones: less is rolling", BY_ARGUMENT
    )
    line_pieces: int = threshold(4, "pieces", "fewest sliding pieces on either side of a line", BY_ARGUMENT)
    carriers: int = threshold(
        3,
        "episodes",
        "the slides of one episode more than an effect has parameters, of at most so many, are predicted by those of "
        "the others",
        BY_ARGUMENT,
        "real-like development, even seeds: friction by direction was named in 5 of 21 captures of an engine with a "
        "friction pyramid, in none of the five since; how many true ones become silent is not measured",
    )
    carries: float = threshold(
        0.05, "1", "share of the gain of all held-out episodes from which one counts for `carriers`", BY_ARGUMENT
    )
    braked_otherwise: tuple[str, ...] = threshold(
        ("torsional_friction",),
        "effects",
        "not named below `score_flexible` where a friction map explains the same: engines differ in the spin of a "
        "sliding body",
        "report4 to report6: 3 of 4 such names were false (101 to 260)",
        "the fourth, true one is silent, too",
    )
    in_impacts_alone: tuple[str, ...] = threshold(("velocity_restitution",), "effects", "what sliding cannot show")
    as_friction: tuple[str, ...] = threshold(
        ("adhesion",),
        "effects",
        "`score_sure` does not apply to an effect that presses a sliding body as its weight does: friction follows it "
        "but for how far the soft contact gives way",
        "experiments in sequence, development: a cube with nothing hidden had 159 and 188, one with adhesion 2,501",
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
        "no candidate is fitted where even a chi2 this far below its expectation would leave the score too low, and "
        "none is named where chi2 of the model alone is not this far above it",
        BY_ARGUMENT,
        "real-like development: both false names of sliding had less left (-0.1 and 2.4 sigma), all true ones more (5)",
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
class FlatImpactThresholds(ImpactThresholds):
    """An effect of contact is named in impacts of a body that falls flat on a face."""

    score: float = threshold(
        12.0,
        "chi2",
        "score from which an effect is named",
        "by argument: twice that of a ball, whose impacts are exact",
    )
    carriers: int = threshold(
        3, "episodes", "fewest held-out ones of which each has the share `sliding.carries` of the gain", BY_ARGUMENT
    )
    told: tuple[str, ...] = threshold(
        ("velocity_restitution",),
        "effects",
        "what flat impacts tell: a face that comes down askew takes more of slow impacts, as adhesion does",
        BY_ARGUMENT,
    )


@dataclass(frozen=True, kw_only=True)
class SegmentsThresholds:
    """An effect of contact is named under the model's contact law."""

    own_share: float = threshold(
        0.1,
        "widths of the prior",
        "standard deviation of each contact's own friction, contact time and damping: no law of contact is exact, and "
        "what such deviations explain is no evidence",
    )
    few_parameters: int = threshold(
        1,
        "parameters",
        "`agreed_score` does not suffice for an effect with more: two numbers fit many laws",
        "report10: six tosses of the own engine's list without an effect of contact",
        "with two parameters 2 of 69 were named, both a friction by direction of a box",
    )
    fitted_parameters: int = threshold(
        2,
        "parameters",
        "an effect with more is not fitted in segments, so that they do not name it",
        "by argument: a few sizes do not cover the nine numbers of a friction map",
    )
    first_score: float = threshold(
        0.0,
        "chi2",
        "score of an effect in segments linearised without it, below which it is not named, and from which effects are "
        "fitted",
        "development, 55 captures: 2 of 27 without an effect and each large one that was named have it",
        "the largest scores of fits without an effect (86 and 49) belong to effects with none",
        (0, 27),
    )
    gain_t: float = threshold(
        1.0,
        "standard errors",
        "mean gain of held-out episodes of an effect that slides show, too, and of a rival",
        "real-like development, 276 captures of three engines without an effect of contact",
        "friction by direction, which a friction pyramid imitates, had at most 0.9 where slides ranked it first",
    )
    alone_t: float = threshold(
        1.5, "standard errors", "the same of an effect that segments alone show", "as `gain_t`", "see `alone`"
    )
    shown_score: float = threshold(
        25.0,
        "chi2",
        "score among slides of an effect that ranks first there, from which `agreed_score` is asked for",
        "as `agreed_score`",
        "see `agreed_score`",
    )
    agreed_score: float = threshold(
        15.0,
        "chi2",
        "score of an effect that ranks first here and among slides",
        "development without an effect of contact: 276 real-like captures of three engines, 16 of six tosses, 17 of "
        "experiments in sequence",
        "none of them is named, though 20 rank the same effect first in both",
        (0, 309),
    )
    alone: tuple[tuple[str, float], ...] = threshold(
        (
            ("torsional_friction", 30.0),
            ("viscous_friction", 75.0),
            ("stribeck_friction", 60.0),
            ("adhesion", 80.0),
            ("anisotropic_friction", 150.0),
        ),
        "chi2",
        "score of an effect that ranks first here, without slides, where no effect is named in flight and nothing is "
        "left there; an effect that is not listed is not named so",
        "1.5 times the largest score of a false effect that passes all other thresholds, without fits (276 real-like "
        "captures: 10, 27, 37, 51, 45) and with them (55 of development: none, 49, none, none, none); friction by "
        "direction 2.5 times the largest of all false ones (60), as two numbers fit more laws",
        "the same captures: none named; beside errors of impulses 36 other captures of development with nothing hidden "
        "reach at most 0.6 of it",
        (0, 303),
    )
    sure: float = threshold(
        2.0,
        "1",
        "factor of this score from which `gain_t` suffices: the gain of one episode that is far above the others' "
        "raises the scatter more than the mean",
        BY_ARGUMENT,
    )
    unlike_laws: tuple[str, ...] = threshold(
        ("torsional_friction",),
        "effects",
        "named so beside effects in flight, too: laws of contact differ in how they push, none has a torque about the "
        "normal",
        BY_ARGUMENT,
        "see `alone`",
    )
    lead_share: float = threshold(0.5, "1", "another effect within this share of the best score is not separable")
    confirmed: float = threshold(2.0, "standard errors", "distance from zero that a refit must leave")
    worse_t: float = threshold(
        1.0,
        "standard errors",
        "nor is an effect named from any test that raises the prediction error of held-out contact segments by more, "
        "in the mean over episodes",
        BY_ARGUMENT,
    )
    separate_chi2: float = threshold(
        12.0, "chi2", "contact rules out an equal of flight that is worse by more than this: odds of 400", BY_ARGUMENT
    )
    separate_t: float = threshold(
        1.5, "standard errors", "and whose mean difference between episodes is above this", BY_ARGUMENT
    )
