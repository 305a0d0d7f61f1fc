"""The chart of what each part of a fitted world costs: how errors change where the truth replaces it, task by task.

    python benchmarks/budget_page.py         # prints the table and draws docs/error-budget-parts.svg

The stored rows, `benchmarks/budget_rows.jsonl`, are development captures of `swapped_parts.py`: the errors [mm, deg] of
their test motions in the fitted world, and with one part of it, or everything but the law of contact, as in truth.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from fall_push_engines import bootstrap_interval
from store import ROOT
from tabletop.capture import TASKS

STORED = ROOT / "benchmarks" / "budget_rows.jsonl"
CHART = ROOT / "docs" / "error-budget-parts.svg"
FITTED, EVERYTHING = "fitted", "everything"
PARTS = {"shape": "true shape", "friction": "true friction", "ground's numbers": "true contact time and damping ratio"}
PARTS |= {EVERYTHING: "everything but the law (floor)"}
_HEADS = ("position, mm", "rotation, deg")
_LEFT, _SCALE, _GAP, _BAR = 250, 180, 70, 22
_WIDTH = _LEFT + 2 * (_SCALE + _GAP)


def change(rows: Sequence[dict[str, Any]], part: str, place: int) -> tuple[float, float, float]:
    """Return how the median error of a capture changes with a true part: median over captures, 95 % interval.

    Args:
        rows: Captures.
        part: One of `PARTS`.
        place: 0 for positions [mm], 1 for rotations [deg].
    """
    middles = [
        [float(np.median([one[place] for one in row["errors"][name]])) for name in (part, FITTED)] for row in rows
    ]
    gaps = np.array([other - fitted for other, fitted in middles])
    return float(np.median(gaps)), *bootstrap_interval(gaps)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the changes by task and part in Markdown; below 0 is better."""
    lines = ["| task | captures | fitted: mm / deg | " + " | ".join(PARTS.values()) + " |"]
    lines.append("| --- " * (3 + len(PARTS)) + "|")
    for task, chosen in _by_task(rows):
        middle = np.median([np.median(row["errors"][FITTED], axis=0) for row in chosen], axis=0)
        cells = [task, str(len(chosen)), f"{middle[0]:.1f} / {middle[1]:.1f}"]
        cells += [", ".join(_interval(change(chosen, part, place)) for place in (0, 1)) for part in PARTS]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def chart(rows: Sequence[dict[str, Any]]) -> str:
    """Return the changes as an SVG: a bar for each part, a line for its interval; positions left, rotations right."""
    drawn, y = list[str](), 24
    reach = [
        max(abs(value) for _, some in _by_task(rows) for part in PARTS for value in change(some, part, place))
        for place in (0, 1)
    ]
    for place, words in enumerate(_HEADS):
        drawn.append(f'<text x="{_middle(place):.0f}" y="{y}" class="h" text-anchor="middle">{words}</text>')
    for task, some in _by_task(rows):
        y += 2 * _BAR
        drawn.append(f'<text x="10" y="{y}" class="h">{escape(task)} ({len(some)} captures)</text>')
        top = y + 6
        for part, words in PARTS.items():
            y += _BAR
            drawn.append(f'<text x="{_LEFT - 10}" y="{y + 4}" text-anchor="end">{escape(words)}</text>')
            for place in (0, 1):
                drawn.append(_bar(y, place, reach[place], change(some, part, place), part == EVERYTHING))
        drawn += [f'<path class="axis" d="M{_middle(place):.0f} {top}V{y + 8}"/>' for place in (0, 1)]
    style = (
        "text{font:13px sans-serif;fill:#222}.h{font-weight:bold}.part{fill:#4472a8}.floor{fill:#6b8e5a}"
        ".axis,.whisker{stroke:#222;fill:none}rect.page{fill:#fff}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {y + 24}" role="img">'
        f"<title>What true parts change, by task</title><style>{style}</style>"
        f'<rect class="page" width="{_WIDTH}" height="{y + 24}"/>' + "".join(drawn) + "</svg>\n"
    )


def _bar(y: int, place: int, reach: float, values: tuple[float, float, float], floor: bool) -> str:
    zero = _middle(place)
    middle, low, high = (zero + 0.5 * _SCALE * value / reach for value in values)
    left, width, kind = min(middle, zero), max(abs(middle - zero), 1), "floor" if floor else "part"
    return (
        f"<g><title>{_interval(values)}</title>"
        f'<rect x="{left:.1f}" y="{y - 6}" width="{width:.1f}" height="12" class="{kind}"/>'
        f'<path class="whisker" d="M{low:.1f} {y}H{high:.1f}M{low:.1f} {y - 4}v8M{high:.1f} {y - 4}v8"/>'
        f'<text x="{zero + 0.5 * _SCALE + 12:.0f}" y="{y + 4}">{values[0]:+.1f}</text></g>'
    )


def _middle(place: int) -> float:
    return _LEFT + 0.5 * _SCALE + place * (_SCALE + _GAP)


def _interval(values: tuple[float, float, float]) -> str:
    return "{:+.1f} ({:+.1f} to {:+.1f})".format(*values)


def _by_task(rows: Sequence[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    found = [(task, [row for row in rows if row["task"] == task]) for task in TASKS]
    return [*((task, some) for task, some in found if some), ("all three", list(rows))]


def main() -> int:
    """Print the table and draw the chart."""
    rows = [json.loads(line) for line in STORED.read_text(encoding="utf-8").splitlines()]
    print(table(rows))
    CHART.write_text(chart(rows), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
