"""The setting `phys-geo.contact_law=paper`: what a fit of that law does not take."""

from __future__ import annotations

from ...datasets.capture.capture import Capture
from ...datasets.models.joints import refuse_joints
from ...schemas import ModelFile, PhysConfig, UsageError
from ..physics.body import Body
from ..physics.hull import Hull
from ..physics.paper_law import PaperLaw, stable_step
from ..physics.smooth_distance import plane_contacts
from ..physics.world import World

STEP_S = 2.5e-4
"""Step where none is asked for [s]. A flat side of 80 spheres has 320 rows, for which one explicit evaluation is stable
up to 0.25 ms at a natural time of 10 ms and a damping ratio of 1.8, one standard deviation of the priors from their
medians (`stable_step`); with 1 ms, our law's step, bodies that fell on such a side were thrown off."""
SIDE_M = 1e-3
"""Depth within which spheres touch a plane at once [m]."""
_PARTS = ("mass_distribution", "length_scale")


def paper_config(file: ModelFile, capture: Capture, config: PhysConfig) -> PhysConfig:
    """Return the settings of a fit of the paper's law.

    Mass distribution and scale are not chosen by windows about impacts, which assume our law; contact spheres are
    refined as published, unless the setting `geometry` says no; steps are shorter, as the law is stable with short ones
    alone.

    Args:
        file: The model from which the fit starts.
        capture: The capture.
        config: The settings as given.

    Raises:
        InputDataError: If a body has joints.
        UsageError: If laws of pairs of materials, effects or those parts are asked for.
    """
    setting = f"phys-geo.contact_law={config.contact_law}"
    refuse_joints(file.articulations, str(capture.root), f"fit with {setting}")
    manifest = capture.manifest
    asked = [f"the effect '{name}'" for name in (*(effect.name for effect in file.effects), *config.effects)]
    asked += [f"phys-geo.{name}=true" for name in _PARTS if getattr(config, name) is True]
    asked += ["laws of pairs of materials"] if manifest.pairs or len(manifest.materials) > 1 else []
    if asked:
        raise UsageError(
            f"{setting} with {asked[0]}: the paper has one law for all contacts, and fits beside it assume ours.",
            "the paper's law alone.",
            "leave out one of the two, or use phys-geo.contact_law=closed_form.",
        )
    step_s = config.step_s if "step_s" in config.model_fields_set else STEP_S
    given = {**dict.fromkeys(_PARTS, False), "geometry": config.geometry is not False, "step_s": step_s}
    return config.model_copy(update=given)


def unstable_sides(world: World) -> tuple[str, ...]:
    """Return warnings where the paper's law is not stable for a free body that lies on its widest side."""
    law, found = world.contact, []
    for body in world.bodies:
        if not body.free or not isinstance(law, PaperLaw):
            continue
        count = widest_side(body)
        most_s = float(stable_step(law, body.mass, law.directions * count).min())
        if world.step_s > most_s:
            found.append(
                f"the paper's law with these numbers is not stable where body '{body.name}' lies on {count} spheres at "
                f"once: its step is {1e3 * world.step_s:.3g} ms, and up to {1e3 * most_s:.2g} ms are. Predictions may "
                f"be thrown off; fit with --set phys-geo.step_s={0.9 * most_s:.1g}"
            )
    return tuple(found)


def widest_side(body: Body) -> int:
    """Return the largest number of a body's spheres that the plane of a face of their hull touches at once."""
    centers, radii = body.centers[0], body.radii[0]
    hull = body.hull or Hull.of(centers, radii, plane_contacts(centers, radii))
    if hull is None:
        return 1
    reach = centers @ hull.faces[:, :3].T + radii[:, None]
    return int((reach > reach.amax(0) - SIDE_M).sum(0).max())
