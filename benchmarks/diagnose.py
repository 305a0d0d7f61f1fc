"""Does `cgwm diagnose` name what is hidden, and nothing where nothing is? Captures whose truth is another engine.

    python benchmarks/diagnose.py --stage development --workers 2 [--nulls 20] [--only cube/com_offset] [--list rough]
    python benchmarks/diagnose.py --stage report9 --table [--record]
    python benchmarks/diagnose.py --list odd               # what is unlike the plan: noise, protocols, bodies
    python benchmarks/diagnose.py --list video             # six captures with videos only
    python benchmarks/diagnose.py --list film              # thirty of 640 x 480 px, bodies of 40 px and more, six nulls
    python benchmarks/diagnose.py --list real-like --stage development --nulls 3 --repeats 6   # see missing_effects.py
    python benchmarks/diagnose.py --time [--device cuda]   # seconds for ten tosses of 1 s

Each case is a capture of `hidden_effects` (MuJoCo or drake as the truth, with formulas of their own), fitted and
diagnosed as a user would: `cgwm fit`, `cgwm diagnose`; where a large effect was named rightly, `cgwm fit --from
--effects` and the errors on the test split before and after. Thresholds may be chosen by the stage development, never
by report to report13, whose seeds are others (each later one: since what the one before said was seen).
Results are stored case by case and taken up again; `--record` writes the figures of a whole report into
benchmarks/results/, from which `make results` makes docs/results.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import shlex
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any, Literal

import numpy as np
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Episode
from cgwm.datasets.models.model import Model, read_model
from cgwm.pipeline.diagnose import diagnose
from cgwm.pipeline.evaluate.evaluation import Evaluation
from cgwm.pipeline.evaluate.stage import evaluate_model
from cgwm.pipeline.fit import fit
from cgwm.pipeline.physics import world_of_model
from cgwm.pipeline.physics.effects.registry import FLIGHT_ALIASES
from cgwm.pipeline.trajectories.initial_state import flight_frames
from cgwm.pipeline.trajectories.segmentation import whole_episodes
from cgwm.schemas import CgwmError, PhysConfig
from diagnose_figures import record_figures
from hidden_effects import (
    EFFECTS,
    STAGES,
    Case,
    cases,
    drake_cases,
    film_capture,
    filmed_cases,
    make_capture,
    odd_cases,
    rough_cases,
    sharp_filmed_cases,
)
from real_like import STAGES as REAL_STAGES
from store import Store, timed

FAMILIES: tuple[set[str], ...] = (
    {"linear_drag", "quadratic_drag", "wind"},
    {"gravity_tilt", "frame_tilt", "constant_force", "wind"},
    {"gravity_scale", "buoyancy", "length_scale", "clock_scale", "constant_force"},
    {"com_offset", "marker_offset"},
    {"friction_patch", "anisotropic_friction", "stribeck_friction", "viscous_friction"},
    {"ground_magnet", "adhesion"},
    {"rolling_resistance", "torsional_friction", "spin_damping"},
)
"""Effects that do much the same: to name one for another is a smaller fault."""
LISTS = ("all", "rough", "odd", "drake", "video", "film", "real-like")
RIGHT = ("exact", "class", "exact, and more", "class, and more")
SILENT = ("none_missing", "law_inexact")
"""Verdicts that name no effect and find nothing left in flight."""
COLUMNS = (*RIGHT, "among", "family", "wrong", "unexplained", "silent", "refused")
"""among: said to be not separable from others of contact, which is honest, and not right; family: one of them alone."""


def judged(case: Case, truth: dict[str, Any], found: dict[str, Any]) -> str:
    """Return how a diagnosis stands to the truth: one of `COLUMNS`, or for a null `right` or `false alarm`."""
    if "refused" in found:
        return "refused"
    verdict = found["verdict"]
    if not case.effects:
        # what the engine's own law brings along is there, though nothing was hidden
        brought = set(truth["engine"].get("comes_with", ()))
        named = verdict == "missing_effect" and set(found["selected"]) <= brought
        return "right" if verdict in SILENT or named else "false alarm"
    if verdict in SILENT:
        return "silent"
    if all(EFFECTS[name].acts == "unknown" for name in case.effects):
        return "exact" if verdict == "unexplained" else "class" if found["remaining_unexplained"] else "wrong"
    return "unexplained" if verdict == "unexplained" else _named(case, truth, found)


def _named(case: Case, truth: dict[str, Any], found: dict[str, Any]) -> str:
    """Return how the effects that were named stand to the true ones."""
    selected = list(found["selected"])
    groups = {name: next((set(group) for group in found["aliases"] if name in group), {name}) for name in selected}
    along = {name for effect in truth["effects"] for name in effect["comes_with"]}
    along |= set(truth["engine"].get("comes_with", ()))
    marks = {_mark(name, groups) for name in case.effects}
    # what was selected beside the truth, and is no member of its class
    beside = {name for name in selected if not groups[name] & {*case.effects, *along}}
    if marks <= {"exact", "class"}:
        return ("exact" if marks == {"exact"} else "class") + (", and more" if beside else "")
    if marks <= {"exact", "class", "among"} and not beside:
        return "among"
    if all(group <= set(truth["engine"].get("comes_with", ())) for group in groups.values()):
        return "silent"  # of what is hidden: what the engine's own law brings is in the motion, and no wrong name
    return "family" if marks & {"exact", "class", "among", "family"} else "wrong"


def _mark(name: str, groups: dict[str, set[str]]) -> str:
    """Return how an effect was named: alone; in a group of what it cannot be told apart from, and no more; nearly."""
    if groups.get(name) == {name}:
        return "exact"
    for group in groups.values():
        if name in group and any(group <= set(aliases) for aliases in FLIGHT_ALIASES):
            return "class"
    if EFFECTS[name].acts == "contact" and any(name in group for group in groups.values()):
        return "among"
    near = {other for family in FAMILIES if name in family for other in family}
    return "family" if any(name in group or near & group for group in groups.values()) else "wrong"


def base_settings(
    supervise: Literal["tracks", "images"], device: Literal["auto", "cpu", "cuda"] = "auto"
) -> PhysConfig:
    """Return settings of the fit before a diagnosis: it may not absorb what was hidden as a mass or as a scale.

    They are those of all cases, since a rule for some of them would tell the fit what was hidden.
    """
    return PhysConfig(supervise=supervise, device=device, mass_distribution=False, length_scale=False)


def measure(case: Case, refit: bool) -> dict[str, Any]:
    """Make the capture of a case, fit it, diagnose it, and judge the verdict."""
    with tempfile.TemporaryDirectory() as folder:
        capture, base = Path(folder) / "capture", Path(folder) / "m0"
        written = film_capture(capture, case) if case.filmed else make_capture(capture, case)
        truth = json.loads(written.read_text(encoding="utf-8"))
        physics = base_settings("images" if case.filmed else "tracks")
        began = time.perf_counter()
        try:
            fit(capture, base, stage="phys-geo", phys_config=physics)
        except CgwmError as error:
            return {"case": case.name, "judged": "failed", "failed": error.found}
        fitted = time.perf_counter()
        try:
            found = diagnose(base, capture).model_dump(mode="json")
        except CgwmError as error:
            found = {"refused": error.found}
        seconds = {"fit": round(fitted - began, 1), "diagnose": round(time.perf_counter() - fitted, 1)}
        mark = judged(case, truth, found)
        row: dict[str, Any] = {
            "case": case.name,
            "thing": case.thing,
            "effects": list(case.effects),
            "magnitude": case.magnitude if case.effects else "null",
            "law": case.law,
            "engine": case.engine,
            "rate_hz": case.rate_hz,
            "position_std_m": case.position_std_m,
            "judged": mark,
            "seconds": seconds,
            "truth": [{key: effect[key] for key in ("name", "values")} for effect in truth["effects"]],
            "found": brief(found),
        }
        if refit and mark in RIGHT and found["selected"]:
            row |= added(capture, base, Path(folder) / "m1", found["selected"], physics)
        return row


def brief(found: dict[str, Any]) -> dict[str, Any]:
    """Return what is kept of a diagnosis."""
    if "refused" in found:
        return found
    keys = (
        "verdict",
        "sentence",
        "selected",
        "aliases",
        "remaining_unexplained",
        "contact_chi2",
        "flight_before",
        "flight_after",
    )
    keys += ("contact_limits",)
    return {key: found[key] for key in keys} | {
        "ranking": found["ranking"][:6],
        "contact": {
            one["effect"]: one["contact_score"] for one in found["ranking"] if one["contact_score"] is not None
        },
        "residual_law": found["residual_law"],
        "next_experiment": found["next_experiment"],
    }


def added(capture: Path, base: Path, child: Path, effects: Sequence[str], physics: PhysConfig) -> dict[str, Any]:
    """Fit the model again with the effects, and return the errors on the test split before and after."""
    config = physics.model_copy(update={"effects": tuple(effects)})
    began = time.process_time()
    try:
        model = fit(capture, child, stage="phys-geo", parent=base, phys_config=config)
    except CgwmError as error:
        return {"refit_failed": error.found}
    opened = Capture.open(capture, splits=("test",))
    ends_s = first_contacts(base, opened)
    errors = {
        when: errors_of_test(read_model(path), opened, ends_s) for when, path in (("before", base), ("after", child))
    }
    own = {p.name: [p.estimate, p.interval_95] for p in model.parameters if "." in p.name and p.interval_95}
    return {"errors": errors, "estimates": own, "child_cpu_s": round(time.process_time() - began, 1)}


def errors_of_test(model: Model, capture: Capture, ends_s: dict[str, float]) -> dict[str, float | None]:
    """Return the median errors [m] of a model on the test split; `ends_s`: first contact of each episode [s]."""
    found = evaluate_model(model, capture)
    result = found.result
    return {
        "flight_m": _in_flight(found, ends_s),
        "floor_m": None if result.state_noise_floor_m is None else result.state_noise_floor_m.median,
        "open_loop_m": result.translation_error_m.median,
        "state_fitted_m": None if result.state_fitted_residual_m is None else result.state_fitted_residual_m.median,
    }


def first_contacts(base: Path, capture: Capture) -> dict[str, float]:
    """Return the time of the first contact of each test episode [s], by the shape that a model has."""
    world = world_of_model(read_model(base))
    whole = whole_episodes(world, [Episode(name, capture.tracks(name)) for name in capture.episodes("test")])
    ends = flight_frames(world, whole).sum(1).clamp(max=whole.times_s.shape[1] - 1)
    return {name: float(times[end]) for name, times, end in zip(whole.names, whole.times_s, ends, strict=True)}


def _in_flight(found: Evaluation, ends_s: dict[str, float]) -> float | None:
    """Return the median over episodes of the mean open-loop error before the first contact [m]; None without any."""
    means = []
    for one in (episode.prediction for episode in found.episodes):
        error = one.translation_error_m()[~one.warmup & (one.time_s < ends_s[one.episode])]
        if np.isfinite(error).any():
            means.append(float(np.nanmean(error)))
    return float(np.median(means)) if means else None


def timing(device: Literal["auto", "cpu", "cuda"]) -> Iterator[str]:
    """Yield the lines of a table of how long a diagnosis of ten tosses of 1 s takes: in a fresh process, and again."""
    yield from ("| body | hidden | fit | diagnosis | again | verdict |", "|---|---|---|---|---|---|")
    things: tuple[Literal["cube", "ball"], ...] = ("cube", "ball")
    for thing, effects in itertools.product(things, (("quadratic_drag",), ())):
        case = Case(f"timing/{thing}", thing, effects, seed=4, train=10)
        with tempfile.TemporaryDirectory() as folder:
            capture, base = Path(folder) / "capture", Path(folder) / "m0"
            make_capture(capture, case)
            marks = [time.perf_counter()]
            fit(capture, base, stage="phys-geo", phys_config=base_settings("tracks", device))
            marks.append(time.perf_counter())
            for _ in range(2):
                found = diagnose(base, capture, device=device)
                marks.append(time.perf_counter())
        seconds = " | ".join(f"{after - before:.1f} s" for before, after in itertools.pairwise(marks))
        named = ", ".join(found.selected)
        yield f"| {thing} | {', '.join(effects) or 'nothing'} | {seconds} | {found.verdict} {named} |"


def run(todo: Sequence[Case], store: Store, workers: int, refit: bool, deadline: float) -> None:
    """Measure what is missing; no case is begun after the deadline."""
    waiting: dict[Future[dict[str, Any]], Case] = {}
    queue = [case for case in todo if store.known(case.name) is None]
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        while queue or waiting:
            while queue and len(waiting) < workers and time.monotonic() < deadline:
                case = queue.pop(0)
                # to look for the poses again would take minutes, and the test split has no tracks to be judged by
                large = refit and case.magnitude == "large" and bool(case.effects) and not case.filmed
                waiting[pool.submit(_timed, case, large)] = case
            if not waiting:
                break
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                case = waiting.pop(future)
                error = future.exception()
                failed = {"case": case.name, "judged": "failed", "failed": f"{type(error).__name__}: {error}"}
                store.add(case.name, future.result() if error is None else failed)


def _timed(case: Case, refit: bool) -> dict[str, Any]:
    return timed(lambda: measure(case, refit))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the confusion table, what false alarms said, and what adding the right effect did."""
    lines = ["| cases | n | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 2) + "|"]
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        if row.get("effects"):
            acts = {EFFECTS[name].acts for name in row["effects"]}
            kind = "pairs" if len(row["effects"]) > 1 else next(iter(acts))
            groups.setdefault(f"{kind}, {row['magnitude']}", []).append(row)
    for name, some in sorted(groups.items()):
        counts = Counter(row["judged"] for row in some)
        lines.append(f"| {name} | {len(some)} | " + " | ".join(str(counts[column]) for column in COLUMNS) + " |")
    nulls = [row for row in rows if row.get("magnitude") == "null"]
    alarms = [row for row in nulls if row["judged"] == "false alarm"]
    bound = 100 * _bound(len(alarms), len(nulls))
    lines.append(f"\nNulls: {len(alarms)} false alarms of {len(nulls)}; 95 % bound {bound:.1f} %.")
    lines += [f"- {row['case']}: {row['found']['verdict']} {', '.join(row['found']['selected'])}" for row in alarms]
    lines += ["", "Not right:"]
    for row in rows:
        if row.get("effects") and row["judged"] not in RIGHT:
            said = row.get("found", {})
            named = ", ".join(said.get("selected", ())) or said.get("refused", row.get("failed", ""))[:80]
            lines.append(f"- {row['case']}: {row['judged']} ({said.get('verdict', 'no verdict')} {named})")
    lines += [f"- {row['case']}: the fit failed ({row['failed'][:80]})" for row in rows if "failed" in row]
    refitted = [row for row in rows if "errors" in row]
    for key in ("open_loop_m", "state_fitted_m"):
        pairs = [(row["errors"]["before"][key], row["errors"]["after"][key]) for row in refitted]
        ratios = [after / before for before, after in pairs if before and after]
        if ratios:
            low, middle, high = np.percentile(ratios, (25, 50, 75))
            lines.append(
                f"\nTest split after / before, {key}: median {middle:.2f} ({low:.2f} to {high:.2f}), n {len(ratios)}"
            )
    held = [yes for row in refitted for yes in covered(row)]
    if held:
        lines.append(f"\n95 % intervals of the added numbers that hold the truth: {sum(held)} of {len(held)}.")
    silent = [(row["case"], above) for row in rows if (above := _above_its_limit(row)) is not None]
    if silent:
        listed = ", ".join(name for name, above in silent if above) or "none"
        lines.append(f"\nSilent in contact: {len(silent)}; of these larger than what should have shown: {listed}.")
    seconds = [row["seconds"]["diagnose"] for row in rows if "seconds" in row]
    if seconds:
        lines.append(f"\nSeconds for a diagnosis: median {np.median(seconds):.1f}, at most {max(seconds):.1f}.")
    return "\n".join(lines)


def _bound(alarms: int, nulls: int) -> float:
    """Return the upper 95 % bound of the rate (Clopper & Pearson)."""
    from scipy.stats import beta

    return float(beta.ppf(0.95, alarms + 1, max(nulls - alarms, 1e-9))) if nulls else 1.0


def _above_its_limit(row: dict[str, Any]) -> bool | None:
    """Return of a single effect of contact that stayed silent whether it is larger than what would have shown."""
    if row["judged"] != "silent" or len(row["effects"]) != 1 or EFFECTS[row["effects"][0]].acts != "contact":
        return None
    values, limits = row["truth"][0]["values"], row["found"]["contact_limits"]
    sizes = next((one["sizes"] for one in limits if one["effect"] == row["effects"][0]), {})
    # a spot of another friction has one change where a map has nine
    return any(abs(values.get(name, values.get("change", 0.0))) > size for name, size in sizes.items())


def covered(row: dict[str, Any]) -> list[bool]:
    """Return for each number of the added effects that the truth has by the same name whether its interval holds it."""
    found = []
    for effect in row["truth"]:
        for name, value in effect["values"].items():
            estimate = row["estimates"].get(f"{effect['name']}.{name}")
            if estimate is not None and isinstance(value, float):
                low, high = estimate[1]
                found.append(low <= value <= high)
    return found


def _real_like(given: argparse.Namespace) -> int:
    """Run cgwm alone on the real-like cases; `missing_effects.py` has its rivals, too."""
    import missing_effects

    numbers = {"--stage": given.stage, "--nulls": given.nulls, "--workers": given.workers, "--seconds": given.seconds}
    numbers |= {"--only": given.only, "--each": given.repeats, "--store": given.store, "--contenders": "cgwm"}
    words = [str(word) for pair in numbers.items() if pair[1] not in (None, "") for word in pair]
    words += ["--any-commit"] * given.any_commit
    return missing_effects.main(["table" if given.table else "run", *words])


def main() -> int:
    """Measure what is missing of the cases, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    stages = dict.fromkeys((*STAGES, *REAL_STAGES))
    parser.add_argument("--stage", choices=stages, default="development", help="report1 to report8: of real-like alone")
    parser.add_argument("--list", choices=LISTS, default="all", help="which cases")
    parser.add_argument("--nulls", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=None, help="seeds of each effect, pair and unknown; of each row")
    parser.add_argument("--only", default="", help="cases whose names contain this")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no case after this time")
    parser.add_argument("--no-refit", action="store_true", help="do not add the effects found")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    parser.add_argument("--table", action="store_true", help="print the table of what is stored, and measure nothing")
    parser.add_argument("--record", action="store_true", help="write the figures of a whole report to results/")
    parser.add_argument("--time", action="store_true", help="time diagnoses of ten tosses of 1 s, and no more")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="of --time")
    given = parser.parse_args()
    part = given.list != "all" or given.only or not given.nulls or not given.stage.startswith("report")
    if given.record and part:
        parser.error("--record wants a whole report: --stage report..., with nulls, and neither --list nor --only.")
    if given.list == "real-like":
        return _real_like(given)
    if given.stage not in STAGES:
        parser.error(f"stage {given.stage} is one of --list real-like alone.")
    if given.time:
        for line in timing(given.device):
            print(line, flush=True)
        return 0
    os.environ["OMP_NUM_THREADS"] = "1"  # the workers start with it
    if given.list == "all":
        chosen = cases(given.stage, given.repeats or 1, given.nulls)
    elif given.list == "drake":
        chosen = drake_cases(given.stage, nulls=given.nulls)
    else:
        lists = {"rough": rough_cases, "odd": odd_cases, "video": filmed_cases, "film": sharp_filmed_cases}
        chosen = lists[given.list](given.stage)
    chosen = [case for case in chosen if given.only in case.name]
    store = Store("diagnose", given.store, given.any_commit)
    if not given.table:
        # every kind of case early, so that a run that is cut off tells of all
        order = np.random.default_rng(0).permutation(len(chosen))
        deadline = time.monotonic() + given.seconds
        run([chosen[k] for k in order], store, given.workers, not given.no_refit, deadline)
    names = {case.name for case in chosen}
    rows = [row for row in store.results() if row["key"] in names]
    print(table(rows))
    if given.record:
        if len(rows) < len(names):
            print(f"{len(names) - len(rows)} cases are not measured yet: nothing is recorded.", file=sys.stderr)
            return 1
        command = shlex.join(word for word in ("python", "benchmarks/diagnose.py", *sys.argv[1:]) if word != "--record")
        acts = {name: entry.acts for name, entry in EFFECTS.items()}
        record_figures(rows, acts=acts.__getitem__, bound=_bound, covered=covered, command=command)
    return 0


if __name__ == "__main__":
    sys.exit(main())
