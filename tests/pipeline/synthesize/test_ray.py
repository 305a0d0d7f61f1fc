"""Shards as the tasks of a local Ray cluster: the same bytes, also where a worker dies in the middle."""

import os
import re
import signal
import threading
import time
from pathlib import Path

import pytest
import torch
from cgwm.datasets.io.atomic import sha256
from cgwm.pipeline.synthesize.shards import synthesize_shards
from cgwm.schemas import SynthesizeConfig, UsageError
from helpers.small_model import write_small_model

pytestmark = pytest.mark.evidence
ray = pytest.importorskip("ray", reason="the extra cgwm[ray] is not installed")

CONFIG = SynthesizeConfig(rollouts=6, duration_s=0.5, width=64, height=48, device="cpu", seed=3, shards=3)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_model(tmp_path_factory.mktemp("models") / "model")


def kill_a_writer(folder: Path, killed: list[int]) -> None:
    """Kill the first process that writes a shard, as soon as it does."""
    end = time.monotonic() + 120
    while not killed and time.monotonic() < end:
        for file in folder.glob(".out.rollouts-*.partial-*"):
            pid = int(re.findall(r"partial-(\d+)-", file.name)[0])
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)
            break
        time.sleep(0.002)


def test_a_worker_that_is_killed_changes_no_byte(model: Path, tmp_path: Path) -> None:
    synthesize_shards(model, tmp_path / "here", CONFIG)
    killed: list[int] = []
    killer = threading.Thread(target=kill_a_writer, args=(tmp_path, killed), daemon=True)
    killer.start()
    summary = synthesize_shards(model, tmp_path / "out", CONFIG, ray="local")
    killer.join()
    assert len(killed) == 1 and killed[0] != os.getpid()
    assert summary.made == 3 and summary.rollouts == 6
    assert sha256(tmp_path / "out") == sha256(tmp_path / "here")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here", "out"]  # nothing unfinished is left
    assert synthesize_shards(model, tmp_path / "out", CONFIG, resume=True, ray="local").made == 0


def test_a_cluster_that_has_no_gpu_or_is_not_there(model: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--ray 127.0.0.1:1: no Ray cluster answers there"):
        synthesize_shards(model, tmp_path / "out", CONFIG, ray="127.0.0.1:1")
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU, and so has its cluster")
    with pytest.raises(UsageError, match=r"--device cuda: the Ray cluster has no GPU"):
        synthesize_shards(model, tmp_path / "out", CONFIG.model_copy(update={"device": "cuda"}), ray="local")
