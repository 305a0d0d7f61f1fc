"""The engine table as a page: takes rows of `fall_push.py`, reduced, and writes docs/engine-table.md from them.

    python benchmarks/engine_page.py take out/evidence/fall_push.jsonl   # adds or replaces rows
    python benchmarks/engine_page.py                                     # writes the page

Rows keep the errors of every episode, the friction with its interval, seconds and commit, so that
`fall_push.py --table --by-engine --any-commit --store benchmarks/engine_rows.jsonl` prints its tables from them, too.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from contenders.rows import FLOOR, PUBLISHED, PUBLISHED_FIXED, REFERENCE, REFINED
from fall_push_engines import POOLED_WITHOUT, Errors, bootstrap_interval, captures_of, held
from numpy.typing import NDArray
from store import ROOT

STORED = ROOT / "benchmarks" / "engine_rows.jsonl"
PAGE = ROOT / "docs" / "engine-table.md"
ROWS = {
    REFERENCE: "cgwm",
    FLOOR: "floor",
    "frozen": "nothing moves",
    "CEM + MuJoCo + R, true mesh, 1x": "CEM, true mesh",
    "CEM + MuJoCo + R, learned shape, 1x": "CEM, learned shape",
    REFINED: "geometry refined",
    PUBLISHED: "as published",
    PUBLISHED_FIXED: "paper's law, geometry fixed",
    "PIN-WM": "PIN-WM",
    "PIN-WM, 4x": "PIN-WM, 4x",
    "DreamerV3, 100 true trajectories": "DreamerV3",
    "DreamerV3, 100 true trajectories, 4x": "DreamerV3, 4x",
}
"""Rows of the page, in its order, and their names there."""
LATER = "cgwm, later code"
"""cgwm's row of an earlier report, fitted again."""
ROWS[LATER] = "fitted again"
LEARNED = tuple(name for name in ROWS if name.startswith(("PIN-WM", "DreamerV3")))
DRAWN = 12
"""Captures of the learned rivals, in all."""
TASKS = ("fall", "push", "tip")
ENGINES = ("rapier", "dart", "mujoco")
WANTED = 8
"""Captures of every engine and task."""
FRESH = 600
"""Seed from which on captures are a later report, which has a section of its own."""
_MM, _DEG, _DB = "translation_mm", "rotation_deg", "psnr_object_db"
_DECIMALS = {_MM: 1, _DEG: 1, _DB: 2}
_INTRODUCTION = (
    "# The engine table\n\n"
    "Written by `benchmarks/engine_page.py` from the stored rows `benchmarks/engine_rows.jsonl`. What the rows are, "
    "and what follows from them: [Other engines as the truth](engine-floor.md).\n\n"
    "mm / deg: medians over the ten test motions of a capture, then over captures, whose number stands in brackets. "
    "Differences to cgwm are paired by capture: median, and 95 % interval of a bootstrap over captures; for mm and deg "
    "the row is worse above 0, for dB below. *As published* is `phys-geo.contact_law=paper`, with the joint refinement "
    "of geometry; *paper's law, geometry fixed* is the same without it. *Fitted again* is cgwm by "
    "later code, from the same spheres. In the tables with all columns, the mean over "
    "captures stands in brackets behind mm / deg.\n\n"
    "One command measures every row, in pieces: it takes up what is stored, begins nothing after its time, and can be "
    "killed. The rows of PIN-WM and DreamerV3 are asked for by their names in the same way, once their code is there "
    "([The rivals themselves](rivals.md)); DART, Rapier and MuJoCo are in `benchmarks/requirements.txt`.\n\n"
    "<!-- illustrative: takes ten minutes on 16 cores and a GPU, and gets through a part -->\n"
    "```sh\n"
    "python benchmarks/fall_push.py --device cuda --tasks fall,push,tip --engines rapier,dart,mujoco \\\n"
    "    --objects box,l_block,mustard_bottle,mug --captures 8 --seed 500 --psnr-every 10 --any-commit \\\n"
    "    --workers 16 --seconds 480 --folder out/fall_push --drafts out/drafts \\\n"
    '    --rows "{rows}"\n'
    "python benchmarks/engine_page.py take out/evidence/fall_push.jsonl\n"
    "```\n\n"
    "Failures with pictures: [Where it fails](engine-floor.md#where-it-fails); what costs most, as a chart: "
    "[Error budget](error-budget.md); object PSNR over the horizon: [Few photos](error-budget.md#few-photos)."
)
_JOINT = (
    "## Joint refinement of geometry\n\n"
    "The colliding spheres that touch are refined with the pictures, through the motion: the same fit with this and "
    "without it, by our law and by the paper's, in all engines. Differences are paired by capture: joint minus fixed."
)
_POOLED = (
    "row", "captures", "mm / deg", "object PSNR dB", "friction error %", "intervals that hold", "seconds",
    "to cgwm: mm", "deg", "dB",
)  # fmt: skip
_OVER = ("row", "engines", "captures", "mm", "deg", "object PSNR dB", "friction error %", "to cgwm: mm", "deg", "dB")
_SEEDS = (
    "seed, commit", "task", "captures", "cgwm / floor, mm", "deg", "PSNR to the floor's, dB", "friction error %",
    "intervals that hold",
)  # fmt: skip
_BARS = ("task", "captures", "cgwm / floor, mm", "cgwm / floor, deg", "PSNR to the floor's, dB")


