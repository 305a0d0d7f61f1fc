"""Do the intervals of a fit to tosses of an elbow hold the numbers, where these are known?

    python benchmarks/elbow_coverage.py elbow_tosses.tar.xz --work out/elbow [--truth own|mujoco] [--seeds 0-23]

Each seed draws contact, losses of the hinge, ratio of masses, inertia and height of the ground from the fit's priors,
throws the elbow of the real tosses (DAIRLab/dair_pll, BSD-3) from where some of the real training tosses begin, and
fits the tracks with noise. With `--truth own` the tosses are our engine's; with `--truth mujoco` they are MuJoCo's with
the same URDF, where contact time and damping ratio have no counterpart. One JSON line a seed, and the share of
intervals that hold and the state of each parameter.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets import Capture, import_elbow, read_model
from cgwm.datasets.capture.links import articulations_of
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.physics.chains.parameters import chain_parameters
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.parameters import (
    CONTACT_PARAMETERS,
    GROUND_SHIFT,
    Parameter,
    apply_parameters,
    contact_parameters,
)
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import ContactParameters, FittedParameter, PhysConfig
from elbow import SEED, TEST, TRAIN, Array, Rival, Tosses, nominal, tosses_of
from scipy.spatial.transform import Rotation
from store import Store

from cgwm import fit

NOISE = Noise(1e-4, 1e-3)
"""Of the tracks: position [m], rotation [rad]; the real tracks have 0.06 mm and 1 mrad."""
UNLIKE = "contact_time_s", "damping_ratio"
"""Parameters that MuJoCo's contact does not have."""
_MIDDLE = ContactParameters(**{p.name: p.prior[0] for p in CONTACT_PARAMETERS})


@cache
def thrown(source: Path, work: Path, count: int) -> tuple[Tosses, Capture]:
    """Return real training tosses, evenly spread, in the world of the URDF, and their capture."""
    if not (work / "capture").exists():
        import_elbow(source, work / "capture", TRAIN, TEST, SEED)
    if not (work / "shape").exists():
        fit(work / "capture", work / "shape", "sg-gs")
    capture = Capture.open(work / "capture")
    shape = read_model(work / "shape")
    shape = replace(shape, file=shape.file.model_copy(update={"contact": _MIDDLE}))
    model = nominal(shape, articulations_of(capture.root, capture.manifest))
    names = capture.episodes("train")
    chosen = [names[k] for k in np.linspace(0, len(names) - 1, count).round().astype(int)]
    return tosses_of(model, capture, chosen, NOISE), capture


def drawn(parameters: Sequence[Parameter], rng: np.random.Generator) -> Array:
    """Return coordinates (P,) from the priors, within their bounds."""
    values = [p.encode(p.prior[0]) + p.prior[1] * rng.standard_normal() for p in parameters]
    return np.clip(values, *np.array([p.limits for p in parameters]).T)


def motion(
    truth: str, tosses: Tosses, capture: Capture, parameters: list[Parameter], values: Array
) -> tuple[Array, Array]:
    """Return positions (E, T, 2, 3) and quaternions (E, T, 2, 4) of tosses with the given numbers."""
    if truth == "mujoco":
        rival, by_name = Rival(capture, tosses.world), dict(zip((p.name for p in parameters), values, strict=True))
        theirs = [np.log(0.006), np.log(0.7)]  # their contact: its middle
        own = [by_name[p.name] for p in rival.parameters if p.name in by_name]
        return rival.motion(np.array([own[0], *theirs, *own[1:]]), tosses)
    decoded = torch.stack([p.decode(torch.tensor(v)) for p, v in zip(parameters, values, strict=True)])
    with torch.no_grad():
        found = rollout(
            apply_parameters(tosses.world, parameters, decoded[None]), tosses.seen.state, tosses.seen.times_s, {}
        )
    return found.position_m[:, :, :2].numpy(), found.quat_wxyz[:, :, :2].numpy()


