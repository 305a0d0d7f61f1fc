"""How well MuJoCo can repeat this engine at all: a joint search over its contact numbers, for laws that the export has.

For one contact law, the numbers of a `pair` are searched together by the cross-entropy method: time constant and
damping ratio of solref and of solreffriction, the five numbers of solimp, impratio and the friction; the cone is
elliptic, and friction is found once more after the normal forces (`noslip_iterations`). What is minimised is the median
deviation 0.1 s after the first contact over some throws (`mjcf_contacts`); the best setting is then judged on other
throws, beside the export as it is. Run with

    python benchmarks/mjcf_search.py [--laws 1,3] [--workers 8] [--generations 10]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from dataclasses import replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
from cgwm.datasets.models.mjcf import APART_ITERATIONS, write_mjcf
from cgwm.pipeline.export.mujoco_check import AFTER_CONTACT_S, FRAME_S
from mjcf_contacts import LAWS, Case, case_of, cube

NUMBERS: dict[str, tuple[float, float, bool]] = {
    "contact time, of the law's": (0.5, 2.0, True),
    "damping ratio, of the law's": (0.3, 3.0, True),
    "least impedance": (0.3, 0.999, False),
    "largest impedance": (0.7, 0.9999, False),
    "width of the impedance [m]": (1e-5, 1e-2, True),
    "midpoint of the impedance": (0.1, 0.9, False),
    "power of the impedance": (1.0, 4.0, False),
    "contact time of friction, of the law's": (0.2, 5.0, True),
    "damping ratio of friction": (0.3, 3.0, True),
    "impratio": (1e-7, 100.0, True),
    "friction, of the law's": (0.7, 1.4, True),
}
"""Least and largest value of each number, and whether it is searched by its logarithm."""
POPULATION, ELITE, SMOOTHED, SPREAD = 48, 10, 0.3, 0.15
FITTED, JUDGED = range(5000, 5080), range(6000, 6100)
"""Seeds of the throws on which numbers are searched, and of those on which they are judged."""


def values_of(point: np.ndarray) -> np.ndarray:
    """Return the numbers at a point of the unit cube, in the order of `NUMBERS`."""
    low, high, logarithm = (np.array(column) for column in zip(*NUMBERS.values(), strict=True))
    linear = low + point * (high - low)
    return np.where(logarithm, low * (high / low) ** point, linear)


def point_of(values: np.ndarray) -> np.ndarray:
    """Return the point of the unit cube at which the numbers have these values."""
    low, high, logarithm = (np.array(column) for column in zip(*NUMBERS.values(), strict=True))
    return np.where(logarithm, np.log(values / low) / np.log(high / low), (values - low) / (high - low))


@cache
def shortened(law: int, first: int, count: int) -> tuple[Case, tuple[tuple[np.ndarray, np.ndarray], ...]]:
    """Return the case of a law, and positions and velocities shortly before the first contact of each start."""
    case = case_of(cube(*LAWS[law]), range(first, first + count))
    data = mujoco.MjData(case.loaded)  # pyright: ignore[reportAttributeAccessIssue]
    states = []
    before = round(AFTER_CONTACT_S / FRAME_S) + 1
    for start, frame in zip(case.starts, case.frames, strict=True):
        mujoco.mj_resetData(case.loaded, data)  # pyright: ignore[reportAttributeAccessIssue]
        data.qpos[:] = np.r_[start.position_m[0], start.quat_wxyz[0]]
        data.qvel[:] = np.r_[start.velocity_m_s[0], start.omega_body_rad_s[0]]
        flight = max(frame - before, 0)
        mujoco.mj_step(case.loaded, data, flight * round(FRAME_S / case.loaded.opt.timestep))  # pyright: ignore[reportAttributeAccessIssue]
        states.append((data.qpos.copy(), data.qvel.copy()))
    frames = [frame - max(frame - before, 0) for frame in case.frames]
    return replace(case, frames=frames), tuple(states)


def as_exported(law: int) -> np.ndarray:
    """Return the numbers of a law's file, in the order of `NUMBERS`."""
    loaded = mujoco.MjModel.from_xml_string(write_mjcf(cube(*LAWS[law])))  # pyright: ignore[reportAttributeAccessIssue]
    share = loaded.pair_solreffriction[0, 0] / LAWS[law][1]
    return np.array([1.0, 1.0, 0.99, 0.99, 0.001, 0.5, 2.0, share, 1.0, loaded.opt.impratio, 1.0])


