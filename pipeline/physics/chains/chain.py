"""Jointed bodies: links in a tree, joined by hinges, slides and fixed joints, with servos, limits and friction.

A link is a body of the world whose motion is "link"; its pose follows from the pose of the chain's base and the values
of the joints. The joints' values are in the state through the poses of the links: see `state.py`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from ....schemas import ArticulationModel, InputDataError
from ...geometry.rotation import cross, quat_exp, quat_multiply, quat_rotate

KINDS = ("hinge", "slide", "fixed")
"""Joints that a chain can have."""
BASES = ("free", "driven", "fixed")
"""How the root link of a chain moves."""


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint between a link and its parent; every tensor has a batch dimension of 1 or B."""

    name: str
    """Name of the joint, unique in the world."""
    kind: str
    """"hinge", "slide" or "fixed"."""
    link: str
    """Name of the body that the joint carries."""
    parent: str
    """Name of the body that it is attached to."""
    position: Tensor
    """Origin of the link's frame in the parent's frame at value 0 [m], shape (B, 3); a hinge's axis goes through it."""
    quat_wxyz: Tensor
    """Orientation of the link's frame in the parent's frame at value 0, shape (B, 4)."""
    axis: Tensor
    """Unit axis of rotation or translation in the link's frame, shape (1, 3)."""
    lower: Tensor
    """Smallest value [rad or m], -inf for none, shape (B,)."""
    upper: Tensor
    """Largest value [rad or m], inf for none, shape (B,)."""
    stiffness: Tensor
    """Servo gain k [N m/rad or N/m], 0 for a passive joint, shape (B,)."""
    damping: Tensor
    """Viscous damping d [N m s/rad or N s/m], shape (B,)."""
    armature: Tensor
    """Reflected inertia of the motor I [kg m2 or kg], shape (B,)."""
    friction: Tensor
    """Dry friction [N m or N], shape (B,)."""
    torque_limit: Tensor
    """Largest torque or force of the servo [N m or N], inf for none, shape (B,)."""

    @staticmethod
    def of(
        name: str,
        kind: str,
        link: str,
        parent: str,
        *,
        position_m: Sequence[float] = (0.0, 0.0, 0.0),
        quat_wxyz: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
        axis: Sequence[float] = (0.0, 0.0, 1.0),
        lower: float = -math.inf,
        upper: float = math.inf,
        stiffness: float = 0.0,
        damping: float = 0.0,
        armature: float = 0.0,
        friction: float = 0.0,
        torque_limit: float = math.inf,
        like: Tensor | None = None,
    ) -> Joint:
        """Build a joint from plain numbers, with the type and device of `like`; see the fields for units.

        Raises:
            InputDataError: If the kind is unknown or a number is not admissible.
        """
        if kind not in KINDS:
            raise InputDataError(
                f"joint '{name}': its kind is '{kind}'.", ", ".join(KINDS) + ".", "correct the kind of the joint."
            )
        like = torch.zeros((), dtype=torch.float64) if like is None else like
        size = math.sqrt(sum(x * x for x in axis))
        if not size > 1e-9:
            raise InputDataError(
                f"joint '{name}': its axis is {tuple(axis)}.",
                "a direction: three numbers, not all 0.",
                "correct the axis of the joint.",
            )
        if not lower <= upper:
            raise InputDataError(
                f"joint '{name}': its limits are {lower:g} and {upper:g}.", "lower <= upper.", "exchange the limits."
            )
        numbers = {
            "stiffness": stiffness, "damping": damping, "armature": armature, "friction": friction,
            "torque_limit": torque_limit,
        }  # fmt: skip
        for key, value in numbers.items():
            if not value >= 0 or (key != "torque_limit" and math.isinf(value)):
                raise InputDataError(
                    f"joint '{name}': {key} is {value:g}.", "0 or more, finite.", "correct the number of the joint."
                )

        def tensor(value: object) -> Tensor:
            return torch.as_tensor(value, dtype=like.dtype, device=like.device)[None]

        norm = math.sqrt(sum(x * x for x in quat_wxyz))
        return Joint(
            name=name,
            kind=kind,
            link=link,
            parent=parent,
            position=tensor(list(position_m)),
            quat_wxyz=tensor([x / norm for x in quat_wxyz]),
            axis=tensor([x / size for x in axis]),
            lower=tensor(lower),
            upper=tensor(upper),
            **{key: tensor(value) for key, value in numbers.items()},
        )


@dataclass(frozen=True, kw_only=True)
class JointFrames:
    """Frames, axes and kinds of the joints of a chain, in one tensor each; every batch dimension is 1 or B."""

    position: Tensor
    """As `Joint.position`, shape (B, joints, 3)."""
    quat_wxyz: Tensor
    """As `Joint.quat_wxyz`, shape (B, joints, 4)."""
    axis: Tensor
    """As `Joint.axis`, shape (B, joints, 3)."""
    middle: Tensor
    """Middle of the limits [rad or m], 0 for none, without derivatives, shape (B, joints)."""
    slides: Tensor
    """Whether each is a slide, shape (joints,)."""
    turns: Tensor
    """Whether each is a hinge, shape (joints,)."""


