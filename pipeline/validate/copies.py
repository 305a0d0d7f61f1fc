"""Checks of what a rollout states twice: robomimic's arrays and the attributes against the labels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from ...datasets.models.mjcf import mujoco_states, state_order
from ...datasets.rollouts.array_table import ARRAYS
from .faults import Fault
from .rollout import Rollout, own_member, shown

TIME_TOLERANCE = 1e-6
"""Largest difference of a frame's time from a multiple of the frame interval, as a fraction of the interval."""


def check_time(rollout: Rollout) -> Iterator[Fault]:
    """Check that times begin at 0, increase, and follow the frame rate of the settings."""
    time, rate_hz = rollout.values["time"], rollout.dataset.rate_hz
    rising = np.diff(time) > 0
    if not rising.all():
        frame = int(np.argmin(rising)) + 1
        yield Fault(check="time", text=f"time: not increasing at frame {frame}.", frame=frame, value=float(time[frame]))
        return
    if rate_hz is None:
        return
    off = np.abs(time * rate_hz - np.arange(len(time)))
    if not off.max() <= TIME_TOLERANCE * max(1, len(time)):
        frame = int(np.argmax(off))
        wanted = frame / rate_hz
        text = f"time: frame {frame}: {time[frame]:.6g} s; {wanted:.6g} s at the {rate_hz:g} frames/s of dataset.json."
        yield Fault(check="time", text=text, frame=frame, value=float(time[frame]), limit=wanted)


def check_copies(rollout: Rollout) -> Iterator[Fault]:
    """Compare `states`, `obs/object`, `actions`, `dones` and `parameters/` with what they repeat."""
    values, bodies = rollout.values, rollout.part("bodies")
    kinds, time = bodies["motions"].tolist(), values["time"]
    pose = np.concatenate([bodies["pos"], bodies["quat_wxyz"]], axis=-1)
    speed = np.concatenate([bodies["vel"], bodies["omega_body"]], axis=-1)
    count = len(time)
    dones = np.zeros(count)
    dones[-1] = 1
    states, also = _states(rollout, kinds), " and joints'" if b"link" in kinds else ""
    copies = [
        *([] if states is None else [("states", states, f"the times and the free bodies'{also}")]),
        ("obs/object", np.concatenate([pose, speed], axis=-1).reshape(count, -1), "the bodies'"),
    ]
    for name, wanted, whose in copies:
        yield from _difference(name, values[name], wanted, f"differs from {whose} poses and velocities")
    yield from _difference("dones", values["dones"], dones, "is not 1 at the last frame alone")
    if b"driven" not in kinds:
        still = np.zeros_like(values["actions"])
        yield from _difference("actions", values["actions"], still, "is not 0, although no body is driven")
    for name, (value, unit) in rollout.attributes.parameters.items():
        found = float(values[f"parameters/{name}"])
        if not found == value:
            text = f"parameters/{shown(name)}: {found:g} {shown(unit)}; params_json says {value:g}."
            yield Fault(check="schema", text=text, value=found, limit=value)
    yield from _model_faults(rollout, kinds)


def _states(rollout: Rollout, kinds: list[bytes]) -> np.ndarray | None:
    """Return what `states` repeats; None for jointed bodies whose model cannot be read."""
    values, model = rollout.values, rollout.dataset.model
    poses = tuple(values[f"bodies/{name}"] for name in ("pos", "quat_wxyz", "vel", "omega_body"))
    if b"link" not in kinds:
        free, count = [index for index, kind in enumerate(kinds) if kind == b"free"], len(values["time"])
        parts = (np.concatenate([poses[k], poses[k + 1]], -1)[:, free].reshape(count, -1) for k in (0, 2))
        return np.concatenate([values["time"][:, None], *parts], axis=1)
    if model is None or tuple(body.name for body in model.file.bodies) != rollout.bodies:
        return None
    names = [name.decode("utf-8", "replace") for name in values["joints/names"].tolist()]
    if set(names) != {name for kind, name in state_order(model.file) if kind == "joint"}:
        return None  # said by the check of joints
    pairs = {name: (values["joints/pos"][:, k], values["joints/vel"][:, k]) for k, name in enumerate(names)}
    return mujoco_states(model.file, values["time"], poses, pairs)


