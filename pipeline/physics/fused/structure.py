"""What a fused kernel is compiled for: the constants of one kind of world."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ..detection import PAIR_SMOOTHING_M
from ..ellipse import CLOSE, FLATTEST, LEAST, NEWTON_STEPS
from ..sweeps import CONTACT_ONSET_M
from .arithmetic_source import ARITHMETIC
from .collision_source import COLLISION
from .contact_source import CONTACTS
from .environment_source import ENVIRONMENT
from .rollout_source import ROLLOUT
from .surface_source import SURFACE

THREADS = 32
"""Of a block: one warp, so that few environments still spread over all multiprocessors."""
BODY_COLUMNS, WRENCH_COLUMNS, TWIST_COLUMNS, MAGNET_COLUMNS, SURFACE_COLUMNS = 23, 10, 3, 2, 22
TURN_COLUMNS, WORLD_COLUMNS = 4, 5
MOTION_COLUMNS = 13
"""The last ones of a body: position, orientation, velocity and spin."""
_BUSY_THREADS = 262_144
"""With so many threads an H200 is busy; more environments need fewer threads each."""
_FREE_SLOTS = {(True, False): 8, (False, False): 4, (True, True): 2, (False, True): 1}
"""How many contacts fit into a thread's registers, by (single precision, with derivatives)."""

_LANGUAGE = """
#if HOST
#define INLINE inline
#define EACH_BODY
#define EACH_SLOT
#define EACH_PAIR
#define KEEP_LOOP
#else
#define INLINE __device__ __forceinline__
#define EACH_BODY _Pragma("unroll")
#define EACH_PAIR _Pragma("unroll 1")
#if UNROLLED
#define EACH_SLOT _Pragma("unroll")
#else
#define EACH_SLOT _Pragma("unroll 1")
#endif
#define KEEP_LOOP _Pragma("unroll 1")
#endif
"""


@dataclass(frozen=True)
class Structure:
    """The constants of a kernel.

    single: float32, else float64; dual: with a derivative in one direction; lanes: threads of an environment, a power
    of two up to 32; record: labels of contacts; effects: accelerations besides gravity; magnets: how many of them
    are the ground's pull; twisted: whether there is a constant angular one; turned: whether the frame of bodies that
    touch each other is not the world's; free (bodies,); drives (bodies,): number of the drive, -1 without; spheres
    (bodies,): how many; pairs: bodies that may touch, -1 for the ground, each with its number of contacts; lowest
    (bodies,): first row and number of the spheres whose heights count, where heights do; carried: whether each launch
    goes on where the one before ended; surface: effects of the contact of one body with the ground; elliptic: one of
    them is friction that depends on the direction.
    """

    single: bool
    dual: bool
    lanes: int
    record: bool
    effects: bool
    magnets: int
    twisted: bool
    turned: bool
    free: tuple[bool, ...]
    drives: tuple[int, ...]
    spheres: tuple[int, ...]
    pairs: tuple[tuple[int, int, int], ...]
    lowest: tuple[tuple[int, int], ...] = ()
    carried: bool = False
    surface: bool = False
    elliptic: bool = False

    @property
    def contacts(self) -> int:
        """How many contacts an environment may have."""
        return sum(count for _, _, count in self.pairs)

    @property
    def slots(self) -> int:
        """How many of them each thread takes."""
        return max(1, -(-self.contacts // self.lanes))

    @property
    def table_width(self) -> int:
        """Numbers of an environment."""
        world = WORLD_COLUMNS + self.turned * TURN_COLUMNS
        world += self.effects * WRENCH_COLUMNS + self.twisted * TWIST_COLUMNS + self.magnets * MAGNET_COLUMNS
        world += self.surface * SURFACE_COLUMNS
        return world + len(self.free) * BODY_COLUMNS

    @property
    def carried_width(self) -> int:
        """Numbers that each thread hands to the next launch: motions of the bodies, impulses, whether any acts."""
        return len(self.free) * MOTION_COLUMNS + 3 * self.slots + 1

    def source(self, host: bool = False) -> str:
        """Return the program; for the host, without the kernel's entry."""
        paired = len(self.free) > 1
        unrolled = self.slots <= _FREE_SLOTS[True, False]
        # the sums of labels take the registers of eight spheres
        held = unrolled and not paired and not (self.record and self.slots > _FREE_SLOTS[False, False])
        constants = {
            "HOST": host, "SINGLE": self.single, "DUAL": self.dual, "LANES": self.lanes, "SLOTS": self.slots,
            "RECORD": self.record, "EFFECTS": self.effects, "MAGNETS": self.magnets,
            "TWISTED": self.twisted, "SURFACE": self.surface, "ELLIPTIC": self.elliptic, "TURNED": self.turned,
            "BODIES": len(self.free), "PAIRS": len(self.pairs),
            "CONTACTS": self.contacts, "PAIRED": paired, "UNROLLED": unrolled, "HELD": held,
            "CARRIED": self.carried, "CARRIED_WIDTH": self.carried_width,
            "DRIVEN": any(number >= 0 for number in self.drives), "TABLE_WIDTH": self.table_width, "THREADS": THREADS,
        }  # fmt: skip
        lines = [f"#define {name} {int(value)}" for name, value in constants.items()]
        lines += [f"#define SMOOTHING_M {PAIR_SMOOTHING_M!r}", f"#define ONSET_M {CONTACT_ONSET_M!r}"]
        lines += [f"#define NEWTON_STEPS {NEWTON_STEPS}", f"#define FLATTEST {FLATTEST!r}"]
        lines += [f"#define LEAST_FRICTION {LEAST!r}", f"#define CLOSE {CLOSE!r}"]
        lists = {
            "is_free": self.free, "drive_number": self.drives, "sphere_count": self.spheres,
            "sphere_start": _starts(self.spheres), "pair_a": [a for a, _, _ in self.pairs],
            "pair_b": [b for _, b, _ in self.pairs], "contact_count": [count for _, _, count in self.pairs],
            "contact_start": _starts([count for _, _, count in self.pairs]),
            "low_start": [start for start, _ in self.lowest], "low_count": [count for _, count in self.lowest],
        }  # fmt: skip
        functions = [_function(name, values) for name, values in lists.items()]
        parts = (ARITHMETIC, SURFACE, CONTACTS, ENVIRONMENT, COLLISION, ROLLOUT)
        return "\n".join((*lines, _LANGUAGE, *functions, *parts))


def lanes_for(contacts: int, environments: int, single: bool, dual: bool, paired: bool) -> int:
    """Return how many threads should share an environment."""
    wanted = min(contacts, 32) if paired else min(contacts, _BUSY_THREADS // max(1, environments))
    wanted = max(wanted, -(-contacts // _FREE_SLOTS[single, dual]), 1)
    lanes = 1
    while lanes < min(wanted, 32):
        lanes *= 2
    return lanes


def _starts(counts: Sequence[int]) -> list[int]:
    return [sum(counts[:index]) for index in range(len(counts))]


def _function(name: str, values: Iterable[int]) -> str:
    """Return a list as a function, which the compiler resolves where the index is known."""
    cases = "".join(f"i == {index} ? {int(value)} : " for index, value in enumerate(values))
    return f"INLINE int {name}(int i) {{ return {cases}0; }}"
