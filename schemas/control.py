"""A task of control, `TASK.toml`, and what `cgwm control` reports."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PrivateAttr, model_validator

from .base import FileModel, read_toml
from .capture import Name
from .errors import did_you_mean
from .field_texts import field_texts
from .quantities import Coordinate, Duration, Friction, Length, Mass, Step
from .toml_text import toml_value

TASK_FORMAT = "cgwm-task/1"
CONTROL_FORMAT = "cgwm-control/1"
SolverName = Literal["mppi", "gauss-newton", "both"]
ClockName = Literal["real", "ideal"]

JOINTS: tuple[str, ...] = ("x", "y")
"""Joints of the finger: the world coordinates of its centre along the ground."""

Angle = Annotated[float, Field(ge=-3600, le=3600)]
"""[deg]."""
Range = tuple[Coordinate, Coordinate]
Place = tuple[Coordinate, Coordinate]
"""x and y [m], world frame."""
Factor = Annotated[float, Field(ge=0.1, le=10)]
Positive = Annotated[float, Field(gt=0, le=1e9)]
Share = Annotated[float, Field(ge=0, le=1)]
Rate = Annotated[float, Field(ge=0.1, le=10_000)]
"""[Hz]."""
HorizonLength = Annotated[float, Field(ge=1e-3, le=60)]
"""[s]."""
Knots = Annotated[int, Field(ge=1, le=1000)]
Samples = Annotated[int, Field(ge=4, le=1_000_000)]


class TaskSection(FileModel):
    """A part of a task; `task_toml` writes the texts of its fields as comments."""


class TaskFile(TaskSection):
    """A task as a file has it."""

    _source: str = PrivateAttr("the task")

    @property
    def source(self) -> str:
        """Where the task comes from, for messages: its file where it was read from one."""
        return self._source

    @property
    def folder(self) -> Path:
        """Folder that the files of the task are relative to."""
        return Path(self._source).parent if self._source != "the task" else Path()


class RobotSection(TaskSection):
    """What acts: a finger, a ball that moves in the plane on position servos."""

    kind: Literal["finger"] = "finger"
    """finger: a ball with the joints x and y [m], at a constant height."""
    name: Name = "finger"
    """Name of the finger. A driven body of the model with this name lends it its material and its picture."""
    radius_m: Length = 0.012
    """Radius of the ball [m]."""
    height_m: Length = 0.03
    """Height of its centre above the ground [m]."""


class ServoSection(TaskSection):
    """The servos of the plant's joints."""

    stiffness_n_m: Positive = 2000.0
    """Gain: force by distance from the target [N/m]."""
    damping_ratio: Positive = 1.0
    """Damping by that of critical damping [1]."""
    mass_kg: Mass = 0.2
    """Mass that each servo moves [kg]."""


class LimitsSection(TaskSection):
    """Limits that no command exceeds."""

    speed_m_s: Positive = 0.3
    """Largest speed of a joint's target [m/s]."""
    joints: dict[str, Range] = {"x": (-0.45, 0.45), "y": (-0.45, 0.45)}
    """Smallest and largest target of each joint [m]."""

    @model_validator(mode="after")
    def _of_the_robot(self) -> LimitsSection:
        for name, (low, high) in self.joints.items():
            if name not in JOINTS:
                raise ValueError(
                    f"the robot has no joint '{name}'; its joints are {', '.join(JOINTS)}.{did_you_mean(name, JOINTS)}"
                )
            if high <= low:
                raise ValueError(f"joint '{name}': a range is [low, high]; found [{low:g}, {high:g}]")
        missing = [name for name in JOINTS if name not in self.joints]
        if missing:
            raise ValueError(f"joint '{missing[0]}' has no limits")
        return self


class GoalSection(TaskSection):
    """Where the object is wanted."""

    position_m: Place = (0.0, 0.0)
    """Position of the origin of the object's frame along the ground, x and y [m]."""
    turn_deg: Angle = 0.0
    """Turn about the ground's normal, relative to the photos [deg]."""


class StartSection(TaskSection):
    """Where a run begins; what is left out is drawn for each seed."""

    within_m: Length = 0.25
    """Largest distance of the object from the goal [m]; all places alike."""
    turn_deg: tuple[Angle, Angle] = (-180.0, 180.0)
    """Turn of the object relative to the photos, from and to [deg]."""
    position_m: Place | None = None
    """Position of the object, in place of `within_m` [m]."""
    finger_m: Place | None = None
    """Position of the finger [m]; by default 5 cm beside the object, in any direction."""


