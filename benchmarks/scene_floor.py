"""How far a prediction of the built-in scene must be off: the true world in our engine, and fits with its true shape.

The scene is made in MuJoCo; our law of contact is another one. Test tosses are predicted open loop from their true
start, with true shape, mass, friction and contact numbers (`floor`), the same from a start that 0.1 s of tracks give
(`measured`), with the numbers that a fit to the training tracks gives in the true shape (`fitted`), and with the best
of a grid of numbers, chosen on these tosses (`best`): mean error over the frames of each toss, mm and deg, and the
medians over tosses. No picture is drawn. Run with

    python benchmarks/scene_floor.py --seeds 0,4,5,8
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode
from cgwm.datasets.synthetic import plan_scene
from cgwm.datasets.synthetic.plan import EpisodePlan, ScenePlan
from cgwm.datasets.synthetic.tracker import POSITION_STD, ROTATION_STD, measure_tracks
from cgwm.pipeline.evaluate.prediction import MODEL, predict
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import PhysConfig
from tabletop.true_world import Numbers, pose_errors, pose_errors_at, spheres_of, true_world

Errors = list[tuple[float, float]]
TIMES, DAMPINGS = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0), (0.7, 1.0, 1.4)
"""Factors of the contact time and of the damping ratio that are tried."""


def errors(world: World, plan: ScenePlan, tests: Sequence[EpisodePlan]) -> Errors:
    """Return the mean errors of each toss [mm, deg]; infinite where the prediction diverges."""
    found = []
    for episode in tests:
        try:
            found.append(pose_errors(world, plan, episode))
        except ArithmeticError:
            found.append((float("inf"), float("inf")))
    return found


def measured(world: World, plan: ScenePlan, tests: Sequence[EpisodePlan]) -> Errors:
    """Return the mean errors of each toss [mm, deg] from a start that its first 0.1 s of measured tracks give."""
    episodes = [Episode(one.name, measure_tracks(plan, one)) for one in tests]
    times = [np.arange(one.frame_count) / plan.frame_rate for one in tests]
    noise = Noise(POSITION_STD, ROTATION_STD)
    found = []
    predictions = predict(world, episodes, noise, 0.1, times, state_fits=0)
    for one, time_s, prediction in zip(tests, times, predictions, strict=True):
        rows, motion = np.abs(prediction.grid_s[:, None] - time_s).argmin(0), prediction.motions[MODEL]
        found.append(pose_errors_at(motion.position_m[rows, 0], motion.quat_wxyz[rows, 0], one, time_s))
    return found


def median(rows: Errors) -> tuple[float, float]:
    """Return the medians over tosses [mm, deg]."""
    place, turn = np.median(rows, axis=0).round(2).tolist()
    return place, turn


def floor(seed: int) -> dict[str, Any]:
    """Return the figures of the scene `fall` with a seed."""
    plan = plan_scene("fall", seed)
    spheres, contact = spheres_of(plan.solid), plan.contact
    tests = [one for one in plan.episodes if one.split == "test"]
    training = [Episode(one.name, measure_tracks(plan, one)) for one in plan.episodes if one.split == "train"]

    def world(friction: float, numbers: Numbers) -> World:
        return true_world(plan.solid, spheres, replace(contact, friction=friction), False, numbers)

    true = world(contact.friction, Numbers(contact.natural_time, contact.damping_ratio))
    fit = {one.name: float(one.estimate) for one in fit_physics(true, training, PhysConfig(seed=seed)).parameters}
    fitted = world(fit["friction"], Numbers(fit["contact_time_s"], fit["damping_ratio"]))
    fitted = replace(fitted, ground_offset=torch.tensor([fit.get("ground_offset_m", 0.0)], dtype=torch.float64))
    numbers = [Numbers(a * contact.natural_time, b * contact.damping_ratio) for a, b in product(TIMES, DAMPINGS)]
    tried = [median(errors(world(contact.friction, one), plan, tests)) for one in numbers]
    return {
        "seed": seed,
        "family": plan.solid.family,
        "floor": median(errors(true, plan, tests)),
        "measured": median(measured(true, plan, tests)),
        "fitted": median(errors(fitted, plan, tests)),
        "best": min(tried),
        "friction": [round(fit["friction"], 4), round(contact.friction, 4)],
    }


def main() -> None:
    """Print a JSON line for each seed, and the medians over seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0")
    rows = []
    for seed in map(int, parser.parse_args().seeds.split(",")):
        rows.append(floor(seed))
        print(json.dumps(rows[-1]), flush=True)
    for kind in ("floor", "measured", "fitted", "best"):
        place, turn = median([row[kind] for row in rows])
        print(f"{kind}: {place:.2f} mm, {turn:.2f} deg")


if __name__ == "__main__":
    main()
