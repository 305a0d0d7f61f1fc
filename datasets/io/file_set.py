"""Files of a folder that are replaced together: after a kill in between, the next command settles it.

The complete new files wait in the hidden directory `.<name>.pending-<pid>-<host>-<random>` beside the first of them,
with the old ones that have made room. Nobody sees files of two sets side by side, though at times some are lacking.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from .atomic import move_into_place, remove_directory, sha256, sync_tree
from .free_space import enough_room
from .neighbours import PARTIAL, clean_stale, is_left_behind, sibling
from .outputs import FileKind, about_to_place, refuse_output
from .places import require_place

_PENDING = "pending"
_OLD = "old"
"""Where the old files of the set wait until `first` is the new one."""
_SIGN = "sign"
"""File with the SHA-256 of the new `first`."""


@contextmanager
def new_files(first: Path, others: Sequence[str], kind: FileKind, overwrite: bool = False) -> Iterator[Path]:
    """Yield an empty directory for files that get their names in the folder of `first` when the block ends.

    Args:
        first: The file by which readers know that all are there: an old one is replaced when the others of its set are
            gone, so that nobody reads files of two sets.
        others: Names of the other files.
        kind: What `first` is; only the same kind is replaced.
        overwrite: Replace existing files.

    Raises:
        UsageError: Before anything is written, see :func:`refuse_output`.
        NotEnoughSpaceError: If the disk is full.
    """
    require_place(first)
    settle_files(first)
    refuse_output(first, kind, overwrite)
    with enough_room(first, f"the {kind}"):
        temporary, pending = sibling(first, PARTIAL), sibling(first, _PENDING)
        try:
            temporary.mkdir()
            yield temporary
            (temporary / _OLD).mkdir()
            (temporary / _SIGN).write_text(sha256(temporary / first.name), encoding="utf-8")
            sync_tree(temporary)
            refuse_output(first, kind, overwrite)
            about_to_place(temporary / first.name, first)
            os.rename(temporary, pending)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        try:
            _place(pending, first, others)
        finally:
            _settle(pending, first)


def settle_files(first: Path) -> None:
    """Complete a set of files that a killed process was placing, or give the old set back if `first` is still the old.

    Files that somebody put there since are left as they are.
    """
    for pending in sorted(first.parent.glob(f".*.{_PENDING}-*")):
        if is_left_behind(pending, first, _PENDING):
            _settle(pending, first)
    clean_stale(first)


def _place(pending: Path, first: Path, others: Sequence[str]) -> None:
    folder = first.parent
    for name in others:
        if (folder / name).exists():
            os.rename(folder / name, pending / _OLD / name)
    for name in [*others, first.name] if not first.exists() else [first.name, *others]:
        move_into_place(pending / name, folder / name)


def _settle(pending: Path, first: Path) -> None:
    folder, source = first.parent, pending
    if (pending / first.name).exists():
        source = pending / _OLD
    elif not first.exists() or sha256(first) != (pending / _SIGN).read_text(encoding="utf-8"):
        source = None
    for entry in [] if source is None else sorted(source.iterdir()):
        if entry.is_file() and entry.name != _SIGN:
            move_into_place(entry, folder / entry.name)
    remove_directory(pending, first)