def reduced(row: dict[str, Any]) -> dict[str, Any]:
    """Return what the page needs of a stored result."""
    kept = {key: row[key] for key in ("key", "commit", "task", "object", "material", "row", "seed", "device")}
    kept["engine"] = row.get("engine", "mujoco")
    if "not_run" in row or "failed" in row:
        return kept | {key: row[key] for key in ("not_run", "failed") if key in row}
    fit = row["fit"]
    numbers = {name: value for name, value in fit.get("parameters", {}).items() if name == "friction"}
    intervals = {name: value for name, value in fit.get("intervals_95", {}).items() if name == "friction"}
    kept["fit"] = {"seconds": fit.get("seconds"), "parameters": numbers, "intervals_95": intervals}
    kept["parameter_errors"] = {k: v for k, v in row["parameter_errors"].items() if k == "friction"}
    kept["episodes"] = [
        {key: round(episode[key], digits + 1) for key, digits in _DECIMALS.items() if key in episode}
        for episode in row["episodes"]
    ]
    return kept


def take(paths: Sequence[Path], stored: Path = STORED) -> int:
    """Add the rows of stores to the stored ones, a later one in place of an earlier one; return how many are there."""
    rows = {row["key"]: row for row in read(stored)} if stored.exists() else {}
    for path in paths:
        rows |= {row["key"]: reduced(row) for row in read(path) if row["row"] in ROWS}
    stored.write_text("".join(json.dumps(rows[key]) + "\n" for key in sorted(rows)), encoding="utf-8")
    return len(rows)


