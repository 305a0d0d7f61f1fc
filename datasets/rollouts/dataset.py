"""The directory of a dataset: its manifest, its shards, and a copy of the model that made it.

With one shard the directory appears complete. With several (`--shard I/N`, in any order and from any machine with
access to the directory) the first finished shard creates the directory, and each adds itself.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import Any

from ...schemas import DamagedShardError, DatasetManifest, InputDataError, ShardEntry, UsageError, read_json
from ...schemas.regular_files import real_path
from ..io.atomic import copy_files, move_into_place, new_directory, replaced_file, scratch_file, sha256
from ..io.free_space import enough_room
from ..io.kinds import refuse_other_kind
from .index import index_fault
from .shards import SHARD, gathered, promise_fault, shard_fault, shard_name, tidied, write_entry

MANIFEST = "dataset.json"
MODEL_FOLDER = "model"
LISTED_MISSING = 1000
"""Maximum number of missing shards that are listed one by one."""


def read_manifest(path: Path) -> DatasetManifest:
    """Read the manifest of a dataset directory, with all shards that are complete."""
    if not (path / MANIFEST).is_file():
        refuse_other_kind(path, "dataset")
    return gathered(path, read_json(path / MANIFEST, DatasetManifest))


def write_manifest(path: Path, manifest: DatasetManifest) -> None:
    """Write the manifest of a dataset directory."""
    with replaced_file(path / MANIFEST) as temporary:
        temporary.write_text(manifest.model_dump_json(indent=2) + "\n", encoding="utf-8")


def settings_text(manifest: DatasetManifest) -> str:
    """Return the settings in the form in which shards store them."""
    return json.dumps(manifest.config, sort_keys=True)


def shard_entry(
    path: Path, index: int, rollouts: int, frames: int, name: str = "", device: str | None = None
) -> ShardEntry:
    """Describe a finished shard, with its hash; `name` is its final name where `path` is a temporary one."""
    size = path.stat().st_size
    return ShardEntry(
        file=name or path.name,
        index=index,
        sha256=sha256(path),
        bytes=size,
        rollouts=rollouts,
        frames=frames,
        device=device,
    )


def finished_shard(path: Path, manifest: DatasetManifest, index: int, overwrite: bool) -> ShardEntry | None:
    """Return the entry of a complete shard, or None if it has to be made (again).

    Args:
        path: DATASET, which need not exist.
        manifest: The manifest of the dataset that would be written, without shards.
        index: Number of the shard, from 0.
        overwrite: Make a damaged shard again.

    Raises:
        UsageError: If `path` is not a dataset, or one of other rollouts.
        DamagedShardError: If the shard is damaged and `overwrite` is not set.
    """
    if not path.exists():
        return None
    refuse_other_dataset(path, manifest)
    name = shard_name(index, manifest.shard_count)
    entry = next((entry for entry in read_manifest(path).shards if entry.index == index), None)
    if not (path / name).exists():
        return None
    fault = shard_fault(path / name, entry) if entry else f"{name}: there, but without an entry in {MANIFEST}."
    if entry is not None and fault is None:
        return entry
    if overwrite:
        return None
    raise DamagedShardError(
        f"{path}/{fault}",
        "the bytes that were written, or no such file.",
        "pass --overwrite as well, which keeps whole shards and makes this one again, or move it away.",
    )


@contextmanager
def new_dataset(
    path: Path, manifest: DatasetManifest, model: Path, index: int, overwrite: bool
) -> Iterator[tuple[Path, list[ShardEntry]]]:
    """Yield the temporary path of a shard to write and a list to append its entry to; publish both at the end.

    Args:
        path: DATASET.
        manifest: The manifest without shards.
        model: The model's directory, which is copied along.
        index: Number of the shard, from 0.
        overwrite: Replace the existing output: the whole dataset if it has one shard, else the shard.

    Raises:
        UsageError: Before anything is written, if the output exists and `overwrite` is not set, or if the shard does
            not belong to the existing dataset.
        NotEnoughSpaceError: If the disk is full; earlier complete output is kept.
    """
    entries: list[ShardEntry] = []
    name = shard_name(index, manifest.shard_count)
    if manifest.shard_count == 1:
        with enough_room(path, name), new_directory(path, "dataset", overwrite) as folder:
            yield folder / name, entries
            _copy_model(model, folder, manifest)
            write_manifest(folder, manifest.model_copy(update={"shards": _stamped(entries, manifest)}))
        return
    home = real_path(path)  # beside the directory itself, so that renaming stays on one file system
    if path.exists():
        refuse_other_dataset(path, manifest)
        if (path / name).exists() and not overwrite:
            raise _exists(path / name)
        tidied(home)
    with enough_room(path, name), scratch_file(home.parent / f"{home.name}.{name}") as temporary:
        yield temporary, entries
        _publish(path, manifest, model, temporary, _stamped(entries, manifest)[0], overwrite)


def _publish(
    path: Path, manifest: DatasetManifest, model: Path, temporary: Path, entry: ShardEntry, overwrite: bool
) -> None:
    if not path.exists():
        try:
            with new_directory(path, "dataset") as folder:
                _copy_model(model, folder, manifest)
                write_manifest(folder, manifest)
        except (UsageError, OSError):
            if not _appears(path / MANIFEST):  # not the case that another shard was faster
                raise
    refuse_other_dataset(path, manifest)
    if (path / entry.file).exists() and not overwrite:  # by a second task of the same number, meanwhile
        others = {shard.index: shard.sha256 for shard in read_manifest(path).shards}
        if others.get(entry.index) != entry.sha256:
            raise _exists(path / entry.file)
        return
    write_entry(path, entry)
    move_into_place(temporary, path / entry.file)


def _copy_model(model: Path, folder: Path, manifest: DatasetManifest) -> None:
    """Copy the model into a dataset, which refuses one that is no longer what the rollouts were made of."""
    copy = folder / MODEL_FOLDER
    copy_files(model, copy)
    if sha256(copy) != manifest.model_sha256:
        raise InputDataError(
            f"{model}: was changed while its rollouts were made.",
            "a model that nobody writes to meanwhile.",
            "run the command again.",
        )


def _appears(file: Path, seconds: float = 10.0) -> bool:
    """Return whether a file of an existing directory exists; a network file system may show it some seconds late."""
    end = time.monotonic() + seconds
    while not file.is_file():
        if not os.path.lexists(file.parent) or time.monotonic() > end:
            return False
        time.sleep(0.2)
        os.listdir(file.parent)  # asks the server again
    return True


def _stamped(entries: list[ShardEntry], manifest: DatasetManifest) -> tuple[ShardEntry, ...]:
    made_of = {"model_sha256": manifest.model_sha256, "versions": manifest.versions}
    return tuple(entry.model_copy(update=made_of) for entry in entries)


def refuse_existing_shards(path: Path, count: int) -> None:
    """Refuse to make shards if one of them exists; called before long work starts.

    Raises:
        UsageError: For the first shard that exists.
    """
    names = (SHARD.fullmatch(file.name) for file in path.glob("rollouts-*-of-*.h5"))
    there = [int(name[1]) for name in names if name is not None and int(name[2]) == count]
    if there:
        raise _exists(path / shard_name(min(there), count))


def _exists(path: Path) -> UsageError:
    return UsageError(
        f"{path} exists.", todo="choose another name or pass --overwrite, or --resume, which keeps what is whole."
    )


def refuse_other_dataset(path: Path, manifest: DatasetManifest) -> None:
    """Refuse to add a shard to a directory that is not a dataset, or to a dataset of other rollouts.

    Raises:
        UsageError: For the first difference.
    """
    if not (path / MANIFEST).is_file():
        raise UsageError(f"{path} exists and is no dataset.", todo="choose another name.")
    other = difference(read_json(path / MANIFEST, DatasetManifest), manifest)
    if other is not None:
        name, found, wanted = other
        raise UsageError(
            f"{path / MANIFEST}: another dataset: its {name} is {_short(found)}, here {_short(wanted)}.",
            "shards of one model with one set of options, made with the same versions.",
            "choose another name for --out, or repeat the options of the first shard.",
        )


def difference(found: DatasetManifest, wanted: DatasetManifest) -> tuple[str, Any, Any] | None:
    """Return name and both values of the first field in which two datasets differ, except for their shards."""
    for field in ("format", "model_sha256", "config", "rollouts", "shard_count", "versions"):
        pair = getattr(found, field), getattr(wanted, field)
        if pair[0] != pair[1]:
            return _deepest(field, *pair)
    return None


def _deepest(name: str, found: Any, wanted: Any) -> tuple[str, Any, Any]:
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for key in sorted({*found, *wanted}):
            if found.get(key) != wanted.get(key):
                return _deepest(f"{name}.{key}", found.get(key), wanted.get(key))
    return name, found, wanted


def _short(value: object) -> str:
    return f"{value!r:.200}"


def missing_shards(manifest: DatasetManifest) -> list[range]:
    """Return the numbers of the shards that a dataset still lacks, as ranges of successive ones.

    Their number is at most that of the shards that are there, plus one, whatever number of shards a manifest names.
    """
    count = manifest.shard_count
    present = sorted({shard.index for shard in manifest.shards if shard.index < count})
    gaps = zip([-1, *present], [*present, count], strict=True)
    return [range(before + 1, after) for before, after in gaps if after - before > 1]


def missing_count(manifest: DatasetManifest) -> int:
    """Return the number of shards that a dataset still lacks."""
    return sum(gap.stop - gap.start for gap in missing_shards(manifest))


def check_hashes(path: Path, manifest: DatasetManifest, files: Collection[str] | None = None) -> list[str]:
    """Compare the shards, their index and the copy of the model with the manifest; return one sentence per fault.

    Args:
        path: DATASET.
        manifest: Its manifest.
        files: Names of the shards whose hash is compared, or None for all; for others only the size is compared.
    """
    found = [*_missing_faults(manifest), promise_fault(manifest)]
    found += [shard_fault(path / shard.file, shard, files is None or shard.file in files) for shard in manifest.shards]
    listed = {shard.file for shard in manifest.shards}
    if manifest.index is not None:
        listed.add(manifest.index.file)
        found.append(index_fault(path / manifest.index.file, manifest))
    extra = {file.name for file in path.glob("*.h5")} - listed
    found += [*(f"{name}: not listed in {MANIFEST}." for name in sorted(extra)), _model_fault(path, manifest)]
    return list(filter(None, found))


def _missing_faults(manifest: DatasetManifest) -> list[str]:
    """Return one sentence for each of the first shards that are missing, and one for all others."""
    lacking, count = chain.from_iterable(missing_shards(manifest)), missing_count(manifest)
    first = islice(lacking, LISTED_MISSING)
    faults = [f"{shard_name(index, manifest.shard_count)}: this shard is missing." for index in first]
    return faults + ([f"and {count - LISTED_MISSING} more shards are missing."] if count > LISTED_MISSING else [])


def _model_fault(path: Path, manifest: DatasetManifest) -> str | None:
    """Return what is wrong with a dataset's copy of its model; None if it is as the manifest says."""
    model = path / manifest.model
    if not model.is_dir():
        return f"{manifest.model}/: the model's copy is missing."
    return None if sha256(model) == manifest.model_sha256 else f"{manifest.model}/: its sha256 differs from {MANIFEST}."
