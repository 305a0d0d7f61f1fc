"""Contact segments linearised at the fit of a candidate, and not where it is absent.

What a segment shows of a large effect is not linear: a spin that friction stops within the segment ends the same
whether it stops early or late, and a state that was fitted without the friction is not near the one with it. So one
step from zero says neither how large the effect is nor how well it explains the data. Each candidate is fitted together
with states and contact parameters, from several sizes, with the states searched anew at each; all fits, the one without
a candidate included, take the best states of each other, so that a gain is never one of the search. The segments are
linearised at the best fit. Their quadratic cost is then written in parameters that are measured from the world without
the effect, as for a linearization there: at the fitted offset o, with information M, score g and chi2, these become M,
g + M o and chi2 + 2 g o + o' M o.

An effect has no prior here but the limits of its parameters: the usual size is one for all bodies, and a box that
weighs 4 N needs another adhesion than a ball of 0.2 N.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...physics.parameters import Parameter, apply_parameters
from ...physics.state import State
from ...physics.world import World
from ...segments.candidates import base_parameters, base_values, with_added
from ...segments.impulse_errors import ImpulseErrors
from ...segments.linearization import Linearization, linearize_contact
from ...segments.segment_fit import robust_excess
from ...segments.segment_states import costs_of, fit_states
from ...segments.segments import Segments
from ..evidence.evidence import Evidence
from ..evidence.robust_fit import with_segment_parameters

Array = NDArray[np.float64]

SIZES = (2.0, 10.0)
"""Sizes from which an effect of one parameter is fitted, in usual sizes."""
SIGNED_SIZES = (-2.0, 2.0)
"""The same of an effect that may have either sign."""
STATE_ITERATIONS = 3
"""Steps of the states after they were shared."""
WIDE = 10.0
"""Width of the effect's prior in that of the usual one: so wide that it does not count."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CandidateFit:
    """Contact segments linearised at a fit, with or without a candidate."""

    segments: Segments
    """The segments with the states of the fit, in the model's world with the candidate at neutral."""
    parameters: tuple[Parameter, ...]
    """What is fitted (k): contact parameters, height of the ground, and those of the candidate."""
    centre: Tensor
    """Their values in the model's world (k,), in fitted coordinates."""
    values: Tensor
    """Fitted values (k,)."""
    plain: Linearization
    """Segments at the fit under the contact law, in parameters measured from the model's world, with the deviations
    that each segment has of its own projected out."""
    beside: Linearization
    """The same beside errors of the impulses of impacts, those of the fit without a candidate."""
    columns: tuple[int, ...]
    """Columns of the candidate's parameters in the linearization; empty without one."""
    errors: ImpulseErrors
    """The errors."""

    @property
    def start(self) -> Array:
        """The fitted parameters (P) in the order and from the origin of the linearization."""
        moved = dict(zip((p.name for p in self.parameters), (self.values - self.centre).tolist(), strict=True))
        return np.array([moved.get(p.name, 0.0) for p in self.plain.parameters])

    @property
    def every(self) -> list[int]:
        """Columns of all parameters, the model's first."""
        return [*range(self.plain.base), *self.columns]


def candidate_fits(
    contact: Segments, world: World, evidence: Sequence[Evidence], groups: Sequence[int]
) -> tuple[CandidateFit, dict[str, CandidateFit]]:
    """Fit contact parameters and states without a candidate, and with each one; return both, by name of the effect.

    Args:
        contact: Contact segments with states fitted by the world.
        world: The model's world.
        evidence: The candidates, with first estimates.
        groups: Session of each episode.
    """
    none = _place(contact, world, None)
    none = none.at(none.values)
    tried = {"": [none]}
    for one in evidence:
        place = _place(none.segments, world, one)
        tried[one.name] = [place.at(values) for values in _starts(one, place)]
    states = [one.segments.observations.state for some in tried.values() for one in some]
    fits: dict[str, CandidateFit] = {}
    for name, some in tried.items():
        shared = [one.at(one.values, search=False, also=states) for one in some]
        fits[name] = min(shared, key=lambda one: one.cost).linearised(groups, fits.get(""))
    return fits.pop(""), fits


