"""Layout of chains for a fused kernel: their tree as constants, their numbers as columns, their commands as rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import torch
from torch import Tensor

from ...geometry.rotation import quat_rotate
from ...optimization.forward_mode import parts_of
from ..chains.chain import Chain
from ..chains.joint_command import JointCommand
from ..chains.state import joints_of
from ..state import State
from ..world import World

LINK_COLUMNS, JOINT_COLUMNS, COMMAND_WIDTH = 20, 9, 14
"""Columns of a link and of a moving joint, as `load_chain` in `kernels/chain.cuh` reads them, and numbers of a row of a
command: the time of its knot and five coefficients of two joints."""
_NUMBERS = ("lower", "upper", "stiffness", "damping", "armature", "friction", "torque_limit")
FREE_ROOT = 1
"""Kind of a free root, see `Tree.kinds`."""
_KINDS = {"hinge": 2, "slide": 3, "fixed": 4}
_SIZES = {"signed char": 1, "short": 2, "int": 4}
"""Types of the numbers of lists that a block of threads copies, and their sizes in bytes."""


@dataclass(frozen=True, kw_only=True)
class Tree:
    """Links of all chains of a world, one chain after another, parents before children."""

    bodies: tuple[int, ...] = ()
    """Index of the body of each link."""
    parents: tuple[int, ...] = ()
    """Link that carries it, -1 for a root."""
    kinds: tuple[int, ...] = ()
    """0: root that is fixed or driven, 1: free root, 2: hinge, 3: slide, 4: fixed joint."""
    dofs: tuple[int, ...] = ()
    """First coordinate of its own in the generalised velocity, -1 for none."""
    joints: tuple[int, ...] = ()
    """Moving joint of each link, -1 for none."""
    above: tuple[tuple[int, ...], ...] = ()
    """Coordinates that move each link, from the root on."""
    dof_links: tuple[int, ...] = ()
    """Link of each coordinate."""
    dof_above: tuple[tuple[int, ...], ...] = ()
    """Coordinates above each coordinate, from the root on, and itself."""
    joint_dofs: tuple[int, ...] = ()
    """Coordinate of each moving joint."""
    roots: tuple[int, ...] = ()
    """Root link of each chain."""
    firsts: tuple[int, ...] = ()
    """First moving joint of each chain."""
    counts: tuple[int, ...] = ()
    """Number of moving joints of each chain."""
    commands: tuple[int, ...] = ()
    """Number of the command of each chain's joints among all commands, -1 for none."""
    light: tuple[int, ...] = ()
    """1 for links without mass that are fixed to another one and carry only such links, else 0."""
    heavy: bool = False
    """Whether any link that moves has a mass."""

    @property
    def depth(self) -> int:
        """Largest number of coordinates that move a link."""
        return max((len(row) for row in self.above), default=0)

    @property
    def columns(self) -> int:
        """Number of pairs of a link and a coordinate that moves it."""
        return sum(map(len, self.above))

    @property
    def table_width(self) -> int:
        """Number of columns."""
        return LINK_COLUMNS * len(self.bodies) + JOINT_COLUMNS * len(self.joint_dofs)

    @property
    def levels(self) -> int:
        """Number of links from a root to the farthest leaf."""
        return 1 + max((self._level(link) for link in range(len(self.bodies))), default=0)

    @property
    def branches(self) -> list[list[int]]:
        """Moving joints by branch: those of two branches have no coordinate above them in common."""
        found: dict[int, list[int]] = {}
        for joint, dof in enumerate(self.joint_dofs):
            found.setdefault(self.dof_above[dof][0], []).append(joint)
        return list(found.values())

    @property
    def serial(self) -> bool:
        """Whether each branch is one joint after the other, all of them at one coordinate each."""
        return all(
            self.dof_above[self.joint_dofs[joint]] == tuple(self.joint_dofs[each] for each in branch[: place + 1])
            for branch in self.branches
            for place, joint in enumerate(branch)
        )

    def groups(self, free: Sequence[bool]) -> list[int]:
        """Return for each body the one under which its contacts count, -1 where it cannot move.

        A link counts under the first link that moves on the way from the root to it.
        """
        found = [index if moves else -1 for index, moves in enumerate(free)]
        for link, body in enumerate(self.bodies):
            if self.above[link]:
                found[body] = self.bodies[self.dof_links[self.above[link][0]]]
        return found

    def _root(self, link: int) -> int:
        return link if self.parents[link] < 0 else self._root(self.parents[link])

    def _level(self, link: int) -> int:
        return 0 if self.parents[link] < 0 else 1 + self._level(self.parents[link])

    def _rows(self) -> dict[str, tuple[str, list[list[int]]]]:
        """Return rows of numbers by the name of the list of their starts, each with the name of the list of them all.

        Links by level, heavy children of each link from last to first, coordinates by the number of those above them,
        coordinates below each one, moving joints by branch, each link once for each coordinate that moves it, and links
        by these coordinates.
        """
        links, dofs = range(len(self.bodies)), range(len(self.dof_links))
        levels = [[k for k in links if self._level(k) == level] for level in range(self.levels)]
        heavy = [k for k in reversed(links) if not self.light[k]]
        children = [[k for k in heavy if self.parents[k] == link] for link in links]
        ranks = [[k for k in dofs if len(self.dof_above[k]) == rank + 1] for rank in range(self.depth)]
        below = [[k for k in dofs if k != dof and dof in self.dof_above[k]] for dof in dofs]
        return {
            "level_start": ("level_link", levels), "child_start": ("link_child", children),
            "rank_start": ("rank_dof", ranks), "below_start": ("dof_below", below),
            "branch_start": ("branch_joint", self.branches),
            "column_start": ("column_link", [[link] * len(self.above[link]) for link in links]),
            "moved_start": ("moved_link", [[k for k in links if dof in self.above[k]] for dof in dofs]),
        }  # fmt: skip

    @cached_property
    def lists(self) -> dict[str, Sequence[int]]:
        """The lists of constants by name; none without links."""
        if not self.bodies:
            return {}
        depth = self.depth
        padded = {
            name: [k for row in rows for k in (*row, *[0] * (depth - len(row)))]
            for name, rows in (("link_above", self.above), ("dof_above", self.dof_above))
        }
        lists: dict[str, Sequence[int]] = {
            "link_body": self.bodies, "link_parent": self.parents, "link_kind": self.kinds, "link_dof": self.dofs,
            "link_joint": self.joints, "link_depth": [len(row) for row in self.above],
            "link_root": [self._root(link) for link in range(len(self.bodies))], "dof_link": self.dof_links,
            "link_light": self.light, "dof_joint": [self.joints[link] for link in self.dof_links],
            "dof_depth": [len(row) for row in self.dof_above], "joint_dof": self.joint_dofs, "chain_root": self.roots,
            "chain_joint": self.firsts, "chain_joints": self.counts, "chain_command": self.commands, **padded,
            "link_chain": [self.roots.index(self._root(link)) for link in range(len(self.bodies))],
            "joint_chain": [chain for chain, count in enumerate(self.counts) for _ in range(count)],
        }  # fmt: skip
        for start, (name, rows) in self._rows().items():
            lists[start] = [0, *accumulate(map(len, rows))]
            lists[name] = [number for row in rows for number in row]
        return lists


