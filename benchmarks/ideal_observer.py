"""What an observer could name in real-like captures who knows the true errors: the limit of any rule.

    python benchmarks/missing_effects.py run --stage development --each 6 --nulls 3 --contenders cgwm
    python benchmarks/ideal_observer.py --stage development [--only flight] [--workers 2] [--out FILE] [--answers STORE]

For each capture with effects of flight or measurement that `missing_effects.py` has made, each true effect, as large as
it is, is projected on what whole flights show: generalised least squares with the true covariance of the errors
(white, slow, bursts at their true times) and the true variances of tilts and scales, states free. `chi2` is its square
in standard errors, what a test of this one effect expects beside chance; `apart` is what the best effect of another
class leaves of it. Smoothing is left out, as it can be undone, and so are a magnet, whose law is not cgwm's, and a
wind, which does nothing without its drag. An effect is nameable with five standard errors (`NAMEABLE`), half of whose
square no other class explains; with `--answers` the recall of a run of `missing_effects.py` is printed for what is
nameable, too: no rule that seldom names anything wrong can have much more.

`best` is sharper, and asks for no count of standard errors: an observer who knows, beside the errors, that one effect
of the library or none is hidden, how sizes are drawn (log-uniform over three decades) and that half of all captures
hide nothing, names the class whose probability, given the flights, is above 95 %. `best` is the share of draws of the
errors in which that is the class of the true effect. Nothing that is in no library confuses this observer. Of a pair
`best` is the same for both: the observer knows that none, one or two effects are hidden, each as likely, the two of no
common family, and names two classes whose probability together is above 95 %.

`errors` are those of the test split, as `missing_effects.py` has them, with the fitted model before, and with the true
effects at their true numbers added: what no diagnosis can be better than, but by chance.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import read_model
from cgwm.datasets.synthetic.hidden_effects import EFFECTS
from cgwm.pipeline.diagnose.stage import library_of, prepared_world
from cgwm.pipeline.fit import fit
from cgwm.pipeline.physics.effects.registry import load_effect
from cgwm.pipeline.segments.candidates import acts_in, admissible, base_parameters, variants_of, with_variants
from cgwm.pipeline.segments.linearization import derivatives
from cgwm.pipeline.segments.prepare import whole_flights
from cgwm.pipeline.segments.segment_states import fit_states
from cgwm.pipeline.segments.segments import Segments
from cgwm.pipeline.trajectories.innovations import WHITE
from cgwm.schemas import CgwmError
from cgwm.schemas.model import EffectModel
from diagnose import base_settings, errors_of_test, first_contacts
from real_like import STAGES
from real_like.errors import Errors, slow_correlation
from real_like.plan import FAMILIES
from real_like.score import EQUIVALENT, RIGHT, judge, rate, ratio_of
from render_results import record
from scipy.special import log_ndtr
from store import ROOT

LEAST_FRAMES = 6
MEASURED = 0.04
"""A direction of parameters counts where its information times the variance of the prior is above this."""
NAMEABLE = (25.0, 12.5)
"""Least `chi2` and `apart`, as of `contact_observer.py`: a test of 15 candidates at 0.002 asks for 14.6, and the effect
itself scatters by one standard error about its size."""
BINS = ((0.0, 17.0), (17.0, np.inf))
"""Ratios of the effect to the slow error: small and large ones."""

SIZES = np.geomspace(1e-3, 1.0, 13)
"""Sizes of an effect, in widths of its parameters, that are likely alike for the best observer."""
SURE, DRAWS = 0.95, 400
"""Probability above which a class is named, and draws of the errors."""

Array = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Seen:
    """The information of whole flights about all candidates."""

    names: list[str]
    """Name of the effect of each parameter (P)."""
    numbers: list[str]
    """Name of each parameter in its effect (P)."""
    width: Array
    """Its usual size (P)."""
    information: Array
    """With states, tilts and scales projected out, (P, P)."""


def seen(model: Path, capture: Path, truth: dict[str, Any]) -> Seen:
    """Return what the training flights of a capture show under the true errors."""
    world, prepared = prepared_world(read_model(model), Capture.open(capture, splits=("train",)), "train")
    kept, _ = admissible(world, library_of(()), prepared.has_orientation)
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if acts_in(v, "flight")]
    every = whole_flights(prepared.flight.items) if prepared.flight is not None else []
    items = [item for item in every if item.last - item.first + 1 >= LEAST_FRAMES]
    parameters = [*base_parameters(world, "flight"), *with_variants(world, variants, "flight")[1]]
    owner = {name: kept[v.place].effect.name for v in variants for name in v.parameters}
    names = [owner.get(p.name, p.name) for p in parameters]
    numbers = [p.name.partition(".")[2] for p in parameters]
    width = np.array([p.prior[1] for p in parameters])
    if not items:  # drops and slides without a flight that is long enough show nothing
        return Seen(names, numbers, width, np.zeros((len(parameters), len(parameters))))
    fitted = fit_states(prepared.segments("flight", world, items))
    plain = Segments.of("flight", world, prepared.observations, items, prepared.noise, WHITE)
    plain = plain.with_state(fitted.observations.state)
    slopes = torch.nan_to_num(derivatives(plain, world, variants)[2]).numpy().astype(np.float64)
    errors, episodes = _errors(truth), truth["episodes"]
    tilts = [names.index("frame_tilt") + k for k in range(2)] if errors.tilt_rad else []
    scales = [names.index("length_scale")] if errors.scale else []
    kinds = [(("tilt", prepared.names[item.episode]), tilts) for item in items]
    owners = [[kind, (("scale", episodes[kind[0][1]]["session"]), scales)] for kind in kinds]
    places = {
        key: (k, columns) for k, (key, columns) in enumerate({key: c for own in owners for key, c in own}.items())
    }
    size, starts = len(parameters), _starts(places, len(parameters))
    total = np.zeros((starts["end"], starts["end"]))
    for k, item in enumerate(items):
        rows = _whitened(plain, slopes, k, errors, episodes[prepared.names[item.episode]]["bursts_s"])
        if not len(rows):  # too few frames show nothing
            continue
        own, states = rows[:, :size], rows[:, size:]
        every_column = np.zeros((len(rows), starts["end"]))
        every_column[:, :size] = own
        for key, columns in owners[k]:
            every_column[:, starts[key] : starts[key] + len(columns)] = own[:, columns]
        basis, s, _ = np.linalg.svd(states / np.linalg.norm(states, axis=0).clip(1e-12), full_matrices=False)
        basis = basis[:, s > 1e-6 * s.max()]
        every_column -= basis @ (basis.T @ every_column)
        total += every_column.T @ every_column
    spread = {"tilt": errors.tilt_rad, "scale": errors.scale}
    prior = [spread[key[0]] ** -2.0 for key, (_, columns) in places.items() for _ in columns]
    mixed = total[:size, size:]
    information = total[:size, :size] - mixed @ np.linalg.solve(total[size:, size:] + np.diag(prior), mixed.T)
    return Seen(names, numbers, width, information)


def _errors(truth: dict[str, Any]) -> Errors:
    return Errors(**{key: value for key, value in truth["errors"].items() if key != "carried"})


def _starts(places: dict[Any, Any], first: int) -> dict[Any, int]:
    """Return the first column of the values of each episode and session, and that after the last."""
    found: dict[Any, int] = {}
    for key, (_, columns) in places.items():
        found[key] = first
        first += len(columns)
    return {**found, "end": first}


def _whitened(flights: Segments, slopes: Array, k: int, errors: Errors, bursts_s: Sequence[Sequence[float]]) -> Array:
    """Return the derivatives (n, P + S) of a flight's measurements over the root of the true covariance."""
    observed, parts = flights.observations, []
    sizes = ((errors.white_m, errors.slow_m, errors.burst_m), (errors.white_rad, errors.slow_rad, errors.burst_rad))
    for kind, (white, slow, burst) in enumerate(sizes):
        mask = (observed.seen, observed.has_orientation)[kind][k, :, 0].numpy() > 0
        if mask.sum() < LEAST_FRAMES:
            continue
        t = observed.times_s[k].numpy()[mask]
        wrong = np.any([(t >= a) & (t <= b) for a, b in bursts_s] or [np.zeros(len(t), bool)], axis=0)
        covariance = slow**2 * slow_correlation(t, errors.slow_s, errors.slow_kind)
        covariance += np.diag(white**2 + burst**2 * wrong)
        root = np.linalg.cholesky(covariance) / flights.noise[kind]
        own = slopes[k][mask][:, 3 * kind : 3 * kind + 3].reshape(len(t), -1)
        parts.append(np.linalg.solve(root, own).reshape(3 * len(t), -1))
    return np.concatenate(parts) if parts else np.empty((0, slopes.shape[-1]))


