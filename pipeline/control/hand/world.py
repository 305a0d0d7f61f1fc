"""The world of a task for a hand: its links as convex shapes on joints with servos, and the object."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import torch
from numpy.typing import ArrayLike

from ....datasets.models.model import Model
from ....datasets.robots import Articulation, JointOfRobot, read_articulation
from ....schemas import HandTask, InputDataError, require_joints
from ....schemas.materials import pair_of
from ...geometry.directions import fibonacci_directions
from ...physics.body import Body
from ...physics.chains.articulated import Servo, chain_of
from ...physics.chains.chain import Chain, Joint
from ...physics.chains.state import require_touching, with_joints
from ...physics.checks import require_apart
from ...physics.contact_law import ContactLaw
from ...physics.hull import Hull
from ...physics.model_world import world_of_model
from ...physics.state import State
from ...physics.world import World
from ...sg_gs.collision.link_hulls import Balls, link_hulls, rounded_hull, whole_hull
from ..horizon import Array
from ..task_world import free_object, require_metric, require_rigid, softened
from .fingertips import Fingertips

OBJECT, LINK = "the object", "a link"
"""Materials of the object, and prefix of those of links with a friction of their own."""
WHOLE_CORNERS = 12
"""Largest number of corners of the hulls by which links touch each other."""
SLACK = 1e-3
"""Largest excess of a range of targets over that of the file, which may have been rounded [rad or m]."""
DIRECTIONS = 200
"""Points of each ball of an object whose hull gets fewer corners."""


@dataclass(frozen=True, kw_only=True)
class HandWorld:
    """A task for a hand with the world that it is about."""

    task: HandTask
    """The task."""
    model: Model
    """The model of the object."""
    world: World
    """Links of the hand, then the object; batch 1, float64 on the CPU."""
    joints: tuple[str, ...]
    """Names of the joints, in the order of commands."""
    lower: Array
    """Smallest targets [rad], shape (joints,)."""
    upper: Array
    """Largest targets [rad], shape (joints,)."""
    home: Array
    """Values of the joints at the start [rad], shape (joints,)."""
    outside: tuple[str, ...]
    """Names of what collides in the file of the hand and belongs to no link: the object does not touch it."""

    @property
    def object(self) -> int:
        """Index of the object."""
        return len(self.world.bodies) - 1

    @property
    def chain(self) -> Chain:
        """The hand."""
        return self.world.chains[0]

    @cached_property
    def tips(self) -> Fingertips:
        """The tips of the fingers."""
        return Fingertips.of(self.world, self.chain)

    @property
    def span(self) -> Array:
        """Larger distance of each joint's limits from its value at the start [rad], shape (joints,)."""
        return np.maximum(self.upper - self.home, self.home - self.lower)

    def planning(self, world: World | None = None, step_s: float | None = None) -> World:
        """Return a world for predictions, whose contacts are soft enough for their steps.

        Args:
            world: A world with other parameters; None for that of the model.
            step_s: The steps [s]; None for those of the planner.
        """
        return softened(world or self.world, step_s or self.task.planner.step_s)

    def state(
        self,
        position_m: ArrayLike,
        quat_wxyz: ArrayLike,
        joints: Mapping[str, float],
        velocity_m_s: ArrayLike = (0.0, 0.0, 0.0),
        omega_body_rad_s: ArrayLike = (0.0, 0.0, 0.0),
        speeds: Mapping[str, float] | None = None,
        placed: bool = True,
    ) -> State:
        """Return the state (1, nb, ...) of all bodies from pose and velocities of the object and values of the joints.

        Args:
            position_m: Position of the object [m], shape (3,).
            quat_wxyz: Its orientation, shape (4,).
            joints: Values of the joints [rad].
            velocity_m_s: Velocity of the object [m/s], shape (3,).
            omega_body_rad_s: Its angular velocity [rad/s], shape (3,).
            speeds: Speeds of the joints [rad/s]; 0 for those that are left out.
            placed: Whether poses of links are wanted, which rollouts do not need.
        """
        count = len(self.world.bodies)
        position, velocity, omega = (torch.zeros(1, count, 3, dtype=torch.float64) for _ in range(3))
        quat = torch.zeros(1, count, 4, dtype=torch.float64)
        quat[..., 0] = 1.0
        position[0, 0] = torch.tensor(self.task.robot.position_m, dtype=torch.float64)
        quat[0, 0] = torch.tensor(self.task.robot.quat_wxyz, dtype=torch.float64)
        for field, value in ((position, position_m), (quat, quat_wxyz), (velocity, velocity_m_s),
                             (omega, omega_body_rad_s)):  # fmt: skip
            field[0, -1] = torch.as_tensor(np.asarray(value, float))
        return with_joints(self.world, State(position, quat, velocity, omega), joints, speeds, placed)


