"""Estimated duration of rollouts, from counts alone: steps, rollouts, possible contacts and sweeps.

The constants are measured on one core of a processor of 2023; other machines and worlds differ by a factor of up to 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...datasets.capture.tracks import Episode
from ..runtime.work_budget import Part, duration
from .contact_detection import pairs_of, slot_count
from .fused import unsupported
from .fused.host import lacking
from .world import World

_CALL_S, _BODY_S, _SLOT_S, _SWEEP_S = 5e-6, 3e-7, 1e-8, 1e-8
"""Fused kernel on the CPU, of a step: of all rollouts together, of a body, of a possible contact, and of an existing
contact in a sweep [s]."""
_TOUCHING = 8, 0.05
"""Existing contacts: all of so few possible ones, and this share of the others."""
_TORCH_CALL_S, _TORCH_SWEEP_S, _TORCH_SLOWER = 1.5e-3, 8e-5, 3.0
"""Torch engine, of a step: of all rollouts together, of a sweep [s]; and how much slower the rest is."""
_CUDA_FASTER = 30.0
"""Speed of the fused kernel on a GPU, compared with the CPU."""

_STATE_BYTES = 13 * 8
"""Pose and velocities of a body, float64 [bytes]."""
_SHORT_ROLLOUTS, _DERIVATIVES = 1500, 5.0
"""Rollouts of the first second of an episode for the tests of all effects, and the cost of their derivatives."""


def rollout_seconds(world: World, rollouts: float, motion_s: float, at_once: float = 1.0) -> float:
    """Return the estimated duration of rollouts [s].

    Args:
        world: The world.
        rollouts: Number of rollouts.
        motion_s: Simulated duration of each [s].
        at_once: Number of rollouts that are simulated together.
    """
    steps = motion_s / world.step_s
    slots = sum(slot_count(world, pair) for pair in pairs_of(world))
    touching = min(slots, _TOUCHING[0] + _TOUCHING[1] * slots)
    step_s = _BODY_S * len(world.bodies) + _SLOT_S * slots + _SWEEP_S * touching * world.iterations
    calls = steps * max(1.0, rollouts / max(at_once, 1.0))
    if "cuda" in (world.rolls_on, world.gravity.device.type) and unsupported(world) is None:
        return (calls * _CALL_S + rollouts * steps * step_s) / _CUDA_FASTER
    if lacking(world) is None:
        return calls * _CALL_S + rollouts * steps * step_s
    torch_s = _TORCH_CALL_S + _TORCH_SWEEP_S * world.iterations
    return calls * torch_s + _TORCH_SLOWER * rollouts * steps * step_s


def durations(episodes: Sequence[Episode], most_s: float = float("inf")) -> list[float]:
    """Return the duration of each episode [s], at most `most_s`."""
    found = []
    for _, tracks in episodes:
        start = min(float(track.time_s[0]) for track in tracks.values())
        end = max(float(track.time_s[-1]) for track in tracks.values())
        found.append(min(end - start, most_s))
    return found


def frame_count(episodes: Sequence[Episode]) -> int:
    """Return the number of frames of the longest episode."""
    return max((len(track) for _, tracks in episodes for track in tracks.values()), default=0)


def rollout_part(
    name: str, world: World, spans_s: Sequence[float], rollouts: float, at_once: float, frames: int = 0
) -> Part:
    """Return the work of rolling out motions of several durations.

    Args:
        name: What the rollouts are for.
        world: The world.
        spans_s: Duration of each motion [s].
        rollouts: Number of rollouts of each.
        at_once: Number of rollouts of all motions that are simulated together.
        frames: Number of frames that each of these rollouts keeps.
    """
    longest = max(spans_s, default=0.0)
    # a batch takes as many steps as its longest rollout
    seconds = rollout_seconds(world, rollouts * len(spans_s), longest, at_once)
    return Part(
        what=f"{name}: {rollouts * len(spans_s):.3g} rollouts of up to {duration(longest)} in steps of "
        f"{world.step_s:g} s, {world.iterations} sweeps each",
        seconds=seconds,
        memory_bytes=min(rollouts * len(spans_s), at_once) * frames * len(world.bodies) * _STATE_BYTES,
    )


def segment_part(name: str, world: World, spans_s: Sequence[float]) -> Part:
    """Return the work of fits and tests on short segments, which lie where something moves: about the first second.

    Args:
        name: What they are for.
        world: The world.
        spans_s: Duration of each episode [s].
    """
    part = rollout_part(name, world, [min(span, 1.0) for span in spans_s], _SHORT_ROLLOUTS, 160)
    return replace(part, seconds=_DERIVATIVES * part.seconds)
