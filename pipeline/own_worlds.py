"""Models with numbers of each session's, or episode's, own, on episodes of which the fit knows them, or does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..datasets.tracks import Track
from ..schemas import ModelFile
from .estimation.observations import Observations
from .estimation.warmup import flight_frames
from .own_numbers import Ties, fit_own_numbers, unit_of
from .physics.effects.registry import load_effect
from .physics.parameters import Parameter, effect_parameters
from .physics.world import World


def with_known_numbers(world: World, file: ModelFile, episodes: Sequence[str], groups: Mapping[str, str]) -> World:
    """Return the world in which episodes of known sessions, or known ones, have their own numbers.

    The others have the mean over those that the fit has seen.
    """
    own = {name: _known(world, file, name, groups) for name in episodes}
    return replace(world, own={name: numbers for name, numbers in own.items() if numbers})


def with_fitted_numbers(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    file: ModelFile,
    groups: Mapping[str, str],
    noise: tuple[float, float],
) -> World:
    """Return the world in which all episodes have numbers of their own: those that the fit knows, the others fitted.

    What is fitted to an episode that is predicted is no prediction: it stands beside a state fitted to it.
    """
    own = own_parameters(world)
    known = with_known_numbers(world, file, [name for name, _ in episodes], groups)
    unknown = [(name, tracks) for name, tracks in episodes if len(known.own.get(name, {})) < len(own)]
    if not own or not unknown:
        return known
    centre = {f"{a.effect.name}.{name}": float(value) for a in world.effects for name, value in a.values.items()}
    spread = {f"{load_effect(e.name).name}.{name}": std for e in file.effects for name, std in e.spread.items()}
    whole = Observations.of(known, unknown, [(-float("inf"), float("inf"))] * len(unknown))
    flying = bool(flight_frames(known, whole)[whole.seen.amax(-1) > 0].all())
    ties = Ties({p.name: centre[p.name] for p in own}, spread)
    found = fit_own_numbers(known, unknown, groups, [(p, centre[p.name]) for p in own], (), noise, flying, 0.0, ties)
    return replace(known, own=dict(found.world.own))


def own_parameters(world: World) -> list[Parameter]:
    """Return the parameters of which each session, or episode, has its own."""
    return [p for p in effect_parameters(world) if p.shared != "all"]


def _known(world: World, file: ModelFile, episode: str, groups: Mapping[str, str]) -> dict[str, float]:
    found: dict[str, float] = {}
    by_effect = {load_effect(effect.name).name: effect.own for effect in file.effects if effect.own}
    for p in own_parameters(world):
        effect, _, number = p.name.partition(".")
        if p.shared == "group" and episode not in groups:
            continue
        value = by_effect.get(effect, {}).get(unit_of(p.shared, episode, groups), {}).get(number)
        if value is not None:
            found[p.name] = value
    return found
