"""The floor of Fall, Push and Tip against several engines: our law of contact with the true shape, mass and friction.

    pip install --no-deps -r benchmarks/requirements.txt
    python benchmarks/engine_floor.py run --stage dev --workers 2
    python benchmarks/engine_floor.py run --stage report --workers 2
    python benchmarks/engine_floor.py table
    python benchmarks/engine_floor.py friction
    python benchmarks/engine_floor.py impacts

Nothing is fitted, filmed or rendered: what an open-loop prediction from the true state misses by is what the law cannot
express, or what nobody can predict. Friction is the engine's own. Natural time and damping ratio have a counterpart in
MuJoCo alone; the row `stated` takes the numbers from which every engine's contacts were made, the row `best` those of a
grid that predict the development captures of the same engine and ground best, over all tasks and objects. The report
tries these two alone, so it comes after development.

Captures are drawn by seeds: those of development from 100 on, those of the report from 500 on. A cell that an engine
cannot simulate is printed with its reason.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.dynamics import (
    GRAVITY,
    STEPS_PER_S,
    Motion,
    lowest,
    matrix_from_quat,
    quat_from_matrix,
    rest_pose,
)
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.schemas import NotConvergedError
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from store import Keyed, Store
from tabletop.capture import TASKS, Task, plan_capture
from tabletop.engines import ENGINES, JUDGES, refusal
from tabletop.materials import MATERIALS
from tabletop.objects import load_item
from tabletop.true_world import Numbers, Spheres, pose_errors, spheres_of, true_world

FIRST_SEED = {"dev": 100, "report": 500}
OBJECTS = ("box", "l_block", "mustard_bottle", "mug")
TIMES_S = (0.002, 0.003, 0.0045, 0.007, 0.011, 0.017)
RATIOS = (0.15, 0.25, 0.4, 0.6, 0.9)
GRID = tuple(f"{time:g} {ratio:g}" for time, ratio in itertools.product(TIMES_S, RATIOS))
DIRECTIONS_DEG = (0.0, 22.5, 45.0, 67.5, 90.0)
_APART_M = 1e-4
"""Height of the lowest corner from which on a body has left the ground."""
UNIT_MM, UNIT_DEG = 10.0, 10.0
"""Errors count in these units where one number must be found."""


@dataclass(frozen=True)
class Job(Keyed):
    """One capture: `tests` motions of an object on a ground, by an engine."""

    stage: str
    engine: str
    task: Task
    object: str
    material: str
    seed: int
    tests: int


def jobs(stage: str, engines: Sequence[str], captures: int, tests: int) -> list[Job]:
    """Return the captures: per engine and task so many, objects and grounds in turn, each of a seed of its own."""
    pairs = list(itertools.product(OBJECTS, MATERIALS))
    order = np.random.default_rng(0).permutation(len(pairs))
    result = []
    for task, index in itertools.product(TASKS, range(captures)):
        obj, material = pairs[order[index % len(pairs)]]
        result += [Job(stage, engine, task, obj, material, FIRST_SEED[stage] + index, tests) for engine in engines]
    return result


@cache
def _spheres(name: str) -> Spheres:
    return spheres_of(load_item(name).solid)


def measure(job: Job, tried: Sequence[str]) -> dict[str, Any]:
    """Return the errors of the stated numbers and of those to be tried in one capture, or why there is none."""
    item = load_item(job.object)
    reason = refusal(job.engine, item.solid)
    if reason is not None:
        return {"not_run": reason}
    try:
        plan, left_out = plan_capture(item, job.object, job.material, job.task, job.seed, job.tests, job.engine)
    except NotConvergedError as error:
        return {"not_run": error.found}
    tests = [episode for episode in plan.episodes if episode.split == "test"]
    contact = plan.contact
    stated = Numbers(contact.natural_time, contact.damping_ratio)
    stated_key, errors = f"{stated.contact_time_s:g} {stated.damping_ratio:g}", {}
    for key in dict.fromkeys((stated_key, *tried)):
        numbers = stated if key == stated_key else Numbers(*(float(part) for part in key.split()))
        world = true_world(item.solid, _spheres(job.object), contact, plan.fingertip, numbers)
        found = [pose_errors(world, plan, episode) for episode in tests]
        errors[key] = np.round(found, 3).tolist()
    still = [_moved(episode.motion.qpos, plan.frame_rate, episode.frame_count) for episode in tests]
    return {"stated": stated_key, "errors": errors, "frozen_mm": still, "left_out": left_out}


def _moved(qpos: Any, rate: float, frames: int) -> float:
    """Return the mean error [mm] of the prediction that nothing moves."""
    rows = np.linspace(0, len(qpos) - 1, frames).astype(int)
    return round(1e3 * float(np.linalg.norm(qpos[rows, :3] - qpos[0, :3], axis=1).mean()), 2)


def best_numbers(rows: Sequence[dict[str, Any]]) -> dict[tuple[str, str], str]:
    """Return the numbers of the grid that predict development captures best, by engine and ground.

    Best is the least mean over captures of the median error, place and orientation each in its unit.
    """
    result = {}
    for engine, material in itertools.product(ENGINES, MATERIALS):
        chosen = [r for r in rows if (r["engine"], r["material"]) == (engine, material) and "errors" in r]
        if not chosen:
            continue
        scores = [np.mean([_score(row["errors"][key]) for row in chosen]) for key in GRID]
        result[engine, material] = GRID[int(np.argmin(scores))]
    return result


def _score(errors: Sequence[Sequence[float]]) -> float:
    values = np.asarray(errors)
    return float(np.median(values[:, 0] / UNIT_MM + values[:, 1] / UNIT_DEG))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the floor by task and engine in Markdown: medians and means over the episodes of the report."""
    best = best_numbers([row for row in rows if row["stage"] == "dev"])
    lines = [
        "| task | engine | captures | stated numbers: mm / deg | best numbers: mm / deg | nothing moves: mm |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    report = [row for row in rows if row["stage"] == "report"]
    for task, engine in itertools.product(TASKS, (*ENGINES, "all but mujoco")):
        engines = [one for one in JUDGES if one not in ("mujoco", "mujoco_default")] if " " in engine else [engine]
        chosen = [row for row in report if row["task"] == task and row["engine"] in engines and "errors" in row]
        if not chosen:
            continue
        stated = np.concatenate([row["errors"][row["stated"]] for row in chosen])
        tuned = [row["errors"][best[row["engine"], row["material"]]] for row in chosen if _known(best, row)]
        moved = np.concatenate([row["frozen_mm"] for row in chosen])
        found = _both(np.concatenate(tuned)) if len(tuned) == len(chosen) else "–"
        lines.append(f"| {task} | {engine} | {len(chosen)} | {_both(stated)} | {found} | {np.median(moved):.0f} |")
    lines += ["", "Medians, with means in brackets. Not run:"]
    reasons = sorted({f"{r['engine']}, {r['task']}, {r['object']}: {r['not_run']}" for r in report if "not_run" in r})
    return "\n".join((*lines, *(f"- {reason}" for reason in reasons or ["nothing"])))


def _known(best: dict[tuple[str, str], str], row: dict[str, Any]) -> bool:
    return (row["engine"], row["material"]) in best


def _both(errors: Any) -> str:
    middle, mean = np.median(errors, axis=0), np.mean(errors, axis=0)
    return f"{middle[0]:.1f} / {middle[1]:.1f} ({mean[0]:.1f} / {mean[1]:.1f})"


def friction_by_direction(engine: str) -> list[float]:
    """Return the friction that a sliding box feels along `DIRECTIONS_DEG` of the world, from how far it slides.

    Coulomb's law gives v^2 / (2 g distance) in every direction; an engine that cuts the cone into a pyramid does not.

    Args:
        engine: One of `ENGINES`.
    """
    item, speed = load_item("box"), 0.7
    made = ENGINES[engine].make(item.solid, MATERIALS["wood"], False)
    pose = rest_pose(item.solid, item.down, 0.3, 0, 0)
    result = []
    for angle in np.radians(DIRECTIONS_DEG):
        motion = made.simulate(pose, np.array([speed * np.cos(angle), speed * np.sin(angle), 0, 0, 0, 0]), 0.0, 0.8)
        distance = float(np.linalg.norm(motion.qpos[-1, :2] - motion.qpos[0, :2]))
        result.append(speed**2 / (2 * GRAVITY * distance))
    return result


def friction_of_impacts(engine: str, material: str) -> list[float]:
    """Return the friction that a box feels in an impact on a face or a corner while it slides, over the ground's.

    Coulomb's law gives a horizontal impulse of friction times the vertical one, 1 here, as long as all that touches
    slides.

    Args:
        engine: One of `ENGINES`.
        material: One of `MATERIALS`.
    """
    item, contact, speed, fall = load_item("box"), MATERIALS[material], 4.0, 1.4
    made = ENGINES[engine].make(item.solid, contact, False)
    result = []
    flat = matrix_from_quat(rest_pose(item.solid, item.down, 0.3, 0, 0)[3:7])
    for angle, tilt in itertools.product(np.radians(DIRECTIONS_DEG), ((0, 0, 0), (0.4, 0.3, 0), (0.3, -0.4, 0))):
        quat = quat_from_matrix(Rotation.from_rotvec(tilt).as_matrix() @ flat)
        pose = np.array([0, 0, 0, *quat])
        pose[2] = lowest(item.solid, pose[3:7]) + 0.002
        start = np.array([speed * np.cos(angle), speed * np.sin(angle), -fall, 0, 0, 0])
        motion = made.simulate(pose, start, 0.0, 0.06)
        heights = np.array([qpos[2] - lowest(item.solid, qpos[3:7]) for qpos in motion.qpos])
        touched = int(np.argmax(heights < _APART_M))
        above = np.flatnonzero(heights[touched:] > _APART_M)
        left = touched + int(above[0]) if len(above) else len(heights) - 2
        change = _velocity(item.solid, motion, left + 1) - _velocity(item.solid, motion, 0)
        change[2] += GRAVITY * (left + 1) / STEPS_PER_S
        result.append(float(np.hypot(change[0], change[1]) / change[2] / contact.friction))
    return result


def _velocity(solid: SolidObject, motion: Motion, row: int) -> NDArray[np.float64]:
    """Return the velocity of the centre of mass [m/s]."""
    turn = matrix_from_quat(motion.qpos[row, 3:7])
    return motion.qvel[row, :3] + turn @ np.cross(motion.qvel[row, 3:6], solid.com)


def impact_table() -> str:
    """Return the friction of impacts by engine and ground in Markdown."""
    lines = ["| engine | " + " | ".join(MATERIALS) + " |", "| --- |" + " --- |" * len(MATERIALS)]
    for name in JUDGES:
        reason = refusal(name, load_item("box").solid)
        if reason is not None:
            cells = [reason] * len(MATERIALS)
        else:
            found = [np.percentile(friction_of_impacts(name, one), (50, 0, 100)) for one in MATERIALS]
            cells = [f"{middle:.2f} ({low:.2f} to {high:.2f})" for middle, low, high in found]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join((*lines, "Median (least to largest) over directions and orientations; 1 by Coulomb's law."))


def friction_table() -> str:
    """Return the friction of every engine by direction in Markdown."""
    lines = ["| engine | " + " | ".join(f"{angle:g} deg" for angle in DIRECTIONS_DEG) + " |"]
    lines += ["| --- |" + " --- |" * len(DIRECTIONS_DEG)]
    for name in JUDGES:
        reason = refusal(name, load_item("box").solid)
        cells = [reason] if reason else [f"{value:.3f}" for value in friction_by_direction(name)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join((*lines, f"Given: {MATERIALS['wood'].friction:g}."))


def main() -> int:
    """Measure what is missing, or print the table of what is stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table", "friction", "impacts"))
    parser.add_argument("--stage", choices=tuple(FIRST_SEED), default="dev")
    parser.add_argument("--engines", default=",".join(JUDGES))
    parser.add_argument("--captures", type=int, default=8, help="of every engine and task")
    parser.add_argument("--tests", type=int, default=10, help="episodes of a capture")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    unknown = [name for name in given.engines.split(",") if name not in ENGINES]
    if unknown:
        parser.error(f"--engines: {unknown[0]!r} is none of {', '.join(ENGINES)}")
    if given.what in ("friction", "impacts"):
        print(friction_table() if given.what == "friction" else impact_table())
        return 0
    store = Store("engine_floor", given.store, given.any_commit)
    if given.what == "table":
        print(table(store.results()))
        return 0
    wanted = jobs(given.stage, given.engines.split(","), given.captures, given.tests)
    best = best_numbers([row for row in store.results() if row["stage"] == "dev"]) if given.stage == "report" else {}
    store.fill(_row, {job.key: (job, _tried(job, best)) for job in wanted}, given.workers)
    return 0


def _tried(job: Job, best: dict[tuple[str, str], str]) -> tuple[str, ...]:
    """Return the numbers to be tried: the whole grid in development, the best of it afterwards."""
    if job.stage == "dev":
        return GRID
    return tuple(best[key] for key in ((job.engine, job.material),) if key in best)


def _row(job: Job, tried: Sequence[str]) -> dict[str, Any]:
    return vars(job) | measure(job, tried)


if __name__ == "__main__":
    sys.exit(main())
