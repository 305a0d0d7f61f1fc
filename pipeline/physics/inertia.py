"""Moments of inertia: a stretched mass, and the elements of a symmetric matrix."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def stretched_inertia(inertia: Tensor, stretch: Tensor) -> Tensor:
    """Return the inertia (n, 3, 3) of a mass stretched by symmetric matrices S (n, 3, 3).

    With C = tr(I)/2 - I the second moments (Wensing et al., "Linear matrix inequalities for physically consistent
    inertial parameter identification", 2018): C' = S C S, I' = tr(C') - C'.
    """
    eye = torch.eye(3, dtype=inertia.dtype, device=inertia.device)
    moment = 0.5 * _trace(inertia) * eye - inertia
    # the change is added, so that no stretch changes nothing bit for bit
    change = stretch @ moment @ stretch - moment
    change = 0.5 * (change + change.transpose(-1, -2))
    return inertia + _trace(change) * eye - change


def _trace(matrix: Tensor) -> Tensor:
    return matrix.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]


def symmetric(six: tuple[float, ...]) -> np.ndarray:
    """Return the symmetric matrix (3, 3) of (xx, yy, zz) or (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = (*six, 0.0, 0.0, 0.0)[:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_elements(matrix: np.ndarray) -> tuple[float, float, float, float, float, float]:
    """Return the elements (xx, yy, zz, xy, xz, yz) of a symmetric matrix (3, 3)."""
    xx, yy, zz, xy, xz, yz = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    return xx, yy, zz, xy, xz, yz
