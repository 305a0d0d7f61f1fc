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

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..physics.effects.effect import ActiveEffect
from ..physics.world import World
from ..segments.force_fields import FlownMotion, ForceField
from ..segments.segments import Segments
from .form_families import Family, families_of, own_field
from .form_fit import FormFit
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict


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
    fit = FormFit.of(motion, active, [own, *forms.values()])
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
