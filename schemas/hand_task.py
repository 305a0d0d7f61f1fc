"""A task of control for a hand: turn an object in it to orientations, and what may be said of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import read_toml
from .capture import Name
from .control import (
    Angle,
    ControlTask,
    Factor,
    HorizonLength,
    Knots,
    PlannerSection,
    Positive,
    Range,
    Rate,
    Samples,
    Share,
    TaskFile,
    TaskSection,
    read_task,
)
from .documents import parse_toml
from .errors import did_you_mean
from .quantities import Duration, Friction, Length, Position3, Step
from .regular_files import read_text_file

HAND_FORMAT = "cgwm-hand-task/1"
FARTHEST_DEG = 175.0
"""Largest distance of a random goal from the last that may be asked for [deg]: one of 18 orientations is as far away,
and none is farther than 180."""
Quaternion = tuple[float, float, float, float]


class HandSection(TaskSection):
    """The hand; its root does not move."""

    file: str = "hand.xml"
    """URDF or MJCF file of the hand, beside this file."""
    position_m: Position3 = (0.0, 0.0, 0.0)
    """Position of its root link [m], world frame."""
    quat_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Orientation of its root link, to world."""
    friction: dict[str, Friction] = {}
    """Friction of the object and single links, or parts of links as link/1, link/2, ... [1]; by default the model's."""
    apart: tuple[str, ...] = ()
    """Links that the object never touches; predictions without their shapes are faster."""
    corners: Annotated[int, Field(ge=4, le=200)] = 24
    """Largest number of corners of the convex shape of each part of a link, and of a convex object."""
    touching: tuple[tuple[str, str], ...] = ()
    """Pairs of links of different fingers, or of a finger and the root, that touch each other; others pass through each
    other. A link touches others as the hull of its parts, the root as its parts.
    """


class HandServoSection(TaskSection):
    """Numbers of all servos in place of those of the file; needed where it has none, as a URDF."""

    stiffness: Positive | None = None
    """Gain [N m/rad, of slides N/m]."""
    damping: Annotated[float, Field(ge=0, le=1e9)] | None = None
    """Damping [N m s/rad, of slides N s/m]."""
    armature: Annotated[float, Field(ge=0, le=1e9)] | None = None
    """Reflected inertia of the motors [kg m2, of slides kg]."""


class HandLimitsSection(TaskSection):
    """Limits that no command exceeds."""

    speed_rad_s: Positive = 8.0
    """Largest speed of a joint's target [rad/s, of slides m/s]."""
    joints: dict[str, Range] = {}
    """Smallest and largest target of single joints [rad, of slides m]; by default those of the file."""


class HandGoalSection(TaskSection):
    """How the object is wanted."""

    kind: Literal["random", "turn"] = "random"
    """random: one orientation after the other, all alike, each at least turn_deg from the last; turn: one turn."""
    position_m: Position3 | None = None
    """Where the origin of the object's frame is wanted [m]; by default where it starts."""
    axis: Position3 = (0.0, 0.0, 1.0)
    """Axis of the turn, world frame."""
    turn_deg: Annotated[float, Field(ge=0, le=180)] = 90.0
    """The turn, to either side by the seed; of random goals the least distance [deg]."""


class HandStartSection(TaskSection):
    """Where a run begins."""

    position_m: Position3 = (0.0, 0.0, 0.1)
    """Position of the origin of the object's frame [m], world frame."""
    quat_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Its orientation, body to world."""
    turn_deg: tuple[Angle, Angle] = (0.0, 0.0)
    """A further turn about the goal's axis, drawn for each seed, from and to [deg]."""
    joints: dict[str, float] = {}
    """Values of the joints [rad, of slides m], to which plans may return; left out: 0, or the nearest limit."""


