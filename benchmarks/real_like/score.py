"""Score answers to real-like captures against the truth: `python score.py truth.json answers.json`.

Needs nothing but Python and numpy, and is part of what `benchmarks/missing_effects.py export` writes.

answers.json holds for each capture what a tool names, and what it says it cannot tell apart from that:

    {"c0001": {"named": ["linear_drag"], "aliases": [["linear_drag", "quadratic_drag"]], "unexplained": false}}

A name may end in `@episode` or `@group` where its number differs from episode to episode, or between the sessions. A
capture that is not answered counts as answered by nothing. How a capture is judged:

- right: every hidden effect is named, alone (exact) or in a group of aliases that are equivalent or nearly so in free
  flight (class), and nothing else is; "right, and more": something wrong beside;
- among: the same, but some only in another group that the tool says it cannot tell apart: honest, and not right;
- part: some hidden effect is named, not all; wrong: none is, but something else; silent: nothing is named. An effect
  in no library is right if nothing is named and `unexplained` is true, silent if nothing is said at all;
- a null is right if nothing is named. What a capture carries may be named everywhere: the scale of sessions, and tilts
  of episodes as `@episode` or `@group`; what the engine's contact implies as well. They count neither way.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

EQUIVALENT = (
    {"gravity_scale", "buoyancy", "length_scale", "clock_scale", "constant_force"},
    {"gravity_tilt", "frame_tilt", "constant_force", "wind"},
    {"com_offset", "marker_offset"},
    {"linear_drag", "quadratic_drag", "wind"},
)
"""Classes whose members a flight cannot or can hardly tell apart: naming the class is right."""
LARGEST_CLASS = 5
"""No group of aliases larger than this counts: to name everything is to name nothing."""
BINS = ((0.0, 3.0), (3.0, 10.0), (10.0, 30.0), (30.0, np.inf))
"""Of the ratio of what an effect moves to the slow error; of a pair the smaller one."""
RIGHT = ("right", "right, and more")
MARKS = ("right", "right, and more", "among", "part", "wrong", "silent")


def judge(truth: dict[str, Any], answer: dict[str, Any] | None) -> dict[str, Any]:
    """Return how an answer stands to the truth of its capture: `mark` of `MARKS`, `false` names, `exact` ones."""
    answer = answer or {}
    named = list(answer.get("named", ()))
    classes = {name: _class_of(name, answer.get("aliases", ())) for name in named}
    hidden = [effect["name"] for effect in truth["effects"] if not effect.get("unknown")]
    strange = any(effect.get("unknown") for effect in truth["effects"])
    along = {name for effect in truth["effects"] for name in effect.get("comes_with", ())}
    along |= set(truth["engine"].get("comes_with", ()))
    allowed = {*hidden, *along}
    false = [name for name in named if not _plain(classes[name]) & allowed and not _carried(classes[name], truth)]
    found = {effect: _found(effect, classes) for effect in hidden}
    if hidden:
        mark = _mark(list(found.values()), false)
    elif strange:
        mark = "wrong" if false else "right" if answer.get("unexplained") else "silent"
    else:
        mark = "wrong" if false else "right"
    return {"mark": mark, "false": false, "exact": sorted(name for name, how in found.items() if how == "exact")}


def _mark(found: Sequence[str | None], false: Sequence[str]) -> str:
    """Return the mark of a capture with hidden effects, from how each is named."""
    if None not in found:
        if "among" in found:
            return "part" if false else "among"
        return "right, and more" if false else "right"
    return "part" if any(found) else "wrong" if false else "silent"


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (Wilson 1927)."""
    if not total:
        return 0.0, 1.0
    z, rate = 1.959963984540054, count / total
    middle, spread = rate + z * z / (2 * total), z * np.sqrt(rate * (1 - rate) / total + (z / (2 * total)) ** 2)
    scale = 1 + z * z / total
    return max(0.0, float((middle - spread) / scale)), min(1.0, float((middle + spread) / scale))


def ratio_of(truth: dict[str, Any]) -> float | None:
    """Return the smallest ratio of what an effect moves to the slow error, None for a null."""
    return min((effect["ratio"] for effect in truth["effects"]), default=None)


