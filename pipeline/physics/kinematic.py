"""Commanded motions of kinematic bodies, from measured tracks or from velocities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ...schemas import InputDataError
from ..geometry.rotation import quat_exp, quat_multiply, quat_rotate, quat_turn
from .chains.joint_command import JointCommand
from .rigid_body import Motion

if TYPE_CHECKING:
    from ...datasets.capture.tracks import Track


@dataclass(frozen=True)
class Drive:
    """Commanded motions of a batch, linear in position and angle between samples and at rest outside them."""

    times_s: Tensor
    """Times of the samples [s], shape (B, S)."""
    position_m: Tensor
    """Origin of the body frame, world frame [m], shape (B, S, 3)."""
    quat_wxyz: Tensor
    """Orientation, body to world, shape (B, S, 4)."""
    velocity_m_s: Tensor
    """Velocity from each sample to the next, world frame [m/s], shape (B, S, 3)."""
    omega_world_rad_s: Tensor
    """Angular velocity from each sample to the next, world frame [rad/s], shape (B, S, 3)."""
    last: Tensor
    """Index of the last interval, shape (B,); shorter tracks are padded with their last sample."""

    @staticmethod
    def of(tracks: Sequence[Track], like: Tensor) -> Drive:
        """Build the commands of a batch from one track per rollout, or one for all, with dtype and device of `like`."""
        longest = max(len(track.time_s) for track in tracks)
        rows = [_prepare(track, longest, like) for track in tracks]
        return Drive(*(torch.stack(column) for column in zip(*rows, strict=True)))

    @staticmethod
    def command(body: str, driven: Mapping[str, Track | Drive | JointCommand], like: Tensor) -> Drive:
        """Return the command of a driven body as a `Drive`.

        Raises:
            InputDataError: If the body has no command.
        """
        if body not in driven:
            raise InputDataError(
                f"the driven body '{body}' has no track in this episode; its track is its command.",
                todo=f"add rows for '{body}' to the episode's tracks file.",
            )
        command = driven[body]
        if isinstance(command, JointCommand):
            raise InputDataError(
                f"the driven body '{body}' has a command of joints.",
                "a track, or a Drive.",
                todo="give a track or a Drive; commands of joints belong to jointed bodies.",
            )
        return command if isinstance(command, Drive) else Drive.of([command], like)

    @staticmethod
    def from_velocities(
        times_s: Tensor, position_m: Tensor, quat_wxyz: Tensor, velocity_m_s: Tensor, omega_world_rad_s: Tensor
    ) -> Drive:
        """Integrate a velocity command in which each velocity holds until the next sample.

        Args:
            times_s: Samples [s], increasing, shape (B, S).
            position_m: Position at the first sample [m], shape (B, 3).
            quat_wxyz: Orientation there, shape (B, 4).
            velocity_m_s: Velocity of the frame's origin from each sample to the next [m/s], shape (B, S - 1, 3).
            omega_world_rad_s: Angular velocity, world frame [rad/s], shape (B, S - 1, 3).
        """
        length = times_s.diff(dim=1)[..., None]
        position = torch.cat((position_m[:, None], position_m[:, None] + (velocity_m_s * length).cumsum(1)), 1)
        quats = [quat_wxyz]
        for turn in (omega_world_rad_s * length).unbind(1):
            quats.append(quat_multiply(quat_exp(turn), quats[-1]))
        still = torch.zeros_like(position_m)[:, None]
        last = torch.full(times_s.shape[:1], times_s.shape[1] - 2, device=times_s.device)
        velocity, omega = (torch.cat((x, still), 1) for x in (velocity_m_s, omega_world_rad_s))
        return Drive(
            times_s=times_s,
            position_m=position,
            quat_wxyz=torch.stack(quats, 1),
            velocity_m_s=velocity,
            omega_world_rad_s=omega,
            last=last,
        )

    @staticmethod
    def straight(times_s: Tensor, position_m: Tensor, quat_wxyz: Tensor, velocity_m_s: Tensor) -> Drive:
        """Return a motion at a constant velocity between two samples, without a turn, in few operations.

        Args:
            times_s: The samples [s], shape (B, 2).
            position_m: Position at the first sample [m], shape (B, 3).
            quat_wxyz: Orientation, shape (B, 4).
            velocity_m_s: Velocity of the frame's origin [m/s], shape (B, 3).
        """
        end = torch.addcmul(position_m, velocity_m_s, times_s[:, 1:] - times_s[:, :1])
        still = torch.zeros_like(position_m)
        return Drive(
            times_s=times_s,
            position_m=torch.stack((position_m, end), 1),
            quat_wxyz=torch.stack((quat_wxyz, quat_wxyz), 1),
            velocity_m_s=torch.stack((velocity_m_s, still), 1),
            omega_world_rad_s=torch.stack((still, still), 1),
            last=torch.zeros(len(times_s), dtype=torch.long, device=times_s.device),
        )

    def repeat(self, times: int) -> Drive:
        """Return the commands with their batch repeated, as `Tensor.repeat` does."""
        if self.times_s.shape[0] == 1:
            return self
        every = (getattr(self, field.name) for field in fields(self))
        return Drive(*(values.repeat(times, *[1] * (values.ndim - 1)) for values in every))

    def select(self, rows: Tensor) -> Drive:
        """Return the commands at some rows of the batch."""
        return Drive(*(getattr(self, field.name)[rows] for field in fields(self)))

    def at(self, time_s: Tensor) -> Motion:
        """Return pose and velocity at times (B,) or (1,) [s]; the spin is the angular velocity, world frame [rad/s]."""
        batch = max(time_s.shape[0], self.times_s.shape[0])
        time = time_s.expand(batch)
        grid = self.times_s.expand(batch, -1).contiguous()  # or searchsorted warns and copies
        index = torch.searchsorted(grid, time.detach()[:, None].contiguous(), right=True).squeeze(-1) - 1
        index = torch.minimum(index.clamp_min(0), self.last.expand(batch))
        first, final = self._pick(grid, index * 0), self._pick(grid, self.last.expand(batch) + 1)
        moving = ((time >= first) & (time <= final)).to(time.dtype)[:, None]
        since = (time.clamp(first, final) - self._pick(grid, index))[:, None]
        velocity, omega = self._pick(self.velocity_m_s, index), self._pick(self.omega_world_rad_s, index)
        position = self._pick(self.position_m, index) + velocity * since
        quat = quat_multiply(quat_exp(omega * since), self._pick(self.quat_wxyz, index))
        return Motion(position, quat, velocity * moving, omega * moving)

    @staticmethod
    def _pick(values: Tensor, index: Tensor) -> Tensor:
        rows = torch.arange(index.shape[0], device=index.device)
        return values.expand(index.shape[0], *values.shape[1:])[rows, index]


def _prepare(track: Track, longest: int, like: Tensor) -> tuple[Tensor, ...]:
    times = torch.as_tensor(track.time_s).to(like)
    position = torch.as_tensor(track.position_m).to(like)
    if track.quat_wxyz is None:
        quat = torch.zeros(len(times), 4).to(like)
        quat[:, 0] = 1.0
    else:
        quat = torch.as_tensor(track.quat_wxyz).to(like)
    length = times.diff()[:, None]
    turn = quat_turn(quat[:-1], quat[1:])
    velocity, omega = position.diff(dim=0) / length, quat_rotate(quat[:-1], turn) / length
    still = torch.zeros(1, 3).to(like)
    padding = longest - len(times)
    late = times[-1:] + torch.arange(1, padding + 1).to(like)
    return (
        torch.cat((times, late)),
        torch.cat((position, position[-1:].expand(padding, 3))),
        torch.cat((quat, quat[-1:].expand(padding, 4))),
        torch.cat((velocity, still.expand(padding + 1, 3))),
        torch.cat((omega, still.expand(padding + 1, 3))),
        torch.tensor(len(times) - 2, device=times.device),
    )
