"""Check before a fit that no track begins deep inside a fixed surface."""

from __future__ import annotations

import numpy as np
import torch

from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Track
from ...schemas import InputDataError
from ..geometry.rotation import quat_to_matrix
from ..physics.checks import DEEPEST_SHARE
from ..physics.contact_detection import Placed
from ..physics.surface_detection import surface_depth
from ..physics.world import World


def require_outside(world: World, capture: Capture, split: str) -> None:
    """Refuse episodes of a split in which a free body or a link begins deep inside a fixed surface.

    Raises:
        InputDataError: With the deepest one: episode, body, surface and depth.
    """
    found = [
        (*_deepest(world, index, track), name, world.bodies[index].name)
        for name in (capture.episodes(split) if world.surfaces else ())
        for index in world.tracked
        if world.bodies[index].radii.shape[-1]
        and (track := capture.tracks(name).get(world.bodies[index].name)) is not None
    ]
    excess, depth, allowed, surface, episode, body = max(found, default=(0.0, 0.0, 0.0, "", "", ""))
    if excess > 1:
        raise InputDataError(
            f"{capture.root / 'capture.toml'}: [[surfaces]] '{surface}': in episode '{episode}', '{body}' begins "
            f"{1e3 * depth:.1f} mm deep inside it.",
            f"up to {1e3 * allowed:.1f} mm; deeper, the contact would throw it out.",
            "check the surface's pose, size and unit, and the frame of the tracks.",
        )


def _deepest(world: World, index: int, track: Track) -> tuple[float, float, float, str]:
    """Return depth in units of the allowed one, depth [m], allowed depth [m] and surface at a track's first pose."""
    body = world.bodies[index]
    quat = np.asarray(track.quat_wxyz, float)[:1]
    # of a ball whose orientation was not measured, any one
    quat = torch.as_tensor(np.where(np.isfinite(quat).all(), quat, [[1.0, 0, 0, 0]]), dtype=world.gravity.dtype)
    rotation = quat_to_matrix(quat)
    origin = torch.as_tensor(np.asarray(track.position_m, float)[:1], dtype=world.gravity.dtype)
    reference = origin + (rotation @ body.com[..., None]).squeeze(-1)
    placed = Placed(body, reference, rotation, torch.zeros_like(reference), torch.zeros_like(reference))
    allowed = DEEPEST_SHARE * float(placed.reach.min())
    depths = [(float(surface_depth(placed, one)[0]), one.name) for one in world.surfaces]
    depth, name = max(depths)
    return depth / allowed, depth, allowed, name