class CostsSection(TaskSection):
    """What a plan costs: squares of errors in these units."""

    position_m: Length = 0.01
    """An error of the object's position that costs 1 [m]."""
    turn_deg: Annotated[float, Field(gt=0, le=3600)] = 10.0
    """An error of its turn that costs 1 [deg]."""
    path: Share = 0.3
    """Weight of the mean over the horizon; the error at its end has the weight 1."""
    speed_m_s: Positive = 3.0
    """A speed of the finger that costs 1 [m/s], as a mean over the horizon."""
    reach_m: Length = 1.0
    """A distance of the finger from the object that costs 1 [m], as a mean over the horizon: it leads a finger that is
    too far away to touch the object within the horizon."""


class PlannerSection(TaskSection):
    """How plans are made."""

    control_hz: Rate = 30.0
    """Commands per second [Hz]."""
    horizon_s: HorizonLength = 1.5
    """Length of a plan [s]."""
    knots: Knots = 15
    """Pieces of constant speed in a plan."""
    samples: Samples = 32
    """Sequences of commands that are compared for a plan."""
    step_s: Step = 0.01
    """Largest time step of a prediction [s]."""
    risk: Literal["likely", "mean", "worst_quarter"] = "mean"
    """What counts of the costs under several draws of the model (--draws): their mean, or that of the worst quarter."""
    bad_states: Annotated[int, Field(ge=1, le=1_000_000)] = 30
    """States in a row that are missing, stale or no numbers, after which a run stops."""

    @model_validator(mode="after")
    def _holds_a_command(self) -> PlannerSection:
        if self.horizon_s < 1 / self.control_hz:
            raise ValueError(
                f"horizon_s = {self.horizon_s:g} s is shorter than one command, which lasts 1/control_hz = "
                f"{1 / self.control_hz:g} s"
            )
        if self.knots * self.step_s > self.horizon_s * (1 + 1e-9):
            raise ValueError(
                f"{self.knots} knots in {self.horizon_s:g} s are closer together than step_s = {self.step_s:g} s"
            )
        return self


class SuccessSection(TaskSection):
    """When the goal is reached."""

    position_m: Length = 0.01
    """Largest error of the position [m]."""
    turn_deg: Annotated[float, Field(gt=0, le=180)] = 5.0
    """Largest error of the turn [deg]."""
    hold_s: Annotated[float, Field(ge=0, le=3600)] = 0.5
    """Time within both [s]."""
    timeout_s: Duration = 60.0
    """Time after which a run has failed [s]."""


class PlantSection(TaskSection):
    """What the commands act on."""

    kind: Literal["model", "mujoco"] = "model"
    """model: the fitted model itself; mujoco: MuJoCo with the object's true mesh."""
    meshes: tuple[str, ...] = ()
    """Convex parts of the object's true mesh (.obj or .stl), beside this file, in the object's frame [m]."""
    friction: Friction | None = None
    """True friction of object and ground [1]; by default that of the model."""
    finger_friction: Friction | None = None
    """True friction of object and finger [1]; by default that of the model."""
    mass_kg: Mass | None = None
    """True mass of the object [kg]; by default that of the model."""
    friction_factor: Factor = 1.0
    """Factor of both frictions [1]."""
    mass_factor: Factor = 1.0
    """Factor of the mass [1]."""
    size_factor: Factor = 1.0
    """Factor of the object's size [1]."""
    delay_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Age of a measured state when it arrives [s]."""
    noise_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the measured position [m]."""
    noise_deg: Annotated[float, Field(ge=0, le=180)] = 0.0
    """Standard deviation of the measured rotation [deg]."""
    step_s: Step = 0.002
    """Time step of MuJoCo [s]."""


class ControlTask(TaskFile):
    """A task of control. Lengths are in metres, angles in degrees; the plane is the model's ground."""

    format: Literal["cgwm-task/1"] = TASK_FORMAT
    object: Name | None = None
    """The free body of the model that is moved; may be left out where there is only one."""
    robot: RobotSection = RobotSection()
    servo: ServoSection = ServoSection()
    limits: LimitsSection = LimitsSection()
    goal: GoalSection = GoalSection()
    start: StartSection = StartSection()
    costs: CostsSection = CostsSection()
    planner: PlannerSection = PlannerSection()
    success: SuccessSection = SuccessSection()
    plant: PlantSection = PlantSection()

    @model_validator(mode="after")
    def _complete(self) -> ControlTask:
        if self.plant.kind == "mujoco" and not self.plant.meshes:
            raise ValueError('plant.kind = "mujoco" needs plant.meshes, the convex parts of the object\'s true mesh')
        if self.planner.risk == "likely":
            raise ValueError('planner.risk = "likely" is for hands; a push has "mean" or "worst_quarter"')
        if self.start.turn_deg[1] < self.start.turn_deg[0]:
            raise ValueError(f"start.turn_deg is a range [low, high]; found {list(self.start.turn_deg)}")
        return self


