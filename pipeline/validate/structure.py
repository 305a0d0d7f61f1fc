"""Checks of a rollout that need no pictures and no physics: `validate` and every export of a dataset run the same."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from ...datasets.capture.camera_faults import intrinsics_fault, pose_fault
from ...datasets.rollouts.array_table import JPEG
from ...datasets.rollouts.chunks import jpeg_size
from ...datasets.rollouts.rollouts import CONVENTION, DEMO, Node
from .arrays import check_arrays
from .copies import check_copies, check_next_observations, check_time
from .faults import Fault
from .rollout import (
    Dataset,
    Rollout,
    integer_attribute,
    name_fault,
    own_member,
    parsed_object,
    read_attributes,
    shown,
)

EXCLUSIVE = ("train", "valid")
"""Splits that share no rollout; others, robomimic's filter keys, may."""


def check_structure(group: Node, name: str, dataset: Dataset, whole: bool = True) -> tuple[Rollout | None, list[Fault]]:
    """Compare a rollout with the documentation of its arrays, with its dataset and with itself.

    Args:
        group: Its group.
        name: Its name, ``demo_<i>``.
        dataset: The dataset that contains it.
        whole: Also read all depth images and masks, and `next_obs`; an export does neither.

    Returns:
        The rollout, or None if it cannot be checked further, and all faults.
    """
    try:
        attributes, faults = read_attributes(group, name, dataset)
        if attributes is None:
            return None, faults
        rollout, more = check_arrays(group, attributes, dataset, pictures=whole)
        if rollout is None:
            return None, faults + more
        found = [*faults, *more, *check_time(rollout), *check_copies(rollout), *_check_offsets(rollout)]
        found += [*_check_inertia(rollout), *_check_cameras(rollout)]
        if whole:
            found += check_next_observations(rollout)
    except OSError as error:
        return None, [Fault(check="readable", text=f"a block cannot be read: {str(error).splitlines()[0]}.")]
    except (KeyError, RuntimeError) as error:  # of HDF5, where the structure itself is damaged
        return None, [Fault(check="readable", text=f"an array or attribute cannot be read: {_reason(error)}.")]
    return rollout, found


def _reason(error: Exception) -> str:
    return shown(str(error.args[0]).splitlines()[0]) if error.args else type(error).__name__


def has_usable_contacts(rollout: Rollout) -> bool:
    """Return whether each contact belongs to a frame, and to bodies that exist."""
    table, count = rollout.part("contacts"), len(rollout.bodies)
    a, b = table["body_a"], table["body_b"]
    return _divides(rollout) and not ((a < 0) | (a >= count) | (b >= count)).any()


def _divides(rollout: Rollout) -> bool:
    offsets, rows = rollout.values["contacts/offsets"], len(rollout.values["contacts/body_a"])
    return bool(offsets[0] == 0 and offsets[-1] == rows and (np.diff(offsets) >= 0).all())


def _check_offsets(rollout: Rollout) -> Iterator[Fault]:
    """Check that the rows of contacts are divided among the frames."""
    if not _divides(rollout):
        rows = len(rollout.values["contacts/body_a"])
        text = f"contacts/offsets: they do not divide {rows} contacts among {rollout.attributes.frames} frames."
        yield Fault(check="contacts", text=text)


def _check_inertia(rollout: Rollout) -> Iterator[Fault]:
    """Check that free bodies have mass, and positive principal moments."""
    bodies = rollout.part("bodies")
    for index, name in enumerate(rollout.bodies):
        if bodies["motions"][index] != b"free":
            continue
        xx, yy, zz, xy, xz, yz = numbers = bodies["inertia"][index]
        if not bodies["mass"][index] > 0:
            text = f"bodies/mass: '{name}' has {bodies['mass'][index]:g} kg; free bodies have more than 0."
            yield Fault(check="values", text=text, body=name, value=float(bodies["mass"][index]), limit=0.0)
        if np.isfinite(numbers).all():
            least = float(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0])
            if not least > 0:
                text = f"bodies/inertia: '{name}' has a principal moment of {least:.3g} kg m2; they are positive."
                yield Fault(check="values", text=text, body=name, value=least, limit=0.0)


def _check_cameras(rollout: Rollout) -> Iterator[Fault]:
    """Check poses and intrinsics of the cameras, and the size of JPEG images."""
    for name in rollout.cameras:
        camera = rollout.camera(name)
        fault = intrinsics_fault(camera.K, camera.distortion, camera.width, camera.height)
        for text in (fault, pose_fault(camera.T_world_cam)):
            if text is not None:
                yield Fault(check="cameras", text=f"cameras/{name}: {text}.", camera=name)
        images: Any = rollout.group[JPEG.name.format(camera=name)]
        if images.attrs.get("encoding") == "jpeg":
            yield from _check_jpeg(images, name, (camera.height, camera.width))


