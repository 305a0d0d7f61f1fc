"""Processors that this process may use, and threads that leave them to others while they wait."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

_CGROUPS, _OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_POOLS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Variables from which the libraries take the number of their threads when they are loaded."""


def processors() -> int:
    """Return the number of processors that this process may use, see :func:`processor_limits`."""
    return min(processor_limits().values())


@cache
def processor_limits() -> Mapping[str, int]:
    """Return what limits the processors of this process, by name: the machine, and whatever allows it fewer.

    These are the affinity that a batch system or `taskset` sets, the quota of a container (rounded down, at least 1),
    `OMP_NUM_THREADS`, and the number of processors that SLURM gave to the task.
    """
    limits = {"the machine": os.cpu_count() or 1}
    if hasattr(os, "sched_getaffinity"):
        limits["its affinity"] = len(os.sched_getaffinity(0))
    quotas = [max(1, int(quota)) for quota in _quotas()]
    if quotas:
        limits["the quota of its control group"] = min(quotas)
    return limits | dict(_stated_limits())


def _stated_limits() -> Iterator[tuple[str, int]]:
    """Yield the environment variables that limit the processors, and their numbers."""
    for name in ("OMP_NUM_THREADS", "SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE"):
        first = os.environ.get(name, "").split(",")[0].split("(")[0]
        if first.isdecimal() and int(first) > 0:
            yield name, int(first)


def use_few_threads() -> None:
    """Have the libraries that are loaded from now on start no more threads than processors, and wait without spinning.

    OpenMP's threads spin by default while they wait for each other. On processors that other processes use, too, most
    of the time went into that: a fit took five times the processor time. Those of OpenBLAS, which numpy has, always
    spin, and our matrices are too small to be shared out: a second thread took a sixth of a diagnosis's processor time.
    What is set in the environment stays.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("KMP_BLOCKTIME", "0")  # the same for LLVM's and Intel's OpenMP
    count = str(processors())
    for name in _POOLS:
        os.environ.setdefault(name, count)


def _quotas() -> Iterator[float]:
    """Yield the processors that the control groups of this process allow, of version 2 and 1."""
    try:
        lines = _OWN_GROUPS.read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = _CGROUPS if not controllers else _CGROUPS / controllers
        folder = root / path.lstrip("/")
        for group in (group for group in (folder, *folder.parents) if group.is_relative_to(root)):
            yield from _quota(group)


def _quota(group: Path) -> Iterator[float]:
    try:
        if (group / "cpu.max").exists():
            limit, period = (group / "cpu.max").read_text(encoding="ascii").split()
        else:
            limit, period = (
                (group / f"cpu.cfs_{name}_us").read_text(encoding="ascii").strip() for name in ("quota", "period")
            )
        if limit.isdecimal():
            yield int(limit) / int(period)
    except (OSError, ValueError):
        return  # no such controller here
