"""The spheres with which bodies touch, as numbers to be fitted: what collision tells about geometry.

Only spheres that come into contact change a motion, so only these are moved; all others keep their places. The image
gives them nothing directly: they are reached through the motion alone, as published (contact model notes, section 7).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..physics.rollout import Rollout
from ..physics.rotation import quat_to_matrix
from ..physics.world import World

TOUCH_M = 5e-4
"""A sphere that comes as near as this to the ground or to a sphere of another body may touch."""
MOST = 20
"""Most spheres of a body that are fitted, those that come nearest."""
MOVED_STD_M = 4e-4
"""Spread of the prior of where a sphere is, and of how large: what photos leave open."""


@dataclass(frozen=True)
class TouchingSpheres:
    """Spheres by body: which (body, indices (m,)). Coordinates of each: centre (3) and radius, in `MOVED_STD_M`."""

    chosen: tuple[tuple[int, Tensor], ...]

    @property
    def count(self) -> int:
        """Number of coordinates."""
        return sum(4 * len(indices) for _, indices in self.chosen)

    @staticmethod
    def of(world: World, rollouts: Rollout) -> TouchingSpheres:
        """Choose the spheres of free bodies that come nearest to something in any of the rollouts (B)."""
        chosen = []
        for index in world.free:
            gap = _least_gaps(world, rollouts, index)
            order = gap.argsort(stable=True)[:MOST]
            order = order[gap[order] < TOUCH_M]
            if len(order):
                chosen.append((index, order))
        return TouchingSpheres(tuple(chosen))

    def apply(self, world: World, coordinates: Tensor) -> World:
        """Return the world with the spheres moved by coordinates (K, count)."""
        first = 0
        for index, indices in self.chosen:
            part = MOVED_STD_M * coordinates[:, first : first + 4 * len(indices)].unflatten(1, (-1, 4))
            first += 4 * len(indices)
            body = world.bodies[index]
            centers = body.centers.expand(len(part), -1, -1).index_add(1, indices, part[..., :3])
            radii = body.radii.expand(len(part), -1).index_add(1, indices, part[..., 3])
            # a corner is a sphere of a fraction of a millimetre: it cannot shrink to nothing
            radii = radii.maximum(0.5 * body.radii)
            world = world.with_body(index, centers=centers, radii=radii)
        return world

    def record(self, world: World, coordinates: Tensor) -> dict[str, dict[str, float]]:
        """Return by body how many spheres were moved, and how far on average and at most [m]."""
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
    """Return the least gap (n,) [m] of each sphere of a body to the ground and to the spheres of others."""
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
    """Return times (B, T) with `factor` - 1 more between each two."""
    between: Sequence[Tensor] = [
        times_s[:, :-1] + (k / factor) * (times_s[:, 1:] - times_s[:, :-1]) for k in range(factor)
    ]
    return torch.cat([torch.stack(list(between), -1).flatten(1), times_s[:, -1:]], 1)
