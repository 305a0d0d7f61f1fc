"""Values of the joints of chains in states, and checks of a world's chains."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from weakref import ref

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from ....schemas import InputDataError, UsageError
from ...geometry.rotation import cross, quat_conjugate, quat_exp, quat_multiply, quat_rotate
from ...optimization.forward_mode import parts_of
from ..body import Body
from ..state import State
from ..world import World
from .chain import BASES, Chain, JointFrames, link_velocities

OFF_JOINT_M, OFF_JOINT_RAD = 1e-5, 1e-4
"""Maximum distance [m] and angle [rad] of a given link pose from the one that its joint admits: rounding of tracks."""


def require_chains(world: World) -> None:
    """Check that the chains of a world are trees of its links and can be simulated.

    Raises:
        InputDataError: If one is not, with the chain and the body or joint.
        UsageError: If the world has a contact law that does not act on links.
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
    if world.chains and world.contact.name != "closed_form":
        raise UsageError(
            "the published contact law does not know jointed bodies.",
            "the contact law closed_form.",
            todo="fit with the contact law closed_form, which is the default.",
        )


def _require_tree(world: World, chain: Chain, bodies: Mapping[str, Body], owner: dict[str, str]) -> None:
    place = world.called(f"chain '{chain.name}'")
    if chain.base not in BASES:
        raise InputDataError(f"{place}: its base is '{chain.base}'.", ", ".join(BASES) + ".", todo="correct base.")
    seen: list[str] = []
    for link, parent in zip(chain.links, ("", *(joint.parent for joint in chain.joints)), strict=True):
        if link not in bodies or bodies[link].motion != "link":
            links = [name for name, body in bodies.items() if body.motion == "link"]
            raise InputDataError(
                f"{place}: '{link}' is not a body with motion \"link\" of this world.",
                ", ".join(links) + ".",
                todo='name one of these bodies, or add it with motion = "link".',
            )
        if link in owner:
            raise InputDataError(
                f"{place}: '{link}' is carried by two joints: a loop.",
                "a tree of links.",
                todo="take one of the two joints out.",
            )
        if parent and parent not in seen:
            raise InputDataError(
                f"{place}: '{link}' hangs on '{parent}', which is not among the links before it.",
                "a tree of links, parents before children.",
                todo="list the joints from the root outwards.",
            )
        owner[link] = chain.name
        seen.append(link)
    require_touching(place, chain)
    if not chain.joints or (chain.base != "free" and not chain.moving):
        raise InputDataError(f"{place}: none of its joints moves.", todo="take a driven or fixed body instead.")
    _require_inertia(place, chain, bodies)


def require_touching(place: str, chain: Chain) -> None:
    """Check that links that touch each other are links of the chain, of which no joint moves both.

    Args:
        place: What the message begins with.
        chain: The chain.

    Raises:
        InputDataError: If they are not, with their names.
    """
    known = chain.links
    for name in (*(name for pair in chain.touching for name in pair), *chain.within):
        if name not in known:
            raise InputDataError(
                f"{place}: there is no link '{name}'.", ", ".join(known) + ".", todo="name one of these links."
            )
    for first, second in chain.touching:
        rows = [chain.above[known.index(name)] for name in (first, second)]
        if chain.base == "free" or any(map(all, zip(*rows, strict=True))) or not any(map(any, rows)):
            raise InputDataError(
                f"{place}: '{first}' and '{second}' cannot touch each other: a joint or a free root moves both, or "
                "none moves either.",
                "links on different branches of a root that is not free.",
                todo="take the pair out, or name links on different branches.",
            )


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
                todo="give the link a mass, or the joint armature, damping or a servo.",
            )
    if chain.base == "free" and not heavy[chain.root]:
        raise InputDataError(
            f"{place}: its free root '{chain.root}' has no mass.",
            "a mass above 0 kg.",
            todo="give the body of the root a mass.",
        )


def on_joints(world: World, state: State) -> State:
    """Return a state in which links are on their joints: values and speeds are read from poses that may be off.

    A fit moves links as if they were free; what a joint does not admit is left out.
    """
    for chain in world.chains:
        values, speeds = joints_of(world, state, chain, exact=False)
        names = chain.joint_names
        state = _posed(
            world,
            state,
            chain,
            dict(zip(names, values.unbind(-1), strict=True)),
            dict(zip(names, speeds.unbind(-1), strict=True)),
        )
    return state


