"""Effects that a user asks for: added to a model, fitted, and written back with their values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from ....datasets.capture.tracks import Episode
from ....datasets.models.effect_files import effect_file, read_source
from ....schemas import EffectModel, FittedParameter, InputDataError, PhysConfig, UsageError
from ...physics.effects.registry import effect_of, split_units
from ...physics.effects.trust import trust_effects
from ...physics.world import World
from ...segments.release_detection import from_releases
from ..tracks.contact_fit import fit_physics
from ..tracks.contact_result import PhysicsFit
from ..tracks.earlier_estimates import EarlierEstimates


def with_effects(present: Sequence[EffectModel], wanted: Iterable[str]) -> tuple[EffectModel, ...]:
    """Return the effects of a model, with the wanted ones that it lacks at their neutral values.

    Raises:
        UsageError: If an effect cannot be loaded, or two have one name.
    """
    effects = [*present, *(_named(name, present) for name in wanted)]
    unique: dict[str, EffectModel] = {}
    for effect in effects:
        short = effect_of(effect).name
        if short in unique and split_units(unique[short].name)[0] == split_units(effect.name)[0]:
            # the same effect with another grouping keeps its values
            unique[short] = unique[short].model_copy(update={"name": effect.name})
        if short in unique and unique[short].name != effect.name:
            raise UsageError(
                f"two effects are called '{short}': {unique[short].name} and {effect.name}.", todo="rename one of them."
            )
        unique.setdefault(short, effect)
    return tuple(unique.values())


def _named(name: str, present: Sequence[EffectModel]) -> EffectModel:
    """Return an effect that the user names, which is consent to run its file.

    The file is the model's copy if that has the same content; else what it contains now is what is run and packed.
    """
    found = effect_file(name)
    if found is None or not found[0].is_file():
        return EffectModel(name=name)
    path = found[0].resolve()
    digest = read_source(path)
    trust_effects([digest])
    for effect in present:
        own = effect_file(effect.name)
        if own is not None and effect.sha256 == digest:
            path = own[0]
    return EffectModel(name=f"{path}:{found[1]}", sha256=digest)


def fitted_effects(
    present: Sequence[EffectModel],
    names: Mapping[str, str],
    parameters: Iterable[FittedParameter],
    constants: Mapping[str, float],
    own: Mapping[str, Mapping[str, float]] | None = None,
    spread: Mapping[str, float] | None = None,
) -> tuple[EffectModel, ...]:
    """Return the effects with fitted values.

    Args:
        present: The model's effects.
        names: Short name of each effect, by its name in the model.
        parameters: Fitted parameters, named `effect.parameter`.
        constants: Chosen constants, `effect.constant` by name.
        own: Group- or episode-specific values of `effect.parameter`, by group or episode.
        spread: Standard deviation between groups, by `effect.parameter`.
    """
    found = {p.name: p.estimate for p in parameters if "[" not in p.name} | dict(constants)
    effects = []
    for effect in present:
        prefix = f"{names[effect.name]}."
        specific = {group: _without_prefix(prefix, values) for group, values in (own or {}).items()}
        update = {
            "parameters": effect.parameters | _without_prefix(prefix, found),
            "own": {group: values for group, values in specific.items() if values},
            "spread": _without_prefix(prefix, spread or {}),
        }
        effects.append(effect.model_copy(update=update))
    return tuple(effects)


def _without_prefix(prefix: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values whose names begin with a prefix, by the rest of their names."""
    return {key.removeprefix(prefix): value for key, value in values.items() if key.startswith(prefix)}


def fit_with_effects(
    world: World,
    episodes: Sequence[Episode],
    config: PhysConfig,
    noise: tuple[float | None, float | None],
    warm_started: bool = False,
    groups: Mapping[str, str] | None = None,
    earlier: EarlierEstimates | None = None,
    medians: Mapping[str, float] | None = None,
    force_std_n: float | None = None,
) -> PhysicsFit:
    """Fit the world as `fit_physics` does, after checking its effects' needs and cutting throws at their release.

    Raises:
        InputDataError: If an effect needs what the world or the episodes do not have.
        NotConvergedError: If every rollout diverges.
    """
    _require_needs(world, episodes)
    thrown, warnings = from_releases(world, episodes, noise)
    found = fit_physics(world, thrown, config, noise, warm_started, groups, earlier, medians, force_std_n)
    return replace(found, warnings=(*found.warnings, *warnings))


_NEEDS = {
    "ground": "a ground in the manifest",
    "contact": "something to touch",
    "spin": "measured orientations or spins",
    "orientation": "measured orientations",
    "driven": "a driven body",
}
"""What effects may need, in words."""


def _present(world: World, episodes: Sequence[Episode]) -> frozenset[str]:
    """Return which of the needs of effects a world and episodes meet."""
    free = {body.name for body in world.bodies if body.free}
    measured = [track for _, tracks in episodes for name, track in tracks.items() if name in free]
    turned = any(track.quat_wxyz is not None for track in measured)
    spun = any(track.omega_body_rad_s is not None for track in measured)
    met = {
        "ground": world.ground_normal is not None,
        "contact": world.ground_normal is not None or len(world.bodies) > 1 or bool(world.surfaces),
        "spin": turned or spun,
        "orientation": turned,
        "driven": any(body.motion == "driven" for body in world.bodies),
    }
    return frozenset(need for need, is_met in met.items() if is_met)


def _require_needs(world: World, episodes: Sequence[Episode]) -> None:
    """Refuse effects that need what the world or the episodes do not have."""
    present = _present(world, episodes)
    for effect in (active.effect for active in world.effects):
        if world.chains and (effect.phase == "contact" or set(effect.needs) & set(_NEEDS)):
            raise InputDataError(
                f"the effect '{effect.name}' with a jointed body: effects on it are fitted to the centre of mass of "
                "its links, in flight, which neither turns nor touches anything.",
                "effects of flight, of gravity and of the measurement that need neither contact nor orientations.",
                "leave it out of --effects.",
            )
        lacking = next((need for need in effect.needs if need in _NEEDS and need not in present), None)
        if lacking is not None:
            raise InputDataError(
                f"the effect '{effect.name}' needs {_NEEDS[lacking]}, and this capture has none.",
                todo="add it to the capture, or leave the effect out of --effects.",
            )
        if "driven" in present and effect.phase == "measurement" and "driven" not in effect.needs:
            raise InputDataError(
                f"the effect '{effect.name}' with a driven body: the body's track is its command, and is distorted by "
                "the same measurement, which a fit cannot correct yet.",
                "effects of the measurement for captures without driven bodies.",
                "leave it out of --effects.",
            )
