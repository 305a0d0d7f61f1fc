"""Jointed bodies: links in a tree, joined by hinges, slides and fixed joints, with servos, limits and friction.

A link is a body of the world whose motion is "link"; its pose follows from the pose of the chain's base and the values
of the joints. The joints' values are in the state through the poses of the links: `joints_of` reads them,
`with_joints` writes them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ...schemas import InputDataError, UsageError
from ..geometry.rotation import cross, quat_conjugate, quat_exp, quat_multiply, quat_rotate

if TYPE_CHECKING:
    from .world import Body, State, World

KINDS = ("hinge", "slide", "fixed")
"""Joints that a chain can have."""
BASES = ("free", "driven", "fixed")
"""How the root link of a chain moves."""
OFF_JOINT_M, OFF_JOINT_RAD = 1e-5, 1e-4
"""Maximum distance [m] and angle [rad] of a given link pose from the one that its joint admits: rounding of tracks."""


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
            raise InputDataError(f"joint '{name}': its kind is '{kind}'.", ", ".join(KINDS) + ".")
        like = torch.zeros((), dtype=torch.float64) if like is None else like
        size = math.sqrt(sum(x * x for x in axis))
        if not size > 1e-9:
            raise InputDataError(
                f"joint '{name}': its axis is {tuple(axis)}.", "a direction: three numbers, not all 0."
            )
        if not lower <= upper:
            raise InputDataError(f"joint '{name}': its limits are {lower:g} and {upper:g}.", "lower <= upper.")
        numbers = {
            "stiffness": stiffness, "damping": damping, "armature": armature, "friction": friction,
            "torque_limit": torque_limit,
        }  # fmt: skip
        for key, value in numbers.items():
            if not value >= 0 or (key != "torque_limit" and math.isinf(value)):
                raise InputDataError(f"joint '{name}': {key} is {value:g}.", "0 or more, finite.")

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

    def moves(self, link: str) -> bool:
        """Return whether a joint, or the free root, moves a link."""
        return self.base == "free" or any(self.above[self.links.index(link)])

    def numbers(self, name: str) -> Tensor:
        """Return a coefficient of all moving joints, shape (1 or B, joints)."""
        values = [getattr(joint, name) for joint in self.moving]
        batch = max(value.shape[0] for value in values)
        return torch.stack([value.expand(batch) for value in values], -1)

    def place(self, joint: Joint, value: Tensor) -> tuple[Tensor, Tensor]:
        """Return position (B, 3) [m] and quaternion (B, 4) of a link's frame in its parent's at a joint value (B,)."""
        if joint.kind == "hinge":
            return joint.position, quat_multiply(joint.quat_wxyz, quat_exp(joint.axis * value[:, None]))
        if joint.kind == "slide":
            return joint.position + quat_rotate(joint.quat_wxyz, joint.axis * value[:, None]), joint.quat_wxyz
        return joint.position, joint.quat_wxyz

    def poses(self, position: Tensor, quat: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of all links: positions (B, L, 3) [m] and quaternions (B, L, 4).

        Args:
            position: Origin of the root's frame, world frame [m], shape (B, 3).
            quat: Orientation of the root, shape (B, 4).
            values: Values of the moving joints [rad or m], shape (B, joints).
        """
        batch = max(position.shape[0], values.shape[0], *(j.position.shape[0] for j in self.joints), 1)
        positions, quats = [position.expand(batch, 3)], [quat.expand(batch, 4)]
        for joint, parent, column in zip(self.joints, self.parents[1:], self.columns[1:], strict=True):
            value = values[:, column] if column >= 0 else values.new_zeros(1)
            offset, turn = self.place(joint, value)
            positions.append(positions[parent] + quat_rotate(quats[parent], offset))
            quats.append(quat_multiply(quats[parent], turn).expand(batch, 4))
        return torch.stack(positions, 1), torch.stack(quats, 1)


def require_chains(world: World) -> None:
    """Check that the chains of a world are trees of its links and can be simulated.

    Raises:
        InputDataError: If one is not, with the chain and the body or joint.
        UsageError: If the world has effects or a contact law that do not act on links.
    """
    names = [joint.name for chain in world.chains for joint in chain.joints]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputDataError(f"several joints are called '{twice[0]}'.", todo="give each joint a name of its own.")
    owner: dict[str, str] = {}
    bodies = {body.name: body for body in world.bodies}
    for chain in world.chains:
        _require_tree(world, chain, bodies, owner)
    for name, body in bodies.items():
        if body.motion == "link" and name not in owner:
            raise InputDataError(f"{world.called(f'body {name!r}')} is a link of no chain.", todo="add it to a chain.")
    if not world.chains:
        return
    if world.contact.name != "closed_form":
        raise UsageError("the published contact law does not know jointed bodies.", "the contact law closed_form.")
    acting = [active.effect.name for active in world.effects if active.effect.has("wrench")]
    if acting:
        raise UsageError(
            f"the effect '{acting[0]}' acts on free bodies alone, and this world has jointed ones.",
            "effects of contact, of gravity and of the measurement.",
            "leave the effect out.",
        )