def _difference(name: str, found: np.ndarray, wanted: np.ndarray, what: str) -> Iterator[Fault]:
    equal = np.isclose(found, wanted, rtol=0, atol=0, equal_nan=True).reshape(len(found), -1).all(1)
    if not equal.all():
        frame = int(np.argmin(equal))
        yield Fault(check="schema", text=f"{name}: frame {frame}: {what}.", frame=frame)


def _model_faults(rollout: Rollout, kinds: list[bytes]) -> Iterator[Fault]:
    """Compare how bodies move, and the units of parameters, with the dataset's model."""
    model = rollout.dataset.model
    if model is None:
        return
    listed = {body.name: body.motion for body in model.file.bodies}
    for name, kind in zip(rollout.bodies, kinds, strict=True):
        if listed.get(name) != kind.decode("utf-8", "replace"):
            text = f"bodies/motions: '{shown(name)}' is {shown(kind.decode('utf-8', 'replace'))}; "
            text += f"in the dataset's model it is {listed.get(name, 'missing')}."
            yield Fault(check="schema", text=text, body=name)
    units = {entry.name: entry.unit for entry in model.file.parameters}
    for name, (_, unit) in rollout.attributes.parameters.items():
        if units.get(name, unit) != unit:
            text = f"parameters/{shown(name)}: its unit is '{shown(unit)}'; in the dataset's model '{units[name]}'."
            yield Fault(check="schema", text=text)


def check_next_observations(rollout: Rollout) -> Iterator[Fault]:
    """Check that `next_obs` is `obs` one frame later, the last frame repeated.

    As cgwm writes it, each of its arrays is a view of `obs`, which is compared; others are read whole.
    """
    later = own_member(rollout.group, "next_obs", h5py.Group)
    for template in (entry.last_name for entry in ARRAYS.values() if entry.group == "obs"):
        for camera in rollout.cameras if "{camera}" in template else ("",):
            name = template.format(camera=camera)
            source = rollout.group[f"obs/{name}"]
            item = None if later is None else own_member(later, name, h5py.Dataset)
            same = item is not None and (item.shape, item.dtype) == (source.shape, source.dtype)
            if not (same and (_is_shifted_view(item, source) or _is_shifted_copy(item, source))):
                yield Fault(check="schema", text=f"next_obs/{name}: is not obs/{name} one frame later.")


def _is_shifted_view(item: Any, source: Any) -> bool:
    if not item.is_virtual:
        return False
    count, seen = len(source), {}
    for view in item.virtual_sources():
        if view.file_name != "." or view.dset_name != source.name:
            return False
        target, place = (space.get_regular_hyperslab() for space in (view.vspace, view.src_space))
        if target[2:] != place[2:] or any(target[0][1:]) or any(place[0][1:]):
            return False
        start, _, rows, block = (part[0] for part in target)
        whole = all(a * b == size for a, b, size in zip(target[2][1:], target[3][1:], source.shape[1:], strict=True))
        if not whole:
            return False
        seen |= {start + row: place[0][0] + row for row in range(rows * block)}
    return seen == {frame: min(frame + 1, count - 1) for frame in range(count)}


def _is_shifted_copy(item: Any, source: Any) -> bool:
    if item.is_virtual or item.external:
        return False
    step = item.chunks[0] if item.chunks else len(item)
    for first in range(0, len(item), step):
        last = min(first + step, len(item))
        following = source[first + 1 : last + 1]
        if last == len(item):
            following = np.concatenate([following, source[-1:]])
        if not np.array_equal(item[first:last], following):
            return False
    return True
