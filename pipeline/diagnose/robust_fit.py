"""Robust fits within the linear picture: what a candidate explains counts fully, what nothing explains counts little.

The loss of a segment is rho of its excess chi2 - dof (see `linear.py`), and its chi2 is quadratic in the numbers. A
minimum of the sum is found by reweighting, so that a segment that only the candidate explains gets its weight back;
weights from the misfit without the candidate would silence just those that tell most of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from .linear import robust_excess
from .score import Picture, layout, sums, widths

Array = NDArray[np.float64]

OWN_SHARE = 0.1
"""Each contact has its own friction, contact time and damping, by so many widths of their priors: no law of contact is
exact, and what its numbers would take up from one impact to the next is no sign of an effect."""
ITERATIONS = 12
STEPS = (1.0, 0.5, 0.25, 0.1)
"""Shares of a step that are tried."""
FALL = 1e-6


@dataclass(frozen=True, eq=False)
class RobustFit:
    """The minimum of the robust loss over chosen numbers.

    columns: of the picture; value (k,): as `score.layout` lays them out; cost; information (k, k): with the weights at
    the minimum.
    """

    columns: tuple[int, ...]
    value: Array
    cost: float
    information: Array


def with_own_numbers(seen: Picture) -> Picture:
    """Return the picture in which every segment's numbers of the model deviate a little on their own.

    The deviations d of a segment, with prior information L, are projected out: of its information M, score g and chi2
    remain M - M_b (M_bb + L)^-1 M_b', g - M_b (M_bb + L)^-1 g_b and chi2 - g_b' (M_bb + L)^-1 g_b.
    """
    base = list(range(seen.base))
    if not base:
        return seen
    width = OWN_SHARE * np.array([seen.parameters[k].prior[1] for k in base])
    own = seen.information[:, base][:, :, base] + np.diag(1 / width**2)
    mixed, slope = seen.information[:, base], seen.score[:, base]
    solved = np.linalg.solve(own, np.concatenate([mixed, slope[..., None]], -1))
    return replace(
        seen,
        information=seen.information - mixed.transpose(0, 2, 1) @ solved[..., :-1],
        score=seen.score - (mixed.transpose(0, 2, 1) @ solved[..., -1:])[..., 0],
        chi2=seen.chi2 - (slope * solved[..., -1]).sum(1),
    )


def robust_fit(seen: Picture, columns: Sequence[int], counted: Array | None = None) -> RobustFit:
    """Return the minimum of the robust loss over numbers, from nothing; bounds at zero are kept.

    Args:
        seen: The picture.
        columns: Places of the numbers, the model's among them.
        counted: How much each segment (B,) counts beside its robust weight; 1 by default.
    """
    counts = np.ones(len(seen.chi2)) if counted is None else counted
    places, _ = layout(seen, columns)
    prior = 1 / widths(seen, columns) ** 2
    low = np.full(len(prior), -np.inf)
    for k, column in enumerate(columns):
        if column >= seen.base and seen.parameters[column].bounds[0] == 0.0:
            low[places[:, k]] = 0.0

    def at(value: Array) -> tuple[float, Array]:
        loss, weight = _losses(seen, columns, value)
        return float((loss * counts).sum() + (prior * value**2).sum()), weight * counts

    value = np.zeros(len(prior))
    cost, weight = at(value)
    for _ in range(ITERATIONS):
        information, score = sums(replace(seen, weight=weight), columns, prior)
        target = np.maximum(np.linalg.solve(information, score), low)
        for share in STEPS:
            trial = value + share * (target - value)
            found, heavier = at(trial)
            if found < cost - FALL:
                break
        else:
            break
        value, cost, weight = trial, found, heavier
    return RobustFit(tuple(columns), value, cost, sums(replace(seen, weight=weight), columns, prior)[0])


def robust_gains(seen: Picture, base: Sequence[int], columns: Sequence[int]) -> Array:
    """Return by how much each episode's robust loss falls when the others tell an effect's numbers.

    Args:
        seen: The picture.
        base: Places of the model's numbers, which are fitted along.
        columns: Places of the effect's.
    """
    gains = []
    for episode in np.unique(seen.episode):
        others = (seen.episode != episode).astype(np.float64)
        losses = []
        for chosen in (list(base), [*base, *columns]):
            value = robust_fit(seen, chosen, others).value
            losses.append(float(_losses(seen, chosen, value)[0][seen.episode == episode].sum()))
        gains.append(losses[0] - losses[1])
    return np.array(gains)


def _losses(seen: Picture, columns: Sequence[int], value: Array) -> tuple[Array, Array]:
    """Return loss and robust weight (B,) of each segment at given numbers."""
    chosen = list(columns)
    own = value[layout(seen, chosen)[0]]
    moved = (seen.information[:, chosen][:, :, chosen] @ own[..., None])[..., 0]
    chi2 = seen.chi2 - 2 * (seen.score[:, chosen] * own).sum(1) + (moved * own).sum(1)
    loss, weight = robust_excess(torch.as_tensor(chi2 - seen.dof))
    return loss.numpy(), weight.numpy()
