"""Does the throw that `cgwm diagnose` ranks first tell two rivals apart, and by how much more than the last one?

    python benchmarks/next_throw.py --stage report --workers 2 [--only ball]

Each case is a capture whose motions cannot tell two effects apart (all drops, all slides or all rolls), one of which is
hidden, with MuJoCo as the truth. The throws that a hand can make are ranked for the two; the first and the last are
then made in MuJoCo, with the noise of the case, and added to the data. What each gained is the change of the
log-likelihood ratio of what is hidden over its rival, both refitted with the states of all segments; contact counts
less by the chi2 per degree of freedom that the law of contact leaves, as it does in the ranking. Goal: in 80 % of the
pairs the first gains at least three times what the last does.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args
from zlib import crc32

import numpy as np
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.datasets.models.model import read_model
from cgwm.datasets.synthetic.hidden_effects.mechanics import Mechanics, Start, build
from cgwm.datasets.synthetic.hidden_effects.record import ENGINES, measured
from cgwm.datasets.synthetic.hidden_effects.things import Kind
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.evidence.score_test import ScoreTest
from cgwm.pipeline.diagnose.next_experiment.experiments import DEFAULT, experiments_of
from cgwm.pipeline.diagnose.next_experiment.throws import RankedExperiment, Rivals, ranked_experiments
from cgwm.pipeline.diagnose.stage import prepared_world
from cgwm.pipeline.fit import fit
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.parameters import effect_parameters
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments.candidates import Candidate, base_parameters
from cgwm.pipeline.segments.prepare import Prepared, prepare
from cgwm.pipeline.segments.segment_fit import Refit, refit
from cgwm.pipeline.segments.segments import Segments
from diagnose import base_settings
from hidden_effects import Case, make_capture
from store import Store, timed

Stage = Literal["development", "report", "report2", "report3", "report4", "report5", "report6"]
"""Reports are read once each."""
Alone = Literal["throws", "slides", "drops", "rolls"]

PAIRS: tuple[tuple[Kind, Alone, str, str], ...] = (
    ("ball", "drops", "linear_drag", "quadratic_drag"),
    ("cube", "drops", "quadratic_drag", "linear_drag"),
    ("cube", "slides", "linear_drag", "viscous_friction"),
    ("cube", "slides", "viscous_friction", "linear_drag"),
    ("ball", "rolls", "rolling_resistance", "linear_drag"),
    ("ball", "rolls", "linear_drag", "rolling_resistance"),
    ("cube", "slides", "com_offset", "gravity_tilt"),
    ("cube", "slides", "gravity_tilt", "com_offset"),
    ("ball", "drops", "buoyancy", "linear_drag"),
    ("cube", "drops", "gravity_scale", "quadratic_drag"),
)
"""Body, its only motion, what is hidden, and its rival."""
REPEATS = 2
LEAST_NATS = 1.0
"""A gain below this counts as this: the noise of a log-likelihood ratio."""
TIMES = 3.0


def cases(stage: Stage) -> list[tuple[Case, str]]:
    """Return the cases, each with the rival of what is hidden; the stages have no seed in common."""
    found = []
    for thing, protocol, hidden, rival in PAIRS:
        for k in range(REPEATS):
            name = f"next/{stage}/{thing}/{protocol}/{hidden}-{rival}/{k}"
            seed = 2 * (crc32(name.encode()) // 2) + (stage != "development")
            case = Case(name, thing, (hidden,), "large", seed, law=1 + k % 2, protocol=protocol, train=4, test=1)
            found.append((case, rival))
    return found


def measure(case: Case, rival: str) -> dict[str, Any]:
    """Return what the ranking promised of its first and last throw, and what they gained."""
    pair = (case.effects[0], rival)
    with tempfile.TemporaryDirectory() as folder:
        capture, base = Path(folder) / "capture", Path(folder) / "m0"
        make_capture(capture, case)
        fit(capture, base, stage="phys-geo", phys_config=base_settings("tracks"))
        opened = Capture.open(capture, splits=("train",))
        world, prepared = prepared_world(read_model(base), opened, "train")
        tracks = [Episode(name, opened.tracks(name)) for name in prepared.names]
    fits = [_with(prepared, world, name) for name in pair]
    discount = max(1.0, min(_contact_chi2(one) for one in fits))
    rivals = Rivals((_evidence(pair[0], fits[0]), _evidence(pair[1], fits[1])), world)
    ranked = ranked_experiments(prepared, rivals, experiments_of(DEFAULT), discount)
    before = _nats(fits[0], fits[1], discount)
    rows = {}
    for place, one in (("first", ranked[0]), ("last", ranked[-1])):
        more = prepare(world, [*tracks, Episode(place, {case.thing: made(case, one)})], prepared.noise)
        after = _nats(_with(more, world, pair[0]), _with(more, world, pair[1]), discount)
        (key,) = one.by_pair
        rows[place] = {
            "throw": one.throw.what,
            "promised_nats": round(one.by_pair[key], 2),
            "least_nats": round(one.least[key], 2),
            "gained_nats": round(after - before, 2),
        }
    return {"case": case.name, "hidden": pair[0], "rival": rival, "before_nats": round(before, 2), **rows}


def made(case: Case, ranked: RankedExperiment) -> Track:
    """Return a throw as MuJoCo moves it, measured as the case is."""
    hidden = case.drawn_effects()
    world = build(Mechanics.of(case.drawn_thing(), case.law), hidden)
    start = Start(**{key: np.array(value) for key, value in ranked.state.items()})
    motion = ENGINES[case.engine].simulate(world, hidden, start, ranked.throw.duration_s)
    timed_case = replace(case, length_s=ranked.throw.duration_s)
    return measured(timed_case, hidden, motion, case.rng(f"noise {ranked.throw.what}"))[0]


def _parts(prepared: Prepared, world: World) -> list[Segments]:
    contact = prepared.contact(world)
    return [part for part in (prepared.flight, contact) if part is not None]


def _contact_chi2(found: Refit) -> float:
    """Return the mean chi2 per degree of freedom that contact is left with, each segment's loss being robust."""
    for part, losses in zip(found.segments, found.by_segment, strict=True):
        if part.kind == "contact":
            dof = float(part.dof.sum())
            return (float(losses.sum()) + dof) / dof
    return 1.0


