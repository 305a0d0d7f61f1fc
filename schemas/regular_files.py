"""Reading of files that a user or a file names: anything that is no regular, readable file is refused unopened.

Opening a FIFO waits for a writer, and a device may never end, so the kind is looked up before.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path, PurePosixPath, PureWindowsPath

from .errors import InputDataError

MAX_BYTES = 1 << 30
"""Largest file that is read whole as text [bytes]."""
_KINDS = (
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_CHECK_DISK = "check the disk that it lies on, or copy the file to another."


def require_regular_file(path: Path | str) -> Path:
    """Return the path of a regular, readable file; links to one are followed.

    Raises:
        InputDataError: If there is no file, a link leads nowhere or in circles, or it is a directory, a named pipe, a
            socket, a device or not readable.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise InputDataError(f"{path}: {_reason(path, error)}.", "a regular file.", "check the path.") from None
    except ValueError:
        raise InputDataError(f"{str(path)!r}: not a path.", "a regular file.", "check the path.") from None
    kind = next((name for is_kind, name in _KINDS if is_kind(mode)), None)
    if kind is not None:
        raise InputDataError(f"{path}: is {kind}.", "a regular file.", "put the file there, or remove it.")
    if not os.access(path, os.R_OK):
        raise InputDataError(f"{path}: cannot be read: {os.strerror(errno.EACCES)}.", todo="check its permissions.")
    return path


def real_path(path: Path | str) -> Path:
    """Return the absolute path with all links followed; of links in circles, as far as they can be followed.

    `Path.resolve` raises RuntimeError for such links, which are to be refused where the file is opened.
    """
    return Path(os.path.realpath(path))


def leads_outside(name: str) -> bool:
    """Return whether a path, of any system, is absolute or may lead out of the folder that it is looked up in."""
    windows = PureWindowsPath(name)
    return bool(windows.anchor) or PurePosixPath(name).is_absolute() or ".." in windows.parts


def read_text_file(path: Path | str, encoding: str = "utf-8") -> str:
    """Return the text of a file.

    Raises:
        InputDataError: If it is no regular, readable file, larger than `MAX_BYTES`, or not text in that encoding.
    """
    path = require_regular_file(path)
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputDataError(
            f"{path}: {size / 2**30:.1f} GiB.",
            f"a text of at most {MAX_BYTES / 2**30:g} GiB.",
            "check that this is the right file.",
        )
    try:
        return path.read_text(encoding=encoding)
    except UnicodeDecodeError:
        raise InputDataError(
            f"{path}: not a text file in UTF-8.", todo="save it as UTF-8, or get the file again."
        ) from None
    except OSError as error:
        raise InputDataError(f"{path}: cannot be read: {error.strerror}.", todo=_CHECK_DISK) from None


def read_binary_file(path: Path | str, most_bytes: int = MAX_BYTES) -> bytes:
    """Return the bytes of a file.

    Raises:
        InputDataError: If it is no regular, readable file, or larger than `most_bytes`.
    """
    path = require_regular_file(path)
    size = path.stat().st_size
    if size > most_bytes:
        raise InputDataError(
            f"{path}: {size / 2**30:.1f} GiB.",
            f"a file of at most {most_bytes / 2**30:g} GiB.",
            "check that this is the right file.",
        )
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputDataError(f"{path}: cannot be read: {error.strerror}.", todo=_CHECK_DISK) from None


def _reason(path: Path, error: OSError) -> str:
    if error.errno == errno.ELOOP:
        return "a link that leads in circles"
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return f"a link to {os.readlink(path)}, which does not exist" if path.is_symlink() else "no such file"
    return f"cannot be read: {os.strerror(error.errno or errno.EIO)}"
