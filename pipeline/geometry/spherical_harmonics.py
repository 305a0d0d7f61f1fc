"""View-dependent colours by real spherical harmonics up to degree 3.

Basis and signs are those of 3D Gaussian splatting (its rasteriser; arXiv 2308.04079), so that its viewers show the same
colours.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...datasets.shapes.ply import SH_C0


def term_count(degree: int) -> int:
    """Return the number of harmonics up to a degree."""
    return (degree + 1) ** 2


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """Evaluate the harmonics (N, (degree + 1)^2) at unit directions (N, 3) from camera to sphere, world frame."""
    x, y, z = directions.unbind(-1)
    terms = [torch.full_like(x, SH_C0)]
    if degree > 0:
        c1 = 0.4886025119029199
        terms += [-c1 * y, c1 * z, -c1 * x]
    if degree > 1:
        c2 = 1.0925484305920792
        terms += [
            c2 * x * y,
            -c2 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -c2 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree > 2:
        a, b = 0.5900435899266435, 0.4570457994644658
        terms += [
            -a * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -b * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -b * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(terms, -1)


def rotated(higher: Tensor, rotation: Tensor) -> Tensor:
    """Return harmonics from degree 1 on whose colours turn with a rotation.

    The new ones have at a direction d the value of the old ones at R^T d. Harmonics of one degree turn among
    themselves, so that the matrix follows from as many directions as that degree has terms, or more.

    Args:
        higher: Coefficients, shape (N, (degree + 1)^2 - 1, 3).
        rotation: R, shape (3, 3).
    """
    degree, first, parts = round((higher.shape[1] + 1) ** 0.5) - 1, 0, []
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator, dtype=torch.float64), dim=-1)
    there = harmonics(directions, degree)[:, 1:]
    before = harmonics(directions @ rotation.detach().double().cpu(), degree)[:, 1:]
    for one in range(1, degree + 1):
        rows = slice(first, first + 2 * one + 1)
        matrix = torch.linalg.lstsq(there[:, rows], before[:, rows]).solution
        parts.append(torch.einsum("kl,nlc->nkc", matrix.to(higher), higher[:, rows]))
        first = rows.stop
    return torch.cat(parts, 1)


def seen_colors(colors: Tensor, higher: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """Return the colours (N, 3) of spheres as seen by a camera, at least 0.

    Args:
        colors: Mean colours over all directions, shape (N, 3).
        higher: Coefficients of the harmonics from degree 1 on, shape (N, (degree + 1)^2 - 1, 3).
        means: Centres, world frame [m], shape (N, 3).
        eye: Centre of the camera, world frame [m], shape (3,).
    """
    degree = round((higher.shape[1] + 1) ** 0.5) - 1
    directions = torch.nn.functional.normalize(means - eye, dim=-1)
    basis = harmonics(directions, degree)[:, 1:]
    return (colors + (basis[:, :, None] * higher).sum(1)).clamp_min(0.0)