def joints_of(world: World, state: State, chain: Chain, exact: bool = True) -> tuple[Tensor, Tensor]:
    """Return the joints of a chain of a world, see `joint_values`."""
    return joint_values(world.body_names, state, chain, exact)


def joint_values(names: Sequence[str], state: State, chain: Chain, exact: bool = True) -> tuple[Tensor, Tensor]:
    """Return values [rad or m] and speeds (B, joints) of the moving joints of a chain, from the poses of its links.

    A hinge's value is the one in the middle of its limits, where it has two, plus or minus half a turn; else between
    minus and plus half a turn.

    Args:
        names: Names of all bodies.
        state: Their poses and velocities.
        chain: The chain.
        exact: Whether links that are off their joints are refused; else the nearest values are returned.

    Raises:
        InputDataError: If a link is not where its joint admits it, with the environment.
    """
    if not chain.moving:
        nothing = state.position_m.new_zeros(state.position_m.shape[0], 0)
        return nothing, nothing
    made = _MADE.get(state.position_m)
    if made is not None and made.chain == chain.identity and made.of(state):
        return made.value, made.speed
    rows = [names.index(name) for name in chain.links]
    child, parent = rows[1:], [rows[up] for up in chain.parents[1:]]
    position, quat, velocity, omega_body = (x[:, child] for x in state.tensors)
    above, turn, carrier, carrier_omega = (x[:, parent] for x in state.tensors)
    away, back = position - above, quat_conjugate(turn)
    joints = chain.frames
    offset = quat_rotate(back, away) - joints.position
    turned = quat_multiply(quat_conjugate(joints.quat_wxyz), quat_multiply(back, quat))
    value = _values(joints, offset, turned)
    if exact:
        _require_joints(chain, offset, turned, value)
    omega, axis = quat_rotate(turn, carrier_omega), quat_rotate(quat, joints.axis)
    turning = (axis * (quat_rotate(quat, omega_body) - omega)).sum(-1)
    sliding = (axis * (velocity - carrier - cross(omega, away))).sum(-1)
    speed = torch.where(joints.slides, sliding, turning)
    return value[:, chain.moving_places], speed[:, chain.moving_places]


def _values(joints: JointFrames, offset: Tensor, turned: Tensor) -> Tensor:
    """Return the values (B, joints) of joints from the links' offsets and turns against their places at value 0."""
    along = (turned[..., 1:] * joints.axis).sum(-1)
    angle = 2 * torch.atan2(along, turned[..., 0])
    angle = angle - 2 * math.pi * torch.round((angle.detach() - joints.middle) / (2 * math.pi))
    return torch.where(joints.slides, (quat_rotate(joints.quat_wxyz, joints.axis) * offset).sum(-1), angle)


@torch.no_grad()
def _require_joints(chain: Chain, offset: Tensor, turned: Tensor, value: Tensor) -> None:
    joints = chain.frames
    slid = quat_rotate(joints.quat_wxyz, joints.axis) * value[..., None]
    offset = torch.where(joints.slides[:, None], offset - slid, offset)
    unturned = quat_multiply(turned, quat_exp(-joints.axis * value[..., None]))
    turned = torch.where(joints.turns[:, None], unturned, turned)
    far = offset.square().sum(-1).sqrt() / OFF_JOINT_M
    angle = 2 * turned[..., 1:].square().sum(-1).sqrt() / OFF_JOINT_RAD
    wrong = ((far > 1) | (angle > 1)).T.nonzero()
    if len(wrong):
        number, item = wrong[0].tolist()
        joint = chain.joints[number]
        raise InputDataError(
            f"the start of environment {item}: link '{joint.link}' is "
            f"{1e3 * OFF_JOINT_M * float(far[item, number]):.3g} mm and "
            f"{OFF_JOINT_RAD * float(angle[item, number]):.3g} rad off its joint '{joint.name}'.",
            f"up to {1e3 * OFF_JOINT_M:g} mm and {OFF_JOINT_RAD:g} rad.",
            "make the start with with_joints.",
        )


