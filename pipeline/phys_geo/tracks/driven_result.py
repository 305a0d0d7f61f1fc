"""What measured forces tell of a jointed body beside its motion, and how the two become one estimate.

Losses and mass by momentum, and friction by sliding, are known without the contact law: they take the place of what the
motion says of them, and a search for the law begins with them. What the motion says of the law's contact time and
damping ratio rests on how deep bodies press into each other, which is the difference of tracks and shapes. Under a load
F a contact is p = tau^2 F / m deep, so that an error g of the gap moves the logarithm of tau by g / (2 p), and that of
the damping ratio, whose damper is told by speeds, as much. A shape that is off is fitted in the search, as a
parameter that is dropped afterwards. Noise of the path is a nuisance: with information I of the data, prior P and
covariance V of what the nuisance moves,

    C = (I (1 + V I)^-1 + P)^-1,

which is the Schur complement of the nuisance; without one nothing changes, and a large one leaves the prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ....schemas.materials import of_pair
from ...physics.chains.values import with_chain_values
from ...physics.parameters import CONTACT_TIME, DAMPING_RATIO, FRICTION, GROUND_SHIFT, Parameter
from ...physics.world import World
from ...segments.fitted_parameters import LIMITS
from .contact_result import ContactEstimate

UNTOLD = LIMITS.unobservable_share
"""Standard error, as a share of the prior's, from which on a parameter is not observable."""
Start = tuple[Parameter, float]
"""A parameter of a search, and where it starts."""


@dataclass(frozen=True, kw_only=True)
class Pressed:
    """What forces tell of a driven body and the link that it pushes."""

    pair: tuple[str, str] | None
    """Their materials, where these have a law of their own."""
    friction: tuple[float, float] | None
    """Logarithm of their friction, and its variance; None where nothing slides for sure."""
    rate_m_s2: float
    """Usual force between them, by the mass that it moves [m/s2]; 0 where nothing presses."""
    gap_std_m: float
    """Error of the gap between them that a search does not know [m]: noise of the path of the driven body and, where
    its shape is not fitted, that of the shape."""

    def moved_by_gap(self, contact_time_s: float) -> float:
        """Return the standard deviation of the logarithm of a contact time by the error of the gap."""
        depth = self.rate_m_s2 * contact_time_s**2
        return self.gap_std_m / (2 * depth) if depth > 0 else 0.0