def read_task(path: Path) -> ControlTask:
    """Read a task.

    Raises:
        InputDataError: If it is missing, is no TOML, or does not fit the schema; with file, line and field.
    """
    task = read_toml(path, ControlTask)
    task._source = str(path)
    return task


def task_toml(task: TaskSection) -> str:
    """Return a task as TOML to edit: fields are explained, unset ones commented out."""
    kind = type(task)
    lines, texts = [f"# {_told(kind.__doc__ or '')}"], field_texts(kind)
    for name in kind.model_fields:
        value = getattr(task, name)
        if not isinstance(value, TaskSection):
            lines += _entry(name, value, texts.get(name, "The version of this format."))
    for name in kind.model_fields:
        section = getattr(task, name)
        if isinstance(section, TaskSection):
            lines += ["", f"# {_told(type(section).__doc__ or '')}", f"[{name}]"]
            texts = field_texts(type(section))
            for key in type(section).model_fields:
                lines += _entry(key, getattr(section, key), texts.get(key, ""))
    return "\n".join(lines) + "\n"


def _told(text: str) -> str:
    return " ".join(text.split())


def _entry(name: str, value: object, text: str) -> list[str]:
    return ["", f"# {_told(text)}", f"# {name} =" if value is None else f"{name} = {toml_value(value)}"]


TASKS = {"push": ControlTask()}
"""Tasks of `cgwm control --print-task`, by name."""

Milliseconds = Annotated[float, Field(ge=0, le=1e9)]


class ControlRun(FileModel):
    """One run of a task."""

    seed: int
    ended: Literal["success", "timeout", "bad_states", "diverged", "dropped"]
    """Why it ended."""
    time_s: Annotated[float, Field(ge=0, le=1e6)]
    """Time of the plant at its end [s]."""
    position_error_m: Annotated[float, Field(ge=0, le=1e8)]
    """At its end [m]."""
    turn_error_deg: Annotated[float, Field(ge=0, le=180)]
    """At its end [deg]."""
    start_position_error_m: Annotated[float, Field(ge=0, le=1e8)]
    start_turn_error_deg: Annotated[float, Field(ge=0, le=180)]
    goals: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Goals that were reached, of a hand."""
    commands: int
    """Commands that were sent."""
    plans: int
    late_plans: int
    """Plans that took longer than the interval of a command, so that the commands of the plan before went on."""
    held_commands: int
    """Commands that were held because a state was missing, stale or no number."""
    plan_ms: Milliseconds
    """Median duration of a plan, wall time [ms]."""
    plan_ms_95: Milliseconds
    """Its 95th percentile [ms]."""
    plan_cpu_ms: Milliseconds
    """Median time of all processors for a plan [ms]."""
    largest_force_n: Annotated[float, Field(ge=0, le=1e12)]
    """Largest contact force of the finger on the object; of a hand, sum of the sizes of all contact forces on it; means
    over the interval of a command [N].
    """


class ControlResult(FileModel):
    """`cgwm control --json`, and `control.json`."""

    format: Literal["cgwm-control/1"] = CONTROL_FORMAT
    model: str
    task: str
    object: str
    solver: SolverName
    clock: ClockName
    plant: Literal["model", "mujoco"]
    goals: int = 0
    """Goals that were reached in all runs, of a hand."""
    draws: int
    """Draws of the model that each plan is evaluated under; 0: the estimate alone."""
    device: str
    control_hz: Annotated[float, Field(gt=0)]
    """The rate that the task asks for [Hz]."""
    reached_hz: Annotated[float, Field(ge=0)]
    """The rate that the plans could hold: 1 / their median duration [Hz]."""
    sentence: str
    """The outcome in words."""
    advice: str = ""
    """What would make the rate hold; empty where it held."""
    successes: int
    success_rate: Share
    success_interval_95: tuple[Share, Share]
    """Wilson's interval of the rate."""
    median_time_s: float | None = None
    """Of the successful runs [s]."""
    runs: tuple[ControlRun, ...]
    recording: str
    """HDF5 file of states, commands, plans and times, in the same folder."""
    page: str
    """File of the page, in the same folder."""
    video: str | None = None
    """Film of plant and prediction, in the same folder; null where the model has no visual spheres."""
    recording_sha256: str
    """SHA-256 of the recording."""
    input_sha256: dict[str, str] = {}
    settings: dict[str, str] = {}
    """What was asked for, by name."""
    versions: dict[str, str] = {}
    warnings: tuple[str, ...] = ()
