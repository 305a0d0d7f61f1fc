"""Refits: chosen numbers of the model and the states of all segments at once, by Gauss-Newton with damping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..estimation.least_squares import bound_stops
from ..physics.parameters import Parameter, apply_parameters
from ..physics.world import World
from .candidates import base_values
from .linear import Linear, linearised, robust_excess, summed
from .segment_states import best_of
from .segments import Segments

Array = NDArray[np.float64]

ITERATIONS = 6
FALL = 0.05
"""A refit ends when the cost falls by less: a twentieth of a standard error of one number."""
FALL_SHARE = 1e-3
"""Or by less than this share of it: where the law misses far more than the noise, less is roughness."""


@dataclass(frozen=True)
class Refit:
    """Where a refit ended.

    world: with the numbers found; parameters (P); values (P,) and covariance (P, P) in fitted coordinates; segments,
    with their states; cost: chi2 of flight, and rho of the excess of contact; by_segment: the same of each, by part.
    """

    world: World
    parameters: tuple[Parameter, ...]
    values: Tensor
    covariance: Tensor
    segments: tuple[Segments, ...]
    cost: float
    by_segment: tuple[Tensor, ...]

    def number(self, name: str) -> tuple[float, float]:
        """Return estimate and standard error of a parameter, in its own unit."""
        k = [p.name for p in self.parameters].index(name)
        p = self.parameters[k]
        estimate = float(p.decode(self.values[k]))
        return estimate, float(self.covariance[k, k].clamp_min(0.0).sqrt()) * (estimate if p.logarithmic else 1.0)


def refit(
    parts: Sequence[Segments],
    world: World,
    parameters: Sequence[Parameter],
    start: Tensor | None = None,
    iterations: int = ITERATIONS,
) -> Refit:
    """Fit parameters and states, from neighbouring ones.

    Args:
        parts: Flight and contact segments, or one of them, with fitted states.
        world: The model's world, with the effects that are fitted.
        parameters: What is fitted beside the states; priors are centred on where they start.
        start: Where (P,), in fitted coordinates; None for the world's own values.
        iterations: Most steps.
    """
    centre = base_values(world, parameters)
    values = centre if start is None else start
    prior = torch.tensor([1 / p.prior[1] ** 2 for p in parameters]).to(centre)
    bounds = torch.tensor([p.limits for p in parameters]).reshape(-1, 2).to(centre)
    parts = [part.in_world(world) for part in parts]
    pictures = [linearised(part, parameters, values) for part in parts]
    cost, damping = _cost(parts, pictures, values, centre, prior), 1e-3
    for _ in range(iterations):
        matrix, slope = _normal(parts, pictures)
        matrix = matrix + torch.diag(prior)
        slope = slope - prior * (values - centre)
        step = _step(matrix, slope, values, bounds, damping)
        moved = (values + step).clamp(bounds[:, 0], bounds[:, 1])
        trial = [
            part.moved(picture.state_step - (picture.by_parameter @ (moved - values)))
            for part, picture in zip(parts, pictures, strict=True)
        ]
        # through contact, states do not always follow in a straight line
        trial = [
            best_of(before, [after.observations.state], parameters, moved) if after.kind == "contact" else after
            for before, after in zip(parts, trial, strict=True)
        ]
        seen = [linearised(part, parameters, moved) for part in trial]
        found = _cost(trial, seen, moved, centre, prior)
        if found < cost:
            fall, cost, damping = cost - found, found, damping / 5
            parts, pictures, values = trial, seen, moved
            if fall < max(FALL, FALL_SHARE * cost):
                break
        else:
            damping *= 20
            if damping > 1e4:
                break
    matrix, _ = _normal(parts, pictures)
    covariance = torch.linalg.pinv(matrix + torch.diag(prior), hermitian=True)
    columns = torch.stack([p.decode(values[k]) for k, p in enumerate(parameters)])[None] if parameters else None
    after = world if columns is None else apply_parameters(world, parameters, columns)
    by_segment = tuple(_losses(part, picture) for part, picture in zip(parts, pictures, strict=True))
    return Refit(after, tuple(parameters), values, covariance, tuple(parts), cost, by_segment)


def _losses(part: Segments, picture: Linear) -> Tensor:
    """Return the cost (B,) of each segment; infinite where a rollout diverged."""
    chi2 = torch.nan_to_num(picture.chi2, nan=torch.inf, posinf=torch.inf)
    return chi2 if part.kind == "flight" else robust_excess(chi2 - picture.dof)[0]


def _cost(
    parts: Sequence[Segments], pictures: Sequence[Linear], values: Tensor, centre: Tensor, prior: Tensor
) -> float:
    data = sum(float(_losses(part, picture).sum()) for part, picture in zip(parts, pictures, strict=True))
    return data + float((prior * (values - centre).square()).sum())


def _normal(parts: Sequence[Segments], pictures: Sequence[Linear]) -> tuple[Tensor, Tensor]:
    matrix, slope = [], []
    for part, picture in zip(parts, pictures, strict=True):
        weight = picture.weight if part.kind == "contact" else None
        matrix.append(summed(picture.information, weight))
        slope.append(summed(picture.score, weight))
    return torch.stack(matrix).sum(0), torch.stack(slope).sum(0)


def _step(matrix: Tensor, slope: Tensor, values: Tensor, bounds: Tensor, damping: float) -> Tensor:
    """Return a damped step; a parameter that a bound stops takes no part."""
    free = (~bound_stops(values, slope, bounds)).to(slope)
    damped = torch.diag(damping * matrix.diagonal() + (1 - free))
    return torch.linalg.solve(matrix * free[:, None] * free + damped, slope * free)