class HandCostsSection(TaskSection):
    """What a plan costs: squares of errors in these units."""

    position_m: Length = 0.03
    """An error of the object's position that costs 1 [m]."""
    keep_m: Length = 0.03
    """Distance of the object from where it is wanted beyond which it may be lost [m]."""
    lost_m: Length = 0.01
    """A further distance that costs 1 [m]."""
    reach_m: Length = 0.3
    """A distance of the fingertips from the object that costs 1 [m], as a mean over fingers and horizon."""
    turn_deg: Annotated[float, Field(gt=0, le=3600)] = 30.0
    """An error of its turn that costs 1 [deg]."""
    path: Share = 1.0
    """Weight of the mean over the horizon; the error at its end has the weight 1."""
    speed_rad_s: Positive = 100.0
    """A speed of the joints that costs 1 [rad/s], as a mean over horizon and joints."""


class HandPlannerSection(PlannerSection):
    """How plans are made."""

    control_hz: Rate = 20.0
    """Commands per second [Hz]; more of them reach more goals, where the machine can hold them."""
    horizon_s: HorizonLength = 0.5
    """Length of a plan [s]."""
    knots: Knots = 10
    """Pieces of a plan, in which the targets change at constant speed."""
    samples: Samples = 16
    """Sequences of commands that are compared for a plan; plans that come in time matter more than their number."""
    step_s: Step = 0.01
    """Largest time step of a prediction [s]; contacts are softened to it."""
    patience_s: Positive = 1.0
    """Time without coming nearer to a random goal after which plans are twice as long, until the object does [s]."""
    risk: Literal["likely", "mean", "worst_quarter"] = "likely"
    """What counts of several draws of the model (--draws): the draw whose predictions of the motion seen until now were
    best; or the mean of the costs under all, or of the worst quarter, which multiplies the time of a plan.
    """


class HandSensingSection(TaskSection):
    """What the controller knows of measured states; their age is the difference of their times and that of commands."""

    noise_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the measured position, per coordinate [m]; above 0 positions are filtered."""
    noise_deg: Annotated[float, Field(ge=0, le=180)] = 0.0
    """Standard deviation of the measured rotation, per coordinate [deg]; above 0 rotations are filtered."""


class HandSuccessSection(TaskSection):
    """When a goal is reached, and when a run ends."""

    turn_deg: Annotated[float, Field(gt=0, le=180)] = 23.0
    """Largest error of the turn [deg]."""
    position_m: Length | None = None
    """Largest error of the position [m]; unset: it does not count."""
    hold_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """Time within both [s]."""
    goals: Annotated[int, Field(ge=1, le=100_000)] = 20
    """Goals after which a run has succeeded."""
    drop_m: Length = 0.15
    """Distance from where it is wanted at which the object has been dropped [m], which ends the run."""
    goal_s: Duration = 80.0
    """Time for a goal, after which a run has failed [s]."""
    timeout_s: Duration = 180.0
    """Time after which a run ends [s]."""


class HandPlantSection(TaskSection):
    """What the commands act on."""

    kind: Literal["model", "mujoco"] = "model"
    """model: the fitted model and the hand themselves; mujoco: a scene in MuJoCo."""
    scene: str = ""
    """MJCF file with the hand's joints, a position servo for each, and the object as a free body."""
    body: str = "object"
    """Name of the object in the scene."""
    friction_factor: Factor = 1.0
    """Factor of all frictions [1]."""
    mass_factor: Factor = 1.0
    """Factor of the object's mass [1]."""
    size_factor: Factor = 1.0
    """Factor of the object's size [1]."""
    delay_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Age of a measured state when it arrives [s]."""
    noise_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the measured position [m]."""
    noise_deg: Annotated[float, Field(ge=0, le=180)] = 0.0
    """Standard deviation of the measured rotation [deg]."""


