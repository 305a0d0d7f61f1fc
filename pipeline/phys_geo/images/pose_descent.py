"""Descent of the image loss to the nearest poses of the bodies, of many poses in one batch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ...geometry.rotation import quat_normalize
from ...optimization.least_squares import Policy, descend
from ...optimization.problem import Box, NormalEquations, Point, Problem, Rows
from .image_loss import ImageLoss

STEP_LIMIT = 0.5
"""Maximum step of the descent, in radii of the body and radians."""
SMALL_STEP = 1e-3
"""Step below which the descent ends, in radii of the body and radians."""


@dataclass(frozen=True)
class Poses:
    """Poses (K) of all bodies (nb), each at one instant, with their image loss."""

    position_m: Tensor
    """Body frame origins [m], world, shape (K, nb, 3)."""
    quat_wxyz: Tensor
    """Orientations, shape (K, nb, 4)."""
    value: Tensor
    """Image loss, shape (K,)."""

    def __len__(self) -> int:
        return len(self.value)

    def at(self, rows: Tensor) -> Poses:
        """Return the poses of some rows."""
        return Poses(self.position_m[rows], self.quat_wxyz[rows], self.value[rows])

    @staticmethod
    def joined(parts: list[Poses]) -> Poses:
        """Return all poses of several groups."""
        return Poses(
            torch.cat([part.position_m for part in parts]),
            torch.cat([part.quat_wxyz for part in parts]),
            torch.cat([part.value for part in parts]),
        )


def descended(
    loss: ImageLoss, instants: Tensor, position_m: Tensor, quat_wxyz: Tensor, iterations: int, blur: int
) -> Poses:
    """Minimise the image loss from poses (K, nb, ...), each at its instant (K,).

    Args:
        loss: Image loss.
        instants: Instants of its footage.
        position_m: Body frame origins [m], world, shape (K, nb, 3).
        quat_wxyz: Orientations, shape (K, nb, 4).
        iterations: Maximum number of steps.
        blur: As in `ImageLoss.expand`.
    """
    problem = _PoseProblem(loss, instants, position_m, blur)
    start = Point(values=problem.box.low, states=(position_m, quat_wxyz))
    policy = Policy(
        iterations=iterations,
        damping=1e-2,
        up=10.0,
        least_damping=0.0,
        most_damping=math.inf,
        step_limit=STEP_LIMIT,
        small_step=SMALL_STEP,
    )
    end = descend(problem, start, policy)
    position, quat = end.point.states
    return Poses(position, quat, (end.cost / 2).to(position_m))


class _PoseProblem(Problem):
    """Poses of all bodies at instants (K), each a group whose state moves the free bodies.

    Args:
        loss: Image loss.
        instants: Instants of its footage, shape (K,).
        like: Tensor of the poses' device.
        blur: As in `ImageLoss.expand`.
    """

    derivatives_with_costs = True

    def __init__(self, loss: ImageLoss, instants: Tensor, like: Tensor, blur: int) -> None:
        self.loss, self.instants, self.blur = loss, instants, blur
        self.owner = torch.arange(len(instants), device=like.device)
        # renders have single precision; the small systems of their derivatives are solved in double precision
        self.box = Box.unbounded(like.new_zeros((len(instants), 0), dtype=torch.float64))
        self.units = torch.tensor(
            [unit for index in loss.free for unit in [loss.radii[index]] * 3 + [1.0] * 3], device=like.device
        ).double()

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """Return the normal equations of the poses, half of whose cost is the image loss."""
        position, quat = point.states
        model = self.loss.expand(self.instants[rows.items.cpu()], position, quat, self.blur)
        count, size = model.slope.shape
        none = model.slope.new_zeros((count, 0), dtype=torch.float64)
        return NormalEquations(
            states=model.curvature.double(),
            mixed=none.new_zeros(count, size, 0),
            information=none.new_zeros(count, 0, 0),
            state_slope=-model.slope.double(),
            slope=none,
            cost=2 * model.value.double(),
        )

    def moved(self, point: Point, values: Tensor, step: Tensor, rows: Rows) -> tuple[Tensor, ...]:
        """Return the poses (b) moved by steps (b, 6 nf)."""
        del values, rows
        position, quat = point.states
        position, quat = self.loss.moved(position, quat, step.to(position))
        return position, quat_normalize(quat)
