"""The verbs `cgwm effects`: list and show effects, and write a template of a custom effect."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import Emit
from .options import Overwrite
from .verb import verb

if TYPE_CHECKING:
    from ..schemas.effects import EffectCard, EffectList, NewEffect


@verb
def list_effects(emit: Emit) -> None:
    """List the effects that can be added to a model: built-in ones and those of installed packages."""
    from ..pipeline.physics.effects.catalogue import list_effects as work

    emit(work(), _listed)


@verb
def show_effect(
    emit: Emit,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="An effect, or path/to/file.py:ClassName.", show_default=False)
    ],
) -> None:
    """Show an effect's formula, its parameters, the motion that reveals it, and effects it can be mistaken for."""
    from ..pipeline.physics.effects.catalogue import show_effect as work

    emit(work(name), _shown)


@verb
def new_effect(
    emit: Emit,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The Python file to write.", show_default=False)],
    overwrite: Overwrite = False,
) -> None:
    """Write a template of a custom effect, which runs unchanged."""
    from ..pipeline.physics.effects.catalogue import new_effect as work

    emit(work(file, overwrite), _written)


def _listed(found: EffectList) -> str:
    from .output import table

    rows = [[card.name, card.phase, card.summary] for card in found.effects]
    return "\n".join([table(rows, ["effect", "acts in", "what it is"]), "Next: cgwm effects show NAME"])


def _shown(card: EffectCard) -> str:
    from .output import quantity, table

    parameters = [[p.name, p.unit, _sign(p.sign), quantity(p.scale), quantity(p.limit)] for p in card.parameters]
    constants = [[c.name, c.unit, "each of " + ", ".join(f"{x:g}" for x in c.grid)] for c in card.constants]
    facts = [
        ["acts in", card.phase],
        ["needs", ", ".join(card.needs) or "nothing"],
        ["shown best by", card.reveals],
        ["in free flight the same as", "; ".join(card.aliases) or "no other effect"],
        ["source", card.source],
    ]
    lines = [f"{card.name}: {card.summary}", f"  {card.formula}"]
    lines.append(table(parameters, ["parameter", "unit", "sign", "scale", "at most"]))
    if constants:
        lines.append(table(constants, ["constant", "unit", "tried at"]))
    return "\n".join([*lines, table(facts)])


def _sign(sign: str) -> str:
    return "not negative" if sign == "nonnegative" else "either"


def _written(new: NewEffect) -> str:
    return f"Wrote {new.path}.\nNext: edit it, then cgwm effects show {new.name}"
