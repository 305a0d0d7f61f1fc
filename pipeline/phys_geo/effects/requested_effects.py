"""Effects in a fit: added to the model, and their values written back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ..datasets.tracks import Track
from ..schemas import EffectModel, InputDataError, PhysConfig, UsageError
from ..schemas import Parameter as FittedParameter
from .diagnosis.releases import after_release, find_releases
from .phys_geo import PhysicsFit, fit_physics
from .physics.effects import load_effect
from .physics.effects.registry import split_units
from .physics.world import World


def with_effects(present: Sequence[EffectModel], wanted: Iterable[str]) -> tuple[EffectModel, ...]:
    """Return the effects of a model and the wanted ones that it does not have yet, at their neutral values.

    Raises:
        UsageError: If an effect cannot be loaded, or two have one name.
    """
    effects = [*present, *(EffectModel(name=_absolute(name)) for name in wanted)]
    unique: dict[str, EffectModel] = {}
    for effect in effects:
        own = load_effect(effect.name).name
        if own in unique and split_units(unique[own].name)[0] == split_units(effect.name)[0]:
            # the same effect, shared otherwise: it goes on from where it is
            unique[own] = unique[own].model_copy(update={"name": effect.name})
        if own in unique and unique[own].name != effect.name:
            raise UsageError(
                f"two effects are called '{own}': {unique[own].name} and {effect.name}.", todo="rename one of them."
            )
        unique.setdefault(own, effect)
    return tuple(unique.values())


def _absolute(name: str) -> str:
    """Return the name of an effect, a user's file by its whole path, so that the model finds it from anywhere."""
    file, _, rest = name.partition(":")
    return f"{Path(file).resolve()}:{rest}" if file.endswith(".py") else name


def fitted_effects(
    present: Sequence[EffectModel],
    names: Mapping[str, str],
    parameters: Iterable[FittedParameter],
    constants: Mapping[str, float],
    own: Mapping[str, Mapping[str, float]] | None = None,
    spread: Mapping[str, float] | None = None,
) -> tuple[EffectModel, ...]:
    """Return the effects with the values that a fit found.

    Args:
        present: The model's effects.
        names: The name that an effect gives itself, by the name that the model has for it.
        parameters: What was fitted, `effect.parameter` by name.
        constants: The chosen constants, `effect.constant` by name.
        own: By session or episode, the values of `effect.parameter` that are its own.
        spread: Of these from unit to unit, `effect.parameter` by name.
    """
    found = {p.name: p.estimate for p in parameters if "[" not in p.name} | dict(constants)
    effects = []
    for effect in present:
        prefix = f"{names[effect.name]}."
        values = {key.removeprefix(prefix): value for key, value in found.items() if key.startswith(prefix)}
        mine = {
            unit: {key.removeprefix(prefix): value for key, value in numbers.items() if key.startswith(prefix)}
            for unit, numbers in (own or {}).items()
        }
        update = {
            "parameters": effect.parameters | values,
            "own": {unit: numbers for unit, numbers in mine.items() if numbers},
            "spread": {
                key.removeprefix(prefix): value for key, value in (spread or {}).items() if key.startswith(prefix)
            },
        }
        effects.append(effect.model_copy(update=update))
    return tuple(effects)


def fit_with_effects(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    config: PhysConfig,
    noise: tuple[float | None, float | None],
    begun: bool = False,
    groups: Mapping[str, str] | None = None,
) -> PhysicsFit:
    """Fit the world, see `fit_physics`, where its effects have what they need; throws count from their release on.

    Raises:
        InputDataError: If an effect needs what the world or the episodes do not have.
        NotConvergedError: If every rollout diverges.
    """
    _require_needs(world, episodes)
    released_s, warnings = find_releases(world, episodes, noise)
    found = fit_physics(world, after_release(episodes, released_s), config, noise, begun, groups)
    return replace(found, warnings=(*found.warnings, *warnings))


def _require_needs(world: World, episodes: Sequence[tuple[str, dict[str, Track]]]) -> None:
    free = {body.name for body in world.bodies if body.free}
    turned = any(
        name in free and track.quat_wxyz is not None for _, tracks in episodes for name, track in tracks.items()
    )
    has = {
        "ground": world.ground_normal is not None,
        "contact": world.ground_normal is not None or len(world.bodies) > 1,
        "spin": turned,
        "driven": any(body.motion == "driven" for body in world.bodies),
    }
    words = {
        "ground": "a ground in the manifest",
        "contact": "something to touch",
        "spin": "measured orientations",
        "driven": "a driven body",
    }
    for active in world.effects:
        effect = active.effect
        for need in effect.needs:
            if not has.get(need, True):
                raise InputDataError(
                    f"the effect '{effect.name}' needs {words[need]}, and this capture has none.",
                    todo="add it to the capture, or leave the effect out of --effects.",
                )
        if has["driven"] and effect.phase == "measurement" and "driven" not in effect.needs:
            raise InputDataError(
                f"the effect '{effect.name}' with a driven body: its track is its command and was measured alike, "
                "which a fit cannot undo yet.",
                "effects of the measurement for captures without driven bodies.",
                "leave it out of --effects.",
            )