def tree_of(world: World, drives: int, commanded: Sequence[int]) -> Tree:
    """Return the tree of a world's chains.

    Args:
        world: The world.
        drives: Number of commands before those of the joints.
        commanded: Numbers of the chains whose joints have a command.
    """
    rows: dict[str, list] = {name: [] for name in Tree.__dataclass_fields__ if name not in ("light", "heavy")}
    for number, chain in enumerate(world.chains):
        _append(rows, world, chain)
        rows["commands"].append(drives + list(commanded).index(number) if number in commanded else -1)
    masses = [_matters(world.bodies[body].mass) for body in rows["bodies"]]
    heavy = any(mass for mass, above in zip(masses, rows["above"], strict=True) if above)
    light = [
        int(kind == _KINDS["fixed"] and not mass and not _matters(world.bodies[body].inertia))
        for kind, mass, body in zip(rows["kinds"], masses, rows["bodies"], strict=True)
    ]
    for link, parent in reversed([*enumerate(rows["parents"])]):
        if parent >= 0:
            light[parent] *= light[link]
    return Tree(**{name: tuple(values) for name, values in rows.items()}, light=tuple(light), heavy=heavy)


def _matters(value: Tensor) -> bool:
    """Return whether a number is not 0, or has a derivative."""
    primal, tangent = parts_of(value)
    return tangent is not None or bool((primal != 0).any())


