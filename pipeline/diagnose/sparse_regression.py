"""Sparse regression of the residual wrench: terms and exponents of a law where no candidate explains the residual.

The residual accelerations of windows, weighted by their information, are regressed on a dictionary of physical terms.
Terms are added one by one as long as each lowers BIC by a margin. The data are accelerations with their information,
not derivatives of the tracks, which are dominated by noise.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..physics.effects.effect import Effect
from ..segments.flights.residual_wrench import TERMS, ResidualWrenches, unit_acceleration
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.experiment

Array = NDArray[np.float64]

EXPONENTS = tuple(np.arange(0.0, 3.51, 0.25).tolist())
"""Exponents of the speed that are tried."""


@dataclass(frozen=True)
class Term:
    """Term of a law."""

    name: str
    """Name in `DICTIONARY`."""
    coefficient: float
    """Coefficient in `unit`."""
    std_error: float
    """Standard error of the coefficient, in `unit`."""
    unit: str
    """Unit of the coefficient."""


@dataclass(frozen=True)
class Law:
    """Law of a residual wrench."""

    terms: tuple[Term, ...]
    """Terms in the order in which they were added."""
    exponents: dict[str, tuple[float, float, float]]
    """Exponent of the speed by term: best value and limits of the 95 % interval."""
    left_chi2: float
    """Chi2 per degree of freedom of the residual of the law."""


def residual_law(found: ResidualWrenches) -> Law:
    """Fit a law to residual wrenches (n windows) by forward selection of terms."""
    target, information = found.wrench, found.information
    columns = {name: build(found) for name, (build, _) in DICTIONARY.items()}
    chosen: list[str] = []
    total = _chi2(target, information)
    penalty = math.log(max(6 * len(target), 2)) + LIMITS.law_margin
    while len(chosen) < LIMITS.most_terms:
        gains = {
            name: total - _fit([columns[k] for k in (*chosen, name)], target, information)[2]
            for name in columns
            if name not in chosen
        }
        best = max(gains, key=lambda name: gains[name])
        if gains[best] < penalty:
            break
        chosen.append(best)
        total -= gains[best]
    left = total / max(6 * len(target) - len(chosen), 1)
    if not chosen:
        return Law((), {}, left)
    value, covariance, _ = _fit([columns[name] for name in chosen], target, information)
    terms = tuple(
        Term(name, float(v), float(s), DICTIONARY[name][1])
        for name, v, s in zip(chosen, value, np.sqrt(np.diag(covariance)), strict=True)
    )
    exponents = {}
    for name in chosen:
        power = POWERS.get(name)
        if power is not None:
            others = [columns[k] for k in chosen if k != name]
            exponents[name] = _exponent(power, others, found)
    return Law(terms, exponents, left)


def _exponent(
    power: Callable[[ResidualWrenches, float], Array], others: list[Array], found: ResidualWrenches
) -> tuple[float, float, float]:
    """Return the exponent with the lowest chi2, and the range in which it rises by less than `exponent_chi2`."""
    costs = np.array([_fit([power(found, p), *others], found.wrench, found.information)[2] for p in EXPONENTS])
    near = [p for p, cost in zip(EXPONENTS, costs, strict=True) if cost < costs.min() + LIMITS.exponent_chi2]
    return EXPONENTS[int(costs.argmin())], min(near), max(near)


def _fit(columns: list[Array], target: Array, information: Array) -> tuple[Array, Array, float]:
    """Return coefficients, covariance and chi2 of a weighted regression; columns (n, 6)."""
    design = np.stack(columns, -1).astype(np.float64)
    normal = np.einsum("nik,nij,njl->kl", design, information, design)
    slope = np.einsum("nik,nij,nj->k", design, information, target)
    covariance = np.linalg.pinv(normal, hermitian=True)
    value = covariance @ slope
    return value, covariance, _chi2(target - design @ value, information)


def _chi2(target: Array, information: Array) -> float:
    """Return chi2 of residual accelerations (n, 6)."""
    return float(np.einsum("ni,nij,nj->", target, information, target))


def _linear(values: Array) -> Array:
    """Return a column (n, 6) of linear accelerations (n, 3)."""
    return np.concatenate((values, np.zeros_like(values)), 1)


def _angular(values: Array) -> Array:
    """Return a column (n, 6) of angular accelerations (n, 3)."""
    return np.concatenate((np.zeros_like(values), values), 1)


def _along(values: Array, exponent: float) -> Array:
    """Return |v|^(p - 1) v for vectors v (n, 3) and exponent p."""
    size = np.linalg.norm(values, axis=1, keepdims=True).clip(1e-6)
    return values * size ** (exponent - 1)


def _unit(kind: type[Effect], parameter: str) -> str:
    """Return the unit of a parameter of an effect."""
    return next(one.unit for one in kind.parameters if one.name == parameter)


DICTIONARY: dict[str, tuple[Callable[[ResidualWrenches], Array], str]] = {
    **{
        name: (functools.partial(unit_acceleration, term=name), _unit(kind, parameter))
        for name, (kind, parameter) in TERMS.items()
    },
    "-|omega| omega": (lambda f: _angular(-_along(f.omega, 2)), "1/rad"),
}
"""Column builder and unit of each term: those of effects, and one that is none; of the acceleration, and with omega
alone of the angular acceleration."""
POWERS: dict[str, Callable[[ResidualWrenches, float], Array]] = {
    "-u": lambda f, p: _linear(-_along(f.velocity, p)),
    "-|u| u": lambda f, p: _linear(-_along(f.velocity, p)),
    "-omega": lambda f, p: _angular(-_along(f.omega, p)),
    "-|omega| omega": lambda f, p: _angular(-_along(f.omega, p)),
}
"""Column builders of the damping terms for any exponent of the speed."""