def hand_world(model: Model, task: HandTask) -> HandWorld:
    """Return the world of a task for a hand.

    Args:
        model: A model with fitted physics, whose only free body is the object.
        task: The task.

    Raises:
        InputDataError: If the model has no physics, no scale, joints or several free bodies; if the file is no hand, or
            lacks a joint or a link that the task names; or if the object begins inside of the hand, or is wanted inside
            of it, out of its reach or farther away than what counts as dropped.
    """
    require_rigid(model)
    require_metric(model)
    free_object(model.file, task.object, task.source)
    hand = _hand(task)
    moving = tuple(joint.name for joint in hand.joints)
    wrong = require_joints(task, moving, tuple(link.name for link in hand.links), _parts(hand))
    if wrong:
        raise InputDataError(f"{task.source}: {wrong}", todo="correct the name or the range.")
    _require_servos(task, hand)
    chain, links = chain_of(hand, {link.name: (np.zeros((0, 3)), np.zeros(0)) for link in hand.links}, "fixed",
                            Servo(**task.servo.model_dump()))  # fmt: skip
    shapes = {
        name: balls for name, balls in link_hulls(hand, task.robot.corners).items() if name not in task.robot.apart
    }
    chain, bodies = _touching(task, hand, *_shaped(task, chain, links, shapes))
    world = world_of(model, task, chain, bodies)
    limits = [_limits(task, joint) for joint in hand.joints]
    lower, upper = (np.array(side) for side in zip(*limits, strict=True))
    home = np.array([task.start.joints.get(joint, min(max(0.0, low), high))
                     for joint, (low, high) in zip(moving, limits, strict=True)])  # fmt: skip
    outside = [k for k in range(len(moving)) if not lower[k] - 1e-9 <= home[k] <= upper[k] + 1e-9]
    if outside:
        k = outside[0]
        raise InputDataError(
            f"{task.source}: [start] joints: '{moving[k]}' = {home[k]:g} rad.",
            f"{lower[k]:g} to {upper[k]:g} rad, its limits.",
            "correct the value.",
        )
    found = HandWorld(
        task=task, model=model, world=world, joints=moving, lower=lower, upper=upper, home=home, outside=hand.outside
    )
    begun = found.state(task.start.position_m, task.start.quat_wxyz, dict(zip(moving, home.tolist(), strict=True)))
    require_apart(world, begun, f"{task.source}, the start")
    _require_reach(found)
    _require_room(found)
    return found


def _parts(hand: Articulation) -> tuple[str, ...]:
    """Return the names of the further parts of links."""
    return tuple(part for link in hand.links for part in _parts_of(hand, link.name))


def _parts_of(hand: Articulation, name: str) -> tuple[str, ...]:
    """Return the names of the further parts of a link."""
    link = next(link for link in hand.links if link.name == name)
    return tuple(_part(name, k) for k in range(1, len(link.geometry)))


def _part(link: str, number: int) -> str:
    """Return the name of a part of a link; the first has that of the link."""
    return f"{link}/{number}" if number else link


def _hand(task: HandTask) -> Articulation:
    """Read the hand of a task."""
    try:
        hand = read_articulation(task.folder / task.robot.file).welded()
    except InputDataError as error:
        found = f"{task.source}: [robot] file: {error.found}"
        todo = error.todo or "correct the path, which is relative to the task's folder."
        raise InputDataError(found, error.allowed, todo) from error
    if not hand.joints:
        raise InputDataError(
            f"{task.source}: [robot] file: {hand.path} has no joint that moves.",
            "a hand with hinges or slides.",
            todo="name a file with joints that are not fixed.",
        )
    return hand


