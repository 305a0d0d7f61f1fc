"""Do the 95 % intervals of a fit to one toss hold the truth, when the truth is another simulator, or our own engine?

The built-in scene's tosses, measured with its noise, on the true convex corners as spheres. With `--truth mujoco` they
are MuJoCo's, and what remains is the difference between the two contact models; with `--truth own` our engine tosses
the same bodies from the same starts, with the same contact numbers. Seeds from 30 on: those below served to choose the
prior, how many independent errors a toss holds (`ERRORS_PER_EPISODE`) and what a misfit adds (`MODEL_EXCESS`).

With `--supervise images` the toss is filmed by the scene's two cameras and fitted from the videos alone, by a model
whose spheres were learned from photos of the object.

    python benchmarks/coverage.py [--seeds 30-49] [--truth mujoco] [--supervise tracks] [--device cpu] [--workers 1]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode
from cgwm.datasets.synthetic import plan_scene, read_truth
from cgwm.datasets.synthetic.dynamics import STEPS_PER_S, Motion
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.datasets.synthetic.plan import EpisodePlan, ScenePlan
from cgwm.datasets.synthetic.record import build_set, record
from cgwm.datasets.synthetic.tracker import POSITION_STD, ROTATION_STD, measure_tracks
from cgwm.pipeline.fit import fit
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.physics import Body, ContactLaw, World
from cgwm.pipeline.physics.rollout import simulate
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.runtime.device import resolve_device
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import FittedParameter, PhysConfig, SplatConfig
from numpy.typing import NDArray
from store import Store

Array = NDArray[np.float64]
Device = Literal["cpu", "cuda"]
CORNER_M = 1e-4
"""Radius of the spheres at the corners."""
STEPS_AT_ONCE = 3
"""So many of MuJoCo's steps make one of our engine's, about 1 ms, as a fit takes them."""
PHOTO_PX, VIDEO_PX = (640, 480), (320, 240)


def world_of(solid: SolidObject) -> World:
    """Return the world of a solid that touches the ground with its corners."""

    def tensor(values: object) -> torch.Tensor:
        return torch.as_tensor(np.asarray([values], float))

    arms = solid.vertices - solid.com
    centers = solid.com + arms * (1 - CORNER_M / np.linalg.norm(arms, axis=1, keepdims=True))
    body = Body(
        name="object",
        motion="free",
        mass=tensor(solid.mass),
        inertia=tensor(solid.inertia),
        com=tensor(solid.com),
        centers=tensor(centers),
        radii=tensor(np.full(len(centers), CORNER_M)),
    )
    law = ContactLaw(*(tensor(value) for value in (0.3, 0.005, 0.4)))
    return World(
        bodies=(body,),
        gravity=tensor((0.0, 0.0, -9.81)),
        ground_normal=tensor((0.0, 0.0, 1.0))[0],
        ground_offset=tensor(0.0),
        contact=law,
    )


def own_motion(plan: ScenePlan, toss: EpisodePlan) -> Motion:
    """Return our engine's motion from the start of a toss, on MuJoCo's time grid."""
    steps = np.arange(len(toss.motion.qpos))
    coarse = steps[::STEPS_AT_ONCE] if steps[-1] % STEPS_AT_ONCE == 0 else np.append(steps[::STEPS_AT_ONCE], steps[-1])
    qpos, qvel = (torch.as_tensor(values[0][None, None]) for values in (toss.motion.qpos, toss.motion.qvel))
    state = State(qpos[..., :3], qpos[..., 3:7], qvel[..., :3], qvel[..., 3:6])
    contact = plan.contact
    numbers = (contact.friction, contact.natural_time, contact.damping_ratio)
    law = ContactLaw(*(torch.tensor([value], dtype=torch.float64) for value in numbers))
    world = replace(world_of(plan.solid), contact=law, step_s=1.01 * STEPS_AT_ONCE / STEPS_PER_S)
    rollout = simulate(world, state, torch.as_tensor(coarse / STEPS_PER_S))
    rows = np.concatenate([getattr(rollout, name)[0, :, 0].numpy() for name in vars(state)], 1)
    rows = np.stack([np.interp(steps, coarse, column) for column in rows.T], 1)
    rows[:, 3:7] /= np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
    return Motion(toss.motion.start, rows[:, :7], rows[:, 7:], toss.motion.first_contact)


def tracked(plan: ScenePlan, toss: EpisodePlan, device: Device) -> tuple[FittedParameter, ...]:
    """Return what a fit to the toss's measured track finds, on the object's true corners."""
    world = replace(world_of(plan.solid), rolls_on=resolve_device(device).type)
    noise, episode = Noise(POSITION_STD, float(ROTATION_STD)), Episode(toss.name, measure_tracks(plan, toss))
    return fit_physics(world, [episode], PhysConfig(seed=plan.seed), noise).parameters


def filmed(plan: ScenePlan, toss: EpisodePlan, device: Device) -> tuple[FittedParameter, ...]:
    """Return what a fit to the toss's videos finds; the shape is learned from photos with true cameras."""
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        capture.mkdir()
        record(build_set(replace(plan, episodes=(toss,)), PHOTO_PX, VIDEO_PX, 48, samples=2), capture)
        cameras = read_truth(capture).cameras
        (capture / "cameras.json").write_text(cameras.model_dump_json(indent=1) + "\n", encoding="utf-8")
        splats = SplatConfig(seed=plan.seed, device=device)
        physics = PhysConfig(seed=plan.seed, device=device, supervise="images")
        out = Path(folder) / "model"
        return fit(capture, out, stage="all", splat_config=splats, phys_config=physics).parameters


