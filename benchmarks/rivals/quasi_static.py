"""The published controller of an Allegro hand by its own code: turns by 90 degrees on the palm, on its own seeds.

python benchmarks/rivals/quasi_static.py run --repository FOLDER [--objects cube,...] [--first 0] [--seeds 20]
python benchmarks/rivals/quasi_static.py table

FOLDER is asu-iris/Complementarity-Free-Dexterous-Manipulation at 87b320f. It runs in an environment of its own, with
MuJoCo 3.2.0, casadi and numpy below 2, and nothing of cgwm; docs/rivals.md has the commands. Its modules are unchanged,
but for a viewer without a window; the loop is that of its `examples/mpc/allegro`. A plan's time is that of contacts and
solver, of all threads.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from allegro_scenes import scene_of
from store import Store

COMMAND_S, LONGEST, HELD, WITHIN = 0.1, 500, 20, 0.04


class NoWindow:
    """Stands in for a viewer."""

    def sync(self) -> None:
        """Show nothing."""

    def close(self) -> None:
        """Do nothing."""


def without_window() -> None:
    """Let MuJoCo's viewer open no window."""
    mujoco: Any = importlib.import_module("mujoco")
    viewer: Any = ModuleType("mujoco.viewer")
    viewer.launch_passive = lambda *_, **__: NoWindow()
    sys.modules["mujoco.viewer"] = mujoco.viewer = viewer


def measure(thing: str, seed: int) -> dict[str, Any]:
    """Return the figures of one run, in the folder that holds its scenes."""
    taken = importlib.import_module(f"examples.mpc.allegro.{thing}.params").ExplicitMPCParams
    param = taken(rand_seed=seed, target_type="rotation")
    contact = importlib.import_module("contact.allegro_collision_detection").Contact(param)
    env = importlib.import_module("envs.allegro_env").MjSimulator(param)
    mpc = importlib.import_module("planning.mpc_explicit").MPCExplicit(param)
    cpu_s: list[float] = []
    held, ended = 0, "timeout"
    for _ in range(LONGEST):
        started, state = time.process_time(), env.get_state()
        try:
            phi, jacobian = contact.detect_once(env)
            goal = (param.target_p_, param.target_q_)
            found = mpc.plan_once(*goal, state, phi, jacobian, sol_guess=param.sol_guess_)
        except (IndexError, ValueError):  # more contacts than its arrays hold
            ended = "crashed"
            break
        param.sol_guess_ = found["sol_guess"]
        cpu_s.append(time.process_time() - started)
        env.step(found["action"])
        held = held + 1 if error_of(env.get_state(), param.target_q_) < WITHIN else 0
        if held > HELD:
            ended = "success"
            break
    state = env.get_state()
    return {
        "ended": ended,
        "time_s": round(COMMAND_S * len(cpu_s), 1),
        "turn_deg": round(math.degrees(2 * math.acos(math.sqrt(max(0.0, 1 - error_of(state, param.target_q_))))), 1),
        "position_mm": round(1e3 * float(np.linalg.norm(state[:3] - param.target_p_)), 1),
        "plan_cpu_ms": round(1e3 * float(np.median(cpu_s)), 1) if cpu_s else None,
        "plan_cpu_95_ms": round(1e3 * float(np.percentile(cpu_s, 95)), 1) if cpu_s else None,
    }


def error_of(state: np.ndarray, goal_wxyz: np.ndarray) -> float:
    """Return its measure of a turn: one less the square of the product of quaternions."""
    return float(1 - np.dot(state[3:7], np.ravel(goal_wxyz)) ** 2)


def main() -> None:
    """Measure what is asked for and is not there yet, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", choices=("run", "table"))
    parser.add_argument("--repository", type=Path)
    parser.add_argument("--objects", default="cube,rubber_duck,camera,stick")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--store", type=Path, default=None)
    given = parser.parse_args()
    store = Store("allegro_rival", given.store.resolve() if given.store else None, any_commit=True)
    if given.work == "table":
        for thing in given.objects.split(","):
            runs = [row for row in store.results() if row["key"].partition("/")[0] == thing]
            good = [row for row in runs if row["ended"] == "success"]
            middle = [f"{np.median([row[key] for row in good]):.1f}" if good else "" for key in
                      ("time_s", "turn_deg", "position_mm")]  # fmt: skip
            cpu = np.median([row["plan_cpu_ms"] for row in runs if row["plan_cpu_ms"]] or [math.nan])
            print(" | ".join([thing, f"{len(good)} of {len(runs)}", *middle, f"{cpu:.0f}"]))
        return
    repository = given.repository.resolve()
    sys.path.insert(0, str(repository))
    without_window()
    with tempfile.TemporaryDirectory() as folder:
        for thing in given.objects.split(","):
            scene_of(repository, Path(folder), thing)
            os.chdir(folder)  # its scenes are named from there
            for seed in range(given.first, given.first + given.seeds):
                store.result(f"{thing}/{seed}", lambda t=thing, s=seed: measure(t, s))


if __name__ == "__main__":
    main()
