"""Merge of shards: one index over all of them, by HDF5 virtual datasets. No data are copied or moved."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

from ...datasets.io.atomic import copy_files, new_directory, new_file, sha256
from ...datasets.io.free_space import enough_room
from ...datasets.io.outputs import reads
from ...datasets.io.processors import processors
from ...datasets.io.progress import progress
from ...datasets.rollouts.dataset import (
    MANIFEST,
    MODEL_FOLDER,
    difference,
    missing_count,
    missing_shards,
    read_manifest,
    settings_text,
    write_manifest,
)
from ...datasets.rollouts.index import INDEX, index_fault, write_index
from ...datasets.rollouts.shards import (
    entry_file,
    foreign,
    promise_fault,
    ranges,
    shard_fault,
    shard_name,
    span,
    tidied,
)
from ...schemas import DatasetManifest, IndexEntry, InputDataError, MergeSummary, ShardEntry, UsageError
from ...schemas.regular_files import real_path
from ..runtime.work_budget import Part, data_size, within_budget

SHOWN_FAULTS = 20
_READ_BYTES_S = 2e8
"""Speed of reading and hashing shards [bytes/s]."""


@dataclass(frozen=True)
class _Shard:
    """A shard and its dataset directory."""

    root: Path
    """The dataset directory."""
    entry: ShardEntry
    """The entry of the shard in the manifest."""

    @property
    def file(self) -> Path:
        return self.root / self.entry.file


@reads("sources")
def merge(
    sources: Sequence[Path], out: Path | None = None, overwrite: bool = False, hashes: bool = True
) -> MergeSummary:
    """Merge the shards of one dataset, in one directory or in several, into an index.

    Args:
        sources: DATASET directories. Several hold different shards of one dataset, made on machines that share no disk.
        out: A file (``.h5``, ``.hdf5``) for the index alone, or a directory for a dataset with the index and links to
            the shards, which are not moved. Default: ``index.h5`` in the one source.
        overwrite: Replace an output that exists.
        hashes: Compare every byte with the shards' hashes; otherwise only the sizes.

    Raises:
        UsageError: If the output exists, or there are several sources and no output.
        InputDataError: If a source is no dataset, or if shards are missing, damaged, duplicate or of another model,
            seed, plan or version; the message lists all faults.
        NotEnoughSpaceError: If the disk has no room for the index.
    """
    if not sources:
        raise UsageError(
            "no dataset to merge.",
            "one directory or more.",
            "name the datasets to merge, or the folder that holds them.",
        )
    if out is None and len(sources) > 1:
        raise UsageError(
            f"{len(sources)} directories and no --out.",
            "--out with a directory, or with the name of an index (.h5).",
            "pass --out DATASET.",
        )
    manifests = [read_manifest(source) for source in sources]
    with within_budget(
        _parts(sources, manifests) if hashes else [], "pass --sizes, which compares only the sizes of the shards."
    ):
        shards, notes = _joined(sources, manifests, hashes)
    manifest = manifests[0].model_copy(update={"shards": tuple(shard.entry for shard in shards), "index": None})
    for source in sources:
        notes += [f"left unfinished by a process that may be running: {file}" for file in tidied(real_path(source))]
    with enough_room(out or sources[0], "the index"):
        if out is None:
            index, kept = _index_inside(sources[0], manifest, manifests[0], shards, overwrite)
        elif out.suffix in (".h5", ".hdf5"):
            index, kept = _index_alone(out, shards, overwrite), False
        else:
            index, kept = _dataset_of_links(out, manifest, shards, overwrite), False
    return MergeSummary(
        index=str(index),
        sha256=sha256(index),
        bytes=index.stat().st_size,
        shards=len(shards),
        rollouts=sum(shard.entry.rollouts for shard in shards),
        frames=sum(shard.entry.frames for shard in shards),
        shard_bytes=sum(shard.entry.bytes for shard in shards),
        up_to_date=kept,
        notes=tuple(notes),
    )


def _parts(sources: Sequence[Path], manifests: Sequence[DatasetManifest]) -> list[Part]:
    """Return the work of reading all shards that are there."""
    pairs = zip(sources, manifests, strict=True)
    files = [source / entry.file for source, manifest in pairs for entry in manifest.shards]
    size = sum(file.stat().st_size for file in files if file.is_file())
    return [Part(what=f"the hashes of {len(files)} shards, {data_size(size)}", seconds=size / _READ_BYTES_S)]


def _joined(
    sources: Sequence[Path], manifests: Sequence[DatasetManifest], hashes: bool
) -> tuple[list[_Shard], list[str]]:
    """Return the checked shards of all sources in the order of their numbers, and notes for the user."""
    shards, notes, doubled = _by_number(sources, manifests)
    faults = [*_differing(sources, manifests), *doubled]
    joined = manifests[0].model_copy(update={"shards": tuple(shard.entry for shard in shards)})
    promise = promise_fault(joined)
    faults += [*_shard_faults(shards, manifests[0], hashes), *_missing(joined), *([promise] if promise else [])]
    if faults:
        where = ", ".join(str(source) for source in sources[:3]) + (", ..." if len(sources) > 3 else "")
        more = [f"and {len(faults) - SHOWN_FAULTS} more"] if len(faults) > SHOWN_FAULTS else []
        raise InputDataError(
            "\n  ".join([f"{where}: the shards cannot be joined:", *faults[:SHOWN_FAULTS], *more]),
            f"shards 0 to {manifests[0].shard_count - 1} of one model, one set of options and one set of versions.",
            "make those shards with the command that made the others; --resume --overwrite keeps what is whole.",
        )
    return shards, notes + _device_notes(shards)


def _by_number(
    sources: Sequence[Path], manifests: Sequence[DatasetManifest]
) -> tuple[list[_Shard], list[str], list[str]]:
    """Return one shard of each number, in order, notes on equal copies of them, and faults of different ones."""
    found: dict[int, _Shard] = {}
    notes: list[str] = []
    faults: list[str] = []
    for source, manifest in zip(sources, manifests, strict=True):
        for entry in manifest.shards:
            shard, first = _Shard(source, entry), found.setdefault(entry.index, _Shard(source, entry))
            if first.root == source:
                continue
            if first.entry.sha256 == entry.sha256:
                notes.append(f"{entry.file} is in {first.root} and, byte for byte, in {source}: the first is taken")
            else:
                faults.append(f"two shards have the number {entry.index}: {first.file} and {shard.file}.")
    return [found[index] for index in sorted(found)], notes, faults


def _missing(joined: DatasetManifest) -> list[str]:
    """Return one fault that lists the missing shards; empty if none is missing."""
    gaps, lacking, count = missing_shards(joined), missing_count(joined), joined.shard_count
    if not lacking:
        return []
    first = islice(chain.from_iterable(gaps), 3)
    names = ", ".join(shard_name(index, count) for index in first) + (", ..." if lacking > 3 else "")
    return [f"{lacking} of {count} shards are missing: {names} (--array={','.join(map(span, gaps))})."]


def _device_notes(shards: Sequence[_Shard]) -> list[str]:
    """Return one note that lists the shards of each device; empty if all are of the same one."""
    devices = {str(shard.entry.device) for shard in shards}
    if len(devices) < 2:
        return []
    parts = (
        f"{ranges(shard.entry.index for shard in shards if str(shard.entry.device) == device)} on {device}"
        for device in sorted(devices)
    )
    return [f"shards {', '.join(parts)}: these agree to rounding, not to the byte"]


def _differing(sources: Sequence[Path], manifests: Sequence[DatasetManifest]) -> Iterator[str]:
    for source, manifest in zip(sources[1:], manifests[1:], strict=True):
        other = difference(manifest, manifests[0])
        if other is not None:
            name, found, wanted = other
            yield f"{source / MANIFEST}: another dataset: its {name} is {found!r:.80}, in {sources[0]} {wanted!r:.80}."


def _shard_faults(shards: Sequence[_Shard], manifest: DatasetManifest, hashes: bool) -> list[str]:
    settings = settings_text(manifest)

    def fault(shard: _Shard) -> str | None:
        if shard.entry.file != shard_name(shard.entry.index, manifest.shard_count):
            return f"{shard.entry.file}: its entry has the number {shard.entry.index}."
        return shard_fault(shard.file, shard.entry, hashes)

    # Hashing releases Python's lock, so threads use all cores and hide the latency of a network file system.
    with ThreadPoolExecutor(min(8, processors())) as pool:
        results = list(progress(pool.map(fault, shards), "check", len(shards), "shard"))
    found = [f"{shard.root}/{result}" for shard, result in zip(shards, results, strict=True) if result]
    for shard, result in zip(shards, results, strict=True):
        if result is None and (other := _foreign(shard, manifest, settings)):
            found.append(f"{shard.root}/{other}")
    return found


def _foreign(shard: _Shard, manifest: DatasetManifest, settings: str) -> str | None:
    try:
        return foreign(shard.file, shard.entry, manifest, settings)
    except InputDataError as error:
        return error.found.removeprefix(f"{shard.root}/")
    except (OSError, KeyError, ValueError) as error:
        return f"{shard.entry.file}: no shard of rollouts: {str(error).splitlines()[0]}"


def _index_inside(
    source: Path, manifest: DatasetManifest, present: DatasetManifest, shards: Sequence[_Shard], overwrite: bool
) -> tuple[Path, bool]:
    path = source / INDEX
    if present.index is not None and index_fault(path, present) is None:
        _fold(source, manifest.model_copy(update={"index": present.index}))
        return path, True
    _write(path, path, shards, overwrite)
    _fold(source, manifest.model_copy(update={"index": _entry(path)}))
    return path, False


def _fold(source: Path, manifest: DatasetManifest) -> None:
    """Move the entries of the shards into the manifest and remove their files, unless these changed meanwhile."""
    write_manifest(source, manifest)
    for entry in manifest.shards:
        file = entry_file(source, entry.file)
        if file.is_file() and ShardEntry.model_validate_json(file.read_text(encoding="utf-8")) == entry:
            file.unlink()


def _index_alone(out: Path, shards: Sequence[_Shard], overwrite: bool) -> Path:
    _write(out, out, shards, overwrite)
    return out


def _dataset_of_links(out: Path, manifest: DatasetManifest, shards: Sequence[_Shard], overwrite: bool) -> Path:
    with new_directory(out, "dataset", overwrite) as folder:
        copy_files(shards[0].root / manifest.model, folder / MODEL_FOLDER)
        linked: list[_Shard] = []
        for shard in shards:
            target = os.path.relpath(real_path(shard.file), real_path(out))
            (folder / shard.entry.file).symlink_to(target)
            linked.append(_Shard(folder, shard.entry))
        _write(folder / INDEX, folder / INDEX, linked, False)
        whole = manifest.model_copy(update={"model": MODEL_FOLDER, "index": _entry(folder / INDEX)})
        write_manifest(folder, whole)
    return out / INDEX


def _write(path: Path, final: Path, shards: Sequence[_Shard], overwrite: bool) -> None:
    """Write an index with paths relative to the folder of `final`."""
    folder = real_path(final.parent)
    named = [(shard.file, _relative(shard.file, folder), shard.entry) for shard in shards]
    with new_file(path, "index", overwrite) as temporary:
        write_index(temporary, named)


def _relative(file: Path, folder: Path) -> str:
    return Path(os.path.relpath(real_path(file.parent) / file.name, folder)).as_posix()


def _entry(path: Path) -> IndexEntry:
    return IndexEntry(file=path.name, sha256=sha256(path), bytes=path.stat().st_size)