def table(truths: dict[str, Any], answers: dict[str, Any]) -> str:
    """Return a table of rows (kinds of capture), one of nulls by engine, and recall against the ratio, as Markdown."""
    judged = {key: judge(truth, answers.get(key)) for key, truth in truths.items()}
    rows = list(dict.fromkeys(truth["row"] for truth in truths.values()))
    lines = ["| captures | n | " + " | ".join(MARKS) + " | right | a wrong name |", "|---" * (len(MARKS) + 4) + "|"]
    for row in rows:
        keys = [key for key, truth in truths.items() if truth["row"] == row]
        lines.append(_line(row, [judged[key] for key in keys]))
        if row == "null":
            for engine in sorted({truths[key]["engine_name"] for key in keys}):
                own = [judged[key] for key in keys if truths[key]["engine_name"] == engine]
                lines.append(_line(f"null, {engine}", own))
    known = {key for key, truth in truths.items() if truth["row"] in ("flight", "measurement", "contact", "pair")}
    if not known:
        return "\n".join(lines)
    lines += ["", "Recall against what the effect moves, in slow errors of the tracks:", ""]
    named = [row for row in rows if any(truths[key]["row"] == row for key in known)]
    bins = [f"{low:g} to {high:g}" if np.isfinite(high) else f"above {low:g}" for low, high in BINS]
    lines += ["| captures | " + " | ".join(bins) + " |", "|---" * (len(BINS) + 1) + "|"]
    for row in named:
        own = [key for key in known if truths[key]["row"] == row]
        cells = []
        for low, high in BINS:
            inside = [judged[key] for key in own if low <= (ratio_of(truths[key]) or 0.0) < high]
            cells.append(rate([one["mark"] in RIGHT for one in inside]))
        lines.append(f"| {row} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def rate(marks: Sequence[bool]) -> str:
    """Return "k of n (p %, low to high)", the 95 % interval Wilson's."""
    count, total = sum(marks), len(marks)
    if not total:
        return "-"
    low, high = wilson(count, total)
    return f"{count} of {total} ({100 * count / total:.0f} %, {100 * low:.0f} to {100 * high:.0f})"


def _line(name: str, judged: Sequence[dict[str, Any]]) -> str:
    counts = [str(sum(one["mark"] == mark for one in judged)) for mark in MARKS]
    right, wrong = [one["mark"] in RIGHT for one in judged], [bool(one["false"]) for one in judged]
    return f"| {name} | {len(judged)} | " + " | ".join(counts) + f" | {rate(right)} | {rate(wrong)} |"


def _class_of(name: str, aliases: Sequence[Sequence[str]]) -> set[str]:
    groups = [set(group) for group in aliases if name in group and len(group) <= LARGEST_CLASS]
    return groups[0] if groups else {name}


def _plain(names: set[str]) -> set[str]:
    return {name.partition("@")[0] for name in names}


def _found(effect: str, classes: dict[str, set[str]]) -> str | None:
    """Return how an effect is named: exact, class, among or not (None); a form by episode is not it."""
    for own in classes.values():
        if own == {effect}:
            return "exact"
    for own in classes.values():
        if effect in own and any(_plain(own) <= group for group in EQUIVALENT):
            return "class"
    return "among" if any(effect in own for own in classes.values()) else None


def _carried(names: set[str], truth: dict[str, Any]) -> bool:
    """Return whether a class of names says what the tracks carry beside noise."""
    carried = set(truth["errors"]["carried"])
    scoped = {name.partition("@")[0] for name in names if "@" in name}
    level = "tilt" in carried and bool(scoped & {"frame_tilt", "gravity_tilt"})
    return level or ("scale" in carried and "length_scale" in _plain(names))


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth")
    parser.add_argument("answers")
    words = parser.parse_args()
    with open(words.truth, encoding="utf-8") as file:
        truths = json.load(file)
    with open(words.answers, encoding="utf-8") as file:
        answers = json.load(file)
    strange = sorted(set(answers) - set(truths))
    if strange:
        print(f"answers to captures that do not exist: {', '.join(strange[:5])}", file=sys.stderr)
        return 2
    print(table(truths, answers))
    unanswered = sum(key not in answers for key in truths)
    if unanswered:
        print(f"\n{unanswered} of {len(truths)} captures are not answered: they count as answered by nothing.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