def _append(rows: dict[str, list], world: World, chain: Chain) -> None:
    """Append the links of a chain to the lists of a tree."""
    offset = len(rows["bodies"])
    rows["roots"].append(offset)
    rows["firsts"].append(len(rows["joint_dofs"]))
    rows["counts"].append(len(chain.moving))
    names = world.body_names
    for place, (name, parent) in enumerate(zip(chain.links, chain.parents, strict=True)):
        link, first = offset + place, len(rows["dof_links"])
        joint = None if parent < 0 else chain.joints[place - 1]
        kind = int(chain.base == "free") if joint is None else _KINDS[joint.kind]
        before = rows["above"][offset + parent] if parent >= 0 else ()
        own = 6 if kind == FREE_ROOT else int(kind in (2, 3))
        rows["bodies"].append(names.index(name))
        rows["parents"].append(offset + parent if parent >= 0 else -1)
        rows["kinds"].append(kind)
        rows["dofs"].append(first if own else -1)
        rows["joints"].append(len(rows["joint_dofs"]) if kind in (2, 3) else -1)
        rows["above"].append((*before, *range(first, first + own)))
        rows["dof_links"] += [link] * own
        rows["dof_above"] += [(*before, *range(first, dof + 1)) for dof in range(first, first + own)]
        if kind in (2, 3):
            rows["joint_dofs"].append(first)


def columns(world: World, state: State) -> list[Tensor]:
    """Return the columns of the chains: those of all links, then those of all moving joints."""
    joints = []
    for chain, (_, numbers) in zip(world.chains, world.once(_fixed_columns), strict=True):
        values, speeds = joints_of(world, state, chain)
        batch = max(len(numbers), len(values))
        parts = (numbers.expand(batch, -1, -1), *(x.expand(batch, -1)[..., None] for x in (values, speeds)))
        joints.append(torch.cat(parts, -1).flatten(1))
    return [*(links for links, _ in world.once(_fixed_columns)), *joints]


def _fixed_columns(world: World) -> list[tuple[Tensor, Tensor]]:
    """Return by chain the columns of its links (1 or B, columns), and its joints' numbers (1 or B, joints, 7)."""
    return [(_link_columns(world, chain), _joint_numbers(chain)) for chain in world.chains]


def _link_columns(world: World, chain: Chain) -> Tensor:
    names = world.body_names
    bodies = [world.bodies[names.index(name)] for name in chain.links]
    like = bodies[0].mass
    upright, still = like.new_tensor([[1.0, 0.0, 0.0, 0.0]]), like.new_zeros(1, 3)
    places = [(still, upright, still), *((joint.position, joint.quat_wxyz, joint.axis) for joint in chain.joints)]
    parts = []
    for body, place in zip(bodies, places, strict=True):
        inertia = body.inertia.flatten(1)[:, (0, 4, 8, 1, 2, 5)]
        parts += [*place, body.mass[:, None], inertia, body.com]
    batch = max(map(len, parts))
    return torch.cat([part.expand(batch, -1) for part in parts], -1)


