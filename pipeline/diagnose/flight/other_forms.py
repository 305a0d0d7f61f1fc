"""Force laws of no library that a named effect may imitate, fitted in its stead to the flights that showed it.

A name is right only if the force has the law of that name. A gust, a force that sets in late, one that acts on one side
of the room, or a damping by another power of the spin is followed by the nearest effect of the library, too, and few
flights need not show what is left. The force that is named is therefore compared with other forms of it: the same one
during a part of the flights, above a height, on one side of a place, by another power of speed or spin, above or below
one of these alone, or swinging in time. Each takes its place in flights linearised at their fit, with the states and
the other effects fitted again, and has as many numbers; a torque that swings has those of its axis, which cost what
they do in BIC.

Before the data, no form of a family is likelier than another, and all together are as likely as the law that is named,
or the laws where flights do not tell two drags apart; how likely the families are, `form_families` says. Where flights
do not tell several effects of the library apart, each is as likely as another, and each that is a force may have
another form, but an error of a scale or a frame has none. The odds are those of the mean likelihoods. No model of
errors is exact, and how the numbers of a force scatter from episode to episode tells how far it can be believed
(`falsification`): variances count as often as the law of least chi2 says, since a wrong one scatters by what it misses.

What else acts need not be named yet: the push of a wind that is too small to be named bends the law of the drag through
which it acts, and another power of the speed follows that, too. Each law, that of the name and every other one, is
therefore as likely with one more effect of the library beside it as without, no such effect likelier than another, and
one of them costs what its numbers do in BIC. Nor need all that is named act: one force of another form may be what two
effects of the library imitate together, as one that grows with the height is imitated by a scale of lengths and a
magnet, so that each law is also tried without one of the other named effects, whose numbers it saves.

A tilt of each episode's own follows any force that flights meet differently: a fan on one side of the room pushes each
throw for another time. Within a flight a tilt is constant, though, and such a force is not. The same forms, across
gravity, take the place of the tilts, with a value for each episode, of one size before the data, or with one for all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...physics.effects.registry import FLIGHT_ALIASES
from ...physics.world import World
from ...segments.candidates import Candidate, acts_in, admissible, variants_of
from ...segments.flights.force_fields import FlownMotion, ForceField
from ...segments.linearization import derivatives
from ...segments.segment_fit import projected
from ...segments.segments import Segments
from ..evidence.session_scales import apart, linearize_beside_scales, members, scale_spread
from ..thresholds import THRESHOLDS
from .coupled_effects import DRAGS
from .form_families import Family, families_of, laws_of, own_field, weights_of
from .form_fit import FormCost, FormFit, Scales, by_episode

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class OtherForms:
    """Other forms of a named force, in its place."""

    effect: str
    """Name of the effect."""
    words: str
    """The form that explains the flights best, in words."""
    gain: float
    """Twice the logarithm of the odds of that form against the effect's own law."""
    odds: float
    """Twice the logarithm of the odds of all forms against the effect's own law."""
    then: str
    """What to record next to tell that form from the effect."""
    instead: frozenset[str] = frozenset()
    """Other named effects that flights do not ask for beside that form."""

    @property
    def likelier(self) -> bool:
        """Whether the force has another form than that of the effect, or too likely has one, for it to be named."""
        return self.odds > LIMITS.form_odds

    @property
    def as_good(self) -> bool:
        """Whether one form explains the flights as well as the effect, which is likelier all the same."""
        return not self.likelier and self.gain > 0