def measured(world: World, tosses: Tosses, position: Array, quat: Array, rng: np.random.Generator) -> list[Episode]:
    """Return tracks of both links with noise."""
    position = position + NOISE.position_m * rng.standard_normal(position.shape)
    turns = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True)
    turns = turns * Rotation.from_rotvec(NOISE.rotation_rad * rng.standard_normal((len(turns), 3)))
    quat = turns.as_quat(scalar_first=True).reshape(quat.shape)
    links = [world.bodies[index].name for index in world.tracked]
    times = tosses.seen.times_s.numpy()
    return [
        Episode(name, {link: Track(times[e], position[e, :, b], quat[e, :, b]) for b, link in enumerate(links)})
        for e, name in enumerate(tosses.names)
    ]


def measure(source: Path, work: Path, count: int, truth: str, seed: int) -> dict[str, Any]:
    """Return what a fit to simulated tosses of a seed says of each parameter."""
    torch.set_num_threads(1)
    tosses, capture = thrown(source, work, count)
    world, rng = tosses.world, np.random.default_rng(seed)
    parameters = [*contact_parameters(world), *chain_parameters(world), GROUND_SHIFT]
    values = drawn(parameters, rng)
    episodes = measured(world, tosses, *motion(truth, tosses, capture, parameters, values), rng)
    found = fit_physics(world, episodes, PhysConfig(seed=seed)).parameters
    return {"parameters": judged(parameters, values, found, UNLIKE if truth == "mujoco" else ())}


def judged(
    parameters: Sequence[Parameter], values: Array, found: Sequence[FittedParameter], unlike: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return by parameter the truth, what a fit found, and whether its interval holds the truth."""
    by_name, rows = {one.name: one for one in found}, {}
    for parameter, coordinate in zip(parameters, values, strict=True):
        name = "ground_offset_m" if parameter is GROUND_SHIFT else parameter.name
        if name in unlike or name not in by_name:
            continue
        value, one = float(parameter.decode(torch.tensor(coordinate))), by_name[name]
        low, high = one.interval_95 or (np.nan, np.nan)
        away = (parameter.encode(one.estimate) - coordinate) / parameter.prior[1]
        width = (one.std_error or np.nan) / (one.estimate if parameter.logarithmic else 1.0) / parameter.prior[1]
        rows[name] = {
            "truth": value, "estimate": one.estimate, "low": low, "high": high, "state": one.state,
            "holds": bool(low <= value <= high), "error_over_prior": float(away), "std_over_prior": float(width),
        }  # fmt: skip
    return rows


def summary(results: Sequence[dict[str, dict[str, Any]]]) -> None:
    """Print for each parameter how many intervals hold, errors and standard errors in the prior's, and the states."""
    for name in dict.fromkeys(name for row in results for name in row):
        rows = [row[name] for row in results if name in row]
        error, claimed = (
            np.sqrt(np.mean([row[key] ** 2 for row in rows])) for key in ("error_over_prior", "std_over_prior")
        )
        print(
            f"{name:24s} holds {sum(row['holds'] for row in rows)} of {len(rows)}; error {error:.2f}, standard error "
            f"{claimed:.2f} of the prior's; {dict(Counter(row['state'] for row in rows))}"
        )


def main() -> int:
    """Print one JSON line a seed and the coverage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--truth", choices=("own", "mujoco"), default="own")
    parser.add_argument("--seeds", default="0-23")
    parser.add_argument("--tosses", type=int, default=24)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--store", type=Path)
    given = parser.parse_args()
    thrown(given.source, given.work, given.tosses)  # written once
    first, last = (int(n) for n in given.seeds.split("-"))
    store = Store("elbow_coverage", given.store)
    jobs = {
        f"{given.truth}/{given.tosses}/{seed}": (given.source, given.work, given.tosses, given.truth, seed)
        for seed in range(first, last + 1)
    }
    store.fill(measure, jobs, given.workers)
    summary([row["parameters"] for row in store.results() if row["key"] in jobs])
    return 0


if __name__ == "__main__":
    sys.exit(main())
