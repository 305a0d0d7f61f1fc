"""How large the errors of flights are in the shape in time that an effect has.

The noise of tracks has a model, and residuals may be of its size on the whole and still larger where an effect shows: a
marker beside the centre moves at the rate of the spin, a drag over a whole flight, and an error that lasts that long
counts for many frames. So what an effect does along one axis is put along each of the axes instead, separately in each
flight. There it is no effect of the library, and what the residuals have of it tells how large errors of this shape
are, among them those of smoothing, bursts and hands that no model of errors has.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...optimization.tails import student_quantile
from ...optimization.uncertainty import REACH, inverse, raised
from .contrasts import KEPT

Array = NDArray[np.float64]


def no_narrower(covariance: Array, rows: Tensor, jacobian: Tensor, prior: Array) -> Array:
    """Return a covariance (P, P) whose variances allow for the errors that flights have in the shape of each effect.

    Args:
        covariance: Of the parameters; correlations stay.
        rows: Residuals (B, F, 6) of flights in sigmas, at the estimates and the states that go with them.
        jacobian: Their derivatives (B, F, 6, P + S) by parameters and states.
        prior: Information of the parameters' priors (P, P).
    """
    rows, jacobian = torch.nan_to_num(rows).double(), torch.nan_to_num(jacobian).double()
    count = len(covariance)
    states = _basis(jacobian[..., count:].flatten(1, 2))
    slopes = jacobian[..., :count].flatten(1, 2)
    slopes = slopes - states @ (states.mT @ slopes)
    curvature = inverse((slopes.mT @ slopes).sum(0).numpy() + prior)
    left = rows.flatten(1, 2)[..., None]
    left = (left - states @ (states.mT @ left)).view_as(rows)
    # the direction in which the residuals move each estimate
    along = jacobian[..., :count] @ torch.from_numpy(curvature)
    excess, counts = _turned(along, left, states.unflatten(1, (-1, 6)), (rows != 0).any(1))
    reach = np.array([student_quantile(0.975, max(float(n), 1.0)) / REACH for n in counts])
    least = np.diag(curvature) * excess.numpy() * reach**2
    return raised(covariance, np.diag(least))


def _basis(columns: Tensor) -> Tensor:
    """Return an orthonormal basis (B, n, S) of columns (B, n, S), with zeros for those that others contain."""
    length = columns.norm(dim=1, keepdim=True)
    basis, size, _ = torch.linalg.svd(columns / length.clamp_min(1e-300), full_matrices=False)
    return basis * (size > KEPT * size.amax(1, keepdim=True))[:, None]


def _turned(along: Tensor, left: Tensor, states: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean square (P,) of residuals along displacements put along other axes, and how many these are (P,).

    Args:
        along: Displacements (B, F, 6, P), positions before rotations.
        left: Residuals (B, F, 6) without what the states explain.
        states: Orthonormal basis (B, F, 6, S) of what the states can follow.
        seen: Which of the six are measured (B, 6).
    """
    moved, left = along.unflatten(2, (2, 3)), left.unflatten(2, (2, 3))
    states, seen = states.unflatten(2, (2, 3)), seen.unflatten(1, (2, 3)).to(left)
    score = torch.einsum("bfhip,bfhj->bhijp", moved, left)
    lost = torch.einsum("bfhip,bfhjs->bhjpis", moved, states)
    size = torch.einsum("bfhip,bfhkp->bhpik", moved, moved)[:, :, None] - lost @ lost.mT
    size = size * seen[..., None, None, None]
    whole = size.diagonal(dim1=-2, dim2=-1).sum((0, 1, 2, 4))
    squares = size.square().sum((0, 1, 2, 4, 5))
    excess = score.square().sum((0, 1, 2, 3)) / whole.clamp_min(1e-300)
    return excess, whole.square() / squares.clamp_min(1e-300)
