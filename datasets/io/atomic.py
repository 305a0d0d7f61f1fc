"""Directories and files that appear under their final name only when they are complete.

Unfinished output has the name `.<name>.partial-<pid>-<host>-<random>` in the same folder. A killed process leaves only
that behind, and the next process that writes the same output removes it.
"""

from __future__ import annotations

import errno
import filecmp
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...schemas import UsageError
from ...schemas.regular_files import require_regular_file
from .free_space import enough_room
from .neighbours import PARTIAL, REPLACED, alive, clean_stale, host, remove, sibling
from .outputs import DirectoryKind, FileKind, about_to_place, inside_output, may_repeat, refuse_output, write_record
from .places import require_place

_LOST = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""Errors of a flush after which the written bytes are lost."""


@contextmanager
def new_directory(path: Path | str, kind: DirectoryKind, overwrite: bool = False) -> Iterator[Path]:
    """Yield an empty directory that takes the name `path` when the block ends without an exception.

    Args:
        path: Final path; parent directories are made.
        kind: What the directory is; only the same kind is replaced.
        overwrite: Replace an existing directory. It disappears only after the new one is complete.

    Raises:
        UsageError: Before anything is written, see :func:`refuse_output`.
        NotEnoughSpaceError: If the disk is full.
    """
    path = Path(path)
    require_place(path)
    clean_stale(path)
    refuse_output(path, kind, overwrite)
    with enough_room(path, f"the {kind}"):
        temporary = _temporary(path)
        try:
            temporary.mkdir()  # inside, so that a signal that arrives right after it still removes it
            with inside_output():
                yield temporary
            write_record(temporary, kind)
            sync_tree(temporary)
            _put_in_place(temporary, path, kind, overwrite)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise


@contextmanager
def new_file(path: Path | str, kind: FileKind, overwrite: bool = False) -> Iterator[Path]:
    """Yield the path of a file to write, which takes the name `path` when the block ends without an exception.

    The temporary name ends with the suffix of `path`, for writers that choose their format by it.

    Args:
        path: Final path; parent directories are made.
        kind: What the file is; only the same kind is replaced.
        overwrite: Replace an existing file.

    Raises:
        UsageError: Before anything is written, if `path` is a directory, and see :func:`refuse_output`. A file that
            the same command writes with the same bytes again is refused only if these differ.
        NotEnoughSpaceError: If the disk is full.
    """
    path = Path(path)
    repeated = not overwrite and may_repeat(path, kind)
    refuse_output(path, kind, overwrite or repeated)
    with enough_room(path, f"the {kind}"), replaced_file(path) as temporary:
        yield temporary
        same = repeated and path.is_file() and filecmp.cmp(temporary, path, shallow=False)
        refuse_output(path, kind, overwrite or same)
        about_to_place(temporary, path)


@contextmanager
def replaced_file(path: Path | str) -> Iterator[Path]:
    """Yield the path of a file to write, which takes the name `path`, as :func:`new_file` does, whatever is there.

    For files inside of cgwm's own outputs; a name that a user chose goes through :func:`new_file`.

    Raises:
        UsageError: Before anything is written, if `path` is a directory.
        NotEnoughSpaceError: If the disk is full.
    """
    path = Path(path)
    require_place(path)
    if path.is_dir():
        raise UsageError(f"{path} is a directory; a file is written here.", todo="choose another name.")
    clean_stale(path)
    with enough_room(path, "it"):
        temporary = _temporary(path, path.suffix)
        try:
            yield temporary
            _sync(temporary)
            os.replace(temporary, path)
            _sync(path.parent)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def scratch_file(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file next to `path`, which is removed at the end unless it was moved before.

    For output that takes several steps to complete: :func:`move_into_place` gives the file its final name.

    Raises:
        NotEnoughSpaceError: If the disk is full.
    """
    require_place(path)
    clean_stale(path)
    with enough_room(path, "it"):
        temporary = _temporary(path, path.suffix)
        try:
            yield temporary
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def temporary_directory(purpose: str, content: str) -> Iterator[Path]:
    """Yield an empty directory in the system's temporary folder, which is removed at the end.

    What a killed process left there is removed by the next one with the same purpose.

    Args:
        purpose: Part of its name.
        content: What is written there, for messages.

    Raises:
        NotEnoughSpaceError: If the disk of the temporary folder is full.
    """
    path = Path(tempfile.gettempdir()) / f"cgwm-{purpose}"
    clean_stale(path)
    todo = "make room there, or set TMPDIR to another folder, and run the command again."
    with enough_room(path.parent, content, todo):
        temporary = _temporary(path)
        try:
            temporary.mkdir(mode=0o700)
            yield temporary
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def move_into_place(temporary: Path, path: Path) -> None:
    """Give a complete file its final name, replacing an existing file atomically."""
    _sync(temporary)
    os.replace(temporary, path)
    _sync(path.parent)


