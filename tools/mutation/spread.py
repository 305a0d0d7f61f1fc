"""Runs of pytest spread over processes: each a fork of this one, which has loaded the large packages once."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

PRELOADED = (
    "torch",
    "numpy",
    "scipy.optimize",
    "scipy.spatial",
    "mujoco",
    "cv2",
    "h5py",
    "pydantic",
    "typer",
    "pytest",
)
"""Imported once, before the processes are forked."""


def preload() -> None:
    """Load what nearly all tests load; what cannot be loaded is for the tests to say.

    The libraries read the number of threads when they are loaded: one, as the processes share the cores.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in PRELOADED:
        with contextlib.suppress(Exception):
            __import__(name)


def fork_pytest(folder: Path, environment: Mapping[str, str], words: Sequence[str], log: Path) -> int:
    """Run pytest with these words in a fork, in a folder; its own processes belong to its group. Returns its number."""
    pid = os.fork()
    if pid:
        return pid
    code, leave = 70, os._exit
    try:
        os.setsid()
        os.environ.update(environment)
        os.chdir(folder)
        sys.path[:0] = environment["PYTHONPATH"].split(os.pathsep)
        sys.dont_write_bytecode = "PYTHONDONTWRITEBYTECODE" in environment
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        import pytest

        code = int(pytest.main(list(words)))
        sys.stdout.flush()
    finally:
        leave(code)


def kill_group(pid: int) -> None:
    """Kill a process and those that it started."""
    try:
        os.killpg(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


def spread(
    root: Path,
    logs: Path,
    parts: Sequence[Sequence[str]],
    environment: Mapping[str, str],
    jobs: int,
    limit_s: float | None,
) -> list[Sequence[str]]:
    """Run pytest once for each list of words, so many at a time; return the lists that had not ended in time."""
    preload()
    (logs / "tmp").mkdir(exist_ok=True)
    end = time.monotonic() + (limit_s or float("inf"))
    running: dict[int, Sequence[str]] = {}
    waiting = list(enumerate(parts))
    while (waiting or running) and time.monotonic() < end:
        while waiting and len(running) < jobs:
            k, words = waiting.pop(0)
            words = [*words, f"--basetemp={logs / 'tmp' / str(k)}"]
            running[fork_pytest(root, environment, words, logs / f"log-{k}.txt")] = parts[k]
        for pid in list(running):
            if os.waitpid(pid, os.WNOHANG)[0]:
                kill_group(pid)
                running.pop(pid)
        time.sleep(0.02)
    for pid in running:
        kill_group(pid)
        os.waitpid(pid, 0)
    return [*running.values(), *(words for _, words in waiting)]
