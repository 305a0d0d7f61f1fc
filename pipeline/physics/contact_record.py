"""Contact labels of a rollout, frame by frame, for datasets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .contact_detection import FAR_M, GROUND, Placed, Points, all_body_points, ground_points, pairs_of, slot_count
from .contact_solver import PairImpulses, put
from .surfaces.detection import all_surface_points
from .world import World

SLIDES = 0.99
"""Minimum share of the friction limit that the tangential impulse of a sliding contact reaches."""


@dataclass(frozen=True)
class ContactRecord:
    """Contacts of a rollout, summed over the steps since the previous frame, world frame; C contacts."""

    body_a: Tensor
    """Index of body a, int64, shape (C,)."""
    body_b: Tensor
    """Index of body b, -1 for the ground, int64, shape (C,)."""
    impulse_n_s: Tensor
    """Impulse on body a [N s], shape (B, T, C, 3)."""
    position_m: Tensor
    """Contact point [m], shape (B, T, C, 3)."""
    normal: Tensor
    """Unit normal from b to a, shape (B, T, C, 3)."""
    distance_m: Tensor
    """Gap [m], negative where the bodies overlap, shape (B, T, C)."""
    sliding: Tensor
    """Whether the contact slides, bool, shape (B, T, C)."""


class Recorder:
    """Collector of contact labels: sums impulses over steps, and adds the geometry at the end of each frame.

    Args:
        world: The world.
        placed: The bodies at the first frame.
    """

    def __init__(self, world: World, placed: Sequence[Placed]) -> None:
        self.world = world
        self.pairs = pairs_of(world)
        self.frames: list[tuple[Tensor, ...]] = []
        self.batch = placed[0].reference.shape[0] if placed else 1
        self.like = world.gravity
        self.steps: list[PairImpulses] = []
        self.close_frame(placed)

    def add(self, touched: Sequence[PairImpulses]) -> None:
        """Add the impulses of one step."""
        self.steps.extend(touched)

    def close_frame(self, placed: Sequence[Placed]) -> None:
        """Sum the impulses since the last frame; contacts without impulse get the current geometry."""
        columns = []
        for number, (a, b) in enumerate(self.pairs):
            points = self._points(a, b, placed)
            total, weighted = torch.zeros_like(points.position), torch.zeros_like(points.position)
            weight, sliding = torch.zeros_like(points.gap), torch.zeros_like(points.gap)
            facing, depth = torch.zeros_like(points.position), torch.zeros_like(points.gap)
            for step in (step for step in self.steps if step.pair == number):
                normal = step.points.normal
                along = (step.impulse_n_s * normal).sum(-1)
                across = (step.impulse_n_s - along[..., None] * normal).square().sum(-1).sqrt()
                slides = (across > SLIDES * step.friction * along).to(along.dtype)
                total = total + self._spread(step, step.impulse_n_s)
                weighted = weighted + self._spread(step, along[..., None] * step.points.position)
                weight, sliding = weight + self._spread(step, along), sliding + self._spread(step, along * slides)
                facing = facing + self._spread(step, along[..., None] * normal)
                depth = depth + self._spread(step, along * step.points.gap)
            acted = weight > 0
            surface = self.world.surface(b)
            if surface is not None and surface.mesh is not None:
                points = _as_acted(points, acted, facing, depth / weight.clamp_min(1e-30))
            elif b != GROUND:
                points = _turned(points, acted, facing, total)
                points = _as_acted(points, acted & (points.gap >= FAR_M), facing, depth / weight.clamp_min(1e-30))
            place = torch.where(acted[..., None], weighted / weight.clamp_min(1e-30)[..., None], points.position)
            columns.append((total, place, points.normal, points.gap, (sliding > 0.5 * weight) & acted))
        self.steps = []
        if columns:
            self.frames.append(tuple(torch.cat([column[k] for column in columns], 1) for k in range(5)))
        else:
            empty = self.like.new_zeros((self.batch, 0))
            vector = self.like.new_zeros((self.batch, 0, 3))
            self.frames.append((vector, vector, vector, empty, empty.bool()))

    def _spread(self, step: PairImpulses, values: Tensor) -> Tensor:
        """Return values (n, C, ...) of a step's points in the pair's fixed slots (B, S, ...)."""
        slots = slot_count(self.world, self.pairs[step.pair])
        index = step.points.slot
        if values.ndim == 3:
            index = index[..., None].expand_as(values)
        wide = values.new_zeros((values.shape[0], slots, *values.shape[2:])).scatter_add(1, index, values)
        return put(wide, step.items, self.batch)

    def _points(self, a: int, b: int, placed: Sequence[Placed]) -> Points:
        surface = self.world.surface(b)
        if surface is not None:
            return all_surface_points(placed[a], surface)
        if b == GROUND:
            slots = torch.arange(slot_count(self.world, (a, b)), device=placed[a].reference.device)
            return ground_points(self.world, placed[a], slots.expand(self.batch, -1))
        return all_body_points(placed[a], placed[b])

    def record(self) -> ContactRecord:
        """Return the record of all frames."""
        counts = [slot_count(self.world, pair) for pair in self.pairs]
        bodies = [[pair[k] for pair, n in zip(self.pairs, counts, strict=True) for _ in range(n)] for k in (0, 1)]
        columns = (torch.stack([frame[k] for frame in self.frames], 1) for k in range(5))
        return ContactRecord(torch.tensor(bodies[0]), torch.tensor(bodies[1]), *columns)


def _turned(points: Points, acted: Tensor, facing: Tensor, total: Tensor) -> Points:
    """Return contacts with the normal of their impulses where they would pull along that at the frame.

    Between two frames a sphere may have met another face, or have turned with its body.
    """
    size = facing.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-30)
    opposite = acted & ((total * points.normal).sum(-1) < 0)
    return replace(points, normal=torch.where(opposite[..., None], facing / size, points.normal))


def _as_acted(points: Points, acted: Tensor, facing: Tensor, gap: Tensor) -> Points:
    """Return contacts with normal and gap of their impulses; slots of meshes and edges may have others at the frame."""
    size = facing.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-30)
    normal = torch.where(acted[..., None], facing / size, points.normal)
    return replace(points, normal=normal, gap=torch.where(acted, gap, points.gap))
