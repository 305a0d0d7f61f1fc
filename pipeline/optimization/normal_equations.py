"""Normal equations of least-squares problems with arrow structure, and the Schur complement that eliminates states.

The state of an item is coupled to the item's residuals and to the parameters of its group only (Triggs et al., "Bundle
adjustment - a modern synthesis", 2000, section 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

FLOOR = 1e-12
"""Minimum diagonal element that damping multiplies, so that directions without information are damped too."""


@dataclass(frozen=True, kw_only=True)
class Eliminated:
    """Normal equations of items with their states eliminated."""

    information: Tensor
    """Information C - M' A^-1 M on the parameters, shape (B, P, P)."""
    score: Tensor
    """Negative gradient g - M' A^-1 g_s by the parameters, shape (B, P)."""
    state_step: Tensor
    """Step A^-1 g_s of the states without a change of the parameters, shape (B, S)."""
    by_parameter: Tensor
    """Response of the states: with parameters that move by d they move by state_step - by_parameter d; (B, S, P)."""

    def following(self, change: Tensor, share: float = 1.0) -> Tensor:
        """Return the step (B, S) of the states for changes (B, P) of the parameters, a share of the whole step."""
        return share * self.state_step - (self.by_parameter @ change[..., None])[..., 0]


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Normal equations of half the cost of items (B), without the priors of the parameters."""

    states: Tensor
    """Information A on the states, shape (B, S, S)."""
    mixed: Tensor
    """Information M by states and parameters, shape (B, S, P)."""
    information: Tensor
    """Information C on the parameters, shape (B, P, P)."""
    state_slope: Tensor
    """Negative gradient g_s by the states, shape (B, S)."""
    slope: Tensor
    """Negative gradient g by the parameters, shape (B, P)."""
    cost: Tensor
    """Cost of each item, shape (B,)."""

    @staticmethod
    def of_parameters(information: Tensor, slope: Tensor, cost: Tensor) -> NormalEquations:
        """Return the equations of items without states; shapes (B, P, P), (B, P), (B,)."""
        batch, count = slope.shape
        return NormalEquations(
            states=slope.new_zeros(batch, 0, 0),
            mixed=slope.new_zeros(batch, 0, count),
            information=information,
            state_slope=slope.new_zeros(batch, 0),
            slope=slope,
            cost=cost,
        )

    @staticmethod
    def of_rows(
        rows: Tensor,
        jacobian: Tensor,
        count: int,
        cost: Tensor,
        weight: Tensor | None = None,
        prior: float | Tensor = 0.0,
    ) -> NormalEquations:
        """Return the equations of residuals.

        Args:
            rows: Residuals, shape (B, R).
            jacobian: Their derivatives by parameters, then by states, shape (B, R, P + S).
            count: P.
            cost: Cost of each item, shape (B,).
            weight: Weight of each residual, shape (B, R); 1 by default.
            prior: Information added on the states' diagonal, a number or of shape (S,) or (B, S).
        """
        heavy = jacobian if weight is None else jacobian * weight[..., None]
        normal = heavy.mT @ jacobian
        slope = -(heavy.mT @ rows[..., None])[..., 0]
        size = jacobian.shape[-1] - count
        weak = torch.as_tensor(prior).to(rows).expand(len(rows), size)
        return NormalEquations(
            states=normal[:, count:, count:] + torch.diag_embed(weak),
            mixed=normal[:, count:, :count],
            information=normal[:, :count, :count],
            state_slope=slope[:, count:],
            slope=slope[:, :count],
            cost=cost,
        )

    @staticmethod
    def joined(parts: Sequence[NormalEquations]) -> NormalEquations:
        """Return the equations of the items of several parts."""
        names = [one.name for one in fields(NormalEquations)]
        return NormalEquations(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})

    def at(self, items: Tensor) -> NormalEquations:
        """Return the equations of some items (b,)."""
        return NormalEquations(**{one.name: getattr(self, one.name)[items] for one in fields(self)})

    def put(self, items: Tensor, other: NormalEquations) -> NormalEquations:
        """Return the equations with those of some items (b,) replaced."""
        pairs = {one.name: (getattr(self, one.name), getattr(other, one.name)) for one in fields(self)}
        return NormalEquations(**{name: old.index_copy(0, items, new) for name, (old, new) in pairs.items()})

    def weighted(self, weight: Tensor) -> NormalEquations:
        """Return the equations of items with weights (B,); the costs are unchanged."""
        one = weight[:, None]
        return NormalEquations(
            states=one[..., None] * self.states,
            mixed=one[..., None] * self.mixed,
            information=one[..., None] * self.information,
            state_slope=one * self.state_slope,
            slope=one * self.slope,
            cost=self.cost,
        )

    def eliminated(self, damping: Tensor | None = None) -> Eliminated:
        """Eliminate the states by the Schur complement.

        Args:
            damping: Relative damping of the states of each item, shape (B,); none by default.
        """
        if not self.states.shape[-1]:
            return Eliminated(
                information=self.information, score=self.slope, state_step=self.state_slope, by_parameter=self.mixed
            )
        states = self.states
        if damping is not None:
            states = damped(states, damping)
        found = solved(states, torch.cat((self.mixed, self.state_slope[..., None]), -1))
        by_parameter, state_step = found[..., :-1], found[..., -1]
        return Eliminated(
            information=self.information - self.mixed.mT @ by_parameter,
            score=self.slope - (self.mixed.mT @ state_step[..., None])[..., 0],
            state_step=state_step,
            by_parameter=by_parameter,
        )

    def finite(self) -> Tensor:
        """Return whether the gradient of each item is finite, shape (B,)."""
        return self.state_slope.isfinite().all(-1) & self.slope.isfinite().all(-1)


def damped(matrix: Tensor, damping: Tensor) -> Tensor:
    """Return matrices (B, N, N) with their diagonals, at least `FLOOR`, raised by relative dampings (B,)."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(FLOOR)
    return matrix + torch.diag_embed(damping[:, None] * diagonal)


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve linear systems (B, N, N) for right sides (B, N, k); not finite where a matrix is singular.

    An exception would end the descents of all other items of the batch.
    """
    return torch.linalg.solve_ex(matrix, right)[0]
