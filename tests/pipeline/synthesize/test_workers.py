"""Shards in several processes: the same bytes, and nothing unfinished after an interrupt or a death."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest
from cgwm.datasets.io.atomic import sha256
from cgwm.pipeline.runtime import processes
from cgwm.pipeline.runtime.processes import in_workers, share_of_cores
from cgwm.pipeline.synthesize.shards import synthesize_shards
from cgwm.schemas import CgwmError, SynthesizeConfig, UsageError
from helpers.forked import Forked, forked
from helpers.small_model import write_small_model

CONFIG = SynthesizeConfig(rollouts=3, duration_s=0.3, width=32, height=24, device="cpu", seed=3, shards=2)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_model(tmp_path_factory.mktemp("models") / "model")


@pytest.fixture
def quick_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start processes as forks of one that has loaded the stage: each that is spawned loads it for three seconds."""
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload([synthesize_shards.__module__])
    monkeypatch.setattr(processes.multiprocessing, "get_context", {"spawn": server}.__getitem__)


def test_processes_make_the_same_bytes(quick_start: None, model: Path, tmp_path: Path) -> None:
    synthesize_shards(model, tmp_path / "one", CONFIG)
    summary = synthesize_shards(model, tmp_path / "two", CONFIG, workers=2)
    assert (summary.made, summary.shards, summary.rollouts) == (2, 2, 3)
    assert sha256(tmp_path / "one") == sha256(tmp_path / "two")
    assert synthesize_shards(model, tmp_path / "two", CONFIG, resume=True, workers=2).made == 0
    with pytest.raises(UsageError, match=r"another dataset: its config.seed is 3, here 4"):
        other = CONFIG.model_copy(update={"seed": 4})
        synthesize_shards(model, tmp_path / "two", other, resume=True, workers=2)


def test_an_interrupt_ends_the_processes_and_leaves_nothing_unfinished(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["synthesize", model, "--out", out, "--shards=2", "--workers=2", "--no-preview", "--device=cpu"]
    words += ["--rollouts=400", "--set=synthesize.width=32", "--set=synthesize.height=24"]

    def started_as_forks() -> None:
        """Processes of a command that has loaded the stage: each that is spawned loads it for three seconds."""
        forks = multiprocessing.get_context("fork")
        processes.multiprocessing.get_context = {"spawn": forks}.__getitem__  # of that process alone

    with Forked(*words, before=started_as_forks) as process:
        end = time.monotonic() + 120
        while len(list(tmp_path.glob(".out.*.partial-*"))) < 2:
            assert process.poll() is None and time.monotonic() < end, process.printed()
            time.sleep(0.01)
        writers = {int(path.name.split(".partial-")[1].split("-")[0]) for path in tmp_path.glob(".out.*.partial-*")}
        process.send_signal(signal.SIGINT)
        done = process.ended(60)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == f"Interrupted; 0 of 2 shards of {out} are complete; the same command with --resume goes on.\n"
    assert list(tmp_path.iterdir()) == []
    assert len(writers) == 2 and process.pid not in writers
    for pid in writers:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_process_that_dies_is_named() -> None:
    with pytest.raises(CgwmError, match=r"shard 7: its process ended by signal 9 \(SIGKILL\)[\s\S]*--resume"):
        list(in_workers(signal.raise_signal, {7: (signal.SIGKILL,)}, 2))
    with pytest.raises(CgwmError, match=r"shard 8: its process ended with exit code 3"):
        list(in_workers(os._exit, {8: (3,)}, 1))


def test_what_a_task_raises_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        list(in_workers(divmod, {0: (1, 0)}, 1))
    assert dict(in_workers(divmod, {k: (k, 2) for k in range(5)}, 2)) == {k: divmod(k, 2) for k in range(5)}


def test_shares_of_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 2, 4, 6, 8}, raising=False)
    assert [share_of_cores(number, 2) for number in range(2)] == [[0, 2], [4, 6, 8]]
    assert [share_of_cores(number, 6) for number in range(6)] == [[0], [2], [4], [6], [8], [0]]


def test_workers_are_no_part_of_a_shard_or_a_cluster(model: Path, tmp_path: Path) -> None:
    words = ["synthesize", str(model), "--out", str(tmp_path / "out"), "--workers=2"]
    for more, text in ((["--shard=0/2"], "--shard makes one"), (["--ray", "local"], "--ray has its own workers")):
        done = forked(*words, *more)
        assert (done.returncode, text in done.stderr) == (2, True)
