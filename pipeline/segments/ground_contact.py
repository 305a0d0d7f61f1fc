"""Contact with the ground alone, where a world has fixed surfaces besides it."""

from __future__ import annotations

from dataclasses import replace

from ..physics.world import World
from ..trajectories.segmentation import clear_of_surfaces
from .prepare import Prepared


def on_the_ground(world: World, prepared: Prepared) -> tuple[World, Prepared]:
    """Return a world without its fixed surfaces, and episodes without what they measured near one; with a ground.

    Effects of contact are those of the ground, and kernels have them for bodies that touch nothing else. Worlds without
    surfaces, or without a ground, and their episodes are returned as they are.

    Args:
        world: The world.
        prepared: The episodes, cut by the world with its surfaces.
    """
    if not world.surfaces or world.ground_normal is None:
        return world, prepared
    whole, items = prepared.observations, prepared.contact_items
    clear = clear_of_surfaces(world, whole, prepared.noise)
    apart = clear | (whole.seen.amax(-1) <= 0)
    kept = tuple(item for item in items if bool(apart[item.episode, item.first : item.last + 1].all()))
    far = clear[..., None].to(whole.seen)
    whole = replace(whole, seen=whole.seen * far, has_orientation=whole.has_orientation * far)
    found = replace(prepared, observations=whole, contact_items=kept)
    if len(kept) < len(items):
        said = (
            f"{len(items) - len(kept)} of {len(items)} pieces of contact touch fixed surfaces; effects of contact are "
            "examined in the others, on the ground. Motions to record next are proposed as if there were no surfaces: "
            "make them where there is room."
        )
        found = replace(found, warnings=(*found.warnings, said))
    return replace(world, surfaces=()), found
