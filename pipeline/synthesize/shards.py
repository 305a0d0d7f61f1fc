"""All shards of a dataset in one command: sequentially, in processes, or as tasks of a Ray cluster."""

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

from ...datasets.io.outputs import reads
from ...datasets.io.progress import progress
from ...datasets.rollouts.dataset import refuse_existing_shards
from ...datasets.rollouts.shards import shard_name, shard_range
from ...schemas import (
    CgwmError,
    DamagedShardError,
    DatasetSummary,
    InterruptedWork,
    NotConvergedError,
    ShardsSummary,
    SynthesizeConfig,
    UsageError,
)
from ...schemas.regular_files import real_path
from ..physics.effects.trust import trust_effects, trusted_effects
from ..runtime.processes import in_workers
from .job import checked_work
from .stage import shard_indices, synthesize

ROLLOUTS_PER_SHARD = 32
"""Default number of rollouts of a Ray task: some minutes of work, which are lost when a worker dies."""
RETRIES = 3
"""Maximum number of restarts of a shard whose worker died."""
_OF_ONE_SHARD = (NotConvergedError, DamagedShardError)
"""Errors of a single shard, after which the other shards are still made."""

_NONE_RUNS = "Could not find any running Ray instance"
"""Message of Ray if no cluster runs on this machine, which is not an error."""

_Outcome = tuple[int, DatasetSummary | CgwmError]


def default_shards(rollouts: int) -> int:
    """Return the number of shards for a cluster, which depends on the dataset alone, so any cluster can resume.

    >>> default_shards(8), default_shards(10_000)
    (1, 313)
    """
    return -(-rollouts // ROLLOUTS_PER_SHARD)


@reads("model")
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
        config: The settings; the number of the shard in them is ignored.
        overwrite: Replace shards that exist; with `resume` only damaged ones.
        resume: Keep existing intact shards.
        ray: The address of a Ray cluster, ``local`` for one on this machine, ``auto`` for the one that runs (by
            RAY_ADDRESS, or here) or else ``local``. All its machines need access to `model` and `out` at these paths.
            None runs without Ray, in this process.
        preview: Write a contact sheet and a film of the first rollouts next to the first shard.
        workers: Number of shards made at a time without Ray, in processes that share the cores and the GPU. A script
            that asks for more than one needs ``if __name__ == "__main__":``, as these processes import it.

    Returns:
        Summary of the present content of the dataset, and the speed.

    Raises:
        CgwmError: As :func:`synthesize`. If one shard diverges or is damaged, the others are still made.
        InterruptedWork: With the number of complete shards.
    """
    began = time.perf_counter()
    shard_indices(config)
    complete = all((out / shard_name(k, config.shards)).is_file() for k in range(config.shards))
    if not (resume or overwrite or complete):  # a complete dataset of the same command is kept, see `synthesize`
        refuse_existing_shards(out, config.shards)
    with checked_work(model, config, config.shards if ray is not None else workers):
        parts = [config.model_copy(update={"shard": shard}) for shard in range(config.shards)]
        if ray is None and workers > 1:
            outcomes = _in_processes(model, out, parts, overwrite, resume, preview, workers)
        elif ray is None:
            outcomes = _here(model, out, parts, overwrite, resume, preview)
        else:
            outcomes = _on_ray(model, out, parts, overwrite, resume, preview, ray)
        done, failed = _collect(outcomes, out, config)
    if failed:
        raise _failure(failed, len(done), config.shards)
    return _summary(out, config, done, time.perf_counter() - began)


def _collect(
    outcomes: Generator[_Outcome, None, None], out: Path, config: SynthesizeConfig
) -> tuple[dict[int, DatasetSummary], dict[int, CgwmError]]:
    """Return the summaries and the errors by shard, as the shards complete.

    Raises:
        CgwmError: If an error concerns all shards.
        InterruptedWork: With a message that says how many shards are complete.
    """
    done: dict[int, DatasetSummary] = {}
    failed: dict[int, CgwmError] = {}
    try:
        # An error closes the generator at once, and with it the tasks that it runs.
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
        raise InterruptedWork(
            f"{len(done)} of {config.shards} shards of {out} are complete; the same command with --resume goes on."
        ) from None
    return done, failed


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
        # A restarted task may find the shard that it made before its worker died, and keeps it.
        keep = resume or not overwrite
        places = str(real_path(model)), str(real_path(out))
        consent = trusted_effects(model)  # other machines have no record of it
        pending = {task.remote(*places, part, overwrite, keep, preview, consent): part.shard for part in parts}
        try:
            while pending:
                ready, _ = ray.wait(list(pending), timeout=1.0)
                for reference in ready:
                    shard = pending.pop(reference)
                    yield shard, _outcome(ray, reference, shard)
        finally:
            for reference in pending:
                ray.cancel(reference)
            if pending:  # lets the tasks remove unfinished files
                ray.wait(list(pending), num_returns=len(pending), timeout=10.0)


def _task(
    model: str,
    out: str,
    config: SynthesizeConfig,
    overwrite: bool,
    resume: bool,
    preview: bool,
    consent: Sequence[str] = (),
) -> DatasetSummary | CgwmError:
    """Make one shard; return expected errors, because Ray would wrap them and show a traceback."""
    try:
        trust_effects(consent)
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
        signal.signal(signal.SIGTERM, before)  # Ray's handler would exit with another code
        yield ray
    finally:
        ray.shutdown()


def _connect(ray: Any, address: str, options: dict[str, Any]) -> None:
    address = os.environ.get("RAY_ADDRESS", address) if address == "auto" else address
    # Ray adds the working directory to its workers' path, where the folder cgwm/ of a clone would hide the package.
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
    """Check that a cluster answers, because Ray tries for many minutes to reach a missing machine."""
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
    """Return the number of GPUs of a task: one, unless the CPU is requested or the cluster has no GPU."""
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
