"""The world of a task of control: the object, fixed bodies and the finger, and what the task may not ask of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull
from torch import Tensor

from ...datasets.models.joints import refuse_joints
from ...datasets.models.laws import refuse_paper_law
from ...datasets.models.model import Model
from ...datasets.shapes.ply import Splats
from ...schemas import BodyModel, ControlTask, InputDataError, ModelFile, did_you_mean
from ..geometry.rotation import quat_multiply, quat_to_matrix
from ..physics.body import Body
from ..physics.checks import DEEPEST_SHARE, overlaps, require_apart
from ..physics.contact_law import ContactLaw
from ..physics.model_world import world_of_model
from ..physics.paper_law import PaperLaw
from ..physics.state import State
from ..physics.world import World
from .goal import PlanarGoal, turned

LEVEL_DEG = 1.0
"""Largest tilt of the ground: the finger moves along x and y."""
SOFTEST_STEPS = 0.6
"""Contact time of a prediction in units of its step: a push is slow, and its friction does not depend on it."""
SHELL_M = 0.008
"""Largest distance of neighbouring balls of a surface [m], less than the finger's radius."""
_DENSITY_KG_M3 = 1000.0


@dataclass(frozen=True, kw_only=True)
class TaskWorld:
    """A task of control with the world that it is about."""

    task: ControlTask
    """The task."""
    model: Model
    """The model with the finger as a driven body, and without bodies that take no part."""
    world: World
    """The world of that model, batch 1, float64 on the CPU."""
    object: int
    """Index of the object."""
    finger: int
    """Index of the finger."""
    goal: PlanarGoal
    """The goal."""
    finger_z: float
    """Height of the finger's centre, world frame [m]."""
    surface: tuple[np.ndarray, np.ndarray]
    """Centres (n, 3) and radii (n,) of balls that make up the object's surface, in its frame [m]."""

    def planning(self, world: World | None = None) -> World:
        """Return a world for predictions in the steps of the planner, whose contacts are soft enough for these steps.

        Args:
            world: A world with other parameters; None for that of the model.
        """
        return softened(world or self.world, self.task.planner.step_s)

    def pose(self, position_m: ArrayLike, turn_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position (3,) [m] and orientation (4,) of the object where its spheres touch the ground.

        Args:
            position_m: x and y of the origin of its frame [m].
            turn_rad: Turn about z relative to the photos [rad].
        """
        reference = self.goal.reference_wxyz
        quat = quat_multiply(turned(turn_rad, reference), reference)
        body = self.world.bodies[self.object]
        lowest = float(((body.centers[0] @ quat_to_matrix(quat).T)[:, 2] - body.radii[0]).min())
        return np.array([*np.asarray(position_m, float), ground_z(self.world) - lowest]), quat.numpy()

    def state(
        self,
        position_m: ArrayLike,
        quat_wxyz: ArrayLike,
        finger_m: ArrayLike,
        velocity_m_s: ArrayLike = (0.0, 0.0, 0.0),
        omega_body_rad_s: ArrayLike = (0.0, 0.0, 0.0),
    ) -> State:
        """Return the state (1, nb, ...) of all bodies from pose and velocities of the object and x, y of the finger."""
        values = fixed_values(self.world)
        for index, given in ((self.object, (position_m, quat_wxyz, velocity_m_s, omega_body_rad_s)),
                             (self.finger, ((*np.asarray(finger_m, float), self.finger_z),))):  # fmt: skip
            for field, value in zip(values, given, strict=False):
                field[0, index] = torch.as_tensor(np.asarray(value, float))
        return State(*values)


def fixed_values(world: World) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the fields of a state (1, nb, ...) with all bodies at rest where the photos show them."""
    count = len(world.bodies)
    position, velocity, omega = (torch.zeros(1, count, 3, dtype=torch.float64) for _ in range(3))
    quat = torch.zeros(1, count, 4, dtype=torch.float64)
    quat[..., 0] = 1.0
    for index, body in enumerate(world.bodies):
        if body.place is not None:
            position[0, index], quat[0, index] = body.place[0, :3], body.place[0, 3:]
    return position, quat, velocity, omega


def ground_z(world: World) -> float:
    """Return the height of a level ground [m]."""
    normal, offset = world.ground
    return float(offset[0] / normal[2])


def task_world(model: Model, task: ControlTask) -> TaskWorld:
    """Return the world of a task.

    Args:
        model: A model with fitted physics.
        task: The task.

    Raises:
        InputDataError: If the model has no physics, no scale, no level ground, joints or several free bodies; if it
            has no such object; if the goal is out of reach or within a fixed body; or if the finger cannot touch the
            object.
    """
    require_rigid(model)
    require_metric(model)
    name = free_object(model.file, task.object, task.source)
    file, collision = _with_finger(model, task, name)
    reduced = replace(model, file=file, collision=collision)
    world = world_of_model(reduced)
    _require_level(world, model)
    pose = model.body(name).photo_pose
    goal = PlanarGoal(
        position_m=torch.tensor(task.goal.position_m, dtype=torch.float64),
        turn_rad=math.radians(task.goal.turn_deg),
        reference_wxyz=torch.tensor(pose.quat_wxyz, dtype=torch.float64),
    )
    found = TaskWorld(
        task=task,
        model=reduced,
        world=world,
        object=world.body_names.index(name),
        finger=world.body_names.index(task.robot.name),
        goal=goal,
        finger_z=ground_z(world) + task.robot.height_m,
        surface=_surface_of(world.bodies[world.body_names.index(name)]),
    )
    _require_touch(found)
    _require_reach(found)
    return found


def softened(world: World, step_s: float) -> World:
    """Return a world for predictions in steps [s], with contacts that are soft enough for these steps."""

    def soft(law: ContactLaw | PaperLaw) -> ContactLaw | PaperLaw:
        if not isinstance(law, ContactLaw):
            return law
        time, ratio = law.contact_time_s.clamp_min(SOFTEST_STEPS * step_s), law.damping_ratio.clamp_min(1.0)
        return replace(law, contact_time_s=time, damping_ratio=ratio)

    laws = {pair: soft(law) for pair, law in world.pair_laws.items()}
    return replace(world, contact=soft(world.contact), pair_laws=laws, step_s=step_s)


def require_rigid(model: Model) -> None:
    """Check that a model has no jointed bodies, and the contact law that control knows to soften.

    Raises:
        InputDataError: If it has joints, or another law.
    """
    refuse_paper_law(model.file, model.place, "control")
    instead = "the object is one rigid body; the Python API's ClosedLoop steps jointed ones (docs/python-api.md)"
    refuse_joints(model.file.articulations, model.place, "control", instead)


def require_metric(model: Model) -> None:
    """Check that a model has a scale.

    Raises:
        InputDataError: If it has none.
    """
    if model.cameras is not None and model.cameras.scale.kind == "unscaled":
        raise InputDataError(
            f"{model.place}: the model has no scale: its cameras are unscaled.",
            "a metric model: commands are in metres.",
            "give a source of scale in capture.toml, under [calibration], and calibrate and fit again.",
        )


def free_object(file: ModelFile, wanted: str | None, source: str) -> str:
    """Return the name of the object, the only free body of a model.

    Args:
        file: The model.
        wanted: The name that a task gives.
        source: The task, for messages.

    Raises:
        InputDataError: If the model has no such body, or not one alone.
    """
    free = [body.name for body in file.bodies if body.motion == "free"]
    if wanted is not None and wanted not in free:
        raise InputDataError(
            f"{source}: object = '{wanted}' is no free body of the model.",
            f"{', '.join(free) or 'none, the model has no free body'}.{did_you_mean(wanted, free)}",
            "correct the name.",
        )
    if len(free) != 1:
        raise InputDataError(
            f"{source}: the model has {len(free)} free bodies{': ' * bool(free)}{', '.join(free)}.",
            "one: the object; where others go is not predicted.",
            "fit a capture of the object alone.",
        )
    return free[0]


def _with_finger(model: Model, task: ControlTask, name: str) -> tuple[ModelFile, dict[str, Splats]]:
    """Return the file and the colliding spheres of the model with the finger as its only driven body."""
    robot, file = task.robot, model.file
    lender = next((body for body in file.bodies if body.name == robot.name), None)
    if lender is not None and lender.motion != "driven":
        raise InputDataError(
            f"{task.source}: [robot] name = '{robot.name}' is a {lender.motion} body of the model.",
            "a name that the model does not have, or that of a driven body.",
            "rename the robot.",
        )
    radius = robot.radius_m
    mass = _DENSITY_KG_M3 * 4 / 3 * math.pi * radius**3
    moment = max(0.4 * mass * radius**2, 1e-12)
    finger = BodyModel(
        name=robot.name,
        motion="driven",
        mass_kg=max(mass, 1e-9),
        inertia_kg_m2=(moment, moment, moment, 0.0, 0.0, 0.0),
        com_m=(0.0, 0.0, 0.0),
        material=None if lender is None else lender.material,
        radius_factor=1.0,
    )
    ball = Splats(np.zeros((1, 3)), np.array([radius]), np.array([0.95]), np.array([[0.9, 0.3, 0.2]]))
    kept = [body for body in file.bodies if body.name == name or body.motion == "fixed"]
    bodies = (*kept, finger)
    collision = {body.name: model.collision[body.name] for body in kept} | {robot.name: ball}
    return file.model_copy(update={"bodies": bodies}), collision


def _require_level(world: World, model: Model) -> None:
    if world.ground_normal is None:
        raise InputDataError(
            f"{model.place}: the model has no ground.", "a level ground.", "give it in capture.toml, under [world]."
        )
    tilt = math.degrees(math.acos(min(1.0, float(world.ground_normal[2]))))
    if tilt > LEVEL_DEG:
        raise InputDataError(
            f"{model.place}: the ground is tilted by {tilt:.1f} deg.",
            f"up to {LEVEL_DEG:g} deg: the finger moves along x and y.",
            "align the world's z axis with the ground's normal.",
        )


def _require_touch(found: TaskWorld) -> None:
    """Check that the finger is above the ground and can touch the object."""
    robot, source = found.task.robot, found.task.source
    if robot.height_m < robot.radius_m:
        raise InputDataError(
            f"{source}: [robot] height_m = {robot.height_m:g} m is less than radius_m: the finger is in the ground.",
            f"{robot.radius_m:g} m or more.",
            "raise height_m.",
        )
    pose = found.pose((0.0, 0.0), 0.0)
    if not len(outline(found, *pose)[1]):
        body = found.world.bodies[found.object]
        top = float((body.centers[0] @ quat_to_matrix(torch.as_tensor(pose[1])).T)[:, 2].max()) + pose[0][2]
        raise InputDataError(
            f"{source}: at the height {robot.height_m:g} m the finger passes over the object.",
            f"up to about {top + robot.radius_m - ground_z(found.world):.3g} m.",
            "lower height_m.",
        )


def _require_reach(found: TaskWorld) -> None:
    """Check that the finger can touch the object from all sides at the goal, and that nothing fixed is there."""
    task, goal = found.task, found.task.goal
    pose = found.pose(goal.position_m, found.goal.turn_rad)
    centers, radii = outline(found, *pose)
    for axis, joint in enumerate(("x", "y")):
        low, high = task.limits.joints[joint]
        first, last = float((centers[:, axis] - radii).min()), float((centers[:, axis] + radii).max())
        if first < low or last > high:
            raise InputDataError(
                f"{task.source}: the goal at {joint} = {goal.position_m[axis]:g} m is out of reach: to push from all "
                f"sides the finger has to go from {first:.3f} to {last:.3f} m.",
                f"joint '{joint}': {low:g} to {high:g} m, [limits] joints.",
                "move the goal, or widen the limits if the robot can.",
            )
    away = (float((centers - radii[:, None])[:, 0].min()) - 1.0, goal.position_m[1])
    for overlap in overlaps(found.world, found.state(*pose, away)):
        if overlap.body == found.world.body_names[found.object] and overlap.other != "the ground":
            depth, most = float(overlap.depth_m.max()), DEEPEST_SHARE * float(overlap.size_m.min())
            if depth > most:
                raise InputDataError(
                    f"{task.source}: the goal is {1e3 * depth:.1f} mm inside {overlap.other}.",
                    "a goal where the object has room.",
                    "move the goal.",
                )


def require_start(found: TaskWorld, state: State, name: str) -> None:
    """Check that nothing begins deep inside of something else, such as the object in the finger.

    Raises:
        InputDataError: If it does.
    """
    require_apart(found.world, state, f"{found.task.source}, {name}")


def outline(found: TaskWorld, position_m: ArrayLike, quat_wxyz: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (n, 2) and radii (n,) [m] of the discs that the centre of the finger cannot enter.

    At the height of the finger a sphere of the object with radius r, at the height difference d, keeps the centre of a
    ball with radius R at the distance sqrt((r + R)^2 - d^2).

    Args:
        found: The task.
        position_m: Position of the object [m], shape (3,).
        quat_wxyz: Its orientation, shape (4,).
    """
    rotation = quat_to_matrix(torch.as_tensor(np.asarray(quat_wxyz, float))).numpy()
    centers = found.surface[0] @ rotation.T + np.asarray(position_m, float)
    square = (found.surface[1] + found.task.robot.radius_m) ** 2 - (centers[:, 2] - found.finger_z) ** 2
    touched = square > 0
    return centers[touched, :2], np.sqrt(square[touched])


def _surface_of(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Return the spheres of a body; of one that fills their hull, balls along the hull's faces."""
    centers, radii = body.centers[0].numpy(), body.radii[0].numpy()
    if body.hull is None:
        return centers, radii
    found = [(centers, radii)]
    for corners in ConvexHull(centers).simplices:
        longest = max(np.linalg.norm(centers[a] - centers[b]) for a, b in combinations(corners, 2))
        share = np.linspace(0, 1, max(2, math.ceil(longest / SHELL_M) + 1))
        first, second = (grid.ravel() for grid in np.meshgrid(share, share))
        inside = first + second <= 1 + 1e-9
        weights = np.stack((first, second, 1 - first - second), -1)[inside].clip(0)
        found.append((weights @ centers[corners], weights @ radii[corners]))
    return np.concatenate([part[0] for part in found]), np.concatenate([part[1] for part in found])
