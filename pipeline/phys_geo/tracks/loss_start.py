"""First guess of losses in joints from measured forces, where the motion leaves them open over decades.

The force that a driven body needs on a given path is a sum of what each loss takes, in proportion to it, so that it is
linear in the losses. Their logarithms, which are fitted, have no part in it where they are small: a descent from there
ends where it began. The guess is the best sum with factors that are not negative (Lawson and Hanson, 1974), from one
rollout without losses and one with each of them, as large as explains the forces best alone.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ...optimization.levenberg_marquardt import robust_loss
from .contact_result import ContactEstimate
from .force_residuals import ForceResiduals

OPEN = 1.0
"""Standard deviation of a fitted coordinate from which on the motion leaves a parameter open."""
APART = 1.0
"""Distance of the values of a loss that are tried, in logarithms."""
FELT = 0.01
"""Least change of a force by the losses that are tried, relative to the largest one, with which an interval shows how
well they explain the forces."""
ROUNDS = 10
"""Number of solutions, each with weights by the residuals of the one before."""


def loss_start(residuals: ForceResiduals, estimate: ContactEstimate, scale: float) -> NDArray[np.float64] | None:
    """Return fitted coordinates (P,) with a first guess of what the motion leaves open; None where it leaves nothing.

    Args:
        residuals: Residuals of forces on long intervals.
        estimate: Parameters from the motion.
        scale: Scale of the robust loss of a force, in standard deviations.
    """
    std = np.sqrt(np.diag(estimate.covariance))
    limits = np.array([p.limits for p in estimate.parameters])
    wide = [k for k, p in enumerate(estimate.parameters) if p.logarithmic and std[k] > OPEN]
    if not wide:
        return None
    from scipy.optimize import nnls  # dear to import, and seldom needed

    none = estimate.values.copy()
    none[wide] = limits[wide, 0]
    base, alone, sizes = _rolled(residuals, none[None])[0], [], []
    for k in wide:
        tried = np.repeat(none[None], round((limits[k, 1] - limits[k, 0]) / APART) + 1, 0)
        tried[:, k] = np.linspace(limits[k, 0], limits[k, 1], len(tried))
        found = _rolled(residuals, tried)
        best = int(found.norm(dim=-1).sum(-1).argmin())  # not the robust loss, which knows no difference far from 0
        alone.append(((found[best] - base) / np.exp(tried[best, k])).flatten())
        sizes.append(np.exp(tried[best, k]))
    slopes, target = (torch.stack(alone, 1) * torch.tensor(sizes)).numpy(), -base.flatten().numpy()
    size = np.linalg.norm(slopes.reshape(len(base), -1), axis=1)
    matters = torch.as_tensor(size > FELT * size.max(initial=0.0))  # the others know nothing of the misfit
    if not bool(matters.any()):
        return None
    weight, factors = np.ones(len(base)), np.zeros(len(wide))
    for _ in range(ROUNDS):
        each = np.sqrt(weight).repeat(3)
        factors, _ = nnls(each[:, None] * slopes, each * target)
        left = torch.as_tensor((slopes @ factors - target).reshape(-1, 3)).square().sum(-1)
        weight = robust_loss(left / max(float(left[matters].median()), 1.0), scale)[1].numpy()
    values = none.copy()
    values[wide] = np.log(np.maximum(factors * np.array(sizes), np.exp(limits[wide, 0])))
    return values.clip(limits[:, 0], limits[:, 1])


def _rolled(residuals: ForceResiduals, values: NDArray[np.float64]) -> torch.Tensor:
    """Return the residuals (K, N, 3) of all episodes, from the starts of their first frames."""
    some = torch.as_tensor(values)
    still = some.new_zeros(len(some), residuals.start_size)
    return torch.cat([residuals.of(k, some, still) for k in range(len(residuals.forces))], 1)
