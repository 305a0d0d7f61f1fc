"""A LEAP hand turns a cube to random orientations: the controller of cgwm on the scene of judo-rai.

python benchmarks/hand.py run --scene FOLDER [--first 0] [--seeds 5] [--clock ideal|real|cpu] [--contenders mppi,cem]
       [--plant friction_factor=0.5] [--model FOLDER] [--limit 300]
python benchmarks/hand.py table

FOLDER is `judo/models` of the wheel of judo-rai 0.1.0 (MIT; `pip download --no-deps judo-rai==0.1.0`), with the meshes
of google-deepmind/mujoco_menagerie's leap_hand, of which only `tip` and `thumb_tip` collide. The plant is its scene
`xml/leap_cube_sim.xml` as it is; the planner's hand is made from the file of the hand alone, which is cut out of that
scene. A goal counts within 0.4 rad; a run ends at 20 goals, a drop, after 80 s without a goal, or at its length.
Clocks: real charges each plan its wall time, cpu the time of all processors (what one idle core would need), ideal
nothing. Contenders: mppi, both, gauss-newton; `hold` never moves: what the goals give by chance; `cem`: see
`hand_cem.py`, with compute for free (`--clock ideal --hz 20`); `compared`: as mppi, and what the other solvers make of
some of its plans, a row for each. A run that reaches the limit of wall time is "cut". For
a real clock on some cores of a machine: `taskset -c`, one process each. Several runs on one GPU: `--turns FILE`, the
same file for each, lets them plan one after the other, while the others' plants, which no clock charges, go on.
"""

from __future__ import annotations

import argparse
import fcntl
import math
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.models.model import Model, read_model
from cgwm.pipeline.control.hand.controller import HandController
from cgwm.pipeline.control.hand.loop import run_hand
from cgwm.pipeline.control.hand.plant import HandScenePlant, HandTruth
from cgwm.pipeline.control.horizon import Array, Forecast
from cgwm.pipeline.control.planning import ControlPlan, ControlState, PlanningController
from cgwm.pipeline.control.solvers import Solution
from cgwm.pipeline.runtime.resources import no_garbage_search
from cgwm.schemas import ContactParameters, HandTask, NotConvergedError
from compared_solvers import ComparedSolvers, solvers_of
from hand_cem import CemController
from known_object import SPREAD, errors_of, known_object, sensing_of
from numpy.typing import ArrayLike
from processor_clock import charge_processors
from store import Store, timed

HALF_M, MASS_KG, ROUNDING_M = 0.03, 0.108, 0.0003
FRICTION, TIP_FRICTION = 0.2, 0.7
HOME = {
    "if_mcp": 0.5, "if_rot": -0.75, "if_pip": 0.75, "if_dip": 0.25, "mf_mcp": 0.5, "mf_rot": 0.0, "mf_pip": 0.75,
    "mf_dip": 0.25, "rf_mcp": 0.5, "rf_rot": 0.75, "rf_pip": 0.75, "rf_dip": 0.25, "th_cmc": 0.65, "th_axl": 0.9,
    "th_mcp": 0.75, "th_ipl": 0.6,
}  # fmt: skip
UNFINISHED, NOTED_S = "unfinished", 5.0
Note = Callable[[dict[str, Any]], object]
PLACE_M, ROOT_WXYZ = (0.0, 0.03, 0.1), (0.0, 0.9961947, 0.0, -0.0871557)


def cube(spread: float = 0.0) -> Model:
    """Return the model of the cube, with the numbers of the scene, and a relative standard error of its friction."""
    inner = HALF_M - ROUNDING_M
    corners = np.array([(x, y, z) for x in (-inner, inner) for y in (-inner, inner) for z in (-inner, inner)])
    contact = ContactParameters(friction=FRICTION, contact_time_s=0.004, damping_ratio=1.0)
    inertia = MASS_KG * 2 / 3 * HALF_M**2 * np.eye(3)
    return known_object((corners, np.full(8, ROUNDING_M)), MASS_KG, inertia, np.zeros(3), contact, spread)


