"""Contact spheres as fitted parameters: geometry estimated from collisions.

Only spheres that come into contact influence a motion, so only these are moved. Images have no direct gradient by them:
they are fitted through the motion alone, as published (contact model notes, section 7).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...geometry.rotation import quat_to_matrix
from ...physics.rollout import Rollout
from ...physics.world import World

TOUCH_M = 5e-4
"""Maximum gap of a contact sphere to the ground or to a sphere of another body [m]."""
MOST = 20
"""Maximum number of spheres of a body that are fitted; those that come nearest are chosen."""
MOVED_STD_M = 4e-4
"""Standard deviation of the prior of a sphere's centre and radius [m]: the uncertainty that photos leave."""


@dataclass(frozen=True)
class ContactSpheres:
    """Contact spheres by body; coordinates of each are centre (3) and radius, in units of `MOVED_STD_M`."""

    chosen: tuple[tuple[int, Tensor], ...]
    """Index of each body, and indices of its contact spheres, shape (m,)."""

    @property
    def count(self) -> int:
        """Number of coordinates."""
        return sum(4 * len(indices) for _, indices in self.chosen)

    @staticmethod
    def of(world: World, rollouts: Rollout) -> ContactSpheres:
        """Choose the spheres of free bodies that come nearest to an obstacle in any of the rollouts (B)."""
        chosen = []
        for index in world.free:
            gap = _least_gaps(world, rollouts, index)
            order = gap.argsort(stable=True)[:MOST]
            order = order[gap[order] < TOUCH_M]
            if len(order):
                chosen.append((index, order))
        return ContactSpheres(tuple(chosen))

    def apply(self, world: World, coordinates: Tensor) -> World:
        """Return the world with the spheres moved by coordinates (K, count)."""
        first = 0
        for index, indices in self.chosen:
            part = MOVED_STD_M * coordinates[:, first : first + 4 * len(indices)].unflatten(1, (-1, 4))
            first += 4 * len(indices)
            body = world.bodies[index]
            centers = body.centers.expand(len(part), -1, -1).index_add(1, indices, part[..., :3])
            radii = body.radii.expand(len(part), -1).index_add(1, indices, part[..., 3])
            # a corner is a sphere of a fraction of a millimetre, which must not vanish
            radii = radii.maximum(0.5 * body.radii)
            world = world.with_body(index, centers=centers, radii=radii)
        return world

    def record(self, world: World, coordinates: Tensor) -> dict[str, dict[str, float]]:
        """Return by body the number of moved spheres, and their mean and maximum displacement [m]."""
        found, first = {}, 0
        for index, indices in self.chosen:
            part = MOVED_STD_M * coordinates[first : first + 4 * len(indices)].unflatten(0, (-1, 4))
            first += 4 * len(indices)
            far = part[:, :3].norm(dim=1) + part[:, 3].abs()
            found[world.bodies[index].name] = {
                "spheres": len(indices),
                "moved_mean_m": float(far.mean()),
                "moved_most_m": float(far.max()),
            }
        return found


def _least_gaps(world: World, rollouts: Rollout, index: int) -> Tensor:
    """Return the minimum gap (n,) [m] of each sphere of a body to the ground and to the spheres of others."""
    body = world.bodies[index]
    centers = _placed(body.centers[0], rollouts, index)
    gap = torch.full((centers.shape[-2],), torch.inf).to(centers)
    if world.ground_normal is not None and world.ground_offset is not None:
        height = centers @ world.ground_normal - world.ground_offset[0] - body.radii[0]
        gap = gap.minimum(height.flatten(0, 1).amin(0))
    for other, them in enumerate(world.bodies):
        if other != index:
            theirs = _placed(them.centers[0], rollouts, other)
            for mine, their in zip(centers.flatten(0, 1), theirs.flatten(0, 1), strict=True):
                apart = torch.cdist(mine, their) - body.radii[0][:, None] - them.radii[0]
                gap = gap.minimum(apart.amin(1))
    return gap


def _placed(centers: Tensor, rollouts: Rollout, index: int) -> Tensor:
    """Return centres in the world at all frames, shape (B, T, n, 3)."""
    rotation = quat_to_matrix(rollouts.quat_wxyz[:, :, index])
    return centers @ rotation.transpose(-1, -2) + rollouts.position_m[:, :, index, None]


def dense_times(times_s: Tensor, factor: int) -> Tensor:
    """Return times (B, T) with `factor` - 1 additional ones between neighbours."""
    between: Sequence[Tensor] = [
        times_s[:, :-1] + (k / factor) * (times_s[:, 1:] - times_s[:, :-1]) for k in range(factor)
    ]
    return torch.cat([torch.stack(list(between), -1).flatten(1), times_s[:, -1:]], 1)
