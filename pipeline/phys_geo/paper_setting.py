"""The setting `phys-geo.contact_law=paper`: what a fit of that law does not take."""

from __future__ import annotations

from ...datasets.capture.capture import Capture
from ...datasets.models.joints import refuse_joints
from ...schemas import ModelFile, PhysConfig, UsageError

STEP_S = 2.5e-4
"""Step where none is asked for [s]. A flat side of 80 spheres has 320 rows, for which one explicit evaluation is stable
up to 0.25 ms at a natural time of 10 ms and a damping ratio of 1.8, one standard deviation of the priors from their
medians (`stable_step`); with 1 ms, our law's step, bodies that fell on such a side were thrown off."""
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