def other_forms(
    flight: Segments,
    world: World,
    classes: Sequence[tuple[str, ...]],
    dispersion: float,
    candidates: Sequence[Candidate] = (),
    turned: bool = True,
    groups: Sequence[int] | None = None,
) -> list[OtherForms]:
    """Compare each named effect that is a force with its other forms.

    Args:
        flight: Segments with states fitted by the world.
        world: The world with the effects at their fitted parameters.
        classes: Names of each effect and of its equals, its own the first.
        dispersion: Factor by which variances exceed those of the noise.
        candidates: Effects of which one more may act.
        turned: Whether orientations were measured.
        groups: Session of each episode; None where all are of one.
    """
    motion, found = FlownMotion(flight.in_world(world)), []
    shared = [one for one in world.effects if all(p.shared == "all" for p in one.effect.parameters)]
    active = {one.effect.name: one for one in shared}
    kept, _ = admissible(world, candidates, turned, flight.observations.spin_rad_s is not None)
    scales = _scales(motion.flight, kept, groups) if classes and groups is not None else None
    for named in classes:
        own = own_field(motion, active[named[0]]) if named[0] in active else None
        if own is None:
            continue
        other = [one for one in kept if one.effect.name not in _alike(named)]
        more = [one for one in variants_of(other, world.gravity[0, :1]) if acts_in(one, "flight")]
        laws, families = laws_of(motion, own, named), families_of(motion, own, named, not sways(flight))
        forms = {words: field for family in families for words, field in family.forms.items()}
        fit = FormFit.of(motion, active[named[0]], [*laws, *forms.values()], more, scales)
        found.append(_compared(fit, named[0], len(laws), families, dispersion, _forces(named, candidates)))
    return found


def sways(flight: Segments) -> bool:
    """Return whether flights have accelerations of their own among the errors.

    Whether these follow the place of a flight is told by their own test (`own_accelerations`).
    """
    return flight.noise_model.position.sway > 0


def _forces(named: Sequence[str], candidates: Sequence[Candidate]) -> float:
    """Return the share of an effect and its equals that are forces, of which there are other forms."""
    errors = {one.effect.name for one in candidates if one.effect.phase == "measurement"}
    return max(sum(name not in errors for name in named), 1) / len(named)


def _scales(flight: Segments, candidates: Sequence[Candidate], groups: Sequence[int]) -> Scales | None:
    """Return how the scales of sessions differ, as flights show it beside all candidates; None where they do not."""
    member = members(flight, groups)
    if member is None:
        return None
    every = [one for one in variants_of(candidates, flight.world.gravity[0, :1]) if acts_in(one, "flight")]
    spread = scale_spread(linearize_beside_scales(flight, flight.world, every, groups))
    return None if spread is None else Scales(apart(member), spread)


def _alike(named: Sequence[str]) -> set[str]:
    """Return the names of an effect, its equals and what flights tell no better from it."""
    found = set(named).union(*(group for group in FLIGHT_ALIASES if named[0] in group))
    return found | set(DRAGS) if named[0] in DRAGS else found


def _compared(
    fit: FormFit, name: str, laws: int, families: Sequence[Family], dispersion: float, forces: float = 1.0
) -> OtherForms:
    """Compare an effect with families of other forms, each with one more effect or not.

    Args:
        fit: The forms, the laws of the effect and of its equals the first ones.
        name: The effect.
        laws: How many laws these are, none likelier than another.
        families: The other forms.
        dispersion: Factor by which variances exceed those of the noise.
        forces: Share of the effect and its equals that may have other forms.
    """
    forms = [words for family in families for words in family.forms]
    tried = [_tried(fit, columns, dispersion) for columns in fit.forms]
    likeliest = min(
        (cost for groups in tried for group in groups for law in group for cost, _ in law), key=lambda c: c.chi2
    )
    logs = [
        log_mean(
            [
                log_mean([log_mean([_log(*one, likeliest, fit.count) for one in law]) for law in group])
                for group in groups
            ]
        )
        for groups in tried
    ]
    own = log_mean(logs[:laws])
    half = {words: log - own for words, log in zip(forms, logs[laws:], strict=True)}
    best = max(half, key=lambda one: half[one])
    together = [log_mean([half[words] for words in family.forms], family.shares) for family in families]
    odds = 2 * (log_mean(together, weights_of(families, name)) + math.log(forces))
    then = next(family.then for family in families if best in family.forms)
    instead = _not_needed(fit, fit.forms[laws + forms.index(best)], dispersion, likeliest.scatter)
    return OtherForms(effect=name, words=best, gain=2 * half[best], odds=odds, then=then, instead=instead)


def _not_needed(fit: FormFit, form: Sequence[int], dispersion: float, scatter: float) -> frozenset[str]:
    """Return the other effects of the world without which a form explains the flights as well, by BIC."""
    beside = fit.in_its_stead(form, dispersion).chi2
    return frozenset(
        name
        for name, own in fit.others.items()
        if (fit.in_its_stead(form, dispersion, (), own).chi2 - beside) / scatter < len(own) * math.log(fit.count)
    )