def _require_servos(task: HandTask, hand: Articulation) -> None:
    without = [joint.name for joint in hand.joints if joint.stiffness <= 0]
    if without and task.servo.stiffness is None:
        raise InputDataError(
            f"{task.source}: joint '{without[0]}' of {hand.path.name} has no servo.",
            "a gain above 0 for every joint.",
            "set [servo] stiffness and damping, or give the file position actuators.",
        )


def _require_reach(found: HandWorld) -> None:
    """Check that the object is wanted within reach, and not where it would count as dropped at the start."""
    task, size = found.task, _size(found.world.bodies[found.object])
    away, reach = math.dist(task.wanted_m, task.robot.position_m), _reach(found)
    if away > reach + size:
        raise InputDataError(
            f"{task.source}: the object is wanted {away:.3g} m from the root of the hand: out of reach.",
            f"up to {reach + size:.3g} m: the fingers reach {reach:.3g} m, and the object {size:.3g} m.",
            "correct position_m of [goal], [start] or [robot].",
        )
    moved, dropped = math.dist(task.wanted_m, task.start.position_m), task.success.drop_m
    if moved > dropped:
        raise InputDataError(
            f"{task.source}: [goal] position_m is {moved:.3g} m from where the object begins, which counts as dropped.",
            f"up to [success] drop_m = {dropped:g} m.",
            "correct one of them.",
        )


def _size(body: Body) -> float:
    """Return the distance of the farthest point of a body from its origin [m]."""
    return float((body.centers.norm(dim=-1) + body.radii).max()) if body.radii.numel() else 0.0


def _reach(found: HandWorld) -> float:
    """Return an upper bound of the distance of any point of the hand from its root, whatever its joints [m]."""
    chain, bodies = found.chain, {body.name: body for body in found.world.bodies}
    far = {chain.root: 0.0}
    for joint in chain.joints:
        ends = torch.stack((joint.lower, joint.upper)).abs() if joint.kind == "slide" else torch.zeros(1)
        far[joint.link] = far[joint.parent] + float(joint.position.norm(dim=-1).max() + ends.max())
    return max(far[name] + _size(bodies[name]) for name in far)


def _require_room(found: HandWorld) -> None:
    """Check that the object has room where it is wanted, with the hand as at the start."""
    task = found.task
    if task.goal.position_m is None:
        return
    joints = dict(zip(found.joints, found.home.tolist(), strict=True))
    require_apart(
        found.world, found.state(task.wanted_m, task.start.quat_wxyz, joints), f"{task.source}, [goal] position_m"
    )


def _limits(task: HandTask, joint: JointOfRobot) -> tuple[float, float]:
    """Return the smallest and the largest target of a joint: those of its file, or of the task within them."""
    low, high = max(joint.lower, joint.lowest_target), min(joint.upper, joint.highest_target)
    wanted = task.limits.joints.get(joint.name, (low, high))
    if wanted[0] < low - SLACK or wanted[1] > high + SLACK:
        raise InputDataError(
            f"{task.source}: [limits] joints: '{joint.name}' = {wanted[0]:g} to {wanted[1]:g}.",
            f"a range within that of the file, {low:g} to {high:g} {'m' if joint.kind == 'slide' else 'rad'}.",
            "correct the range.",
        )
    return max(low, wanted[0]), min(high, wanted[1])


def _shaped(
    task: HandTask, chain: Chain, links: list[Body], shapes: Mapping[str, list[Balls]]
) -> tuple[Chain, list[Body]]:
    """Return the chain and its links with their shapes; further shapes of a link are links that are fixed to it."""
    bodies, more, joints = [], [], []
    for link in links:
        first, *others = [_with_hull(link, balls) for balls in shapes.get(link.name, ())] or [link]
        bodies.append(first)
        for number, part in enumerate(others, 1):
            name = _part(link.name, number)
            more.append(replace(part, name=name, mass=0 * link.mass, inertia=0 * link.inertia))
            joints.append(Joint.of(f"{name}/fixed", "fixed", name, link.name))
    every = [replace(body, material=_material(task, body.name)) for body in (*bodies, *more)]
    return replace(chain, joints=(*chain.joints, *joints)), every


