"""Effects in a fit: added to the model, and their values written back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ..datasets.tracks import Track
from ..schemas import EffectModel, InputDataError, PhysConfig, UsageError
from ..schemas import Parameter as FittedParameter
from .phys_geo import PhysicsFit, fit_physics
from .physics.effects import load_effect
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
) -> tuple[EffectModel, ...]:
    """Return the effects with the values that a fit found.

    Args:
        present: The model's effects.
        names: The name that an effect gives itself, by the name that the model has for it.
        parameters: What was fitted, `effect.parameter` by name.
        constants: The chosen constants, `effect.constant` by name.
    """
    found = {parameter.name: parameter.estimate for parameter in parameters} | dict(constants)
    effects = []
    for effect in present:
        prefix = f"{names[effect.name]}."
        values = {key.removeprefix(prefix): value for key, value in found.items() if key.startswith(prefix)}
        effects.append(effect.model_copy(update={"parameters": effect.parameters | values}))
    return tuple(effects)


def fit_with_effects(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    config: PhysConfig,
    noise: tuple[float | None, float | None],
    begun: bool = False,
) -> PhysicsFit:
    """Fit the world, see `fit_physics`, where its effects have what they need.

    Raises:
        InputDataError: If an effect needs what the world or the episodes do not have.
        NotConvergedError: If every rollout diverges.
    """
    _require_needs(world, episodes)
    return fit_physics(world, episodes, config, noise, begun)


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
        for number in effect.parameters:
            if number.shared != "all":
                raise InputDataError(
                    f"{effect.name}.{number.name} is one value for each {number.shared}; a fit finds one for all.",
                    'shared = "all".',
                )
