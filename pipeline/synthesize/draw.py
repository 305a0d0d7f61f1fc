"""What is drawn for one rollout: its physics, its start, its cameras, its light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..datasets.cameras import Camera
from ..datasets.models import Model
from ..datasets.rollouts import RolloutParameter
from ..schemas import SamplingPlan, SynthesizeConfig
from .lights import Lighting, draw_lighting
from .posterior import draw_parameters
from .sampling import Start, draw_start, look_at_cameras, up_direction


@dataclass(frozen=True)
class Draw:
    """A rollout before it is simulated.

    index: its global number; attempt: how often that was drawn before; model: with this rollout's parameters.
    """

    index: int
    attempt: int
    model: Model
    parameters: tuple[RolloutParameter, ...]
    start: Start
    cameras: Mapping[str, Camera]
    lighting: Lighting


def seed_of(seed: int, index: int, attempt: int) -> np.random.SeedSequence:
    """Return the source of all that is drawn for a rollout at an attempt, counted from 0."""
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
    """Draw a rollout from the seed, its number and the attempt alone.

    Args:
        model: The fitted model.
        plan: A resolved plan.
        config: The seed, and the size of the images.
        cameras: Those that all rollouts share; none where there is nothing to see.
        duration_s: Length of the rollout [s].
        index: Its global number.
        attempt: How often it was drawn before.
    """
    rng = np.random.default_rng(seed_of(config.seed, index, attempt))
    file, parameters = draw_parameters(model.file, plan.parameter_spread, rng, plan.parameters)
    drawn = replace(model, file=file)
    start = draw_start(drawn, plan, duration_s, rng)
    if cameras and plan.moving_views:
        cameras = look_at_cameras(model, plan, config, rng)
    lighting = draw_lighting(file, up_direction(file), plan, cameras, rng)
    return Draw(index, attempt, drawn, parameters, start, cameras, lighting)
