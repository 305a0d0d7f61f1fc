"""Thresholds of the fits that commands share: input, preparation, phases; see `trajectories.thresholds`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..trajectories.thresholds import BY_ARGUMENT, threshold


@dataclass(frozen=True, kw_only=True)
class InputThresholds:
    """An input is refused, or its first frames are left out."""

    most_off: float = threshold(
        0.2,
        "sizes",
        "depth under the ground, or height of rest above it, beyond which shape or ground are wrong",
        BY_ARGUMENT,
    )
    noise_sigmas: float = threshold(
        2.0,
        "sigma",
        "tolerance of `most_off` in addition",
        "by argument: 2 % (5 % of a box's) frames at rest lie 2 sigma deeper",
        "noise of 5 mm: 3 of 7 balls refused before the noise counted, 0 since",
    )
    most_tilt: float = threshold(
        0.1,
        "rad",
        "tilt of the tracking frame up to which such depths are diagnosed, not refused",
        "report6: one ball and one cube, frames tilted by 2 degrees",
        "both refused before, exact since",
    )
    envelope_weight: float = threshold(
        0.02,
        "1",
        "weight of places above the plane in the lower envelope that shows a tilt",
        "as `most_tilt`",
        "see `most_tilt`",
    )
    deep_share: float = threshold(
        0.05, "1", "share of the frames that may lie deeper under the tilted plane", "as `most_tilt`", "see `most_tilt`"
    )
    most_carried: float = threshold(
        0.2, "1", "share of the frames above the ground and not falling: shape or ground are wrong"
    )
    least_stretch: int = threshold(
        4,
        "frames",
        "fewest in a row that tell a body that is carried from a bounce that a filter smeared",
        "by argument: two at each end give the velocities",
    )
    densest_kg_m3: float = threshold(23000.0, "kg/m3", "heaviest body of its shape: osmium", "physical bound")
    alike_sigmas: float = threshold(
        3.0, "sigma", "motions that differ by less are one motion; bodies that move by less stand still"
    )
    least_seen: float = threshold(
        0.25, "weights", "smallest visible force at which nothing can be diagnosed, with `share_of_size`"
    )
    share_of_size: float = threshold(0.25, "sizes", "noise above which `least_seen` is required")
    held_chi2: float = threshold(
        3.0,
        "chi2 / dof",
        "rotation that fits worse than that of most flights: an episode may begin in a hand",
        "349 measured tosses of a cube",
        "12 of 349 fit 20 times as well without the first third of their flight, none without the last",
    )
    free_chi2: float = threshold(
        2.0, "chi2 / dof", "rotation without the first frames that is free flight", "as `held_chi2`", "see `held_chi2`"
    )
    skew: float = threshold(
        3.0, "1", "how much worse it fits without as many last frames", "as `held_chi2`", "see `held_chi2`"
    )
    least_free: int = threshold(8, "frames", "fewest that remain of the flight", "as `held_chi2`", "see `held_chi2`")


@dataclass(frozen=True, kw_only=True)
class CarriedThresholds:
    """An episode begins while the body is carried or pushed."""

    weights: float = threshold(
        0.5,
        "weights",
        "step of acceleration at the release from which something held or pushed the body before",
        "by argument: what holds a body still carries its weight; effects in flight are smooth",
        "the first tenth of a second is lost where it is none",
    )
    sigmas: float = threshold(5.0, "standard errors", "the same: at least so many", BY_ARGUMENT)
    longest_s: float = threshold(0.2, "s", "latest release that is looked for", BY_ARGUMENT)
    free_s: float = threshold(0.06, "s", "shortest motion after the release", BY_ARGUMENT)
    window_s: float = threshold(0.35, "s", "motion from the first frame on that is a parabola", BY_ARGUMENT)
    bend_rad: float = threshold(
        0.1, "rad", "turn of the surfaces under a body in that time, from which on nothing is told", BY_ARGUMENT
    )
    least_frames: int = threshold(8, "frames", "fewest that a beginning has", "parabola, step and its time")
    widths_s: tuple[float, ...] = threshold(
        (0.0, 0.008, 0.016, 0.024),
        "s",
        "widths of a filter that rounds the step",
        "by argument: low passes from 10 Hz on",
    )
    rounded: float = threshold(2.0, "widths", "after the release the rounded step is over", BY_ARGUMENT)
    most_alike: float = threshold(0.95, "1", "largest correlation of neighbouring errors that is believed", BY_ARGUMENT)


@dataclass(frozen=True, kw_only=True)
class PreparationThresholds:
    """Noise is believed, a direction or a force counts as measured."""

    noise_disagrees: float = threshold(
        1.3, "1", "a given noise that differs by this factor is replaced (if smaller) or warned about"
    )
    sure: float = threshold(4.0, "standard errors", "from which a force in flight counts as shown (`least_force_m_s2`)")
    robust_excess: float = threshold(
        20.0, "chi2", "scale of the robust loss of a contact segment", "study of diagnosis, section 3"
    )
    smeared_frames: int = threshold(
        3,
        "frames",
        "frames next to a contact that count as contact where errors are correlated",
        "by argument: a filter of seven frames",
        "longer filters: `smeared_times`",
    )
    smeared_times: float = threshold(
        2.0,
        "correlation times",
        "the same, in times over which the errors are correlated",
        "by argument: a filter smears a contact as far as it correlates errors",
    )
    smeared_s: float = threshold(0.04, "s", "longest such time: slower errors come from no filter", BY_ARGUMENT)
    edge_share: float = threshold(
        0.5,
        "1",
        "share of it over which a low pass bends a flight at an end of a record",
        "by argument: the acceleration has a step there, not the velocity; 12 Hz bend a fall by 0.3 mm over 0.04 s",
    )
    filter_frames: int = threshold(
        5,
        "frames",
        "the same in frames, where these last longer than `smeared_s`",
        "by argument: a filter of eleven frames",
        "a ball at 60 Hz, smoothed over eleven frames: the flights between its bounces were named a pull of the ground",
    )
    filtered: float = threshold(
        0.95,
        "1",
        "share of the variance of errors that is correlated, above which a filter made them: it passes no white noise",
        "by argument; measured tosses of a cube have 0.9, and sharp contacts",
    )
    bad_fit: float = threshold(1.3, "1", "chi2 of a contact segment, in usual ones, from which it is fitted again")
    unobservable_share: float = threshold(
        0.8, "widths of the prior", "standard error from which a parameter is called not observable"
    )


@dataclass(frozen=True, kw_only=True)
class PhaseThresholds:
    """A contact is an impact, rest, rolling or sticking."""

    impact_weights: float = threshold(
        3.0,
        "impulses of the weight over a frame",
        "normal impulse from which a contact is an impact",
        "by argument: rolling over an edge reaches 2",
    )
    impact_m_s: float = threshold(
        0.05, "m/s", "the same where frames are so short that the impulse of the weight is negligible"
    )
    rest_m_s: float = threshold(0.02, "m/s", "speed of a surface at rest, in addition to the noise")
    round_share: float = threshold(
        0.5,
        "sizes",
        "radius of the touching sphere from which a body rolls",
        "by argument: a cube sticks on its corner",
    )
    sliding_impulse: float = threshold(
        0.5, "1", "share of the normal impulse at contacts that slide from which the body slides", "by argument: half"
    )
    rolling_impulse: float = threshold(
        0.5, "1", "share of the normal impulse on round spheres from which the body rolls", "by argument: half"
    )


@dataclass(frozen=True, kw_only=True)
class SlidingSegmentThresholds:
    """A motion is a sliding segment, and shows the friction."""

    longest_s: float = threshold(0.5, "s", "longest sliding segment; longer ones are cut")
    shortest_s: float = threshold(0.15, "s", "shortest sliding segment; shorter ones are left to other tests")
    near_m: float = threshold(0.0015, "m", "height below which the lowest point is on the ground")
    near_sigmas: float = threshold(3.0, "sigma", "tolerance of `near_m` in addition")
    near_surface_m: float = threshold(
        0.004,
        "m",
        "the same above a fixed surface, which a mesh of few triangles describes to a millimetre or two",
        BY_ARGUMENT,
    )
    longest_on_surface_s: float = threshold(
        3.0, "s", "longest piece of rolling or sliding on fixed surfaces: all of it shows a small force"
    )
    flat: float = threshold(
        0.999,
        "1",
        "cosine of the angle between the normals of a surface on which a body with edges slides",
        BY_ARGUMENT,
    )
    apart: float = threshold(
        0.06,
        "1",
        "share of the second moment of normals above which surfaces carry in another direction, too, as the sides of a "
        "groove: that of two 28 degrees apart; neighbouring triangles of a curved surface are closer",
        BY_ARGUMENT,
    )
    kink_sigmas: float = threshold(
        6.0, "sigma", "`jump_sigmas` for a jump of the velocity in any direction, on fixed surfaces", BY_ARGUMENT
    )
    jump_m_s: float = threshold(0.12, "m/s", "jump of velocity that is an impact, which ends a sliding segment")
    jump_sigmas: float = threshold(4.0, "sigma", "the same, where it is more")
    tilting_rad_s: float = threshold(
        0.3,
        "rad/s",
        "a body with edges that tilts faster turns over an edge and does not slide",
        "development: chi2 / dof of such segments up to 161",
    )
    well_known: float = threshold(100.0, "1", "information from which one sliding segment determines the friction")
    well_fitted: float = threshold(4.0, "chi2 / dof", "up to which one sliding segment determines the friction")
    loads_unknown: float = threshold(
        0.01,
        "weights",
        "how corners share the weight counts as unknown to this share",
        "development: 6 of 30 cubes with a false effect of contact",
        "0 of 32 on report3",
        (0, 32),
    )


@dataclass(frozen=True, kw_only=True)
class ImpactDataThresholds:
    """A motion is an impact, and how exact the model of an impact is."""

    least: int = threshold(4, "impacts", "fewest that show more than a restitution")
    rebound_share: float = threshold(
        0.03,
        "1",
        "scatter of a rebound about any law",
        "development without an effect: 0.7 to 5 %",
        "a restitution that falls by 0.03 s/m is found in 1 of 30 nulls",
    )
    friction_share: float = threshold(
        0.04, "1", "model error of the tangential impulse, of itself: a slip ends within the impact", "development"
    )
    impulse_share: float = threshold(
        0.002, "1", "model error of the tangential impulse, of the normal one", "development"
    )
    spin_share: float = threshold(
        0.06, "1", "model error of the change of spin: the ground deforms and shortens the arm", "development"
    )
    contact_s: float = threshold(0.008, "s", "duration after reaching the ground that belongs to no flight")
    longest_s: float = threshold(0.03, "s", "longest contact that is one impact")
    misfit_sigmas: float = threshold(5.0, "sigma", "a frame farther off a flight's parabola does not belong to it")
    bad_flight: float = threshold(2.5, "chi2 / dof", "up to which a flight gives the velocities of an impact")
    min_frames: int = threshold(4, "frames", "fewest of a flight between two impacts")


@dataclass(frozen=True, kw_only=True)
class FlatImpactThresholds:
    """An impact of a body is flat on a face."""

    tilt_rad: float = threshold(
        math.radians(5.0),
        "rad",
        "angle between the face and the ground, before and after, up to which an impact is flat",
        "simulated drops of a box in MuJoCo at tilts of 0.2 to 8 deg: the energies' ratio varies by 3 to 6 % up to "
        "4 deg at 2 m/s",
    )
    turning_share: float = threshold(
        0.1, "1", "largest share of the energy that tips the face, before and after", "as `tilt_rad`"
    )
    slip_share: float = threshold(
        0.3,
        "1",
        "largest speed along the ground, in that along the normal: friction takes energy and tips",
        BY_ARGUMENT,
    )
    apart_s: float = threshold(0.1, "s", "longest time between the last frame of a flight and the first of the next")
    clear_sigmas: float = threshold(2.0, "sigma", "height of the lowest corner in a frame of the next", BY_ARGUMENT)


@dataclass(frozen=True, kw_only=True)
class ChoiceThresholds:
    """A fit estimates more than the contact: mass distribution, scale of lengths."""

    level: float = threshold(
        0.01,
        "1",
        "level of the t test of the held-out gains of the episodes",
        "by argument: seven sets are compared",
        "0 of 36 captures of 10 or 30 tosses with nothing hidden choose a part: 12 of this engine, 24 of MuJoCo",
        (0, 36),
    )
    least_share: float = threshold(
        0.02,
        "1",
        "smallest fall of the held-out misfit, as a share, for which a parameter is added",
        BY_ARGUMENT,
        "of MuJoCo's softest contact, a scale explains 1 % beyond chance in 2 of 6",
    )
    least_episodes: int = threshold(8, "episodes", "fewest tosses with measured rotation", BY_ARGUMENT)
    looked_at: int = threshold(16, "episodes", "most of which flights are compared", BY_ARGUMENT)
    least_errors: float = threshold(
        3.0,
        "standard errors",
        "centre of mass or moments that were chosen are not taken over unless one of their numbers differs by this "
        "much from what the capture gives",
        BY_ARGUMENT,
    )
    worse_chi2: float = threshold(
        25.0,
        "chi2",
        "a mass distribution that was chosen is not taken over where flights of most episodes fit worse with it, and "
        "of all but the worst by more than this together, in units of chi2 / dof: five standard errors",
        BY_ARGUMENT,
        "a box in MuJoCo and a bouncing ball, whose moments first contacts had changed by 30 and 3 %: 158,000, 6,100",
    )


@dataclass(frozen=True, kw_only=True)
class BounceThresholds:
    """A turn of a ball's height is a bounce, and which frames beside it belong to its flights."""

    near_m: float = threshold(0.03, "m", "height over the ground, beside the fall in one frame, up to which it bounces")
    slowest_m_s: float = threshold(0.4, "m/s", "slowest fall before a bounce")
    least_rise: float = threshold(0.1, "1", "slowest rise after it, as a share of the fall")
    least_frames: int = threshold(4, "frames", "fewest of a flight on each side of a bounce")
    apart_s: float = threshold(0.004, "s", "time about the lowest frame that may lie within the contact")
    longest_s: float = threshold(
        0.3, "s", "longest part of a flight that gives the speed at a bounce", "drag and spin change with the speed"
    )
    least_restitution: float = threshold(
        0.2,
        "1",
        "restitution from which flights give it; below, most impacts have no flight after them",
        BY_ARGUMENT,
    )
    most_error: float = threshold(
        0.1, "1", "standard error of the restitution up to which bounces give it", BY_ARGUMENT
    )


