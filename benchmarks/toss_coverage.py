"""Do the intervals of a fit to a dozen tosses of a box or a ball hold the numbers, where these are known?

    python benchmarks/toss_coverage.py [--things box,ball] [--truths own,mujoco] [--tosses 12] [--seeds 0-23]

Each seed draws friction, contact time, damping ratio and height of the ground from the fit's priors, and starts as
`contact_truth.py` has them; our engine or MuJoCo tosses, and the tracks are fitted with noise of 0.2 mm and 2 mrad.
MuJoCo's contact has no contact time and no damping ratio of this kind. One JSON line a seed, then for each parameter
the intervals that hold, the error and the standard error in that of the prior, and the states.
"""

from __future__ import annotations

import argparse
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.physics import State, simulate
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, GROUND_SHIFT, apply_parameters
from cgwm.schemas import PhysConfig
from contact_truth import LENGTH_S, RATE_HZ, Array, ball, box, starts, tossed, world_of
from elbow_coverage import UNLIKE, drawn, judged, summary
from scipy.spatial.transform import Rotation
from store import Store

POSITION_STD_M, ROTATION_STD_RAD = 2e-4, 2e-3
THINGS = {"box": box, "ball": ball}
PARAMETERS = (*CONTACT_PARAMETERS, GROUND_SHIFT)


def motion(thing: str, truth: str, start: Array, values: Array) -> tuple[Array, Array]:
    """Return positions (N, T, 3) and quaternions (N, T, 4) of tosses with the given coordinates (4,)."""
    decoded = torch.stack([p.decode(torch.tensor(v)) for p, v in zip(PARAMETERS, values, strict=True)])
    thrown = THINGS[thing]()
    if truth == "mujoco":
        found = tossed(thrown, 3, start, {"friction": float(decoded[0]), "height_m": float(decoded[-1])})
        return found.position_m, found.quat_wxyz
    place, quat, velocity, spin = (torch.as_tensor(x[:, None].copy()) for x in np.split(start, [3, 7, 10], axis=1))
    world = apply_parameters(world_of(thrown.body), PARAMETERS, decoded[None])
    with torch.no_grad():
        rolled = simulate(
            world, State(place, quat, velocity, spin), torch.arange(round(LENGTH_S * RATE_HZ) + 1) / RATE_HZ
        )
    return rolled.position_m[:, :, 0].numpy(), rolled.quat_wxyz[:, :, 0].numpy()


def measure(thing: str, truth: str, count: int, seed: int) -> dict[str, Any]:
    """Return what a fit to the tosses of a seed says of each parameter."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(seed)
    values = drawn(PARAMETERS, rng)
    position, quat = motion(thing, truth, starts(count, seed), values)
    position = position + POSITION_STD_M * rng.standard_normal(position.shape)
    turns = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True)
    turns = turns * Rotation.from_rotvec(ROTATION_STD_RAD * rng.standard_normal((len(turns), 3)))
    quat, times = turns.as_quat(scalar_first=True).reshape(quat.shape), np.arange(position.shape[1]) / RATE_HZ
    episodes = [Episode(str(k), {"body": Track(times, position[k], quat[k])}) for k in range(count)]
    found = fit_physics(world_of(THINGS[thing]().body), episodes, PhysConfig(seed=seed)).parameters
    return {"parameters": judged(PARAMETERS, values, found, UNLIKE if truth == "mujoco" else ())}


def main() -> int:
    """Print one JSON line a seed and the coverage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--things", default="box,ball")
    parser.add_argument("--truths", default="own,mujoco")
    parser.add_argument("--tosses", type=int, default=12)
    parser.add_argument("--seeds", default="0-23")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--store", type=Path)
    given = parser.parse_args()
    first, last = (int(n) for n in given.seeds.split("-"))
    store = Store("toss_coverage", given.store)
    cases = list(product(given.things.split(","), given.truths.split(",")))
    jobs = {
        f"{thing}/{truth}/{given.tosses}/{seed}": (thing, truth, given.tosses, seed)
        for seed in range(first, last + 1)
        for thing, truth in cases
    }
    store.fill(measure, jobs, given.workers)
    rows = {row["key"]: row["parameters"] for row in store.results()}
    for thing, truth in cases:
        print(f"{thing}, {truth}")
        summary([rows[key] for key in jobs if key.startswith(f"{thing}/{truth}/") and key in rows])
    return 0


if __name__ == "__main__":
    sys.exit(main())
