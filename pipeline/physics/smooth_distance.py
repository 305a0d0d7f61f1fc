"""Smooth signed distance to a union of spheres."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from ..geometry.directions import fibonacci_directions

_PLANE_DIRECTIONS = 2000
"""Number of directions in which `plane_contacts` compares support functions."""


def smooth_min(distances: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """Return the smoothed minimum of signed distances and its weights.

    Source: the simplex smooth minimum of DexForge (arXiv 2610.06331), solved in closed form on the sorted distances
    (derived: with x the distances above the smallest, t = (S1 + sqrt(S1^2 - k (S2 - width^2))) / k for the k nearest).
    The value lies in [min d - 2 width / 3, min d]; its derivative by a distance is that distance's weight.

    Args:
        distances: Signed distances [m], shape (..., sphere), positive outside.
        width: Smoothing width [m], > 0.

    Returns:
        Smoothed distance [m], shape (...), and weights [1], shape (..., sphere), summing to 1.
    """
    nearest = distances.amin(-1, keepdim=True).detach()
    x = distances - nearest
    ordered = x.sort(-1).values
    count = torch.arange(1, x.shape[-1] + 1, dtype=x.dtype, device=x.device)
    first, second = ordered.cumsum(-1), ordered.square().cumsum(-1)
    root = (first.square() - count * (second - width * width)).clamp_min(0.0)
    # sqrt has no derivative at 0; candidates there are never the chosen one
    threshold = (first + torch.where(root > 0, root, torch.ones_like(root)).sqrt() * (root > 0)) / count
    following = torch.cat((ordered[..., 1:], torch.full_like(ordered[..., :1], torch.inf)), -1)
    valid = (ordered < threshold) & (threshold <= following)
    choice = valid.to(torch.int8).argmax(-1, keepdim=True)
    t = torch.gather(threshold, -1, choice)
    a = ((t - x) / width).clamp_min(0.0)
    value = (nearest + t).squeeze(-1) - width / 3 * (a.pow(3).sum(-1) + 2)
    return value, a.square()


def log_sum_exp_distance(distances: Tensor, per_m: float) -> tuple[Tensor, Tensor]:
    """Return the log-sum-exp smooth minimum of the paper for distances (..., N) [m], and its weights.

    -(1/beta) log sum exp(-beta d): between min d - log(N)/beta and min d.
    """
    scaled = -per_m * distances
    return -torch.logsumexp(scaled, -1) / per_m, torch.softmax(scaled, -1)


def union_distance(points: Tensor, centers: Tensor, radii: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """Return the signed distance of points to a union of spheres, and its outward unit normal.

    Args:
        points: Query points [m], shape (B, Q, 3).
        centers: Sphere centres [m], shape (B, N, 3), same frame.
        radii: Sphere radii [m], shape (B, N).
        width: Smoothing width [m].

    Returns:
        Distance [m], shape (B, Q), negative inside; and normal, shape (B, Q, 3), pointing out of the union.
    """
    offset = points[:, :, None, :] - centers[:, None, :, :]
    return blended(offset, radii[:, None, :], partial(smooth_min, width=width))


def blended(offset: Tensor, radii: Tensor, minimum: Callable[[Tensor], tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Return the distance and the outward normal of points to unions of spheres, each point with its own spheres.

    Args:
        offset: From the spheres' centres to the point [m], shape (..., N, 3).
        radii: The spheres' radii [m], shape (..., N).
        minimum: The smooth minimum: distances (..., N) to the value (...) and the weights (..., N).

    Returns:
        Distance [m], shape (...), and unit normal, shape (..., 3).
    """
    length2 = offset.square().sum(-1)
    length = torch.where(length2 > 0, length2, torch.ones_like(length2)).sqrt() * (length2 > 0)
    value, weights = minimum(length - radii)
    gradient = (weights[..., None] * offset / length.clamp_min(1e-12)[..., None]).sum(-2)
    norm2 = gradient.square().sum(-1, keepdim=True)
    # exactly between opposite spheres the direction is undefined; any unit vector serves, and upwards is stable
    up = torch.zeros_like(gradient)
    up[..., 2] = 1.0
    known = norm2 > 1e-16
    return value, torch.where(known, gradient / torch.where(known, norm2, torch.ones_like(norm2)).sqrt(), up)


def plane_contacts(centers: Tensor, radii: Tensor, tolerance_m: float = 1e-4) -> Tensor:
    """Return the indices (K,) of the spheres by which a plane touches a union of spheres.

    Contact with a plane depends only on the support function of the union, the largest n . c + r, to which most spheres
    on a flat side add nothing in addition to the corners. Spheres are chosen greedily where the support function of the
    chosen ones is farthest below that of all, until the difference is below the tolerance.

    Args:
        centers: Sphere centres [m], shape (N, 3).
        radii: Sphere radii [m], shape (N,).
        tolerance_m: Largest admitted loss of the support function [m].
    """
    directions = torch.as_tensor(fibonacci_directions(_PLANE_DIRECTIONS)).to(centers)
    reach = centers @ directions.T + radii[:, None]
    full, taken = reach.amax(0), torch.full_like(reach[0], -torch.inf)
    chosen: list[int] = []
    while True:
        lacking = full - taken
        place = int(lacking.argmax())
        if float(lacking[place]) <= tolerance_m:
            return torch.tensor(sorted(chosen), device=centers.device)
        chosen.append(int(reach[:, place].argmax()))
        taken = torch.maximum(taken, reach[chosen[-1]])