def limit(found: Seen, effect: dict[str, Any]) -> tuple[float, float] | None:
    """Return the square of a true effect in standard errors, and what the best of another class leaves of it."""
    name, true = effect["name"], _true(found, effect)
    score = found.information @ true
    square = float(true @ score)
    alike = set[str]().union({name}, *(group for group in EQUIVALENT if name in group))
    others = [_explained(found, score, rival) for rival in set(found.names) - alike]
    return (square, square - max(others, default=0.0)) if true.any() else None


def _explained(found: Seen, score: Array, name: str) -> float:
    """Return what one effect explains of another, from the score of that one."""
    own = [k for k, other in enumerate(found.names) if other == name]
    width = found.width[own]
    values, vectors = np.linalg.eigh(found.information[np.ix_(own, own)] * np.outer(width, width))
    kept = values > MEASURED
    return float(np.square(vectors[:, kept].T @ (score[own] * width) / np.sqrt(values[kept])).sum())


def best_recall(found: Seen, effect: dict[str, Any], nonnegative: frozenset[str] = frozenset()) -> float:
    """Return how often an observer who knows how effects are drawn is sure of the class of a true one, and is right.

    Args:
        found: What the flights show.
        effect: The true effect.
        nonnegative: Effects of one number that is not negative.
    """
    name, true = effect["name"], _true(found, effect)
    values, vectors = np.linalg.eigh(found.information)
    root = vectors * np.sqrt(values.clip(0.0))
    errors = np.random.default_rng(0).standard_normal((DRAWS, len(true)))
    score = found.information @ true + errors @ root.T
    names = list(dict.fromkeys(found.names))
    evidence = np.stack([_log_evidence(found, score, one, one in nonnegative) for one in names])
    # before the data nothing is hidden in half of the captures, and no effect is likelier than another
    logs = np.concatenate((np.zeros((1, DRAWS)), evidence - np.log(len(names))))
    share = np.exp(logs - np.logaddexp.reduce(logs, 0))[1:]
    classes = [{one} for one in names] + [set(group) & set(names) for group in EQUIVALENT]
    sure = np.stack([share[[one in group for one in names]].sum(0) for group in classes if group])
    kept = [group for group in classes if group]
    first = sure.argmax(0)  # a single effect before its class, where they are alike
    right = np.array([name in group for group in kept])[first]
    return float(np.mean(right & (sure.max(0) > SURE)))


