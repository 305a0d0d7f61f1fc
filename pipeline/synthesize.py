"""The stage synthesize: labelled rollouts of a fitted model into HDF5.

Rollout e is drawn from `numpy.random.SeedSequence(seed, spawn_key=(e,))` with the global index e and simulated by
itself, so its content depends neither on the sharding nor on the other rollouts.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

from ..datasets.atomic import sha256
from ..datasets.cameras import Camera
from ..datasets.dataset import new_dataset, shard_entry, shard_name
from ..datasets.mjcf import mujoco_states, write_mjcf
from ..datasets.models import Model, read_model
from ..datasets.progress import progress
from ..datasets.rollouts import ContactTable, FrameBlock, RolloutLabels, RolloutParameter, RolloutWriter
from ..schemas import (
    DatasetManifest,
    DatasetSummary,
    InputDataError,
    ModelFile,
    SamplingPlan,
    ShardEntry,
    SynthesizeConfig,
    UsageError,
)
from .labels import LabelRenderer
from .memory import enough_memory
from .physics.checks import require_apart, require_finite
from .physics.dispatch import rollout as roll_out
from .physics.records import ContactRecord
from .physics.world import State, World
from .posterior import draw_parameters, not_varied
from .preview import with_preview
from .sampling import Start, draw_start, look_at_cameras, resolve_plan

STATE_ONLY = (
    "state only: the model has no visual spheres, so there is nothing to render; "
    "obs/ holds the bodies' state and no images"
)
RECORDED_PACKAGES = ("cgwm", "h5py", "mujoco", "numpy", "torch")


@dataclass(frozen=True)
class _Job:
    """What all rollouts of a shard share."""

    model: Model
    config: SynthesizeConfig
    plan: SamplingPlan
    times_s: np.ndarray
    cameras: Mapping[str, Camera]
    renderer: LabelRenderer | None
    device: str


def synthesize(
    model: Path, out: Path, config: SynthesizeConfig, overwrite: bool = False, preview: bool = True
) -> DatasetSummary:
    """Write one shard of a dataset of labelled rollouts.

    With one shard, `out` appears complete. With more, every call adds its shard to `out` (the first that is ready
    makes it), in any order.

    Args:
        model: MODEL, a directory that `cgwm fit` wrote, with fitted physics.
        out: DATASET.
        config: The settings; times, sizes and the sampling plan are in it.
        overwrite: Replace what is there: the dataset where it has one shard, else the shard.
        preview: Write a contact sheet and a film of the first rollouts beside the first shard.

    Returns:
        What was written, with its hash and the speed.

    Raises:
        InputDataError: If `model` is no model, or has no fitted physics.
        UsageError: If the output exists, or belongs to another dataset.
        NotConvergedError: If a simulation diverges.
        NotEnoughMemoryError: If the pictures cannot be rendered in the memory that there is.
    """
    began = time.perf_counter()
    with _one_thread():
        job = _prepare(model, config)
    tried = f"{job.model.visual_count} spheres, pictures of {config.width}x{config.height} px"
    with enough_memory(tried, job.device, "a smaller --width and --height, a model of fewer spheres"):
        summary = _written(job, model, out, config, overwrite, began)
    return with_preview(summary) if preview and config.shard == 0 else summary


def _written(
    job: _Job, model: Path, out: Path, config: SynthesizeConfig, overwrite: bool, began: float
) -> DatasetSummary:
    indices = shard_indices(config)
    notes = _notes(job)
    manifest = _manifest(model, job, notes)
    config_json = json.dumps(manifest.config, sort_keys=True)
    contacts = 0
    with _one_thread(), new_dataset(out, manifest, model, config.shard, overwrite) as (path, entries):
        with RolloutWriter(path, config.seed, config_json, f"cgwm {version('cgwm')}", config.compression) as writer:
            for index in progress(indices, "rollouts", len(indices), "rollout"):
                labels = simulate_rollout(job, index)
                writer.write(labels, _frames(job, labels))
                contacts += len(labels.contacts.body_a)
        entries.append(_entry(path, config, len(indices), writer.total * max(1, len(job.cameras))))
    seconds = time.perf_counter() - began
    entry = entries[0]
    return DatasetSummary(
        dataset=str(out),
        shard=entry.file,
        sha256=entry.sha256,
        bytes=entry.bytes,
        rollouts=entry.rollouts,
        frames=entry.frames,
        contacts=contacts,
        cameras=tuple(job.cameras),
        seconds=seconds,
        frames_per_s=entry.frames / seconds,
        notes=notes,
    )


def shard_indices(config: SynthesizeConfig) -> range:
    """Return the global indices of the rollouts of a shard: successive ones, in shares that differ by at most one.

    Raises:
        UsageError: If there are more shards than rollouts.
    """
    if config.shards > config.rollouts:
        raise UsageError(
            f"{config.shards} shards for {config.rollouts} rollouts: some would be empty.",
            f"1 to {config.rollouts} shards.",
        )
    first, last = (config.rollouts * k // config.shards for k in (config.shard, config.shard + 1))
    return range(first, last)


def simulate_rollout(job: _Job, index: int) -> RolloutLabels:
    """Draw and simulate the rollout with the global number `index`; everything but its images."""
    rng = np.random.default_rng(np.random.SeedSequence(job.config.seed, spawn_key=(index,)))
    file, parameters = draw_parameters(job.model.file, job.plan.parameter_spread, rng)
    model = replace(job.model, file=file)
    start = draw_start(model, job.plan, float(job.times_s[-1]), rng)
    world = World.from_model(model, torch.float64, job.device)
    state = State(*(_batched(values, job.device) for values in _state(start)))
    times = torch.as_tensor(job.times_s, dtype=torch.float64, device=job.device)
    require_apart(world, state)
    with torch.no_grad():
        rollout = roll_out(world, state, times, start.driven, record_contacts=True)
    require_finite(rollout, world, state, [f"rollout {index} (seed {job.config.seed})"])
    poses = tuple(
        values[0].cpu().numpy()
        for values in (rollout.position_m, rollout.quat_wxyz, rollout.velocity_m_s, rollout.omega_body_rad_s)
    )
    assert rollout.contacts is not None  # asked for above
    contacts = _contact_table(rollout.contacts)
    return _labels(job, index, model, parameters, start, poses, contacts)


def _prepare(path: Path, config: SynthesizeConfig) -> _Job:
    model = read_model(path)
    lacking = [body.name for body in model.file.bodies if body.name not in model.collision]
    if lacking:
        raise InputDataError(
            f"{path}: the body '{lacking[0]}' has no colliding spheres.",
            todo="fit it again: cgwm fit CAPTURE --out MODEL.",
        )
    if model.file.contact is None:
        World.from_model(model)  # says what is missing, and how to get it
    plan = resolve_plan(model, config.plan)
    count = round(config.duration_s * config.frame_rate_hz) + 1
    if count < 2:
        raise UsageError(
            f"{config.duration_s:g} s at {config.frame_rate_hz:g} frames/s is one frame.", "two frames or more."
        )
    device = _device(config)
    visible = bool(model.body_splats)
    cameras = look_at_cameras(model, plan, config) if visible else {}
    renderer = LabelRenderer(model, cameras, device) if visible else None
    return _Job(model, config, plan, np.arange(count) / config.frame_rate_hz, cameras, renderer, device)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch work in one thread on the CPU.

    The tensors are too small to share out: on a machine with other work, threads that wait for each other made it
    20 times slower. Shards in parallel are the way to use more cores. It also keeps the bytes the same everywhere.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _device(config: SynthesizeConfig) -> str:
    if config.device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if config.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: no CUDA device is there.", "auto, cpu.", "see 'cgwm doctor'.")
    return config.device


def _manifest(path: Path, job: _Job, notes: tuple[str, ...]) -> DatasetManifest:
    settings = job.config.model_copy(update={"plan": job.plan, "shard": 0})
    return DatasetManifest(
        model_sha256=sha256(path),
        config=settings.model_dump(mode="json", exclude={"shard"}),
        rollouts=job.config.rollouts,
        shard_count=job.config.shards,
        bodies=tuple(body.name for body in job.model.file.bodies),
        cameras=tuple(job.cameras),
        versions={name: version(name) for name in RECORDED_PACKAGES},
        notes=notes,
    )


def _notes(job: _Job) -> tuple[str, ...]:
    notes = [] if job.renderer is not None else [STATE_ONLY]
    kept = not_varied(job.model.file)
    if kept and job.plan.parameter_spread > 0:
        notes.append(f"kept at their estimate, because nothing sets them in a rollout: {', '.join(kept)}")
    spread = [p.name for p in job.model.file.parameters if p.std_error and p.name not in kept]
    if job.plan.parameter_spread > 0 and not spread:
        notes.append("no physical parameter has a standard error, so all rollouts have the same physics")
    unseen = [b.name for b in job.model.file.bodies if b.name not in job.model.body_splats]
    if job.renderer is not None and unseen:
        notes.append(f"not in the images, because they have no visual spheres: {', '.join(unseen)}")
    return tuple(notes)


def _entry(path: Path, config: SynthesizeConfig, rollouts: int, frames: int) -> ShardEntry:
    return shard_entry(path, config.shard, rollouts, frames, shard_name(config.shard, config.shards))


def _frames(job: _Job, labels: RolloutLabels) -> Iterator[FrameBlock]:
    if job.renderer is not None:
        yield from job.renderer.blocks(labels.position_m, labels.quat_wxyz)


def _state(start: Start) -> tuple[np.ndarray, ...]:
    return start.position_m, start.quat_wxyz, start.velocity_m_s, start.omega_body_rad_s


def _batched(values: np.ndarray, device: str) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float64, device=device)[None]


def _labels(
    job: _Job,
    index: int,
    model: Model,
    parameters: tuple[RolloutParameter, ...],
    start: Start,
    poses: tuple[np.ndarray, ...],
    contacts: ContactTable,
) -> RolloutLabels:
    bodies = model.file.bodies
    actions, meaning = _actions(model.file, start, job.plan, len(job.times_s))
    return RolloutLabels(
        episode_index=index,
        seed=job.config.seed,
        model_mjcf=write_mjcf(model, job.cameras),
        time_s=job.times_s,
        states=mujoco_states(model.file, job.times_s, poses),
        actions=actions,
        action_meaning=meaning,
        bodies=tuple(body.name for body in bodies),
        motions=tuple(body.motion for body in bodies),
        mass_kg=np.array([body.mass_kg for body in bodies]),
        com_m=np.array([body.com_m for body in bodies]),
        inertia_kg_m2=np.array([body.inertia_kg_m2 for body in bodies]),
        position_m=poses[0],
        quat_wxyz=poses[1],
        velocity_m_s=poses[2],
        omega_body_rad_s=poses[3],
        gravity_m_s2=np.array(model.file.gravity_m_s2),
        contacts=contacts,
        parameters=parameters,
        effects={effect.name: effect.parameters for effect in model.file.effects},
        cameras=job.cameras,
    )


def _actions(file: ModelFile, start: Start, plan: SamplingPlan, count: int) -> tuple[np.ndarray, str]:
    """Return the commands (T, A): velocities of the driven bodies over the plan's largest push speed."""
    driven = [index for index, body in enumerate(file.bodies) if body.motion == "driven"]
    if not driven:
        return np.zeros((count, 1)), "No body is driven: zero."
    scale = max(plan.push_speed_m_s[1], 1e-9)
    names = ", ".join(file.bodies[index].name for index in driven)
    command = np.concatenate([start.velocity_m_s[index] for index in driven]) / scale
    text = f"Velocity command of {names}, world axes, in units of {scale:g} m/s."
    return np.repeat(command[None], count, axis=0), text


def _contact_table(record: ContactRecord) -> ContactTable:
    """Keep the contacts that touch at the frame, or that passed on an impulse since the frame before."""
    impulse = record.impulse_n_s[0].cpu().numpy()
    distance = record.distance_m[0].cpu().numpy()
    active = (np.abs(impulse).max(-1) > 0) | (distance <= 0)
    frame, slot = np.nonzero(active)

    def rows(values: torch.Tensor) -> np.ndarray:
        return values[0].cpu().numpy()[frame, slot]

    return ContactTable(
        offsets=np.concatenate([[0], np.cumsum(active.sum(1))]).astype(np.int64),
        body_a=record.body_a.cpu().numpy()[slot].astype(np.int32),
        body_b=record.body_b.cpu().numpy()[slot].astype(np.int32),
        position_m=rows(record.position_m),
        normal=rows(record.normal),
        distance_m=distance[frame, slot],
        impulse_n_s=impulse[frame, slot],
        sliding=rows(record.sliding).astype(np.uint8),
    )
