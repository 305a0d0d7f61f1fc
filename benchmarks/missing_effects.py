"""Who names what is hidden in real-like captures, and nothing else: cgwm and its rivals in one table.

    python benchmarks/missing_effects.py run --stage development --each 6 --nulls 3     # some 40 captures
    python benchmarks/missing_effects.py run --stage report1 --workers 16 --seconds 220   # again, until 0 are left
    python benchmarks/missing_effects.py table --stage report1 [--plot FILE.png] [--record]
    python benchmarks/missing_effects.py export OUT --stage development --each 6 --nulls 3

The captures are those of `real_like`; each contender is one file of `contenders/` (`effects_base.py` is its interface):
`cgwm`, as a user runs it, with what the default fit takes into the model by itself counted as named; `bic`, stepwise
selection over the same library by BIC with one noise; `sysid`, a likelihood-ratio test of each candidate in MuJoCo;
`sindy`, sparse regression on smoothed accelerations; and, asked for by name alone, `cgwm_plain`, whose fit takes
nothing by itself. Captures and answers are stored one by one under out/ and taken up again. Thresholds, of
rivals too, may be chosen on the stage development alone.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from contenders.effects_base import EffectNamer
from real_like import EACH, NULLS, STAGES, RealCase, make_real_capture, missing, real_cases
from real_like.score import BINS, RIGHT, judge, rate, ratio_of, table, wilson
from store import ROOT, Store, timed

CONTENDERS: dict[str, Callable[[], EffectNamer]] = {
    "cgwm": lambda: import_module("contenders.effects_cgwm").Cgwm(refit=True),
    "cgwm_plain": lambda: import_module("contenders.effects_cgwm").Cgwm(refit=True, plain=True),
    "bic": lambda: import_module("contenders.effects_bic").StepwiseBic(),
    "sysid": lambda: import_module("contenders.effects_sysid").MujocoSysid(),
    "sindy": lambda: import_module("contenders.effects_sindy").SparseRegression(),
}


def answer(contender: str, case: RealCase, captures: Path) -> dict[str, Any]:
    """Return what a contender says of a case; its capture is made unless it is there."""
    capture, truth = made(case, captures)
    try:
        found = CONTENDERS[contender]().names(capture)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return {"case": case.name, "truth": truth, "failed": f"{type(error).__name__}: {error}"}
    said = {"named": list(found.named), "aliases": [list(group) for group in found.aliases]}
    return {"case": case.name, "truth": truth, "answer": {**said, "unexplained": found.unexplained}, **found.details}


def made(case: RealCase, captures: Path) -> tuple[Path, dict[str, Any]]:
    """Return the capture of a case, made unless it is there, and its truth."""
    folder = captures / case.name.replace("/", "__")
    secret = captures.with_name(f"{captures.name}.truth") / f"{folder.name}.json"
    if not (folder.is_dir() and secret.is_file()):
        secret.parent.mkdir(parents=True, exist_ok=True)
        make_real_capture(folder, case, secret, overwrite=True)
    return folder, json.loads(secret.read_text(encoding="utf-8"))


def run(
    todo: Sequence[tuple[str, RealCase]], store: Store, captures: Path, workers: int, deadline: float
) -> tuple[int, int]:
    """Measure what is missing, and return how many were measured and how many remain; none begins late."""
    queue = [(who, case) for who, case in todo if store.known(f"{who}:{case.name}") is None]
    waiting: dict[Future[dict[str, Any]], tuple[str, RealCase]] = {}
    done_now = 0
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        while queue or waiting:
            while queue and len(waiting) < workers and time.monotonic() < deadline:
                who, case = queue.pop(0)
                waiting[pool.submit(_timed, who, case, captures)] = (who, case)
            if not waiting:
                break
            finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in finished:
                who, case = waiting.pop(future)
                error = future.exception()
                failed = {"case": case.name, "failed": f"{type(error).__name__}: {error}"}
                row = {"contender": who, **(future.result() if error is None else failed)}
                store.add(f"{who}:{case.name}", row)
                done_now += 1
    return done_now, len(queue)


def _timed(who: str, case: RealCase, captures: Path) -> dict[str, Any]:
    return timed(lambda: answer(who, case, captures))


def report(rows: Sequence[dict[str, Any]], planned: Sequence[tuple[str, RealCase]]) -> str:
    """Return the table of each contender, what was not run, and what adding the named effects did."""
    lines: list[str] = []
    for who in dict.fromkeys(who for who, _ in planned):
        wanted = [case for name, case in planned if name == who]
        own = {row["case"]: row for row in rows if row["contender"] == who}
        answered = {name: row for name, row in own.items() if "answer" in row}
        lines += [f"## {who}", ""]
        truths = {name: row["truth"] for name, row in own.items() if "truth" in row}
        if truths:
            lines += [table(truths, {name: row["answer"] for name, row in answered.items()}), ""]
        refused = [row for row in answered.values() if "refused" in row]
        if refused:
            lines.append(f"{len(refused)} captures were refused: they count as answered by nothing.")
        failed = [row for row in own.values() if "failed" in row]
        lines += [f"- {row['case']}: failed, as if answered by nothing ({row['failed'][:100]})" for row in failed]
        lines += _not_run(wanted, own)
        took = [row for row in answered.values() if row.get("taken")]
        if took:
            lines.append(f"In {len(took)} of {len(answered)} captures the fit took something by itself:")
            lines += [f"- {row['case']}: {', '.join(row['taken'])}" for row in took]
        lines += _added(list(answered.values()))
        seconds = [row["cpu_s"] for row in answered.values()]
        if seconds:
            lines += [f"Seconds of CPU for a capture: median {np.median(seconds):.1f}, at most {max(seconds):.1f}.", ""]
    return "\n".join(lines)


def _not_run(wanted: Sequence[RealCase], own: dict[str, Any]) -> list[str]:
    """Return lines about the cells that were not run, and why."""
    cells: dict[tuple[str, str], int] = {}
    for case in wanted:
        if case.name not in own:
            cells[case.row, case.group] = cells.get((case.row, case.group), 0) + 1
    if not cells:
        return []
    lines = ["", "Not run:"]
    for (row, group), count in sorted(cells.items()):
        lacking = missing(group)
        lines.append(f"- {row}, {group}: {count} captures{f' ({lacking} is not installed)' if lacking else ''}")
    return [*lines, ""]


def _added(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return lines about the errors on the test split after and before, and how the intervals cover."""
    from diagnose import covered
    from missing_effects_figures import comparable

    right = [row for row in rows if "errors" in row and judge(row["truth"], row["answer"])["mark"] in RIGHT]
    lines = []
    for key in ("open_loop_m", "flight_m", "state_fitted_m"):
        pairs = [(row["errors"]["before"].get(key), row["errors"]["after"].get(key)) for row in right]
        ratios = [after / before for before, after in pairs if before and after]
        if ratios:
            low, middle, high = np.percentile(ratios, (25, 50, 75))
            lines.append(f"Test split after / before, {key}: {middle:.2f} ({low:.2f} to {high:.2f}), n {len(ratios)}.")
    held = [yes for row in right for yes in covered({**row, "truth": row["truth"]["effects"]})]
    alike = [yes for row in right for yes in covered({**row, "truth": comparable(row)})]
    text = f"95 % intervals that hold the truth: {rate(held)}; of numbers that mean the same in both: {rate(alike)}."
    return [*lines, text, ""] if held else lines


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw recall against what an effect moves in slow errors, for each contender, with 95 % intervals."""
    pyplot: Any = import_module("matplotlib.pyplot")
    figure, axes = pyplot.subplots(figsize=(7, 4.5))
    whos = list(dict.fromkeys(row["contender"] for row in rows))
    for place, who in enumerate(whos):
        own = [row for row in rows if row["contender"] == who and "answer" in row and row["truth"]["effects"]]
        own = [row for row in own if row["truth"]["row"] != "unknown"]
        for low, high in BINS[1:]:
            inside = [row for row in own if low <= (ratio_of(row["truth"]) or 0.0) < high]
            right = sum(judge(row["truth"], row["answer"])["mark"] in RIGHT for row in inside)
            if inside:
                middle = np.sqrt(low * min(high, 100.0)) * (1 + 0.04 * place)
                bottom, top = wilson(right, len(inside))
                label = f"{who}" if low == BINS[1][0] else None
                axes.plot([middle, middle], [bottom, top], color=f"C{place}")
                axes.annotate(f"{right} of {len(inside)}", (1.05 * middle, right / len(inside)), color=f"C{place}")
                axes.plot(middle, right / len(inside), "o", color=f"C{place}", label=label)
    axes.set(
        xscale="log", ylim=(0, 1), xlabel="largest displacement by the effect / slow error", ylabel="named rightly"
    )
    places = [edge for low, high in BINS[1:] for edge in (low, min(high, 100.0))]
    axes.set_xticks(sorted(set(places)), [f"{place:g}" for place in sorted(set(places))])
    axes.minorticks_off()
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main(words: Sequence[str] | None = None) -> int:
    """Run, print the table, or export; `words` are those of the command line unless given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table", "export"))
    parser.add_argument("out", nargs="?", type=Path, help="of export")
    parser.add_argument("--stage", choices=STAGES, default="development")
    every = ",".join(who for who in CONTENDERS if who != "cgwm_plain")
    parser.add_argument("--contenders", default=every, help="separated by commas")
    parser.add_argument("--nulls", type=int, default=NULLS, help="for each engine")
    parser.add_argument("--each", type=int, default=EACH, help="captures of each other row")
    parser.add_argument("--more", type=int, default=0, help="further captures of what is in no library")
    parser.add_argument("--tossed", type=int, default=0, help="further captures of many throws")
    parser.add_argument("--only", default="", help="part of the name")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no capture after this time")
    parser.add_argument("--captures", type=Path, default=None, help="where captures are kept; default out/real_like")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    parser.add_argument("--plot", type=Path, default=None, help="of table: draw recall against the ratio")
    parser.add_argument("--record", action="store_true", help="of table: write a report's figures to results/")
    given = parser.parse_args(words)
    if given.record and (given.only or not given.stage.startswith("report")):
        parser.error("--record wants a report: --stage report..., without --only.")
    os.environ["OMP_NUM_THREADS"] = "1"  # the workers start with it
    every_case = real_cases(given.stage, given.nulls, given.each, given.more, given.tossed)
    chosen = [case for case in every_case if given.only in case.name]
    captures = given.captures or ROOT / "out" / "real_like" / given.stage
    if given.what == "export":
        if given.out is None:
            parser.error("where to? name a directory: export OUT")
        exporting: Any = import_module("real_like.export")
        return exporting.export(given.out, chosen, captures, given.workers)
    whos = given.contenders.split(",")
    unknown = [who for who in whos if who not in CONTENDERS]
    if unknown:
        parser.error(f"no contender '{unknown[0]}'; there are {', '.join(CONTENDERS)}")
    planned = [(who, case) for case in _mixed(chosen) for who in whos]
    store = Store("missing_effects", given.store, given.any_commit)
    left = 0
    if given.what == "run":
        absent = {who: lacking for who in whos if (lacking := CONTENDERS[who]().missing())}
        for who, lacking in absent.items():
            print(f"{who} is not run: {lacking} is not installed.", file=sys.stderr)
        able = [(who, case) for who, case in planned if who not in absent and missing(case.group) is None]
        done, left = run(able, store, captures, given.workers, time.monotonic() + given.seconds)
        print(f"{done} measured, {left} left{': run the same command again' if left else ''}.", file=sys.stderr)
    names = {f"{who}:{case.name}" for who, case in planned}
    rows = [row for row in store.results() if row["key"] in names]
    print(report(rows, planned))
    if given.plot:
        plot(rows, given.plot)
    if given.record and not _recorded(rows, planned, given):
        return 1
    return 3 if left else 0


