"""Heights at which bodies rest on, or are clear of, the ground and the fixed surfaces of a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.models.model import Model
from ..physics.body import Body
from ..physics.contact_detection import Placed
from ..physics.model_world import fixed_surfaces
from ..physics.surfaces.detection import surface_depth
from ..physics.surfaces.fixed_surface import HALF_SPACE, FixedSurface
from .plan import up_direction

Array = NDArray[np.float64]

STEP = 0.5
"""Distance of the heights that are tried, in radii of the smallest sphere: thinner than what a sphere can miss."""
MOST_STEPS = 4096
"""Maximum number of these heights in either direction."""
_BLOCK, _ROUNDS = 16, 5
"""Heights that are tried at once, and the number of times that the interval between two of them is divided."""


@dataclass(frozen=True)
class Supports:
    """The ground and the fixed surfaces of a model."""

    surfaces: tuple[FixedSurface, ...]
    """The fixed surfaces."""
    up: Array
    """Unit vector away from the ground, or against gravity; world frame, shape (3,)."""
    ground_m: float | None
    """Height of the ground along `up` [m]; None without one."""

    @staticmethod
    def of(model: Model) -> Supports:
        """Return those of a model."""
        found = fixed_surfaces(model, lambda x: torch.as_tensor(np.asarray(x), dtype=torch.float64)[None])
        ground = model.file.ground
        return Supports(found, up_direction(model.file), None if ground is None else ground.offset_m)

    def rest_height(self, place: Array, arms: Array, radii: Array) -> float | None:
        """Return the height along `up` at which a body rests, lowered from where it is or the next free height above.

        Args:
            place: Position of its origin [m], shape (3,).
            arms: Centres of its spheres relative to the origin, world axes [m], shape (N, 3).
            radii: Their radii [m], shape (N,).

        Returns:
            The height of the origin [m]; None where nothing is below.
        """
        lowest = None if self.ground_m is None else self.ground_m - float((arms @ self.up - radii).min())
        if not self.surfaces:
            return lowest
        begin = float(place @ self.up) if lowest is None else max(float(place @ self.up), lowest)
        reach = float((np.linalg.norm(arms, axis=1) + radii).max())
        step = max(STEP * float(radii.min()), (self._span(place, begin) + 2 * reach) / MOST_STEPS)
        count = min(MOST_STEPS, int((self._span(place, begin) + 2 * reach) / step) + 1)

        def blocked(heights: Array) -> NDArray[np.bool_]:
            return self.overlaps(place + (heights - place @ self.up)[:, None] * self.up, arms, radii)

        free = _first(lambda h: ~blocked(h), begin, step, count)
        if free is None:
            return begin
        if free > begin:
            return _edge(blocked, free - step, free)
        bottom = count if lowest is None else min(count, int((begin - lowest) / step))
        touched = _first(blocked, begin, -step, bottom)
        if touched is not None:
            return _edge(blocked, touched, touched + step)
        if lowest is None or not blocked(np.array([lowest]))[0]:
            return lowest
        return _edge(blocked, lowest, begin - step * bottom)

    def overlaps(self, places: Array, arms: Array, radii: Array) -> NDArray[np.bool_]:
        """Return whether spheres overlap any surface, by place of their body's origin (P, 3) [m]; shape (P,)."""
        tensors = (torch.as_tensor(np.asarray(x), dtype=torch.float64) for x in (places, arms[None], radii[None]))
        origin, centers, sizes = tensors
        upright = torch.eye(3, dtype=torch.float64).expand(len(origin), 3, 3)
        one = torch.ones(1, dtype=torch.float64)
        body = Body(
            name="shape", motion="fixed", mass=one, inertia=torch.eye(3, dtype=torch.float64)[None],
            com=torch.zeros(1, 3, dtype=torch.float64), centers=centers, radii=sizes,
        )  # fmt: skip
        placed = Placed.still(body, origin, upright)
        inside = [surface_depth(placed, surface) > 0 for surface in self.surfaces]
        return torch.stack(inside).any(0).numpy() if inside else np.zeros(len(origin), bool)

    def _span(self, place: Array, height: float) -> float:
        """Return how far from a height along `up` surfaces reach [m]."""
        return max((_farthest(one, self.up, place, height) for one in self.surfaces), default=0.0)


def _farthest(surface: FixedSurface, up: Array, place: Array, height: float) -> float:
    center = surface.position[0].numpy()
    if surface.kind == HALF_SPACE:
        normal = surface.to_world(torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64))[0, 0].numpy()
        level = abs(float(normal @ up))
        return abs(float((place + (height - place @ up) * up - center) @ normal)) / max(level, 0.05)
    if surface.mesh is not None:
        size = float(np.linalg.norm(surface.mesh.topology.corners.reshape(-1, 3), axis=1).max())
    else:
        size = float(surface.size[0].norm())
    return abs(float(center @ up) - height) + size


def _first(wanted: Callable[[Array], NDArray[np.bool_]], begin: float, step: float, count: int) -> float | None:
    """Return the first of count + 1 heights from `begin` on that is wanted; None where none is."""
    for block in range(0, count + 1, _BLOCK):
        heights = np.asarray(begin + step * np.arange(block, min(block + _BLOCK, count + 1)), np.float64)
        found = np.flatnonzero(wanted(heights))
        if len(found):
            return float(heights[found[0]])
    return None


def _edge(blocked: Callable[[Array], NDArray[np.bool_]], low: float, high: float) -> float:
    """Return the lowest height of those between a blocked and a free one that is free, to rounding."""
    for _ in range(_ROUNDS):
        heights = np.linspace(low, high, _BLOCK + 1)
        last = int(np.flatnonzero(np.append(blocked(heights[:-1]), False))[-1:].max(initial=0))
        low, high = float(heights[last]), float(heights[last + 1])
    return high
