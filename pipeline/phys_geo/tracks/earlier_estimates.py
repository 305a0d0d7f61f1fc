"""Estimates of the model that a fit starts from, kept where the new episodes do not observe the parameter.

They are kept, not combined with the new episodes: these may be the ones that gave them, and would then count twice.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from ....schemas import Correlation, FittedParameter, ModelFile
from ...physics.parameters import GROUND_SHIFT, Parameter, effect_parameters
from ...physics.world import World
from ...segments.first_contact_fit import EffectEstimate
from ...segments.thresholds import SEGMENT_THRESHOLDS
from .contact_result import ContactEstimate

GROUND = "ground_offset_m"
"""Name of the ground's height in a model, whose shift is fitted."""


@dataclass(frozen=True, kw_only=True)
class EarlierEstimates:
    """What an earlier fit found."""

    parameters: dict[str, FittedParameter] = field(default_factory=dict)
    """Parameters that it fitted, with intervals, by name."""
    correlations: tuple[Correlation, ...] = ()
    """Correlations of their errors."""

    @staticmethod
    def of(parameters: Iterable[FittedParameter], correlations: Iterable[Correlation]) -> EarlierEstimates:
        """Collect the parameters that were found; given, derived, unobserved ones and those on a bound were not."""
        found = {p.name: p for p in parameters if p.state == "fitted" and p.std_error and p.interval_95 is not None}
        return EarlierEstimates(parameters=found, correlations=tuple(correlations))

    def kept_in(self, world: World, estimate: ContactEstimate) -> ContactEstimate:
        """Return an estimate with the earlier one of each parameter that it does not observe.

        Args:
            world: The world that was fitted; the shift of the ground counts from its height.
            estimate: Contact parameters from the new episodes.
        """
        names = [GROUND if p is GROUND_SHIFT else p.name for p in estimate.parameters]
        std = np.sqrt(np.diag(estimate.covariance))
        limit = SEGMENT_THRESHOLDS.preparation.unobservable_share
        places = [
            k
            for k, (p, name) in enumerate(zip(estimate.parameters, names, strict=True))
            if std[k] > limit * p.prior[1] and name in self.parameters
        ]
        if not places:
            return estimate
        values, covariance = estimate.values.copy(), estimate.covariance.copy()
        kept = [self.parameters[names[k]] for k in places]
        covariance[places, :] = covariance[:, places] = 0.0
        covariance[np.ix_(places, places)] = self._covariance(kept, [estimate.parameters[k] for k in places])
        for k, found in zip(places, kept, strict=True):
            values[k] = _coordinate(world, estimate.parameters[k], found.estimate)
        return replace(estimate, values=values, covariance=covariance, kept={p.name: p for p in kept})

    def _covariance(self, kept: list[FittedParameter], like: list[Parameter]) -> np.ndarray:
        """Return the covariance of kept parameters in fitted coordinates; those of separate fits are independent."""
        correlation = np.eye(len(kept))
        for block in self.correlations:
            place = {name: k for k, name in enumerate(block.parameters)}
            for i, one in enumerate(kept):
                for j, other in enumerate(kept):
                    if i != j and one.name in place and other.name in place:
                        correlation[i, j] = block.matrix[place[one.name]][place[other.name]]
        pairs = zip(kept, like, strict=True)
        std = np.array([(p.std_error or 0.0) / (p.estimate if q.logarithmic else 1.0) for p, q in pairs])
        return correlation * np.outer(std, std)

    def lost_effects(self, world: World, found: EffectEstimate) -> list[str]:
        """Return the effects of the world of which the new episodes do not observe a parameter that was found before.

        Args:
            world: The world before the fit of its effects.
            found: The effects fitted to the new episodes.
        """
        if any(parameter.shared != "all" for parameter in effect_parameters(world)):
            return []  # each group has values of its own, which say how far the groups of other episodes may be
        now = {p.name: p.state for p in found.parameters}
        names = {
            name.partition(".")[0]
            for name in self.parameters
            if "." in name and now.get(name, "not_observable") == "not_observable"
        }
        return [active.effect.name for active in world.effects if active.effect.name in names]


def with_fitted_physics(fresh: ModelFile, parent: ModelFile) -> ModelFile:
    """Return a model with new shapes of the same bodies, and the fitted physics of the model from which a fit starts.

    Args:
        fresh: The model with the new shapes, without fitted physics.
        parent: The model from which the fit starts.
    """
    found = {p.name: p for p in parent.parameters if p.state == "fitted"}
    before = {body.name: body for body in parent.bodies}
    bodies = []
    for body in fresh.bodies:
        like, own = before[body.name], {f"{body.name}.com_x_m", f"{body.name}.moment_x"}
        fitted = bool(own & set(found)) and like.mass_kg == body.mass_kg
        mass = {"com_m": like.com_m, "inertia_kg_m2": like.inertia_kg_m2} if fitted else {}
        bodies.append(body.model_copy(update=mass))
    return fresh.model_copy(
        update={
            "bodies": tuple(bodies),
            "contact": parent.contact,
            "effects": parent.effects,
            "parameters": tuple(({p.name: p for p in fresh.parameters} | found).values()),
            "correlations": parent.correlations,
        }
    )


def _coordinate(world: World, parameter: Parameter, estimate: float) -> float:
    """Return the fitted coordinate of an earlier estimate, within the parameter's limits."""
    value = estimate
    if parameter is GROUND_SHIFT and world.ground_offset is not None:
        value -= float(world.ground_offset[0])
    low, high = parameter.bounds
    return parameter.encode(min(max(value, low), high))