class HandTask(TaskFile):
    """A task of control for a hand. Lengths are in metres; angles of joints in radians, others in degrees."""

    format: Literal["cgwm-hand-task/1"] = HAND_FORMAT
    object: Name | None = None
    """The free body of the model that is moved; may be left out where there is only one."""
    robot: HandSection = HandSection()
    servo: HandServoSection = HandServoSection()
    limits: HandLimitsSection = HandLimitsSection()
    goal: HandGoalSection = HandGoalSection()
    start: HandStartSection = HandStartSection()
    costs: HandCostsSection = HandCostsSection()
    planner: HandPlannerSection = HandPlannerSection()
    sensing: HandSensingSection = HandSensingSection()
    success: HandSuccessSection = HandSuccessSection()
    plant: HandPlantSection = HandPlantSection()

    @property
    def wanted_m(self) -> Position3:
        """Where the object is wanted [m]."""
        return self.start.position_m if self.goal.position_m is None else self.goal.position_m

    @model_validator(mode="after")
    def _complete(self) -> HandTask:
        if self.plant.kind == "mujoco" and not self.plant.scene:
            raise ValueError('plant.kind = "mujoco" needs plant.scene, an MJCF file with hand and object')
        for name, quat in (("robot", self.robot.quat_wxyz), ("start", self.start.quat_wxyz)):
            if abs(sum(value * value for value in quat) - 1) > 1e-3:
                raise ValueError(f"{name}.quat_wxyz = {list(quat)} is not of length 1")
        if not any(self.goal.axis):
            raise ValueError("goal.axis is zero")
        if self.goal.kind == "random" and self.goal.turn_deg > FARTHEST_DEG:
            raise ValueError(f"goal.turn_deg = {self.goal.turn_deg:g} of random goals is more than {FARTHEST_DEG:g}")
        if self.start.turn_deg[1] < self.start.turn_deg[0]:
            raise ValueError(f"start.turn_deg is a range [low, high]; found {list(self.start.turn_deg)}")
        return self


def read_hand_task(path: Path) -> HandTask:
    """Read a task for a hand.

    Raises:
        InputDataError: If it is missing, is no TOML, or does not fit the schema; with file, line and field.
    """
    task = read_toml(path, HandTask)
    task._source = str(path)
    return task


AnyTask = ControlTask | HandTask


def read_any_task(path: Path) -> AnyTask:
    """Read a task of either kind, as its format says.

    Raises:
        InputDataError: If it is missing, is no TOML, or does not fit the schema; with file, line and field.
    """
    found = parse_toml(read_text_file(path), path)
    return read_hand_task(path) if str(found.get("format", "")).startswith("cgwm-hand-task/") else read_task(path)


def files_of(task: AnyTask) -> tuple[str, ...]:
    """Return the files that a task names, relative to its folder."""
    if isinstance(task, ControlTask):
        return task.plant.meshes
    return (task.robot.file, *([task.plant.scene] if task.plant.scene else []))


def require_joints(task: HandTask, known: tuple[str, ...], links: tuple[str, ...], parts: tuple[str, ...] = ()) -> str:
    """Return what is wrong with the names of a task, in words; empty for nothing.

    Args:
        task: The task.
        known: Names of the joints that move.
        links: Names of the links.
        parts: Names of their further parts.
    """
    given = (
        ("[limits] joints", task.limits.joints, "joint", known),
        ("[start] joints", task.start.joints, "joint", known),
        ("[robot] friction", task.robot.friction, "link", (*links, *parts)),
        ("[robot] apart", task.robot.apart, "link", links),
        ("[robot] touching", tuple(name for pair in task.robot.touching for name in pair), "link", links),
    )
    for place, names, kind, legal in given:
        for name in names:
            if name not in legal:
                return (
                    f"{place}: the hand has no {kind} '{name}'; it has {', '.join(legal)}.{did_you_mean(name, legal)}"
                )
    for name, (low, high) in task.limits.joints.items():
        if high <= low:
            return f"[limits] joints: '{name}': a range is [low, high]; found [{low:g}, {high:g}]"
    return ""


HAND_TASKS = {
    "hand": HandTask(),
    "turn": HandTask(
        goal=HandGoalSection(kind="turn"),
        success=HandSuccessSection(goals=1, hold_s=1.0, goal_s=60.0, timeout_s=60.0),
    ),
}
"""Tasks of `cgwm control --print-task`, by name: random goals one after the other, and one turn."""
