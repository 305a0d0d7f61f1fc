"""The shards of a dataset: names, rollouts, entries, and checks of their integrity.

Each shard has an entry file next to it, `rollouts-0003-of-0064.json`, with its sha256, which is written first. So
shards that finish at the same time on many machines never write the same file and need no lock: every file appears by
a rename, which is atomic on network file systems, too. `cgwm merge` collects the entries in `dataset.json`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import h5py

from ...schemas import DatasetManifest, InputDataError, ShardEntry, read_json
from ..io.atomic import leftovers, replaced_file, sha256
from ..io.hdf5_files import hdf5_faults, require_stored
from .rollouts import SHARD, Node, demo_names, open_shard


def shard_name(index: int, count: int) -> str:
    """Return the file name of a shard, numbered from 0: ``rollouts-0003-of-0064.h5``."""
    return f"rollouts-{index:04d}-of-{count:04d}.h5"


def shard_range(rollouts: int, count: int, index: int) -> range:
    """Return the rollouts of a shard: successive ones, in shares that differ by at most one.

    >>> [list(shard_range(5, 2, index)) for index in (0, 1)]
    [[0, 1], [2, 3, 4]]
    """
    return range(rollouts * index // count, rollouts * (index + 1) // count)


def ranges(numbers: Iterable[int]) -> str:
    """Write numbers in the format of SLURM's --array.

    >>> ranges([0, 1, 2, 5, 7, 8])
    '0-2,5,7-8'
    """
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)


def span(numbers: range) -> str:
    """Write successive numbers, which may be too many to go through, in the same format.

    >>> span(range(3, 10**12)), span(range(4, 5)), span(range(0))
    ('3-999999999999', '4', '')
    """
    if numbers.stop <= numbers.start:
        return ""
    last = numbers.stop - 1
    return f"{numbers.start}" if last == numbers.start else f"{numbers.start}-{last}"


def entry_file(path: Path, shard: str) -> Path:
    """Return the path of the entry of a shard before the shards are merged."""
    return (path / shard).with_suffix(".json")


def write_entry(path: Path, entry: ShardEntry) -> None:
    """Write the entry of a shard just before the shard gets its final name."""
    with replaced_file(entry_file(path, entry.file)) as temporary:
        temporary.write_text(entry.model_dump_json(indent=2) + "\n", encoding="utf-8")


def gathered(path: Path, listed: DatasetManifest) -> DatasetManifest:
    """Return a manifest with the shards that were added since it was written; entry files override its list.

    An entry without its shard was left by a task that was killed between the two writes; the shard is missing.
    """
    entries = {entry.index: entry for entry in listed.shards}
    for file in sorted(path.glob("rollouts-*-of-*.json")):
        if SHARD.fullmatch(file.with_suffix(".h5").name) and file.with_suffix(".h5").is_file():
            entry = read_json(file, ShardEntry)
            entries[entry.index] = entry
    return listed.model_copy(update={"shards": tuple(entries[index] for index in sorted(entries))})


def shard_fault(file: Path, entry: ShardEntry, hashes: bool = True) -> str | None:
    """Return one sentence on how a shard differs from what was written, or None if it is intact.

    Args:
        file: Path of the shard.
        entry: Its entry in the manifest.
        hashes: Compare its hash, not only its size.
    """
    if not file.is_file():
        return f"{file.name}: listed in dataset.json, but no such file."
    size = file.stat().st_size
    if not hashes:
        return None if size == entry.bytes else f"{file.name}: {size} bytes; dataset.json says {entry.bytes}."
    if sha256(file) == entry.sha256:
        return None
    place = unreadable_block(file)
    how = f"{place} cannot be read." if place else "changed since it was written; all its blocks can be read."
    return f"{file.name}: its sha256 differs from dataset.json: {how}"


def promise_fault(manifest: DatasetManifest) -> str | None:
    """Return one sentence if the shards that are there do not hold the rollouts that they stand for, or None.

    None is left out: a rollout that diverges is drawn again, and after too many draws its shard is not written.
    """
    present = [shard for shard in manifest.shards if shard.index < manifest.shard_count]
    shares = [len(shard_range(manifest.rollouts, manifest.shard_count, shard.index)) for shard in present]
    if all(shard.rollouts == share for shard, share in zip(present, shares, strict=True)):
        return None
    where = f"its {len(present)} of {manifest.shard_count} shards"
    held = sum(shard.rollouts for shard in present)
    return f"dataset.json promises {sum(shares)} rollouts in {where}; they are listed with {held}."


def unreadable_block(file: Path) -> str | None:
    """Return the first array whose blocks fail their checksum or cannot be unpacked, with its frames, or None."""
    found: list[str] = []

    def visit(name: str, item: object) -> bool | None:
        if isinstance(item, h5py.Dataset) and not item.is_virtual:
            require_stored(item, f"{file}: {name}")
            blocks = item.iter_chunks() if item.chunks else [()]
            for block in blocks:
                try:
                    item[block]
                except OSError:
                    rows = block[0] if block else slice(0, 1)
                    found.append(f"{name}, rows {rows.start} to {rows.stop - 1},")
                    return True
        return None

    try:
        with open_shard(file) as handle:
            handle.visititems(visit)
    except (InputDataError, OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        return f"the HDF5 structure ({str(error).splitlines()[0][:120]})"
    return found[0] if found else None


def contact_count(file: Path) -> int:
    """Return the number of contact labels in a shard."""
    with open_shard(file) as handle:
        data: Node = handle["data"]
        return sum(len(data[name]["contacts"]["body_a"]) for name in demo_names(handle))


def foreign(file: Path, entry: ShardEntry, manifest: DatasetManifest, config_json: str) -> str | None:
    """Return one sentence on why an intact shard does not belong to a dataset, or None if it does.

    Args:
        file: The shard.
        entry: Its entry.
        manifest: Manifest of the dataset.
        config_json: Settings of the dataset in the form in which shards store them.
    """
    return next(_strange(file, entry, manifest, config_json), None)


def _strange(file: Path, entry: ShardEntry, manifest: DatasetManifest, config_json: str) -> Iterator[str]:
    if entry.model_sha256 not in (None, manifest.model_sha256):
        yield f"{file.name}: made from another model ({entry.model_sha256}; the dataset's is {manifest.model_sha256})."
    for name, version in entry.versions.items():
        if manifest.versions.get(name) != version:
            yield f"{file.name}: made with {name} {version}; the dataset's is {manifest.versions.get(name, 'none')}."
    with open_shard(file) as handle, hdf5_faults(file):
        yield from _strange_settings(file, handle.attrs, manifest, config_json)
        found = [int(name.removeprefix("demo_")) for name in demo_names(handle)]
    wanted = shard_range(manifest.rollouts, manifest.shard_count, entry.index)
    if not all(number in wanted for number in found):
        yield f"{file.name}: holds the rollouts {ranges(found)}; its number stands for {span(wanted)}."
    if len(found) != entry.rollouts:
        yield f"{file.name}: holds {len(found)} rollouts; its entry says {entry.rollouts}."


def _strange_settings(file: Path, attributes: Node, manifest: DatasetManifest, config_json: str) -> Iterator[str]:
    if int(attributes["seed"]) != manifest.config.get("seed"):
        yield f"{file.name}: made with seed {attributes['seed']}; the dataset's is {manifest.config.get('seed')}."
    if attributes["config_json"] != config_json:
        yield f"{file.name}: made with other settings (its attribute config_json)."


def tidied(path: Path) -> list[str]:
    """Remove unfinished shards of dead processes of this machine; return those that may be in use elsewhere."""
    beside = re.compile(rf"{re.escape(path.name)}\.{SHARD.pattern}")
    inside = re.compile(r"rollouts-\d+-of-\d+\.json|index\.h5|dataset\.json")
    kept: list[str] = []
    for folder, names in ((path.parent, beside), (path, inside)):
        dead, unknown = leftovers(folder, names)
        for file in dead:
            file.unlink(missing_ok=True)
        kept += [str(file) for file in unknown]
    return kept
