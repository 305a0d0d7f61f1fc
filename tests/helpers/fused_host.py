"""The fused kernel's source built with g++ and run on the CPU: every line of it is tested without a GPU.

The threads of a block are fibres that take turns: each runs to its next exchange with the others. As on a GPU, several
environments share a warp, and all of its threads must take part in each exchange, at the same place of the program; or
the warps of a block share an environment, and all threads must come to the places where they wait for each other.
Environments begin in memory that is filled with what no number or index is, and a place outside of the arrays is told.
"""

from __future__ import annotations

import ctypes
import platform
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pytest
from cgwm.pipeline.physics.fused import host
from cgwm.pipeline.physics.fused.structure import Structure
from cgwm.pipeline.runtime import kernel_build
from torch import Tensor

COMPILER = shutil.which("g++")

SHIM = r"""
#include <cmath>
#include <cstdio>
#include <csetjmp>
#include <csignal>
#include <cstdlib>
#include <ucontext.h>
#define __device__
#define __restrict__ __restrict

const int MOST = 256;
struct Fibres {  // the threads of a block
    ucontext_t home, contexts[MOST];
    jmp_buf places_left[MOST];
    bool begun[MOST];
    double slots[2][MOST];
    const void* places[2][MOST];
    long exchanges[MOST], waits[MOST], halts[MOST];
    const void *waits_at[MOST], *halts_at[MOST];
    bool done[MOST];
    int count, current;
};
static Fibres fibres;

static void next_fibre() {
    int from = fibres.current;
    fibres.current = (from + 1) % fibres.count;
    if (_setjmp(fibres.places_left[from])) return;
    if (fibres.begun[fibres.current]) _longjmp(fibres.places_left[fibres.current], 1);
    fibres.begun[fibres.current] = true;
    setcontext(&fibres.contexts[fibres.current]);  // asks the system for its signals, which a jump does not
}

static void part_ways() {
    fprintf(stderr, "lanes part ways\n");
    abort();
}

static int first_of_warp() { return fibres.current / 32 * 32; }
static int end_of_warp() { return first_of_warp() + 32 < fibres.count ? first_of_warp() + 32 : fibres.count; }

// Lets the other lanes of a set run until they came to a place as often as this one.
static void await(int first, int end, unsigned others, const long* times) {
    int lane = fibres.current;
    for (int round = 0; round < 1000000; round++) {
        bool all = true;
        for (int other = first; other < end && all; other++) {
            bool missing = (others >> other % 32 & 1) && times[other] < times[lane];
            if (missing && fibres.done[other]) part_ways();
            all = all && !missing;
        }
        if (all) return;
        next_fibre();
    }
    part_ways();
}

static const double* exchange(double mine, const void* place) {
    int lane = fibres.current, turn = fibres.exchanges[lane]++ % 2;
    fibres.slots[turn][lane] = mine;
    fibres.places[turn][lane] = place;
    await(first_of_warp(), end_of_warp(), 0xffffffffu, fibres.exchanges);
    for (int other = first_of_warp(); other < end_of_warp(); other++) {
        if (fibres.exchanges[other] > fibres.exchanges[lane] + 1 || fibres.places[turn][other] != place) part_ways();
    }
    return fibres.slots[turn];
}
__attribute__((noinline)) static void __syncwarp(unsigned peers) {
    int lane = fibres.current;
    fibres.waits[lane]++;
    fibres.waits_at[lane] = __builtin_return_address(0);
    await(first_of_warp(), end_of_warp(), peers, fibres.waits);
    for (int other = first_of_warp(); other < end_of_warp(); other++) {
        bool here = (peers >> other % 32 & 1) && fibres.waits[other] == fibres.waits[lane];
        if (here && fibres.waits_at[other] != fibres.waits_at[lane]) part_ways();
    }
}
__attribute__((noinline)) static void __syncthreads() {
    int lane = fibres.current;
    fibres.halts[lane]++;
    fibres.halts_at[lane] = __builtin_return_address(0);
    await(0, fibres.count, 0xffffffffu, fibres.halts);
    for (int other = 0; other < fibres.count; other++) {
        if (fibres.halts[other] == fibres.halts[lane] && fibres.halts_at[other] != fibres.halts_at[lane]) part_ways();
    }
}
#define PLACE __builtin_return_address(0)
template <class T> __attribute__((noinline)) T __shfl_xor_sync(unsigned, T mine, int apart, int) {
    int lane = fibres.current;
    return T(exchange(mine, PLACE)[lane ^ apart]);
}
template <class T> __attribute__((noinline)) T __shfl_sync(unsigned, T mine, int source, int width) {
    int first = fibres.current / width * width;
    return T(exchange(mine, PLACE)[first + source]);
}
__attribute__((noinline)) static bool __any_sync(unsigned, bool mine) {
    const double* all = exchange(mine, PLACE);
    for (int lane = first_of_warp(); lane < end_of_warp(); lane++) if (all[lane] != 0) return true;
    return false;
}
__attribute__((noinline)) static unsigned __ballot_sync(unsigned, bool mine) {
    const double* all = exchange(mine, PLACE);
    unsigned marks = 0;
    for (int lane = first_of_warp(); lane < end_of_warp(); lane++) marks |= unsigned(all[lane] != 0) << lane % 32;
    return marks;
}
inline int __popc(unsigned marks) { return __builtin_popcount(marks); }
inline int __ffs(unsigned marks) { return __builtin_ffs((int)marks); }
"""

