"""Checks that are generated from the documentation of the arrays: presence, type, shape, attributes and values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np

from ...datasets.rollouts.array_entry import ATTRIBUTES, ArrayEntry, value_of
from ...datasets.rollouts.array_table import ARRAYS, JPEG, turning
from ...datasets.rollouts.rollouts import SHARDS, Node
from .faults import Fault
from .rollout import Attributes, Dataset, Rollout, name_fault, shown

NORM_TOLERANCE = 1e-6
"""Largest difference of the norm of a quaternion or normal from 1."""
BOUND_TOLERANCE = 1e-9
"""Distance by which rounding may put a floating-point number outside of its bounds."""
MOST_NAME_BYTES = 1 << 20
"""Largest list of names of bodies that is read [bytes]."""
DEPTH = 3
"""Number of groups on the way to the deepest documented array, itself included."""


@dataclass
class _Found:
    """What a rollout contains."""

    arrays: dict[str, h5py.Dataset] = field(default_factory=dict)
    """Its arrays by name, without `next_obs`."""
    groups: set[str] = field(default_factory=set)
    """Its groups by name."""
    faults: list[Fault] = field(default_factory=list)
    """What cannot be used."""


@dataclass(frozen=True, kw_only=True)
class _Expected:
    """An array that a rollout has to contain."""

    entry: ArrayEntry
    """Its documentation."""
    words: Mapping[str, str]
    """Known words of its name and description."""

    @property
    def name(self) -> str:
        """Its name."""
        return self.entry.name.format_map(self.words)

    @property
    def is_picture(self) -> bool:
        """Whether it has an image for each frame, which is read in blocks."""
        return self.entry.name.startswith("obs/{camera}")


def check_arrays(
    group: Node, attributes: Attributes, dataset: Dataset, pictures: bool = True
) -> tuple[Rollout | None, list[Fault]]:
    """Compare the arrays of a rollout with their documentation, and return them with all faults.

    Args:
        group: The rollout's group.
        attributes: Its attributes.
        dataset: The dataset that contains it.
        pictures: Whether to check the values of images, for which all of them are read.

    Returns:
        The rollout, or None if its arrays cannot be used, and the faults.
    """
    found = _Found()
    _collect(group, "", found, SHARDS in group.file)
    faults = found.faults
    names, cameras = _names(found, dataset, faults)
    expected = {array.name: array for array in _expected(found, attributes, cameras)}
    values: dict[str, np.ndarray] = {}
    symbols = _symbols(found, attributes, dataset, names, cameras)
    wrong = [fault for array in expected.values() for fault in _shape_faults(array, found, symbols)]
    wrong += _size_faults(found, dataset, cameras, symbols)
    if wrong or faults:
        return None, faults + wrong
    for array in expected.values():
        faults += _attribute_faults(array, found.arrays[array.name])
        if not array.is_picture:
            values[array.name] = np.asarray(found.arrays[array.name][()])
    symbols["N"] = len(values["contacts/body_a"])
    for array in expected.values():
        item = found.arrays[array.name]
        if not array.is_picture:
            faults += _value_faults(array, values[array.name], symbols, values["contacts/offsets"])
        elif pictures and (array.entry.low or item.dtype.kind == "f"):
            faults += _picture_faults(array, item, symbols)
    unlisted = sorted(set(found.arrays) - set(expected))
    faults += [
        _schema(f"{shown(name)}: is not among the parameters of params_json.")
        for name in unlisted
        if name.startswith("parameters/")
    ]
    rollout = Rollout(
        group=group,
        dataset=dataset,
        attributes=attributes,
        bodies=tuple(names),
        cameras=tuple(cameras),
        values=values,
        undocumented=tuple(map(shown, unlisted)),
    )
    return rollout, faults


def _schema(text: str) -> Fault:
    return Fault(check="schema", text=text)


def _collect(group: Node, prefix: str, found: _Found, index: bool) -> None:
    """Collect the arrays of a group, following neither links nor, except in an index, virtual arrays."""
    for name in group:
        path = f"{prefix}{name}"
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            found.faults.append(_schema(f"{shown(path)}: is a link; a shard contains its arrays itself."))
            continue
        item = group[name]
        if isinstance(item, h5py.Group) and path != "next_obs":
            found.groups.add(path)
            if path.count("/") + 1 < DEPTH:
                _collect(item, f"{path}/", found, index)
        elif isinstance(item, h5py.Dataset):
            if item.external or (item.is_virtual and not index):
                found.faults.append(_schema(f"{shown(path)}: its numbers are in another file or array."))
            found.arrays[path] = item


def _names(found: _Found, dataset: Dataset, faults: list[Fault]) -> tuple[list[str], list[str]]:
    """Return the names of bodies and cameras, and add what is wrong with them to the faults."""
    item, names = found.arrays.get("bodies/names"), list(dataset.manifest.bodies)
    if item is not None and item.dtype.kind == "S" and item.ndim == 1 and item.nbytes <= MOST_NAME_BYTES:
        read = [name.decode("utf-8", "backslashreplace") for name in item[()]]
        if names and read != names:
            text = f"bodies/names: {', '.join(map(shown, read))}; dataset.json has {', '.join(map(shown, names))}."
            faults.append(_schema(text))
        names = read
    cameras = sorted(path.removeprefix("cameras/") for path in found.groups if path.startswith("cameras/"))
    listed = sorted(dataset.manifest.cameras)
    if cameras != listed:
        text = f"cameras: {', '.join(map(shown, cameras)) or 'none'}; dataset.json has "
        faults.append(_schema(f"{text}{', '.join(map(shown, listed)) or 'none'}."))
    faults += [*_name_faults("bodies/names", names), *_name_faults("cameras", cameras)]
    return names, cameras


def _name_faults(place: str, names: list[str]) -> Iterator[Fault]:
    for name in names:
        fault = name_fault(name) or ("is there twice" if names.count(name) > 1 else None)
        if fault:
            yield _schema(f"{place}: the name '{shown(name)}' {fault}.")


def _expected(found: _Found, attributes: Attributes, cameras: list[str]) -> Iterator[_Expected]:
    """Yield the arrays that a rollout with these attributes and cameras has to contain."""
    light = {"light/lamp", "light/sky"} & found.arrays.keys()
    for name, entry in ARRAYS.items():
        if entry.presence == "optional" and not (name in found.arrays or (light and name.startswith("light/"))):
            continue
        if entry.presence == "joints" and not (b"link" in _motions(found) or "joints" in found.groups):
            continue
        if "{parameter}" in name:
            for parameter, (_, unit) in attributes.parameters.items():
                yield _Expected(entry=entry, words={"parameter": parameter, "unit": unit})
        elif "{camera}" in name:
            for camera in cameras:
                item = found.arrays.get(name.format(camera=camera))
                encoded = name == JPEG.name and item is not None and item.attrs.get("encoding") == "jpeg"
                yield _Expected(entry=JPEG if encoded else entry, words={"camera": camera})
        elif cameras or entry.presence != "cameras":
            yield _Expected(entry=entry, words={"turning": turning(attributes.effects)})


def _motions(found: _Found) -> list[bytes]:
    """Return how the bodies move, as far as it can be read."""
    item = found.arrays.get("bodies/motions")
    if item is None or item.dtype.kind != "S" or item.ndim != 1 or item.nbytes > MOST_NAME_BYTES:
        return []
    return item[()].tolist()


def _symbols(
    found: _Found, attributes: Attributes, dataset: Dataset, names: list[str], cameras: list[str]
) -> dict[str, int]:
    """Return the values of the letters in shapes and bounds that are known."""
    symbols = {"T": attributes.frames, "B": len(names), "body": len(names)}
    symbols |= {"C": len(cameras), "camera": len(cameras)}
    rows, joints, kinds = found.arrays.get("contacts/body_a"), found.arrays.get("joints/names"), _motions(found)
    count = len(joints) if joints is not None and joints.ndim == 1 else 0
    if len(kinds) == len(names):
        symbols |= {"J": count, "A": max(1, 3 * kinds.count(b"driven"))}
        roots = [] if dataset.model is None else [one.base for one in dataset.model.file.articulations]
        if b"link" not in kinds or roots:
            symbols["D"] = 1 + 13 * (kinds.count(b"free") + roots.count("free")) + 2 * count
    if rows is not None and rows.ndim == 1:
        symbols["N"] = len(rows)
    for camera in cameras:
        for letter, key in (("H", "height"), ("W", "width")):
            item = found.arrays.get(f"cameras/{camera}/{key}")
            if item is not None and item.shape == () and item.dtype.kind == "i":
                symbols[f"{letter} {camera}"] = int(item[()])
    return symbols


def _size_faults(found: _Found, dataset: Dataset, cameras: list[str], symbols: dict[str, int]) -> Iterator[Fault]:
    """Compare the sizes of the cameras with the settings."""
    for camera in cameras:
        for letter, key in (("H", "height"), ("W", "width")):
            value, wanted = symbols.get(f"{letter} {camera}"), dataset.manifest.config.get(key)
            if isinstance(wanted, int) and value is not None and value != wanted:
                yield _schema(f"cameras/{shown(camera)}/{key}: {value} px; the settings in dataset.json say {wanted}.")


def _shape_faults(array: _Expected, found: _Found, symbols: dict[str, int]) -> Iterator[Fault]:
    """Check that an array is there with its type and shape, and that its numbers are in the file."""
    entry, name, item = array.entry, shown(array.name), found.arrays.get(array.name)
    if item is None:
        yield _schema(f"{name}: this array is missing.")
        return
    kinds = entry.dtype.split()
    if not _is_of(item.dtype, kinds):
        yield _schema(f"{name}: its type is {item.dtype}; {' or '.join(kinds)} is documented.")
        return
    camera = array.words.get("camera", "")
    own = {letter: symbols[f"{letter} {camera}"] for letter in "HW" if f"{letter} {camera}" in symbols}
    wanted = [value_of(term, {**symbols, **own}) for term in entry.shape]
    if len(item.shape) != len(wanted) or any(w not in (None, size) for size, w in zip(item.shape, wanted, strict=True)):
        sizes = ", ".join("any" if size is None else str(size) for size in wanted)
        yield _schema(f"{name}: its shape is {item.shape}; {entry.axes} is documented, here ({sizes}).")
        return
    if not item.is_virtual and _stored_share(item) < 1:
        yield Fault(check="readable", text=f"{name}: not all of its numbers are in the file.")


def _is_of(dtype: np.dtype, kinds: list[str]) -> bool:
    """Return whether a type is among kinds such as `f4`, or `S` for texts of any length."""
    sized = kinds == ["S"] or f"{dtype.kind}{dtype.itemsize}" in kinds
    return sized and dtype.kind in {kind[0] for kind in kinds}


def _stored_share(item: Any) -> float:
    """Return the fraction of an array's blocks that the file contains; for others HDF5 would read zeros."""
    if not item.size:
        return 1.0
    if item.chunks is None:
        return item.id.get_storage_size() / item.nbytes
    blocks = int(np.prod([-(-size // chunk) for size, chunk in zip(item.shape, item.chunks, strict=True)]))
    return item.id.get_num_chunks() / blocks


def _attribute_faults(array: _Expected, item: Node) -> Iterator[Fault]:
    """Compare the attributes of an array with its documentation."""
    name, found = shown(array.name), dict(item.attrs)
    lacking = [key for key in ATTRIBUTES if key not in found]
    if lacking:
        yield _schema(f"{name}: has no attribute {', '.join(lacking)}.")
    for key, wanted in array.entry.known_texts(array.words).items():
        if key in found and found[key] != wanted:
            yield _schema(f"{name}: its {key} is '{shown(str(found[key]))}'; '{shown(wanted)}' is documented.")


def _value_faults(
    array: _Expected, values: np.ndarray, symbols: Mapping[str, int], offsets: np.ndarray, first: int = 0
) -> Iterator[Fault]:
    """Check that numbers are finite, within their bounds and of length 1, and that texts are among the allowed ones.

    Args:
        array: The array.
        values: Its values, or a block of them.
        symbols: Values of the letters in its bounds.
        offsets: Rows of each frame in arrays of contacts.
        first: First frame of the block.
    """
    entry, name = array.entry, shown(array.name)
    yield from _word_faults(array, values)
    if values.dtype.kind == "S" or not values.size:
        return

    def fault(check: str, at: np.ndarray, text: str, value: float | None, limit: float | None) -> Fault:
        row = int(np.argwhere(at)[0][0]) if at.ndim else 0
        frame = None
        if entry.shape[:1] == ("T",):
            frame = first + row
        elif entry.shape[:1] == ("N",):
            frame = int(np.searchsorted(offsets, row, side="right")) - 1
        place = "" if frame is None else f"frame {frame}: "
        return Fault(check=check, text=f"{name}: {place}{text}", frame=frame, value=value, limit=limit)

    if values.dtype.kind == "f" and not (finite := np.isfinite(values)).all():
        yield fault("finite", ~finite, "contains numbers that are not finite.", None, None)
        return
    for outside, worst, limit, here in _outside(array, values, symbols):
        text = f"{worst:g} is not among what is documented, {entry.values_text}{here}."
        yield fault("values", outside, text, worst, limit)
    if entry.unit_norm:
        errors = np.abs(np.linalg.norm(values, axis=-1) - 1)
        if (long := errors > NORM_TOLERANCE).any():
            text = f"a norm differs from 1 by {errors.max():.2g}; {NORM_TOLERANCE:g} is allowed."
            yield fault("norms", long, text, float(errors.max()), NORM_TOLERANCE)


def _word_faults(array: _Expected, values: np.ndarray) -> Iterator[Fault]:
    """Check that texts are among the documented ones, where these are listed."""
    for word in values.tolist() if array.entry.words else ():
        text = word.decode("utf-8", "backslashreplace")
        if text not in array.entry.words:
            yield _schema(f"{shown(array.name)}: '{shown(text)}'; {', '.join(array.entry.words)} are documented.")


def _outside(
    array: _Expected, values: np.ndarray, symbols: Mapping[str, int]
) -> Iterator[tuple[np.ndarray, float, float, str]]:
    """Yield for each bound that is broken where it is, the worst value, the bound, and the bound in words."""
    slack = BOUND_TOLERANCE if values.dtype.kind == "f" else 0
    for term, sign in ((array.entry.low, -1), (array.entry.high, 1)):
        limit = value_of(term, symbols) if term else None
        if limit is None:
            continue
        outside = values > limit + slack if sign > 0 else values < limit - slack
        if outside.any():
            worst = float(values.max() if sign > 0 else values.min())
            yield outside, worst, float(limit), "" if term.lstrip("-").isdigit() else f", here at most {limit}"


def _picture_faults(array: _Expected, item: Any, symbols: Mapping[str, int]) -> Iterable[Fault]:
    """Check the values of images, block by block; return the faults of the first block that has any."""
    blocks = item.iter_chunks() if item.chunks else [(slice(0, len(item)),)]
    none = np.zeros(0, np.int64)
    for block in blocks:
        faults = list(_value_faults(array, item[block], symbols, none, block[0].start))
        if faults:
            return faults
    return []