def _require_tree(world: World, chain: Chain, bodies: Mapping[str, Body], owner: dict[str, str]) -> None:
    place = world.called(f"chain '{chain.name}'")
    if chain.base not in BASES:
        raise InputDataError(f"{place}: its base is '{chain.base}'.", ", ".join(BASES) + ".")
    seen: list[str] = []
    for link, parent in zip(chain.links, ("", *(joint.parent for joint in chain.joints)), strict=True):
        if link not in bodies or bodies[link].motion != "link":
            raise InputDataError(f"{place}: '{link}' is not a body with motion \"link\" of this world.")
        if link in owner:
            raise InputDataError(f"{place}: '{link}' is carried by two joints: a loop.", "a tree of links.")
        if parent and parent not in seen:
            raise InputDataError(
                f"{place}: '{link}' hangs on '{parent}', which is not among the links before it.",
                "a tree of links, parents before children.",
            )
        owner[link] = chain.name
        seen.append(link)
    if not chain.joints or (chain.base != "free" and not chain.moving):
        raise InputDataError(f"{place}: none of its joints moves.", todo="take a driven or fixed body instead.")
    _require_inertia(place, chain, bodies)


def _require_inertia(place: str, chain: Chain, bodies: Mapping[str, Body]) -> None:
    """Check that each joint that moves has something to move: mass below it, reflected inertia or damping."""
    heavy = {name: bool((bodies[name].mass > 0).all()) for name in chain.links}
    for index, joint in enumerate(chain.moving):
        below = [name for name, row in zip(chain.links, chain.above, strict=True) if row[index]]
        own = joint.armature + joint.damping + joint.stiffness
        if not any(heavy[name] for name in below) and not bool((own > 0).all()):
            raise InputDataError(
                f"{place}: joint '{joint.name}' moves links without mass and has no inertia of its own.",
                "a link with mass, or reflected inertia, damping or servo gain above 0.",
            )
    if chain.base == "free" and not heavy[chain.root]:
        raise InputDataError(f"{place}: its free root '{chain.root}' has no mass.", "a mass above 0 kg.")


def joints_of(world: World, state: State, chain: Chain) -> tuple[Tensor, Tensor]:
    """Return values [rad or m] and speeds (B, joints) of the moving joints of a chain, from the poses of its links.

    A hinge's value is the one in the middle of its limits, where it has two, plus or minus half a turn; else between
    minus and plus half a turn.

    Raises:
        InputDataError: If a link is not where its joint admits it, with the environment.
    """
    rows = [world.body_names.index(name) for name in chain.links]
    values, speeds = [], []
    for joint, row, up in zip(chain.joints, rows[1:], chain.parents[1:], strict=True):
        parent = rows[up]
        position, quat, velocity = (x[:, row] for x in (state.position_m, state.quat_wxyz, state.velocity_m_s))
        above, turn = state.position_m[:, parent], state.quat_wxyz[:, parent]
        offset = quat_rotate(quat_conjugate(turn), position - above) - joint.position
        turned = quat_multiply(quat_conjugate(joint.quat_wxyz), quat_multiply(quat_conjugate(turn), quat))
        value = _value(joint, offset, turned)
        _require_joint(joint, offset, turned, value)
        if joint.kind == "fixed":
            continue
        omega = quat_rotate(turn, state.omega_body_rad_s[:, parent])
        axis = quat_rotate(quat, joint.axis)
        if joint.kind == "hinge":
            speed = (axis * (quat_rotate(quat, state.omega_body_rad_s[:, row]) - omega)).sum(-1)
        else:
            carried = state.velocity_m_s[:, parent] + cross(omega, position - above)
            speed = (axis * (velocity - carried)).sum(-1)
        values.append(value)
        speeds.append(speed)
    if not values:
        nothing = state.position_m.new_zeros(state.position_m.shape[0], 0)
        return nothing, nothing
    return torch.stack(values, -1), torch.stack(speeds, -1)


