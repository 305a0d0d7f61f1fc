"""Flights linearised at the fit of an effect, in which force fields take its place."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..physics.effects.effect import ActiveEffect
from ..segments.candidates import base_parameters, base_values
from ..segments.force_fields import FlownMotion, ForceField
from ..segments.segment_fit import Linear, projected
from ..segments.segments import Segments
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]

LEAST_SHARE = 1e-3
"""Share of the information of all episodes from which one episode tells a direction of a form's numbers."""
SINGULAR = 1e-7
"""The same of the largest information, below which a direction is none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FormFit:
    """Quadratic cost of episodes (E) in parameters and forms (n), at the fit of an effect, states eliminated."""

    information: Array
    """Information of each episode, shape (E, n, n)."""
    score: Array
    """Score of each episode, shape (E, n)."""
    prior: Array
    """Prior information, of the other parameters alone, shape (n,)."""
    without: Array
    """Step (n,) that takes the effect away."""
    rest: list[int]
    """Places of the other parameters."""
    forms: list[list[int]]
    """Places of the numbers of each form."""

    @staticmethod
    def of(motion: FlownMotion, active: ActiveEffect, forms: Sequence[ForceField]) -> FormFit:
        """Return the cost of flights in the parameters of their world and in forms of an effect, its own first.

        Without a force, a body moves as with it less what the force does along the motion as it was: that is exact,
        where the derivative by its parameter also has what the force does to its own change of the motion.
        """
        flight = motion.flight
        parameters = base_parameters(flight.world, "flight")
        count, values = len(parameters), base_values(flight.world, parameters)
        rows, jacobian = flight.residuals(parameters, values)
        columns = motion.innovations(ForceField.joined(forms)).to(jacobian)
        ends = np.cumsum([count, *(form.size for form in forms)]).tolist()
        joined = torch.cat((jacobian[..., :count], columns, jacobian[..., count:]), -1)
        information, score = _by_episode(flight, projected(flight, rows, joined, ends[-1]))
        own = [k for k, p in enumerate(parameters) if p.name.partition(".")[0] == active.effect.name]
        rest = [k for k in range(count) if k not in own]
        taken = range(count, count + len(own)) if active.effect.has("wrench") else own
        return FormFit(
            information=information,
            score=score,
            prior=_placed(rest, [1 / parameters[k].prior[1] ** 2 for k in rest], ends[-1]),
            without=_placed(taken, [-float(values[k]) for k in own], ends[-1]),
            rest=rest,
            forms=[list(range(a, b)) for a, b in itertools.pairwise(ends)],
        )

    def in_its_stead(self, form: Sequence[int], dispersion: float) -> tuple[float, float]:
        """Return chi2 with a form in place of the effect, up to a constant, and its scatter between episodes."""
        step = self._solved([*self.rest, *form], self.without)
        slopes = self.score - self.information @ step
        q, dof = _scatter(self.information[:, form][:, :, form], slopes[:, form])
        scatter = (LIMITS.model_counts + q / dispersion) / (LIMITS.model_counts + dof)
        return self._cost(step) / dispersion, max(1.0, scatter)

    def _cost(self, step: Array) -> float:
        """Return the cost of a step (n,) from the fit, up to a constant."""
        return float(step @ (self.information.sum(0) @ step) - 2 * self.score.sum(0) @ step)

    def _solved(self, free: Sequence[int], fixed: Array) -> Array:
        """Return the step (n,) of least cost in free places, from fixed ones."""
        places = list(free)
        total = self.information.sum(0)
        matrix = total[np.ix_(places, places)] + np.diag(self.prior[places])
        step = fixed.copy()
        step[places] += _inverse(matrix) @ (self.score.sum(0) - total @ fixed)[places]
        return step


def _by_episode(flight: Segments, linear: Linear) -> tuple[Array, Array]:
    """Return information (E, n, n) and score (E, n) of the episodes of flights."""
    episode = np.unique([item.episode for item in flight.items], return_inverse=True)[1]
    information = np.zeros((episode.max() + 1, *linear.information.shape[1:]))
    score = np.zeros(information.shape[:2])
    np.add.at(information, episode, linear.information.double().numpy())
    np.add.at(score, episode, linear.score.double().numpy())
    return information, score


def _placed(places: Sequence[int], values: Sequence[float], size: int) -> Array:
    """Return values at places of a vector of zeros."""
    found = np.zeros(size)
    found[list(places)] = values
    return found


def _scatter(information: Array, slopes: Array) -> tuple[float, int]:
    """Return Cochran's Q of numbers over episodes from their information (E, k, k) and slopes (E, k), and its dof."""
    size = np.sqrt(np.maximum(np.diagonal(information.sum(0)), 1e-300))
    q, rank = 0.0, 0
    for matrix, slope in zip(information, slopes, strict=True):
        values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
        kept = values > LEAST_SHARE
        along = vectors[:, kept].T @ (slope / size)
        q, rank = q + float((along**2 / values[kept]).sum()), rank + int(kept.sum())
    return q, max(rank - len(size), 0)


def _inverse(matrix: Array) -> Array:
    """Return the inverse of an information matrix in its measured directions."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    kept = values > SINGULAR
    return (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(size, size)