def _recorded(
    rows: Sequence[dict[str, Any]], planned: Sequence[tuple[str, RealCase]], options: argparse.Namespace
) -> bool:
    """Write the figures of a report into benchmarks/results/; return False if a contender has no answer.

    Captures are asked in a random order, so that a report that was cut off is a sample of the whole one.
    """
    whos = {who for who, _ in planned}
    asked = {who: sum(row["contender"] == who and "truth" in row for row in rows) for who in whos}
    if not all(asked.values()):
        print("a contender has no answer: nothing is recorded.", file=sys.stderr)
        return False
    figures: Any = import_module("missing_effects_figures")
    counts = {"each": options.each, "nulls": options.nulls, "more": options.more, "tossed": options.tossed}
    each = " ".join(f"--{name} {count}" for name, count in counts.items() if count or name in ("each", "nulls"))
    figures.record_figures(rows, f"python benchmarks/missing_effects.py run --stage {options.stage} {each}")
    return True


def _mixed(chosen: Sequence[RealCase]) -> list[RealCase]:
    """Return cases in a random order in which a run that is cut off at any time has as much of each row and engine."""
    rng = np.random.default_rng(0)
    kinds: dict[tuple[str, str], list[RealCase]] = {}
    for case in chosen:
        kinds.setdefault((case.row, case.engine), []).append(case)
    placed = [
        ((k + rng.uniform()) / len(own), own[at])
        for own in kinds.values()
        for k, at in enumerate(rng.permutation(len(own)))
    ]
    return [case for _, case in sorted(placed, key=lambda one: one[0])]


if __name__ == "__main__":
    sys.exit(main())