def best_pair_recall(found: Seen, effects: Sequence[dict[str, Any]]) -> float:
    """Return how often an observer who knows how effects are drawn is sure of the classes of two true ones, and right.

    That some numbers are not negative is not used.

    Args:
        found: What the flights show.
        effects: The two true effects.
    """
    true = np.sum([_true(found, effect) for effect in effects], axis=0)
    values, vectors = np.linalg.eigh(found.information)
    errors = np.random.default_rng(0).standard_normal((DRAWS, len(true)))
    score = found.information @ true + errors @ (vectors * np.sqrt(values.clip(0.0))).T
    names = [name for name in dict.fromkeys(found.names) if name in EFFECTS]
    pairs = [(a, b) for a, b in combinations(names, 2) if not any({a, b} <= family for family in FAMILIES)]
    sets = [(), *((name,) for name in names), *pairs]
    counts = {number: sum(len(one) == number for one in sets) for number in range(3)}
    logs = np.stack([_log_evidence_of(found, score, one) - np.log(counts[len(one)]) for one in sets])
    share = np.exp(logs - np.logaddexp.reduce(logs, 0))
    classes = [{one} for one in names] + [set(group) & set(names) for group in EQUIVALENT]
    sure, right = np.zeros(DRAWS), np.zeros(DRAWS, bool)
    for first, second in combinations([group for group in classes if group], 2):
        inside = [len(one) == 2 and _fall_into(one, first, second) for one in sets]
        together = share[inside].sum(0)
        better = together > sure * (1 + 1e-9)  # single effects before their class, where they are alike
        sure = np.where(better, together, sure)
        right = np.where(better, _fall_into([effect["name"] for effect in effects], first, second), right)
    return float(np.mean(right & (sure > SURE)))


