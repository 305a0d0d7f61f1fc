"""Thresholds as fields of frozen dataclasses: the value, and in the field's metadata what is known about it.

Those of the tracks' noise and of the cuts between flight and contact stand here; those of fits in
`segments/thresholds`, those of a diagnosis in `diagnose/thresholds`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

NOT_KNOWN, NOT_MEASURED, BY_ARGUMENT = "not known", "not measured alone", "by argument"


@dataclass(frozen=True, kw_only=True)
class Threshold:
    """What is known about a threshold."""

    name: str
    """Name of the field."""
    value: Any
    """The value in use."""
    unit: str
    """Unit of the value; "1" for ratios and counts."""
    decides: str
    """What the threshold decides."""
    calibrated_on: str
    """Data or argument that the value follows from."""
    error_rates: str
    """False alarms and misses, on data other than those of the calibration where nothing else is said."""
    false_alarms: tuple[int, int] | None
    """Number of false alarms, and of data sets without an effect that it was counted on; None where not counted."""


def threshold(
    value: Any,
    unit: str,
    decides: str,
    calibrated_on: str = NOT_KNOWN,
    error_rates: str = NOT_MEASURED,
    false_alarms: tuple[int, int] | None = None,
) -> Any:
    """Return a dataclass field with a value in use and what is known about it; see `Threshold`."""
    known = {
        "unit": unit,
        "decides": decides,
        "calibrated_on": calibrated_on,
        "error_rates": error_rates,
        "false_alarms": false_alarms,
    }
    return field(default=value, metadata=known)


def thresholds_of(group: Any) -> list[Threshold]:
    """Return the thresholds of a group, in their order."""
    return [Threshold(name=one.name, value=getattr(group, one.name), **one.metadata) for one in fields(group)]


@dataclass(frozen=True, kw_only=True)
class TrackNoiseThresholds:
    """Wrong frames, and correlation of the errors in time."""

    outlier_sigmas: float = threshold(
        6.0,
        "sigmas",
        "a frame this far from the cubic through its neighbours is a wrong measurement",
        "by argument: 2e-9 of normal errors",
    )
    longest_burst_s: float = threshold(
        0.1,
        "s",
        "longest row of wrong measurements in flight; a cubic follows the motion over no longer one",
        BY_ARGUMENT,
    )
    least_burst: int = threshold(
        2, "frames", "fewest wrong frames in such a row; a single one is told by itself", BY_ARGUMENT
    )
    burst_share: float = threshold(
        6.0,
        "1",
        "mean square of such a row, in usual ones, beside the smooth path of the whole flight",
        "by argument: as `unsound` of flights, and the odds of the rows that are looked at beside it",
    )
    burst_rest: float = threshold(
        2.0,
        "1",
        "largest mean square of the rest of its flight, in usual ones: what touched the body leaves more",
        "by argument: ten independent errors exceed it once in thirty flights",
    )
    burst_sides: tuple[float, float] = threshold(
        (3, 0.04),
        "frames, s",
        "fewest frames of a flight, and their least time, before and after such a row: a filter smears contacts as far",
        "by argument: as `smeared_s`",
    )
    burst_most: tuple[float, float] = threshold(
        (2, 0.34), "1", "most such rows of a flight, and most of its frames that they take together", BY_ARGUMENT
    )
    regular_times: float = threshold(
        0.8,
        "1",
        "errors of fast motion at the times of a regular clock, in those at the times stated, below which the clock is "
        "believed",
        "by argument: where stated times are right, those of a clock make errors larger, never smaller",
        "measured throws at 300 Hz whose times scatter by 0.3 ms: 0.13",
    )
    least_jitter: float = threshold(
        0.01, "frames", "scatter of stated times about a regular clock from which the two are compared", BY_ARGUMENT
    )
    usual_jitter: float = threshold(
        0.5,
        "1",
        "share of the likeliest errors of times that the median of short fast windows has to show: contacts and hands "
        "smear the ends of flights along the motion, too",
        "by argument; 10 of 44 real-like development captures with right times were said to have wrong ones without it",
    )
    seen_jitter: float = threshold(
        0.5,
        "sigmas",
        "smallest errors of times, times the usual speed, that are said beside those of the tracking",
        BY_ARGUMENT,
    )
    keep_sigmas: float = threshold(
        4.0,
        "sigmas",
        "of a first, robust estimate, above which residuals are left out of the final one",
    )
    neighbours: float = threshold(
        2.5,
        "standard errors",
        "excess of the correlation of neighbouring frames from which errors count as correlated",
        "by argument (residuals)",
    )
    enough: int = threshold(
        60,
        "1",
        "fewest residuals, or degrees of freedom of windows, for an estimate of noise",
        "by argument: a noise within 10 %",
    )
    sure_both: float = threshold(
        20.0,
        "2 log L",
        "rise by which errors count as correlated in time, of positions and rotations together",
        "noise four times larger along one axis reached 10",
        "development: 0 of 16 nulls with correlated errors and 0 of 8 with smoothed tracks flagged (15 of 16 and 2 of "
        "8 before); effects 18 of 18. Fresh seeds: 2 of 63 effects missed, in smoothed tracks",
    )
    sure_alone: float = threshold(
        6.0,
        "2 log L",
        "the same of each kind",
        "see `sure_both`",
        "see `sure_both`",
    )
    sure_filter: float = threshold(
        2 * math.log(100),
        "2 log L",
        "the same of a filter of the tracks over errors that last without one",
        "by argument: odds of 100",
    )
    cutoff_periods: float = threshold(
        1.2,
        "1 / cut-off",
        "how far a low pass bends a flight before and after a contact",
        "by argument: a bounce of 5 m/s is off by 0.2 mm there and by 1 mm after 0.8 (12 to 35 Hz); cut-offs are found "
        "to within a fifth",
    )
    told_by_window: float = threshold(
        0.5,
        "windows",
        "longest correlation time that is looked for: slower errors are curves in a window, which the polynomial takes "
        "away, and whole flights tell them",
        "by argument; in 20 measured tosses of 0.1 s, errors of 0.02 mm counted as 0.6 mm that last 130 ms",
    )
    likely: float = threshold(
        2.0,
        "log L",
        "the slowest correlation time among those within this of the best is used",
        "two thirds of the true correlation times lie within it",
    )
    wrong: float = threshold(
        9.0,
        "1",
        "windows whose mean square is this many times the median hold a contact or an outlier",
    )


@dataclass(frozen=True, kw_only=True)
class SegmentationThresholds:
    """Frames are flight or contact, and where a segment ends."""

    flight_s: float = threshold(
        0.60,
        "s",
        "longer flights are cut into equal parts",
        NOT_KNOWN,
        "where the tracks have slow errors, parts of one flight are joined again (`segments/flights/slow_errors`)",
    )
    least_flight_s: float = threshold(
        0.06,
        "s",
        "a shorter flight between two contacts determines no acceleration and belongs to the contact",
    )
    contact_s: float = threshold(0.10, "s", "longest contact segment")
    lead_s: float = threshold(
        0.03,
        "s",
        "flight before and after a contact that is included, to determine the velocities there",
    )
    least_frames: int = threshold(
        6,
        "frames",
        "fewest of a segment: its state uses up the information of two",
        BY_ARGUMENT,
    )
    gap: float = threshold(2.5, "median frame intervals", "a longer gap ends a segment, if it exceeds `gap_s`, too")
    gap_s: float = threshold(
        0.03,
        "s",
        "see `gap`: how long a body may be unseen does not depend on the frame rate",
        "by argument: whether it may have touched something meanwhile is asked of its next move (`move_share`)",
    )
    still: float = threshold(
        4.0,
        "standard errors",
        "nothing moves in a segment where the means of its halves differ by less",
    )
    kept_rests: int = threshold(2, "segments", "segments at rest in a row that are kept")
    move_share: float = threshold(
        0.75,
        "1",
        "a point within this share of its last or next move, plus noise, may have touched: whatever the bounce, "
        "one of its sides lies within half a move",
        "study of diagnosis, pitfall P1",
    )
    height_sigmas: float = threshold(
        3.0,
        "standard errors",
        "of the measured heights, by which that margin grows",
        "study of diagnosis, pitfall P1",
    )
    most_lift: float = threshold(
        0.5,
        "gravity",
        "a body above the ground whose acceleration differs from gravity by more is held or supported",
        "by argument: known effects in the air are weaker",
        "in the 38 real-like development captures 1894 frames counted as supported without `least_fall` and "
        "`kink_frames`, 622 with them",
    )
    lift_sigmas: float = threshold(
        5.0,
        "standard errors",
        "least size of that difference",
        BY_ARGUMENT,
        "see `most_lift`",
    )
    least_fall: float = threshold(
        0.2,
        "gravity",
        "downward acceleration of a parabola through all heights from which they are flight all the same",
        "by argument: a free fall is lowest at one of its ends",
        "see `most_lift`",
    )
    kink_frames: int = threshold(
        3,
        "frames",
        "on each side of a bounce above the ground that are no free fall",
        BY_ARGUMENT,
        "see `most_lift`",
    )


@dataclass(frozen=True, kw_only=True)
class TrackThresholds:
    """All thresholds that decide what tracks show."""

    track_noise: TrackNoiseThresholds = TrackNoiseThresholds()
    """Wrong frames, and correlation of the errors in time."""
    segmentation: SegmentationThresholds = SegmentationThresholds()
    """Flight and contact."""


TRACK_THRESHOLDS = TrackThresholds()
"""The thresholds in use."""
