"""Do the 95 % intervals of a fit to one toss hold the truth, when the truth is another simulator, or our own engine?

The built-in scene's tosses, measured with its noise, on the true convex corners as spheres. With `--truth mujoco` they
are MuJoCo's, and what remains is the difference between the two contact models; with `--truth own` our engine tosses
the same bodies from the same starts, with the same contact numbers. Seeds from 30 on: those below served to choose the
prior, how many independent errors a toss holds (`ERRORS_PER_EPISODE`) and what a misfit adds (`MODEL_EXCESS`).

    python benchmarks/coverage.py [--seeds 30-49] [--truth mujoco]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from cgwm.datasets.scenes import plan_scene
from cgwm.datasets.scenes.dynamics import OBJECT
from cgwm.datasets.scenes.objects import SolidObject
from cgwm.datasets.scenes.plan import EpisodePlan, ScenePlan
from cgwm.datasets.scenes.record import POSITION_STD, ROTATION_STD, measure_tracks
from cgwm.datasets.tracks import Track
from cgwm.pipeline.phys_geo import fit_physics
from cgwm.pipeline.physics import Body, ContactLaw, World
from cgwm.pipeline.physics.rollout import simulate
from cgwm.pipeline.physics.rotation import quat_exp, quat_multiply
from cgwm.pipeline.physics.world import State
from cgwm.schemas import PhysConfig
from store import Store

CORNER_M = 1e-4
"""Radius of the spheres at the corners."""


def world_of(solid: SolidObject) -> World:
    """Return the world of a solid that touches the ground with its corners."""

    def tensor(values: object) -> torch.Tensor:
        return torch.as_tensor(np.asarray([values], float))

    arms = solid.vertices - solid.com
    centers = solid.com + arms * (1 - CORNER_M / np.linalg.norm(arms, axis=1, keepdims=True))
    body = Body(
        "object",
        "free",
        tensor(solid.mass),
        tensor(solid.inertia),
        tensor(solid.com),
        tensor(centers),
        tensor(np.full(len(centers), CORNER_M)),
    )
    law = ContactLaw(*(tensor(value) for value in (0.3, 0.005, 0.4)))
    return World((body,), tensor((0.0, 0.0, -9.81)), tensor((0.0, 0.0, 1.0))[0], tensor(0.0), law)


def own_tracks(plan: ScenePlan, toss: EpisodePlan, measured: dict[str, Track], seed: int) -> dict[str, Track]:
    """Return what a tracker sees of our engine's toss from the same start, at the times of the measured track."""
    times = measured[OBJECT].time_s
    row = toss.motion.row(float(times[0]))
    qpos, qvel = (torch.as_tensor(values[row][None, None]) for values in (toss.motion.qpos, toss.motion.qvel))
    state = State(qpos[..., :3], qpos[..., 3:7], qvel[..., :3], qvel[..., 3:6])
    contact = plan.contact
    numbers = (contact.friction, contact.natural_time, contact.damping_ratio)
    law = ContactLaw(*(torch.tensor([value], dtype=torch.float64) for value in numbers))
    rollout = simulate(replace(world_of(plan.solid), contact=law), state, torch.as_tensor(times))
    rng = np.random.default_rng([seed, 12])
    turn = torch.as_tensor(float(ROTATION_STD) * rng.standard_normal((len(times), 3)))
    quat = quat_multiply(rollout.quat_wxyz[0, :, 0], quat_exp(turn)).numpy()
    noise = POSITION_STD * rng.standard_normal((len(times), 3))
    return {OBJECT: Track(times, rollout.position_m[0, :, 0].numpy() + noise, quat)}


def measure(seed: int, truth_engine: str) -> dict[str, Any]:
    """Fit the training toss of a seed; return for each parameter truth, estimate and interval."""
    plan = plan_scene("fall", seed)
    toss = next(episode for episode in plan.episodes if episode.split == "train")
    tracks = measure_tracks(plan, toss)
    if truth_engine == "own":
        tracks = own_tracks(plan, toss, tracks, seed)
    fit = fit_physics(
        world_of(plan.solid),
        [(toss.name, tracks)],
        PhysConfig(seed=seed),
        (POSITION_STD, float(ROTATION_STD)),
    )
    contact = plan.contact
    truth = dict(friction=contact.friction, contact_time_s=contact.natural_time, damping_ratio=contact.damping_ratio)
    rows = {}
    for parameter in fit.parameters:
        if parameter.name in truth and parameter.interval_95 is not None:
            low, high = parameter.interval_95
            value = truth[parameter.name]
            rows[parameter.name] = [value, parameter.estimate, low, high, low <= value <= high]
    return {"parameters": rows, "kept": fit.record.get("kept"), "misfit": fit.record.get("shooting_misfit")}


def main() -> int:
    """Print one JSON line a seed and the coverage; return 1 if it is below 80 % for any parameter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="30-49")
    parser.add_argument("--truth", choices=("mujoco", "own"), default="mujoco")
    options = parser.parse_args()
    first, last = options.seeds.split("-")
    store, hits = Store("coverage"), {}
    for seed in range(int(first), int(last) + 1):
        key = f"seed {seed}, truth {options.truth}"
        found = store.result(key, lambda seed=seed: measure(seed, options.truth))
        for name, row in found["parameters"].items():
            hits.setdefault(name, []).append(row[-1])
    for name, held in hits.items():
        print(f"{name}: {sum(held)} of {len(held)} intervals hold the truth")
    return 0 if all(np.mean(held) >= 0.8 for held in hits.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