def _fall_into(two: Sequence[str], first: set[str], second: set[str]) -> bool:
    """Return whether one of two effects is of one class and the other of the other."""
    a, b = two
    return (a in first and b in second) or (b in first and a in second)


def _log_evidence_of(found: Seen, score: Array, names: Sequence[str]) -> Array:
    """Return the logarithm of the likelihood of effects of unknown sizes against none, for scores (D, P), as (D)."""
    if not names:
        return np.zeros(len(score))
    own = [[k for k, other in enumerate(found.names) if other == name] for name in names]
    places, logs = [k for one in own for k in one], []
    sizes = SIZES if len(names) == 1 else SIZES[::2]
    for some in product(sizes, repeat=len(names)):
        width = np.concatenate([size * found.width[one] for size, one in zip(some, own, strict=True)])
        matrix = np.eye(len(places)) + found.information[np.ix_(places, places)] * np.outer(width, width)
        along = np.linalg.solve(np.linalg.cholesky(matrix), (score[:, places] * width).T)
        logs.append(0.5 * np.square(along).sum(0) - 0.5 * np.linalg.slogdet(matrix)[1])
    return np.logaddexp.reduce(logs, 0) - np.log(len(logs))


def _log_evidence(found: Seen, score: Array, name: str, nonnegative: bool) -> Array:
    """Return the logarithm of the likelihood of an effect of unknown size against none, for scores (D, P), as (D)."""
    own = [k for k, other in enumerate(found.names) if other == name]
    width = found.width[own]
    values, vectors = np.linalg.eigh(found.information[np.ix_(own, own)] * np.outer(width, width))
    values = values.clip(0.0)
    along, logs = (score[:, own] * width) @ vectors, []
    for size in SIZES:
        precision = values + size**-2.0
        log = 0.5 * (along**2 / precision).sum(1) - 0.5 * np.log(size**2 * precision).sum()
        if nonnegative and len(own) == 1:
            sign = float(vectors[0, 0])
            log = log + log_ndtr(sign * along[:, 0] / np.sqrt(precision[0])) + np.log(2)
        logs.append(log)
    return np.logaddexp.reduce(logs, 0) - np.log(len(SIZES))


def _true(found: Seen, effect: dict[str, Any]) -> Array:
    """Return the values (P) of a true effect, 0 for all others."""
    pairs = zip(found.names, found.numbers, strict=True)
    return np.array([effect["values"].get(number, 0.0) if own == effect["name"] else 0.0 for own, number in pairs])


def observed(truth: dict[str, Any], capture: Path, model: Path) -> dict[str, Any]:
    """Return what the ideal observer sees of the effects of a capture; None of those that are left out."""
    if not model.is_dir():
        fit(capture, model, stage="phys-geo", phys_config=base_settings("tracks"))
    found = seen(model, capture, truth)
    limits = {effect["name"]: limit(found, effect) for effect in truth["effects"] if effect["name"] in found.names}
    limits |= {name: None for name in limits if name == "ground_magnet"}
    row = {"case": truth["name"], "limits": {e["name"]: limits.get(e["name"]) for e in truth["effects"]}}
    if len(truth["effects"]) == 1 and limits.get(truth["effects"][0]["name"]) is not None:
        one_sided = frozenset(
            c.effect.name for c in library_of(()) if [p.nonnegative for p in c.effect.parameters] == [True]
        )
        row["best"] = best_recall(found, truth["effects"][0], one_sided)
    if len(truth["effects"]) == 2 and None not in row["limits"].values():
        row["best"] = best_pair_recall(found, truth["effects"])
    return {**row, "errors": true_errors(truth, capture, model)}


