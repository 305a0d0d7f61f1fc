"""What fixed surfaces carry a body with in measured poses: directions along which they push, and gaps.

A body that rolls or slides on surfaces is pushed along their normals, by as much as keeps it there, whatever the law of
contact: its weight and the curvature of its path decide, in a groove on both sides. What a model misses shows along the
surfaces alone. Where triangles, or a stated place, are off by a millimetre, positions along the normals say so, and say
nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...geometry.rotation import quat_to_matrix
from ...physics.contact_detection import FAR_M, Placed
from ...physics.surfaces.detection import points_within
from ...physics.world import World
from ...trajectories.observations import Observations
from ...trajectories.rolling_start import without_slip
from ..thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.sliding_data

TOGETHER = 64
"""Number of poses, one after another in time, whose contacts are searched at once: near each other in space, they need
few triangles."""


@dataclass(frozen=True)
class Support:
    """Contacts (C) of a body in poses (n) with fixed surfaces within a reach."""

    gap_m: Tensor
    """Gaps [m], `FAR_M` where there is none, shape (n, C)."""
    normal: Tensor
    """Unit normals towards the body, shape (n, C, 3)."""

    @staticmethod
    def of(world: World, index: int, position_m: Tensor, quat_wxyz: Tensor, reach_m: float) -> Support:
        """Return what a body touches within a reach [m] in poses: positions (n, 3) and orientations (n, 4)."""
        parts = []
        for some in range(0, len(position_m), TOGETHER):
            at = slice(some, some + TOGETHER)
            placed = Placed.still(world.bodies[index], position_m[at], quat_to_matrix(quat_wxyz[at]))
            every = [points_within(placed, surface, reach_m) for surface in world.surfaces]
            parts.append((torch.cat([p.gap for p in every], 1), torch.cat([p.normal for p in every], 1)))
        return Support(*(torch.cat(one) for one in zip(*parts, strict=True)))

    def weights(self, within_m: float) -> Tensor:
        """Return 1 for contacts (n, C) that are less than a distance [m] farther than the nearest one, else 0."""
        near = self.gap_m < self.gap_m.amin(1, keepdim=True) + within_m
        return (near & (self.gap_m < FAR_M)).to(self.gap_m)

    def carried(self, within_m: float) -> Tensor:
        """Return the directions (n, 3, 3) along which the contacts within a distance [m] carry, as rows, some zero."""
        weight = self.weights(within_m)
        share = weight / weight.sum(1, keepdim=True).clamp_min(1.0)
        moment = (share[..., None] * self.normal).mT @ self.normal
        size, axes = torch.linalg.eigh(moment)
        return axes.mT * (size > LIMITS.apart).to(axes)[..., None]

    def mean(self, within_m: float) -> Tensor:
        """Return the mean normals (n, 3) of the contacts within a distance [m], of length 1; zero without any."""
        return torch.nn.functional.normalize((self.weights(within_m)[..., None] * self.normal).sum(1), dim=-1)

    def lifted(self, within_m: float, depth_m: Tensor | float = 0.0) -> Tensor:
        """Return the shortest moves (n, 3) [m] after which contacts within a distance [m] are `depth_m` deep.

        Contacts whose normals are nearly the same push a body out together, by the mean of their gaps.
        """
        weight = self.weights(within_m)
        wanted = (-self.gap_m - depth_m) * weight
        inverse = torch.linalg.pinv(weight[..., None] * self.normal, rtol=LIMITS.apart**0.5)
        return (inverse @ wanted[..., None]).squeeze(-1)

    def rolling(self, within_m: float, velocity_m_s: Tensor, radius_m: float) -> Tensor:
        """Return the smallest spins (n, 3) [rad/s] with which a ball rolls on these contacts without slip."""
        weight = self.weights(within_m)
        return without_slip(self.normal, weight, velocity_m_s, radius_m)


@dataclass(frozen=True)
class Carrying:
    """What fixed surfaces do with a body in all frames (E, T) of episodes."""

    gap_m: Tensor
    """Gap of the nearest contact [m], `FAR_M` where there is none, shape (E, T)."""
    carried: Tensor
    """Directions along which they carry, as rows, some zero, shape (E, T, 3, 3)."""
    normal: Tensor
    """Mean normals, shape (E, T, 3)."""

    @staticmethod
    def of(world: World, whole: Observations, within_m: float) -> Carrying:
        """Find them.

        Args:
            world: With fixed surfaces.
            whole: The episodes (E), of one free body.
            within_m: Distance [m] by which a contact that carries may be farther than the nearest one.
        """
        place, quat = whole.position_m[:, :, 0], whole.quat_wxyz[:, :, 0]
        found = Support.of(
            world, whole.free[0], place.flatten(0, 1), quat.flatten(0, 1), LIMITS.near_surface_m + within_m
        )
        shape = place.shape[:2]
        return Carrying(
            found.gap_m.amin(1).view(shape),
            found.carried(within_m).view(*shape, 3, 3),
            found.mean(within_m).view(*shape, 3),
        )


def within_of(position_std_m: float) -> float:
    """Return how much farther than the nearest one a contact that carries may be [m], given the noise."""
    return LIMITS.near_m + LIMITS.near_sigmas * position_std_m


def on_surfaces(world: World) -> bool:
    """Return whether what carries is fixed surfaces alone."""
    return world.ground_normal is None and bool(world.surfaces)
