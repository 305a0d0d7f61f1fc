"""Check before a fit that no track begins deep inside a fixed surface, or passes deep through one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Track
from ...schemas import InputDataError
from ..geometry.rotation import quat_to_matrix
from ..physics.checks import DEEPEST_SHARE
from ..physics.contact_detection import Placed
from ..physics.surfaces.detection import surface_depth
from ..physics.world import World

FRAMES = 200
"""Maximum number of frames of a track that are looked at, evenly spread."""
CHECK = "check the surface's pose, size and unit, and the frame of the tracks."


@dataclass(frozen=True, kw_only=True)
class _Depth:
    """How deep a body is in a surface in an episode."""

    episode: str
    body: str
    surface: str
    first_m: float
    """At the first frame [m]."""
    deepest_m: float
    """At the deepest of the frames [m]."""
    time_s: float
    """Time of that [s]."""
    allowed_m: float
    """What contact explains [m]."""


def require_outside(world: World, capture: Capture, split: str) -> list[str]:
    """Refuse episodes of a split in which a free body or a link begins deep inside a fixed surface.

    Returns:
        Warnings of bodies that are deep inside a surface later, which contact does not explain.

    Raises:
        InputDataError: With the deepest one: episode, body, surface and depth.
    """
    found = list(_depths(world, capture, split))
    first = max(found, key=lambda one: one.first_m / one.allowed_m, default=None)
    if first is not None and first.first_m > first.allowed_m:
        raise InputDataError(
            f"{capture.root / 'capture.toml'}: [[surfaces]] '{first.surface}': in episode '{first.episode}', "
            f"'{first.body}' begins {1e3 * first.first_m:.1f} mm deep inside it.",
            f"up to {1e3 * first.allowed_m:.1f} mm; deeper, the contact would throw it out.",
            CHECK,
        )
    warnings = []
    for surface, body in sorted({(one.surface, one.body) for one in found if one.deepest_m > one.allowed_m}):
        deep = [one for one in found if (one.surface, one.body) == (surface, body) and one.deepest_m > one.allowed_m]
        worst = max(deep, key=lambda one: one.deepest_m)
        warnings.append(
            f"the track of {body} passes through the surface '{surface}' in {len(deep)} "
            f"episode{'' if len(deep) == 1 else 's'}: {1e3 * worst.deepest_m:.1f} mm deep in episode "
            f"'{worst.episode}' at {worst.time_s:.2f} s, where contact explains up to {1e3 * worst.allowed_m:.1f} mm. "
            f"What is fitted to that is wrong: {CHECK}"
        )
    return warnings


def _depths(world: World, capture: Capture, split: str) -> Iterator[_Depth]:
    """Yield how deep each free body or link is in each surface, by episode."""
    for name in capture.episodes(split) if world.surfaces else ():
        tracks = capture.tracks(name)
        for index in world.tracked:
            body = world.bodies[index]
            track = tracks.get(body.name)
            if track is None or not body.radii.shape[-1]:
                continue
            rows = np.unique(np.linspace(0, len(track.time_s) - 1, min(len(track.time_s), FRAMES)).round().astype(int))
            placed = _placed(world, index, track, rows)
            allowed = DEEPEST_SHARE * float(placed.reach.min())
            for surface in world.surfaces:
                depth = surface_depth(placed, surface)
                deepest = int(depth.argmax())
                yield _Depth(
                    episode=name,
                    body=body.name,
                    surface=surface.name,
                    first_m=float(depth[0]),
                    deepest_m=float(depth[deepest]),
                    time_s=float(track.time_s[rows[deepest]]),
                    allowed_m=allowed,
                )


def _placed(world: World, index: int, track: Track, rows: np.ndarray) -> Placed:
    """Return a body in the poses of its track at some rows; of a ball without orientation in any one."""
    body = world.bodies[index]
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1))
    if track.quat_wxyz is not None:
        measured = np.asarray(track.quat_wxyz, float)[rows]
        quat = np.where(np.isfinite(measured).all(1, keepdims=True), measured, quat)
    origin = torch.as_tensor(np.asarray(track.position_m, float)[rows]).to(world.gravity)
    return Placed.still(body, origin, quat_to_matrix(torch.as_tensor(quat).to(world.gravity)))
