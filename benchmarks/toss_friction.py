"""Which friction repeats the tosses of an engine, with all else true: whether a toss has one coefficient of friction.

    pip install --no-deps -r benchmarks/requirements.txt
    python benchmarks/toss_friction.py run --workers 2
    python benchmarks/toss_friction.py table
    python benchmarks/toss_friction.py account --seed 110

Nothing is filmed: as in `engine_floor.py`, our law predicts each motion of Fall open loop from its true state with the
true shape, mass and contact numbers, with the stated friction times each of `FACTORS`. The motion to learn from (15
frames) says what a fit without any error of measurement would find; the ten others, what would predict them best.
Captures of development: objects of boxes on three grounds, seeds 102 and 103.

`account` says how friction acts in the motion to learn from: the horizontal over the vertical impulse, in units of the
stated friction, while the ground carries more than `IMPACT` times the weight, and while it carries less and the body
moves along it; and how long the latter lasts.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.dynamics import GRAVITY, STEPS_PER_S, matrix_from_quat
from cgwm.datasets.synthetic.plan import ScenePlan
from cgwm.schemas import NotConvergedError
from engine_floor import UNIT_DEG, UNIT_MM
from numpy.typing import NDArray
from store import Store
from tabletop.capture import plan_capture
from tabletop.engines import ENGINES, refusal
from tabletop.jobs import ObjectJob
from tabletop.materials import MATERIALS
from tabletop.objects import load_item
from tabletop.true_world import Numbers, pose_errors, spheres_of, true_world

FACTORS = (0.3, 0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 1.35, 1.5)
OBJECTS = ("box", "l_block")
SEEDS = (102, 103)
TESTS = 10
_STATED = FACTORS.index(1.0)
IMPACT, CARRIED, MOVING_M_S, _BIN_S = 2.5, 0.3, 0.03, 0.005
"""Vertical force in units of the weight above which contact counts as an impact, and below which as none; least speed
of a slide; and over how long forces are averaged."""


def measure(job: ObjectJob) -> dict[str, Any]:
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


@dataclass(frozen=True)
class Account:
    """How friction acts in a motion: impulse ratios in units of the stated friction, None where nothing acts [1]."""

    impact: float | None
    slide: float | None
    share: float
    """Share of impacts in the horizontal impulse."""
    slide_s: float
    """Duration of the slides [s]."""

    @staticmethod
    def of(plan: ScenePlan) -> Account:
        """Take the account of the motion to learn from, from the momentum of its centre of mass."""
        motion = plan.episodes[0].motion
        first = motion.row(0.0)
        com = np.array([row[:3] + matrix_from_quat(row[3:7]) @ plan.solid.com for row in motion.qpos[first:]])
        velocity = (np.gradient(com, axis=0) * STEPS_PER_S)[:: round(_BIN_S * STEPS_PER_S)]
        change = np.diff(velocity, axis=0)
        up, along = change[:, 2] + GRAVITY * _BIN_S, np.hypot(change[:, 0], change[:, 1])
        load = up / (GRAVITY * _BIN_S)
        impact = load > IMPACT
        slide = (load > CARRIED) & ~impact & (np.hypot(velocity[1:, 0], velocity[1:, 1]) > MOVING_M_S)
        in_impacts, in_slides = (
            float(along[kind].sum() / up[kind].sum() / plan.contact.friction) if kind.any() else None
            for kind in (impact, slide)
        )
        both = float(along[impact | slide].sum())
        share = float(along[impact].sum()) / both if both else 0.0
        return Account(in_impacts, in_slides, share, float(slide.sum()) * _BIN_S)


def account(seed: int) -> str:
    """Return by engine how friction acts in the tosses to learn from, in Markdown: medians (least to largest)."""
    lines = [
        "| engine | captures | impacts | slides | share of impacts % | slides last s |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for engine in ENGINES:
        found = []
        for name, material in itertools.product(OBJECTS, MATERIALS):
            item = load_item(name)
            if refusal(engine, item.solid) is None:
                with contextlib.suppress(NotConvergedError):
                    found.append(Account.of(plan_capture(item, name, material, "fall", seed, 0, engine)[0]))
        if found:
            cells = [_range([one.impact for one in found]), _range([one.slide for one in found])]
            cells += [_range([100 * one.share for one in found], "{:.0f}"), _range([one.slide_s for one in found])]
            lines.append(f"| {engine} | {len(found)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _range(values: Sequence[float | None], form: str = "{:.2f}") -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    middle, low, high = (form.format(value) for value in (np.median(known), min(known), max(known)))
    return f"{middle} ({low} to {high})"


def _quartiles(values: Any) -> str:
    low, middle, high = np.percentile(values, (25, 50, 75))
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def main() -> int:
    """Measure what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table", "account"))
    parser.add_argument("--seed", type=int, default=110, help="of the captures of the account, below 500")
    parser.add_argument("--engines", default=",".join(ENGINES))
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    unknown = [name for name in given.engines.split(",") if name not in ENGINES]
    if unknown:
        parser.error(f"--engines: {unknown[0]!r} is none of {', '.join(ENGINES)}")
    if given.what == "account":
        print(account(given.seed))
        return 0
    store = Store("toss_friction", given.store, given.any_commit)
    if given.what == "table":
        print(table(store.results()))
        return 0
    jobs = [ObjectJob(*one) for one in itertools.product(given.engines.split(","), OBJECTS, MATERIALS, SEEDS)]
    order = np.random.default_rng(0).permutation(len(jobs))
    store.fill(measure, {jobs[k].key: (jobs[k],) for k in order}, given.workers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
