"""Separation of effects that are equal in flight by what they do in contact.

No contact law is exact: the contact parameters are fitted jointly, segments that no candidate explains are
downweighted, and an equal is ruled out only where most episodes agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...physics.effects.registry import CONTACT_ALIASES
from ...physics.parameters import GROUND_SHIFT
from ...physics.world import World
from ...segments.candidates import base_parameters, variants_of, without_effects
from ...segments.linearization import Linearization, linearize
from ...segments.prepare import Prepared
from ...segments.segment_fit import Refit, refit, robust_excess
from ...segments.segment_states import fit_states
from ...segments.segments import Segments
from ..evidence.effect_selection import SelectionStep
from ..evidence.evidence import Evidence
from ..thresholds import THRESHOLDS

LIMITS = THRESHOLDS.segments

FORCE = "constant_force"
"""Name of the effect that a tilt or another gravity is a part of."""
SCALE = "length_scale"
"""Name of the effect of which each session may have a value of its own."""

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ResolvedFlight:
    """Effects selected in flight, with the equals that contact admits, and the contact segments."""

    chosen: tuple[tuple[Evidence, ...], ...]
    """The equals of each effect selected in flight, the selected one first."""
    after_flight: World
    """World with these effects."""
    world: World
    """The same with the contact parameters refitted."""
    segments: Segments | None
    """Contact segments with states fitted by `world`; None without contact."""

    @property
    def chi2(self) -> float | None:
        """Chi2 per degree of freedom of the contact segments; None without contact."""
        if self.segments is None:
            return None
        none = self.segments.observations.times_s.new_zeros(0)
        rows = self.segments.residuals([], none, jacobian=False)[0]
        return float(rows.square().sum() / self.segments.dof.sum())


def resolved_flight(prepared: Prepared, after_flight: World, steps: Sequence[SelectionStep]) -> ResolvedFlight:
    """Fit the contact segments and keep the flight equals that they admit; all of them without contact.

    Where the poses were found in videos, contact is not asked either: it tells equals of flight apart by tenths of a
    millimetre within some frames, over which the errors of such poses are alike, while chi2 counts each frame.

    Args:
        prepared: The episodes.
        after_flight: The world with the effects selected in flight.
        steps: Selection steps of the flight search.
    """
    flagged, after_flight = _undoubled([step for step in steps if step.flagged], after_flight)
    ambiguous = [] if prepared.filmed else [step for step in flagged if _is_asked(step, flagged)]
    neutral = without_effects(after_flight, *(step.best.name for step in ambiguous))
    fitted = fitted_contact(prepared, neutral)
    if fitted is None:
        chosen = tuple(tuple(step.equals) for step in flagged)
        return ResolvedFlight(chosen=chosen, after_flight=after_flight, world=after_flight, segments=None)
    base, contact = fitted
    final, chosen = after_flight, []
    for step in flagged:
        equals = list(step.equals)
        if step in ambiguous:
            kept, _ = separated(equals, contact, base.world, prepared.groups)
            equals = _without_doubles(_with_aliases(kept, equals), [one for one in flagged if one is not step])
            final = _replaced(final, step.best, equals[0])
        chosen.append(tuple(equals))
    final = replace(final, contact=base.world.contact)
    if ambiguous:
        base, contact = refitted_contact(contact, final)
    return ResolvedFlight(chosen=tuple(chosen), after_flight=final, world=base.world, segments=contact)


def _is_asked(step: SelectionStep, steps: Sequence[SelectionStep]) -> bool:
    """Return whether contact can separate the equals of a selected effect.

    It is not asked which tilt an episode has of its own, nor which of several drags it is, which push in contact as in
    flight, so that the error of the law of contact would decide, nor whether it is a drag where an effect of another
    step may act through it: without any the other one, as the wind, would do nothing.
    """
    drags = ["drag" in one.candidate.effect.provides for one in step.equals]
    if len(step.equals) < 2 or step.own_std is not None or all(drags):
        return False
    others = (one for other in steps if other is not step for one in other.equals)
    return not (any(drags) and any("drag" in one.candidate.effect.needs for one in others))


def _undoubled(steps: Sequence[SelectionStep], world: World) -> tuple[list[SelectionStep], World]:
    """Return selected steps in which no constant force stands for what another one is a part of, and their world."""
    found = []
    for step in steps:
        others = [one for one in steps if one is not step and one.own_std is None]
        equals = tuple(_without_doubles(step.equals, others)) if step.own_std is None else step.equals
        world = _replaced(world, step.best, equals[0])
        found.append(replace(step, equals=equals))
    return found, world


def _without_doubles(equals: Sequence[Evidence], others: Sequence[SelectionStep]) -> list[Evidence]:
    """Return equals with a constant force last, where another effect is a part of it.

    A constant force beside a tilt is two names of one horizontal force, and no numbers belong to either alone.
    """
    doubled = any(one.name == FORCE for other in others for one in other.equals)
    return sorted(equals, key=lambda one: one.name == FORCE) if doubled else list(equals)


def fitted_contact(prepared: Prepared, world: World) -> tuple[Refit, Segments] | None:
    """Return the contact parameters refitted to the contact segments, and the segments; None without contact.

    The height of the ground stays at its given value: it is projected out later and must not bend the states here.
    """
    contact = prepared.contact(world)
    return None if contact is None else _fitted(contact, world)


def refitted_contact(contact: Segments, world: World) -> tuple[Refit, Segments]:
    """Return the contact parameters refitted in another world, and the segments, from states fitted before."""
    return _fitted(fit_states(contact.in_world(world), iterations=4, search=False), world)


def _fitted(contact: Segments, world: World) -> tuple[Refit, Segments]:
    """Refit the contact parameters, without the height of the ground and the effects, and return the segments, too."""
    own = {f"{a.effect.name}." for a in world.effects}
    parameters = [
        p
        for p in base_parameters(world, "contact")
        if p is not GROUND_SHIFT and not any(p.name.startswith(name) for name in own)
    ]
    found = refit([contact], world, parameters)
    return found, found.segments[0]


def separated(
    equals: Sequence[Evidence], contact: Segments, world: World, groups: Sequence[int]
) -> tuple[list[Evidence], dict[str, float]]:
    """Return the flight equals that contact does not rule out, the best first, and the gain of each in contact.

    Each effect has the parameters estimated in flight, which contact may move within their standard errors; the contact
    parameters are fitted jointly. Without this freedom, poorly known parameters would reflect their errors rather than
    the effects.

    Args:
        equals: Evidence of the equals, refitted in flight.
        contact: Contact segments with states fitted by the world without any of them.
        world: That world.
        groups: Session of each episode.
    """
    chosen = [e.candidate for e in equals]
    variants = variants_of(chosen, world.gravity[0, :1])
    picked = [
        next(v for v in variants if chosen[v.place] is e.candidate and v.constants == e.constants) for e in equals
    ]
    linear = linearize(contact, world, picked, groups, robust=False)
    linear = reweighted(linear, [k for v in picked for k in linear.columns(v.parameters)])
    # the misfit of the contact law itself is no evidence against an effect
    misfit = max(1.0, float((linear.weight * linear.chi2).sum() / (linear.weight * linear.dof).sum()))
    gains, total = [], np.array([float(e.refitted.cost) if e.refitted else math.inf for e in equals])
    for k, (evidence, variant) in enumerate(zip(equals, picked, strict=True)):
        known = np.array([evidence.estimates[p.name] for p in evidence.candidate.effect.parameters])
        by_episode, moved = _gains_near(linear, linear.columns(variant.parameters), known[:, 0], known[:, 1], misfit)
        gains.append(by_episode / misfit)
        total[k] += moved - gains[k].sum()
    kept = _not_ruled_out(equals, gains, total, linear, len(set(groups)) > 1)
    return kept, {e.name: float(g.sum()) for e, g in zip(equals, gains, strict=True)}


def _not_ruled_out(
    equals: Sequence[Evidence], gains: Sequence[Array], total: Array, linear: Linearization, sessions: bool
) -> list[Evidence]:
    """Return the equals that contact does not rule out, the best first.

    Where episodes belong to several sessions, each may have a scale of lengths of its own, of which flights show the
    mean beside whatever else acts: one scale for all is then as wrong in contact as none, and what it gains there is
    true without being all. So it is not ruled out, and rules nothing else out. Nor does a constant force, which is a
    tilt and another gravity together: what its further number gains in contact may be what the contact law misses.
    Where contact is described no better with the best of them than with none, it tells nothing.

    Args:
        equals: The equals.
        gains: Gain of each in each episode (E,).
        total: Cost of each in flight and contact together.
        linear: Linearization of the contact segments, for the penalty of BIC.
        sessions: Whether episodes belong to several sessions.
    """
    order = sorted(range(len(equals)), key=lambda k: (total[k] + _bic(equals[k], linear), equals[k].name))
    apart = {k for k in order if sessions and equals[k].name == SCALE}
    ruling = [k for k in order if k not in apart]
    best = min([k for k in ruling if equals[k].name != FORCE] or ruling or order, key=lambda k: total[k])
    kept, tells = [], float(gains[best].sum()) > 0
    for k in order:
        if k in apart or not tells:
            kept.append(equals[k])
            continue
        worse = gains[best] - gains[k]
        spread = worse.std(ddof=1) / math.sqrt(len(worse)) if len(worse) > 1 else math.inf
        out = total[k] - total[best] > LIMITS.separate_chi2 and worse.mean() > LIMITS.separate_t * spread
        if not out:
            kept.append(equals[k])
    return kept


def reweighted(linear: Linearization, columns: Sequence[int]) -> Linearization:
    """Return the linearization with robust weights from the residual of fits to single segments.

    A segment that a candidate explains has full weight; one that none explains is downweighted.
    """
    chosen = [*range(linear.base), *columns]
    width = np.array([linear.parameters[k].prior[1] for k in chosen])
    information = linear.information[:, chosen][:, :, chosen] * np.outer(width, width)
    score = linear.score[:, chosen] * width
    step = np.linalg.solve(information + np.eye(len(chosen)), score[..., None])[..., 0]
    left = linear.chi2 - np.einsum("bi,bi->b", score, step) - linear.dof
    weight = robust_excess(torch.as_tensor(left))[1].numpy()
    return replace(linear, weight=weight)


def _gains_near(
    linear: Linearization, columns: Sequence[int], value: Array, std: Array, misfit: float
) -> tuple[Array, float]:
    """Return the gain of each episode (E,) with an effect near known parameters, and chi2 of their change.

    Args:
        linear: Linearization of the contact segments.
        columns: Columns of the effect's parameters.
        value: Their known values (k,).
        std: Standard errors of these (k,).
        misfit: Factor by which chi2 in contact exceeds that of noise.
    """
    base, count = list(range(linear.base)), linear.base
    chosen = [*base, *columns]
    known = misfit / np.maximum(std, 1e-12) ** 2
    m = (linear.information * linear.weight[:, None, None]).sum(0)[np.ix_(chosen, chosen)]
    g = (linear.score * linear.weight[:, None]).sum(0)[chosen]
    prior = np.concatenate([linear.prior[:count], known])
    with_effect = np.linalg.solve(m + np.diag(prior), g + np.concatenate([np.zeros(count), known * value]))
    without = np.linalg.solve(m[:count, :count] + np.diag(prior[:count]), g[:count])
    both = [with_effect, np.concatenate([without, np.zeros_like(value)])]
    gains = []
    for episode in np.unique(linear.episode):
        mine = linear.weight * (linear.episode == episode)
        own = (linear.information * mine[:, None, None]).sum(0)[np.ix_(chosen, chosen)]
        slope = (linear.score * mine[:, None]).sum(0)[chosen]
        gains.append(np.subtract(*[2 * slope @ x - x @ own @ x for x in both]))
    return np.array(gains), float((known / misfit) @ (with_effect[count:] - value) ** 2)


def _bic(evidence: Evidence, linear: Linearization) -> float:
    """Return the penalty of BIC, and of implausible sizes."""
    return len(evidence.candidate.effect.parameters) * math.log(max(linear.dof.sum(), 2.0)) + evidence.odds


def _replaced(world: World, old: Evidence, new: Evidence) -> World:
    """Return the world with one effect replaced by another at its refitted parameters."""
    if old.name == new.name or new.refitted is None:
        return world
    own = next(a for a in new.refitted.world.effects if a.effect.name == new.name)
    return replace(world, effects=(*without_effects(world, old.name).effects, own))


def _with_aliases(kept: Sequence[Evidence], equals: Sequence[Evidence]) -> list[Evidence]:
    """Return the remaining equals, with the original ones that rigid contact cannot distinguish from them."""
    names = {one.name for one in kept}
    names |= {name for group in CONTACT_ALIASES if group & names for name in group}
    return [*kept, *(one for one in equals if one.name in names and one not in kept)]
