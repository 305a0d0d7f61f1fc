"""Robust fits of a linearization: segments that no candidate explains are downweighted.

The loss of a segment is rho of its excess chi2 - dof (see `segment_fit.robust_excess`), and its chi2 is quadratic in
the parameters. The minimum of the sum is found by iterative reweighting, so that a segment that only the candidate
explains regains its weight; weights from the misfit without the candidate would suppress the most informative segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..segments.linearization import Linearization, layout, sums, widths
from ..segments.segment_fit import robust_excess

Array = NDArray[np.float64]

OWN_SHARE = 0.1
"""Standard deviation of the contact parameters (friction, contact time, damping) between segments, in widths of their
priors. No contact law is exact, and a residual that such deviations explain is no evidence for an effect."""
ITERATIONS = 12
"""Maximum number of reweighting iterations."""
STEPS = (1.0, 0.5, 0.25, 0.1)
"""Shares of a step that are tried in turn."""
FALL = 1e-6
"""Minimum fall of the cost for a step to be accepted."""


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Minimum of the robust loss over chosen parameters."""

    columns: tuple[int, ...]
    """Columns of the parameters in the linearization."""
    value: Array
    """Parameters (k,) in the order of `linearization.layout`."""
    cost: float
    """Robust loss plus the cost of the priors."""
    information: Array
    """Information (k, k) with the weights at the minimum."""


def with_segment_parameters(linear: Linearization) -> Linearization:
    """Return the linearization with random deviations of the model's parameters in each segment.

    The deviations d of a segment, with prior information L, are projected out: its information M, score g and chi2
    become M - M_b (M_bb + L)^-1 M_b', g - M_b (M_bb + L)^-1 g_b and chi2 - g_b' (M_bb + L)^-1 g_b.
    """
    base = list(range(linear.base))
    if not base:
        return linear
    width = OWN_SHARE * np.array([linear.parameters[k].prior[1] for k in base])
    own = linear.information[:, base][:, :, base] + np.diag(1 / width**2)
    mixed, slope = linear.information[:, base], linear.score[:, base]
    solved = np.linalg.solve(own, np.concatenate([mixed, slope[..., None]], -1))
    return replace(
        linear,
        information=linear.information - mixed.transpose(0, 2, 1) @ solved[..., :-1],
        score=linear.score - (mixed.transpose(0, 2, 1) @ solved[..., -1:])[..., 0],
        chi2=linear.chi2 - (slope * solved[..., -1]).sum(1),
    )


def robust_fit(linear: Linearization, columns: Sequence[int], counted: Array | None = None) -> RobustFit:
    """Minimize the robust loss over chosen parameters, starting at zero; lower bounds at zero are kept.

    Args:
        linear: The linearization.
        columns: Columns of the parameters, including the model's.
        counted: Weight of each segment (B,) in addition to its robust weight; 1 by default.
    """
    counts = np.ones(len(linear.chi2)) if counted is None else counted
    places, _ = layout(linear, columns)
    prior = 1 / widths(linear, columns) ** 2
    low = np.full(len(prior), -np.inf)
    for k, column in enumerate(columns):
        if column >= linear.base and linear.parameters[column].bounds[0] == 0.0:
            low[places[:, k]] = 0.0

    def at(value: Array) -> tuple[float, Array]:
        """Return the cost at given parameters and the weight of each segment there."""
        loss, weight = _losses(linear, columns, value)
        return float((loss * counts).sum() + (prior * value**2).sum()), weight * counts

    value = np.zeros(len(prior))
    cost, weight = at(value)
    for _ in range(ITERATIONS):
        information, score = sums(replace(linear, weight=weight), columns, prior)
        target = np.maximum(np.linalg.solve(information, score), low)
        for share in STEPS:
            trial = value + share * (target - value)
            found, heavier = at(trial)
            if found < cost - FALL:
                break
        else:
            break
        value, cost, weight = trial, found, heavier
    return RobustFit(tuple(columns), value, cost, sums(replace(linear, weight=weight), columns, prior)[0])


def robust_gains(linear: Linearization, base: Sequence[int], columns: Sequence[int]) -> Array:
    """Return the fall of each episode's robust loss with an effect's parameters estimated from the other episodes.

    Args:
        linear: The linearization.
        base: Columns of the model's parameters, which are fitted jointly.
        columns: Columns of the effect's parameters.
    """
    gains = []
    for episode in np.unique(linear.episode):
        others = (linear.episode != episode).astype(np.float64)
        losses = []
        for chosen in (list(base), [*base, *columns]):
            value = robust_fit(linear, chosen, others).value
            losses.append(float(_losses(linear, chosen, value)[0][linear.episode == episode].sum()))
        gains.append(losses[0] - losses[1])
    return np.array(gains)


def _losses(linear: Linearization, columns: Sequence[int], value: Array) -> tuple[Array, Array]:
    """Return loss and robust weight (B,) of each segment at given parameters."""
    chosen = list(columns)
    own = value[layout(linear, chosen)[0]]
    moved = (linear.information[:, chosen][:, :, chosen] @ own[..., None])[..., 0]
    chi2 = linear.chi2 - 2 * (linear.score[:, chosen] * own).sum(1) + (moved * own).sum(1)
    loss, weight = robust_excess(torch.as_tensor(chi2 - linear.dof))
    return loss.numpy(), weight.numpy()
