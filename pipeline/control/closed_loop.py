"""Closed-loop simulation of a fitted model: each step takes a command and returns a frame and the state.

The fused kernel runs over all sub-steps of the control interval, then the renderer over all spheres. One environment
leaves a GPU idle, and a core of a CPU is ten times as fast at it: so physics runs on the CPU where there is a C++
compiler, on CUDA, too, where the frame is one replay of a CUDA graph. Without a compiler CUDA runs the kernel in that
graph, and a CPU the torch engine, slowly. The steps are those of one open-loop rollout under the same commands: the
contact impulses persist from one control step to the next.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ...datasets.capture.cameras import Camera
from ...datasets.models.model import Model
from ...schemas import InputDataError, NotConvergedError, UsageError, did_you_mean
from ..geometry.rotation import quat_normalize, quat_rotate, quat_turn
from ..physics.chains.chain import Chain
from ..physics.chains.joint_command import JointCommand
from ..physics.chains.state import joints_of
from ..physics.checks import require_apart
from ..physics.kinematic import Drive
from ..physics.state import State
from ..physics.surfaces.thin_walls import require_thick_walls
from .frame_renderer import FrameRenderer
from .loop_physics import SIZES, DeviceState, numbers_of, state_of, stepper_of

ROOM, LEAST_ROOM = 2, 65_536
"""Capacity for pairs of tiles and spheres in the renderer's kernels: factor of the last count, and minimum number."""


@dataclass(frozen=True)
class Velocity:
    """Command of a driven body: constant velocities over the control interval."""

    velocity_m_s: ArrayLike | Tensor
    """Velocity of the origin of the body frame [m/s], world frame, shape (3,)."""
    omega_world_rad_s: ArrayLike | Tensor = (0.0, 0.0, 0.0)
    """Angular velocity [rad/s], world frame, shape (3,)."""


@dataclass(frozen=True)
class Reach:
    """Command of a driven body: the pose at the end of the control interval, reached at constant velocities."""

    position_m: ArrayLike | Tensor
    """Position of the origin of the body frame [m], world frame, shape (3,)."""
    quat_wxyz: ArrayLike | Tensor | None = None
    """Orientation (body to world), shape (4,); None keeps the present one."""


@dataclass(frozen=True)
class Targets:
    """Command of the servos of a jointed body, under its name: their targets at the end of the control interval."""

    values: Mapping[str, float]
    """Targets by name of the joint [rad or m]; joints that are left out keep theirs."""
    hold: Literal["linear", "zero"] = "linear"
    """How a target changes: linearly over the interval, or at once at its beginning."""


Command = Velocity | Reach | Targets


