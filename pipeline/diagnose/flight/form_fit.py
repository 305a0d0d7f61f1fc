"""Flights linearised at the fit of an effect, in which force fields take its place."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...physics.effects.effect import ActiveEffect
from ...segments.candidates import Variant, base_parameters, base_values
from ...segments.flights.force_fields import FlownMotion, ForceField
from ...segments.linearization import derivatives
from ...segments.segment_fit import Linear, projected
from ...segments.segments import Segments
from ..evidence.session_scales import scale_variant
from ..thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]

LEAST_SHARE = 1e-3
"""Share of the information of all episodes from which one episode tells a direction of a form's numbers."""
SINGULAR = 1e-7
"""The same of the largest information, below which a direction is none."""


class FormCost(NamedTuple):
    """What a form in place of an effect leaves."""

    chi2: float
    """Chi2, up to a constant."""
    scatter: float
    """Factor by which variances between episodes exceed those of the noise; at least 1."""


class Scales(NamedTuple):
    """Scales of lengths that differ between sessions."""

    member: Array
    """What each flight has of each number by which they differ, (B, n)."""
    spread: float
    """Their standard deviation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FormFit:
    """Quadratic cost of episodes (E) in parameters and forms (n), at the fit of an effect, states eliminated."""

    information: Array
    """Information of each episode, shape (E, n, n)."""
    score: Array
    """Score of each episode, shape (E, n)."""
    prior: Array
    """Prior information, of the other parameters of the world alone, shape (n,)."""
    without: Array
    """Step (n,) that takes the effect away."""
    rest: list[int]
    """Places of the other parameters, and of the numbers by which sessions differ."""
    forms: list[list[int]]
    """Places of the numbers of each form."""
    more: list[list[list[int]]]
    """Places of the numbers of each further effect, at each combination of its constants."""
    others: dict[str, list[int]]
    """Places of the numbers of each other effect of the world that has a value for all episodes."""
    values: Array
    """Values of the other parameters, shape (n,)."""
    nonnegative: frozenset[int]
    """Places of numbers of further effects that are not negative."""
    count: float
    """Degrees of freedom of the flights."""

    @staticmethod
    def of(
        motion: FlownMotion,
        active: ActiveEffect,
        forms: Sequence[ForceField],
        more: Sequence[Variant] = (),
        scales: Scales | None = None,
    ) -> FormFit:
        """Return the cost of flights in the parameters of their world and in forms of an effect, its own first.

        Without a force, a body moves as with it less what the force does along the motion as it was: that is exact,
        where the derivative by its parameter also has what the force does to its own change of the motion. What is no
        force, as a scale, does more than the force that it is compared as: its own law is the effect itself.

        Args:
            motion: The flights.
            active: The effect.
            forms: Its forms.
            more: Further effects, at their neutral values.
            scales: How the scales of lengths of sessions differ.
        """
        flight = motion.flight
        own_scale = [] if scales is None else [scale_variant(flight.world)]
        parameters, rows, jacobian = derivatives(flight, flight.world, [*more, *own_scale])
        base, size = base_parameters(flight.world, "flight"), len(parameters) - len(own_scale)
        count, values = len(base), base_values(flight.world, base)
        columns = [jacobian[..., :size], motion.innovations(ForceField.joined(forms)).to(jacobian)]
        ends = np.cumsum([size, *(form.size for form in forms)]).tolist()
        last = ends[-1]
        if scales is not None:
            member = torch.tensor(scales.member).to(jacobian)[:, None, None]
            columns.append(jacobian[..., size : size + 1] * member)
            last += member.shape[-1]
        joined = torch.cat((*columns, jacobian[..., len(parameters) :]), -1)
        information, score = by_episode(flight, projected(flight, rows, joined, last))
        own = [k for k, p in enumerate(base) if p.name.partition(".")[0] == active.effect.name]
        rest = [k for k in range(count) if k not in own]
        widths = [parameters[k].prior[1] for k in rest]
        if scales is not None:
            rest, widths = [*rest, *range(ends[-1], last)], [*widths, *[scales.spread] * (last - ends[-1])]
        taken = range(size, size + len(own)) if active.effect.has("wrench") else own
        place = {p.name: k for k, p in enumerate(parameters)}
        further: dict[int, list[list[int]]] = {}
        for variant in more:
            further.setdefault(variant.place, []).append([place[name] for name in variant.parameters])
        others: dict[str, list[int]] = {}
        for k in range(count):
            if k not in own and base[k].shared == "all":
                others.setdefault(base[k].name.partition(".")[0], []).append(k)
        return FormFit(
            information=information,
            score=score,
            prior=_placed(rest, [width**-2.0 for width in widths], last),
            without=_placed(taken, [-float(values[k]) for k in own], last),
            rest=rest,
            forms=_forms(ends, [] if active.effect.has("wrench") else own),
            more=list(further.values()),
            others=others,
            values=_placed(range(count), values.tolist(), last),
            nonnegative=frozenset(k for k, p in enumerate(parameters) if k >= count and p.bounds[0] == 0.0),
            count=max(float(flight.dof.sum()), 2.0),
        )

    def in_its_stead(
        self, form: Sequence[int], dispersion: float, further: Sequence[int] = (), gone: Sequence[int] = ()
    ) -> FormCost:
        """Return chi2 with a form in place of the effect, and the scatter of its numbers between episodes.

        Args:
            form: Places of the numbers of the form.
            dispersion: Factor by which variances exceed those of the noise.
            further: Those of a further effect, which is none where a number is negative that may not be.
            gone: Those of another effect of the world that is taken away, too.
        """
        without = self.without.copy()
        without[list(gone)] = -self.values[list(gone)]
        step = self._solved([*(k for k in self.rest if k not in gone), *form, *further], without)
        if any(step[k] < 0 for k in further if k in self.nonnegative):
            return self.in_its_stead(form, dispersion)
        own = self.information[:, form]
        q, dof = _scatter(own[:, :, form], self.score[:, form] - own @ step)
        scatter = (LIMITS.model_counts + q / dispersion) / (LIMITS.model_counts + dof)
        return FormCost(self._cost(step) / dispersion, max(1.0, scatter))

    @cached_property
    def _total(self) -> tuple[Array, Array]:
        """Information (n, n) and score (n,) of all episodes."""
        return self.information.sum(0), self.score.sum(0)

    def _cost(self, step: Array) -> float:
        """Return the cost of a step (n,) from the fit, up to a constant."""
        information, score = self._total
        return float(step @ (information @ step) - 2 * score @ step)

    def _solved(self, free: Sequence[int], fixed: Array) -> Array:
        """Return the step (n,) of least cost in free places, from fixed ones."""
        places = list(free)
        information, score = self._total
        matrix = information[np.ix_(places, places)] + np.diag(self.prior[places])
        step = fixed.copy()
        step[places] += _inverse(matrix) @ (score - information @ fixed)[places]
        return step


def _forms(ends: Sequence[int], own: list[int]) -> list[list[int]]:
    """Return the places of the numbers of each form, that of the first one those of the effect where there are any."""
    found = [list(range(a, b)) for a, b in itertools.pairwise(ends)]
    return [own, *found[1:]] if own else found


def by_episode(flight: Segments, linear: Linear) -> tuple[Array, Array]:
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
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    along = ((slopes / size)[:, None] @ vectors)[:, 0]
    kept = values > LEAST_SHARE
    return float((along[kept] ** 2 / values[kept]).sum()), max(int(kept.sum()) - len(size), 0)


def _inverse(matrix: Array) -> Array:
    """Return the inverse of an information matrix in its measured directions."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    kept = values > SINGULAR
    return (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(size, size)
