"""Contact laws in use: each pair of bodies that can touch has the law of its two materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .contact_law import ContactLaw
from .paper_law import PaperLaw
from .world import World


@dataclass(frozen=True)
class LawsInUse:
    """The contact laws that act between the bodies of a world."""

    laws: tuple[ContactLaw | PaperLaw, ...]
    """The laws, each once; at least one."""
    of_pair: tuple[int, ...]
    """Number of the law of each pair of `pairs_of`."""
    materials: tuple[tuple[str, str] | None, ...]
    """The materials that each law belongs to; None for that of all other pairs."""


def laws_in_use(world: World) -> LawsInUse:
    """Return the contact laws of all pairs that can touch; where nothing touches, that of pairs without their own."""
    keys = [world.materials_of(a, b) for a, b in world.pairs]
    used = _each_once(keys) or [None]
    return LawsInUse(
        laws=tuple(world.contact if key is None else world.pair_laws[key] for key in used),
        of_pair=tuple(used.index(key) for key in keys),
        materials=tuple(used),
    )


def _each_once(keys: Sequence[tuple[str, str] | None]) -> list[tuple[str, str] | None]:
    return list(dict.fromkeys(keys))
