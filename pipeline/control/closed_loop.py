"""A fitted model as one environment of a controller: a command in, a frame and the state out, step by step.

On CUDA a step is one replay of a CUDA graph: the fused kernel over all sub-steps of the control interval, then the
renderer over all spheres. On the CPU the torch engine and renderer do the same, slowly. The steps are those of one
open-loop rollout under the same commands: the impulses of contacts go on from one control step to the next.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..datasets.cameras import Camera
from ..datasets.models import Model
from ..schemas import InputDataError, NotConvergedError, UsageError
from .physics.checks import require_apart
from .physics.driven import Drive
from .physics.fused.stepping import FusedStepper
from .physics.rotation import quat_conjugate, quat_log, quat_multiply, quat_normalize, quat_rotate
from .physics.stepping import Stepper, TorchStepper
from .physics.world import State, World
from .picture import Picture

ROOM, LEAST_ROOM = 2, 65_536
"""The renderer's kernels get room for so many times the pairs of tiles and spheres that were last counted, and at least
for so many."""
_SIZES = {"position_m": 3, "quat_wxyz": 4, "velocity_m_s": 3, "omega_body_rad_s": 3}


@dataclass(frozen=True)
class Velocity:
    """Command of a driven body: velocities [m/s], [rad/s] that hold over the control interval, world frame."""

    velocity_m_s: ArrayLike | Tensor
    omega_world_rad_s: ArrayLike | Tensor = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Reach:
    """Command of a driven body: the pose at the end of the control interval, reached at constant velocities.

    position_m: of the body frame's origin, world [m]; quat_wxyz: None keeps the orientation.
    """

    position_m: ArrayLike | Tensor
    quat_wxyz: ArrayLike | Tensor | None = None


Command = Velocity | Reach


class ClosedLoop:
    """A model's world and spheres on a device, stepped by a controller.

    Args:
        model: A model with fitted physics and visual spheres.
        camera: The camera of the frames.
        control_dt_s: Length of a control interval [s]; the physics takes sub-steps in it.
        device: cpu or cuda.
        dtype: Of the physics; frames are rendered in single precision.

    Raises:
        InputDataError: If the model has no fitted physics or nothing to see, or cannot be simulated.
        UsageError: If the interval is not positive, or the kernels on CUDA cannot take the model.
    """

    def __init__(
        self,
        model: Model,
        camera: Camera,
        control_dt_s: float,
        device: str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        if not 0 < control_dt_s < float("inf"):
            raise UsageError(f"a control interval of {control_dt_s:g} s.", "above 0 s.")
        world = World.from_model(model, dtype, device)
        self._world, self._cuda = world, world.gravity.is_cuda
        self._times = torch.tensor([[0.0, control_dt_s]], dtype=torch.float64)
        stepper: Stepper = (FusedStepper if self._cuda else TorchStepper)(world, control_dt_s)
        self._stepper = stepper
        self._picture = Picture(model, camera, device)
        self._poses: dict[str, tuple[Tensor, Tensor]] | None = None
        self._steps = 0
        self._graph: _Graph | None = None

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in the order of the state."""
        return self._world.body_names

    @torch.no_grad()
    def reset(self, state: State) -> Tensor:
        """Start anew, and return the frame of the start, uint8 RGB (H, W, 3), on the device.

        Args:
            state: Of all bodies (1, nb, ...); driven and fixed ones are at rest where it puts them.

        Raises:
            InputDataError: If it has another shape, is not finite, or bodies begin deep inside each other.
        """
        world, count = self._world, len(self.body_names)
        for name, size in _SIZES.items():
            shape = tuple(getattr(state, name).shape)
            if shape != (1, count, size):
                raise InputDataError(f"the start's {name} has the shape {shape}.", f"{(1, count, size)}.")
        start = State(*(value.detach().to(world.gravity) for value in vars(state).values()))
        start = replace(start, quat_wxyz=quat_normalize(start.quat_wxyz))
        pose = (start.position_m.to("cpu", torch.float64), start.quat_wxyz.to("cpu", torch.float64))
        driven = [k for k, body in enumerate(world.bodies) if body.motion == "driven"]
        poses = {self.body_names[k]: (pose[0][:, k], quat_normalize(pose[1][:, k])) for k in driven}
        at_rest = self._typed(self._commanded(poses, {name: Velocity((0.0, 0.0, 0.0)) for name in poses}))
        require_apart(world, start)
        self._stepper.reset(start, at_rest)
        self._poses, self._steps = poses, 0
        frame, pairs = self._picture.of(start)
        if self._cuda and self._graph is None:
            capacity = _room(int(pairs))
            self._advanced(capacity)  # compiles and loads all kernels, which a capture cannot
            self._stepper.reset(start, at_rest)
            self._graph = self._captured(start, capacity)
        if self._cuda:
            torch.cuda.synchronize()
        return frame

    @torch.no_grad()
    def step(self, command: Mapping[str, Command] | None = None) -> tuple[Tensor, State]:
        """Take the environment on by one control interval.

        Args:
            command: One for every driven body, by name.

        Returns:
            The frame at its end, uint8 RGB (H, W, 3), and the state there (1, nb, ...). Both lie on the device, are
            complete, and stay as they are in later steps.

        Raises:
            UsageError: If there was no reset, a command is missing, or it is for no driven body.
            NotConvergedError: If the state does not stay finite.
        """
        if self._poses is None:
            raise UsageError("a step before the first reset.", todo="call reset(state) first.")
        drives = self._commanded(self._poses, command or {})
        self._stepper.command(self._typed(drives))
        outcome = self._graph.replayed() if self._graph is not None else self._advanced(None)
        pairs, finite = outcome.checks.tolist()  # waits for the device
        self._steps += 1
        ends = {name: (drive.position_m[:, -1], drive.quat_wxyz[:, -1]) for name, drive in drives.items()}
        self._poses = {name: (position, quat_normalize(quat)) for name, (position, quat) in ends.items()}
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
        """Return the commands of an interval that begins at the poses, float64 on the CPU."""
        if set(command) != set(poses):
            wrong = sorted(set(command) ^ set(poses))[0]
            found = f"a command for '{wrong}', which is not driven" if wrong in command else f"no command for '{wrong}'"
            raise UsageError(f"{found}.", f"one for each of: {', '.join(poses) or 'no body'}.")
        drives = {}
        for name, (position, quat) in poses.items():
            velocity, omega = self._velocities(name, command[name], position, quat)
            drives[name] = Drive.from_velocities(self._times, position, quat, velocity[:, None], omega[:, None])
        return drives

    def _typed(self, drives: Mapping[str, Drive]) -> dict[str, Drive]:
        """Return the commands in the type of the physics."""
        dtype = self._world.gravity.dtype

        def typed(value: Tensor) -> Tensor:
            return value.to(dtype) if value.is_floating_point() else value

        return {name: Drive(*map(typed, vars(drive).values())) for name, drive in drives.items()}

    def _velocities(self, name: str, command: Command, position: Tensor, quat: Tensor) -> tuple[Tensor, Tensor]:
        """Return velocity and angular velocity of a command (1, 3), world frame."""
        if isinstance(command, Velocity):
            return _row(name, command.velocity_m_s, 3), _row(name, command.omega_world_rad_s, 3)
        length = self._times[:, 1:]
        velocity = (_row(name, command.position_m, 3) - position) / length
        if command.quat_wxyz is None:
            return velocity, torch.zeros_like(velocity)
        turn = quat_log(quat_multiply(quat_conjugate(quat), quat_normalize(_row(name, command.quat_wxyz, 4))))
        return velocity, quat_rotate(quat, turn) / length

    def _advanced(self, capacity: int | None) -> _Outcome:
        """Take physics and picture on by one interval."""
        state = self._stepper.advance()
        numbers = torch.cat([getattr(state, name) for name in _SIZES], -1)
        frame, pairs = self._picture.of(state, capacity)
        checks = torch.stack((pairs.to(torch.int32), torch.isfinite(numbers).all().to(torch.int32)))
        return _Outcome(frame, numbers, checks)

    def _captured(self, state: State, capacity: int) -> _Graph:
        """Capture an interval as a CUDA graph; nothing moves meanwhile."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):  # Triton compiles, and libraries take their memory
                self._picture.of(state, capacity)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            outcome = self._advanced(capacity)
        return _Graph(graph, outcome, capacity)


@dataclass(frozen=True)
class _Outcome:
    """Of an interval: frame (H, W, 3); numbers (1, nb, 13): the state; checks (2,): pairs, and whether it is finite."""

    frame: Tensor
    numbers: Tensor
    checks: Tensor

    def state(self) -> State:
        return State(*self.numbers.clone().split(list(_SIZES.values()), -1))


@dataclass(frozen=True)
class _Graph:
    """An interval as a CUDA graph, which writes its outcome to the same place at each replay."""

    graph: torch.cuda.CUDAGraph
    outcome: _Outcome
    capacity: int

    def replayed(self) -> _Outcome:
        self.graph.replay()
        return self.outcome


def _room(pairs: int) -> int:
    return max(ROOM * pairs, LEAST_ROOM)


def _row(name: str, values: ArrayLike | Tensor, size: int) -> Tensor:
    """Return the numbers of a command as a row (1, size) on the CPU."""
    row = torch.as_tensor(values, dtype=torch.float64, device="cpu").detach()
    if row.shape != (size,) or not bool(torch.isfinite(row).all()):
        raise UsageError(f"the command of '{name}' has {row.tolist()}.", f"{size} finite numbers.")
    return row[None]
