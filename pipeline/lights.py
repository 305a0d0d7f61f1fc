"""The light of a rollout and the exposures of its cameras, drawn from a sampling plan."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..schemas import Exposure, Light, ModelFile, SamplingPlan
from .distributions import draw


@dataclass(frozen=True)
class Lighting:
    """What a rollout's pictures are seen in.

    Attributes:
        light: The lamp and the sky that shade the moving bodies; None where the model has no light.
        gain_rgb: Brightness of the rollout's light relative to the photos [1], shape (3,).
        exposures: Of each camera: what it shows is gain * picture + offset, the light's gain included.
    """

    light: Light | None
    gain_rgb: np.ndarray
    exposures: dict[str, Exposure]

    @property
    def plain(self) -> bool:
        """Whether the pictures stay as they are."""
        return all(exposure == Exposure() for exposure in self.exposures.values())


def draw_lighting(
    file: ModelFile, up: np.ndarray, plan: SamplingPlan, cameras: Iterable[str], rng: np.random.Generator
) -> Lighting:
    """Draw the light of a rollout and the exposure of each camera.

    Args:
        file: The model.
        up: The ground's normal, world frame, shape (3,).
        plan: A resolved plan.
        cameras: Names of the cameras.
        rng: Source of randomness.
    """
    light, angle = file.light, math.radians(draw(plan.light_turn_deg, rng))
    if light is not None and angle:
        lamp = np.asarray(light.lamp)
        # Rodrigues: about the unit vector up
        turned = (
            lamp * math.cos(angle) + np.cross(up, lamp) * math.sin(angle) + up * (up @ lamp) * (1 - math.cos(angle))
        )
        light = light.model_copy(update={"lamp": (float(turned[0]), float(turned[1]), float(turned[2]))})
    gain = draw(plan.light_gain, rng) * np.array([draw(plan.light_tint, rng) for _ in range(3)])
    exposures = {}
    for name in cameras:
        own = gain * draw(plan.exposure_gain, rng) * [draw(plan.exposure_tint, rng) for _ in range(3)]
        offset = draw(plan.exposure_offset, rng)
        exposures[name] = Exposure(
            gain_rgb=(float(own[0]), float(own[1]), float(own[2])), offset_rgb=(offset, offset, offset)
        )
    return Lighting(light, gain, exposures)
