"""The work of making a dataset, estimated from counts."""

from __future__ import annotations

import math

from ...datasets.models.model import Model
from ...schemas import SamplingPlan, SynthesizeConfig
from ..physics.contact_detection import pairs_of, slot_count
from ..physics.model_world import world_of_model
from ..physics.rollout_cost import rollout_seconds
from ..runtime.work_budget import Part, duration

LESS = "ask for fewer --rollouts, or a smaller --set synthesize.duration_s, frame_rate_hz, width or height."
_FRAME_S, _PIXEL_S, _SPHERE_S = 5e-3, 1.5e-7, 5e-6
"""Rendering of a picture on the CPU: each, by pixel and by sphere [s]."""
_CUDA_FASTER = 30.0
_PICTURE_BYTES = 12
"""Colour, depth and masks of a pixel in memory [bytes]."""
_STORED_BYTES = 0.1
"""Lower bound of what a pixel takes in the file, compressed [bytes]; photos take 1 to 2."""
_BODY_BYTES, _CONTACT_BYTES = 26 * 8, 11 * 8
"""State, forces and inertia of a body, and a possible contact, at a frame [bytes]."""
_ROLLOUT_BYTES = 20_000
"""Lower bound of a rollout without its frames, in the file [bytes]."""
_SHARD_S = 0.05


def synthesis_parts(
    model: Model, plan: SamplingPlan, config: SynthesizeConfig, rollouts: int, device: str, at_once: int
) -> list[Part]:
    """Return the parts of the work of making rollouts.

    Args:
        model: The model.
        plan: The resolved plan.
        config: The settings.
        rollouts: Number of rollouts to make.
        device: cpu or cuda.
        at_once: Number of rollouts in memory together.
    """
    world = world_of_model(model)
    bodies, frames = len(world.bodies), config.duration_s * config.frame_rate_hz + 1
    views = plan.views if model.body_splats else 0
    slots = sum(slot_count(world, pair) for pair in pairs_of(world))
    simulated = rollout_seconds(world, rollouts, config.duration_s)
    made = Part(
        what=f"{rollouts:.3g} rollouts of {duration(config.duration_s)} in steps of {world.step_s:g} s, "
        f"{world.iterations} sweeps each, {frames:.3g} frames",
        seconds=simulated,
        memory_bytes=min(at_once, rollouts) * frames * (bodies * _BODY_BYTES + slots * _CONTACT_BYTES),
        disk_bytes=rollouts * (_ROLLOUT_BYTES + frames * bodies * 13),
    )
    worst = Part(
        what=f"draws of one rollout that the plan's rules reject, up to {plan.reject.attempts:.3g} (reject.attempts)",
        seconds=max(0.0, plan.reject.attempts - 1000.0) * simulated / max(rollouts, 1),
    )
    pixels, pictures = config.width * config.height, rollouts * frames * views
    picture_s = _FRAME_S + _PIXEL_S * pixels + _SPHERE_S * model.visual_count
    rendered = Part(
        what=f"{pictures:.3g} pictures of {config.width} x {config.height} px of {model.visual_count} spheres",
        seconds=pictures * picture_s / (_CUDA_FASTER if device == "cuda" else 1.0),
        memory_bytes=min(1.0, pictures) * pixels * _PICTURE_BYTES,
        disk_bytes=pictures * pixels * _STORED_BYTES,
    )
    return [made, rendered, *([worst] if worst.seconds else [])]


def shard_parts(parts: list[Part], shards: int, workers: int) -> list[Part]:
    """Return the parts of all shards of a dataset, of which several are made at a time."""
    at_a_time = max(1, min(workers, shards))
    found = [
        Part(what=part.what, seconds=part.seconds / at_a_time, memory_bytes=part.memory_bytes * at_a_time)
        for part in parts
    ]
    overhead = Part(what=f"{shards:.3g} shards", seconds=shards * _SHARD_S, memory_bytes=shards * 4096.0)
    return [*found, *([overhead] if math.log10(shards) > 3 else [])]
