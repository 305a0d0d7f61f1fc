"""The table of the benchmark `fall_push.py` over engines: every row by task, pooled and against each engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from contenders.rows import REFERENCE
from numpy.typing import NDArray

POOLED_WITHOUT = ("mujoco", "mujoco_default")
"""The rivals of the table are fitted in MuJoCo: where it is the judge, they know the law."""
_RESAMPLES = 4000
_HEADER = (
    "| row | captures | trans mm | rot ° | object PSNR dB | friction error % | intervals that hold | "
    f"trans − {REFERENCE} mm | rot − {REFERENCE} ° |\n|---|---|---|---|---|---|---|---|---|"
)

Errors = dict[tuple[str, ...], dict[str, float]]
"""Medians over the episodes of each capture."""


def engine_table(results: Sequence[dict[str, Any]], names: dict[str, Sequence[str]]) -> str:
    """Return the tables of every task in Markdown: pooled over the engines that are not MuJoCo, then by engine.

    Args:
        results: Stored results.
        names: The tasks, objects, materials, engines and rows to show.
    """
    shown = [
        row
        for row in results
        if row.get("engine", "mujoco") in names["engines"]
        and all(row.get(one) in names[f"{one}s"] for one in ("task", "object", "material", "row"))
        and "not_run" not in row
    ]
    parts = [
        "Medians over the test episodes of each capture, then median (mean) over captures. Differences are paired by "
        "capture: median, and 95 % interval of a bootstrap over captures; above 0 the row is worse."
    ]
    for task in names["tasks"]:
        others = [engine for engine in names["engines"] if engine not in POOLED_WITHOUT]
        groups = [("all engines but MuJoCo", others)] if len(others) > 1 else []
        groups += [(engine, [engine]) for engine in names["engines"]]
        for title, engines in groups:
            here = [row for row in shown if row["task"] == task and row.get("engine", "mujoco") in engines]
            lines = [_line(name, here) for name in names["rows"] if any(row["row"] == name for row in here)]
            if lines:
                parts.append("\n".join((f"**{task}, {title}**\n", _HEADER, *lines)))
    return "\n\n".join(parts) if len(parts) > 1 else "No results yet."


def _line(name: str, rows: Sequence[dict[str, Any]]) -> str:
    mine, reference = captures_of(rows, name), captures_of(rows, REFERENCE)
    chosen = [row for row in rows if row["row"] == name]
    failed = sum("failed" in row for row in chosen)
    cells = [f"{len(mine)}" + (f" ({failed} failed)" if failed else "")]
    for key, decimals in (("translation_mm", 1), ("rotation_deg", 1), ("psnr_object_db", 2)):
        values = [one[key] for one in mine.values() if key in one]
        cells.append(f"{np.median(values):.{decimals}f} ({np.mean(values):.{decimals}f})" if values else "–")
    known = [row for row in chosen if "friction" in row.get("parameter_errors", ())]
    friction = [abs(row["parameter_errors"]["friction"]) for row in known]
    cells.append(f"{100 * np.median(friction):.0f}" if friction else "–")
    hold = [one for row in chosen if "failed" not in row for one in held(row)]
    cells.append(f"{sum(hold)} of {len(hold)}" if hold else "–")
    for key in ("translation_mm", "rotation_deg"):
        cells.append("" if name == REFERENCE else _difference(mine, reference, key))
    return f"| {name} | " + " | ".join(cells) + " |"


def captures_of(rows: Sequence[dict[str, Any]], name: str) -> Errors:
    """Return the medians of a row's captures; episodes that diverged count as infinitely wrong."""
    result: Errors = {}
    for row in rows:
        if row["row"] != name or "failed" in row:
            continue
        capture = tuple(str(row.get(key, "mujoco")) for key in ("engine", "task", "object", "material", "seed"))
        result[capture] = {
            key: float(np.median([episode.get(key, np.inf) for episode in row["episodes"]]))
            for key in ("translation_mm", "rotation_deg", "psnr_object_db")
            if any(key in episode for episode in row["episodes"])
        }
    return result


def held(row: dict[str, Any]) -> list[bool]:
    """Return which of a fit's intervals of friction hold the truth: the number that every engine knows."""
    interval = row["fit"].get("intervals_95", {}).get("friction")
    error = row["parameter_errors"].get("friction")
    if interval is None or error is None:
        return []
    true = row["fit"]["parameters"]["friction"] / (1 + error)
    return [bool(interval[0] <= true <= interval[1])]


def _difference(mine: Errors, reference: Errors, key: str) -> str:
    both = [c for c in mine if c in reference and key in mine[c] and key in reference[c]]
    gaps = np.array([mine[capture][key] - reference[capture][key] for capture in both])
    gaps = gaps[np.isfinite(gaps)]
    if len(gaps) < 2:
        return "–"
    low, high = bootstrap_interval(gaps)
    return f"{np.median(gaps):+.1f} ({low:+.1f} to {high:+.1f})"


def bootstrap_interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the 95 % percentile interval of the median of values, resampled with replacement."""
    rng = np.random.default_rng(0)
    medians = np.median(rng.choice(values, (_RESAMPLES, len(values))), axis=1)
    low, high = np.percentile(medians, (2.5, 97.5))
    return float(low), float(high)
