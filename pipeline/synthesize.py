"""The stage synthesize: labelled rollouts of a fitted model into HDF5.

Rollout e is drawn from `numpy.random.SeedSequence(seed, spawn_key=(e,))` with the global index e, and after a draw that
the plan's rules reject from `spawn_key=(e, attempt)`; its content depends neither on the sharding nor on the rollouts
that are simulated with it.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

from ..datasets.atomic import sha256
from ..datasets.cameras import Camera
from ..datasets.dataset import finished_shard, new_dataset, shard_entry
from ..datasets.models import Model, read_model
from ..datasets.progress import progress
from ..datasets.rollout_writer import RolloutWriter
from ..datasets.rollouts import FrameBlock, RolloutLabels
from ..datasets.shards import contact_count, shard_name, shard_range
from ..schemas import (
    DatasetManifest,
    DatasetSummary,
    InputDataError,
    SamplingPlan,
    ShardEntry,
    SynthesizeConfig,
    UsageError,
)
from .draws import Draw, draw_rollout
from .labels import LabelRenderer
from .memory import enough_memory
from .physics.world import World
from .posterior import DERIVED, not_varied, require_admissible, with_correlations
from .preview import with_preview
from .rejection import Rejection, accepted_rollouts
from .rollout_batches import ENVIRONMENTS, Diverged, Simulator
from .rollout_labels import labels_of
from .sampling import look_at_cameras, resolve_plan
from .stopwatch import Stopwatch

STATE_ONLY = (
    "state only: the model has no visual spheres, so there is nothing to render; "
    "obs/ holds the bodies' state and no images"
)
RECORDED_PACKAGES = ("cgwm", "h5py", "hdf5plugin", "mujoco", "numpy", "torch")
ROLLOUTS_AT_ONCE = {"cuda": ENVIRONMENTS, "cpu": 1}
"""Drawn and simulated together where the settings do not say, one batch ahead of the pictures."""
NOT_CONTENT = {"shard", "batch"}
"""Settings that change no rollout."""


@dataclass(frozen=True)
class _Job:
    """What all rollouts of a shard share."""

    model: Model
    config: SynthesizeConfig
    plan: SamplingPlan
    times_s: np.ndarray
    cameras: Mapping[str, Camera]
    renderer: LabelRenderer | None
    simulator: Simulator
    rejection: Rejection
    device: str


@dataclass(frozen=True)
class _Outcome:
    """What became of draws that are not in the dataset: rejected, by rule; and what is said of those that diverged."""

    rejected: Counter[str]
    diverged: list[str]


def synthesize(
    model: Path,
    out: Path,
    config: SynthesizeConfig,
    overwrite: bool = False,
    resume: bool = False,
    preview: bool = False,
    stopwatch: Stopwatch | None = None,
) -> DatasetSummary:
    """Write one shard of a dataset of labelled rollouts.

    With one shard, `out` appears complete. With more, every call adds its shard to `out` (the first that is ready
    makes it), in any order.

    Args:
        model: MODEL, a directory that `cgwm fit` wrote, with fitted physics.
        out: DATASET.
        config: The settings; times, sizes and the sampling plan are in it.
        overwrite: Replace what is there: the dataset where it has one shard, else the shard.
        resume: Keep the shard if it is there and its hash is right. With `overwrite`, a damaged one is made again.
        preview: Write a contact sheet and a film of the first rollouts beside the first shard.
        stopwatch: To measure where the time goes.

    Returns:
        What was written, with its hash and the speed, and how many draws were rejected by which rule.

    Raises:
        InputDataError: If `model` is no model, or has no fitted physics.
        UsageError: If the output exists, or belongs to another dataset.
        DamagedShardError: If a shard that is to be kept is not what was written.
        NotConvergedError: If the rules reject all draws for a rollout, or too many of them diverge.
        NotEnoughSpaceError: If there is no room for the shard.
        NotEnoughMemoryError: If the pictures cannot be rendered in the memory that there is.
    """
    began = time.perf_counter()
    with _one_thread():
        job = _prepare(model, config)
    tried = f"{job.model.visual_count} spheres, pictures of {config.width}x{config.height} px"
    with enough_memory(tried, job.device, "a smaller --width and --height, a model of fewer spheres"):
        summary = _written(job, model, out, config, overwrite, resume, began, stopwatch or Stopwatch())
    return with_preview(summary) if preview and config.shard == 0 else summary


def _written(
    job: _Job,
    model: Path,
    out: Path,
    config: SynthesizeConfig,
    overwrite: bool,
    resume: bool,
    began: float,
    stopwatch: Stopwatch,
) -> DatasetSummary:
    indices = shard_indices(config)
    notes = _notes(job)
    manifest = _manifest(model, job, notes)
    if resume and (kept := finished_shard(out, manifest, config.shard, overwrite)) is not None:
        return _summary(out, job, kept, contact_count(out / kept.file), time.perf_counter() - began, True, notes)
    config_json = json.dumps(manifest.config, sort_keys=True)
    contacts, outcome = 0, _Outcome(Counter(), [])
    with _one_thread(), _quick_turns(), new_dataset(out, manifest, model, config.shard, overwrite) as (path, entries):
        with RolloutWriter(path, config.seed, config_json, f"cgwm {version('cgwm')}", config.compression) as writer:
            with closing(_rollouts(job, indices, outcome, stopwatch)) as found:
                for draw, labels in progress(found, "rollouts", len(indices), "rollout"):
                    with stopwatch.part("render and hand over"):
                        writer.write(labels, _frames(job, draw, labels, stopwatch))
                    contacts += len(labels.contacts.body_a)
            ended = time.perf_counter()
        stopwatch.seconds["wait for the writer"] = time.perf_counter() - ended
        with stopwatch.part("hash"):
            entry = _entry(path, job, len(indices), writer.total * max(1, len(job.cameras)))
        entries.append(entry.model_copy(update={"rejected": dict(sorted(outcome.rejected.items()))}))
        ended = time.perf_counter()
    stopwatch.seconds["publish"] = time.perf_counter() - ended
    notes += tuple(f"drawn again: {found}" for found in outcome.diverged)
    return _summary(out, job, entries[0], contacts, time.perf_counter() - began, False, notes)


def _summary(
    out: Path, job: _Job, entry: ShardEntry, contacts: int, seconds: float, up_to_date: bool, notes: tuple[str, ...]
) -> DatasetSummary:
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
        frames_per_s=0.0 if up_to_date else entry.frames / seconds,
        rejected=entry.rejected,
        plan=job.plan,
        up_to_date=up_to_date,
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
    return shard_range(config.rollouts, config.shards, config.shard)


def _rollouts(
    job: _Job, indices: range, outcome: _Outcome, stopwatch: Stopwatch
) -> Generator[tuple[Draw, RolloutLabels], None, None]:
    """Yield the accepted rollouts in the order of their numbers; the next batch is simulated meanwhile."""
    size = job.config.batch or ROLLOUTS_AT_ONCE[job.device]
    batches = [indices[first : first + size] for first in range(0, len(indices), size)]
    with ThreadPoolExecutor(1, "cgwm-simulate") as ahead:
        following = ahead.submit(_batch, job, batches[0], outcome, stopwatch)
        for number in range(len(batches)):
            with stopwatch.part("wait for simulation"):
                found = following.result()
            if number + 1 < len(batches):
                following = ahead.submit(_batch, job, batches[number + 1], outcome, stopwatch)
            yield from found


def _batch(job: _Job, indices: range, outcome: _Outcome, stopwatch: Stopwatch) -> list[tuple[Draw, RolloutLabels]]:
    duration_s = float(job.times_s[-1])

    def draw(index: int, attempt: int) -> Draw:
        with stopwatch.part("draw"):
            return draw_rollout(job.model, job.plan, job.config, job.cameras, duration_s, index, attempt)

    def simulate(draws: Sequence[Draw]) -> list[RolloutLabels | Diverged]:
        with stopwatch.part("simulate", job.device == "cuda"):
            found = job.simulator.run(draws, job.config.seed)
        outcome.diverged.extend(one.error.found for one in found if isinstance(one, Diverged))
        with stopwatch.part("labels"):
            return [
                one if isinstance(one, Diverged) else labels_of(one, job.plan, job.config.seed, job.times_s)
                for one in found
            ]

    attempts = job.plan.reject.attempts
    return list(accepted_rollouts(indices, draw, simulate, job.rejection.reason, attempts, outcome.rejected))


def resolved_plan(model: Path, plan: SamplingPlan) -> SamplingPlan:
    """Return a plan with what it leaves out filled in for a model.

    Args:
        model: MODEL.
        plan: The plan.

    Raises:
        InputDataError: If `model` is no model or has no fitted physics, or the plan does not fit it.
    """
    return _with_plan(model, plan)[1]


def _with_plan(path: Path, plan: SamplingPlan) -> tuple[Model, SamplingPlan]:
    model = read_model(path)
    lacking = [body.name for body in model.file.bodies if body.name not in model.collision]
    if lacking:
        raise InputDataError(
            f"{path}: the body '{lacking[0]}' has no colliding spheres.",
            todo="fit it again: cgwm fit CAPTURE --out MODEL.",
        )
    if model.file.contact is None:
        World.from_model(model)  # says what is missing, and how to get it
    model = replace(model, file=with_correlations(model))
    require_admissible(model.file, plan.parameters)
    return model, resolve_plan(model, plan)


def _prepare(path: Path, config: SynthesizeConfig) -> _Job:
    model, plan = _with_plan(path, config.plan)
    count = round(config.duration_s * config.frame_rate_hz) + 1
    if count < 2:
        raise UsageError(
            f"{config.duration_s:g} s at {config.frame_rate_hz:g} frames/s is one frame.", "two frames or more."
        )
    device = _device(config)
    visible = bool(model.body_splats)
    if plan.reject.unseen_share is not None and not visible:
        raise InputDataError(
            f"{path}: the model has no visual spheres, so that no camera sees it, and the plan has unseen_share.",
            todo="leave unseen_share out of [reject].",
        )
    cameras = look_at_cameras(model, plan, config) if visible else {}
    renderer = LabelRenderer(model, cameras, device) if visible else None
    times = np.arange(count) / config.frame_rate_hz
    simulator, rejection = Simulator(model, times, device), Rejection.of(model, plan.reject)
    return _Job(model, config, plan, times, cameras, renderer, simulator, rejection, device)


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


@contextmanager
def _quick_turns() -> Iterator[None]:
    """Let threads take turns with the interpreter after 0.2 ms instead of 5.

    The thread that launches the work of a GPU lets go of the interpreter at each launch, and waits for its turn to go
    on while others compress and write.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(2e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


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
        config=settings.model_dump(mode="json", exclude=NOT_CONTENT),
        rollouts=job.config.rollouts,
        shard_count=job.config.shards,
        bodies=tuple(body.name for body in job.model.file.bodies),
        cameras=tuple(job.cameras),
        versions={name: version(name) for name in RECORDED_PACKAGES} | {"rollout_engine": job.simulator.engine},
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
    together = {name for block in job.model.file.correlations for name in block.parameters}
    alone = [name for name in spread if name not in together and name not in DERIVED]
    if job.plan.parameter_spread > 0 and len(alone) > 1:
        notes.append(f"drawn each by itself, because the model has no correlations of them: {', '.join(alone)}")
    if job.plan.light_turn_deg.support != (0.0, 0.0) and job.model.file.light is None:
        notes.append("light_turn_deg turns nothing: the model has no light")
    unseen = [b.name for b in job.model.file.bodies if b.name not in job.model.body_splats]
    if job.renderer is not None and unseen:
        notes.append(f"not in the images, because they have no visual spheres: {', '.join(unseen)}")
    return tuple(notes)


def _entry(path: Path, job: _Job, rollouts: int, frames: int) -> ShardEntry:
    index, name = job.config.shard, shard_name(job.config.shard, job.config.shards)
    return shard_entry(path, index, rollouts, frames, name, torch.device(job.device).type)


def _frames(job: _Job, draw: Draw, labels: RolloutLabels, stopwatch: Stopwatch) -> Iterator[FrameBlock]:
    if job.renderer is None:
        return
    with stopwatch.part("render", job.device == "cuda"):
        if job.plan.moving_views:
            job.renderer.set_cameras(draw.cameras)
        if job.plan.light_turn_deg.support != (0.0, 0.0) and draw.lighting.light is not None:
            job.renderer.set_light(draw.lighting.light)
        exposures = None if draw.lighting.plain else draw.lighting.exposures
        blocks = job.renderer.blocks(labels.position_m, labels.quat_wxyz, wait=False, exposures=exposures)
    while True:
        with stopwatch.part("render", job.device == "cuda"):
            block = next(blocks, None)
        if block is None:
            return
        yield block