Tried = list[list[list[tuple[FormCost, int]]]]
"""Costs of a form and how many numbers it has more: as it is, by one more effect, by one fewer; by constants."""


def _tried(fit: FormFit, form: Sequence[int], dispersion: float) -> Tried:
    """Return the costs of a form as it is, with one more effect of the library, and without one that is named."""
    more = len(form) - len(fit.forms[0])
    found: Tried = [[[(fit.in_its_stead(form, dispersion), more)]]]
    if fit.more:
        found.append(
            [[(fit.in_its_stead(form, dispersion, one), more + len(one)) for one in variants] for variants in fit.more]
        )
    if fit.others:
        found.append([[(fit.in_its_stead(form, dispersion, (), one), more - len(one))] for one in fit.others.values()])
    return found


def _log(cost: FormCost, more: int, likeliest: FormCost, count: float) -> float:
    """Return the logarithm of a likelihood against that of the least chi2, of a form with so many numbers more.

    How far variances exceed those of the noise is what the form of least chi2 says.
    """
    return -0.5 * ((cost.chi2 - likeliest.chi2) / likeliest.scatter + more * math.log(count))


def log_mean(values: Sequence[float], weights: Sequence[float] = ()) -> float:
    """Return the logarithm of the mean of exponentials, weighted where weights are given."""
    logs = np.log(np.array(weights)) if weights else np.zeros(len(values))
    return float(np.logaddexp.reduce(np.array(values) + logs) - np.logaddexp.reduce(logs))


class OwnForm(NamedTuple):
    """The other form that flights fit best, in place of a tilt of each episode's own."""

    coordinate: str
    """What the force follows."""
    odds: float
    """Twice the logarithm of the odds of all forms against tilts."""


def own_form(whole: Segments, world: World, std_m_s2: float) -> OwnForm:
    """Compare tilts of each episode's own with other forms of a force across gravity.

    Args:
        whole: Whole flights, with fitted states and without accelerations of their own in the noise.
        world: The world without effects that push across gravity.
        std_m_s2: Standard deviation of the accelerations [m/s2].
    """
    motion = FlownMotion(whole.in_world(world))
    level = motion.axes[1].expand(*motion.times_s.shape, 3, 2).clone()
    own = ForceField(level, torch.zeros_like(level))
    families = families_of(motion, own, ("gravity_tilt",), of_places=False)
    fields = [own, *(field for family in families for field in family.forms.values())]
    parameters, rows, jacobian = derivatives(motion.flight, world, ())
    states = jacobian[..., len(parameters) :]
    joined = torch.cat((motion.innovations(ForceField.joined(fields)).to(jacobian), states), -1)
    count = sum(field.size for field in fields)
    information, score = by_episode(motion.flight, projected(motion.flight, rows, joined, count))
    each = [_of_own(information[:, k : k + 2, k : k + 2], score[:, k : k + 2], std_m_s2) for k in range(0, count, 2)]
    logs = iter(log_mean(both) - each[0][0] for both in each[1:])  # one tilt for all is no tilt of each episode's own
    found = [[next(logs) for _ in family.forms] for family in families]
    best = max(range(len(families)), key=lambda k: max(found[k]))
    return OwnForm(families[best].coordinate, 2 * log_mean([log_mean(one) for one in found]))


def _of_own(information: Array, score: Array, std: float) -> tuple[float, float]:
    """Return the logarithms of the likelihoods, against none, of values of each episode (E, 2) and of one for all."""
    total = information.sum(0, keepdims=True), score.sum(0, keepdims=True)
    return _of_values(information, score, std), _of_values(*total, std)


def _of_values(information: Array, score: Array, std: float) -> float:
    """Return the logarithm of the likelihood, against none, of values (n, 2) of one size before the data."""
    explained = np.einsum("ni,nij,nj->", score, np.linalg.inv(information + np.eye(2) / std**2), score)
    return 0.5 * float(explained - np.linalg.slogdet(np.eye(2) + std**2 * information)[1].sum())