def task_in(folder: Path, scene: Path, given: argparse.Namespace) -> HandTask:
    """Return the task; the scene's files are copied into the folder, with the hand alone beside them."""
    shutil.copytree(scene, folder, dirs_exist_ok=True)
    xml = folder / "xml"
    for path in xml.rglob("*.xml"):
        text = path.read_text(encoding="utf-8").replace('"../../../meshes/leap/"', f'"{folder}/meshes/leap/"')
        path.write_text(text.replace("../../meshes/leap/", ""), encoding="utf-8")
    parts = xml / "leap_components"
    alone = "\n".join(
        line for line in (parts / "params_and_default.xml").read_text().splitlines() if "trace_cube" not in line
    )
    (parts / "params_hand.xml").write_text(alone)
    (xml / "hand.xml").write_text(
        '<mujoco model="leap_rh"><include file="leap_components/assets.xml"/>'
        '<include file="leap_components/params_hand.xml"/><worldbody><body name="leap_hand">'
        '<include file="leap_components/leap_hand.xml"/></body></worldbody></mujoco>'
    )
    fingers = [[f"{finger}_{part}" for part in ("bs", "px", "md", "ds")] for finger in ("if", "mf", "rf")]
    fingers.append(["th_mp", "th_bs", "th_px", "th_ds"])
    touching = [
        pair
        for first, second in combinations(fingers, 2)
        for pair in product(first, second)
        if pair != (first[0], second[0])
    ]
    touching += [(finger[-1], "leap_hand") for finger in fingers]  # what the scene does not exclude, fingers apart
    tips = {f"{finger}_ds/3": TIP_FRICTION for finger in ("if", "mf", "rf", "th")}  # the last part of each
    task = HandTask.model_validate(
        {
            "robot": {
                "file": "xml/hand.xml",
                "quat_wxyz": ROOT_WXYZ,
                "friction": tips,
                "corners": given.corners,
                "touching": touching if given.touching else (),
            },
            "start": {"position_m": PLACE_M, "joints": HOME},
            "goal": {"turn_deg": 23.0},
            "planner": {
                "control_hz": given.hz,
                "samples": given.samples,
                "horizon_s": given.horizon,
                "step_s": given.step,
            },
            "sensing": sensing_of(given.plant),
            "success": {"turn_deg": math.degrees(0.4), "drop_m": 0.4, "goals": 20, "timeout_s": given.seconds},
            "plant": {"kind": "mujoco", "scene": "xml/leap_cube_sim.xml", "body": "cube", **errors_of(given.plant)},
        }
    )
    task._source = str(folder / "task.toml")
    return task


class Hold:
    """Targets that stay."""

    def solve(self, objective: Any, warm: torch.Tensor, propose: Any, rng: np.random.Generator) -> Solution:
        """See `cgwm.pipeline.control.solvers.Solver`."""
        return Solution(torch.zeros_like(warm), 0.0)


class Limited:
    """A plant that stops at a time of the machine, and stores what was reached until now.

    A row is stored with each goal and with every 5 s of the plant, so that a run that is killed is not lost.

    Args:
        plant: The plant.
        controller: The controller, which is told each goal.
        end_s: The time [s], as of `time.monotonic`.
        note: Takes the figures until now.
    """

    def __init__(self, plant: HandScenePlant, controller: HandController, end_s: float, note: Note) -> None:
        self.reset, self._plant, self._end_s, self._note = plant.reset, plant, end_s, note
        self.cut = False
        self._time_s, self._noted_s, self._goals = 0.0, 0.0, -1  # the first goal is given at the start
        self._aim, controller.aim = controller.aim, self.aim

    def aim(self, goal_wxyz: ArrayLike) -> None:
        """Pass a goal to the controller."""
        self._goals += 1
        self._aim(goal_wxyz)
        if self._goals:
            self._store()

    def advance(self, target_rad: Array, interval_s: float) -> HandTruth:
        """See `HandPlant`."""
        self.cut = time.monotonic() > self._end_s
        if self.cut:
            raise NotConvergedError("the time is up.")
        self._time_s += interval_s
        if self._time_s - self._noted_s >= NOTED_S:
            self._store()
        return self._plant.advance(target_rad, interval_s)

    def _store(self) -> None:
        self._noted_s = self._time_s
        self._note({"ended": UNFINISHED, "time_s": round(self._time_s, 2), "goals": self._goals})


@contextmanager
def turn(path: Path | None) -> Iterator[None]:
    """Wait until no other process has its turn by a file, and have it; no file, no waiting."""
    if path is None:
        yield
        return
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def plan_in_turn(controller: PlanningController, path: Path | None) -> None:
    """Let a controller wait for its turn before its plans, whose time begins after it, and make no forecasts."""
    made = type(controller).plan

    def plan(state: ControlState | None, acts_s: float | None = None) -> ControlPlan | None:
        with turn(path):
            return made(controller, state, acts_s)

    nowhere = Forecast(times_s=np.zeros(1), position_m=np.full((1, 3), np.nan), quat_wxyz=np.full((1, 4), np.nan))
    controller.plan, controller.forecast = plan, lambda: nowhere


