"""Random draws of one rollout: physical parameters, start, cameras and light."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...datasets.capture.cameras import Camera
from ...datasets.models.model import Model
from ...datasets.rollouts.rollouts import RolloutParameter
from ...schemas import Exposure, GroundShadow, Light, ModelFile, SamplingPlan, SynthesizeConfig
from ...schemas.quantities import Vector3
from ..rendering.ground_shadow import shadow_of
from .distributions import draw
from .parameters import draw_parameters
from .plan import up_direction
from .start_states import Start, draw_start
from .viewpoints import look_at_cameras


@dataclass(frozen=True, kw_only=True)
class Draw:
    """Draws of a rollout before its simulation."""

    index: int
    """Global number of the rollout."""
    attempt: int
    """Number of earlier draws of this rollout."""
    model: Model
    """The model with the parameters of this rollout."""
    parameters: tuple[RolloutParameter, ...]
    """Physical parameters of this rollout."""
    start: Start
    """Initial state, and motions of the driven bodies."""
    cameras: Mapping[str, Camera]
    """Cameras by name."""
    lighting: Lighting
    """Light of the rollout and exposures of its cameras."""


def seed_of(seed: int, index: int, attempt: int) -> np.random.SeedSequence:
    """Return the seed sequence of all draws of a rollout at an attempt, counted from 0."""
    return np.random.SeedSequence(seed, spawn_key=(index, attempt) if attempt else (index,))


def draw_rollout(
    model: Model,
    plan: SamplingPlan,
    config: SynthesizeConfig,
    cameras: Mapping[str, Camera],
    duration_s: float,
    index: int,
    attempt: int = 0,
) -> Draw:
    """Draw a rollout as a function of the seed, its number and the attempt alone.

    Args:
        model: The fitted model.
        plan: A resolved plan.
        config: The seed, and the size of the images.
        cameras: Cameras that all rollouts share; empty for a model without visual spheres.
        duration_s: Length of the rollout [s].
        index: Global number of the rollout.
        attempt: Number of earlier draws of it.
    """
    rng = np.random.default_rng(seed_of(config.seed, index, attempt))
    file, parameters = draw_parameters(model.file, plan.parameter_spread, rng, plan.parameters)
    drawn = replace(model, file=file)
    start = draw_start(drawn, plan, duration_s, rng)
    if cameras and plan.moving_views:
        cameras = look_at_cameras(model, plan, config, rng)
    lighting = draw_lighting(file, up_direction(file), plan, cameras, rng)
    return Draw(
        index=index,
        attempt=attempt,
        model=drawn,
        parameters=parameters,
        start=start,
        cameras=cameras,
        lighting=lighting,
    )


@dataclass(frozen=True)
class Lighting:
    """Light of a rollout and exposures of its cameras."""

    light: Light | None
    """Lamp and sky that shade the moving bodies; None if the model has no light."""
    gain_rgb: np.ndarray
    """Brightness of the light relative to the photos by colour channel [1], shape (3,)."""
    exposures: dict[str, Exposure]
    """Exposure by camera: its image is gain * picture + offset, including the gain of the light."""
    shadow: GroundShadow | None
    """Shadow that moving bodies cast on the ground under the lamp; None if the model tells none."""

    @property
    def plain(self) -> bool:
        """Whether the pictures remain unchanged."""
        return all(exposure == Exposure() for exposure in self.exposures.values())


def draw_lighting(
    file: ModelFile, up: np.ndarray, plan: SamplingPlan, cameras: Iterable[str], rng: np.random.Generator
) -> Lighting:
    """Draw the light of a rollout and the exposure of each camera.

    Args:
        file: The model.
        up: Normal of the ground, world frame, shape (3,).
        plan: A resolved plan.
        cameras: Names of the cameras.
        rng: Source of randomness.
    """
    light, angle = file.light, math.radians(draw(plan.light_turn_deg, rng))
    shadow = shadow_of(file)
    if light is not None and angle:
        light = light.model_copy(update={"lamp": _turned(light.lamp, up, angle)})
    if shadow is not None and angle:
        shadow = shadow.model_copy(update={"to_lamp": _turned(shadow.to_lamp, up, angle)})
    gain = draw(plan.light_gain, rng) * np.array([draw(plan.light_tint, rng) for _ in range(3)])
    exposures = {}
    for name in cameras:
        own = gain * draw(plan.exposure_gain, rng) * [draw(plan.exposure_tint, rng) for _ in range(3)]
        offset = draw(plan.exposure_offset, rng)
        exposures[name] = Exposure(
            gain_rgb=(float(own[0]), float(own[1]), float(own[2])), offset_rgb=(offset, offset, offset)
        )
    return Lighting(light, gain, exposures, shadow)


def _turned(vector: Vector3, up: np.ndarray, angle: float) -> Vector3:
    """Return a vector turned by an angle [rad] about the unit vector `up` (Rodrigues' formula)."""
    v = np.asarray(vector)
    x, y, z = v * math.cos(angle) + np.cross(up, v) * math.sin(angle) + up * (up @ v) * (1 - math.cos(angle))
    return float(x), float(y), float(z)