def read(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file of JSON lines."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Return the page in Markdown."""
    fresh, rows = [row for row in rows if row["seed"] >= FRESH], [row for row in rows if row["seed"] < FRESH]
    others = [row for row in rows if row["engine"] not in POOLED_WITHOUT]
    parts = [
        _INTRODUCTION.replace("{rows}", "; ".join(name for name in ROWS if name not in (*LEARNED, LATER))),
        "## All engines but MuJoCo",
    ]
    for task in TASKS:
        parts.append(f"**{task.capitalize()}**\n\n{_pooled([row for row in others if row['task'] == task])}")
    parts.append(f"**All three tasks**\n\n{_pooled(others)}")
    parts.append(f"**Against the floor**, on the captures that have both\n\n{_bars(others)}")
    parts.append(
        "## Over engines\n\nThe median over captures of each engine, MuJoCo among them; then the median and the mean "
        "over the engines that have the row. Differences are paired by capture, over all of them."
    )
    parts += [f"**{task.capitalize()}**\n\n{_over_engines(_of(rows, task=task))}" for task in TASKS]
    parts += ["## By engine", _by_engine(rows)]
    for task, engine in itertools.product(TASKS, ENGINES):
        here = _of(rows, task=task, engine=engine)
        if here:
            parts.append(f"**{task.capitalize()}, {engine}**\n\n{_pooled(here)}")
    parts += [_JOINT, _joint(rows)]
    if fresh:
        parts.append(
            "## Over seeds\n\nReports on captures of which nothing had been seen before, against Rapier and DART; and "
            f"the first of them fitted again by later code.\n\n{_over_seeds([*others, *fresh])}"
        )
        seeds = sorted({row["seed"] for row in fresh}, reverse=True)
        for seed in seeds:
            title = "Fresh captures" if seed == seeds[0] else f"An earlier report, seed {seed}"
            parts += _later(title, [row for row in fresh if row["seed"] == seed])
    parts += ["## Learned rivals by capture", _learned(rows)]
    parts += ["## Captures", _counts(rows), "## Not run", _not_run(rows)]
    return "\n\n".join(parts) + "\n"


def _joint(rows: Sequence[dict[str, Any]]) -> str:
    """Return what the joint refinement of geometry changes, by law and task."""
    lines = _head(("law", "task", "captures", "joint: mm / deg", "fixed: mm / deg", "joint - fixed: mm", "deg", "dB"))
    for law, joint, fixed in (("ours", REFINED, REFERENCE), ("the paper's", PUBLISHED, PUBLISHED_FIXED)):
        for task in (*TASKS, "all three"):
            here = [row for row in rows if task in (row["task"], "all three")]
            mine, other = captures_of(here, joint), captures_of(here, fixed)
            both = [capture for capture in mine if capture in other]
            if not both:
                continue
            mine, other = ({capture: one[capture] for capture in both} for one in (mine, other))
            cells = [law, task, str(len(both)), _middle(mine), _middle(other)]
            cells += [difference(mine, other, key) for key in (_MM, _DEG, _DB)]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _over_seeds(rows: Sequence[dict[str, Any]]) -> str:
    """Return cgwm beside the floor, its frictions and intervals by seed and task, and of all seeds together."""
    lines, every = _head(_SEEDS), list[dict[str, Any]]()
    floors = [row for row in rows if row["row"] == FLOOR]
    for seed in sorted({row["seed"] for row in rows}):
        for name in (REFERENCE, LATER):
            mine = [row | {"row": REFERENCE} for row in rows if (row["seed"], row["row"]) == (seed, name)]
            if not mine:
                continue
            commits = ", ".join(f"`{one[:7]}`" for one in sorted({row["commit"] for row in mine}))
            every += mine if name == REFERENCE else []
            lines += _seed_lines(f"{seed}{', again' if name == LATER else ''}, {commits}", mine, floors)
    lines += _seed_lines("all, as reported", every, floors)
    return "\n".join(lines)


def _seed_lines(title: str, mine: Sequence[dict[str, Any]], floors: Sequence[dict[str, Any]]) -> list[str]:
    lines = []
    for task in (*TASKS, "all three"):
        here = [row for row in (*mine, *floors) if task in (row["task"], "all three")]
        bars = _beside_the_floor(here)
        kept = [one for row in here if row["row"] == REFERENCE and "fit" in row for one in held(row)]
        error = _friction(here, REFERENCE)
        if bars is not None and error is not None:
            share = f"{sum(kept)} of {len(kept)} ({100 * sum(kept) / len(kept):.0f} %)"
            count, mm, deg, gap = bars
            lines.append(f"| {title} | {task} | {count} | {mm:.2f} | {deg:.2f} | {gap:+.2f} | {error:.0f} | {share} |")
    return lines


def _later(title: str, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the parts of the page of a later report: by task, all three, against the floor, and which captures."""
    seeds, commits = ({row[key] for row in rows} for key in ("seed", "commit"))
    words = "Captures of which nothing was seen before (seed {}), at {}, all engines together.".format(
        ", ".join(map(str, sorted(seeds))), ", ".join(f"`{one[:7]}`" for one in sorted(commits))
    )
    parts = [f"## {title}\n\n{words}"]
    parts += [f"**{task.capitalize()}**\n\n{_pooled(here)}" for task in TASKS if (here := _of(rows, task=task))]
    parts += [f"**All three tasks**\n\n{_pooled(rows)}", f"**Against the floor**\n\n{_bars(rows)}"]
    there = [" ".join((task, obj, ground, engine)) for engine, task, obj, ground, _ in captures_of(rows, REFERENCE)]
    return [*parts, "Captures: " + ", ".join(sorted(there)).replace("_", " ") + "."]


def _of(rows: Sequence[dict[str, Any]], **values: str) -> list[dict[str, Any]]:
    return [row for row in rows if all(row[key] == value for key, value in values.items())]


def _friction(rows: Sequence[dict[str, Any]], name: str) -> float | None:
    """Return the median error of friction of a row [%]; None where it finds none, or is given the true one."""
    known = [row for row in rows if row["row"] == name and "fit" in row and "friction" in row["parameter_errors"]]
    if name == FLOOR or not known:
        return None
    return 100 * float(np.median([abs(row["parameter_errors"]["friction"]) for row in known]))


def _over_engines(rows: Sequence[dict[str, Any]]) -> str:
    """Return medians by engine as their median and mean over the engines, and differences paired by capture."""
    lines, reference = _head(_OVER), captures_of(rows, REFERENCE)
    for name, shown in ROWS.items():
        mine = captures_of(rows, name)
        if not mine:
            continue
        each = [captures_of(_of(rows, engine=engine), name) for engine in ENGINES]
        each = [one for one in each if one]
        cells = [shown, str(len(each)), str(len(mine))]
        for key in (_MM, _DEG, _DB):
            middles = [
                float(np.median(values)) for one in each if (values := [m[key] for m in one.values() if key in m])
            ]
            cells.append(_median_mean(middles, _DECIMALS[key]))
        errors = [_friction(_of(rows, engine=engine), name) for engine in ENGINES]
        cells.append(_median_mean([one for one in errors if one is not None], 0))
        cells += [difference(mine, reference, key) if name != REFERENCE else "" for key in (_MM, _DEG, _DB)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _median_mean(values: Sequence[float], digits: int) -> str:
    return f"{np.median(values):.{digits}f}, {np.mean(values):.{digits}f}" if values else "–"


def _learned(rows: Sequence[dict[str, Any]]) -> str:
    """Return the learned rivals in each of their captures, mm / deg / dB, and how they differ from cgwm over all."""
    shown = [name for name in (REFERENCE, FLOOR, *LEARNED) if captures_of(rows, name)]
    rivals = [name for name in shown if name in LEARNED]
    found = {name: captures_of(rows, name) for name in shown}
    lines = _head(("capture", *(ROWS[name] for name in shown)))
    for capture in sorted(set().union(*(found[name] for name in rivals)), key=lambda one: (TASKS.index(one[1]), one)):
        engine, task, obj, ground, _ = capture
        cells = [
            " / ".join(f"{found[name][capture][key]:.1f}" for key in (_MM, _DEG, _DB))
            if capture in found[name]
            else "–"
            for name in shown
        ]
        lines.append(f"| {task}, {obj.replace('_', ' ')}, {ground}, {engine} | " + " | ".join(cells) + " |")
    lines += ["", *_head(("row", "captures", "worse than cgwm in", "to cgwm: mm", "deg", "dB"))]
    for name in rivals:
        gaps = paired(found[name], found[REFERENCE], _MM)
        cells = [difference(found[name], found[REFERENCE], key) for key in (_MM, _DEG, _DB)]
        lines.append(f"| {ROWS[name]} | {len(gaps)} | {int((gaps > 0).sum())} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _not_run(rows: Sequence[dict[str, Any]]) -> str:
    """Return which captures that cgwm has a row of lack another row; of learned rivals twelve were drawn."""
    lines = _head(("row", "captures", "not run"))
    every = captures_of(rows, REFERENCE)
    for name, shown in ROWS.items():
        mine = captures_of(rows, name)
        lacking = sorted(set(every) - set(mine))
        if name == REFERENCE or not lacking or (name in LEARNED and len(mine) >= DRAWN):
            continue
        if name in LEARNED:
            words = f"{DRAWN} were drawn, see [The learned rivals](engine-floor.md#the-learned-rivals-themselves)"
        else:
            places: dict[str, list[str]] = {}
            for engine, task, obj, ground, _ in lacking:
                places.setdefault(f"{task} {engine}", []).append(f"{obj} {ground}".replace("_", " "))
            words = "; ".join(f"{place}: {', '.join(names)}" for place, names in places.items())
        lines.append(f"| {shown} | {len(mine)} of {DRAWN if name in LEARNED else len(every)} | {words} |")
    return "\n".join(lines)


def _head(names: Sequence[str]) -> list[str]:
    return ["| " + " | ".join(names) + " |", "| --- " * len(names) + "|"]


def _bars(rows: Sequence[dict[str, Any]]) -> str:
    """Return how cgwm's medians compare with the floor's, on the captures that both have."""
    lines = _head(_BARS)
    for task in (*TASKS, "all three"):
        bars = _beside_the_floor([row for row in rows if task in (row["task"], "all three")])
        if bars is not None:
            lines.append("| {} | {} | {:.2f} | {:.2f} | {:+.2f} |".format(task, *bars))
    return "\n".join(lines)


def _beside_the_floor(rows: Sequence[dict[str, Any]]) -> tuple[int, float, float, float] | None:
    """Return on how many captures cgwm and the floor are, the ratios of their medians (mm, deg), and the gap in dB."""
    mine, floor = captures_of(rows, REFERENCE), captures_of(rows, FLOOR)
    both = [capture for capture in mine if capture in floor]
    if not both:
        return None
    mm, deg = (
        float(np.median([mine[c][key] for c in both]) / np.median([floor[c][key] for c in both])) for key in (_MM, _DEG)
    )
    return len(both), mm, deg, float(np.median(-paired(floor, mine, _DB)))


def _pooled(rows: Sequence[dict[str, Any]]) -> str:
    lines = _head(_POOLED)
    reference = captures_of(rows, REFERENCE)
    for name, shown in ROWS.items():
        mine, chosen = captures_of(rows, name), [row for row in rows if row["row"] == name and "fit" in row]
        if not mine:
            continue
        kept = [one for row in chosen for one in held(row)]
        seconds = [row["fit"]["seconds"] for row in chosen if row["fit"]["seconds"]]
        error = _friction(rows, name)
        cells = [
            shown,
            str(len(mine)),
            f"{_middle(mine)} ({_mean(mine, _MM)} / {_mean(mine, _DEG)})",
            _median(mine, _DB),
            "–" if error is None else f"{error:.0f}",
        ]
        cells += [f"{sum(kept)} of {len(kept)}" if kept else "–", f"{np.median(seconds):.0f}" if seconds else "–"]
        cells += [difference(mine, reference, key) if name != REFERENCE else "" for key in (_MM, _DEG, _DB)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def difference(mine: Errors, reference: Errors, key: str) -> str:
    """Return the median paired difference of two rows with its interval; both have to have the capture."""
    gaps = paired(mine, reference, key)
    if len(gaps) < 2:
        return "–"
    low, high = bootstrap_interval(gaps)
    digits = _DECIMALS[key]
    return f"{np.median(gaps):+.{digits}f} ({low:+.{digits}f} to {high:+.{digits}f})"


def paired(mine: Errors, reference: Errors, key: str) -> NDArray[np.float64]:
    """Return the differences of two rows on the captures that both have, without those that are not finite."""
    both = [c for c in mine if c in reference and key in mine[c] and key in reference[c]]
    gaps = np.array([mine[capture][key] - reference[capture][key] for capture in both])
    return gaps[np.isfinite(gaps)]


def _by_engine(rows: Sequence[dict[str, Any]]) -> str:
    there = [name for name in ROWS if captures_of(rows, name)]
    lines = _head(("task", "engine", *(ROWS[name] for name in there)))
    for task in TASKS:
        for engine in ENGINES:
            here = [row for row in rows if (row["task"], row["engine"]) == (task, engine)]
            found = [captures_of(here, name) for name in there]
            cells = [f"{_middle(one)} ({len(one)})" if one else "–" for one in found]
            lines.append(f"| {task} | {engine} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _counts(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table of which captures have cgwm's row, by task and engine, and of how many of the commonest commit."""
    commits = Counter(row["commit"] for row in rows if row["row"] == REFERENCE)
    common = max(commits, key=lambda one: commits[one])
    lines = _head(("task", "engine", f"captures of {WANTED}", f"at `{common[:7]}`", "object and ground"))
    for task in TASKS:
        for engine in ENGINES:
            here = [row for row in rows if (row["task"], row["engine"]) == (task, engine)]
            found = sorted(captures_of(here, REFERENCE))
            of_common = captures_of([row for row in here if row["commit"] == common], REFERENCE)
            names = [
                " ".join((obj, ground) if seed == "500" else (obj, ground, f"(seed {seed})"))
                for _, _, obj, ground, seed in found
            ]
            lines.append(
                f"| {task} | {engine} | {len(found)} | {len(of_common)} | {', '.join(names).replace('_', ' ')} |"
            )
    every = ", ".join(f"`{one[:7]}`" for one in sorted({row["commit"] for row in rows}))
    return "\n".join(lines) + f"\n\nRows of commits {every}."


def _median(errors: Errors, key: str) -> str:
    values = [one[key] for one in errors.values() if key in one]
    return f"{np.median(values):.{_DECIMALS[key]}f}" if values else "–"


def _mean(errors: Errors, key: str) -> str:
    values = [one[key] for one in errors.values() if key in one]
    return f"{np.mean(values):.{_DECIMALS[key]}f}" if values else "–"


def _middle(errors: Errors) -> str:
    return f"{_median(errors, _MM)} / {_median(errors, _DEG)}"


def main() -> int:
    """Take rows, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", help="take STORE...; left out, the page is written")
    given = parser.parse_args().what
    if given[:1] == ["take"]:
        print(f"{take([Path(one) for one in given[1:]])} rows in {STORED.relative_to(ROOT)}")
    elif given:
        parser.error(f"{given[0]!r} is not 'take'")
    PAGE.write_text(page(read(STORED)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
