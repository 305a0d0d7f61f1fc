"""What a fit of the ContactGaussian-WM paper's contact law does not take, and how much longer it lasts."""

from __future__ import annotations

from ...datasets.capture.capture import Capture
from ...datasets.io.progress import note
from ...datasets.models.joints import refuse_joints
from ...schemas import ModelFile, PhysConfig, UsageError

SLOWER = 20
"""How many times longer a fit of the paper's law to a track takes on a CPU, since the kernels do not have it: 48 s
against 2.4 s for a box that falls once."""


def require_paper_law(file: ModelFile, capture: Capture, config: PhysConfig) -> None:
    """Refuse what the paper's law does not have: laws of pairs of materials, effects and jointed bodies; say its cost.

    Raises:
        InputDataError: If a body has joints.
        UsageError: If pairs of materials, or effects, are given.
    """
    setting = f"phys-geo.contact_law={config.contact_law}"
    refuse_joints(file.articulations, str(capture.root), f"fit with {setting}")
    effects = [effect.name for effect in file.effects] + list(config.effects)
    if effects:
        raise UsageError(
            f"{setting} with the effect '{effects[0]}': the fit of effects assumes the law closed_form.",
            "the paper's law without effects.",
            f"leave out {setting}, or the effects.",
        )
    if capture.manifest.pairs or len(capture.manifest.materials) > 1:
        raise UsageError(
            f"{capture.root / 'capture.toml'}: {setting} with laws of pairs of materials: the paper has one for all.",
            "captures without [[materials]] and [[pairs]].",
            f"leave out {setting}, or the materials.",
        )
    note(
        f"phys-geo: the contact law 'paper' runs in the torch engine alone, some {SLOWER} times slower than the kernels"
    )
