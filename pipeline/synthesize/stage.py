"""The stage synthesize: write labelled rollouts of a fitted model to HDF5.

Rollout e is drawn from `numpy.random.SeedSequence(seed, spawn_key=(e,))` with the global index e, and after a rejection
by the plan's rules from `spawn_key=(e, attempt)`; its content depends neither on the sharding nor on the other rollouts
of its batch.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import torch

from ...datasets.io.outputs import reads
from ...datasets.io.progress import progress
from ...datasets.rollouts.dataset import finished_shard, new_dataset, shard_entry
from ...datasets.rollouts.rollout_writer import RolloutWriter
from ...datasets.rollouts.rollouts import FrameBlock, RolloutLabels
from ...datasets.rollouts.shards import contact_count, shard_name, shard_range
from ...schemas import DatasetManifest, DatasetSummary, InputDataError, ShardEntry, SynthesizeConfig, UsageError
from ..runtime.resources import enough_memory, one_torch_thread
from ..runtime.timing import Stopwatch
from .draw import Draw, draw_rollout
from .job import Job, manifest_of, notes_of, prepared
from .labels import labels_of
from .preview import with_preview
from .rejection import accepted_rollouts
from .simulator import ENVIRONMENTS, Diverged

ROLLOUTS_AT_ONCE = {"cuda": ENVIRONMENTS, "cpu": 1}
"""Default number of rollouts per batch by device; simulation is one batch ahead of rendering."""


@dataclass(frozen=True)
class _Outcome:
    """Draws that are not in the dataset."""

    rejected: Counter[str]
    """Number of rejected draws by rule."""
    diverged: list[str]
    """Messages on the diverged draws."""


@reads("model")
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

    With one shard, `out` appears when it is complete. With more, every call adds its shard to `out` in any order, and
    the first call that is ready creates `out`.

    Args:
        model: MODEL, a directory that `cgwm fit` wrote, with fitted physics.
        out: DATASET.
        config: The settings; times, sizes and the sampling plan are in it.
        overwrite: Replace existing output: the dataset if it has one shard, else the shard.
        resume: Keep the shard if it exists with the right hash. With `overwrite`, a damaged one is made again.
        preview: Write a contact sheet and a film of the first rollouts next to the first shard.
        stopwatch: Timer of the parts of the work.

    Returns:
        Summary of the shard with its hash, the speed, and the number of rejected draws by rule.

    Raises:
        InputDataError: If `model` is no model, or has no fitted physics.
        UsageError: If the output exists, or belongs to another dataset.
        DamagedShardError: If a kept shard differs from what was written.
        NotConvergedError: If the rules reject all draws for a rollout, or too many of them diverge.
        NotEnoughSpaceError: If the disk has no room for the shard.
        NotEnoughMemoryError: If the available memory is not sufficient for rendering.
    """
    began = time.perf_counter()
    with one_torch_thread(kernels_too=True):
        shard_indices(config)
        job = prepared(model, config, Path(out))
    tried = f"{job.model.visual_count} spheres, pictures of {config.width}x{config.height} px"
    with enough_memory(tried, job.device, "a smaller --width and --height, a model of fewer spheres"):
        summary = _written(job, model, out, config, overwrite, resume, began, stopwatch or Stopwatch())
    return with_preview(summary) if preview and config.shard == 0 else summary


def _written(
    job: Job,
    model: Path,
    out: Path,
    config: SynthesizeConfig,
    overwrite: bool,
    resume: bool,
    began: float,
    stopwatch: Stopwatch,
) -> DatasetSummary:
    indices = shard_indices(config)
    notes = notes_of(job)
    manifest = manifest_of(model, job, notes)
    if (kept := _kept(out, manifest, config.shard, overwrite, resume)) is not None:
        return _summary(out, job, kept, contact_count(out / kept.file), time.perf_counter() - began, True, notes)
    config_json = json.dumps(manifest.config, sort_keys=True)
    contacts, outcome = 0, _Outcome(Counter(), [])
    dataset = new_dataset(out, manifest, model, config.shard, overwrite)
    with one_torch_thread(kernels_too=True), _quick_turns(), dataset as (path, entries):
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


def _kept(out: Path, manifest: DatasetManifest, shard: int, overwrite: bool, resume: bool) -> ShardEntry | None:
    """Return the entry of a shard that is there already, made by the same command or to be kept; None if there is none.

    Without `resume`, another dataset or a damaged shard is there, and refused where the output is begun.
    """
    if resume:
        return finished_shard(out, manifest, shard, overwrite)
    if overwrite:
        return None
    with suppress(UsageError, InputDataError):
        return finished_shard(out, manifest, shard, overwrite)
    return None


def _summary(
    out: Path, job: Job, entry: ShardEntry, contacts: int, seconds: float, up_to_date: bool, notes: tuple[str, ...]
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
    """Return the consecutive global indices of the rollouts of a shard; shares differ by at most one.

    Raises:
        UsageError: If there are more shards than rollouts.
    """
    if config.shards > config.rollouts:
        raise UsageError(
            f"--shards, --rollouts: {config.shards} shards for {config.rollouts} rollouts: some would be empty.",
            f"1 to {config.rollouts} shards.",
            "take fewer shards, or more rollouts.",
        )
    return shard_range(config.rollouts, config.shards, config.shard)


def _rollouts(
    job: Job, indices: range, outcome: _Outcome, stopwatch: Stopwatch
) -> Generator[tuple[Draw, RolloutLabels], None, None]:
    """Yield the accepted rollouts in the order of their numbers, while the next batch is simulated."""
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


def _batch(job: Job, indices: range, outcome: _Outcome, stopwatch: Stopwatch) -> list[tuple[Draw, RolloutLabels]]:
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


@contextmanager
def _quick_turns() -> Iterator[None]:
    """Let threads switch after 0.2 ms instead of 5 ms.

    The thread that launches GPU work releases the interpreter at each launch, and would wait for threads that compress
    and write.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(2e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def _entry(path: Path, job: Job, rollouts: int, frames: int) -> ShardEntry:
    index, name = job.config.shard, shard_name(job.config.shard, job.config.shards)
    return shard_entry(path, index, rollouts, frames, name, torch.device(job.device).type)


def _frames(job: Job, draw: Draw, labels: RolloutLabels, stopwatch: Stopwatch) -> Iterator[FrameBlock]:
    if job.renderer is None:
        return
    with stopwatch.part("render", job.device == "cuda"):
        if job.plan.moving_views:
            job.renderer.set_cameras(draw.cameras)
        if job.plan.light_turn_deg.support != (0.0, 0.0) and draw.lighting.light is not None:
            job.renderer.set_light(draw.lighting.light)
        if job.config.shadows:
            job.renderer.set_shadow(draw.lighting.shadow)
        exposures = None if draw.lighting.plain else draw.lighting.exposures
        blocks = job.renderer.blocks(labels.position_m, labels.quat_wxyz, wait=False, exposures=exposures)
    while True:
        with stopwatch.part("render", job.device == "cuda"):
            block = next(blocks, None)
        if block is None:
            return
        yield block