def true_errors(truth: dict[str, Any], capture: Path, model: Path) -> dict[str, Any]:
    """Return the errors of the test split before, and with the true effects at their numbers added to the model."""
    base, opened, effects = read_model(model), Capture.open(capture, splits=("test",)), []
    for effect in truth["effects"]:
        known = load_effect(effect["name"])
        names = {number.name for number in (*known.parameters, *known.constants)}
        values = {name: value for name, value in effect["values"].items() if name in names}
        effects.append(EffectModel(name=effect["name"], parameters=values))
    if any("drag" in load_effect(one.name).needs for one in effects):
        return {}  # a wind acts through a drag, whose number the truth has under another name
    added = replace(base, file=base.file.model_copy(update={"effects": (*base.file.effects, *effects)}))
    ends_s = first_contacts(model, opened)
    return {when: errors_of_test(one, opened, ends_s) for when, one in (("before", base), ("true", added))}


def is_nameable(found: Sequence[float] | None) -> bool | None:
    """Return whether an effect with these `chi2` and `apart` is nameable; None of one that is left out."""
    return None if found is None else found[0] > NAMEABLE[0] and found[1] > NAMEABLE[1]


PARTS = ("that move a body by 17 slow errors or more", "that move it by less", "pairs")
"""Parts of the captures of which the observer is asked."""


def parts_of(rows: Sequence[dict[str, Any]], truths: dict[str, Any]) -> list[list[dict[str, Any]]]:
    """Return the rows of each of `PARTS` whose effects are all such as the observer is asked of."""
    asked = [row for row in rows if None not in row["limits"].values()]
    single = [row for row in asked if len(row["limits"]) == 1]
    small = [row for row in single if (ratio_of(truths[row["case"]]) or 0.0) < BINS[0][1]]
    return [[row for row in single if row not in small], small, [row for row in asked if len(row["limits"]) == 2]]


def table(rows: Sequence[dict[str, Any]], truths: dict[str, Any], answers: dict[str, Any]) -> str:
    """Return how many effects are nameable, and how many of these were named, by their size and of pairs."""
    lines = []
    for part, own in zip(PARTS, parts_of(rows, truths), strict=True):
        told = [all(is_nameable(one) for one in row["limits"].values()) for row in own]
        lines.append(f"{part}: nameable {rate(told)}")
        best = [row["best"] for row in own if "best" in row]
        if best:
            error = 1.96 * float(np.std(best)) / np.sqrt(len(best))
            lines.append(
                f"{part}: the best observer names {sum(best):.1f} of {len(best)}, {np.mean(best):.0%} +- {error:.0%}"
            )
        lines += _named(part, own, truths, answers)
        lines += _named(f"{part}, nameable", [row for row, one in zip(own, told, strict=True) if one], truths, answers)
    for key in ("open_loop_m", "flight_m"):
        ratios = _ratios(rows, key)
        if ratios:
            low, middle, high = np.percentile(ratios, (25, 50, 75))
            lines.append(
                f"test split, true effects / none, {key}: {middle:.2f} ({low:.2f} to {high:.2f}), n {len(ratios)}"
            )
    return "\n".join(lines)


def _ratios(rows: Sequence[dict[str, Any]], key: str) -> list[float]:
    """Return errors of the test split with the true effects, over those without."""
    pairs = [(row["errors"]["before"][key], row["errors"]["true"][key]) for row in rows if row.get("errors")]
    return [after / before for before, after in pairs if before and after]


def record_figures(
    rows: Sequence[dict[str, Any]], truths: dict[str, Any], answers: dict[str, Any], command: str
) -> None:
    """Write what the best observer names, beside what cgwm names of the same captures, to benchmarks/results/."""
    for part, own in zip(PARTS, parts_of(rows, truths), strict=True):
        best = [row["best"] for row in own if "best" in row]
        marks = [judge(truths[row["case"]], answers["cgwm"].get(row["case"]))["mark"] in RIGHT for row in own]
        if best:
            what = "pairs of effects, both" if part == "pairs" else f"effects of flight and measurement {part}"
            reached = f", {100 * sum(marks) / sum(best):.0f} % of that" if sum(best) else ""
            record(
                "real_like",
                figure=f"real-like, {what}: an observer who knows the errors would name",
                value=f"{sum(best):.1f} of {len(best)} ({100 * np.mean(best):.0f} %)",
                target="",
                met=None,
                note=f"cgwm names {sum(marks)} of the same captures of {command.rsplit(maxsplit=1)[-1]}{reached}",
                command=command,
            )
    for key, where in (("open_loop_m", ""), ("flight_m", " before the first contact")):
        ratios = _ratios(rows, key)
        if ratios:
            low, middle, high = np.percentile(ratios, (25, 50, 75))
            record(
                "real_like",
                figure=f"real-like, open-loop error on test episodes{where}, with the true effect at its true numbers "
                "/ without it",
                value=round(float(middle), 2),
                note=f"median of {len(ratios)} captures, named or not; half lie within {low:.2f} to {high:.2f}",
                command=command,
            )