@dataclass(frozen=True)
class Generation:
    """Links of a chain with equally many ancestors, as indices."""

    links: Tensor
    """Their places in `Chain.links`."""
    joints: Tensor
    """Places of their joints in `Chain.joints`."""
    parents: Tensor
    """Places of their parents in `Chain.links`."""
    above: Tensor
    """Places of their parents among all links one generation after the other, the root first."""


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Links joined in a tree."""

    name: str
    """Name of the chain, unique in the world; commands are given under it."""
    root: str
    """Name of the body that carries the others."""
    base: str
    """How the root moves: "free", "driven" or "fixed"."""
    joints: tuple[Joint, ...]
    """The joints, parents before children."""
    touching: tuple[tuple[str, str], ...] = ()
    """Pairs of links that touch each other; no joint may move both. Other links of a chain pass through each other."""
    within: tuple[str, ...] = ()
    """Links that touch nothing but links of the chain."""

    @cached_property
    def identity(self) -> object:
        """Token that the chain has in common with its copies on other devices, and with no other chain."""
        return object()

    def is_copied_as(self, copy: Chain) -> None:
        """Give a copy on another device or of another type the identity of this chain."""
        copy.__dict__["identity"] = self.identity

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the links, the root first, then those of the joints in their order."""
        return (self.root, *(joint.link for joint in self.joints))

    @cached_property
    def moving(self) -> tuple[Joint, ...]:
        """The joints that move, in the order of commands and joint values."""
        return tuple(joint for joint in self.joints if joint.kind != "fixed")

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints that move, in the order of commands and joint values."""
        return tuple(joint.name for joint in self.moving)

    @cached_property
    def parents(self) -> tuple[int, ...]:
        """Place in `links` of the parent of each link; -1 for the root."""
        return (-1, *(self.links.index(joint.parent) for joint in self.joints))

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Place in `moving` of the joint of each link; -1 for the root and links that do not move in their parent."""
        return (-1, *(self.joint_names.index(j.name) if j.kind != "fixed" else -1 for j in self.joints))

    @cached_property
    def above(self) -> tuple[tuple[bool, ...], ...]:
        """Whether a joint of `moving` moves a link, by link and joint."""
        rows: list[tuple[bool, ...]] = []
        for parent, column in zip(self.parents, self.columns, strict=True):
            row = list(rows[parent]) if parent >= 0 else [False] * len(self.moving)
            if column >= 0:
                row[column] = True
            rows.append(tuple(row))
        return tuple(rows)

    @cached_property
    def branches(self) -> tuple[int, ...]:
        """Place in `links` of the first link that moves, from the root to each link; the root where none does.

        Impulses on links of different branches do not act on each other where the root is not free.
        """
        if self.base == "free":
            return (0,) * len(self.links)
        found = [0]
        for link, (parent, row) in enumerate(zip(self.parents[1:], self.above[1:], strict=True), 1):
            found.append(found[parent] if any(self.above[parent]) else link if any(row) else 0)
        return tuple(found)

    @cached_property
    def frames(self) -> JointFrames:
        """Frames, axes and kinds of all joints."""
        middles = [(0.5 * (joint.lower + joint.upper)).detach() for joint in self.joints]
        kinds = [joint.kind for joint in self.joints]
        device = self.joints[0].axis.device
        return JointFrames(
            position=_side_by_side([joint.position for joint in self.joints]),
            quat_wxyz=_side_by_side([joint.quat_wxyz for joint in self.joints]),
            axis=_side_by_side([joint.axis for joint in self.joints]),
            middle=_side_by_side([torch.where(torch.isfinite(x), x, torch.zeros_like(x)) for x in middles]),
            slides=torch.tensor([kind == "slide" for kind in kinds], device=device),
            turns=torch.tensor([kind == "hinge" for kind in kinds], device=device),
        )

    @cached_property
    def moving_places(self) -> list[int]:
        """Place in `joints` of each joint of `moving`."""
        return [k for k, joint in enumerate(self.joints) if joint.kind != "fixed"]

    @cached_property
    def has_servos(self) -> bool:
        """Whether a joint has a servo."""
        return bool(self.moving) and bool((self.numbers("stiffness") > 0).any())

    def moves(self, link: str) -> bool:
        """Return whether a joint, or the free root, moves a link."""
        return self.base == "free" or any(self.above[self.links.index(link)])

    def numbers(self, name: str) -> Tensor:
        """Return a coefficient of all moving joints, shape (1 or B, joints)."""
        return _side_by_side([getattr(joint, name) for joint in self.moving])

    @cached_property
    def generations(self) -> tuple[Generation, ...]:
        """Links with equally many ancestors, children of the root first."""
        depth = [0]
        for parent in self.parents[1:]:
            depth.append(depth[parent] + 1)
        rows = [[k for k, ancestors in enumerate(depth) if ancestors == d] for d in range(1, max(depth) + 1)]
        places = {0: 0}
        for row in rows:
            places |= {link: len(places) + number for number, link in enumerate(row)}
        parents = [[self.parents[k] for k in row] for row in rows]
        index = partial(torch.tensor, device=self.joints[0].axis.device)
        return tuple(
            Generation(index(row), index([k - 1 for k in row]), index(above), index([places[k] for k in above]))
            for row, above in zip(rows, parents, strict=True)
        )

    @cached_property
    def generation_order(self) -> Tensor:
        """Place of each link among all links one generation after the other, the root first."""
        return torch.cat([torch.zeros_like(self.in_joints[:1]), *(row.links for row in self.generations)]).argsort()

    @cached_property
    def in_joints(self) -> Tensor:
        """Place of the joint of each link but the root in `moving`, or behind its last, shape (L - 1,)."""
        places = [column if column >= 0 else len(self.moving) for column in self.columns[1:]]
        return torch.tensor(places, device=self.joints[0].axis.device)

    def in_links(self, values: Tensor) -> Tensor:
        """Return numbers (B, joints) of the moving joints by joint, (B, all joints), 0 for fixed ones."""
        return torch.nn.functional.pad(values, (0, 1)).index_select(1, self.in_joints)

    def poses(self, position: Tensor, quat: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of all links: positions (B, L, 3) [m] and quaternions (B, L, 4).

        Args:
            position: Origin of the root's frame, world frame [m], shape (B, 3).
            quat: Orientation of the root, shape (B, 4).
            values: Values of the moving joints [rad or m], shape (B, joints).
        """
        frames, every = self.frames, self.in_links(values)[..., None]
        moved = torch.where(frames.slides[:, None], frames.axis * every, torch.zeros_like(every))
        turned = torch.where(frames.turns[:, None], frames.axis * every, torch.zeros_like(every))
        offset = frames.position + quat_rotate(frames.quat_wxyz, moved)
        turn = quat_multiply(frames.quat_wxyz, quat_exp(turned))
        batch = max(position.shape[0], quat.shape[0], offset.shape[0], turn.shape[0])
        places, turns = position.expand(batch, 3)[:, None], quat.expand(batch, 4)[:, None]
        for row in self.generations:
            origin, carrier = places.index_select(1, row.above), turns.index_select(1, row.above)
            places = torch.cat((places, origin + quat_rotate(carrier, offset.index_select(1, row.joints))), 1)
            turns = torch.cat((turns, quat_multiply(carrier, turn.index_select(1, row.joints))), 1)
        return places.index_select(1, self.generation_order), turns.index_select(1, self.generation_order)


def _side_by_side(values: Sequence[Tensor]) -> Tensor:
    """Return numbers of several joints (1 or B, ...) in one tensor (1 or B, joints, ...)."""
    batch = max(value.shape[0] for value in values)
    return torch.stack([value.expand(batch, *value.shape[1:]) for value in values], 1)


def chain_of_model(entry: ArticulationModel, like: Tensor) -> Chain:
    """Return a jointed body of a model as a chain of tensors with the type and device of `like`."""
    joints = tuple(
        Joint.of(
            joint.name,
            joint.kind,
            joint.link,
            joint.parent,
            position_m=joint.position_m,
            quat_wxyz=joint.quat_wxyz,
            axis=joint.axis,
            lower=-math.inf if joint.lower is None else joint.lower,
            upper=math.inf if joint.upper is None else joint.upper,
            damping=joint.damping,
            friction=joint.friction,
            armature=joint.armature,
            stiffness=joint.stiffness,
            torque_limit=math.inf if joint.torque_limit is None else joint.torque_limit,
            like=like,
        )
        for joint in entry.joints
    )
    return Chain(name=entry.name, root=entry.root, base=entry.base, joints=joints)


def link_velocities(
    chain: Chain, position: Tensor, quat: Tensor, root: tuple[Tensor, Tensor], speeds: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the velocities of the links' origins and their angular velocities, world frame, shape (B, L, 3) each.

    Args:
        chain: The chain.
        position: Origins of the links [m], shape (B, L, 3).
        quat: Orientations of the links, shape (B, L, 4).
        root: Velocity of the root's origin [m/s] and its angular velocity [rad/s], world frame, shape (B, 3) each.
        speeds: Speeds of the moving joints, shape (B, joints).
    """
    frames, every = chain.frames, chain.in_links(speeds)[..., None]
    along = quat_rotate(quat[:, 1:], frames.axis) * every
    zero = torch.zeros_like(along)
    sliding = torch.where(frames.slides[:, None], along, zero)
    turning = torch.where(frames.turns[:, None], along, zero)
    order = chain.generation_order
    linear, omega = (part.expand_as(position[:, 0])[:, None] for part in root)
    for row in chain.generations:
        carrier, own = omega.index_select(1, row.above), row.joints
        away = position.index_select(1, row.links) - position.index_select(1, row.parents)
        moved = linear.index_select(1, row.above) + cross(carrier, away) + sliding.index_select(1, own)
        linear = torch.cat((linear, moved), 1)
        omega = torch.cat((omega, carrier + turning.index_select(1, own)), 1)
    return linear.index_select(1, order), omega.index_select(1, order)
