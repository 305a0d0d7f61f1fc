"""Choice between the fused kernel, on the GPU or the CPU, and the torch engine; batches of rollouts."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..optimization.forward_mode import parts_of
from ..runtime.kernel_build import compiler
from .chains.chain import Joint
from .chains.joint_command import JointCommand
from .contact_detection import pairs_of, slot_count
from .fused import simulate_fused, unsupported
from .fused.host import lacking, simulate_on_host
from .kinematic import Drive
from .paper_law import PaperLaw
from .rollout import Rollout, simulate
from .state import State
from .world import World

if TYPE_CHECKING:
    from ...datasets.capture.tracks import Track

CPU_CONTACTS, CPU_ROLLOUTS, GPU_ROLLOUTS = 32_000, (160, 2048), 8192
"""Batch sizes: possible contacts on the CPU, minimum and maximum rollouts on the CPU, rollouts on a GPU."""
LEAST_SAVED, LEAST_SHARE = 6000, 0.1
"""Minimum number of frames that a further group saves, absolute and as a share of all: a rollout takes milliseconds to
prepare, as long as some thousand frames of the kernel and of their residuals."""
_MOTION = ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")


def rollout(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive | JointCommand] | None = None,
    record_contacts: bool = False,
    bodies: tuple[int, ...] | None = None,
) -> Rollout:
    """Simulate a world, in the fused kernel where that supports it: on CUDA, or on a CPU with a C++ compiler.

    Otherwise the torch engine runs, and the log gives each reason once, except on a CPU without a compiler. A world
    whose `rolls_on` is another device is copied there if the kernel supports it, and the rollout is copied back.

    Args:
        world: The world; see :func:`simulate` for the other arguments.
        state: The state at the first time.
        times_s: Frame times [s].
        driven: The commands.
        record_contacts: Whether to keep the contacts of every frame.
        bodies: Bodies of which the motion is wanted, in this order; None for all. Only they are copied back.

    Raises:
        InputDataError, UsageError: See :func:`simulate`.
    """
    home = world.gravity.device
    if world.rolls_on not in (None, home.type) and home.type == "cpu":
        reason = unsupported(world) or lacking_derivatives(world, state, times_s, driven or {}, record_contacts)
        if reason is None:
            return simulate_fused(world, state, times_s, driven, record_contacts, bodies=bodies)
        _note(reason)
    run, against = (simulate_fused, unsupported) if home.type == "cuda" else (simulate_on_host, lacking)
    reason = against(world) or lacking_derivatives(world, state, times_s, driven or {}, record_contacts)
    if reason is None:
        return _of_bodies(run(world, state, times_s, driven, record_contacts), bodies)
    if home.type == "cuda" or compiler() is not None:
        _note(reason)
    return _of_bodies(simulate(world, state, times_s, driven, record_contacts), bodies)


def _of_bodies(motion: Rollout, bodies: tuple[int, ...] | None) -> Rollout:
    """Return the motion of some bodies; None for all."""
    if bodies is None:
        return motion
    rows = torch.tensor(bodies, dtype=torch.long, device=motion.position_m.device)
    return replace(motion, **{name: getattr(motion, name).index_select(2, rows) for name in _MOTION})


def rollouts_at_once(world: World) -> int:
    """Return the number of rollouts per call; more exceed the processor's cache, or the memory of the GPU."""
    if "cuda" in (world.rolls_on, world.gravity.device.type):
        return GPU_ROLLOUTS
    contacts = sum(slot_count(world, pair) for pair in pairs_of(world))
    return min(max(CPU_CONTACTS // max(contacts, 1), CPU_ROLLOUTS[0]), CPU_ROLLOUTS[1])


def length_groups(lengths: Sequence[int], repeats: int = 1) -> list[tuple[list[int], int]]:
    """Return the items of each group, in their order, and the length of its longest item.

    Args:
        lengths: Number of frames of each item (B,).
        repeats: How often each item is simulated.
    """
    return _split(sorted(range(len(lengths)), key=lambda item: lengths[item]), lengths, repeats)


def _split(items: list[int], lengths: Sequence[int], repeats: int) -> list[tuple[list[int], int]]:
    """Return groups of items that are sorted by length."""
    longest = lengths[items[-1]]
    saved = [(longest - lengths[items[k - 1]]) * k for k in range(1, len(items))]
    best = max(saved, default=0)
    if repeats * best < LEAST_SAVED or best < LEAST_SHARE * longest * len(items):
        return [(sorted(items), longest)]
    place = saved.index(best) + 1
    return [*_split(items[:place], lengths, repeats), *_split(items[place:], lengths, repeats)]


def ragged_rollout(
    times_s: Tensor, lengths: Sequence[int], repeats: int, roll: Callable[[list[int], int], Rollout]
) -> Rollout:
    """Return the rollout of a batch whose items are simulated only up to their last frame, which they then keep.

    Args:
        times_s: Frame times, shape (repeats * B, T) [s].
        lengths: Number of frames of each item (B,).
        repeats: How often each item is in the batch, the whole items one after another.
        roll: Simulates some items, each `repeats` times, for a number of frames.
    """
    groups = length_groups(lengths, repeats)
    if len(groups) == 1:
        return roll(list(range(len(lengths))), times_s.shape[-1])
    parts = [roll(items, frames) for items, frames in groups]
    back = torch.cat([torch.tensor(items) for items, _ in groups]).argsort()

    def joined(name: str) -> Tensor:
        padded = []
        for part in parts:
            values = getattr(part, name)
            kept = values[:, -1:].expand(-1, times_s.shape[-1] - values.shape[1], -1, -1)
            padded.append(torch.cat([values, kept], 1).unflatten(0, (repeats, -1)))
        return torch.cat(padded, 1)[:, back].flatten(0, 1)

    position, quat, velocity, omega = (joined(name) for name in _MOTION)
    return Rollout(times_s=times_s, position_m=position, quat_wxyz=quat, velocity_m_s=velocity, omega_body_rad_s=omega)


def lacking_derivatives(
    world: World,
    state: State,
    times_s: Tensor,
    driven: Mapping[str, Track | Drive | JointCommand],
    record_contacts: bool,
) -> str | None:
    """Return the requested derivatives or labels that the kernel does not support, in words; None for none."""
    if not torch.is_grad_enabled() and not record_contacts:
        return None
    if record_contacts and isinstance(world.contact, PaperLaw):
        return f"the contact record of the law '{world.contact.name}' is asked for"
    tensors = list(_tensors(world, state, times_s, driven))
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return "derivatives in reverse are asked for"
    if record_contacts and any(parts_of(tensor)[1] is not None for tensor in tensors):
        return "derivatives of the contact record are asked for"
    return None


def _tensors(
    world: World, state: State, times_s: Tensor, driven: Mapping[str, Track | Drive | JointCommand]
) -> Iterator[Tensor]:
    """Yield all tensors of a rollout's arguments."""
    drives = [command for command in driven.values() if isinstance(command, Drive)]
    for holder in (world, *world.laws, state, *world.bodies, *world.surfaces, *drives):
        yield from (value for value in vars(holder).values() if isinstance(value, Tensor) and value.is_floating_point())
    for active in world.effects:
        yield from active.values.values()
    for holder in (*(joint for chain in world.chains for joint in chain.joints), *driven.values()):
        if isinstance(holder, (Joint, JointCommand)):
            yield from (value for value in vars(holder).values() if isinstance(value, Tensor))
    yield times_s


@cache
def _note(reason: str) -> None:
    logging.getLogger("cgwm").info("rollouts run in the torch engine, not in the fused kernel: %s", reason)
