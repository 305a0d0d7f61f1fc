"""Hidden neighbours of outputs: unfinished ones and old ones that make room, with the process that made them.

Their names are `.<name>.<kind>-<pid>-<host>-<random>`.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import socket
from pathlib import Path

PARTIAL = "partial"
REPLACED = "replaced"


def sibling(path: Path, kind: str, suffix: str = "") -> Path:
    """Return the name of a hidden neighbour of `path`, which tells what it is and which process made it."""
    name = path.name or path.resolve().name
    return path.parent / f".{name}.{kind}-{os.getpid()}-{host()}-{secrets.token_hex(4)}{suffix}"


def host() -> str:
    """Return the scope in which process numbers are unique: the machine, and the container if it has its own."""
    try:
        counted = os.readlink("/proc/self/ns/pid")
    except OSError:
        counted = ""
    return hashlib.sha256(f"{socket.gethostname()} {counted}".encode()).hexdigest()[:8]


def clean_stale(path: Path) -> None:
    """Remove unfinished outputs of dead processes of this machine for `path`, and restore a displaced old output."""
    name = path.name or path.resolve().name
    for entry in sorted(path.parent.glob(f".{_glob_escape(name)}.*-*")):
        if is_left_behind(entry, path, REPLACED) and not os.path.lexists(path):
            os.rename(entry, path)
        elif is_left_behind(entry, path, f"{PARTIAL}|{REPLACED}"):
            remove(entry)


def is_left_behind(entry: Path, path: Path, kinds: str) -> bool:
    """Return whether a hidden neighbour of `path` is of one of these kinds, and of a dead process of this machine."""
    name = path.name or path.resolve().name
    match = re.fullmatch(rf"\.{re.escape(name)}\.(?:{kinds})-(\d+)-(?:([0-9a-f]{{8}})-)?[^-]*", entry.name)
    # On a shared file system the process may live on another machine, where its number says nothing here.
    return match is not None and not alive(int(match[1])) and match[2] in (None, host())


def _glob_escape(name: str) -> str:
    return re.sub(r"([*?[])", r"[\1]", name)


def alive(pid: int) -> bool:
    """Return whether a process of this machine runs."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def remove(path: Path) -> None:
    """Remove a file, link or directory, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
