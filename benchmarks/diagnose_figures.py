"""The figures of `diagnose.py` that docs/results-diagnosis.md shows, computed from its stored cases."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from render_results import record

RIGHT = ("exact", "class")
"""Judgements that count as right: the exact name, or exactly the effects equivalent to it; no additional effect."""
Row = dict[str, Any]


def record_figures(
    rows: Sequence[Row],
    *,
    acts: Callable[[str], str],
    bound: Callable[[int, int], float],
    covered: Callable[[Row], list[bool]],
    command: str,
) -> None:
    """Record the figures of a whole report in benchmarks/results/diagnose.jsonl.

    Args:
        rows: All cases of a report, with effects and without.
        acts: Of an effect's name: "flight", "measurement", "contact" or "unknown".
        bound: Of the numbers of alarms and of cases, the upper 95 % bound of the rate.
        covered: Of a case with an added effect, whether the interval of each parameter contains the true value.
        command: What measured them.
    """
    for figure in [*figures(rows, acts, bound), *_added(rows, covered)]:
        record("diagnose", command=command, **figure)


def figures(rows: Sequence[Row], acts: Callable[[str], str], bound: Callable[[int, int], float]) -> Iterator[Row]:
    """Yield the figures of a report as the arguments of `record`."""
    kinds: dict[str, list[Row]] = {"pairs": []}
    for row in rows:
        if row.get("effects"):
            kind = "pairs" if len(row["effects"]) > 1 else acts(row["effects"][0])
            kinds.setdefault(kind, []).append(row)
    right = "named exactly or up to equivalence"
    yield _share(f"effects that act in flight, {right}", kinds["flight"], "98 %", 0.98)
    yield _share(f"effects of the measurement, {right}", kinds["measurement"], "98 %", 0.98)
    large, small = (_of_size(kinds["contact"], size) for size in ("large", "small"))
    yield _share("large effects of contact, named", large, "80 %", 0.8)
    yield _share("small effects of contact, named", small)
    wrong = [sum(row["judged"] == "wrong" for row in some) for some in (large, small)]
    few = all(count <= 0.05 * len(some) for count, some in zip(wrong, (large, small), strict=True))
    yield {
        "figure": "effects of contact, named wrongly",
        "value": f"{sum(wrong)} of {len(large) + len(small)}",
        "target": "at most 5 %",
        "met": few,
    }
    yield _share("pairs of effects, both named", kinds["pairs"], "80 %", 0.8)
    yield _share("effects in no library, reported as unexplained", kinds["unknown"], "100 %", 1.0)
    nulls = [row for row in rows if row.get("magnitude") == "null"]
    alarms = sum(row["judged"] == "false alarm" for row in nulls)
    yield {
        "figure": "false alarms where nothing is missing",
        "value": f"{alarms} of {len(nulls)} ({100 * alarms / len(nulls):.0f} %)",
        "target": "at most 5 %",
        "met": alarms <= 0.05 * len(nulls),
        "note": f"95 % bound {100 * bound(alarms, len(nulls)):.1f} %",
    }
    yield {
        "figure": "time for a diagnosis of six tosses, median",
        "value": round(float(np.median([row["seconds"]["diagnose"] for row in rows if "seconds" in row])), 1),
        "unit": "s",
    }


def _added(rows: Sequence[Row], covered: Callable[[Row], list[bool]]) -> Iterator[Row]:
    """Yield what adding the named effect did to the errors on the test split, and how its intervals cover."""
    named = {"open_loop_m": ("open-loop error", 0.6), "state_fitted_m": ("state-fitted residual", None)}
    for key, (what, most) in named.items():
        pairs = [(row["errors"]["before"][key], row["errors"]["after"][key]) for row in rows if "errors" in row]
        ratios = [after / before for before, after in pairs if before and after]
        low, middle, high = np.percentile(ratios, (25, 50, 75)) if ratios else (np.nan,) * 3
        yield {
            "figure": f"{what} on test episodes, with the named effect / without it",
            "value": round(float(middle), 2),
            "target": "" if most is None else f"at most {most}",
            "met": None if most is None else bool(middle <= most),
            "note": f"median of {len(ratios)} cases; quartiles {low:.2f} and {high:.2f}",
        }
    held = [yes for row in rows if "errors" in row for yes in covered(row)]
    share = sum(held) / len(held) if held else float("nan")
    yield {
        "figure": "95 % intervals of added parameters that contain the true value",
        "value": f"{sum(held)} of {len(held)} ({100 * share:.0f} %)",
        "target": "90 to 99 %",
        "met": 0.9 <= share <= 0.99,
    }


def _of_size(rows: Sequence[Row], size: str) -> list[Row]:
    return [row for row in rows if row["magnitude"] == size]


def _share(figure: str, rows: Sequence[Row], target: str = "", least: float | None = None) -> Row:
    """Return how many of the cases were judged as right; by size in the note."""
    counts = {size: [row["judged"] in RIGHT for row in _of_size(rows, size)] for size in ("large", "small")}
    right, count = sum(map(sum, counts.values())), sum(map(len, counts.values()))
    sizes = [f"{size} {sum(some)} of {len(some)}" for size, some in counts.items() if some]
    silent = sum(row["judged"] == "silent" for row in rows)
    notes = [*(sizes if len(sizes) > 1 else ()), *([f"{silent} missed silently"] if silent else ())]
    return {
        "figure": figure,
        "value": f"{right} of {count} ({100 * right / count:.0f} %)",
        "target": target,
        "met": None if least is None else right >= least * count,
        "note": ", ".join(notes),
    }
