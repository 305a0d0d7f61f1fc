"""An Allegro hand turns objects on its palm by 90 degrees: the task of a published quasi-static controller.

python benchmarks/allegro.py run --repository FOLDER [--objects cube,rubber_duck,camera,stick] [--first 0] [--seeds 20]
python benchmarks/allegro.py table

FOLDER is asu-iris/Complementarity-Free-Dexterous-Manipulation at 87b320f (no licence: to be read and run only), whose
scenes are the plant, without their textures. Start, goal and success are those of its `examples/mpc/allegro`: a random
turn about the vertical, a goal 90 degrees to one side, reached where 1 - (q . q*)^2 < 0.04 (23.1 degrees) at more than
20 commands of 0.1 s in a row within 500; position is not asked, but given. The plant waits for plans. With `--mujoco
PACKAGES`, a folder that `pip install --no-deps --target PACKAGES mujoco==3.2.0` makes, the plant runs in a process of
its own under that MuJoCo, with which their tables were made; without it under the installed one. Meshes collide as
their hulls, as in predictions.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from allegro_scenes import resized, scene_of
from cgwm.datasets.models.model import Model
from cgwm.pipeline.control.hand.controller import HandController
from cgwm.pipeline.control.hand.loop import run_hand
from cgwm.pipeline.control.hand.plant import HandScenePlant
from cgwm.pipeline.runtime.resources import no_garbage_search
from cgwm.pipeline.sg_gs.collision.link_hulls import rounded_hull
from cgwm.schemas import ContactParameters, HandTask
from compared_solvers import ComparedSolvers, Note, solvers_of
from known_object import SPREAD, errors_of, known_object, sensing_of
from plant_process import PipedPlant
from store import Store

mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs
FRICTION, FINGER_FRICTION, CONTACT_TIME_S, DAMPING_RATIO = 0.5, 1.0, 0.02, 8.0
"""Those of the scenes; damping as forecasts of runs of development want it: objects and fingers overlap by millimetres
there, and what overlaps must not be thrown apart."""
ABOVE_M = 0.22
JOINTS_RAD = (
    0.125, 1.13, 1.45, 1.24, -0.02, 0.445, 1.17, 1.5, -0.459, 1.54, 1.11, 1.23, 0.638, 1.85, 1.5, 1.26,
)  # fmt: skip
"""Joints at the start, finger by finger."""
PLACES = {
    "cube": ((-0.03, -0.01, 0.04), (-0.01, 0.0, 0.05), (-math.pi / 2, math.pi), (-1, 1)),
    "rubber_duck": ((-0.02, 0.0, 0.05), (0.0, 0.0, 0.05), (-math.pi / 2, math.pi), (1, -1)),
    "camera": ((-0.03, 0.0, 0.04), (-0.01, 0.0, 0.04), (-math.pi / 2, math.pi), (1, -1)),
    "stick": ((-0.01, 0.0, 0.03), (-0.01, 0.0, 0.03), (math.pi / 4, math.pi / 2), (-1, 1)),
}
"""By object: mean place at the start and wanted place [m], first turn and range of turns [rad], sides to choose."""


def model_of(scene: Path, corners: int, spread: float = 0.0) -> Model:
    """Return the model of the object of a scene, with the scene's numbers."""
    found = mujoco.MjModel.from_xml_path(str(scene))
    body = found.body("obj").id
    geom = found.body_geomadr[body]
    turn, inertial = np.zeros(9), np.zeros(9)
    mujoco.mju_quat2Mat(inertial, found.body_iquat[body])
    mujoco.mju_quat2Mat(turn, found.geom_quat[geom])
    if found.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = found.geom_dataid[geom]
        points = found.mesh_vert[found.mesh_vertadr[mesh] :][: found.mesh_vertnum[mesh]].astype(float)
    else:
        points = found.geom_size[geom] * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    points = points @ turn.reshape(3, 3).T + found.geom_pos[geom]
    inertia = inertial.reshape(3, 3) @ np.diag(found.body_inertia[body]) @ inertial.reshape(3, 3).T
    contact = ContactParameters(friction=FRICTION, contact_time_s=CONTACT_TIME_S, damping_ratio=DAMPING_RATIO)
    balls = rounded_hull(points, corners)
    return known_object(balls, float(found.body_mass[body]), inertia, found.body_ipos[body], contact, spread)