def measure(
    name: str, task: HandTask, seed: int, given: argparse.Namespace, end_s: float, note: Note
) -> dict[str, Any]:
    """Return the figures of one run."""
    clock, device = given.clock, given.device
    model = cube(SPREAD if given.draws else 0.0) if given.model is None else read_model(given.model)
    if name == "cem":
        controller = CemController(model, task)
    else:
        solver = "mppi" if name in ("hold", "compared") else name
        extra: Any = {"draws": given.draws, "device": device}
        controller = HandController(model, task, solver, **extra)  # pyright: ignore[reportArgumentType]
    if name == "hold":
        controller._solver = Hold()
    if name == "compared":
        controller._solver = ComparedSolvers(
            solvers_of(given.samples), lambda plan, figures: note({"plan": plan} | figures)
        )
    if clock == "cpu":
        charge_processors(controller)
    elif name != "cem":
        plan_in_turn(controller, given.turns)
    before = os.getloadavg()[0]
    plant = Limited(HandScenePlant(controller.hand), controller, end_s, note)
    with no_garbage_search():
        found = run_hand(controller, plant, seed, "ideal" if clock == "ideal" else "real")
    wall, cpu = (1e3 * found.column(key, "plans") for key in ("wall_s", "cpu_s"))
    reached = found.column("reached")
    return {
        "ended": "cut" if plant.cut else found.ended,
        "time_s": round(len(reached) * controller.interval_s, 2),
        "goals": found.goals,
        "first_s": round(float(np.flatnonzero(reached)[0] + 1) * controller.interval_s, 2) if found.goals else None,
        "turn_deg": round(float(np.median(found.column("turn_error_deg"))), 1),
        "position_mm": round(1e3 * float(np.median(found.column("position_error_m"))), 1),
        "plans": len(wall),
        "late": found.late,
        "plan_ms": round(float(np.median(wall)), 1),
        "plan_95_ms": round(float(np.percentile(wall, 95)), 1),
        "plan_cpu_ms": round(float(np.median(cpu)), 1),
        "load": round(0.5 * (before + os.getloadavg()[0]), 1),
    }


def rows(store: Store) -> Iterator[list[str]]:
    """Yield the rows of the table."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in store.results():
        found.setdefault(row["key"].rpartition("/")[0], []).append(row)
    for name, runs in sorted(found.items()):
        late, plans = (sum(run.get(key, 0) for run in runs) for key in ("late", "plans"))
        minutes = sum(run["time_s"] for run in runs) / 60
        goals = [run["goals"] for run in runs]
        yield [name, str(len(runs)), f"{sum(goals)} in {minutes:.1f} min", f"{sum(goals) / minutes:.1f}",
               f"{np.median(goals):.0f}", str(sum(run["ended"] == "dropped" for run in runs)),
               f"{np.median([run.get('plan_cpu_ms', 0) for run in runs]):.0f}",
               f"{100 * late / max(plans, 1):.0f}"]  # fmt: skip


HEADER = ("contender, clock, rate", "runs", "goals", "goals a minute", "goals a run (median)", "drops", "plan, CPU ms",
          "late, %")  # fmt: skip


def main() -> None:
    """Measure what is asked for and is not there yet, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", choices=("run", "table"))
    parser.add_argument("--scene", type=Path, help="judo/models of judo-rai 0.1.0, with meshes/leap/")
    parser.add_argument("--contenders", default="mppi")
    parser.add_argument("--clock", choices=("real", "ideal", "cpu"), default="real")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a run")
    parser.add_argument("--hz", type=float, default=50.0)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--corners", type=int, default=24, help="of the shape of a part of a link")
    parser.add_argument(
        "--touching", action=argparse.BooleanOptionalAction, default=True, help="fingers touch each other"
    )
    parser.add_argument("--horizon", type=float, default=0.5)
    parser.add_argument("--step", type=float, default=0.01)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="of the predictions")
    parser.add_argument("--store", type=Path, default=None)
    parser.add_argument("--any-commit", action="store_true", help="results of other commits count")
    parser.add_argument("--model", type=Path, default=None, help="a fitted model of the cube in place of the true one")
    parser.add_argument("--plant", default="", help="errors of the plant, as friction_factor=0.5,delay_s=0.03")
    parser.add_argument("--draws", type=int, default=0, help="of friction, whose standard error is 70 %% then")
    parser.add_argument("--turns", type=Path, default=None, help="a file: runs with the same one plan in turn")
    parser.add_argument("--limit", type=float, default=math.inf, help="wall time after which runs are cut [s]")
    given = parser.parse_args()
    end_s = time.monotonic() + given.limit
    store = Store("hand", given.store, given.any_commit)
    if given.work == "table":
        print(" | ".join(HEADER))
        for row in rows(store):
            print(" | ".join(row))
        return
    if given.scene is None:
        sys.exit("run needs --scene FOLDER, judo/models of the wheel of judo-rai 0.1.0.")
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    with tempfile.TemporaryDirectory() as folder:
        task = task_in(Path(folder), given.scene, given)
        for seed in range(given.first, given.first + given.seeds):
            for name in given.contenders.split(","):
                size = f"{given.samples} x {given.horizon:g} s in steps of {1e3 * given.step:g} ms"
                if time.monotonic() > end_s:
                    return
                kind = f"{given.device}, {given.plant}" if given.plant else given.device
                kind += "" if given.model is None else ", fitted"
                kind += f", {given.draws} draws" if given.draws else ""
                key = f"{name}, {given.clock}, {given.hz:g} Hz, {size}, {kind}/{seed}"
                known = store.known(key)
                if known is None or known["ended"] == UNFINISHED:
                    note = partial(store.add, key)
                    store.add(key, timed(lambda n=name, s=seed, x=note: measure(n, task, s, given, end_s, x)))


if __name__ == "__main__":
    main()
