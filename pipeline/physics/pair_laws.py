"""Contact laws in use: each pair of bodies that can touch has the law of its two materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from .contact_detection import pairs_of
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
    pairs = pairs_of(world)
    keys = [world.pair_between(world.material_of(a), world.material_of(b)) for a, b in pairs]
    used = _each_once(keys) or [None]
    return LawsInUse(
        laws=tuple(world.contact if key is None else world.pair_laws[key] for key in used),
        of_pair=tuple(used.index(key) for key in keys),
        materials=tuple(used),
    )


def with_only_law(world: World) -> World:
    """Return a world whose contacts are all of one pair of materials with the law of that pair as its `contact`."""
    used = laws_in_use(world)
    only = used.materials[0] if len(used.materials) == 1 else None
    return world if only is None else replace(world, contact=used.laws[0], pair_laws={})


def _each_once(keys: Sequence[tuple[str, str] | None]) -> list[tuple[str, str] | None]:
    return list(dict.fromkeys(keys))