def measure(seed: int, truth_engine: str, supervise: str, device: Device) -> dict[str, Any]:
    """Fit the training toss of a seed; return for each parameter truth, estimate and interval."""
    plan = plan_scene("fall", seed)
    toss = next(episode for episode in plan.episodes if episode.split == "train")
    if truth_engine == "own":
        toss = replace(toss, motion=own_motion(plan, toss))
    found = (filmed if supervise == "images" else tracked)(plan, toss, device)
    contact = plan.contact
    truth = dict(friction=contact.friction, contact_time_s=contact.natural_time, damping_ratio=contact.damping_ratio)
    rows = {}
    for parameter in found:
        if parameter.name in truth and parameter.interval_95 is not None:
            low, high = parameter.interval_95
            value = truth[parameter.name]
            rows[parameter.name] = [value, parameter.estimate, low, high, low <= value <= high]
    return {"parameters": rows}


def main() -> int:
    """Print one JSON line a seed and the coverage; return 1 if it is below 80 % for any parameter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="30-49")
    parser.add_argument("--truth", choices=("mujoco", "own"), default="mujoco")
    parser.add_argument("--supervise", choices=("tracks", "images"), default="tracks")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    options = parser.parse_args()
    first, last = options.seeds.split("-")
    store, hits, errors = Store("coverage", options.store), {}, {}
    how = (options.truth, options.supervise, options.device)
    seeds = {", ".join((f"seed {seed}", *how)): seed for seed in range(int(first), int(last) + 1)}
    store.fill(measure, {key: (seed, *how) for key, seed in seeds.items()}, options.workers)
    for row in (row for row in store.results() if row["key"] in seeds):
        for name, (truth, estimate, _, _, held) in row["parameters"].items():
            hits.setdefault(name, []).append(held)
            errors.setdefault(name, []).append(abs(estimate / truth - 1))
    for name, held in hits.items():
        middle, most = 100 * np.median(errors[name]), 100 * max(errors[name])
        print(
            f"{name}: {sum(held)} of {len(held)} intervals hold the truth; off by {middle:.1f} % (at most {most:.1f})"
        )
    return 0 if all(np.mean(held) >= 0.8 for held in hits.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
