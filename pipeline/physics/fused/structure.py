"""Compile-time constants of a fused kernel, and its composed source."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product

from ...runtime import kernel_build
from ..chains.joint_rows import LIMIT_TIME_S
from ..contact_detection import FAR_M, PAIR_SMOOTHING_M
from ..edge_contact import FACE_SLACK_M, LEAST_CROSSING, OUT_OF_FACE
from ..friction_ellipse import CLOSE, FLATTEST, LEAST, NEWTON_STEPS
from ..hull import MOST_PLANES, OVERHANG_M, PARALLEL, SAME_NORMAL, SAME_PLANE_M
from ..impulse_solver import CONTACT_ONSET_M, IMMOVABLE, LEAST_ACROSS, LEAST_MOBILITY
from ..surfaces.fixed_surface import BOX, HALF_SPACE, MESH
from ..surfaces.surface_mesh import FLAT, MESH_CONTACTS, ORDER
from .tree import COMMAND_WIDTH, FREE_ROOT, JOINT_COLUMNS, LINK_COLUMNS, Tree, listed, listed_copies, lists_bytes

WARP = 32
THREADS = WARP
"""Threads of a block: one warp, so that few environments still spread over all multiprocessors."""
GATHERED_THREADS = 256
"""Threads of a block that simulates one environment in which hulls of links may touch."""
CROWDS = (256, 128, 64)
"""Largest numbers of contacts at once for which such a block has room; the first that fits into its memory."""
BODY_COLUMNS, WRENCH_COLUMNS, TWIST_COLUMNS, LIFT_COLUMNS, MAGNET_COLUMNS, SURFACE_COLUMNS = 23, 10, 3, 3, 2, 22
TURN_COLUMNS, WORLD_COLUMNS, PUBLISHED_COLUMNS = 4, 5, 5
"""Columns of the table of environments, by subject, as `load` in `kernels/environment.cuh` reads them; each further
contact law adds one to those of the world."""
MOTION_COLUMNS = 13
"""Last columns of a body: position, orientation, velocity and spin."""
FRAME_WIDTH, LABEL_WIDTH, SURFACE_WIDTH = 16, 12, 10
"""Numbers of a body in a frame, of a contact in a label, and of a fixed surface."""
SHARED_BYTES = 48 * 1024
"""Shared memory that a block of any CUDA device may have without asking for more."""
_MOST_WIDE = 32
"""Maximum number of contacts of a body of which several are simulated in one vector: they lie in the cache."""
_LONG_LIST = 8
"""Number of constants from which a list is an array in memory, and not a chain of comparisons."""
_BUSY_THREADS = 262_144
"""Number of threads that fill an H200; more environments get fewer threads each."""
_BUSY_CHAINED, _MOST_SPARSE = 16_384, 8
"""The same where links move, and the most threads that an environment has with more than these: measured on an H100,
where 4,096 hands are the fastest with 8 threads each, and 128 hands with 32.
"""
_FREE_SLOTS = {(True, False): 8, (False, False): 4, (True, True): 2, (False, True): 1}
"""Number of contacts that fit into the registers of a thread, by (single precision, with derivatives)."""

_NUMBERS: dict[str, float] = {
    "SMOOTHING_M": PAIR_SMOOTHING_M,
    "SAME_PLANE_M": SAME_PLANE_M,
    "SAME_NORMAL": SAME_NORMAL,
    "OVERHANG_M": OVERHANG_M,
    "LEAST_CROSSING": LEAST_CROSSING,
    "OUT_OF_FACE": OUT_OF_FACE,
    "FACE_SLACK_M": FACE_SLACK_M,
    "PARALLEL": PARALLEL,
    "MOST_PLANES": MOST_PLANES,
    "ONSET_M": CONTACT_ONSET_M,
    "LEAST_MOBILITY": LEAST_MOBILITY,
    "IMMOVABLE": IMMOVABLE,
    "LEAST_ACROSS": LEAST_ACROSS,
    "NEWTON_STEPS": NEWTON_STEPS,
    "FLATTEST": FLATTEST,
    **{f"ORDER_{axis}": value for axis, value in zip("XYZ", ORDER, strict=True)},
    "FLAT_SINE": FLAT,
    "FAR_M": FAR_M,
    "LEAST_FRICTION": LEAST,
    "CLOSE": CLOSE,
    "LIMIT_TIME_S": LIMIT_TIME_S,
}
"""Numbers of the contact engine that the kernels share with torch."""

_WIDTHS = {
    "BODY_COLUMNS": BODY_COLUMNS, "MOTION_COLUMNS": MOTION_COLUMNS, "LINK_COLUMNS": LINK_COLUMNS,
    "JOINT_COLUMNS": JOINT_COLUMNS, "PUBLISHED_COLUMNS": PUBLISHED_COLUMNS, "SAMPLE_WIDTH": COMMAND_WIDTH,
    "FRAME_WIDTH": FRAME_WIDTH, "LABEL_WIDTH": LABEL_WIDTH, "SURFACE_WIDTH": SURFACE_WIDTH,
}  # fmt: skip
"""Numbers of a row of the kernels' arrays: of 64 bits there, as products with them may need."""

