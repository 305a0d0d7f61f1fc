"""Figures of `missing_effects.py` in docs/results-diagnosis.md: bars are cgwm's, rivals have the same rows beside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from real_like.score import RIGHT, judge, ratio_of, wilson
from render_results import record

LARGE_RATIO = 300**0.5
"""From this multiple of the slow error on an effect counts as large: the middle of 3 to 100 on a log scale."""
MOST_FALSE_NULLS, MOST_WRONG_UNKNOWN, LEAST_LARGE, LEAST_SMALL, LEAST_PAIRS = 0.02, 0.05, 0.9, 0.8, 0.8
MOST_RATIO = 0.5
OTHER_FORMULAS = {"ground_magnet", "adhesion", "stribeck_friction"}
"""Effects that the captures hide by another formula than the library's, whose numbers mean another thing: a power of
the height for an exponential, a ramp for a smooth one, the square of a speed for the speed. So does the drag of a box,
which captures have along each of its sides: of the number along a side, a flow along the diagonal feels 0.58."""
Row = dict[str, Any]


def record_figures(rows: Sequence[Row], command: str) -> None:
    """Record the figures of a report, all contenders, in benchmarks/results/real_like.jsonl.

    A figure of which the report has no capture stays as an older report has it.
    """
    for who in dict.fromkeys(row["contender"] for row in rows):
        own = [row for row in rows if row["contender"] == who]
        for figure in figures(who, own):
            if figure["value"] != "0 of 0":
                record("real_like", command=command, **figure)


def figures(who: str, rows: Sequence[Row]) -> Iterator[Row]:
    """Yield the figures of one contender as the arguments of `record`; what failed counts as answered by nothing."""
    judged = [(row["truth"], judge(row["truth"], row.get("answer"))) for row in rows]
    single = [pair for pair in judged if pair[0]["row"] in ("flight", "measurement")]
    large = [mark["mark"] in RIGHT for truth, mark in single if (ratio_of(truth) or 0.0) >= LARGE_RATIO]
    small = [mark["mark"] in RIGHT for truth, mark in single if (ratio_of(truth) or 0.0) < LARGE_RATIO]
    text = "real-like, effects of flight and measurement"
    yield _least(who, f"{text} that move a body by 17 slow errors or more, named", large, LEAST_LARGE)
    yield _least(who, f"{text} that move it by less, named", small, LEAST_SMALL)
    yield _least(who, "real-like, effects of contact, named", _right(judged, "contact"), None)
    yield _least(who, "real-like, pairs of effects, both named", _right(judged, "pair"), LEAST_PAIRS)
    unknown = [bool(mark["false"]) for truth, mark in judged if truth["row"] == "unknown"]
    yield _most(who, "real-like, effects in no library that get a wrong name", unknown, MOST_WRONG_UNKNOWN)
    for engine in sorted({truth["engine_name"] for truth, _ in judged}):
        alarms = [
            bool(mark["false"]) for truth, mark in judged if truth["row"] == "null" and truth["engine_name"] == engine
        ]
        yield _most(who, f"real-like, nothing hidden, motions of {engine}: a wrong name", alarms, MOST_FALSE_NULLS)
    tossed = [(truth, mark) for truth, mark in judged if truth["row"] == "tossed"]
    hidden = [mark["mark"] in RIGHT for truth, mark in tossed if truth["effects"]]
    yield _least(who, "real-like, fourteen throws, effects of flight and measurement, named", hidden, None)
    yield _most(who, "real-like, fourteen throws: a wrong name", [bool(mark["false"]) for _, mark in tossed], None)
    took = [bool(set(row.get("taken", ())) & set(mark["false"])) for row, (_, mark) in zip(rows, judged, strict=True)]
    yield _most(who, "real-like, all captures: the fit takes by itself what is not there", took, None)
    wrong = [bool(mark["false"]) for _, mark in judged]
    yield _most(who, "real-like, all captures: a wrong name", wrong, None)
    yield from _added(who, [row for row, (_, mark) in zip(rows, judged, strict=True) if mark["mark"] in RIGHT])


def _added(who: str, named: Sequence[Row]) -> Iterator[Row]:
    """Yield what adding the effects did where they were named rightly: errors of the test split, and intervals."""
    from diagnose import covered

    added = [row for row in named if "errors" in row]
    # of captures without an effect those count in which a scale or tilts that they carry were named
    hiding = [row for row in added if row["truth"]["effects"]]
    text, flown = "real-like, open-loop error on test episodes", " before the first contact"
    for key, where, some in (
        ("open_loop_m", "", added),
        ("flight_m", flown, added),
        ("open_loop_m", " of captures that hide an effect", hiding),
        ("flight_m", f"{flown} of captures that hide an effect", hiding),
    ):
        pairs = [(row["errors"]["before"].get(key), row["errors"]["after"].get(key)) for row in some]
        ratios = [after / before for before, after in pairs if before and after]
        if ratios:
            middle, spread = float(np.median(ratios)), np.percentile(ratios, (25, 75))
            yield {
                "figure": f"{text}{where}, with the named effect / without it",
                "value": round(middle, 2),
                "target": "" if where else f"at most {MOST_RATIO}",
                "met": None if where else middle <= MOST_RATIO,
                "note": f"median of {len(ratios)}, half lie within {spread[0]:.2f} to {spread[1]:.2f}",
            }
    text = "real-like, 95 % intervals of added parameters that contain the true value"
    for more, truth in (("", lambda row: row["truth"]["effects"]), (", where both mean the same", comparable)):
        held = [yes for row in added for yes in covered({**row, "truth": truth(row)})]
        if held:
            met = 0.9 <= sum(held) / len(held) <= 0.99
            yield _figure(who, text + more, held, wilson(sum(held), len(held)), "90 to 99 %", met, "")


def comparable(row: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the hidden effects of a row whose numbers mean the same in the truth and in what was named.

    Left out are laws of another formula, and laws with other constants. What sessions have of a scale of their own is
    not: an interval of an effect that does the same has to allow for their mean.
    """
    constants = {one["effect"]: one["constants"] for one in row["found"]["ranking"]}
    boxes = set() if row["truth"]["thing"] == "ball" else {"quadratic_drag"}

    def same(effect: dict[str, Any]) -> bool:
        given = constants.get(effect["name"], {})
        return all(abs(effect["values"].get(name, value) - value) < 1e-3 * abs(value) for name, value in given.items())

    return [one for one in row["truth"]["effects"] if one["name"] not in OTHER_FORMULAS | boxes and same(one)]