def with_joints(
    world: World,
    state: State,
    values: Mapping[str, float | Tensor],
    speeds: Mapping[str, float | Tensor] | None = None,
    placed: bool = True,
) -> State:
    """Return a state in which the links of all chains are where the joints put them.

    Args:
        world: The world.
        state: Poses and velocities of the other bodies and of the roots, shapes (B, nb, ...).
        values: Values by joint name [rad or m], numbers or shape (B,); 0 for joints that are left out.
        speeds: Speeds by joint name [rad/s or m/s]; 0 for joints that are left out.
        placed: Whether poses and velocities of links are wanted. Else only rollouts take the state: they begin with the
            joints, from which they place the links themselves.

    Raises:
        UsageError: If a name is not that of a joint that moves.
    """
    known = [name for chain in world.chains for name in chain.joint_names]
    unknown = [name for given in (values, speeds or {}) for name in given if name not in known]
    if unknown:
        raise UsageError(
            f"there is no moving joint '{unknown[0]}'.", ", ".join(known) + ".", todo="name one of these joints."
        )
    for chain in world.chains:
        state = _posed(world, state, chain, values, speeds or {}, placed)
    return state


def _posed(
    world: World,
    state: State,
    chain: Chain,
    values: Mapping[str, float | Tensor],
    speeds: Mapping[str, float | Tensor],
    placed: bool = True,
) -> State:
    like = state.position_m
    columns = []
    for given in (values, speeds):
        if chain.joint_names and not any(isinstance(number, Tensor) for number in given.values()):
            columns.append(like.new_tensor([given.get(name, 0.0) for name in chain.joint_names]).expand(len(like), -1))
            continue
        parts = [torch.as_tensor(given.get(name, 0.0)).to(like).reshape(-1) for name in chain.joint_names]
        batch = max([like.shape[0], *(len(part) for part in parts)])
        columns.append(torch.stack([part.expand(batch) for part in parts], -1) if parts else like.new_zeros(batch, 0))
    value, speed = columns
    found = type(state)(*(x.expand(value.shape[0], -1, -1).clone() for x in state.tensors))
    known = chain.moving and _versioned(found) and _principal(chain, value)
    if known and not placed:
        _MADE[found.position_m] = _Made(chain.identity, _versions(found), value, speed)
        return found
    names = world.body_names
    rows = [names.index(name) for name in chain.links]
    root = rows[0]
    position, quat = chain.poses(state.position_m[:, root], state.quat_wxyz[:, root], value)
    first = (state.velocity_m_s[:, root], quat_rotate(state.quat_wxyz[:, root], state.omega_body_rad_s[:, root]))
    linear, omega = link_velocities(chain, position, quat, first, speed)
    fields = [x.expand(position.shape[0], -1, -1).clone() for x in state.tensors]
    for field, values_ in zip(fields, (position, quat, linear, quat_rotate(quat_conjugate(quat), omega)), strict=True):
        field[:, rows] = values_
    found = type(state)(*fields)
    if known:
        _MADE[found.position_m] = _Made(chain.identity, _versions(found), value, speed)
    return found


def made_likewise(state: State, copy: State, copied: Callable[[Tensor], Tensor]) -> None:
    """Keep for a copy of a state the joints from which that was made.

    Args:
        state: A state.
        copy: The same on another device or of another type.
        copied: Function that copies a tensor likewise.
    """
    made = _MADE.get(state.position_m)
    if made is not None and made.of(state) and _versioned(copy) and copy.position_m is not state.position_m:
        _MADE[copy.position_m] = _Made(made.chain, _versions(copy), copied(made.value), copied(made.speed))


def _versioned(state: State) -> bool:
    """Return whether it can be told that a state was changed in place; tensors of inference mode have no versions."""
    return not any(part.is_inference() for part in state.tensors)


def _versions(state: State) -> list[tuple[ref[Tensor], int]]:
    return [(ref(part), part._version) for part in state.tensors]


@dataclass(frozen=True)
class _Made:
    """Joints from which a state was made, so that they need not be found again from the poses of the links."""

    chain: object
    """`Chain.identity` of their chain."""
    tensors: list[tuple[ref[Tensor], int]]
    """The state's tensors and their versions: one that was changed in place makes another state."""
    value: Tensor
    """Values of the moving joints (B, joints)."""
    speed: Tensor
    """Their speeds."""

    def of(self, state: State) -> bool:
        """Return whether a state is the one that was made."""
        return all(
            own() is part and version == part._version
            for (own, version), part in zip(self.tensors, state.tensors, strict=True)
        )


_MADE: MutableMapping[Tensor, _Made] = WeakTensorKeyDictionary()


@torch.no_grad()
def _principal(chain: Chain, value: Tensor) -> bool:
    """Return whether values (B, joints) are those which `joint_values` would find, not whole turns away."""
    turned = (parts_of(value)[0].detach() - chain.frames.middle[:, chain.moving_places]).abs() < math.pi
    return bool((turned | chain.frames.slides[chain.moving_places]).all())