def task_of(folder: Path, scene: Path, seed: int, given: argparse.Namespace) -> HandTask:
    """Return the task of a seed; start and goal are drawn as in the repository."""
    start_m, _, (first, span), sides = PLACES[scene.stem.removeprefix("env_allegro_")]
    errors = errors_of(given.plant)
    plant = resized(scene, errors.pop("size_factor", 1.0))
    rng = np.random.RandomState(100 + seed)
    place = np.array(start_m[:2]) + 0.005 * rng.randn(2)
    turn = first + span * float(rng.rand(1)[0])
    side = float(rng.choice(sides))
    drawn = 1.0 if np.random.default_rng([seed, 4]).uniform() < 0.5 else -1.0  # the side that `goals_of` takes
    fingers = ("ff", "mf", "rf", "th")
    names = [f"{finger}j{k}" for finger in fingers for k in range(4)]
    parts = [f"{finger}_{part}" for finger in fingers for part in ("base", "proximal", "medial", "distal")]
    moved = [[f"{finger}_{part}" for part in ("proximal", "medial", "distal")] for finger in fingers]
    touching = [pair for one, other in combinations(moved, 2) for pair in product(one, other)]
    touching += [(part, "palm") for finger in moved for part in finger if part != "th_proximal"]
    task = HandTask.model_validate(
        {
            "robot": {
                "file": "envs/xmls/allegro_right_hand.xml",
                "quat_wxyz": (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)),
                "friction": dict.fromkeys(parts, FINGER_FRICTION),
                "corners": given.corners,
                "touching": touching if given.touching else (),
            },
            "start": {
                "position_m": (float(place[0]), float(place[1]), start_m[2] + given.lift),
                "quat_wxyz": (math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)),
                "joints": dict(zip(names, JOINTS_RAD, strict=True)),
            },
            "goal": {"kind": "turn", "axis": (0.0, 0.0, side * drawn), "turn_deg": 90.0},
            "planner": {
                "control_hz": given.hz, "samples": given.samples, "horizon_s": given.horizon,
                "knots": round(given.horizon * given.hz), "step_s": given.step,
            },
            "success": {
                "turn_deg": math.degrees(2 * math.acos(math.sqrt(0.96))), "hold_s": 2.1, "drop_m": 0.1, "goals": 1,
                "timeout_s": 50.0,
            },
            "sensing": sensing_of(given.plant),
            "costs": {"position_m": given.place, "keep_m": given.keep},
            "limits": {"speed_rad_s": given.speed},
            "plant": {
                "kind": "mujoco", "scene": str(plant.relative_to(folder)), "body": "obj", **errors,
            },
        }
    )  # fmt: skip
    task._source = str(folder / "task.toml")
    return task


def measure(
    folder: Path, scene: Path, seed: int, given: argparse.Namespace, piped: PipedPlant | None, note: Note
) -> dict[str, Any]:
    """Return the figures of one run; `note` takes comparisons of solvers."""
    task = task_of(folder, scene, seed, given)
    # some starts overlap with the thumb, and the wanted place with the fingers at the start: a task may ask neither
    above = task.start.model_copy(update={"position_m": (*task.start.position_m[:2], ABOVE_M)})
    model = model_of(scene, given.corners, SPREAD if given.draws else 0.0)
    solver = "mppi" if given.solver == "compared" else given.solver
    controller = HandController(model, task.model_copy(update={"start": above}), solver, draws=given.draws)
    if given.solver == "compared":
        controller._solver = ComparedSolvers(solvers_of(given.samples), note)
    goal = task.goal.model_copy(update={"position_m": PLACES[scene.stem.removeprefix("env_allegro_")][1]})
    controller.task = task.model_copy(update={"goal": goal})
    controller.hand = replace(controller.hand, task=controller.task)
    if piped is not None:
        piped.open(controller.hand)
    with no_garbage_search():
        found = run_hand(controller, piped or HandScenePlant(controller.hand), seed, "ideal")
    cpu = 1e3 * found.column("cpu_s", "plans")
    return {
        "ended": found.ended,
        "time_s": round(len(found.column("reached")) * controller.interval_s, 1),
        "turn_deg": round(float(found.column("turn_error_deg")[-1]), 1),
        "position_mm": round(1e3 * float(found.column("position_error_m")[-1]), 1),
        "plan_cpu_ms": round(float(np.median(cpu)), 1),
        "plan_cpu_95_ms": round(float(np.percentile(cpu, 95)), 1),
    }


