"""HDF5 files from elsewhere: what a file declares, and where it refers to, is looked at before anything is read.

A link to another file would make cgwm open any file of this machine, and a few bytes may declare arrays of terabytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
from h5py import h5l, h5o  # pyright: ignore[reportAttributeAccessIssue]

from ...schemas import InputDataError
from ...schemas.regular_files import require_regular_file

MOST_DEEP = 64
"""Maximum depth of groups in groups."""
MOST_OBJECTS = 1_000_000
"""Maximum number of groups and arrays of a file that are visited."""
MOST_CHUNK_BYTES = 1 << 30
"""Largest chunk, which HDF5 unpacks as a whole [bytes]."""
NEEDS_NO_PROOF_BYTES = 64 << 20
"""Size up to which an array may be stored in part [bytes]."""
_WRITE = "write it again, or take the original."
_ERRORS = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError)
"""What h5py raises for damaged files and for what is no HDF5."""


@contextmanager
def hdf5_faults(path: Path) -> Iterator[None]:
    """Turn what h5py raises in the block into one message that names the file.

    Raises:
        InputDataError: In place of an error of h5py.
    """
    try:
        yield
    except _ERRORS as error:
        reason = (str(error).splitlines() or [""])[0][:160] or type(error).__name__
        raise InputDataError(f"{path}: not a readable HDF5 file: {reason}.", todo=_WRITE) from None


def open_hdf5(path: Path, **options: Any) -> h5py.File:
    """Open an HDF5 file for reading.

    Args:
        path: The file.
        options: Of `h5py.File`.

    Raises:
        InputDataError: If it is no regular file, or no HDF5 file that can be read.
    """
    with hdf5_faults(require_regular_file(path)):
        return h5py.File(path, "r", **options)


def own_objects(group: h5py.Group, where: str) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Yield path and object of all groups and arrays within a group: by name, each once, in front of what it contains.

    Args:
        group: The group; what it leads to by soft links within the file is not yielded again.
        where: What the group is called in messages.

    Raises:
        InputDataError: For a link to another file, a soft link that leads nowhere or in circles, or groups without end.
    """
    soft: list[tuple[h5py.Group, str, str]] = []
    pending: list[tuple[str, Any]] = [("", group)]
    seen: set[tuple[int, int]] = set()
    while pending:
        place, item = pending.pop()
        info = h5o.get_info(item.id)
        if (info.fileno, info.addr) in seen:
            continue
        seen.add((info.fileno, info.addr))
        if place:
            yield place, item
        if isinstance(item, h5py.Group):
            _require_end(place, len(seen) + len(pending), where)
            inside, links = _entries(item, place, where)
            pending += reversed(inside)
            soft += links
    for parent, name, path in soft:  # last, when it is known that no path leads through a link to another file
        _require_target(parent, name, f"{where}/{path}")


def _require_end(place: str, count: int, where: str) -> None:
    """Refuse a group deep in others, or after very many objects: such groups hardly end."""
    if place.count("/") > MOST_DEEP or count > MOST_OBJECTS:
        raise InputDataError(
            f"{where}/{place[:80]}: groups without end.",
            f"{MOST_DEEP} groups in each other.",
            "take the original file.",
        )


def _entries(
    group: h5py.Group, place: str, where: str
) -> tuple[list[tuple[str, h5py.Group | h5py.Dataset]], list[tuple[h5py.Group, str, str]]]:
    """Return path and object of the groups and arrays of a group, by name, and its soft links: group, name, path."""
    inside, soft = [], []
    for name in sorted(group):
        path = f"{place}/{name}".lstrip("/")
        if not is_own_link(group, name, f"{where}/{path}"):
            soft.append((group, name, path))
        elif isinstance(item := group[name], h5py.Group | h5py.Dataset):
            inside.append((path, item))
    return inside, soft


def is_own_link(group: h5py.Group, name: str, where: str) -> bool:
    """Return whether an entry of a group is an object of its own; False for a soft link.

    Args:
        group: The group.
        name: Name of the entry.
        where: What the entry is called in messages.

    Raises:
        InputDataError: If it is a link to another file.
    """
    kind = group.id.links.get_info(name.encode("utf-8", "surrogateescape")).type
    if kind not in (h5l.TYPE_HARD, h5l.TYPE_SOFT):
        link = group.get(name, getlink=True)
        raise InputDataError(
            f"{where}: a link to another file, {getattr(link, 'filename', '')}.",
            "groups and arrays in the file itself.",
            "copy what it leads to into the file, or pass the other file.",
        )
    return kind == h5l.TYPE_HARD