@dataclass(frozen=True, kw_only=True)
class DescribedThresholds:
    """A model does not describe the motion at all."""

    longest_s: float = threshold(1.5, "s", "part of an episode that is predicted", BY_ARGUMENT)
    times_worse: float = threshold(
        2.0, "1", "open-loop error in units of that of a body that stands still or keeps its velocity", BY_ARGUMENT
    )
    sizes_worse: float = threshold(0.1, "sizes", "tolerance of `times_worse` in addition", BY_ARGUMENT)
    episodes_worse: float = threshold(0.75, "1", "share of the episodes in which it has to be so", BY_ARGUMENT)
    touch_m: float = threshold(1e-4, "m", "change of the predicted motion by contact that is one", BY_ARGUMENT)
    touched_share: float = threshold(
        0.25, "1", "share of the episodes with contact of which a model without any says nothing", BY_ARGUMENT
    )
    level_s: float = threshold(0.2, "s", "time at one height that shows a support", BY_ARGUMENT)
    level_share: float = threshold(
        0.3, "1", "change of height that is none, as a share of that of free fall about its highest point", BY_ARGUMENT
    )
    turn_m_s: float = threshold(
        0.2, "m/s", "speed from falling to rising between two neighbouring pieces of a track: a bounce", BY_ARGUMENT
    )
    turn_sigmas: float = threshold(5.0, "standard errors", "the same: at least so many", BY_ARGUMENT)
    near_sizes: float = threshold(
        0.1, "sizes", "distance to what could be touched from which shape or ground are named as the cause", BY_ARGUMENT
    )
    inside_sizes: float = threshold(0.2, "sizes", "the same inside of it", BY_ARGUMENT)