def rows(store: Store) -> Iterator[list[str]]:
    """Yield the rows of the table."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in store.results():
        if "ended" in row:
            found.setdefault(row["key"].rpartition("/")[0], []).append(row)
    for name, runs in sorted(found.items()):
        good = [run for run in runs if run["ended"] == "success"]
        middle = [f"{np.median([run[key] for run in good]):.1f}" if good else "" for key in
                  ("time_s", "turn_deg", "position_mm")]  # fmt: skip
        yield [name, f"{len(good)} of {len(runs)}", *middle, str(sum(run["ended"] == "dropped" for run in runs)),
               f"{np.median([run['plan_cpu_ms'] for run in runs]):.0f}"]  # fmt: skip


def main() -> None:
    """Measure what is asked for and is not there yet, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", choices=("run", "table"))
    parser.add_argument("--repository", type=Path)
    parser.add_argument("--objects", default=",".join(PLACES))
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--hz", type=float, default=100 / 3)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--corners", type=int, default=16, help="of the hulls of the object and of each part of a link")
    parser.add_argument(
        "--touching", action=argparse.BooleanOptionalAction, default=False, help="fingers touch each other"
    )
    parser.add_argument("--horizon", type=float, default=0.4)
    parser.add_argument("--step", type=float, default=0.015)
    parser.add_argument("--place", type=float, default=0.015, help="error of the place that costs 1 [m]")
    parser.add_argument("--keep", type=float, default=0.02, help="see `keep_m` of a task [m]")
    parser.add_argument("--speed", type=float, default=2.0, help="limit of targets [rad/s]; theirs: 0.2 rad a command")
    parser.add_argument("--plant", default="", help="errors of the plant, as friction_factor=0.5,delay_s=0.03")
    parser.add_argument("--draws", type=int, default=0, help="of friction, whose standard error is 70 %% then")
    parser.add_argument("--lift", type=float, default=0.0, help="height above the start of the repository [m]")
    parser.add_argument(
        "--solver", choices=("mppi", "both", "gauss-newton", "compared"), default="mppi",
        help="compared: the plans of mppi, and what the others make of some of them",
    )  # fmt: skip
    parser.add_argument("--mujoco", type=Path, default=None, help="packages of the plant's own process")
    parser.add_argument("--store", type=Path, default=None)
    parser.add_argument("--any-commit", action="store_true", help="results of other commits count")
    given = parser.parse_args()
    store = Store("allegro", given.store, given.any_commit)
    if given.work == "table":
        print("object, plans | reached | time, s | turn, deg | away, mm | dropped | plan, CPU ms")
        for row in rows(store):
            print(" | ".join(row))
        return
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    piped = PipedPlant(given.mujoco) if given.mujoco else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for thing in given.objects.split(","):
            scene = scene_of(given.repository, folder, thing)
            for seed in range(given.first, given.first + given.seeds):
                size = f"{given.hz:g} Hz, {given.samples} x {given.horizon:g} s in steps of {1e3 * given.step:g} ms"
                size += f", {given.plant}" if given.plant else ""
                size += f", {given.draws} draws" if given.draws else ""
                size += f", {given.mujoco.name}" if given.mujoco else ""
                size += "" if given.solver == "mppi" else f", {given.solver}"
                key = f"{thing}, {size}/{seed}"

                def note(plan: int, figures: dict[str, Any], key: str = key) -> None:
                    store.add(f"{key}, plan {plan}", figures)

                store.result(key, lambda c=scene, s=seed, n=note: measure(folder, c, s, given, piped, n))
    if piped is not None:
        piped.close()


if __name__ == "__main__":
    main()