def _check_jpeg(images: Any, name: str, size: tuple[int, int]) -> Iterator[Fault]:
    """Check that JPEG images have the size of their camera: in the attributes, and in each file's header."""
    listed = tuple(integer_attribute(images, key) for key in ("height", "width"))
    if listed != size:
        text = f"obs/{name}_image: its attributes height and width are {listed}; the camera has {size}."
        yield Fault(check="shape", text=text, camera=name)
    for frame, row in enumerate(images):
        found = jpeg_size(row)
        if found != size:
            what = "is no JPEG" if found is None else f"{found[1]} x {found[0]} px"
            text = f"obs/{name}_image: frame {frame}: {what}; the camera has {size[1]} x {size[0]}."
            yield Fault(check="shape", text=text, frame=frame, camera=name)
            return


def listing_fault(file: Node) -> str | None:
    """Return why the rollouts of a shard or index cannot be listed, as a sentence without its name, or None."""
    try:
        return next(_listing_faults(file), None)
    except (OSError, KeyError, RuntimeError) as error:
        return f"an array or attribute cannot be read: {_reason(error)}."


def _listing_faults(file: Node) -> Iterator[str]:
    data = own_member(file, "data", h5py.Group)
    if data is None:
        yield "it has no group 'data' of its own."
        return
    for name in data:
        group = own_member(data, name, h5py.Group)
        if group is None or not DEMO.fullmatch(name):
            yield f"data/{shown(name)} is no rollout; these are groups called demo_<index>."
            return
        for key in ("num_samples", "episode_index"):
            if integer_attribute(group, key) is None:
                yield f"data/{name}: the attribute {key} is missing or no whole number."


def check_file(file: Node) -> list[str]:
    """Return what is wrong with a shard or index whose rollouts can be listed, as sentences without its name."""
    try:
        return list(_file_faults(file))
    except (OSError, KeyError, RuntimeError) as error:
        return [f"an array or attribute cannot be read: {_reason(error)}."]


def _file_faults(file: Node) -> Iterator[str]:
    data = file["data"]
    total = sum(integer_attribute(data[name], "num_samples") or 0 for name in data)
    if integer_attribute(data, "total") != total:
        yield f"data/@total is {shown(str(data.attrs.get('total')))}; the demos sum up to {total}."
    env = data.attrs.get("env_args")
    if not isinstance(env, str) or not {"env_name", "type", "env_kwargs"} <= (parsed_object(env) or {}).keys():
        yield "data/@env_args is no JSON object with env_name, type and env_kwargs, which robomimic reads."
    if file.attrs.get("convention") != CONVENTION:
        yield f"@convention is '{shown(str(file.attrs.get('convention')))}'; '{shown(CONVENTION)}' is documented."
    yield from _split_faults(file, set(data))


def _split_faults(file: Node, demos: set[str]) -> Iterator[str]:
    """Check that splits are lists of different rollouts of this file, and that no rollout is in `train` and `valid`."""
    group = own_member(file, "mask", h5py.Group)
    if group is None:
        yield "it has no group 'mask' of its own, with the splits."
        return
    members: dict[str, set[str]] = {}
    for split in group:
        fault = name_fault(split)
        if fault is not None:
            yield f"mask: the name '{shown(split)}' {fault}."
            continue
        item = own_member(group, split, h5py.Dataset)
        if item is None or not _may_list(item, len(demos)):
            yield f"mask/{split}: is no list of the file's {len(demos)} rollouts."
            continue
        names = _texts(item)
        unknown = [name for name in names if name not in demos]
        if unknown:
            yield f"mask/{split} names '{shown(unknown[0])}', which is no rollout of this file."
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            yield f"mask/{split} names '{shown(twice[0])}' twice."
        members[split] = set(names)
    shared = sorted(set.intersection(*(members.get(split, set()) for split in EXCLUSIVE)), key=len)
    if shared:
        yield f"mask: '{shown(shared[0])}' is in {' and in '.join(EXCLUSIVE)}."


def _may_list(item: h5py.Dataset, demos: int) -> bool:
    """Return whether an array can be a list of a file's rollouts, by its type and size."""
    return item.ndim == 1 and item.dtype.kind in "SO" and len(item) <= 10 * demos + 10


def _texts(item: h5py.Dataset) -> list[str]:
    return [name.decode("utf-8", "backslashreplace") if isinstance(name, bytes) else str(name) for name in item]
