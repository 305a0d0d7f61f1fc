"""The directory of a dataset: its manifest, its shards, and a copy of the model that made it.

With one shard the directory appears complete. With several (`--shard I/N`, in any order and from any machine that
sees the directory) the first shard that is ready makes the directory, and each adds itself to the manifest.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..schemas import DatasetManifest, ShardEntry, UsageError, read_json
from .atomic import new_directory, new_file, sha256
from .kinds import refuse_other_kind

MANIFEST = "dataset.json"
MODEL_FOLDER = "model"


def shard_name(index: int, count: int) -> str:
    """Return the file name of a shard, numbered from 0: ``rollouts-0003-of-0064.h5``."""
    return f"rollouts-{index:04d}-of-{count:04d}.h5"


def read_manifest(path: Path) -> DatasetManifest:
    """Read the manifest of a dataset directory."""
    if not (path / MANIFEST).is_file():
        refuse_other_kind(path, "dataset")
    return read_json(path / MANIFEST, DatasetManifest)


def shard_entry(path: Path, index: int, rollouts: int, frames: int, name: str = "") -> ShardEntry:
    """Describe a finished shard, with its hash; `name` is its final name where `path` is a temporary one."""
    size = path.stat().st_size
    return ShardEntry(
        file=name or path.name,
        index=index,
        sha256=sha256(path),
        bytes=size,
        rollouts=rollouts,
        frames=frames,
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
        overwrite: Replace what is there: the whole dataset where it has one shard, else the shard.

    Raises:
        UsageError: Before anything is written, if the output exists and `overwrite` is not set, or if the shard
            belongs to another dataset than the one that is there.
    """
    entries: list[ShardEntry] = []
    if manifest.shard_count == 1:
        with new_directory(path, overwrite) as folder:
            yield folder / shard_name(index, 1), entries
            shutil.copytree(model, folder / MODEL_FOLDER)
            _write(folder, manifest.model_copy(update={"shards": tuple(entries)}))
        return
    name = shard_name(index, manifest.shard_count)
    if path.exists():
        _refuse_other(path, manifest)
        if (path / name).exists() and not overwrite:
            raise UsageError(f"{path / name} exists.", todo="choose another name or pass --overwrite.")
    waiting = path.parent / f".{path.name}.{name}"
    with new_file(waiting, overwrite=True) as temporary:
        yield temporary, entries
    try:
        _publish(path, manifest, model, waiting, name, entries)
    finally:
        waiting.unlink(missing_ok=True)


def _publish(
    path: Path, manifest: DatasetManifest, model: Path, waiting: Path, name: str, entries: list[ShardEntry]
) -> None:
    if not path.exists():
        try:
            with new_directory(path) as folder:
                shutil.copytree(model, folder / MODEL_FOLDER)
                _write(folder, manifest)
        except (UsageError, OSError):
            if not (path / MANIFEST).is_file():  # not the case that another shard was faster
                raise
    _refuse_other(path, manifest)
    with _locked(path):
        os.replace(waiting, path / name)
        present = read_manifest(path)
        others = [shard for shard in present.shards if shard.file != name]
        shards = tuple(sorted([*others, *entries], key=lambda shard: shard.index))
        _write(path, present.model_copy(update={"shards": shards}))


def _refuse_other(path: Path, manifest: DatasetManifest) -> None:
    """Refuse to add a shard to a directory that is no dataset, or a dataset of other rollouts."""
    if not (path / MANIFEST).is_file():
        raise UsageError(f"{path} exists and is no dataset.", todo="choose another name.")
    present = read_manifest(path)
    for field in ("model_sha256", "config", "rollouts", "shard_count"):
        found, wanted = getattr(present, field), getattr(manifest, field)
        if found != wanted:
            raise UsageError(
                f"{path / MANIFEST}: another dataset: its {field} is {_short(found)}, here {_short(wanted)}.",
                "shards of one model with one set of options.",
                "choose another name for --out, or repeat the options of the first shard.",
            )


def _short(value: object) -> str:
    return f"{value!r:.200}"


def _write(folder: Path, manifest: DatasetManifest) -> None:
    with new_file(folder / MANIFEST, overwrite=True) as temporary:
        temporary.write_text(manifest.model_dump_json(indent=2) + "\n", encoding="utf-8")


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the directory's advisory lock, so that shards that end together do not lose each other's entries."""
    try:
        import fcntl
    except ImportError:  # no POSIX: there, shards have to end one after the other
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def missing_shards(manifest: DatasetManifest) -> list[str]:
    """Return the names of the shards that a dataset still lacks."""
    present = {shard.index for shard in manifest.shards}
    return [shard_name(index, manifest.shard_count) for index in range(manifest.shard_count) if index not in present]


def check_hashes(path: Path, manifest: DatasetManifest, files: Collection[str] | None = None) -> list[str]:
    """Compare the shards and the model's copy with the manifest; return one sentence a fault.

    Args:
        path: DATASET.
        manifest: Its manifest.
        files: Names of the shards to read for their hash; all where left out.
    """
    faults = [f"{name}: this shard is missing." for name in missing_shards(manifest)]
    for shard in manifest.shards:
        file = path / shard.file
        if not file.is_file():
            faults.append(f"{shard.file}: listed in {MANIFEST}, but no such file.")
        elif (files is None or shard.file in files) and sha256(file) != shard.sha256:
            faults.append(f"{shard.file}: its sha256 differs from {MANIFEST}: changed or damaged since it was written.")
    listed = {shard.file for shard in manifest.shards}
    extra = sorted(file.name for file in path.glob("*.h5") if file.name not in listed)
    faults += [f"{name}: not listed in {MANIFEST}." for name in extra]
    model = path / manifest.model
    if not model.is_dir():
        faults.append(f"{manifest.model}/: the model's copy is missing.")
    elif sha256(model) != manifest.model_sha256:
        faults.append(f"{manifest.model}/: its sha256 differs from {MANIFEST}.")
    return faults
