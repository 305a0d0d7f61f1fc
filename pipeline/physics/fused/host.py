"""Fused kernel on the CPU: the CUDA source, built once by a C++ compiler and cached, one thread per core.

Its results equal those of the torch engine up to rounding, in a tenth of the time: a step of the torch engine takes a
hundred operations on small tensors, each of which is dominated by its overhead. Rollouts of one body above the ground
are simulated several at once, in the places of a vector, which changes no bit.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from ...runtime import kernel_build
from ...runtime.resources import kernel_threads
from ..chains.joint_command import JointCommand
from ..kinematic import Drive
from ..rollout import Rollout
from ..state import State
from ..world import World
from .packing import reason_against
from .rollout import roll
from .structure import MOTION_COLUMNS, Structure, kernel_file

if TYPE_CHECKING:
    from ....datasets.capture.tracks import Track

FLAGS = (*kernel_build.HOST_FLAGS, "-fno-tree-slp-vectorize")
"""Options of the compiler. Pairs of neighbouring numbers are not packed into vectors: reading them just after they were
written one by one stalls, which costs a fifth of the time.
"""
THREAD_CONTACT_STEPS = 20_000
"""Minimum number of steps times possible contacts per thread: about a millisecond, many times what a thread costs."""
SUBSTEPS = 10
"""Place of `Packed.substeps` among the tensors of a launch."""
SHARES = 4
"""Number of times that a thread comes for rollouts, so that all end at about the same time."""
MOST_AT_ONCE = 8
"""Maximum number of rollouts that a thread takes at once; rounded up to whole vectors."""
LEAST_WIDE = 16
"""Number of rollouts from which they are simulated in vectors: fewer are not worth the compiler's time."""
LEAST_WIDE_STEPS = 100_000
"""The same for steps of all rollouts of bodies that touch nothing: a tenth of a second of the compiler for each
millisecond that vectors save."""
WIDE_FLAGS = ("--param", "sccvn-max-alias-queries-per-access=30")
"""Options of g++ for programs of vectors: it looks less far for equal values in memory, which takes a third of its time
and finds next to none."""
_WIDTHS = {"-mavx512f": 8, "-mavx2": 4}
"""Numbers of double precision in a vector, by the option of the compiler."""
_DIRECTION = (1.0, 0.7, 1.3)
"""A direction along which rollouts are sorted by their first place, as along an axis many begin equal."""


def lacking(world: World) -> str | None:
    """Return why the kernel does not support a world on the CPU; None where it does."""
    if world.gravity.device.type != "cpu":
        return f"its tensors are on the device '{world.gravity.device.type}', not on the CPU"
    if kernel_build.compiler() is None:
        return kernel_build.NO_COMPILER
    return world.once(reason_against) or kernel_build.host_unavailable()


def simulate_on_host(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive | JointCommand] | None = None,
    record_contacts: bool = False,
) -> Rollout:
    """Simulate a world by the fused kernel, for tensors on the CPU; arguments as in `simulate_fused`.

    Raises:
        InputDataError: As `simulate` does.
        UsageError: If a reverse derivative is requested.
    """
    return roll(launch_on_host, world, state, times_s, driven, record_contacts, lanes=1)


def launch_on_host(structure: Structure, tensors: tuple[Tensor | None, ...], numbers: tuple[int, ...]) -> None:
    """Run the kernel of a structure on the CPU; arguments as of `launch`, tensors on the CPU."""
    pointers = [ctypes.c_void_p(None if tensor is None else tensor.data_ptr()) for tensor in tensors]
    substeps = tensors[SUBSTEPS]
    steps = 1 if substeps is None else max(1, int(substeps.sum()))
    threads = threads_for(numbers[0], steps * max(1, structure.contacts))
    share = max(1, min(MOST_AT_ONCE, numbers[0] // (SHARES * threads)))
    wide = width() if structure.widens and _worth_vectors(structure.contacts, numbers[0], steps) else 0
    order = _order(tensors[0]) if wide and tensors[0] is not None else None
    first = ctypes.c_void_p(None if order is None else order.data_ptr())
    share = -(-share // max(wide, 1)) * max(wide, 1)
    _library(structure, wide).run(*map(ctypes.c_int, (threads, share)), first, *pointers, *map(ctypes.c_int, numbers))


def _worth_vectors(contacts: int, rollouts: int, steps: int) -> bool:
    """Return whether rollouts with a number of possible contacts and of steps are simulated in vectors."""
    return rollouts >= LEAST_WIDE and (contacts > 0 or rollouts * steps >= LEAST_WIDE_STEPS)


def threads_for(rollouts: int, contact_steps: int) -> int:
    """Return the number of threads for rollouts, of which each has a number of steps times possible contacts."""
    return max(1, min(kernel_threads(), rollouts, rollouts * contact_steps // THREAD_CONTACT_STEPS))


@cache
def width() -> int:
    """Return how many rollouts of one body one thread simulates at once, in vectors; 0 for one after another."""
    if Path(kernel_build.compiler() or "").name != "g++":
        return 0
    return max((_WIDTHS.get(flag, 0) for flag in kernel_build.vector_flags()), default=0)


def _order(table: Tensor) -> Tensor:
    """Return rollouts in an order in which neighbours begin alike: they then need the same branches; int32, (B,)."""
    place = table[:, -MOTION_COLUMNS : 3 - MOTION_COLUMNS]
    return (place @ place.new_tensor(_DIRECTION)).argsort().int()


@cache
def _library(structure: Structure, wide: int = 0) -> ctypes.CDLL:
    source = kernel_file("host_prelude") + structure.source(host=True, wide=wide) + kernel_file("host_entry")
    vectors = kernel_build.vector_flags() if wide or structure.hulled or structure.published else ()
    return kernel_build.host_library(source, (*FLAGS, *vectors, *(WIDE_FLAGS if wide else ())))
