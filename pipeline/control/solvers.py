"""Solvers of plans behind one interface: sampling, Gauss-Newton on exact derivatives, and both in turn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ...schemas import SolverName, UsageError, did_you_mean
from ..optimization.forward_mode import batched_jacobian
from ..optimization.least_squares import Policy, descend
from ..optimization.problem import Box, NormalEquations, Point, Problem, Rows
from .objective import Draw, Objective

NOISE = (0.03, 0.4)
"""Smallest and largest standard deviation of changed plans in units of the bound; each sample has its own."""
CHANGED = 1 / 3
"""Share of the samples that change the plan before; the others are proposals."""
NOISE_PIECES = 4
"""Pieces that noise changes alike: single ones would only shake the finger."""
TEMPERATURE = 0.02
"""Excess of the cost over the lowest, as a share of it, at which a sample counts 1/e in their mean."""
BLOCKS = 5
"""Groups of pieces whose common change Gauss-Newton chooses: each direction costs two rollouts."""
POLISH = Policy(iterations=2, attempts=2, damping=1e-2, linearise_end=False)
DESCENT = Policy(iterations=4, attempts=3, damping=1e-2, linearise_end=False)
STARTS = 4
"""Starts of Gauss-Newton alone: the plan before and proposals."""


@dataclass(frozen=True)
class Solution:
    """Sequence that a solver has found."""

    values: Tensor
    """The sequence, shape (N, joints)."""
    cost: float
    """Its cost."""


class Solver(Protocol):
    """Interface of the solvers."""

    def solve(self, objective: Objective, warm: Tensor, propose: Draw, rng: np.random.Generator) -> Solution:
        """Lower the cost of an objective.

        Args:
            objective: The objective.
            warm: The plan before, shifted by the time that has passed, shape (N, joints).
            propose: Source of other sequences.
            rng: Source of randomness.
        """
        ...


@dataclass(frozen=True)
class Mppi:
    """Sampling: proposals and changes of the plan before, then changes of the best, whose weighted mean competes.

    The mean is that of model-predictive path integral control (Williams et al., "Information theoretic MPC for
    model-based reinforcement learning", 2017, eq. 17), restricted to samples about the best one: the mean of pushes
    from two sides is no push. The best sequence never costs more than the plan before.
    """

    samples: int
    """Number of sequences."""

    def solve(self, objective: Objective, warm: Tensor, propose: Draw, rng: np.random.Generator) -> Solution:
        """See :class:`Solver`."""
        first = max(2, self.samples // 2)
        changed = int(CHANGED * first)
        proposals = _tensor(propose(rng, max(first - changed - 2, 0)), objective)
        values = torch.cat(
            (warm[None], torch.zeros_like(warm)[None], self._changed(warm, changed, objective, rng), proposals)
        )
        values = values.clamp(-objective.bound, objective.bound)
        costs = objective.costs(values)
        best = values[costs.argmin()]
        near = self._changed(best, max(self.samples - first - 1, 1), objective, rng)
        later = objective.costs(near)
        values, costs = torch.cat((best[None], near)), torch.cat((costs.min()[None], later))
        mean = _mean(values, costs)[None]
        values, costs = torch.cat((values, mean)), torch.cat((costs, objective.costs(mean)))
        chosen = costs.argmin()
        return Solution(values[chosen], float(costs[chosen]))

    def _changed(self, values: Tensor, count: int, objective: Objective, rng: np.random.Generator) -> Tensor:
        """Return sequences (count, N, joints) about one (N, joints), within the bound."""
        pieces, joints = objective.shape
        noise = rng.normal(size=(count, -(-pieces // NOISE_PIECES), joints)).repeat(NOISE_PIECES, 1)[:, :pieces]
        size = np.exp(rng.uniform(math.log(NOISE[0]), math.log(NOISE[1]), (count, 1, 1)))
        changed = values + torch.as_tensor(objective.bound * size * noise)
        return changed.clamp(-objective.bound, objective.bound)


@dataclass(frozen=True)
class GaussNewton:
    """Damped Gauss-Newton within bounds from the plan before and from proposals, all descents in one batch."""

    def solve(self, objective: Objective, warm: Tensor, propose: Draw, rng: np.random.Generator) -> Solution:
        """See :class:`Solver`."""
        proposals = _tensor(propose(rng, STARTS - 1), objective)
        return descended(objective, torch.cat((warm[None], proposals)), DESCENT)


@dataclass(frozen=True)
class Both:
    """Sampling, and Gauss-Newton from its result."""

    sampling: Solver
    """The sampling solver."""

    def solve(self, objective: Objective, warm: Tensor, propose: Draw, rng: np.random.Generator) -> Solution:
        """See :class:`Solver`."""
        found = self.sampling.solve(objective, warm, propose, rng)
        polished = descended(objective, found.values[None], POLISH)
        return polished if polished.cost < found.cost else found


def solver_of(name: SolverName, sampling: Solver) -> Solver:
    """Return the solver of a name.

    Args:
        name: mppi, gauss-newton or both.
        sampling: The sampling solver.

    Raises:
        UsageError: If there is no such solver.
    """
    known: dict[str, Solver] = {"mppi": sampling, "gauss-newton": GaussNewton(), "both": Both(sampling)}
    if name not in known:
        raise UsageError(
            f"there is no solver '{name}'.", f"{', '.join(known)}.{did_you_mean(name, known)}", "name one of these."
        )
    return known[name]


def descended(objective: Objective, starts: Tensor, policy: Policy) -> Solution:
    """Return the best end of the descents from starts (G, N, joints)."""
    problem = _Blocks.of(objective, starts)
    found = descend(problem, Point(values=torch.zeros(len(starts), problem.size, dtype=starts.dtype)), policy)
    ends = problem.sequences(found.point.values, torch.arange(len(starts)))
    values = torch.cat((starts, ends))
    costs = objective.costs(values)
    chosen = costs.argmin()
    return Solution(values[chosen], float(costs[chosen]))


class _Blocks(Problem):
    """Changes of sequences that are common to blocks of pieces; an item is a sequence under one draw of the model."""

    def __init__(self, objective: Objective, starts: Tensor, box: Box, owner: Tensor) -> None:
        self.objective, self.starts, self.box, self.owner = objective, starts, box, owner
        pieces = objective.shape[0]
        self.block = torch.arange(pieces) * min(BLOCKS, pieces) // pieces

    @staticmethod
    def of(objective: Objective, starts: Tensor) -> _Blocks:
        count, (pieces, joints) = len(starts), objective.shape
        size = min(BLOCKS, pieces) * joints
        # a block may be changed by twice the bound; what leaves the bound is clamped
        wide = torch.full((count, size), 2 * objective.bound, dtype=starts.dtype)
        zero = torch.zeros_like(wide)
        box = Box(low=-wide, high=wide, centre=zero, information=zero)
        return _Blocks(objective, starts, box, torch.arange(count).repeat_interleave(objective.draws))

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.box.low.shape[1]

    def sequences(self, values: Tensor, groups: Tensor) -> Tensor:
        """Return the sequences (b, N, joints) of changes (b, P) of the starts of groups (b,)."""
        change = values.unflatten(1, (-1, self.objective.shape[1]))[:, self.block]
        return (self.starts[groups] + change).clamp(-self.objective.bound, self.objective.bound)

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        """See :class:`Problem`."""
        groups, draws = rows.groups[rows.owner], rows.items % self.objective.draws

        def residuals(values: Tensor, repeats: int) -> Tensor:
            sequences = self.sequences(values, groups.repeat(repeats))
            return self.objective.residuals(sequences, draws.repeat(repeats))

        found, jacobian = batched_jacobian(residuals, point.values[rows.owner])
        return NormalEquations.of_rows(found, jacobian, self.size, found.square().sum(-1))

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """See :class:`Problem`."""
        sequences = self.sequences(point.values[rows.owner], rows.groups[rows.owner])
        with torch.no_grad():
            return self.objective.residuals(sequences, rows.items % self.objective.draws).square().sum(-1)


def _mean(values: Tensor, costs: Tensor) -> Tensor:
    """Return the mean (N, joints) of sequences (B, N, joints), weighted by their costs (B,)."""
    lowest = costs.min()
    excess = (costs - lowest) / (TEMPERATURE * lowest.clamp_min(1e-12))
    weights = torch.exp(-excess)
    return (weights[:, None, None] * values).sum(0) / weights.sum()


def _tensor(values: np.ndarray, objective: Objective) -> Tensor:
    return torch.as_tensor(np.asarray(values, float).reshape(-1, *objective.shape))