ENTRY = r"""
static const Problem* shared_problem;
static int first_environment;
#if SHARED
static Environment copies[THREADS / LANES];
#endif

// Fills memory with what no number is and no index may be. What is read before it is set is then seen: a GPU's memory
// holds what ran before, that of a CPU is mostly zero.
static void fill_unset(void* room, unsigned long bytes) {
    const int unset = 0x7fffffff;  // two of them are a NaN
    for (unsigned long at = 0; at < bytes; at += sizeof unset) __builtin_memcpy((char*)room + at, &unset, sizeof unset);
}

static void lane_main() {
    Lanes lanes = {fibres.current % LANES, false};
#if SHARED
    Environment& env = copies[fibres.current / LANES];
#else
    Environment env;
    fill_unset(&env, sizeof env);
#endif
    roll(*shared_problem, first_environment + fibres.current / LANES, lanes, env);
    fibres.done[fibres.current] = true;
    for (int other = 0; other < fibres.count; other++) {
        while (!fibres.done[other]) next_fibre();
    }
    setcontext(&fibres.home);
}

static void simulate(Problem& problem) {
    const int environments = problem.environments;
#if LANES == 1
    for (int index = 0; index < environments; index++) {
        Lanes lanes = {0, false};
        Environment env;
        fill_unset(&env, sizeof env);
        roll(problem, index, lanes, env);
    }
#else
    for (int first = 0; first < environments; first += THREADS / LANES) {
        static char stacks[THREADS][1 << 20];
#if SHARED
        fill_unset(copies, sizeof copies);
#endif
        shared_problem = &problem;
        first_environment = first;
        fibres.count = environments - first < THREADS / LANES ? (environments - first) * LANES : THREADS;
        fibres.current = 0;
        for (int lane = 0; lane < fibres.count; lane++) {
            fibres.exchanges[lane] = fibres.waits[lane] = fibres.halts[lane] = 0;
            fibres.done[lane] = false;
            fibres.begun[lane] = lane == 0;
            getcontext(&fibres.contexts[lane]);
            fibres.contexts[lane].uc_stack.ss_sp = stacks[lane];
            fibres.contexts[lane].uc_stack.ss_size = sizeof stacks[lane];
            fibres.contexts[lane].uc_link = nullptr;
            makecontext(&fibres.contexts[lane], lane_main, 0);
        }
        swapcontext(&fibres.home, &fibres.contexts[0]);
        for (int lane = 0; lane < fibres.count; lane++) {
            if (!fibres.done[lane]) { fprintf(stderr, "lane %d waits for others that ended\n", lane); abort(); }
        }
    }
#endif
}

// Bytes of what the threads of an environment share.
extern "C" unsigned long shared_size() { return sizeof(Environment); }

static sigjmp_buf before_faults;
static void fault(int) { siglongjmp(before_faults, 1); }

// Returns whether a place outside of the arrays was read or written.
extern "C" int run(PARAMETERS) {
    Problem problem = PROBLEM;
    struct sigaction ours = {}, others;
    ours.sa_handler = fault;
    sigaction(SIGSEGV, &ours, &others);
    bool faulty = sigsetjmp(before_faults, 1);
    if (!faulty) simulate(problem);
    sigaction(SIGSEGV, &others, nullptr);
    return faulty;
}
"""


