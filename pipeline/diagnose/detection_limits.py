"""What contact could have shown: from which size on a candidate would have been named, had it been there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from ..physics.world import World
from .candidates import Candidate, Variant, admissible, base_values, variants_of, with_variants
from .glide_fits import GlideFit, lasting_misfits
from .glide_stage import StartedGlides, batches, fitted_along, fitted_glides

SAFE = 1.5
"""Limits are by this larger than where an effect that stays as linear as it begins would reach its score. Of 78 effects
of development cases 19 were above their limits, of which 18 were named, and 59 below, of which 14 were. The one above
that was silent is friction against spinning at a corner, which stops the spin and then acts no more."""


@dataclass(frozen=True)
class ContactLimit:
    """A candidate that acts in contact, and the size from which on these data would have shown it.

    sizes: by the names of its numbers, in their units; empty where no admissible size would have shown; constants: at
    which it shows best.
    """

    candidate: Candidate
    sizes: dict[str, float] = field(default_factory=dict)
    constants: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Told:
    """How well glides tell a candidate at one choice of its constants.

    times: its limit in units of its numbers' usual sizes; values (P,): its numbers there, in the direction in which
    they are told least.
    """

    variant: Variant
    times: float
    values: NDArray[np.float64]


def contact_limits(
    started: StartedGlides | None,
    world: World,
    candidates: Sequence[Candidate],
    score: tuple[float, float],
    turned: bool,
    blind_to: Sequence[str],
) -> list[ContactLimit]:
    """Return the limits of all candidates that act in contact, by what glides tell of them; none without glides.

    The score of an effect of the size x is (x / sigma)^2, with sigma of its number beside the friction and what flights
    tell; of several numbers in the direction in which they are told least. An effect has no limit where a fit without
    it follows the motions that it would make: one so strong that it ends a slide at once is a friction.

    Args:
        started: The glides; None where there are none.
        world: The model's world.
        candidates: All of them.
        score: Above which an effect of one number is named, and one of more.
        turned: Whether orientations were measured.
        blind_to: Effects that glides do not show.
    """
    if started is None:
        return []
    kept, _ = admissible(world, candidates, turned)
    acting = [c for c in kept if c.effect.phase == "contact"]
    asked = [c for c in acting if c.effect.name not in blind_to]
    spread = max(1.0, started.base.cost / float(started.segments.dof.sum()))
    best: dict[int, _Told] = {}
    for part in batches(variants_of(asked, world.gravity[0, :1])):
        start = [(started.base.segments, started.base.values[0])] * len(part)
        fits = fitted_glides(started.segments.world, part, start, started.told, iterations=1)
        for variant, fit in zip(part, fits, strict=True):
            one = _told(variant, fit, SAFE * math.sqrt(spread * score[len(variant.parameters) > 1]))
            if variant.place not in best or one.times < best[variant.place].times:
                best[variant.place] = one
    told = list(best.values())
    told = [one for one in told if one.times <= min(n.limit / n.scale for n in one.variant.active.effect.parameters)]
    sizes = {}
    for one, misfit in zip(told, _misfits(started, told), strict=True):
        if misfit > spread * score[len(one.variant.parameters) > 1]:
            sizes[asked[one.variant.place].effect.name] = one
    return [_limit(candidate, sizes.get(candidate.effect.name)) for candidate in acting]


def _told(variant: Variant, fit: GlideFit, sigmas: float) -> _Told:
    """Return the size of a candidate, so many standard errors large."""
    numbers = variant.active.effect.parameters
    covariance = torch.linalg.pinv(fit.information[0], hermitian=True)[-len(numbers) :, -len(numbers) :].numpy()
    usual = np.array([number.scale for number in numbers])
    variances, directions = np.linalg.eigh(covariance / usual / usual[:, None])
    times = sigmas * math.sqrt(max(float(variances[-1]), 0.0))
    direction = directions[:, -1] * np.sign(directions[:, -1].sum() or 1.0)
    return _Told(variant, times, times * usual * direction)


def _misfits(started: StartedGlides, told: Sequence[_Told]) -> list[float]:
    """Return what chi2 a fit without the candidates would leave (K,) of glides that they had made."""
    if not told:
        return []
    beside, own = with_variants(started.segments.world, [one.variant for one in told], "contact")
    known = fitted_along(started.segments.world, started.told)
    parameters = [*known, *own]
    values = base_values(beside, parameters)
    values[: len(known)] = started.base.values[0, : len(known)]
    place = {p.name: k for k, p in enumerate(parameters)}
    others = values.repeat(len(told), 1)
    for row, one in zip(others, told, strict=True):
        row[[place[name] for name in one.variant.parameters]] = torch.as_tensor(one.values).to(row)
    glides = started.base.segments.in_world(beside)
    return lasting_misfits(glides, parameters, values, others, len(known))


def _limit(candidate: Candidate, told: _Told | None) -> ContactLimit:
    if told is None:
        return ContactLimit(candidate)
    sizes = {number.name: told.times * number.scale for number in candidate.effect.parameters}
    return ContactLimit(candidate, sizes, told.variant.constants)
