"""The tips of a hand's fingers, which plans bring to the object."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...geometry.rotation import quat_rotate
from ...physics.chains.chain import Chain
from ...physics.world import World


@dataclass(frozen=True)
class Fingertips:
    """Points of the last links of all fingers that are farthest from the joints of these links."""

    links: tuple[int, ...]
    """Bodies that they belong to."""
    points: Tensor
    """Their places in the frames of these bodies [m], shape (tips, 3)."""

    @staticmethod
    def of(world: World, chain: Chain) -> Fingertips:
        """Return the tips of the fingers of a chain; links without shapes have none.

        Args:
            world: The world that has the bodies of the chain.
            chain: The hand; parts of links are fixed to them with the frame of the link.
        """
        carriers = {joint.parent for joint in chain.moving}
        found = {}
        for joint in chain.moving:
            if joint.link not in carriers and len(points := _points(world, chain, joint.link)):
                found[world.body_names.index(joint.link)] = points[points.norm(dim=-1).argmax()]
        return Fingertips(tuple(found), torch.stack(list(found.values())) if found else torch.zeros(0, 3))

    def places(self, position_m: Tensor, quat_wxyz: Tensor) -> Tensor:
        """Return the places (..., tips, 3) of the tips [m] from positions [m] and orientations of their links."""
        return position_m + quat_rotate(quat_wxyz, self.points)


def _points(world: World, chain: Chain, link: str) -> Tensor:
    """Return the corners (n, 3) of the shapes of a link and its parts in its frame [m]."""
    parts = {joint.link for joint in chain.joints if joint.kind == "fixed" and joint.parent == link}
    return torch.cat([body.centers[0] for body in world.bodies if body.name in {link, *parts}])