PRODUCT_FLAGS, PRODUCT_WIDTH = host.FLAGS, host.width
LINKER = ("-fuse-ld=gold",) if shutil.which("ld.gold") else ()
"""The quickest linker that is here: a sixth of the time of a build."""
QUICK_FLAGS = (*("-O1" if flag == "-O3" else flag for flag in PRODUCT_FLAGS), *LINKER)
"""Those of the product's kernels in tests: the same arithmetic, built in half of the time."""


@contextmanager
def built_as_for_users() -> Iterator[None]:
    """Build the product's kernels with the flags that users have, for vectors of rollouts where they have them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "FLAGS", PRODUCT_FLAGS)
        patch.setattr(host, "width", PRODUCT_WIDTH)
        host._library.cache_clear()
        yield
        host._library.cache_clear()


WARNINGS = ("-Wall", "-Wextra", "-Werror", "-Wno-unknown-pragmas", "-Wno-clobbered", "-Wno-unused-function")
# g++ does not see that only pairs of two bodies are faced
WARNINGS += ("-Wno-unused-parameter", "-Wno-unused-variable", "-Wno-array-bounds")


@cache
def library(structure: Structure, flags: tuple[str, ...] = ("-O0",)) -> ctypes.CDLL:
    """Return the kernel of a structure, built now or, of the same source and compiler, by an earlier run of tests."""
    assert COMPILER is not None
    source = SHIM + structure.source(host=True) + ENTRY
    # the checked longjmp of some distributions' default takes a jump to another fibre's stack for an error
    command = [COMPILER, "-std=c++14", "-shared", "-fPIC", "-U_FORTIFY_SOURCE", *LINKER, *WARNINGS, *flags]

    def build(folder: Path) -> Path:
        (folder / "rollout.cpp").write_text(source)
        done = subprocess.run(
            [*command, "rollout.cpp", "-o", "rollout.so"], cwd=folder, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return folder / "rollout.so"

    recipe = "\n".join((*command, platform.machine(), str(Path(COMPILER).stat().st_mtime_ns), source))
    return kernel_build.built(recipe, ".so", build, lambda file: ctypes.CDLL(str(file)))


SIZES = {"signed char": 1, "short": 2, "int": 4}
"""Bytes of the types of which lists are."""
SHARED_ROOM = 0.3
"""Largest share by which the bound on an environment's memory may exceed what it takes."""


@cache
def check_memory(structure: Structure) -> None:
    """Compare the bounds on the memory that threads share, from which follows how many of them fit, with what it is."""
    if not structure.shared:
        return
    size = library(structure).shared_size
    size.restype = ctypes.c_ulong
    copies = re.findall(r"__shared__ static ([a-z ]+) \w+\[(\d+)\];", structure.source())
    lists = sum(SIZES[kind] * int(count) for kind, count in copies)
    environments = structure.threads // structure.lanes
    room = structure.shared_bytes - size()
    assert copies and 0 <= room <= SHARED_ROOM * size(), f"{room} bytes more than an environment takes"
    # each list may begin up to 3 bytes after the one before, and the block's last array elsewhere
    more = structure.block_bytes - environments * structure.shared_bytes - lists
    assert 3 * len(copies) <= more <= 3 * len(copies) + 64, f"{more} bytes more than lists of a block take"


def run(structure: Structure, tensors: tuple[Tensor | None, ...], numbers: tuple[int, ...]) -> None:
    """Do what `fused.launch.launch` does, on the CPU."""
    pointers = [ctypes.c_void_p(None if tensor is None else tensor.data_ptr()) for tensor in tensors]
    faulty = library(structure).run(*pointers, *(ctypes.c_int(number) for number in numbers))
    check_memory(structure)
    assert not faulty, "the kernel used an index that was not set or lies outside of an array"