def _value(joint: Joint, offset: Tensor, turned: Tensor) -> Tensor:
    """Return the value (B,) of a joint from the link's offset and turn against its place at value 0."""
    if joint.kind == "slide":
        return (quat_rotate(joint.quat_wxyz, joint.axis) * offset).sum(-1)
    along = (turned[:, 1:] * joint.axis).sum(-1)
    value = 2 * torch.atan2(along, turned[:, 0])
    middle = 0.5 * (joint.lower + joint.upper)
    middle = torch.where(torch.isfinite(middle), middle, torch.zeros_like(middle)).detach()
    return value - 2 * math.pi * torch.round((value.detach() - middle) / (2 * math.pi))


def _require_joint(joint: Joint, offset: Tensor, turned: Tensor, value: Tensor) -> None:
    with torch.no_grad():
        if joint.kind == "slide":
            offset = offset - quat_rotate(joint.quat_wxyz, joint.axis) * value[:, None]
        elif joint.kind == "hinge":
            turned = quat_multiply(turned, quat_exp(-joint.axis * value[:, None]))
        far = offset.square().sum(-1).sqrt() / OFF_JOINT_M
        angle = 2 * turned[:, 1:].square().sum(-1).sqrt() / OFF_JOINT_RAD
        wrong = ((far > 1) | (angle > 1)).nonzero()
        if len(wrong):
            item = int(wrong[0, 0])
            raise InputDataError(
                f"the start of environment {item}: link '{joint.link}' is "
                f"{1e3 * OFF_JOINT_M * float(far[item]):.3g} mm and "
                f"{OFF_JOINT_RAD * float(angle[item]):.3g} rad off its joint '{joint.name}'.",
                f"up to {1e3 * OFF_JOINT_M:g} mm and {OFF_JOINT_RAD:g} rad.",
                "make the start with with_joints.",
            )


def with_joints(
    world: World,
    state: State,
    values: Mapping[str, float | Tensor],
    speeds: Mapping[str, float | Tensor] | None = None,
) -> State:
    """Return a state in which the links of all chains are where the joints put them.

    Args:
        world: The world.
        state: Poses and velocities of the other bodies and of the roots, shapes (B, nb, ...).
        values: Values by joint name [rad or m], numbers or shape (B,); 0 for joints that are left out.
        speeds: Speeds by joint name [rad/s or m/s]; 0 for joints that are left out.

    Raises:
        UsageError: If a name is not that of a joint that moves.
    """
    known = [name for chain in world.chains for name in chain.joint_names]
    unknown = [name for given in (values, speeds or {}) for name in given if name not in known]
    if unknown:
        raise UsageError(f"there is no moving joint '{unknown[0]}'.", ", ".join(known) + ".")
    for chain in world.chains:
        state = _posed(world, state, chain, values, speeds or {})
    return state


def _posed(
    world: World, state: State, chain: Chain, values: Mapping[str, float | Tensor], speeds: Mapping[str, float | Tensor]
) -> State:
    rows = [world.body_names.index(name) for name in chain.links]
    like = state.position_m
    columns = []
    for given in (values, speeds):
        parts = [torch.as_tensor(given.get(name, 0.0)).to(like).reshape(-1) for name in chain.joint_names]
        batch = max([like.shape[0], *(len(part) for part in parts)])
        columns.append(torch.stack([part.expand(batch) for part in parts], -1) if parts else like.new_zeros(batch, 0))
    value, speed = columns
    root = rows[0]
    position, quat = chain.poses(state.position_m[:, root], state.quat_wxyz[:, root], value)
    first = (state.velocity_m_s[:, root], quat_rotate(state.quat_wxyz[:, root], state.omega_body_rad_s[:, root]))
    linear, omega = link_velocities(chain, position, quat, first, speed)
    fields = [x.expand(position.shape[0], -1, -1).clone() for x in state.tensors]
    for field, values_ in zip(fields, (position, quat, linear, quat_rotate(quat_conjugate(quat), omega)), strict=True):
        field[:, rows] = values_
    return type(state)(*fields)


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
    linear, omega = [root[0].expand_as(position[:, 0])], [root[1].expand_as(position[:, 0])]
    for k, (joint, parent, column) in enumerate(
        zip(chain.joints, chain.parents[1:], chain.columns[1:], strict=True), 1
    ):
        velocity = linear[parent] + cross(omega[parent], position[:, k] - position[:, parent])
        spin = omega[parent]
        if column >= 0:
            along = quat_rotate(quat[:, k], joint.axis) * speeds[:, column, None]
            velocity, spin = (velocity, spin + along) if joint.kind == "hinge" else (velocity + along, spin)
        linear.append(velocity)
        omega.append(spin)
    return torch.stack(linear, 1), torch.stack(omega, 1)
