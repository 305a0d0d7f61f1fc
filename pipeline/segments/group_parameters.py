"""Parameters that differ between groups (sessions or episodes), and the world with those that a fit has found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ...schemas import InputDataError, ModelFile
from ..physics.effects.registry import effect_of
from ..physics.parameters import Parameter, effect_parameters
from ..physics.world import World


def group_of(shared: str, episode: str, groups: Mapping[str, str]) -> str:
    """Return the group that an episode belongs to, for parameters shared within `shared`.

    Args:
        shared: "all", "group" or "episode".
        episode: Name of the episode.
        groups: Group of each episode that belongs to one.

    Raises:
        InputDataError: If the parameter is one of groups and the episode belongs to none.
    """
    if shared == "episode":
        return episode
    if shared == "group" and episode not in groups:
        raise InputDataError(
            f"an effect has separate parameters for each group, and episode '{episode}' belongs to no group.",
            f"[episodes.{episode}] group in capture.toml, for every episode.",
            "name the groups, or give each episode separate parameters: NAME@episode.",
        )
    return groups[episode] if shared == "group" else ""


def group_parameters(world: World) -> list[Parameter]:
    """Return the parameters that differ between groups or episodes."""
    return [p for p in effect_parameters(world) if p.shared != "all"]


def with_known_groups(world: World, file: ModelFile, episodes: Sequence[str], groups: Mapping[str, str]) -> World:
    """Return the world in which episodes of groups that the fit has seen use the parameters of their group.

    Other episodes use the mean over the groups of the fit.
    """
    own = {name: _known(world, file, name, groups) for name in episodes}
    return replace(world, own_values={name: values for name, values in own.items() if values})


def _known(world: World, file: ModelFile, episode: str, groups: Mapping[str, str]) -> dict[str, float]:
    """Return the group-specific parameters that the fit knows of an episode, by `effect.parameter`."""
    found: dict[str, float] = {}
    by_effect = {effect_of(effect).name: effect.own for effect in file.effects if effect.own}
    for p in group_parameters(world):
        effect, _, number = p.name.partition(".")
        if p.shared == "group" and episode not in groups:
            continue
        value = by_effect.get(effect, {}).get(group_of(p.shared, episode, groups), {}).get(number)
        if value is not None:
            found[p.name] = value
    return found