def _named(what: str, rows: Sequence[dict[str, Any]], truths: dict[str, Any], answers: dict[str, Any]) -> Iterator[str]:
    """Yield a line that says how many of some captures were named, for each contender."""
    for who, own in answers.items():
        marks = [judge(truths[row["case"]], own.get(row["case"]))["mark"] in RIGHT for row in rows]
        yield f"{what}: {who} names {rate(marks)}"


def _answers(path: Path) -> dict[str, Any]:
    """Return the answers in a store of `missing_effects.py`, by contender and case."""
    found: dict[str, Any] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        if "contender" in row:
            found.setdefault(row["contender"], {})[row["case"]] = row.get("answer")
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Print what an ideal observer sees of each capture, and how often it is enough."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stage", choices=STAGES, default="development")
    parser.add_argument("--captures", type=Path, default=None, help="as of missing_effects.py")
    parser.add_argument("--only", default="", help="part of the name")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no capture after this time")
    parser.add_argument("--out", type=Path, default=None, help="file of the results, JSON lines; known cases are kept")
    parser.add_argument("--answers", type=Path, default=None, help="store of missing_effects.py: recall of what is")
    parser.add_argument("--record", action="store_true", help="with --answers: write a report's figures to results/")
    given = parser.parse_args(words)
    if given.record and not given.answers:
        parser.error("--record wants --answers, of the same captures.")
    captures, deadline = given.captures or ROOT / "out" / "real_like" / given.stage, time.monotonic() + given.seconds
    models = captures.with_name(f"{captures.name}.models")
    paths = sorted(captures.with_name(f"{captures.name}.truth").glob("*.json"))
    truths = {one["name"]: one for one in (json.loads(path.read_text(encoding="utf-8")) for path in paths)}
    truths = {name: one for name, one in truths.items() if _is_asked(one) and given.only in name}
    lines = given.out.read_text(encoding="utf-8").splitlines() if given.out and given.out.is_file() else []
    rows = [json.loads(line) for line in lines]
    todo = [one for name, one in truths.items() if name not in {row["case"] for row in rows}]
    with ProcessPoolExecutor(given.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        places = [one["name"].replace("/", "__") for one in todo]
        futures = [
            pool.submit(_within, one, captures / place, models / place, deadline)
            for one, place in zip(todo, places, strict=True)
        ]
        for future in as_completed(futures):
            row = future.result()
            if row is None:
                continue
            rows.append(row)
            print(json.dumps(row), flush=True)
            if given.out:
                with given.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    rows = [row for row in rows if row["case"] in truths]
    answers = _answers(given.answers) if given.answers else {}
    print(table(rows, truths, answers))
    if given.record:
        record_figures(rows, truths, answers, f"python benchmarks/ideal_observer.py --stage {given.stage}")
    return 0


def _is_asked(truth: dict[str, Any]) -> bool:
    """Return whether all effects of a capture act in flight or in the measurement."""
    acts = [EFFECTS[effect["name"]].acts for effect in truth["effects"]]
    return bool(acts) and set(acts) <= {"flight", "measurement"}


def _within(truth: dict[str, Any], capture: Path, model: Path, deadline: float) -> dict[str, Any] | None:
    """Return what the observer sees, None after the deadline or where the capture is refused."""
    if time.monotonic() > deadline:
        return None
    try:
        return observed(truth, capture, model)
    except CgwmError:
        return None


if __name__ == "__main__":
    sys.exit(main())