@dataclass(frozen=True, eq=False, kw_only=True)
class _Place:
    """A world that is fitted, values of its parameters, and the states there."""

    world: World
    parameters: tuple[Parameter, ...]
    own: tuple[Parameter, ...]
    centre: Tensor
    values: Tensor
    segments: Segments

    @property
    def cost(self) -> float:
        """Robust loss of the states at the values."""
        chi2 = costs_of(self.segments, self.parameters, self.values)
        return float(robust_excess(chi2 - self.segments.dof)[0].sum())

    def at(self, values: Tensor, search: bool = True, also: Sequence[State] = ()) -> _Place:
        """Return the place at other values, with states fitted there."""
        count = None if search else STATE_ITERATIONS
        fitted = fit_states(self.segments, self.parameters, values, count, search=search, also=also)
        return replace(self, values=values, segments=fitted)

    def linearised(self, groups: Sequence[int], none: CandidateFit | None) -> CandidateFit:
        """Return the segments linearised here, in parameters measured from the model's world."""
        columns = torch.stack([p.decode(self.values[k]) for k, p in enumerate(self.parameters)])[None]
        world = apply_parameters(self.world, self.parameters, columns)
        at = linearize_contact(self.segments.in_world(world), world, (), groups, None if none is None else none.errors)
        names = {p.name for p in self.own}
        own = tuple(k for k, p in enumerate(at.plain.parameters) if p.name in names)
        fit = CandidateFit(
            segments=self.segments,
            parameters=self.parameters,
            centre=self.centre,
            values=self.values,
            plain=_without_prior(at.plain, own),
            beside=_without_prior(at.beside, own),
            columns=own,
            errors=at.errors,
        )
        start = fit.start
        return replace(fit, plain=measured_from(fit.plain, start), beside=measured_from(fit.beside, start))


def _without_prior(linear: Linearization, own: Sequence[int]) -> Linearization:
    """Return a linearization with deviations of each segment, in which a candidate's parameters have hardly a prior.

    Args:
        linear: At a fit, the candidate's parameters last.
        own: Columns of the candidate's parameters.
    """
    # deviations of the effect's own would explain it away
    linear = with_segment_parameters(replace(linear, base=linear.base - len(own)))
    wide = [
        replace(p, prior=(p.prior[0], WIDE * p.prior[1])) if k in own else p for k, p in enumerate(linear.parameters)
    ]
    prior = np.where(np.isin(np.arange(len(wide)), own), 0.0, linear.prior)
    return replace(linear, parameters=tuple(wide), prior=prior)


def _place(contact: Segments, world: World, evidence: Evidence | None) -> _Place:
    """Return where a fit with an effect starts, at neutral."""
    nuisance = [p for p in base_parameters(world, "contact") if "." not in p.name]
    own: tuple[Parameter, ...] = ()
    if evidence is not None:
        effect = evidence.candidate.effect
        world = with_added(world, effect, evidence.constants)
        own = tuple(p for p in base_parameters(world, "contact") if p.name.startswith(f"{effect.name}."))
    parameters = (*nuisance, *own)
    centre = base_values(world, parameters)
    return _Place(
        world=world,
        parameters=parameters,
        own=own,
        centre=centre,
        values=centre,
        segments=contact.in_world(world),
    )


def _starts(evidence: Evidence, place: _Place) -> list[Tensor]:
    """Return the values that fits of an effect start from, in fitted coordinates."""
    first = np.array(evidence.test.estimate[: len(place.own)], dtype=np.float64)
    sizes = np.array([p.scale for p in evidence.candidate.effect.parameters])
    tried = [first]
    if len(place.own) == 1:
        signed = place.own[0].bounds[0] != 0.0
        tried = [share * sizes for share in (SIGNED_SIZES if signed else SIZES)]
    found = []
    for values in tried:
        start = place.centre.clone()
        for k, (p, value) in enumerate(zip(place.own, values, strict=True), len(start) - len(place.own)):
            start[k] = min(max(float(value), p.limits[0]), p.limits[1])
        found.append(start)
    return found


def measured_from(linear: Linearization, offset: Array) -> Linearization:
    """Return a linearization at parameters that lie by an offset (P,) from an origin, measured from that origin."""
    moved = linear.information @ offset
    return replace(
        linear,
        score=linear.score + moved,
        chi2=linear.chi2 + 2 * linear.score @ offset + moved @ offset,
    )