def _with(prepared: Prepared, world: World, name: str) -> Refit:
    """Return the refit of all segments with an effect beside the model's numbers."""
    added = replace(world, effects=(*world.effects, ActiveEffect.of(load_effect(name))))
    own = [p for p in effect_parameters(added) if p.name.startswith(f"{name}.")]
    return refit(_parts(prepared, world), added, [*base_parameters(world, "contact"), *own])


def _nats(hidden: Refit, rival: Refit, discount: float) -> float:
    """Return the log-likelihood ratio of two refits, contact discounted."""
    shares = {"flight": 1.0, "contact": 1.0 / discount}
    costs = [
        sum(shares[part.kind] * float(losses.sum()) for part, losses in zip(one.segments, one.by_segment, strict=True))
        for one in (rival, hidden)
    ]
    return 0.5 * (costs[0] - costs[1])


def _evidence(name: str, found: Refit) -> Evidence:
    effect = load_effect(name)
    numbers = {p.name: found.number(f"{name}.{p.name}") for p in effect.parameters}
    values = np.array([value for value, _ in numbers.values()])
    test = ScoreTest(
        statistic=0.0, dof=len(values), p_value=1.0, estimate=values, covariance=np.eye(len(values)), admissible=True
    )
    return Evidence(candidate=Candidate(name, effect), constants={}, test=test, p_value=1.0, numbers=numbers)


def _timed(case: Case, rival: str) -> dict[str, Any]:
    return timed(lambda: measure(case, rival))


def _times(row: dict[str, Any]) -> float:
    return row["first"]["gained_nats"] / max(row["last"]["gained_nats"], LEAST_NATS)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return what was promised and gained, pair by pair, and how many reach the goal."""
    lines = ["| case | before | first throw | promised | gained | last throw | promised | gained | times |"]
    lines.append("|---" * 9 + "|")
    for row in rows:
        words = [row["case"].partition("/")[2].partition("/")[2], f"{row['before_nats']:.1f}"]
        for place in ("first", "last"):
            one = row[place]
            words += [one["throw"], f"{one['promised_nats']:.1f}", f"{one['gained_nats']:.1f}"]
        lines.append("| " + " | ".join([*words, f"{_times(row):.1f}"]) + " |")
    reached = sum(_times(row) >= TIMES for row in rows)
    lines.append(f"\nThe first gains {TIMES:g} times what the last does, or more: {reached} of {len(rows)}.")
    return "\n".join(lines)


def main() -> int:
    """Measure the pairs, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stage", choices=get_args(Stage), default="development")
    parser.add_argument("--only", default="", help="cases whose names contain this")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    given = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"  # the workers start with it
    store = Store("next_throw", given.store)
    chosen = [(case, rival) for case, rival in cases(given.stage) if given.only in case.name]
    with ProcessPoolExecutor(given.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        waiting = {
            case.name: pool.submit(_timed, case, rival) for case, rival in chosen if store.known(case.name) is None
        }
        for name, future in waiting.items():
            error = future.exception()
            if error is None:
                store.add(name, future.result())
            else:
                print(json.dumps({"case": name, "failed": f"{type(error).__name__}: {error}"}), flush=True)
    names = {case.name for case, _ in chosen}
    rows = [row for row in store.results() if row["key"] in names]
    print(table(rows))
    return 0 if len(rows) == len(chosen) and sum(_times(row) >= TIMES for row in rows) >= 0.8 * len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
