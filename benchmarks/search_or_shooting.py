"""Which numbers of a fit to one motion predict others like it: those of the search, or those of multiple shooting.

    pip install --no-deps -r benchmarks/requirements.txt
    python benchmarks/search_or_shooting.py run --engines mujoco,dart,rapier --seeds 741,742 --workers 2
    python benchmarks/search_or_shooting.py run --tasks push,tip --seeds 741 --workers 2
    python benchmarks/search_or_shooting.py table --tasks push

The motions of `one_motion.py`: one of 15 noisy true poses, true shape and mass; both estimates of one fit predict
four others from 0.1 s of measurement. The table has a line for each value of `OPEN_LOOP_TOLERANCE`, the ratio of
the open-loop errors up to which the numbers of shooting are kept.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode
from cgwm.datasets.synthetic.plan import ScenePlan
from cgwm.pipeline.geometry.rotation import geodesic_angle
from cgwm.pipeline.phys_geo.tracks import contact_fit, contact_shooting
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.physics.parameters import Parameter, apply_parameters
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.initial_state import estimate_states, warmup_frames
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import NotConvergedError, PhysConfig
from one_motion import NOISE, noisy_episode, true_shape_world
from store import Store
from tabletop.capture import Task, plan_capture
from tabletop.engines import ENGINES, refusal
from tabletop.jobs import ObjectJob
from tabletop.materials import MATERIALS
from tabletop.objects import load_item

TESTS, WARMUP_S = 4, 0.1
TOLERANCES = (0.0, 1.5, 2.0, 3.0, 5.0, math.inf)


@dataclass(frozen=True)
class Job(ObjectJob):
    """One fit and what it predicts."""

    task: Task = "fall"


def measure_job(job: Job) -> dict[str, Any]:
    """Return both estimates of friction, the errors of their predictions, and the ratio that decides."""
    item = load_item(job.object)
    try:
        plan = plan_capture(item, job.object, job.material, job.task, job.seed, TESTS, job.engine)[0]
        world, record, both = _estimates(plan, job.seed)
    except NotConvergedError as error:
        return vars(job) | {"not_run": error.found}
    tests = [noisy_episode(plan, job.seed, number) for number in range(1, len(plan.episodes))]
    found: dict[str, Any] = {"true": plan.contact.friction, "converged": record.converged,
                             "ratio": record.open_loop_m / record.search_open_loop_m}  # fmt: skip
    for name, (parameters, values) in both.items():
        friction = float(parameters[0].decode(torch.as_tensor(values[0])))
        found[name] = {"friction": friction, "errors_mm_deg": _predicted(world, parameters, values, tests)}
    return vars(job) | found


def _estimates(plan: ScenePlan, seed: int) -> tuple[World, Any, dict[str, tuple[Sequence[Parameter], np.ndarray]]]:
    """Return the world of the fit, the record of its shooting, and both estimates in fitted coordinates."""
    seen: dict[str, Any] = {}
    shoot, temper = contact_shooting.shoot_contact, contact_shooting.tempered

    def tempered(*given: Any) -> Any:
        seen["shared"] = temper(*given)
        return seen["shared"]

    def shot(world: World, data: Any, search: Any, names: Any, ground_known: bool, *rest: Any) -> Any:
        found = shoot(world, data, search, names, ground_known, *rest)
        more = contact_shooting._with_ground(world, names, ground_known)
        both = {"search": (names, search.mean), "shooting": (more, seen["shared"][0])}
        seen.update(world=world, record=found[1], both=both)
        return found

    contact_fit.shoot_contact, contact_shooting.tempered = shot, tempered
    try:
        fit_physics(true_shape_world(plan, "own"), [noisy_episode(plan, seed)], PhysConfig(), NOISE)
    finally:
        contact_fit.shoot_contact, contact_shooting.tempered = shoot, temper
    return seen["world"], seen["record"], seen["both"]


def _predicted(
    world: World, parameters: Sequence[Parameter], values: np.ndarray, episodes: Sequence[Episode]
) -> list[tuple[float, float]]:
    """Return the mean errors [mm, deg] of each episode after its warm-up."""
    whole = Observations.of(world, episodes, [(-math.inf, math.inf)] * len(episodes))
    warm = warmup_frames(world, whole, WARMUP_S)
    whole, _ = estimate_states(world, whole, warm, Noise(*NOISE))
    decoded = torch.stack([p.decode(torch.as_tensor(v)) for p, v in zip(parameters, values, strict=True)])
    with torch.no_grad():
        changed = apply_parameters(whole.world(world, 1), parameters, decoded.expand(len(episodes), -1))
        motion = measure(changed, whole.state, whole.times_s, whole.drives)
    free, after = list(whole.free), (whole.seen[..., 0] > 0) & ~warm
    shift = (motion.position_m[:, :, free] - whole.position_m).norm(dim=-1)[..., 0]
    angle = geodesic_angle(motion.quat_wxyz[:, :, free], whole.quat_wxyz)[..., 0]
    return [
        (1e3 * float(shift[k, after[k]].mean()), math.degrees(float(angle[k, after[k]].mean())))
        for k in range(len(episodes))
    ]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return for each tolerance the errors of predictions and of friction, in Markdown."""
    rows = [row for row in rows if "ratio" in row]
    converged = sum(row["converged"] for row in rows)
    lines = [f"{len(rows)} captures; the shooting of {converged} converged.", "",
             "| tolerance | mean | median | friction %: median (mean) |", "| --- | --- | --- | --- |"]  # fmt: skip
    for tolerance in TOLERANCES if rows else ():
        kept = [row["shooting" if row["ratio"] <= tolerance else "search"] | {"true": row["true"]} for row in rows]
        errors = [pair for one in kept for pair in one["errors_mm_deg"]]
        mm, deg = ([pair[k] for pair in errors] for k in (0, 1))
        off = [100 * abs(one["friction"] / one["true"] - 1) for one in kept]
        lines.append(f"| {tolerance:g} | {fmean(mm):.1f} mm, {fmean(deg):.1f} deg | {median(mm):.1f} mm, "
                     f"{median(deg):.1f} deg | {median(off):.0f} ({fmean(off):.0f}) |")  # fmt: skip
    return "\n".join(lines)


def main() -> int:
    """Measure what is missing, or print the table of what is stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("--engines", default="mujoco,dart,rapier", help=", ".join(ENGINES))
    parser.add_argument("--tasks", default="fall", help="fall, push, tip")
    parser.add_argument("--seeds", default="310", help="of the captures; development seeds are below 500")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--seconds", type=float, help="begin none after this time")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    store, tasks = Store("search_or_shooting", given.store, given.any_commit), given.tasks.split(",")
    if given.what == "run":
        seeds = [int(seed) for seed in given.seeds.split(",")]
        cells = product(given.engines.split(","), ("box", "l_block"), MATERIALS, seeds, tasks)
        wanted = [Job(*cell) for cell in cells if refusal(cell[0], load_item(cell[1]).solid) is None]
        store.fill(measure_job, {job.key: (job,) for job in wanted}, given.workers, given.seconds)
    print(table([row for row in store.results() if row.get("task", "fall") in tasks]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
