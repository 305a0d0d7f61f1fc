"""The fused kernel on the CPU, where there is a C++ compiler: the same source, built once and kept, one thread a core.

It gives what the torch engine gives to rounding, in a tenth of the time: a step of the torch engine is a hundred
operations on small tensors, each of which costs more to begin than to do.
"""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from ... import kernel_cache
from ...compiler import compiler
from ...threads import kernel_threads
from ..driven import Drive
from ..rollout import Rollout
from ..world import State, World
from .packing import reason_against
from .rollout import roll
from .structure import Structure

if TYPE_CHECKING:
    from ....datasets.tracks import Track

FLAGS = ("-std=c++17", "-O2", "-shared", "-fPIC", "-pthread", "-ffp-contract=off", "-w")
"""Nothing that lets the compiler reorder sums, or use what only this processor has: what is kept serves others too."""
BUILD_S = 120.0
"""A compiler that takes longer is given up."""
THREAD_ROLLOUTS = 16
"""Fewer rollouts than this are not worth a thread."""

_SHIM = """
#include <atomic>
#include <cmath>
#include <thread>
#include <vector>
#define __device__
#define __restrict__ __restrict
"""
_ENTRY = """
extern "C" void run(int threads, PARAMETERS) {
    const Problem problem = PROBLEM;
    std::atomic<int> next(0);
    auto work = [&]() {
        for (int first; (first = next.fetch_add(8)) < environments;) {
            for (int index = first; index < first + 8 && index < environments; index++) {
                Lanes lanes = {0, false};
                roll(problem, index, lanes);
            }
        }
    };
    std::vector<std::thread> others;
    for (int k = 1; k < threads; k++) others.emplace_back(work);
    work();
    for (std::thread& other : others) other.join();
}
"""


def lacking(world: World) -> str | None:
    """Return why the kernel cannot take a world on the CPU; None where it can."""
    if world.gravity.device.type != "cpu":
        return f"its tensors are on the device '{world.gravity.device.type}', not on the CPU"
    if compiler() is None:
        return "there is no C++ compiler (g++, clang++ or c++)"
    return reason_against(world) or _trial()


def simulate_on_host(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive] | None = None,
    record_contacts: bool = False,
) -> Rollout:
    """Do what `simulate_fused` does, for tensors on the CPU.

    Raises:
        InputDataError: As `simulate` does.
        UsageError: If a reverse derivative is asked for.
    """
    return roll(_launch, world, state, times_s, driven, record_contacts, lanes=1)


def _launch(structure: Structure, tensors: tuple[Tensor | None, ...], numbers: tuple[int, ...]) -> None:
    pointers = [ctypes.c_void_p(None if tensor is None else tensor.data_ptr()) for tensor in tensors]
    threads = max(1, min(kernel_threads(), numbers[0] // THREAD_ROLLOUTS))
    _library(structure).run(ctypes.c_int(threads), *pointers, *(ctypes.c_int(number) for number in numbers))


@cache
def _library(structure: Structure) -> ctypes.CDLL:
    return _built(_SHIM + structure.source(host=True) + _ENTRY)


@cache
def _trial() -> str | None:
    """Return why the compiler builds nothing that can be loaded; None where it does."""
    try:
        _built('extern "C" int answer() { return 42; }')
    except (OSError, subprocess.SubprocessError) as error:
        said = error.stderr if isinstance(error, subprocess.CalledProcessError) else ""
        return f"the C++ compiler {compiler()} failed: {(said or str(error)).strip().splitlines()[-1]}"
    return None


def _built(source: str) -> ctypes.CDLL:
    """Build a source, or take what an earlier run built of it."""
    command = compiler()
    assert command is not None  # see lacking

    def build(work: Path) -> Path:
        program, library = work / "rollout.cpp", work / "rollout.so"
        program.write_text(source, encoding="utf-8")
        steps = [command, *FLAGS, str(program), "-o", str(library)]
        own = os.environ | {"TMPDIR": str(work)}
        subprocess.run(steps, check=True, capture_output=True, text=True, timeout=BUILD_S, env=own)
        return library

    recipe = "\n".join((command, platform.machine(), str(Path(command).stat().st_mtime_ns), *FLAGS, source))
    return kernel_cache.built(recipe, ".so", build, lambda library: ctypes.CDLL(str(library)))