def _require_target(group: h5py.Group, name: str, where: str) -> None:
    try:
        found = group[name]
    except _ERRORS:
        found = None
    if found is None:
        raise InputDataError(
            f"{where}: a soft link that leads nowhere or in circles.", "links to what is there.", "remove the link."
        )


def require_stored(
    item: h5py.Dataset, where: str, files: Mapping[str, Callable[[], h5py.File]] | None = None, depth: int = 0
) -> None:
    """Refuse an array whose numbers lie in other files, or that declares numbers which are not stored.

    Args:
        item: The array.
        where: What it is called in messages.
        files: The other files that a virtual array may look into, by the names that it has for them: each opened.
        depth: Number of virtual arrays through which it was reached.

    Raises:
        InputDataError: If it is such an array.
    """
    if item.shape is None:
        raise InputDataError(f"{where}: an array without a shape.", "arrays of numbers.", "write it, or remove it.")
    made = item.id.get_create_plist()
    if made.get_external_count():
        raise InputDataError(
            f"{where}: its numbers lie in another file, {(item.external or [['']])[0][0]}.",
            "arrays in the file.",
            "write the numbers into the file itself.",
        )
    if made.get_layout() == h5py.h5d.VIRTUAL:
        _require_sources(item, where, files or {}, depth)
        return
    chunks = made.get_chunk() if made.get_layout() == h5py.h5d.CHUNKED else None
    if chunks is not None:
        _require_small(math.prod(chunks) * item.dtype.itemsize, where)
    size, stored = math.prod(item.shape) * item.dtype.itemsize, item.id.get_storage_size()
    if size and not _is_whole(item, size, stored, chunks):
        raise InputDataError(
            f"{where}: declares {item.dtype} {item.shape}, {size / 2**20:.3g} MiB, of which {stored} bytes are stored.",
            "arrays that are written completely.",
            "take the original file.",
        )


def _require_small(chunk: int, where: str) -> None:
    """Refuse chunks of very many bytes, of which one is read at a time."""
    if chunk > MOST_CHUNK_BYTES:
        raise InputDataError(
            f"{where}: chunks of {chunk / 2**30:.1f} GiB.",
            f"{MOST_CHUNK_BYTES / 2**30:g} GiB.",
            "write the file with smaller chunks.",
        )


def _is_whole(item: h5py.Dataset, size: int, stored: int, chunks: tuple[int, ...] | None) -> bool:
    """Return whether all of an array is stored, of which so many bytes are; of a small one a part is enough."""
    if stored <= 0 or size <= NEEDS_NO_PROOF_BYTES:
        return stored > 0
    if chunks is None:
        return stored >= size
    count = math.prod(-(-length // part) for length, part in zip(item.shape, chunks, strict=True))
    return item.id.get_num_chunks() == count


def _opened(files: Mapping[str, Callable[[], h5py.File]], name: str, where: str) -> h5py.File:
    """Return one of the files that a virtual array may look into."""
    if name not in files:
        raise InputDataError(
            f"{where}: looks into another file, {name}.",
            "the files of the dataset.",
            "write the numbers into the file itself.",
        )
    return files[name]()


def _require_sources(item: h5py.Dataset, where: str, files: Mapping[str, Callable[[], h5py.File]], depth: int) -> None:
    """Refuse a virtual array that looks elsewhere than into the given files, or whose sources do not cover it."""
    if depth > 1:
        raise InputDataError(
            f"{where}: a virtual array of virtual arrays.",
            "arrays in files.",
            "write the numbers into the file itself.",
        )
    covered = 0
    for source in item.virtual_sources():
        taken = source.vspace.get_select_npoints()
        covered += taken
        file = item.file if source.file_name == "." else _opened(files, source.file_name, where)
        _require_source(file, source.dset_name, taken, where, files, depth)
    if covered < math.prod(item.shape):
        raise InputDataError(
            f"{where}: declares {item.shape}, of which {covered} numbers have a source.",
            "a virtual array whose sources cover it.",
            _WRITE,
        )


def _require_source(
    file: h5py.File, name: str, taken: int, where: str, files: Mapping[str, Callable[[], h5py.File]], depth: int
) -> None:
    """Refuse the source of a virtual array that holds fewer numbers than are taken from it."""
    place: Any = file
    for part in name.strip("/").split("/"):
        if not is_own_link(place, part, f"{where}: its source {name}"):
            raise InputDataError(f"{where}: its source {name} is a link.", "an array in the file itself.", _WRITE)
        place = place[part]
    if not isinstance(place, h5py.Dataset) or place.shape is None or (place.size or 0) < taken:
        raise InputDataError(
            f"{where}: its source {name} is no array of {taken} numbers.",
            "an array that is written completely.",
            _WRITE,
        )
    require_stored(place, where, files, depth + 1)
