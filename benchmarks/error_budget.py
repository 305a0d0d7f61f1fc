r"""The error budget of Fall, Push and Tip: what each thing that a fit does not know costs, one at a time.

    python benchmarks/fall_push.py --tasks fall,push,tip --engines rapier,mujoco,cgwm --captures 3 --seed 100 \
        --objects box,l_block,mustard_bottle,mug --psnr-every 10 \
        --rows "cgwm; floor; frozen; cgwm, true shape; cgwm, true mass; cgwm, true poses"
    python benchmarks/error_budget.py --store out/evidence/fall_push.jsonl --chart docs/error-budget.svg

Shape, mass and poses are true before the fit, friction in the prediction alone; the law is true where our own engine is
the truth. The start is not replaced by itself: predictions begin at the true one, and in the fit it is part of the
poses.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from contenders.rows import FLOOR, REFERENCE
from store import Store
from tabletop.capture import TASKS
from tabletop.engines import JUDGES

FRICTION, LAW = "true friction", "law of contact true (our engine as the truth)"
PARTS = ("true shape", "true mass", "true poses")
_RESAMPLES = 4000
_UNITS = (("translation_mm", "mm"), ("rotation_deg", "deg"))
_WIDTH, _BAR, _LEFT, _SCALE = 760, 20, 300, 170


@dataclass(frozen=True)
class Line:
    """What is known of one row in one task: medians of each capture [mm, deg], and errors of friction [1]."""

    name: str
    captures: dict[str, tuple[float, float]]
    friction: dict[str, float]
    paired: bool = True
    """Whether its captures are those of the reference."""

    def at(self, captures: set[str]) -> Line:
        """Return the line on some captures."""
        kept = {name: value for name, value in self.captures.items() if name in captures}
        return replace(self, captures=kept, friction={k: v for k, v in self.friction.items() if k in captures})

    def middle(self, place: int) -> float:
        """Return the median over captures [mm] for 0, [deg] for 1."""
        return float(np.median([one[place] for one in self.captures.values()]))


def budget(results: Sequence[dict[str, Any]], task: str) -> list[Line]:
    """Return the lines of a task, the reference first and the floor last, on the captures that all of them have.

    Lines without results are left out; those against our own engine have captures of their own.
    """
    rows = [row for row in results if row["task"] == task and "episodes" in row]
    judged = [row for row in rows if row["engine"] in JUDGES]
    reference = [row for row in judged if row["row"] == REFERENCE]
    lines = [_line(REFERENCE, reference)]
    lines.append(Line(FRICTION, {_capture(r): _medians(r["true_friction"]) for r in reference}, {}))
    lines += [_line(part, [r for r in judged if r["row"] == f"{REFERENCE}, {part}"]) for part in PARTS]
    own = [row for row in rows if row["engine"] == "cgwm" and row["row"] == REFERENCE]
    lines.append(_line(LAW, own, paired=False))
    lines.append(_line("all true but the law (floor)", [row for row in judged if row["row"] == FLOOR]))
    lines = [line for line in lines if line.captures]
    common = set.intersection(*(set(line.captures) for line in lines if line.paired)) if lines else set()
    return [line.at(common) if line.paired else line for line in lines] if common else []


def _line(name: str, rows: Sequence[dict[str, Any]], paired: bool = True) -> Line:
    errors = {_capture(row): row["parameter_errors"].get("friction") for row in rows}
    friction = {capture: abs(error) for capture, error in errors.items() if error}
    return Line(name, {_capture(row): _medians(row["episodes"]) for row in rows}, friction, paired)


def _capture(row: dict[str, Any]) -> str:
    return "/".join(str(row[key]) for key in ("engine", "object", "material", "seed"))


def _medians(episodes: Sequence[dict[str, Any]]) -> tuple[float, float]:
    """Return the medians over episodes; those that diverged count as infinitely wrong."""
    first, second = (float(np.median([one.get(key, np.inf) for one in episodes])) for key, _ in _UNITS)
    return first, second


def saved(line: Line, reference: Line, place: int) -> tuple[float, float, float] | None:
    """Return how much smaller a line's error is than the reference's: median over captures, and its 95 % interval."""
    common = sorted(set(line.captures) & set(reference.captures))
    if not line.paired or not common or line is reference:
        return None
    gain = np.array([reference.captures[one][place] - line.captures[one][place] for one in common])
    draws = np.random.default_rng(0).integers(0, len(gain), (_RESAMPLES, len(gain)))
    low, high = np.percentile(np.median(gain[draws], axis=1), (2.5, 97.5))
    return float(np.median(gain)), float(low), float(high)


def table(results: Sequence[dict[str, Any]]) -> str:
    """Return the budget of every task in Markdown."""
    lines = [
        "| task | true | captures | mm | deg | friction error % | saves mm | saves deg |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for task in TASKS:
        found = budget(results, task)
        for line in found:
            friction = f"{100 * np.median(list(line.friction.values())):.0f}" if line.friction else "–"
            cells = [
                task,
                line.name,
                str(len(line.captures)),
                f"{line.middle(0):.1f}",
                f"{line.middle(1):.1f}",
                friction,
            ]
            cells += [_interval(saved(line, found[0], place)) for place in (0, 1)]
            lines.append("| " + " | ".join(cells) + " |")
    missing = sorted({f"{_capture(row)}/{row['task']}: {row['not_run']}" for row in results if "not_run" in row})
    missing += sorted({f"{_capture(r)}/{r['task']}/{r['row']} failed: {r['failed']}" for r in results if "failed" in r})
    return "\n".join((*lines, *(f"Not run: {reason}" for reason in missing)))


def _interval(values: tuple[float, float, float] | None) -> str:
    return "–" if values is None else "{:.1f} ({:.1f} to {:.1f})".format(*values)


def chart(results: Sequence[dict[str, Any]]) -> str:
    """Return the budget as an SVG: bars of the median errors, position to the left and rotation to the right."""
    parts, y = [], 40
    parts.append(f'<text x="{_LEFT}" y="20" class="h">position, mm</text>')
    parts.append(f'<text x="{_LEFT + _SCALE + 60}" y="20" class="h">rotation, deg</text>')
    for task in TASKS:
        lines = budget(results, task)
        if not lines:
            continue
        parts.append(f'<text x="10" y="{y + 4}" class="h">{task}</text>')
        most = [max(line.middle(place) for line in lines) for place in (0, 1)]
        for line in lines:
            y += _BAR
            parts.append(f'<text x="{_LEFT - 10}" y="{y + 4}" text-anchor="end">{escape(line.name)}</text>')
            for place, left in ((0, _LEFT), (1, _LEFT + _SCALE + 60)):
                value = line.middle(place)
                length = _SCALE * value / max(most[place], 1e-9)
                kind = "base" if line is lines[0] else "floor" if line is lines[-1] else "part"
                parts.append(
                    f'<rect x="{left}" y="{y - 8}" width="{length:.1f}" height="{_BAR - 6}" class="{kind}"/>'
                    f'<text x="{left + length + 4:.1f}" y="{y + 4}">{value:.1f}</text>'
                )
        y += 2 * _BAR
    style = (
        "text{font:13px sans-serif;fill:#222}.h{font-weight:bold}.base{fill:#b5482f}.part{fill:#4472a8}"
        ".floor{fill:#6b8e5a}rect.page{fill:#fff}"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {y}" role="img">'
        f'<title>Error budget by task</title><style>{style}</style><rect class="page" width="{_WIDTH}" height="{y}"/>'
        + "".join(parts)
        + "</svg>\n"
    )


def main() -> int:
    """Print the table of what is stored, and draw the chart."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, default=None, help="file of the results of fall_push.py")
    parser.add_argument("--seed", type=int, default=100, help="of the captures")
    parser.add_argument("--any-commit", action="store_true", help="take results of other commits, too")
    parser.add_argument("--chart", type=Path, default=None, help="file of the chart, SVG")
    given = parser.parse_args()
    results = [row for row in Store("fall_push", given.store, given.any_commit).results() if row["seed"] == given.seed]
    print(table(results))
    if given.chart is not None:
        given.chart.write_text(chart(results), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