def set_numbers(case: Case, values: np.ndarray) -> None:
    """Write contact numbers into the compiled model of a case."""
    loaded, law = case.loaded, case.law
    time_share, ratio, least, largest, width, middle, power, slip_share, slip_ratio, impratio, friction = values
    zeta = law.damping_ratio * ratio
    loaded.pair_solref[:] = (law.contact_time_s * time_share / zeta, zeta)
    loaded.pair_solimp[:] = (min(least, largest), largest, width, middle, power)
    loaded.pair_solreffriction[:] = (law.contact_time_s * slip_share, slip_ratio)
    loaded.pair_friction[:, :2] = law.friction * friction
    loaded.opt.impratio, loaded.opt.noslip_iterations = impratio, APART_ITERATIONS


def deviation(law: int, first: int, count: int, values: np.ndarray) -> tuple[float, float, float]:
    """Return median and 90 % quantile of the position [mm], and the median angle [deg], with these numbers."""
    case, states = shortened(law, first, count)
    set_numbers(case, values)
    data = mujoco.MjData(case.loaded)  # pyright: ignore[reportAttributeAccessIssue]
    found = np.array([_after(case, data, *state, frame) for state, frame in zip(states, case.frames, strict=True)])
    away_mm = 1e3 * np.linalg.norm(found[:, :3] - case.position_m, axis=1)
    away_mm = np.where(np.isfinite(away_mm), away_mm, 1e3)
    angle = np.degrees(2 * np.arccos(np.abs((found[:, 3:] * case.quat_wxyz).sum(1)).clip(0, 1)))
    return float(np.median(away_mm)), float(np.quantile(away_mm, 0.9)), float(np.median(angle))


def _after(case: Case, data: Any, qpos: np.ndarray, qvel: np.ndarray, frames: int) -> np.ndarray:
    mujoco.mj_resetData(case.loaded, data)  # pyright: ignore[reportAttributeAccessIssue]
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_step(case.loaded, data, frames * round(FRAME_S / case.loaded.opt.timestep))  # pyright: ignore[reportAttributeAccessIssue]
    return data.qpos.copy()


def _work(job: tuple[int, range, np.ndarray]) -> tuple[float, float, float]:
    law, seeds, values = job
    return deviation(law, seeds.start, len(seeds), values)


def search(law: int, pool: Any, generations: int, seed: int = 0) -> dict[str, Any]:
    """Return the best numbers that some generations find for a law, judged on other throws."""
    rng = np.random.default_rng(seed)
    exported = as_exported(law)
    mean, std = point_of(exported), np.full(len(NUMBERS), SPREAD)
    best, best_mm = exported, np.inf
    for generation in range(generations):
        points = rng.normal(mean, std, (POPULATION, len(mean))).clip(0, 1)
        if generation == 0:
            points[0] = mean
        medians = np.array([one[0] for one in pool.map(_work, [(law, FITTED, values_of(p)) for p in points], 1)])
        order = np.argsort(medians)
        if medians[order[0]] < best_mm:
            best, best_mm = values_of(points[order[0]]), float(medians[order[0]])
        elite = points[order[:ELITE]]
        mean = SMOOTHED * mean + (1 - SMOOTHED) * elite.mean(0)
        std = SMOOTHED * std + (1 - SMOOTHED) * elite.std(0) + 0.005
        middle_mm = medians[order[:ELITE]].mean()
        print(law, generation, f"best {best_mm:.2f} mm, mean of the elite {middle_mm:.2f}", flush=True)
    candidates = {"exported": exported, "best": best, "mean": values_of(mean)}
    judged = pool.map(_work, [(law, JUDGED, values) for values in candidates.values()], 1)
    friction, contact_time_s, damping = LAWS[law]
    return {
        "key": f"friction {friction:g}, contact time {1e3 * contact_time_s:g} ms, damping {damping:g}",
        "settings": POPULATION * generations,
        "searched_mm": round(best_mm, 2),
        "judged_mm_90_deg": {name: [round(v, 2) for v in one] for name, one in zip(candidates, judged, strict=True)},
        "best": dict(zip(NUMBERS, (float(f"{value:.4g}") for value in best), strict=True)),
        "mean": dict(zip(NUMBERS, (float(f"{value:.4g}") for value in values_of(mean)), strict=True)),
    }


def main() -> int:
    """Print a JSON line for each law."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", default="1,3", help="places in mjcf_contacts.LAWS")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--generations", type=int, default=10)
    given = parser.parse_args()
    laws = [int(law) for law in given.laws.split(",")]
    os.environ["OMP_NUM_THREADS"] = "1"
    with multiprocessing.get_context("spawn").Pool(given.workers) as pool:
        for law in laws:
            print(json.dumps(search(law, pool, given.generations)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
