"""Force laws of no library that a named effect may imitate, fitted in its stead to the flights that showed it.

A name is right only if the force has the law of that name. A gust, a force that sets in late, one that acts on one side
of the room, or a damping by another power of the spin is followed by the nearest effect of the library, too, and few
flights need not show what is left. The force that is named is therefore compared with other forms of it: the same one
during a part of the flights, above a height, on one side of a place, by another power of speed or spin. Each takes its
place in flights linearised at their fit, with the states and the other effects fitted again, and has as many numbers.

Before the data, no form of a family is likelier than another, no family likelier than another, and all together are as
likely as the law that is named; the odds are those of the mean likelihoods. No model of errors is exact, and how the
numbers of a form scatter from episode to episode tells how far it can be believed beside that form (`falsification`):
a difference of chi2 counts in units of that scatter.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..physics.effects.effect import ActiveEffect
from ..physics.world import World
from ..segments.candidates import base_parameters, base_values
from ..segments.force_fields import FlownMotion, ForceField
from ..segments.segment_fit import projected
from ..segments.segments import Segments
from .form_families import Family, families_of, own_field
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]

LEAST_SHARE = 1e-3
"""Share of the information of all episodes from which one episode tells a direction of a form's numbers."""
SINGULAR = 1e-7
"""The same of the largest information, below which a direction is none."""


@dataclass(frozen=True, kw_only=True)
class OtherForms:
    """Other forms of a named force, in its place."""

    effect: str
    """Name of the effect."""
    words: str
    """The form that explains the flights best, in words."""
    gain: float
    """Fall of chi2 with that form in place of the effect, beside the scatter between episodes."""
    odds: float
    """Twice the logarithm of the odds of all forms against the effect's own law."""

    @property
    def likelier(self) -> bool:
        """Whether the force has another form than that of the effect, rather than that one."""
        return self.odds > LIMITS.form_odds

    @property
    def as_good(self) -> bool:
        """Whether one form explains the flights as well as the effect, which is likelier all the same."""
        return not self.likelier and self.gain > 0


def other_forms(
    flight: Segments, world: World, classes: Sequence[tuple[str, ...]], dispersion: float
) -> list[OtherForms]:
    """Compare each named effect that is a force with its other forms.

    Args:
        flight: Segments with states fitted by the world.
        world: The world with the effects at their fitted parameters.
        classes: Names of each effect and of its equals, its own the first.
        dispersion: Factor by which variances exceed those of the noise.
    """
    motion, found = FlownMotion(flight.in_world(world)), []
    shared = [one for one in world.effects if all(p.shared == "all" for p in one.effect.parameters)]
    active = {one.effect.name: one for one in shared}
    for named in classes:
        own = own_field(motion, active[named[0]]) if named[0] in active else None
        if own is not None:
            found.append(_compared(motion, active[named[0]], own, families_of(motion, own, named), dispersion))
    return found


def _compared(
    motion: FlownMotion, active: ActiveEffect, own: ForceField, families: Sequence[Family], dispersion: float
) -> OtherForms:
    """Compare an effect, whose force is given, with families of other forms."""
    forms = {words: field for family in families for words, field in family.items()}
    fit = _Fit.of(motion, active, [own, *forms.values()])
    as_it_is = fit.in_its_stead(fit.forms[0], dispersion)[0]
    gains = {}
    for words, columns in zip(forms, fit.forms[1:], strict=True):
        chi2, scatter = fit.in_its_stead(columns, dispersion)
        gains[words] = (as_it_is - chi2) / scatter
    best = max(gains, key=lambda one: gains[one])
    halves = [_log_mean([0.5 * gains[words] for words in family]) for family in families]
    return OtherForms(effect=active.effect.name, words=best, gain=gains[best], odds=2 * _log_mean(halves))


def _log_mean(values: Sequence[float]) -> float:
    """Return the logarithm of the mean of exponentials."""
    return float(np.logaddexp.reduce(values)) - math.log(len(values))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Fit:
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
    def of(motion: FlownMotion, active: ActiveEffect, forms: Sequence[ForceField]) -> _Fit:
        """Return the cost of flights in the parameters of their world and in forms of an effect, its own first.

        Without a force, a body moves as with it less what the force does along the motion as it was: that is exact,
        where the derivative by its parameter also has what the force does to its own change of the motion.
        """
        flight, name = motion.flight, active.effect.name
        parameters = base_parameters(flight.world, "flight")
        values = base_values(flight.world, parameters)
        rows, jacobian = flight.residuals(parameters, values)
        count = len(parameters)
        sizes = np.cumsum([count, *(form.size for form in forms)])
        columns = motion.innovations(ForceField.joined(forms)).to(jacobian)
        joined = torch.cat((jacobian[..., :count], columns, jacobian[..., count:]), -1)
        linear = projected(flight, rows, joined, int(sizes[-1]))
        own = [k for k, p in enumerate(parameters) if p.name.partition(".")[0] == name]
        first = list(range(count, count + len(own)))
        rest = [k for k in range(count) if k not in own]
        episode = np.unique([item.episode for item in flight.items], return_inverse=True)[1]
        information = np.zeros((episode.max() + 1, *linear.information.shape[1:]))
        score = np.zeros(information.shape[:2])
        np.add.at(information, episode, linear.information.double().numpy())
        np.add.at(score, episode, linear.score.double().numpy())
        return _Fit(
            information=information,
            score=score,
            prior=_placed(rest, [1 / parameters[k].prior[1] ** 2 for k in rest], len(score[0])),
            without=_placed(
                first if active.effect.has("wrench") else own, [-float(values[k]) for k in own], len(score[0])
            ),
            rest=rest,
            forms=[list(range(a, b)) for a, b in itertools.pairwise(sizes.tolist())],
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