def _joint_numbers(chain: Chain) -> Tensor:
    if not chain.moving:
        return chain.joints[0].lower.new_zeros(1, 0, len(_NUMBERS))
    columns = [chain.numbers(name) for name in _NUMBERS]
    batch = max(map(len, columns))
    return torch.stack([column.expand(batch, -1) for column in columns], -1)


def free_roots(world: World) -> list[int]:
    """Return the indices of the links that move freely, at the root of a chain."""
    return [world.body_names.index(chain.root) for chain in world.chains if chain.base == "free"]


def root_motion(index: int, state: State) -> tuple[Tensor, Tensor]:
    """Return velocity and angular velocity (B, 3) of a free root at the start, world frame."""
    omega = quat_rotate(state.quat_wxyz[:, index], state.omega_body_rad_s[:, index])
    return state.velocity_m_s[:, index], omega


def command_rows(world: World, driven: Mapping[str, object], like: Tensor) -> dict[int, tuple[Tensor, Tensor]]:
    """Return by chain the rows (1 or B, knots * ceil(joints / 2), 14) of its command, and the last piece's index."""
    found = {}
    for number, chain in enumerate(world.chains):
        command = JointCommand.of(chain, driven, like)
        if command is not None:
            found[number] = _rows(command)
    return found


def _rows(command: JointCommand) -> tuple[Tensor, Tensor]:
    times, pieces = command.times_s, command.coefficients
    batch, knots, joints = max(times.shape[0], pieces.shape[0]), times.shape[1], pieces.shape[2]
    pieces = pieces.expand(batch, -1, -1, -1)
    if joints % 2:
        pieces = torch.cat((pieces, torch.zeros_like(pieces[:, :, :1])), 2)
    pairs = pieces.unflatten(2, (-1, 2)).flatten(3)
    time = times.expand(batch, -1)[:, :, None, None].expand(-1, -1, pairs.shape[2], 1)
    padding = torch.zeros_like(pairs[..., : COMMAND_WIDTH - 1 - pairs.shape[-1]])
    rows = torch.cat((time, pairs, padding), -1).flatten(1, 2)
    return rows, torch.full((1,), knots - 1, device=times.device)


def lists_bytes(lists: Mapping[str, Sequence[int]]) -> int:
    """Return the size of the copies of lists in the memory of a block, up to 3 bytes for the start of each."""
    return sum(_SIZES[_kind(values)] * max(1, len(values)) + 3 for values in lists.values())


def listed(lists: Mapping[str, Sequence[int]]) -> list[str]:
    """Return the source of lists of constants by name."""
    return [_list_source("int", name, values) for name, values in lists.items()]


def listed_copies(lists: Mapping[str, Sequence[int]]) -> list[str]:
    """Return the source of lists whose names are those of copies in the memory of a block, made by `copy_lists`.

    On a GPU, where a place of one list gives that of the next one, the memory of a block answers sooner.
    """
    found = [_list_source(_kind(values), f"{name}_list", values) for name, values in lists.items()]
    found += [f"__shared__ static {_kind(values)} {name}[{max(1, len(values))}];" for name, values in lists.items()]
    copies = [
        f"    KEEP_LOOP for (int i = threadIdx.x; i < {len(values)}; i += THREADS) {name}[i] = {name}_list[i];"
        for name, values in lists.items()
    ]
    return [*found, "INLINE void copy_lists() {", *copies, "    __syncthreads();", "}"]


def _list_source(kind: str, name: str, values: Sequence[int]) -> str:
    return f"__device__ static const {kind} {name}[] = {{{', '.join(str(int(value)) for value in values or [0])}}};"


def _kind(values: Sequence[int]) -> str:
    """Return the smallest type that has room for numbers."""
    most = max((max(value, -1 - value) for value in map(int, values)), default=0)
    return "signed char" if most < 1 << 7 else "short" if most < 1 << 15 else "int"
