"""All shards of a dataset in one command: one after the other, in processes, or as the tasks of a Ray cluster."""

from __future__ import annotations

import logging
import os
import signal
import socket
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import chdir, closing, contextmanager
from pathlib import Path
from typing import Any

from ..datasets.dataset import refuse_existing_shards
from ..datasets.progress import progress
from ..datasets.shards import shard_range
from ..schemas import (
    CgwmError,
    DamagedShardError,
    DatasetSummary,
    NotConvergedError,
    ShardsSummary,
    SynthesizeConfig,
    UsageError,
)
from .synthesize import shard_indices, synthesize
from .workers import in_workers

ROLLOUTS_PER_SHARD = 32
"""Of a Ray task, where nothing else is said: some minutes of work, which is what a dead worker loses."""
RETRIES = 3
"""How often a shard is begun again whose worker died."""
_OF_ONE_SHARD = (NotConvergedError, DamagedShardError)
"""Errors that say nothing about the other shards: these are still made."""

_NONE_RUNS = "Could not find any running Ray instance"
"""What Ray says where no cluster runs on this machine, which is no fault."""

_Outcome = tuple[int, DatasetSummary | CgwmError]


def default_shards(rollouts: int) -> int:
    """Return the number of shards for a cluster: it depends on the dataset alone, so that any cluster can go on.

    >>> default_shards(8), default_shards(10_000)
    (1, 313)
    """
    return -(-rollouts // ROLLOUTS_PER_SHARD)


def synthesize_shards(
    model: Path,
    out: Path,
    config: SynthesizeConfig,
    overwrite: bool = False,
    resume: bool = False,
    ray: str | None = None,
    preview: bool = False,
    workers: int = 1,
) -> ShardsSummary:
    """Write all shards of a dataset of labelled rollouts.

    Args:
        model: MODEL.
        out: DATASET.
        config: The settings; its number of the shard counts for nothing.
        overwrite: Replace shards that exist; with `resume` only damaged ones.
        resume: Keep the shards that are there and whole.
        ray: The address of a Ray cluster, ``local`` for one on this machine, ``auto`` for the one that runs (by
            RAY_ADDRESS, or here) or else ``local``. All its machines have to see `model` and `out` at these paths.
            None: without Ray, in this process.
        preview: Write a contact sheet and a film of the first rollouts beside the first shard.
        workers: Without Ray, make so many shards at a time, in processes that share the cores and the GPU. A script
            that asks for more than one needs ``if __name__ == "__main__":``, as these processes import it.

    Returns:
        What the dataset holds now, and the speed.

    Raises:
        CgwmError: As :func:`synthesize`. Where one shard diverges or is damaged, the others are made all the same.
        KeyboardInterrupt: With a word on what is complete.
    """
    began = time.perf_counter()
    shard_indices(config)
    if not (resume or overwrite):
        refuse_existing_shards(out, config.shards)
    parts = [config.model_copy(update={"shard": shard}) for shard in range(config.shards)]
    if ray is None and workers > 1:
        outcomes = _in_processes(model, out, parts, overwrite, resume, preview, workers)
    elif ray is None:
        outcomes = _here(model, out, parts, overwrite, resume, preview)
    else:
        outcomes = _on_ray(model, out, parts, overwrite, resume, preview, ray)
    done: dict[int, DatasetSummary] = {}
    failed: dict[int, CgwmError] = {}
    try:
        # closed at once when it is left at an error, and its tasks with it
        with progress(None, "shards", config.rollouts, "rollout") as bar, closing(outcomes):
            for shard, outcome in outcomes:
                if isinstance(outcome, DatasetSummary):
                    done[shard] = outcome
                elif isinstance(outcome, _OF_ONE_SHARD):
                    failed[shard] = outcome
                else:
                    raise outcome
                bar.update(len(shard_range(config.rollouts, config.shards, shard)))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"{len(done)} of {config.shards} shards of {out} are complete; the same command with --resume goes on."
        ) from None
    if failed:
        raise _failure(failed, len(done), config.shards)
    return _summary(out, config, done, time.perf_counter() - began)


def _here(
    model: Path, out: Path, parts: Sequence[SynthesizeConfig], overwrite: bool, resume: bool, preview: bool
) -> Generator[_Outcome, None, None]:
    for part in parts:
        yield part.shard, _task(str(model), str(out), part, overwrite, resume, preview)


def _in_processes(
    model: Path, out: Path, parts: Sequence[SynthesizeConfig], overwrite: bool, resume: bool, preview: bool, count: int
) -> Generator[_Outcome, None, None]:
    calls = {part.shard: (str(model), str(out), part, overwrite, resume, preview) for part in parts}
    return in_workers(_task, calls, count)


