"""Processors by what the process may use, and threads that do not spin."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from cgwm.datasets.io import processors as module
from cgwm.datasets.io.processors import processor_limits, processors, use_few_threads


@pytest.fixture(autouse=True)
def plain_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """64 processors, and nothing that limits them."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(64)), raising=False)
    monkeypatch.setattr(module, "_CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(module, "_OWN_GROUPS", tmp_path / "own")
    for name in ("OMP_NUM_THREADS", "SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE"):
        monkeypatch.delenv(name, raising=False)
    processor_limits.cache_clear()
    yield
    processor_limits.cache_clear()


def test_a_machine_of_ones_own_is_used_whole() -> None:
    assert processors() == 64


def test_a_batch_system_sets_the_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 4, 5, 6}, raising=False)
    assert processors() == 4


@pytest.mark.parametrize(("quota", "expected"), [("250000 100000", 2), ("50000 100000", 1), ("max 100000", 64)])
def test_a_container_has_a_quota(tmp_path: Path, quota: str, expected: int) -> None:
    (tmp_path / "own").write_text("0::/user/job\n")
    (tmp_path / "cgroup" / "user" / "job").mkdir(parents=True)
    (tmp_path / "cgroup" / "user" / "cpu.max").write_text(quota + "\n")  # of the group around the process's own
    assert processors() == expected


def test_an_older_kernel_has_the_quota_in_two_files(tmp_path: Path) -> None:
    (tmp_path / "own").write_text("4:cpu,cpuacct:/docker/1\n3:memory:/docker/1\n")
    group = tmp_path / "cgroup" / "cpu,cpuacct" / "docker" / "1"
    group.mkdir(parents=True)
    (group / "cpu.cfs_quota_us").write_text("300000\n")
    (group / "cpu.cfs_period_us").write_text("100000\n")
    assert processor_limits()["the quota of its control group"] == processors() == 3


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [("OMP_NUM_THREADS", "6,2", 6), ("SLURM_CPUS_PER_TASK", "4", 4), ("SLURM_CPUS_ON_NODE", "8(x2)", 8)],
)
def test_the_environment_limits_them(monkeypatch: pytest.MonkeyPatch, name: str, text: str, expected: int) -> None:
    monkeypatch.setenv(name, text)
    assert processors() == expected
    assert processor_limits()[name] == expected


SAY = """
import os, sys
from cgwm.cli.main import _app
_app()
assert "torch" not in sys.modules
import torch
print(os.environ["OMP_WAIT_POLICY"], torch.get_num_threads(), os.environ["OPENBLAS_NUM_THREADS"])
"""


GIVEN = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "ACTIVE"}


@pytest.mark.parametrize("given", ["", "ACTIVE"])
def test_waiting_is_passive_unless_the_user_says_otherwise(given: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_WAIT_POLICY", "KMP_BLOCKTIME", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, given)  # so that what is set below does not stay
        if not given:
            monkeypatch.delenv(name)
    use_few_threads()
    assert os.environ["OMP_WAIT_POLICY"] == (given or "PASSIVE") and os.environ["KMP_BLOCKTIME"] == (given or "0")
    assert os.environ["OMP_NUM_THREADS"] == (given or "64")
    assert os.environ["OPENBLAS_NUM_THREADS"] == (given or "1")


# In the suite: the test above, in this process.
@pytest.mark.evidence
@pytest.mark.parametrize("given", [{}, pytest.param(GIVEN, marks=pytest.mark.evidence)])
def test_commands_wait_without_spinning_unless_the_user_says_otherwise(given: dict[str, str]) -> None:
    clean = {name: value for name, value in os.environ.items() if not name.endswith(("_NUM_THREADS", "_POLICY"))}
    said = subprocess.run([sys.executable, "-c", SAY], capture_output=True, text=True, check=True, env=clean | given)
    policy, threads, blas = said.stdout.split()
    assert policy == given.get("OMP_WAIT_POLICY", "PASSIVE")
    assert blas == "1"
    assert int(threads) == 1 if given else int(threads) >= 1
