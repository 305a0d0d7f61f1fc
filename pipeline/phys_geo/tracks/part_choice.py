"""What a fit to tracks estimates beside the contact, decided by held-out tosses before anything of it is fitted.

The parts are the centre of mass, the second moments of mass and the scale of lengths. Each set of them is judged by the
misfit of tosses that its estimate has not seen (`segments/held_out_gain.py`). A part stays out unless it lowers this
misfit beyond chance, also beside a drag or an offset of the marker where tosses ask for one; the scale and the centre
of mass also have to beat the effects that look the same in flight. What is fitted then has to have a number: a part all
of whose numbers lie within their errors of what the capture gives is not taken over (`without_number`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ....datasets.capture.tracks import Episode
from ....datasets.io.progress import note
from ....schemas import FitChoice, FittedParameter, HeldOutFall, PhysConfig
from ...physics.effects import ActiveEffect, load_effect
from ...physics.effects.registry import FLIGHT_ALIASES
from ...physics.parameters import GROUND_SHIFT, Parameter, contact_parameters, effect_parameters
from ...physics.world import World
from ...segments.held_out_gain import LEAST_EPISODES, ContactLinearization, HeldOutGain, has_number
from ...trajectories.initial_state import flight_frames
from ...trajectories.observations import Observations
from ...trajectories.track_noise import Noise
from .inertia_fit import MASS_PARTS, mass_parameters, turns

SCALE = "length_scale"
"""The part that is an effect of the measurement; the others are those of the mass distribution."""
RIVALS = {SCALE: ("gravity_scale", "clock_scale", "linear_drag"), "centre_of_mass": ("marker_offset",)}
"""Effects that look like a part before the first contact."""
DRAGS = ("linear_drag", "quadratic_drag")
FOLLOWED = (*DRAGS, "marker_offset")
"""Effects that a fit of the mass distribution would follow for lack of anything else."""
FLIGHT_FRAMES = 3
"""Minimum number of frames before the first contact, which determine the velocities at it."""
WORDS = {"centre_of_mass": "centre of mass", "second_moments": "second moments of mass", SCALE: "scale of lengths"}
"""The parts in a sentence."""

Parts = tuple[str, ...]
"""Names of parts, in the order of `WORDS`."""


def asked_parts(config: PhysConfig) -> Parts:
    """Return the parts that the settings ask for."""
    mass = MASS_PARTS if config.mass_distribution is True else ()
    return (*mass, *((SCALE,) if config.length_scale is True else ()))


def choose_parts(world: World, episodes: Sequence[Episode], noise: Noise, config: PhysConfig) -> FitChoice | None:
    """Return the parts that held-out tosses ask for, beside those that the settings ask for.

    Args:
        world: The world; its effects are at their start.
        episodes: Name and tracks by body of each training episode.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
        config: The stage's settings; what they give as true or false is not chosen.

    Returns:
        The choice; None if the settings leave nothing to choose, or the episodes have too few tosses.

    Raises:
        NotConvergedError: If the rollouts diverge at the start.
    """
    tosses = _tosses(world, episodes)
    open_parts = _open_parts(world, config)
    if not open_parts or len(tosses) < LEAST_EPISODES:
        return None
    note(f"phys-geo: which of {', '.join(open_parts)} predict held-out episodes")
    return _Comparison.of(world, tosses, noise, asked_parts(config)).choice(open_parts)


def _tosses(world: World, episodes: Sequence[Episode]) -> list[Episode]:
    """Return the episodes in which turning bodies fly before they touch the ground."""
    if world.ground_normal is None:
        return []
    turning = [e for e in episodes if all(turns(e.tracks.get(world.bodies[i].name)) for i in world.free)]
    if not turning:
        return []
    whole = Observations.of(world, turning, [(-np.inf, np.inf)] * len(turning))
    flying = flight_frames(world, whole).sum(1).tolist()
    return [
        episode
        for episode, count, frames in zip(turning, flying, whole.frames.tolist(), strict=True)
        if FLIGHT_FRAMES <= count < frames
    ]


def _open_parts(world: World, config: PhysConfig) -> Parts:
    """Return the parts that the settings leave open, and that no effect of the world has in its place."""
    present = {active.effect.name for active in world.effects}
    alike = {name for group in FLIGHT_ALIASES if SCALE in group for name in group} | set(RIVALS[SCALE])
    mass = MASS_PARTS if config.mass_distribution == "auto" and not present & {"com_offset", "inertia_shape"} else ()
    return (*mass, *((SCALE,) if config.length_scale == "auto" and not present & alike else ()))


def without_number(choice: FitChoice, fitted: Sequence[FittedParameter], given: Mapping[str, float]) -> FitChoice:
    """Return a choice without the parts all of whose numbers lie within their errors of what was given.

    Args:
        choice: The choice.
        fitted: Parameters of the mass distribution.
        given: Their values before, by name.
    """
    for part, mark in (("centre_of_mass", ".com_"), ("second_moments", ".moment_")):
        own = [(one.estimate - given[one.name], one.std_error) for one in fitted if mark in one.name]
        if part in choice.chosen and not has_number(own):
            why = "but no number of it differs from what the capture gives beyond chance"
            choice = _left_out(choice, part, f"would lower the misfit about first contacts, {why}")
    return choice


def without_contradicted(choice: FitChoice, part: str) -> FitChoice:
    """Return a choice without a part with which flights fit worse."""
    return _left_out(
        choice,
        part,
        "would lower the misfit about first contacts, but the flights, which no law of contact enters, fit worse with "
        "what these ask for",
    )


def _left_out(choice: FitChoice, part: str, why: str) -> FitChoice:
    """Return a choice without a part, and why."""
    chosen = tuple(one for one in choice.chosen if one != part)
    kept = f"; the {_listed(chosen)} {'are' if _plural(chosen) else 'is'} fitted, too" if chosen else ""
    sentence = (
        f"By cross-validation over {choice.episodes} training tosses the {WORDS[part]} {why}, and it stays as before"
        f"{kept}."
    )
    return choice.model_copy(update={"chosen": chosen, "sentence": sentence})


@dataclass(frozen=True, eq=False, kw_only=True)
class _Comparison:
    """Sets of parts on held-out tosses."""

    linear: ContactLinearization
    """The misfit of the tosses in all parameters."""
    columns: dict[str, list[int]]
    """Indices of the parameters of each part and rival."""
    asked: Parts
    """Parts that are fitted in any case."""

    @staticmethod
    def of(world: World, tosses: Sequence[Episode], noise: Noise, asked: Parts) -> _Comparison:
        """Linearise the misfit of the tosses."""
        own = {active.effect.name for active in world.effects}
        rivals = [name for some in RIVALS.values() for name in some]
        added = [name for name in dict.fromkeys((SCALE, *rivals, *FOLLOWED)) if name not in own]
        neutral = tuple(ActiveEffect.of(load_effect(name), {}, world.gravity) for name in added)
        wide = replace(world, effects=(*world.effects, *neutral))
        base = [(p, p.prior[0]) for p in (*contact_parameters(world), GROUND_SHIFT)]
        further: list[tuple[str, Parameter, float]] = []
        for part in MASS_PARTS:
            further += [(part, p, value) for p, value in mass_parameters(world, (part,))]
        for parameter in effect_parameters(wide):
            effect = parameter.name.partition(".")[0]
            if effect in added:
                further.append((effect, parameter, 0.0))
        linear = ContactLinearization.of(wide, tosses, base, [(p, value) for _, p, value in further], noise)
        columns: dict[str, list[int]] = {}
        for k, (part, _, _) in enumerate(further):
            columns.setdefault(part, []).append(len(base) + k)
        return _Comparison(linear=linear, columns=columns, asked=asked)

    def gain(self, parts: Parts, over: Parts = ()) -> HeldOutGain:
        """Return the gain of parts over other ones, each with those that are asked for."""
        return self.linear.gain(*(self._columns((*self.asked, *some)) for some in (parts, over)))

    def _columns(self, parts: Parts) -> list[int]:
        return [column for part in parts for column in self.columns[part]]

    def choice(self, open_parts: Parts) -> FitChoice:
        """Return the best set of the open parts, each of which is needed."""
        sets = [some for count in range(1, len(open_parts) + 1) for some in combinations(open_parts, count)]
        gains = {some: self.gain(some) for some in sets}
        drag, followed = self._asked_for(DRAGS), self._asked_for(FOLLOWED)
        beside = () if followed is None else (followed,)
        admitted = [
            some
            for some in sets
            if gains[some].matters and self._beats_rivals(some) and self._beside(some, beside).matters
        ]
        chosen = max(admitted, key=lambda some: gains[some].share, default=())
        while unneeded := [part for part in chosen if not self._needed(part, chosen)]:
            weakest = min(unneeded, key=lambda part: self.gain(chosen, _without(chosen, part)).share)
            chosen = _without(chosen, weakest)
        return FitChoice(
            episodes=len(self.linear.score),
            chosen=chosen,
            tested=tuple(
                HeldOutFall(parts=some, share=gains[some].share, std_error=gains[some].std_error) for some in sets
            ),
            sentence=_sentence(len(self.linear.score), open_parts, chosen, gains.get(chosen))
            + ("" if drag is None or chosen else _force(drag, self.gain((drag,)))),
        )

    def _asked_for(self, effects: Sequence[str]) -> str | None:
        """Return which of some effects held-out tosses ask for most; None where they ask for none."""
        gains = {name: self.gain((name,)) for name in effects if name in self.columns}
        return max((name for name in gains if gains[name].matters), key=lambda name: gains[name].share, default=None)

    def _beside(self, parts: Parts, other: Parts) -> HeldOutGain:
        """Return the gain of parts beside another effect: what that explains in flight is no mass distribution."""
        return self.gain((*parts, *other), other)

    def _needed(self, part: str, chosen: Parts) -> bool:
        """Return whether held-out tosses miss a part of the chosen ones."""
        return self.gain(chosen, _without(chosen, part)).matters

    def _beats_rivals(self, parts: Parts) -> bool:
        """Return whether each of the parts predicts better than each effect that looks the same in flight."""
        return all(
            self.gain(parts, (*_without(parts, part), rival)).beyond_chance
            for part in parts
            for rival in RIVALS.get(part, ())
            if rival in self.columns
        )


def _without(parts: Parts, part: str) -> Parts:
    """Return the parts without one."""
    return tuple(other for other in parts if other != part)


def _sentence(episodes: int, open_parts: Parts, chosen: Parts, gain: HeldOutGain | None) -> str:
    """Return what was chosen, in one sentence."""
    begin = f"By cross-validation over {episodes} training tosses"
    left = [part for part in open_parts if part not in chosen]
    if gain is None:
        return f"{begin} the {_listed(left)} {_left(left)}: held-out tosses are not predicted better with them fitted."
    verb = "are fitted, too" if _plural(chosen) else "is fitted, too"
    rest = f"; the {_listed(left)} {_left(left)}" if left else ""
    share = f"{100 * gain.share:.0f} +- {100 * gain.std_error:.0f} %"
    return f"{begin} the {_listed(chosen)} {verb}: the misfit of held-out tosses falls by {share}{rest}."


def _force(drag: str, gain: HeldOutGain) -> str:
    """Return that a force in flight explains held-out tosses better, as a further sentence."""
    share = f"{100 * gain.share:.0f} +- {100 * gain.std_error:.0f} %"
    return f" A force in flight, as {drag}, lets that misfit fall by {share}: cgwm diagnose tells which."


def _left(parts: Sequence[str]) -> str:
    """Return what happens to parts that are not fitted."""
    return "stay as they are" if _plural(parts) else "stays as it is"


def _plural(parts: Sequence[str]) -> bool:
    """Return whether parts in words take a plural verb."""
    return len(parts) > 1 or "second_moments" in parts


def _listed(parts: Sequence[str]) -> str:
    """Return parts in words."""
    *first, last = (WORDS[part] for part in parts)
    return f"{', '.join(first)} and {last}" if first else last
