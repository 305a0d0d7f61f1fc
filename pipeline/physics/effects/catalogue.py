"""Catalogue of effects for `cgwm effects`: list, description, and a template for custom effects."""

from __future__ import annotations

from pathlib import Path

from ....datasets.io.atomic import new_file
from ....datasets.io.outputs import signed
from ....schemas import UsageError
from ....schemas.effects import EffectCard, EffectConstantCard, EffectList, EffectParameterCard, NewEffect
from .registry import aliases, effect_names, load_effect


def list_effects() -> EffectList:
    """Return the built-in effects and those of installed packages."""
    return EffectList(effects=tuple(show_effect(name) for name in effect_names()))


def show_effect(spec: str) -> EffectCard:
    """Return the description of an effect.

    Args:
        spec: Its name, or `path/to/file.py:ClassName`.

    Raises:
        UsageError: If there is no such effect, or it is badly declared.
    """
    effect = load_effect(spec)
    return EffectCard(
        name=spec,
        summary=effect.summary,
        formula=effect.formula,
        parameters=tuple(
            EffectParameterCard(
                name=p.name,
                unit=p.unit,
                sign="nonnegative" if p.nonnegative else "any",
                scale=p.scale,
                limit=p.limit,
                shared=p.shared,
            )
            for p in effect.parameters
        ),
        constants=tuple(EffectConstantCard(name=c.name, unit=c.unit, grid=c.grid) for c in effect.constants),
        phase=effect.phase,
        needs=effect.needs,
        reveals=effect.reveals,
        aliases=tuple(aliases(effect.name)),
        source=effect.source,
    )


def new_effect(file: Path | str, overwrite: bool = False) -> NewEffect:
    """Write a template of a custom effect, which runs unchanged.

    Raises:
        UsageError: If the name does not end with .py, or the file exists and `overwrite` is not set.
    """
    path = Path(file)
    if path.suffix != ".py":
        raise UsageError(
            f"{path}: an effect is a Python file.",
            "a name that ends with .py.",
            "end the name with .py: cgwm effects new FILE.py.",
        )
    text = (Path(__file__).parent / "template.py").read_text(encoding="utf-8")
    text = text.replace("from .effect import", "from cgwm.pipeline.physics.effects import")  # from outside the package
    with new_file(path, "effect template", overwrite) as partial:
        partial.write_text(signed(text), encoding="utf-8")
    return NewEffect(path=str(path), name=f"{path}:MyEffect")