@dataclass(frozen=True, kw_only=True)
class SlowErrorThresholds:
    """Tracking errors have a slow part."""

    evidence: float = threshold(
        20.0,
        "2 log L",
        "twice the gain of the log-likelihood from which a slow process is part of the noise: as for fast ones",
        BY_ARGUMENT,
    )
    sway_evidence: float = threshold(
        14.0,
        "2 log L",
        "the same for an acceleration of each flight's own: one parameter, odds of 1,000",
        BY_ARGUMENT,
    )
    least_episodes: int = threshold(
        3, "episodes", "fewest that tell what differs between them from what is common", BY_ARGUMENT
    )
    least_frames: int = threshold(
        60,
        "frames",
        "fewest of all flights, as for the size of the noise; and fewest values beside states and common effects, for "
        "which frames are thinned out less",
        "by argument; 20 measured tosses of a cube were left with 13 values, and their tilts with no evidence",
    )
    better_law: float = threshold(
        0.05,
        "probability",
        "what repeats from episode to episode is a constant force unless another law predicts held-out episodes better "
        "by a paired t-test with a p-value below it",
        BY_ARGUMENT,
    )
    unsound: float = threshold(
        6.0,
        "1",
        "flights whose variance, beside all that effects could do in them, is this many times that of the quietest "
        "quarter are left out: they hold a contact, a hand or smoothed bursts",
        "by argument: they would count for a sixth of the others",
    )