_FILES = (
    "wide",  # numbers of several environments at once, on a CPU
    "arithmetic",  # numbers, vectors and rotations, and exchanges between the threads of an environment
    "surface",  # effects of the contact between one body and the ground
    "contact",  # what a contact of a step is
    "parting",  # what is known of two hulls
    "chain",  # links of chains and their joints, as read from the table
    "contact_law",  # what one contact asks for, and the change of its impulse in an iteration
    "sphere_union",  # distance from the spheres of a body
    "hull",  # distance from their hull
    "contact_shares",  # the effective mass of each contact of a pair
    "environment",  # what the kernel is given, and the state of an environment read from it
    "fixed_surface",  # distances of spheres to fixed surfaces
    "chain_motion",  # kinematics, equations of motion and joints of chains
    "flight",  # bodies without contact
    "facing",  # gap, normal and point of each possible contact of two bodies
    "meeting",  # which bodies may touch in a step
    "queue",  # contacts that lanes share out among each other
    "touching",  # the contacts of a pair
    "sweeps",  # iterations over impulses
    "collision",  # all contacts of a step
    "gathered",  # contacts of an environment that a block of threads simulates
    "published",  # all contacts of a step by the paper's law
    "rollout",  # an environment from its first frame to its last, and what is written of it
)
"""Files of `kernels/` in the order in which they are compiled, after `language`; each names its formulas' origin."""


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Compile-time constants of a kernel, from which its source is composed."""

    single: bool
    """Whether to compute in float32; else float64."""
    dual: bool
    """Whether to compute a derivative in one direction."""
    lanes: int
    """Threads per environment, a power of two up to 32."""
    record: bool
    """Whether to write contact labels."""
    effects: bool
    """Whether there are accelerations in addition to gravity."""
    magnets: int
    """Number of attractions by the ground."""
    twisted: bool
    """Whether a constant angular acceleration acts."""
    lifted: bool
    """Whether the lift of a spin that was not measured acts."""
    turned: bool
    """Whether the frame of bodies that touch each other differs from the world frame."""
    free: tuple[bool, ...]
    """Whether each body moves freely, shape (bodies,)."""
    drives: tuple[int, ...]
    """Number of each body's command, -1 without, shape (bodies,)."""
    spheres: tuple[int, ...]
    """Number of spheres of each body, shape (bodies,)."""
    pairs: tuple[tuple[int, int, int], ...]
    """Pairs of bodies that may touch, -1 for the ground, each with its number of contacts."""
    laws: tuple[int, ...] = ()
    """Number of the contact law of each pair; empty where all have the same one."""
    hulls: tuple[tuple[int, int, int, int, int], ...] = ()
    """First row in the geometry of each body's hull, and its numbers of faces, edges, supports and edges between
    different planes; none where the body's spheres are touched."""
    areas: tuple[int, ...] = ()
    """First row in the geometry of the areas of each pair's contacts, -1 where all count alike; empty for no areas."""
    lowest: tuple[tuple[int, int], ...] = ()
    """First row and number of each body's spheres whose heights count; empty where heights do not."""
    surfaces: tuple[int, ...] = ()
    """Kind of each fixed surface, as in `fixed_surface.KINDS`."""
    mesh_starts: tuple[tuple[int, int], ...] = ()
    """First number and first index of each surface's mesh; of those that are none, of no meaning."""
    carried: bool = False
    """Whether each launch continues where the previous one ended."""
    surface: bool = False
    """Whether effects act on the contact of one body with the ground."""
    elliptic: bool = False
    """Whether friction depends on the direction."""
    published: int = 0
    """Number of rows of a contact's friction pyramid by the paper's law; 0 for ours."""
    tree: Tree | None = None
    """Links of chains; None for none."""
    crowd: int = 0
    """Number of contacts at once for which there is room, where they are `gathered`."""

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Hash of all fields: kernels are found by their structures in each launch."""
        return hash(tuple(getattr(self, name) for name in self.__dataclass_fields__))

    @cached_property
    def contacts(self) -> int:
        """Number of contacts that an environment may have."""
        return sum(count for _, _, count in self.pairs)

    @property
    def paired(self) -> bool:
        """Whether contacts have normals of their own, not only that of the ground."""
        return len(self.free) > 1 or bool(self.surfaces)

    @property
    def law_count(self) -> int:
        """Number of contact laws."""
        return max(self.laws, default=0) + 1

    @property
    def shared(self) -> bool:
        """Whether the threads of an environment share one copy of what they have in common, and divide the work on it.

        Where links move, most of a step is such work; the state of one body alone fits into the registers of each.
        """
        return self.tree is not None and self.lanes > 1

    @property
    def gathered(self) -> bool:
        """Whether a block of threads simulates one environment, with all of its contacts in one list.

        Hulls take long to compare, and links have many: the threads of one warp would do this one pair after another.
        """
        return self.shared and self.hulled

    @property
    def threads(self) -> int:
        """Number of threads of a block."""
        return self.lanes if self.gathered else THREADS

    @property
    def shared_bytes(self) -> int:
        """Bound on the size of the copy that the threads of an environment share, `Environment` in `kernels`."""
        tree, bodies, free, pairs = self.tree or Tree(), len(self.free), max(1, sum(self.free)), max(1, len(self.pairs))
        links, joints, dofs, roots = len(tree.bodies), len(tree.joint_dofs) + 1, len(tree.dof_above), len(tree.roots)
        size = (4 if self.single else 8) * (2 if self.dual else 1)
        place, mass = 13 * links, tree.heavy * (16 * links + 2 * dofs + joints)
        kick = mass + max(place, 12 * tree.heavy * links) + 12 * roots + 4 * dofs + joints
        shown = max(12 * (links + free), (28 + (self.law_count > 1)) * self.lanes)
        collide = 6 * tree.columns + shown + 11 * self.lanes + 8 + 2 * pairs
        marks = 2 * pairs + 4 * (bodies + links + free + 4 * self.lanes) + 16
        lasting = 40 + 5 * self.law_count + 41 * bodies + 23 * free + 3 * links + 10 * joints + dofs * (2 + tree.depth)
        flags = links + 2 * joints + 4 * roots + 4 * bodies + 128
        if self.gathered:
            numbers, lasts, more = self._gathered_bytes(links + free)
            collide = 6 * tree.columns + 8 + -(-numbers // size)
            lasting, flags = lasting + -(-lasts // size), flags + more
            marks = 0
        return size * (lasting + max(kick, collide, place + dofs)) + marks + flags

    def _gathered_bytes(self, moved: int) -> tuple[int, int, int]:
        """Return the bytes that contacts take where they are gathered: in a step, for the next step, and beside these.

        Args:
            moved: Number of links and of free bodies.
        """
        number = 4 if self.single else 8
        size, pairs = number * (2 if self.dual else 1), max(1, len(self.pairs))
        contact = size * (16 + (self.law_count > 1)) + 16
        parting = 16 + 4 * number + 12 * size + 2 * 132 + 32 * (14 * size + 4 * number + 16)
        shown = max(self.lanes // WARP * parting, 10 * size * self.crowd)
        listed = self.crowd * (contact + size + 4 + 4 + (size if self.areas else 0)) + shown
        bodies = moved * (12 * size + 8) + 4 * len(self.free)
        return listed + bodies + (2 * number + 4) * pairs, 3 * number * pairs + self.crowd * (4 + 3 * size), 64

    @property
    def block_bytes(self) -> int:
        """Bound on the shared memory of a block of threads."""
        return self.shared_bytes * (self.threads // self.lanes) + lists_bytes(self._copied_lists()) + 64

    def launched(self, dual: bool, lanes: int, room: int) -> Structure:
        """Return `on_lanes(lanes, room)` with or without derivatives, made at the first call and kept."""
        kept: dict[tuple[bool, int, int], Structure] = self.__dict__.setdefault("_launched", {})
        found = kept.get((dual, lanes, room))
        if found is None:
            found = kept[dual, lanes, room] = replace(self, dual=dual).on_lanes(lanes, room)
        return found

    def on_lanes(self, lanes: int, room: int = SHARED_BYTES) -> Structure:
        """Return the structure for a number of threads per environment, or for those that shared memory has room for.

        Fewer environments share a block where their copies are large; where not even one fits, each environment has
        one thread, whose copy is in its own memory.

        Args:
            lanes: Threads per environment; where hulls of links may touch, more than one are whole warps.
            room: Memory that a block may have where it asks for it [bytes].
        """
        wanted = replace(self, lanes=lanes)
        if wanted.gathered:
            wide = max(lanes, WARP)
            for crowd, each in product(CROWDS, (wide, *(fewer for fewer in (128, 64, WARP) if fewer < wide))):
                found = replace(self, lanes=each, crowd=max(1, min(crowd, self.contacts)))  # no array is empty
                if _block_bytes(found) <= room:
                    return found
            return self.on_lanes(1)
        if not wanted.shared or _block_bytes(wanted) <= SHARED_BYTES:
            return wanted
        return self.on_lanes(2 * lanes if lanes < THREADS else 1)

    @property
    def contact_bytes(self) -> int:
        """Least size of a thread's list of contacts: of each an arm, an impulse and three numbers, of pairs more."""
        return (16 if self.paired else 9) * (4 if self.single else 8) * self.slots

    @property
    def slots(self) -> int:
        """Number of contacts per thread."""
        return max(1, -(-self.contacts // self.lanes))

    @property
    def table_width(self) -> int:
        """Number of columns of the table of environments."""
        world = WORLD_COLUMNS + self.law_count - 1 + self.turned * TURN_COLUMNS
        world += self.effects * WRENCH_COLUMNS + self.twisted * TWIST_COLUMNS + self.magnets * MAGNET_COLUMNS
        world += self.lifted * LIFT_COLUMNS
        world += self.surface * SURFACE_COLUMNS + bool(self.published) * PUBLISHED_COLUMNS
        if self.tree is not None:
            world += self.tree.table_width
        return world + len(self.free) * BODY_COLUMNS

    @property
    def carried_width(self) -> int:
        """Number of values that each thread keeps for the next launch, see `resume` in `kernels/environment.cuh`."""
        joints = 0 if self.tree is None else len(self.tree.joint_dofs)
        impulses = 4 * self.crowd if self.gathered else 3 * self.slots
        return 1 + len(self.free) * MOTION_COLUMNS + impulses + 1 + 5 * joints

    @property
    def carried_rows(self) -> int:
        """Number of rows of these values of an environment."""
        return 1 if self.gathered else self.lanes

    @property
    def _unrolled(self) -> bool:
        """Whether loops over the contacts of a thread are unrolled."""
        return self.slots <= _FREE_SLOTS[True, False]

    @property
    def _fits_registers(self) -> bool:
        """Whether a thread keeps its spheres in registers; the sums of labels take those of eight spheres."""
        return self._unrolled and not (self.record and self.slots > _FREE_SLOTS[False, False])

    @property
    def hulled(self) -> bool:
        """Whether hulls of bodies may touch each other or a surface."""
        return self.paired and any(faces for _, faces, *_ in self.hulls)

    @property
    def widens(self) -> bool:
        """Whether a CPU can simulate several environments in one vector: one free body above the ground, no records."""
        alone = self.free == (True,) and not self.paired and self.tree is None and set(self.drives) == {-1}
        plain = not (self.single or self.dual or self.record or self.carried or self.areas or self.turned)
        few = self.contacts <= _MOST_WIDE or bool(self.published)  # the paper's law keeps no list of contacts
        return alone and plain and self.lanes == 1 and few

    def source(self, host: bool = False, wide: int = 0) -> str:
        """Return the source: constants, then the files of `kernels/`; for the host without the kernel entry.

        Args:
            host: Whether for the host.
            wide: Environments in a vector, where the structure `widens`; 0 for one after another.
        """
        tree = self.tree or Tree()
        constants = {"WIDE": wide} | self._flags(host) | _tree_flags(tree)
        flags = [f"#define {name} {int(value)}" for name, value in constants.items()]
        numbers = [f"#define {name} {value!r}" for name, value in _NUMBERS.items()]
        if self.shared and not host:
            lists = listed_copies(self._copied_lists())
        else:
            lists = listed(tree.lists | self._long_lists())
        functions = [_function(name, values) for name, values in self._called_lists().items()]
        functions += _facets(self.published)
        numbers += [f"#define {name} {value}LL" for name, value in _WIDTHS.items()]
        texts = (kernel_file("language"), *lists, *functions, *map(kernel_file, _FILES))
        return "\n".join((*flags, *numbers, *texts))

    def _called_lists(self) -> dict[str, list[int]]:
        """Return the lists that functions look up, by name."""
        lists = self._lists() | self._tree_lists(self.tree or Tree())
        return {name: [int(value) for value in values] for name, values in lists.items()}

    def _long_lists(self) -> dict[str, list[int]]:
        """Return those of them that are arrays in memory, by the name of the array."""
        return {f"{name}_of": values for name, values in self._called_lists().items() if len(values) > _LONG_LIST}

    def _copied_lists(self) -> dict[str, Sequence[int]]:
        """Return the lists of which each block of threads has a copy, by name."""
        return (self.tree or Tree()).lists | self._long_lists()

    def _flags(self, host: bool) -> dict[str, int]:
        """Return the constants by name, those of chains aside."""
        paired = self.paired
        alone = host and self.lanes == 1  # one thread of a CPU, whose arrays lie in its cache
        hulls = self.hulled
        held = not paired and not self.published and (alone or self._fits_registers)
        queued = self.shared and not hulls
        gathered = self.gathered
        # contacts with ground and surfaces may be two more of a pair than the even share of a lane
        list_room = self.slots + queued * (1 + 2 * sum(b < 0 for _, b, _ in self.pairs))
        return {
            "HOST": host, "SHARED": self.shared, "SHARED_BYTES": self.shared_bytes, "SINGLE": self.single,
            "DUAL": self.dual, "LANES": self.lanes, "SLOTS": self.slots,
            "RECORD": self.record, "EFFECTS": self.effects, "MAGNETS": self.magnets,
            "TWISTED": self.twisted, "LIFTED": self.lifted, "SURFACE": self.surface, "ELLIPTIC": self.elliptic,
            "TURNED": self.turned, "PUBLISHED": self.published,
            "BODIES": len(self.free), "FREES": max(1, sum(self.free)) if self.shared else len(self.free),
            "PAIRS": len(self.pairs), "FIXED": len(self.surfaces),
            "MESHES": self.surfaces.count(MESH), "MESH_CONTACTS": MESH_CONTACTS,
            "HALF_SPACE_KIND": HALF_SPACE, "BOX_KIND": BOX, "MESH_KIND": MESH,
            "CONTACTS": self.contacts, "PAIRED": paired, "UNROLLED": self._unrolled, "HELD": held,
            "LISTED": paired or alone, "CULLED": alone, "LAWS": self.law_count, "STEP_WIDTH": 2 + 2 * self.law_count,
            "HULLS": hulls, "QUEUED": queued, "LIST_ROOM": list_room,
            "GATHERED": gathered, "CROWD": self.crowd, "WARP": WARP,
            "PATCHES": bool(self.areas),
            "CARRIED": self.carried, "CARRIED_WIDTH": self.carried_width,
            "DRIVEN": any(number >= 0 for number in self.drives), "TABLE_WIDTH": self.table_width,
            "THREADS": self.threads,
        }  # fmt: skip

    def _lists(self) -> dict[str, Iterable[int]]:
        """Return the lists by name."""
        lists: dict[str, Iterable[int]] = {
            "is_free": self.free, "free_number": [sum(self.free[:index]) for index in range(len(self.free))],
            "free_body": [index for index, moves in enumerate(self.free) if moves] or [0],
            "drive_number": self.drives, "sphere_count": self.spheres,
            "sphere_start": _starts(self.spheres), "pair_a": [a for a, _, _ in self.pairs],
            "pair_b": [b for _, b, _ in self.pairs], "contact_count": [count for _, _, count in self.pairs],
            "contact_start": _starts([count for _, _, count in self.pairs]),
            "pair_law": self.laws, "area_start": self.areas,
            "surface_kind": self.surfaces, "mesh_number_start": [start for start, _ in self.mesh_starts],
            "mesh_index_start": [start for _, start in self.mesh_starts],
            "low_start": [start for start, _ in self.lowest], "low_count": [count for _, count in self.lowest],
        }  # fmt: skip
        for index, name in enumerate(("hull_start", "face_count", "edge_count", "support_count", "ridge_count")):
            lists[name] = [hull[index] for hull in self.hulls]
        return lists

    def _tree_lists(self, tree: Tree) -> dict[str, Iterable[int]]:
        """Return the lists of chains that have one entry for each body."""
        links = [tree.bodies.index(body) if body in tree.bodies else -1 for body in range(len(self.free))]
        return {"group_of": tree.groups(self.free), "body_link": links}


def _tree_flags(tree: Tree) -> dict[str, int]:
    """Return the constants of chains by name."""
    return {
        "LINKS": len(tree.bodies), "JOINTS": len(tree.joint_dofs), "DOFS": len(tree.dof_above),
        "CHAINS": len(tree.roots), "DEPTH": tree.depth, "HEAVY": tree.heavy, "LEVELS": tree.levels,
        "BRANCH_COUNT": len(tree.branches), "SERIAL": tree.serial, "COLUMNS": tree.columns,
        "FIRST_MOVED": int(bool(tree.kinds) and tree.kinds[0] != FREE_ROOT),
    }  # fmt: skip


@cache
def _block_bytes(structure: Structure) -> int:
    return structure.block_bytes


def kernel_file(name: str) -> str:
    """Return the text of a file of `kernels/` after an empty line."""
    return "\n" + kernel_build.source_file(__name__, f"kernels/{name}.cuh")


def lanes_for(
    contacts: int, environments: int, single: bool, dual: bool, paired: bool, links: int = 0, hulled: bool = False
) -> int:
    """Return the number of threads that should share an environment, a power of two up to 32, or a block of them."""
    if links > 0 and hulled:
        return GATHERED_THREADS
    if links > 0:
        # half of the links at once: fewer threads would do them one after another
        wanted = max(min(links // 2, _MOST_SPARSE), min(contacts, _BUSY_CHAINED // max(1, environments)))
    else:
        wanted = min(contacts, 32) if paired else min(contacts, _BUSY_THREADS // max(1, environments))
        wanted = max(wanted, -(-contacts // _FREE_SLOTS[single, dual]))
    lanes = 1
    while lanes < min(wanted, 32):
        lanes *= 2
    return lanes


def _starts(counts: Sequence[int]) -> list[int]:
    return [sum(counts[:index]) for index in range(len(counts))]


def _facets(count: int) -> list[str]:
    """Return the source of the directions of the rows of a friction pyramid, along both tangents."""
    turns = [2 * math.pi * row / count for row in range(count)]
    axes = {"facet_x": map(math.cos, turns), "facet_y": map(math.sin, turns)}
    return [f"INLINE double {name}(int i) {{ return {_cases(values)}0; }}" for name, values in axes.items()]


def _cases(values: Iterable[float]) -> str:
    return "".join(f"i == {index} ? {value!r} : " for index, value in enumerate(values))


def _function(name: str, values: Sequence[int]) -> str:
    """Return the source of a function that looks up a list, which the compiler resolves for a known index."""
    if len(values) > _LONG_LIST:
        return f"INLINE int {name}(int i) {{ return {name}_of[i]; }}"
    return f"INLINE int {name}(int i) {{ return {_cases(map(int, values))}0; }}"
