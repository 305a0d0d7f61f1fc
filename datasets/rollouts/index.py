"""Index of a dataset: all shards as one HDF5 file of virtual datasets, without copies.

The file has the structure of a shard, so that every reader of shards can read it. Paths are relative to it, and its
content does not depend on when or where it was made. HDF5 itself would read a missing shard as the fill value: NaN for
floating-point numbers, the largest value for integers. `open_shard` refuses such an index.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np

from ...schemas import DatasetManifest, ShardEntry
from ..io.atomic import sha256
from ..io.hdf5_files import hdf5_faults
from ..io.progress import progress
from .guarded_file import GuardedFile
from .rollouts import SHARDS, Node, demo_names, demo_of, open_shard

INDEX = "index.h5"


def write_index(path: Path, shards: Sequence[tuple[Path, str, ShardEntry]]) -> None:
    """Write the index of some shards.

    Args:
        path: The file to write; pass a temporary one.
        shards: For each shard its path, its path relative to the final index, and its entry.

    Raises:
        InputDataError: If a shard cannot be read.
        OSError: If the index cannot be written.
    """
    guarded = GuardedFile(path)
    try:
        with h5py.File(guarded, "w") as index:
            data = index.create_group("data")
            splits: dict[str, list[str]] = {}
            total = 0
            for file, name, _ in progress(shards, "shards", len(shards), "shard"):
                with open_shard(file) as opened, hdf5_faults(file):
                    shard: Node = opened
                    if not len(data):
                        _copy_attributes(shard, index)
                        _copy_attributes(shard["data"], data)
                    total += int(shard["data"].attrs["total"])
                    for split, members in shard["mask"].items():
                        splits.setdefault(split, []).extend(member.decode() for member in members[()])
                    for demo in demo_names(shard):
                        _mirror(demo_of(opened, demo), data.create_group(demo), name.encode())
                _check(guarded)
            data.attrs["total"] = total
            _write_splits(index.create_group("mask"), splits)
            _write_shards(index.create_group(SHARDS), [(name, entry) for _, name, entry in shards])
    finally:
        guarded.close()
        _check(guarded)


def index_fault(file: Path, manifest: DatasetManifest) -> str | None:
    """Return one sentence on how the index of a dataset differs from the manifest, or None if it agrees."""
    assert manifest.index is not None
    if not file.is_file():
        return f"{file.name}: listed in dataset.json, but no such file."
    if sha256(file) != manifest.index.sha256:
        return f"{file.name}: its sha256 differs from dataset.json; make it again with 'cgwm merge --overwrite'."
    with open_shard(file) as index, hdf5_faults(file):
        listed: Node = index[SHARDS]
        found = [value.decode() for value in listed["sha256"][()]]
    if found != [shard.sha256 for shard in manifest.shards]:
        return f"{file.name}: of other shards than those that are there; make it again with 'cgwm merge --overwrite'."
    return None


def _check(file: GuardedFile) -> None:
    if file.error is not None:
        raise file.error


def _mirror(source: Node, target: Node, file: bytes) -> None:
    """Copy groups and attributes of one group to another, and add its arrays as views of those in `file`."""
    _copy_attributes(source, target)
    for name, item in source.items():
        if isinstance(item, h5py.Group):
            _mirror(item, target.create_group(name), file)
        elif item.shape and item.size:
            _copy_attributes(item, _view(item, target, name, file))
        else:  # a number by itself, or nothing: there is nothing to look at
            source.copy(item, target, name)


def _view(source: Node, target: Node, name: str, file: bytes) -> h5py.Dataset:
    # By h5py's low level: its high level stamps virtual datasets with the time of their creation.
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    properties.set_layout(h5py.h5d.VIRTUAL)
    space = h5py.h5s.create_simple(source.shape)
    properties.set_virtual(space, file, source.name.encode(), space)
    lost = _lost(source.dtype)
    if lost is not None:
        properties.set_fill_value(lost)
    return h5py.Dataset(h5py.h5d.create(target.id, name.encode(), source.id.get_type(), space, properties))


def _lost(dtype: np.dtype) -> np.ndarray | None:
    """Return the fill value for a missing shard, which cannot be mistaken for a measurement."""
    if dtype.kind == "f":
        return np.array(np.nan, dtype)
    return np.array(np.iinfo(dtype).max, dtype) if dtype.kind in "iu" else None


def _copy_attributes(source: Node, target: Node) -> None:
    for name, value in source.attrs.items():
        target.attrs[name] = value


def _write_splits(group: Node, splits: Mapping[str, list[str]]) -> None:
    for split, names in splits.items():
        names.sort(key=lambda name: int(name.removeprefix("demo_")))
        _write_names(group, split, names)


def _write_shards(group: Node, shards: Sequence[tuple[str, ShardEntry]]) -> None:
    _write_names(group, "file", [name for name, _ in shards])
    _write_names(group, "sha256", [entry.sha256 for _, entry in shards])
    group.create_dataset("bytes", data=np.array([entry.bytes for _, entry in shards], np.int64))
    group.attrs["description"] = "The files that the arrays of this one look into, relative to it."


def _write_names(group: Node, name: str, values: list[str]) -> None:
    encoded = [value.encode() for value in values]
    width = max((len(value) for value in encoded), default=1)
    group.create_dataset(name, data=np.array(encoded, dtype=f"S{max(width, 1)}"))