@dataclass(frozen=True, kw_only=True)
class SessionThresholds:
    """Sessions have scales of lengths of their own, which the interval of an effect allows for."""

    least_episodes: int = threshold(2, "episodes", "fewest of a session that tell its scale", BY_ARGUMENT)
    usual_scale: float = threshold(
        3e-3,
        "1",
        "usual standard deviation between the scales of sessions that differ, which counts for `usual_counts` degrees "
        "of freedom beside what flights show of it",
        "by argument: calibrations with a board or a wand agree to some tenths of a per cent",
    )
    usual_counts: float = threshold(
        1.0,
        "sessions",
        "degrees of freedom for which the usual standard deviation counts",
        "by computation: with 1 the intervals of the mean over two sessions hold in 90 to 100 % for standard "
        "deviations of 0.001 to 0.01, with 4 in 72 to 100 %",
    )


@dataclass(frozen=True, kw_only=True)
class ImpulseErrorThresholds:
    """What counts as an error of the impulse of an impact."""

    freedom: float = threshold(
        3.0,
        "1",
        "degrees of freedom of Student's t, by which errors of impulses are distributed",
        "by argument: the fewest with a variance",
        "scores of 4 development captures with 8 and with infinitely many differ by at most an eighth",
    )
    arm: float = threshold(
        0.3,
        "sizes",
        "lever arm of errors that turn a body, per share of the normal impulse",
        "by argument: in a corner that strikes instead of another one the impulse moves by as much",
    )


