"""Which friction repeats the tosses of an engine, with all else true: whether a toss has one coefficient of friction.

    pip install --no-deps -r benchmarks/requirements.txt
    python benchmarks/toss_friction.py run --workers 2
    python benchmarks/toss_friction.py table

Nothing is filmed: as in `engine_floor.py`, our law predicts each motion of Fall open loop from its true state with the
true shape, mass and contact numbers, with the stated friction times each of `FACTORS`. The motion to learn from (15
frames) says what a fit without any error of measurement would find; the ten others, what would predict them best.
Captures of development: objects of boxes on three grounds, seeds 102 and 103.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from engine_floor import UNIT_DEG, UNIT_MM
from numpy.typing import NDArray
from store import Keyed, Store
from tabletop.capture import plan_capture
from tabletop.engines import ENGINES, refusal
from tabletop.materials import MATERIALS
from tabletop.objects import load_item
from tabletop.true_world import Numbers, pose_errors, spheres_of, true_world

FACTORS = (0.3, 0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 1.35, 1.5)
OBJECTS = ("box", "l_block")
SEEDS = (102, 103)
TESTS = 10
_STATED = FACTORS.index(1.0)


@dataclass(frozen=True)
class Job(Keyed):
    """The tosses of one capture."""

    engine: str
    object: str
    material: str
    seed: int


def measure(job: Job) -> dict[str, Any]:
    """Return the errors [mm, deg] of every motion, the one to learn from first, by factor; or why there are none."""
    item = load_item(job.object)
    reason = refusal(job.engine, item.solid)
    if reason is not None:
        return vars(job) | {"not_run": reason}
    plan, _ = plan_capture(item, job.object, job.material, "fall", job.seed, TESTS, job.engine)
    spheres, contact = spheres_of(item.solid), plan.contact
    numbers = Numbers(contact.natural_time, contact.damping_ratio)
    errors = []
    for factor in FACTORS:
        tried = replace(contact, friction=factor * contact.friction)
        world = true_world(item.solid, spheres, tried, plan.fingertip, numbers)
        errors.append(np.round([pose_errors(world, plan, one) for one in plan.episodes], 3).tolist())
    return vars(job) | {"errors": errors}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return what repeats the tosses best, by engine, in Markdown: medians over captures or motions (quartiles)."""
    lines = [
        "| engine | captures | best for the training motion | for each test | for all tests | mm / deg with it "
        "| as stated |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for engine in ENGINES:
        found = [np.array(row["errors"]) for row in rows if row["engine"] == engine and "errors" in row]
        if found:
            lines.append(_line(engine, found))
    return "\n".join(lines)


def _line(engine: str, found: Sequence[NDArray[np.float64]]) -> str:
    scores = [errors[..., 0] / UNIT_MM + errors[..., 1] / UNIT_DEG for errors in found]  # (factor, motion)
    factors = np.array(FACTORS)
    training = [factors[score[:, 0].argmin()] for score in scores]
    each = np.concatenate([factors[score[:, 1:].argmin(0)] for score in scores])
    common = [int(np.median(score[:, 1:], axis=1).argmin()) for score in scores]
    best, stated = (
        np.median([np.median(errors[k, 1:], axis=0) for errors, k in zip(found, places, strict=True)], axis=0)
        for places in (common, [_STATED] * len(found))
    )
    cells = [engine, str(len(found)), _quartiles(training), _quartiles(each), _quartiles(factors[common])]
    return "| " + " | ".join([*cells, f"{best[0]:.1f} / {best[1]:.1f}", f"{stated[0]:.1f} / {stated[1]:.1f}"]) + " |"


def _quartiles(values: Any) -> str:
    low, middle, high = np.percentile(values, (25, 50, 75))
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def main() -> int:
    """Measure what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("--engines", default=",".join(ENGINES))
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    unknown = [name for name in given.engines.split(",") if name not in ENGINES]
    if unknown:
        parser.error(f"--engines: {unknown[0]!r} is none of {', '.join(ENGINES)}")
    store = Store("toss_friction", given.store, given.any_commit)
    if given.what == "table":
        print(table(store.results()))
        return 0
    jobs = [Job(*one) for one in itertools.product(given.engines.split(","), OBJECTS, MATERIALS, SEEDS)]
    order = np.random.default_rng(0).permutation(len(jobs))
    store.fill(measure, {jobs[k].key: (jobs[k],) for k in order}, given.workers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
