"""What the residuals of fitted windows are like: how large, and how far one frame's tells the next one's.

A model that misses something bends a whole episode, and smoothed tracks err alike for several frames. As for a
first-order autoregression of correlation rho from frame to frame, (1 - rho) / (1 + rho) of the frames count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .estimation.least_squares import Solution
from .estimation.observations import Observations

Array = NDArray[np.float64]

ROBUST_SCALE = 3.0
"""Of the robust loss with which windows are fitted, in sigmas."""
MOST_CORRELATED = 0.98


@dataclass(frozen=True)
class WindowErrors:
    """What the residuals are like: chi2 (B,) and count (B,) of numbers, weighted; kind (B,); inflation by kind."""

    chi2: Array
    count: Array
    kind: NDArray[np.int64]
    inflation: Array

    @property
    def independent(self) -> Array:
        """By how many independent numbers (B,) the errors of each item count."""
        return self.count / self.inflation[self.kind]

    def factor(self, numbers: int) -> tuple[float, float]:
        """Return by what factor the errors of all items exceed those assumed, at least 1, and the degrees of freedom.

        Args:
            numbers: How many were fitted beside the states.
        """
        dof = max(float(self.independent.sum()) - numbers, 1.0)
        return max(float(self.chi2.sum()) / dof, 1.0), dof

    @staticmethod
    def of(rows: Tensor, solution: Solution, batch: Observations, ends: NDArray[np.bool_]) -> WindowErrors:
        """Look at residuals.

        Args:
            rows: Residuals (B, F, 6) at the solution, in assumed standard deviations.
            solution: Of the fit, which weighed them robustly.
            batch: The windows.
            ends: Which of them (B,) are ends of episodes: these err in their own way.
        """
        weight = (1 / (1 + solution.chi2 / ROBUST_SCALE**2)).unflatten(1, (-1, len(batch.free)))
        r = rows.unflatten(1, (-1, len(batch.free)))
        known = torch.cat(
            (batch.seen[..., None] * batch.measured_axes[:, None], batch.turned[..., None].expand(-1, -1, -1, 3)), -1
        )
        count = (weight[..., None] * known).sum(1)
        count = (count - 2 * (known.sum(1) > 0)).clamp_min(0.0).sum((1, 2))
        chi2 = (weight[..., None] * r.square() * known).sum((1, 2, 3))
        pairs = torch.minimum(weight[:, 1:], weight[:, :-1])[..., None] * known[:, 1:] * known[:, :-1]
        product = (pairs * r[:, 1:] * r[:, :-1]).sum((1, 2, 3))
        square = 0.5 * (pairs * (r[:, 1:].square() + r[:, :-1].square())).sum((1, 2, 3))
        kind = ends.astype(np.int64)
        inflation = np.ones(2)
        for k in np.unique(kind):
            rho = float(product[kind == k].sum() / square[kind == k].sum().clamp_min(1e-300))
            rho = min(max(rho, 0.0), MOST_CORRELATED)
            inflation[k] = (1 + rho) / (1 - rho)
        return WindowErrors(chi2.numpy(), count.numpy(), kind, inflation)