@dataclass(frozen=True, kw_only=True)
class SegmentThresholds:
    """All thresholds on segments that decide a verdict."""

    input: InputThresholds = InputThresholds()
    """Input checks."""
    carried: CarriedThresholds = CarriedThresholds()
    """Beginnings in a hand."""
    preparation: PreparationThresholds = PreparationThresholds()
    """Preparation and linearization."""
    phases: PhaseThresholds = PhaseThresholds()
    """Phases of contact."""
    sliding_data: SlidingSegmentThresholds = SlidingSegmentThresholds()
    """Sliding segments."""
    impact_data: ImpactDataThresholds = ImpactDataThresholds()
    """Impacts of a ball."""
    flat_impacts: FlatImpactThresholds = FlatImpactThresholds()
    """Impacts of a body flat on a face."""
    choice: ChoiceThresholds = ChoiceThresholds()
    """What a fit estimates."""
    bounce: BounceThresholds = BounceThresholds()
    """Bounces of a ball, with or without its orientation."""
    described: DescribedThresholds = DescribedThresholds()
    """Whether a model describes the motion."""
    slow_errors: SlowErrorThresholds = SlowErrorThresholds()
    """Slow errors of flights."""
    impulse_errors: ImpulseErrorThresholds = ImpulseErrorThresholds()
    """Errors of the impulses of impacts."""
    sessions: SessionThresholds = SessionThresholds()
    """Scales of sessions."""


SEGMENT_THRESHOLDS = SegmentThresholds()
"""The thresholds in use."""
