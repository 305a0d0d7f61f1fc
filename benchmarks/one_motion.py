"""Friction from one motion whose poses, shape and mass are true: what of a fit's error does not come from images.

    pip install --no-deps -r benchmarks/requirements.txt
    python benchmarks/one_motion.py run --engines mujoco,dart,rapier --seeds 310,311 --workers 2
    python benchmarks/one_motion.py run --engines mujoco,dart,rapier,drake,cgwm --tasks fall,tip --seeds 110
    python benchmarks/one_motion.py table

The training episode of Fall, Push and Tip, and of the scene `push` (task `slow`: the finger stops at the body), with
the noise of poses found in videos. The laws: `shared`, one law for the ground and the finger; `own`, as `cgwm fit` has
it.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.datasets.synthetic import plan_scene
from cgwm.datasets.synthetic.dynamics import FINGERTIP
from cgwm.datasets.synthetic.plan import ScenePlan
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.physics.world import World
from cgwm.schemas import NotConvergedError, PhysConfig
from store import Keyed, Store
from tabletop.capture import Task, plan_capture
from tabletop.engines import ENGINES, refusal
from tabletop.materials import MATERIALS
from tabletop.objects import load_item
from tabletop.true_world import OBJECT, Numbers, finger_track, spheres_of, true_world

NOISE = (5e-4, 5e-3)
"""Of the poses: position [m], rotation [rad]."""
SLOW = "slow"
TASKS, LAWS = ("fall", "push", "tip", SLOW), ("shared", "own")


@dataclass(frozen=True)
class Job(Keyed):
    """One fit to one motion."""

    engine: str
    task: str
    object: str
    material: str
    seed: int
    law: Literal["shared", "own"]


def jobs(
    engines: Sequence[str], objects: Sequence[str], seeds: Sequence[int], tasks: Sequence[str], laws: Sequence[str]
) -> list[Job]:
    """Return all fits; the scene of slow pushes has an object and a ground of its own, and MuJoCo as the truth."""
    cells = itertools.product(engines, [task for task in tasks if task != SLOW], objects, MATERIALS, seeds)
    rows = [cell for cell in cells if refusal(cell[0], load_item(cell[2]).solid) is None]
    rows += [("mujoco", SLOW, "-", "-", seed) for seed in seeds if SLOW in tasks]
    return [Job(*row, law=cast(Any, law)) for row in rows for law in laws if row[1] != "fall" or law == "own"]


def measure(job: Job) -> dict[str, Any]:
    """Return the friction of a fit with its interval and the true one, or why there is none."""
    try:
        plan = _plan(job)
        fit = fit_physics(true_shape_world(plan, job.law), [noisy_episode(plan, job.seed)], PhysConfig(), NOISE)
    except NotConvergedError as error:
        return {"not_run": error.found}
    found = next(one for one in fit.parameters if one.name == "friction")
    return {"friction": found.estimate, "interval_95": found.interval_95, "state": found.state,
            "true": plan.contact.friction}  # fmt: skip


def _plan(job: Job) -> ScenePlan:
    if job.task == SLOW:
        return plan_scene("push", job.seed)
    item = load_item(job.object)
    return plan_capture(item, job.object, job.material, cast(Task, job.task), job.seed, 0, job.engine)[0]


def true_shape_world(plan: ScenePlan, law: str) -> World:
    """Return the world of a fit to a plan's motion, with true shape and mass and one of the laws of the finger."""
    numbers = Numbers(plan.contact.natural_time, plan.contact.damping_ratio)
    world = true_world(plan.solid, spheres_of(plan.solid), plan.contact, plan.fingertip, numbers)
    return replace(world, pair_laws={}) if law == "shared" else world


def noisy_episode(plan: ScenePlan, seed: int, number: int = 0) -> Episode:
    """Return an episode, by default that of training: noisy poses of the object, and the command of the finger."""
    episode, rng = plan.episodes[number], np.random.default_rng([seed, 31, number] if number else [seed, 31])
    times = np.arange(episode.frame_count) / plan.frame_rate
    pose = episode.motion.qpos[episode.motion.rows(times)]
    place = pose[:, :3] + NOISE[0] * rng.standard_normal((len(times), 3))
    turn = quat_exp(torch.as_tensor(NOISE[1] * rng.standard_normal((len(times), 3))))
    tracks = {OBJECT: Track(times, place, quat_multiply(torch.as_tensor(pose[:, 3:7]), turn).numpy())}
    return Episode(episode.name, tracks | ({FINGERTIP: finger_track(episode)} if plan.fingertip else {}))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return by task, engine and law how far friction is off, and how many intervals hold, in Markdown."""
    lines = ["| task | engine | law of the finger | fits | friction error %: median (mean) | bias % "
             "| half of an interval % | intervals that hold | not observable |", "| --- " * 9 + "|"]  # fmt: skip
    for task, engine, law in itertools.product(TASKS, ENGINES, LAWS):
        chosen = [r for r in rows if (r["task"], r["engine"], r["law"]) == (task, engine, law) and "friction" in r]
        if not chosen:
            continue
        bias = 100 * np.array([row["friction"] / row["true"] - 1 for row in chosen])
        errors = np.abs(bias)
        half = [50 * math.log(row["interval_95"][1] / row["interval_95"][0]) for row in chosen]
        held = sum(row["interval_95"][0] <= row["true"] <= row["interval_95"][1] for row in chosen)
        unseen = sum(row["state"] == "not_observable" for row in chosen)
        lines.append(f"| {task} | {engine} | {law if task != 'fall' else '–'} | {len(chosen)} | "
                     f"{np.median(errors):.0f} ({np.mean(errors):.0f}) | {np.median(bias):+.0f} | "
                     f"{np.median(half):.0f} | {held} | {unseen} |")  # fmt: skip
    lost = sorted({f"{r['engine']}, {r['task']}, {r['object']}: {r['not_run']}" for r in rows if "not_run" in r})
    return "\n".join((*lines, *(f"Not run: {reason}" for reason in lost)))


def main() -> int:
    """Measure what is missing, or print the table of what is stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("--engines", default="mujoco,dart,rapier", help=", ".join(ENGINES))
    parser.add_argument("--objects", default="box,l_block")
    parser.add_argument("--tasks", default="fall,push,slow", help=", ".join(TASKS))
    parser.add_argument("--laws", default="shared,own", help="laws of the finger")
    parser.add_argument("--seeds", default="310,311", help="of the captures; development seeds are below 500")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    unknown = [name for name in given.engines.split(",") if name not in ENGINES]
    if unknown:
        parser.error(f"--engines: {unknown[0]!r} is none of {', '.join(ENGINES)}")
    store = Store("one_motion", None, given.any_commit)
    if given.what == "run":
        words = (given.engines, given.objects, given.seeds, given.tasks, given.laws)
        engines, objects, seeds, tasks, laws = (one.split(",") for one in words)
        wanted = jobs(engines, objects, [int(seed) for seed in seeds], tasks, laws)
        store.fill(_row, {job.key: (job,) for job in wanted}, given.workers)
    print(table(store.results()))
    return 0


def _row(job: Job) -> dict[str, Any]:
    return vars(job) | measure(job)


if __name__ == "__main__":
    sys.exit(main())
