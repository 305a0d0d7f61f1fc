"""Fast creation of HDF5 arrays with descriptions: a rollout has about 70 arrays with five attributes each.

h5py's high level needs 18 ms for them, as long as a GPU needs to render the frames that they describe; its low level
needs 12 ms. So an array is made once, empty, with its attributes, in a file in memory, from which HDF5 copies it.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from functools import cache
from typing import Any

import h5py
import numpy as np
from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue]

from .array_entry import ATTRIBUTES, ArrayEntry
from .array_table import ARRAYS
from .rollouts import Node

MOST_PROTOTYPES = 2000
_NAMES = tuple(name.encode() for name in ATTRIBUTES)


def new_group(parent: Node, name: str) -> Node:
    """Make a group."""
    return h5py.Group(h5py.h5g.create(parent.id, name.encode()))


def put(group: Node, name: str, data: Any, in_chunks: bool = True, **words: str) -> Any:
    """Write an array with its description, in one chunk with a checksum or contiguously, and return its DatasetID.

    Args:
        group: The group that contains it.
        name: Its documented name, a key of :data:`array_table.ARRAYS`.
        data: Its numbers.
        in_chunks: Write one chunk with a checksum.
        words: The words in braces of its name and description.
    """
    return put_entry(group, ARRAYS[name], data, in_chunks, words)


def put_entry(group: Node, entry: ArrayEntry, data: Any, in_chunks: bool, words: Mapping[str, str]) -> Any:
    """Write an array as `put` does, by its documentation."""
    values = np.asarray(data)
    properties = checked(values.shape if in_chunks else ())
    name = entry.last_name.format_map(words)
    made = new_dataset(group, name, values.dtype, values.shape, properties, *entry.texts(words))
    if values.size:
        made.write(h5py.h5s.ALL, h5py.h5s.ALL, values if values.flags.c_contiguous else values.copy())
    return made


@cache
def checked(shape: tuple[int, ...]) -> Any:
    """Return the creation properties of an array in one chunk of that shape, with a checksum; for () without."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    if shape and all(shape):
        properties.set_chunk(shape)
        properties.set_fletcher32()
    return properties


def new_dataset(
    group: Node, name: str, dtype: np.dtype[Any], shape: tuple[int, ...], properties: Any, *texts: str
) -> Any:
    """Make an empty array with its description, and return its DatasetID.

    Args:
        group: Group of the array.
        name: Name of the array.
        dtype: Type of its numbers.
        shape: Shape of the array.
        properties: Creation properties; the same object for arrays of one kind.
        texts: Unit, frame, order, meaning of the shape, description.
    """
    return _prototypes().copy(group, name, dtype, shape, properties, texts)


def write_text(made: Any, name: bytes, text: str) -> None:
    """Write an attribute of a new object."""
    kind, space = _text_kind()
    h5py.h5a.create(made, name, kind, space).write(np.array(text, dtype=h5py.string_dtype()))


def write_number(made: Any, name: str, number: np.generic) -> None:
    """Write an attribute of a new object."""
    kind, (_, space) = h5py.h5t.py_create(number.dtype), _text_kind()
    h5py.h5a.create(made, name.encode(), kind, space).write(np.asarray(number))


@cache
def _text_kind() -> tuple[Any, Any]:
    return h5py.h5t.py_create(h5py.string_dtype(), logical=True), h5py.h5s.create(h5py.h5s.SCALAR)


class _Prototypes:
    """Empty arrays with their attributes, in memory."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start()

    def _start(self) -> None:
        self._file = h5py.File("prototypes", "w", driver="core", backing_store=False)
        self._made: dict[tuple[Any, ...], bytes] = {}

    def copy(
        self,
        group: Node,
        name: str,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
        properties: Any,
        texts: tuple[str, ...],
    ) -> Any:
        """Put a copy into a group, and return its DatasetID."""
        key = (dtype.str, shape, id(properties), texts)
        if texts[3].startswith("(N"):  # as many rows as there are contacts: seldom the same again
            return _make(group, name.encode(), dtype, shape, properties, texts)
        with self._lock:
            if key not in self._made:
                if len(self._made) >= MOST_PROTOTYPES:
                    self._file.close()
                    self._start()
                self._made[key] = str(len(self._made)).encode()
                _make(self._file, self._made[key], dtype, shape, properties, texts)
            h5o.copy(self._file.id, self._made[key], group.id, name.encode())
        return h5py.h5d.open(group.id, name.encode())


def _make(
    group: Node, name: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], properties: Any, texts: tuple[str, ...]
) -> Any:
    kind = h5py.h5t.py_create(dtype, logical=True)
    space = h5py.h5s.create_simple(shape) if shape else h5py.h5s.create(h5py.h5s.SCALAR)
    made = h5py.h5d.create(group.id, name, kind, space, properties)
    for attribute, text in zip(_NAMES, texts, strict=True):
        write_text(made, attribute, text)
    return made


@cache
def _prototypes() -> _Prototypes:
    return _Prototypes()
