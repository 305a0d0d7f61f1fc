"""Sampling of smooth changes of the plan before, whose best are averaged: for many joints and frequent plans."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from ..objective import Draw, Objective
from ..solvers import Solution


@dataclass(frozen=True)
class Elites:
    """One round of the cross-entropy method for each plan, about the plan before and with a given spread.

    Changes are polynomials through nodes, small at the beginning of a plan and large later, so that plans look for
    other ways without shaking the joints. The plan is the mean of the best samples: with as few samples as one may roll
    out in time, the best one alone is chosen by chance, and changes that contradict each other should cancel. The mean
    is not rolled out, since it is the first sample of the next plan. See de Boer et al., "A tutorial on the
    cross-entropy method" (2005).
    """

    samples: int
    """Number of sequences; the first is the plan before."""
    noise: tuple[float, float] = (0.06, 0.6)
    """Standard deviation of the first node and of the others, in units of the bound."""
    nodes: int = 4
    """Number of nodes, the first where the plan acts, the last at its end."""
    best: int = 3
    """Number of samples that are averaged."""

    def solve(self, objective: Objective, warm: Tensor, propose: Draw, rng: np.random.Generator) -> Solution:
        """See :class:`cgwm.pipeline.control.solvers.Solver`; the cost is that of the best sample."""
        pieces, joints = objective.shape
        size = np.array([self.noise[0], *[self.noise[1]] * (self.nodes - 1)])[:, None]
        nodes = objective.bound * size * rng.normal(size=(self.samples - 1, self.nodes, joints))
        changes = torch.einsum(
            "kn,snj->skj", _polynomials(pieces, self.nodes).to(warm), torch.as_tensor(nodes).to(warm)
        )
        values = torch.cat((warm[None], warm + changes)).clamp(-objective.bound, objective.bound)
        costs = objective.costs(values)
        order = costs.argsort()[: self.best]
        return Solution(values[order].mean(0), float(costs[order[0]]))


@cache
def _polynomials(pieces: int, nodes: int) -> Tensor:
    """Return the values at the ends of pieces (pieces, nodes) of the polynomials that are 1 at one of some nodes."""
    ends, places = np.arange(1, pieces + 1) / pieces, np.linspace(0, 1, nodes)
    return torch.as_tensor(np.vander(ends, nodes) @ np.linalg.inv(np.vander(places)))