@dataclass(frozen=True, kw_only=True)
class DrivenFit:
    """Numbers of a jointed body from measured forces."""

    parameters: Sequence[Parameter]
    """Losses of its joints and the factor of its mass (P)."""
    values: NDArray[np.float64]
    """Estimate in fitted coordinates, shape (P,)."""
    covariance: NDArray[np.float64]
    """Covariance, shape (P, P)."""
    pressed: Sequence[Pressed]
    """What is known of each driven body and the link that it pushes."""
    record: dict[str, Any]
    """Course of the fit, for `fit.json`."""
    open: frozenset[str] = frozenset()
    """Names of parameters of the contact law that the motion does not tell."""

    def world(self, world: World) -> World:
        """Return the world with the mass that was found."""
        mass = [(p, v) for p, v in zip(self.parameters, self.values, strict=True) if p.name.endswith(".mass_factor")]
        return with_chain_values(world, {p.name: p.decode(torch.tensor([v])) for p, v in mass})

    def narrowed(self, start: Sequence[Start]) -> list[Start]:
        """Return the parameters of a search with what is known as their priors, and where it starts."""
        return [self._narrow(*one) for one in start]

    def told(self) -> DrivenFit:
        """Return the part of the parameters that are observable."""
        rows = [k for k, p in enumerate(self.parameters) if self.covariance[k, k] < (UNTOLD * p.prior[1]) ** 2]
        names = [self.parameters[k] for k in rows]
        return replace(self, parameters=names, values=self.values[rows], covariance=self.covariance[np.ix_(rows, rows)])

    def leave_open(self, estimate: ContactEstimate) -> ContactEstimate:
        """Return the estimate of a search with the widths of the priors for parameters that are not observable.

        What it says of them rests on how deep bodies press into each other. Values stay, as they go with the others.
        """
        known = {p.name for p in self.told().parameters}
        open_now = {p.name for p in self.parameters} - known | self.open
        covariance = estimate.covariance.copy()
        for k, parameter in enumerate(estimate.parameters):
            if parameter.name in open_now:
                covariance[k], covariance[:, k] = 0.0, 0.0
                covariance[k, k] = parameter.prior[1] ** 2
        return replace(estimate, covariance=covariance)

    def put_in(self, estimate: ContactEstimate, parameters: Sequence[Parameter]) -> ContactEstimate:
        """Return the estimate of a search with what forces tell in place of what it says of the same numbers.

        Args:
            estimate: Of the search, whose priors are narrow.
            parameters: Its parameters as they were before.
        """
        usual = {p.name: p for p in parameters}
        names = [usual.get(p.name, p) for p in estimate.parameters]
        added = [p for p in self.parameters if p.name not in usual]
        place = len(names) - (names[-1] is GROUND_SHIFT)
        kept = [*range(place), *range(place + len(added), len(names) + len(added))]
        names[place:place] = added
        values, covariance = np.zeros(len(names)), np.zeros((len(names), len(names)))
        values[kept], covariance[np.ix_(kept, kept)] = estimate.values, estimate.covariance
        column = {p.name: k for k, p in enumerate(names)}
        rows = [column[p.name] for p in self.parameters]
        covariance[rows], covariance[:, rows] = 0.0, 0.0
        values[rows], covariance[np.ix_(rows, rows)] = self.values, self.covariance
        for one in self.pressed:
            k = column.get(of_pair(FRICTION.name, one.pair))
            if k is not None:
                covariance[k], covariance[:, k] = 0.0, 0.0
                prior = names[k].encode(names[k].prior[0]), names[k].prior[1] ** 2
                values[k], covariance[k, k] = one.friction or prior
            law = [column.get(of_pair(p.name, one.pair)) for p in (CONTACT_TIME, DAMPING_RATIO)]
            if all(k is not None for k in law):
                both = [k for k in law if k is not None]
                moved = np.full((2, 2), one.moved_by_gap(math.exp(values[both[0]])) ** 2)
                own, variance = with_nuisance(
                    values[both], covariance[np.ix_(both, both)], [names[k] for k in both], moved
                )
                covariance[both], covariance[:, both] = 0.0, 0.0
                values[both], covariance[np.ix_(both, both)] = own, variance
        return replace(estimate, parameters=names, values=values, covariance=covariance, spread=None)

    def _narrow(self, parameter: Parameter, value: float) -> Start:
        own = zip(self.parameters, self.values, np.diag(self.covariance), strict=True)
        known = {p.name: (float(v), float(c)) for p, v, c in own}
        known |= {of_pair(FRICTION.name, one.pair): one.friction for one in self.pressed if one.friction is not None}
        if parameter.name not in known:
            return parameter, value
        middle, variance = known[parameter.name]
        low, high = parameter.limits
        value = math.exp(min(max(middle, low), high))
        return replace(parameter, prior=(value, math.sqrt(variance))), value


def with_nuisance(
    values: NDArray[np.float64], covariance: NDArray[np.float64], parameters: Sequence[Parameter], moved: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return estimate (P,) and covariance (P, P) of parameters whose data depend on something that is not known.

    Args:
        values: Estimate without it, in fitted coordinates, shape (P,).
        covariance: Its covariance, shape (P, P).
        parameters: The parameters, with the priors that are part of both.
        moved: Covariance (P, P) of what it moves the estimate of the data by.
    """
    middle = np.array([p.encode(p.prior[0]) for p in parameters])
    prior = np.diag([p.prior[1] ** -2 for p in parameters])
    whole = np.linalg.pinv(covariance, hermitian=True)
    size, axes = np.linalg.eigh(whole - prior)
    data = (axes * size.clip(0.0)) @ axes.T  # negative by rounding, or where a scatter is wider than the prior
    less = np.linalg.inv(np.eye(len(values)) + data @ moved)
    information = less @ data
    found = np.linalg.inv(information + prior)
    shift = less @ (data @ values + prior @ (values - middle))
    return found @ (shift + prior @ middle), found
