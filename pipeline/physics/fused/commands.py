"""Layout of the commands of driven bodies and joints as input arrays of a fused kernel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..chains.joint_command import JointCommand
from ..kinematic import Drive
from ..world import World
from . import tree
from .layout import in_frame, joined, quat_in_frame

if TYPE_CHECKING:
    from ....datasets.capture.tracks import Track


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Commands of driven bodies, and of joints."""

    bodies: list[int]
    """Indices of the driven bodies."""
    chains: list[int]
    """Numbers of the chains whose joints have a command."""
    rows: list[tuple[Tensor, Tensor]]
    """Samples (1 or B, S, 14) of each command and the index of its last interval (1 or B,)."""

    @staticmethod
    def of(
        world: World, driven: Mapping[str, Track | Drive | JointCommand], like: Tensor, turn: Tensor | None
    ) -> Commands:
        """Return the commands of a world's driven bodies, roots of chains and joints."""
        roots = [chain.root for chain in world.chains if chain.base == "driven"]
        bodies = [k for k, body in enumerate(world.bodies) if body.motion == "driven" or body.name in roots]
        rows = [drive_rows(Drive.command(world.bodies[k].name, driven, like), turn) for k in bodies]
        joints = tree.command_rows(world, driven, like)
        return Commands(bodies=bodies, chains=list(joints), rows=[*rows, *joints.values()])

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors."""
        return [tensor for row in self.rows for tensor in row]

    def samples(self, like: Tensor) -> Tensor:
        """Return the samples of all commands in one tensor."""
        return joined([row for row, _ in self.rows]) if self.rows else like.new_zeros(1, 0, tree.COMMAND_WIDTH)

    def last(self, like: Tensor) -> Tensor:
        """Return the index of the last interval of each command, int32, shape (1 or B, commands)."""
        if not self.rows:
            return like.new_zeros(1, 0)
        return joined([last[:, None] for _, last in self.rows]).to(torch.int32)

    def starts(self, like: Tensor) -> Tensor:
        """Return the first sample of each command, int32, shape (commands,)."""
        lengths = [row.shape[1] for row, _ in self.rows]
        starts = [sum(lengths[:index]) for index in range(len(lengths))]
        return torch.tensor(starts, dtype=torch.int32, device=like.device)


def drive_rows(drive: Drive, turn: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the samples (1 or B, S, 14) of a command, and the index of its last interval (1 or B,)."""
    # the velocities go from a sample to the next; the last sample has none
    parts = (
        drive.times_s[..., None], in_frame(turn, drive.position_m), quat_in_frame(turn, drive.quat_wxyz),
        in_frame(turn, drive.velocity_m_s), in_frame(turn, drive.omega_world_rad_s),
    )  # fmt: skip
    return torch.cat(parts, -1), drive.last