def remove_directory(directory: Path, path: Path) -> None:
    """Remove a hidden neighbour of `path`; what a kill leaves of it is an unfinished output, and never half of it."""
    aside = sibling(path, PARTIAL)
    os.rename(directory, aside)
    shutil.rmtree(aside, ignore_errors=True)


def leftovers(folder: Path, names: re.Pattern[str]) -> tuple[list[Path], list[Path]]:
    """Find unfinished outputs in a folder whose names match: those of dead processes, and those that may be alive.

    Only the processes of this machine are known; output of other machines of a cluster may be in use.
    """
    dead: list[Path] = []
    unknown: list[Path] = []
    for entry in sorted(folder.glob(f".*.{PARTIAL}-*")):
        match = re.fullmatch(rf"\.(.+)\.{PARTIAL}-(\d+)-([0-9a-f]{{8}})-[^-]*", entry.name)
        if match is not None and names.fullmatch(match[1]):
            (dead if match[3] == host() and not alive(int(match[2])) else unknown).append(entry)
    return dead, unknown


def sha256(path: Path | str) -> str:
    """Return the SHA-256 (hex) of a file, or of the sorted relative names and hashes of the files in a directory.

    Raises:
        InputDataError: If a file cannot be read.
    """
    path = Path(path)
    digest = hashlib.sha256()
    if path.is_dir():
        for name in _files(path):
            digest.update(f"{name.as_posix()}\0{sha256(path / name)}\n".encode())
        return digest.hexdigest()
    with require_regular_file(path).open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def copy_files(source: Path, target: Path) -> None:
    """Copy the files of a directory, those that :func:`sha256` counts, into a new one: no broken link, no pipe."""
    target.mkdir()
    for name in _files(source):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / name, target / name)


def _files(folder: Path) -> list[Path]:
    """Return the relative names of the files in a directory and below, sorted."""
    return [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]


def _temporary(path: Path, suffix: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return sibling(path, PARTIAL, suffix)


def _put_in_place(temporary: Path, path: Path, kind: DirectoryKind, overwrite: bool) -> None:
    """Give a complete directory its final name, unless another process has just given it to another one."""
    about_to_place(temporary, path)
    before = _inode(path)
    if before is None:
        _rename_unless_taken(temporary, path)
        return
    try:
        refuse_output(path, kind, overwrite)
    except (OSError, UsageError):
        if _inode(path) != before:
            raise _taken(path) from None
        raise
    aside = sibling(path, REPLACED)
    try:
        try:
            os.rename(path, aside)
        except FileNotFoundError:
            raise _taken(path) from None
        _rename_unless_taken(temporary, path)
    except BaseException:
        if _inode(path) is None and _inode(aside) is not None:
            os.rename(aside, path)
        raise
    finally:
        if _inode(path) is not None:  # else it is all that is left of the old output
            remove(aside)


def _rename_unless_taken(temporary: Path, path: Path) -> None:
    try:
        os.rename(temporary, path)
    except OSError:
        if _inode(path) is not None:
            raise _taken(path) from None
        raise
    _sync(path.parent)


def _taken(path: Path) -> UsageError:
    return UsageError(
        f"{path} was written by another command meanwhile, and nothing of this one is kept.",
        todo="choose another name, or run one of them at a time.",
    )


def _inode(path: Path) -> int | None:
    """Return the number by which what has a name is told from what had it before; None for nothing."""
    try:
        return path.lstat().st_ino
    except OSError:
        return None


def sync_tree(directory: Path) -> None:
    """Flush a directory and all that is in it to the disk."""
    for entry in directory.rglob("*"):
        if entry.is_file() or entry.is_dir():
            _sync(entry)
    _sync(directory)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno in _LOST:
            raise
        # some file systems cannot flush a directory; the rename is atomic all the same
    finally:
        os.close(descriptor)