def _touching(task: HandTask, hand: Articulation, chain: Chain, bodies: list[Body]) -> tuple[Chain, list[Body]]:
    """Return the chain and its links with those by which links touch each other: their hulls, and parts of the root."""
    root = hand.links[0].name
    if root in task.robot.apart and any(root in pair for pair in task.robot.touching):
        raise InputDataError(
            f"{task.source}: [robot] touching: '{root}' is apart, and so has no shape.",
            todo="take it out of one of both.",
        )
    require_touching(f"{task.source}: [robot] touching", replace(chain, touching=task.robot.touching))
    names = dict.fromkeys(name for pair in task.robot.touching for name in pair if name != root)
    links = {link.name: link for link in hand.links}
    more = []
    for name in names:
        body = next(body for body in bodies if body.name == name)
        made = replace(body, name=f"{name}/whole", mass=0 * body.mass, inertia=0 * body.inertia)
        more.append(_with_hull(made, whole_hull(links[name], WHOLE_CORNERS)))
    shapes = {name: (f"{name}/whole",) for name in names} | {root: (root, *_parts_of(hand, root))}
    pairs = tuple(pair for first, second in task.robot.touching for pair in product(shapes[first], shapes[second]))
    joints = tuple(Joint.of(f"{body.name}/fixed", "fixed", body.name, body.name.rpartition("/")[0]) for body in more)
    within = tuple(body.name for body in more)
    chain = replace(chain, joints=(*chain.joints, *joints), touching=pairs, within=within)
    return chain, [*bodies, *more]


def _material(task: HandTask, part: str) -> str | None:
    """Return the material of a part: its own, or that of its link, where the task gives it a friction."""
    owner = next((name for name in (part, part.partition("/")[0]) if name in task.robot.friction), None)
    return None if owner is None else f"{LINK} {owner}"


def _with_hull(body: Body, balls: Balls) -> Body:
    centers, radii = (torch.as_tensor(values)[None] for values in balls)
    every = torch.arange(radii.shape[1])
    return replace(body, centers=centers, radii=radii, on_plane=None, hull=Hull.of(centers[0], radii[0], every))


def _with_few_corners(body: Body, corners: int) -> Body:
    """Return a convex body with the hull of at most `corners` balls: plans pay for each face and edge in every step."""
    if body.hull is None or body.radii.shape[1] <= corners:
        return body
    centers, radii = body.centers[0].numpy(), body.radii[0].numpy()
    surface = centers[:, None] + radii[:, None, None] * fibonacci_directions(DIRECTIONS)
    return _with_hull(body, rounded_hull(surface.reshape(-1, 3), corners))


def world_of(model: Model, task: HandTask, chain: Chain, links: Sequence[Body], friction_factor: float = 1.0) -> World:
    """Return the world of hand and object, with the law of the model and the frictions that the task gives.

    Args:
        model: A model of the object.
        task: The task.
        chain: The hand.
        links: Its links.
        friction_factor: Factor of the frictions of links that the task gives: by how much the object's surface is more
            slippery or less than its model says.

    Raises:
        InputDataError: If the model has another contact law than that of cgwm.
    """
    alone, name = world_of_model(model, joins_others=True), free_object(model.file, task.object, task.source)
    thing = alone.bodies[alone.body_names.index(name)]
    law = alone.contact
    if not isinstance(law, ContactLaw):
        raise InputDataError(f"{model.place}: the model has the contact law of a paper.", "that of cgwm.", "fit again.")
    laws = {
        pair_of(OBJECT, f"{LINK} {link}"): replace(law, friction=torch.full_like(law.friction, friction_factor * value))
        for link, value in task.robot.friction.items()
    }
    return World(
        bodies=(*links, replace(_with_few_corners(thing, task.robot.corners), material=OBJECT)),
        gravity=alone.gravity,
        ground_normal=None,
        ground_offset=None,
        contact=law,
        pair_laws=laws,
        step_s=min(alone.step_s, task.planner.step_s),
        chains=(chain,),
        source=alone.source,
    )