class ClosedLoop:
    """A fitted model as the environment of a controller.

    Args:
        model: A model with fitted physics and visual spheres.
        camera: The camera of the frames; None for no frames, which have the shape (0, 0, 3) then.
        control_dt_s: Length of a control interval [s]; the physics divides it into sub-steps.
        device: cpu or cuda.
        dtype: Data type of the physics; frames are rendered in single precision.

    Raises:
        InputDataError: If the model has no fitted physics or no visual spheres, or cannot be simulated.
        UsageError: If the interval is not positive, the CUDA kernels do not support the model, or the root of a jointed
            body is driven.
    """

    def __init__(
        self,
        model: Model,
        camera: Camera | None,
        control_dt_s: float,
        device: str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        if not 0 < control_dt_s < float("inf"):
            raise UsageError(
                f"a control interval of {control_dt_s:g} s.", "above 0 s.", todo="give control_dt_s above 0."
            )
        driven = next((one for one in model.file.articulations if one.base == "driven"), None)
        if driven is not None:
            raise UsageError(
                f"{model.place}: the root '{driven.root}' of the jointed body '{driven.name}' is driven, and "
                "ClosedLoop moves driven bodies without joints alone.",
                'jointed bodies with base = "free" or "fixed".',
                todo="leave the driven root to a track, or make it free or fixed in the capture and fit again.",
            )
        self._times = torch.tensor([[0.0, control_dt_s]], dtype=torch.float64)
        self._cuda = torch.device(device).type == "cuda"
        self._stepper, self._world = stepper_of(model, control_dt_s, device, dtype)
        world = self._world
        self._sent = DeviceState(world, device) if self._cuda and not world.gravity.is_cuda else None
        self._picture = _NoFrames(device) if camera is None else FrameRenderer(model, camera, device)
        self._servos = [chain for chain in world.chains if chain.has_servos]
        self._targets: dict[str, Tensor] = {}
        self._poses: dict[str, tuple[Tensor, Tensor]] | None = None
        self._steps = 0
        self._graph: _Graph | None = None

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in the order of the state."""
        return self._world.body_names

    @torch.no_grad()
    def reset(self, state: State) -> Tensor:
        """Set the state, and return its frame, uint8 RGB (H, W, 3), on the device.

        Args:
            state: State of all bodies (1, nb, ...); driven and fixed bodies are at rest at the given poses. Servos
                hold the values that their joints have there.

        Raises:
            InputDataError: If the state has another shape, is not finite, or bodies interpenetrate deeply.
        """
        world, count = self._world, len(self.body_names)
        for name, size in SIZES.items():
            shape = tuple(getattr(state, name).shape)
            if shape != (1, count, size):
                raise InputDataError(
                    f"the start's {name} has the shape {shape}.",
                    f"{(1, count, size)}.",
                    todo="give states of this shape, as State of the world makes them.",
                )
        start = State(*(value.detach().to(world.gravity) for value in state.tensors))
        start = replace(start, quat_wxyz=quat_normalize(start.quat_wxyz))
        pose = (start.position_m.to("cpu", torch.float64), start.quat_wxyz.to("cpu", torch.float64))
        driven = [k for k, body in enumerate(world.bodies) if body.motion == "driven"]
        poses = {self.body_names[k]: (pose[0][:, k], quat_normalize(pose[1][:, k])) for k in driven}
        self._targets = {
            chain.name: joints_of(world, start, chain)[0].to("cpu", torch.float64) for chain in self._servos
        }
        still = self._commanded(poses, {name: Velocity((0.0, 0.0, 0.0)) for name in poses})
        at_rest = {**self._typed(still), **self._servo_commands({})}
        require_apart(world, start)
        require_thick_walls(world, start)
        self._stepper.reset(start, at_rest)
        self._poses, self._steps = poses, 0
        there = start if self._sent is None else self._sent.set(start)
        frame, pairs = self._picture.of(there)
        if self._cuda and self._graph is None:
            capacity = _room(int(pairs))
            self._advanced(capacity)  # compiles and loads all kernels, which is impossible during a capture
            self._stepper.reset(start, at_rest)
            self._graph = self._captured(there, capacity)
        if self._cuda:
            torch.cuda.synchronize()
        return frame

    @torch.no_grad()
    def step(self, command: Mapping[str, Command] | None = None) -> tuple[Tensor, State]:
        """Advance the environment by one control interval.

        Args:
            command: Command of every driven body, by name; `Targets` of jointed bodies with servos, which without any
                hold their last targets.

        Returns:
            Frame at the end of the interval, uint8 RGB (H, W, 3), and state there (1, nb, ...). Both are on the device,
            complete, and unchanged by later steps.

        Raises:
            UsageError: Before the first reset, if a command is missing, or if one is for a body that is not driven.
            NotConvergedError: If the state is no longer finite.
        """
        if self._poses is None:
            raise UsageError("a step before the first reset.", todo="call reset(state) first.")
        given = dict(command or {})
        joints = {chain.name: given.pop(chain.name) for chain in self._servos if chain.name in given}
        drives = self._commanded(self._poses, given)
        self._stepper.command({**self._typed(drives), **self._servo_commands(joints)})
        if self._sent is not None:
            self._sent.set(self._stepper.advance())
        outcome = self._graph.replayed() if self._graph is not None else self._advanced(None)
        pairs, finite = outcome.checks.tolist()  # waits for the device
        self._steps += 1
        self._poses = {name: (drive.position_m[:, -1], drive.quat_wxyz[:, -1]) for name, drive in drives.items()}
        if not finite:
            raise NotConvergedError(
                f"control step {self._steps}: the state is not finite any more.",
                todo="reset the loop; check the commands' speeds, and take a smaller step (--set phys-geo.step_s=...).",
            )
        state = outcome.state()
        if self._graph is not None and pairs > self._graph.capacity:
            self._graph = self._captured(state, _room(pairs))
            return self._picture.of(state, self._graph.capacity)[0], state
        return outcome.frame.clone(), state

    def _commanded(
        self, poses: Mapping[str, tuple[Tensor, Tensor]], command: Mapping[str, Command]
    ) -> dict[str, Drive]:
        """Return the motions of the driven bodies over an interval that starts at the poses, float64 on the CPU."""
        if set(command) != set(poses):
            wrong = sorted(set(command) ^ set(poses))[0]
            found = f"a command for '{wrong}', which is not driven" if wrong in command else f"no command for '{wrong}'"
            raise UsageError(
                f"{found}.",
                f"one for each of: {', '.join(poses) or 'no body'}.",
                todo="give one command for each body that is driven or has joints, by its name.",
            )
        drives = {}
        for name, (position, quat) in poses.items():
            wanted = command[name]
            if isinstance(wanted, Targets):
                raise UsageError(
                    f"the command of '{name}' has targets of joints.",
                    "Velocity or Reach of a driven body.",
                    todo="give Velocity or Reach for it.",
                )
            velocity, omega = self._velocities(name, wanted, position, quat)
            if bool(omega.any()):
                drive = Drive.from_velocities(
                    self._times, position, quat_normalize(quat), velocity[:, None], omega[:, None]
                )
            else:
                drive = Drive.straight(self._times, position, quat, velocity)
            drives[name] = drive
        return drives

    def _typed(self, drives: Mapping[str, Drive]) -> dict[str, Drive]:
        """Return the motions in the data type of the physics."""
        dtype = self._world.gravity.dtype
        if dtype == torch.float64:
            return dict(drives)

        def typed(value: Tensor) -> Tensor:
            return value.to(dtype) if value.is_floating_point() else value

        return {name: Drive(*map(typed, vars(drive).values())) for name, drive in drives.items()}

    def _servo_commands(self, given: Mapping[str, Command]) -> dict[str, JointCommand]:
        """Return the commands of the servos over an interval, and keep their targets at its end."""
        commands = {}
        for chain in self._servos:
            before, after = self._targets[chain.name], self._targets[chain.name].clone()
            wanted = given.get(chain.name, Targets({}))
            if not isinstance(wanted, Targets):
                raise UsageError(
                    f"the command of the jointed body '{chain.name}' is {wanted}.",
                    "Targets of its joints.",
                    todo="give Targets, by joint or for all joints.",
                )
            for name, value in wanted.values.items():
                after[0, _joint_of(chain, name)] = _row(name, [value], 1)[0, 0]
            knots = torch.stack((before, after) if wanted.hold == "linear" else (after, after), 1)
            commands[chain.name] = JointCommand.targets(self._times, knots.to(self._world.gravity.dtype))
            self._targets[chain.name] = after
        return commands

    def _velocities(
        self, name: str, command: Velocity | Reach, position: Tensor, quat: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return velocity [m/s] and angular velocity [rad/s] of a command, world frame, shape (1, 3)."""
        if isinstance(command, Velocity):
            return _row(name, command.velocity_m_s, 3), _row(name, command.omega_world_rad_s, 3)
        length = self._times[:, 1:]
        velocity = (_row(name, command.position_m, 3) - position) / length
        if command.quat_wxyz is None:
            return velocity, torch.zeros_like(velocity)
        turn = quat_turn(quat, quat_normalize(_row(name, command.quat_wxyz, 4)))
        return velocity, quat_rotate(quat, turn) / length

    def _advanced(self, capacity: int | None) -> _Outcome:
        """Return state and frame after an interval; physics of the same device advances by it here."""
        state = self._stepper.advance() if self._sent is None else self._sent.state
        numbers = numbers_of(state)
        frame, pairs = self._picture.of(state, capacity)
        checks = torch.stack((pairs.to(torch.int32), torch.isfinite(numbers).all().to(torch.int32)))
        return _Outcome(frame, numbers, checks)

    def _captured(self, state: State, capacity: int) -> _Graph:
        """Capture an interval as a CUDA graph, without advancing the state."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):  # kernels are compiled, and libraries take their memory
                self._picture.of(state, capacity)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            outcome = self._advanced(capacity)
        return _Graph(graph, outcome, capacity)


class _NoFrames:
    """Renderer of nothing, for loops without a camera."""

    def __init__(self, device: str) -> None:
        self._frame = torch.zeros(0, 0, 3, dtype=torch.uint8, device=device)

    def of(self, state: State, capacity: int | None = None) -> tuple[Tensor, Tensor]:
        """Return an empty frame, and no pairs."""
        return self._frame, torch.zeros((), dtype=torch.int32, device=self._frame.device)


def _joint_of(chain: Chain, name: str) -> int:
    """Return the column of a joint with a servo."""
    known = [joint.name for joint in chain.moving if bool((joint.stiffness > 0).any())]
    if name not in known:
        near = did_you_mean(name, known)
        raise UsageError(
            f"'{chain.name}' has no joint '{name}' with a servo.",
            ", ".join(known) + "." + near,
            todo="name a joint of this list; which have a servo is in the [[articulations]] of the model.",
        )
    return chain.joint_names.index(name)


@dataclass(frozen=True)
class _Outcome:
    """Result of a control interval."""

    frame: Tensor
    """Frame at its end, shape (H, W, 3)."""
    numbers: Tensor
    """State at its end: position, orientation, velocity, angular velocity; shape (1, nb, 13)."""
    checks: Tensor
    """Number of pairs of tiles and spheres, and whether the state is finite, shape (2,)."""

    def state(self) -> State:
        return state_of(self.numbers.clone())


@dataclass(frozen=True)
class _Graph:
    """A control interval as a CUDA graph, which writes its result to the same tensors at each replay."""

    graph: torch.cuda.CUDAGraph
    """The graph."""
    outcome: _Outcome
    """Tensors that the graph writes to."""
    capacity: int
    """Number of pairs of tiles and spheres that fit."""

    def replayed(self) -> _Outcome:
        self.graph.replay()
        return self.outcome


def _room(pairs: int) -> int:
    return max(ROOM * pairs, LEAST_ROOM)


def _row(name: str, values: ArrayLike | Tensor, size: int) -> Tensor:
    """Return the values of a command as a row (1, size), float64 on the CPU."""
    row = torch.as_tensor(values, dtype=torch.float64, device="cpu").detach()
    if row.shape != (size,) or not bool(torch.isfinite(row).all()):
        raise UsageError(
            f"the command of '{name}' has {row.tolist()}.",
            f"{size} finite numbers.",
            todo="give finite numbers, one for each joint.",
        )
    return row[None]