def _right(judged: Sequence[tuple[Row, Row]], row: str) -> list[bool]:
    return [mark["mark"] in RIGHT for truth, mark in judged if truth["row"] == row]


def _least(who: str, figure: str, marks: Sequence[bool], bar: float | None) -> Row:
    low, high = wilson(sum(marks), len(marks))
    bar = bar if who == "cgwm" and marks else None
    proven = "" if bar is None else ", proven" if low >= bar else ", not proven"
    met = None if bar is None else sum(marks) >= bar * len(marks)
    return _figure(who, figure, marks, (low, high), "" if bar is None else f"{100 * bar:g} %", met, proven)


def _most(who: str, figure: str, marks: Sequence[bool], bar: float | None) -> Row:
    low, high = wilson(sum(marks), len(marks))
    bar = bar if who == "cgwm" and marks else None
    proven = "" if bar is None else ", proven" if high <= bar else ", not proven"
    met = None if bar is None else sum(marks) <= bar * len(marks)
    return _figure(who, figure, marks, (low, high), "" if bar is None else f"at most {100 * bar:g} %", met, proven)


def _figure(
    who: str, figure: str, marks: Sequence[bool], interval: tuple[float, float], target: str, met: bool | None,
    proven: str,
) -> Row:  # fmt: skip
    share = f" ({100 * sum(marks) / len(marks):.0f} %)" if marks else ""
    return {
        "figure": figure if who == "cgwm" else f"{figure} ({who})",
        "value": f"{sum(marks)} of {len(marks)}{share}",
        "target": target,
        "met": met,
        "note": f"95 % interval {100 * interval[0]:.1f} to {100 * interval[1]:.1f} %{proven}",
    }