def _on_ray(
    model: Path,
    out: Path,
    parts: Sequence[SynthesizeConfig],
    overwrite: bool,
    resume: bool,
    preview: bool,
    address: str,
) -> Generator[_Outcome, None, None]:
    with _connected(address) as ray:
        gpus = _gpus(ray, parts[0].device)
        task = ray.remote(_task).options(num_cpus=1, num_gpus=gpus, max_retries=RETRIES)
        # A task that is begun again may find the shard that it has made before its worker died: it keeps it.
        keep = resume or not overwrite
        places = str(model.resolve()), str(out.resolve())
        pending = {task.remote(*places, part, overwrite, keep, preview): part.shard for part in parts}
        try:
            while pending:
                ready, _ = ray.wait(list(pending), timeout=1.0)
                for reference in ready:
                    shard = pending.pop(reference)
                    yield shard, _outcome(ray, reference, shard)
        finally:
            for reference in pending:
                ray.cancel(reference)
            if pending:  # so that they remove what is unfinished
                ray.wait(list(pending), num_returns=len(pending), timeout=10.0)


def _task(
    model: str, out: str, config: SynthesizeConfig, overwrite: bool, resume: bool, preview: bool
) -> DatasetSummary | CgwmError:
    """Make one shard; an error that was meant is returned, for Ray would wrap it and show a traceback."""
    try:
        return synthesize(Path(model), Path(out), config, overwrite, resume, preview)
    except CgwmError as error:
        return error


def _outcome(ray: Any, reference: Any, shard: int) -> DatasetSummary | CgwmError:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        reason = str(error.cause or error).strip().splitlines()[-1]
        todo = "install the same cgwm[ray] on every machine of the cluster; --resume keeps the complete shards."
    except ray.exceptions.RayError as error:
        reason = f"{type(error).__name__}, after {RETRIES} more attempts"
        todo = "see Ray's logs (memory?), and run the command again; --resume keeps the complete shards."
    return CgwmError(f"shard {shard}: its Ray task failed: {reason}.", todo=todo)


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UsageError(
            "--ray needs the package ray, which is not installed.", todo="pip install 'cgwm[ray]'"
        ) from None
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    before = signal.getsignal(signal.SIGTERM)
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        _connect(ray, address, quiet)
        signal.signal(signal.SIGTERM, before)  # Ray's own would end the process with another exit code
        yield ray
    finally:
        ray.shutdown()


def _connect(ray: Any, address: str, options: dict[str, Any]) -> None:
    address = os.environ.get("RAY_ADDRESS", address) if address == "auto" else address
    # Ray puts the working directory on its workers' path, where a clone's folder cgwm/ would hide the package.
    with chdir(os.path.sep):
        if address not in ("auto", "local"):
            _require_answer(address)
        if address != "local":
            try:
                ray.init(address=address, **options)
                return
            except (ConnectionError, ValueError) as error:
                if address != "auto" or _NONE_RUNS not in str(error):
                    raise _no_cluster(address, str(error)) from None
        ray.init(address="local", include_dashboard=False, **options)


def _require_answer(address: str) -> None:
    """Ray itself tries for many minutes to reach a machine that is not there."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not (colon and port.isdecimal()):
        raise _no_cluster(address, "no host:port")
    try:
        socket.create_connection((host, int(port)), timeout=10.0).close()
    except OSError as error:
        raise _no_cluster(address, str(error)) from None


def _no_cluster(address: str, reason: str) -> UsageError:
    return UsageError(
        f"--ray {address}: no Ray cluster answers there ({reason.splitlines()[0]}).",
        "host:port, ray://host:port, auto, local.",
        "start one ('ray start --head'), or pass --ray local.",
    )


def _gpus(ray: Any, device: str) -> int:
    """Return the GPUs of a task: one, unless the CPU is asked for or the cluster has none."""
    there = ray.cluster_resources().get("GPU", 0) >= 1
    if device == "cuda" and not there:
        raise UsageError("--device cuda: the Ray cluster has no GPU.", "auto, cpu.", "see 'ray status'.")
    return int(there and device != "cpu")


def _failure(failed: dict[int, CgwmError], done: int, count: int) -> CgwmError:
    shard, first = min(failed.items())
    others = f" ({len(failed)} of {count} shards failed, {done} are complete.)"
    return type(first)(f"shard {shard}: {first.found}{others}", first.allowed, first.todo)


def _summary(out: Path, config: SynthesizeConfig, done: dict[int, DatasetSummary], seconds: float) -> ShardsSummary:
    made = [summary for summary in done.values() if not summary.up_to_date]
    rejected: Counter[str] = Counter()
    for summary in done.values():
        rejected.update(summary.rejected)
    return ShardsSummary(
        dataset=str(out),
        shards=config.shards,
        made=len(made),
        rollouts=sum(summary.rollouts for summary in done.values()),
        frames=sum(summary.frames for summary in done.values()),
        bytes=sum(summary.bytes for summary in done.values()),
        seconds=seconds,
        frames_per_s=sum(summary.frames for summary in made) / seconds,
        rejected=dict(sorted(rejected.items())),
        plan=done[0].plan,
        preview=done[0].preview,
        notes=tuple(dict.fromkeys(note for _, summary in sorted(done.items()) for note in summary.notes)),
    )
