"""Do the 95 % intervals of a fit to one toss hold the truth, when the truth is another simulator?

The built-in scene's tosses by MuJoCo, measured with its noise, on the true convex corners as spheres: what remains is
the difference between the two contact models. Seeds from 30 on: those below served to choose the prior and how many
independent errors a toss holds (`ERRORS_PER_EPISODE`).

    python benchmarks/coverage.py [--seeds 30-49]
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np
import torch
from cgwm.datasets.scenes import plan_scene
from cgwm.datasets.scenes.objects import SolidObject
from cgwm.datasets.scenes.record import POSITION_STD, ROTATION_STD, measure_tracks
from cgwm.pipeline.phys_geo import fit_physics
from cgwm.pipeline.physics import Body, ContactLaw, World
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


def measure(seed: int) -> dict[str, Any]:
    """Fit the training toss of a seed; return for each parameter truth, estimate and interval."""
    plan = plan_scene("fall", seed)
    toss = next(episode for episode in plan.episodes if episode.split == "train")
    fit = fit_physics(
        world_of(plan.solid),
        [(toss.name, measure_tracks(plan, toss))],
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
    return {"parameters": rows, "refined": fit.record.get("kept") == "refined"}


def main() -> int:
    """Print one JSON line a seed and the coverage; return 1 if it is below 80 % for any parameter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="30-49")
    first, last = parser.parse_args().seeds.split("-")
    store, hits = Store("coverage"), {}
    for seed in range(int(first), int(last) + 1):
        for name, row in store.result(f"seed {seed}", lambda seed=seed: measure(seed))["parameters"].items():
            hits.setdefault(name, []).append(row[-1])
    for name, held in hits.items():
        print(f"{name}: {sum(held)} of {len(held)} intervals hold the truth")
    return 0 if all(np.mean(held) >= 0.8 for held in hits.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
