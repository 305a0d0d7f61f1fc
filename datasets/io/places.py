"""Names and folders under which output can be written, looked up before the work starts."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from ...schemas import UsageError

LONGEST_NAME = 200
"""Maximum length of an output's name [bytes]: file systems take 255, and the unfinished output has a longer name."""
_LONGEST_PART = 255
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_ANOTHER = "choose another name for the output."


def require_place(path: Path | str) -> None:
    """Refuse an output that cannot be made under its name, before the work for it.

    Raises:
        UsageError: If the name is too long or holds a control character, or the folder that is to hold it is a file
            or cannot be written to.
    """
    path = Path(path)
    strange = _CONTROL.search(str(path))
    if strange is not None:
        raise UsageError(f"{str(path)!r}: a name with the control character {strange[0]!r}.", todo=_ANOTHER)
    for part in path.parent.parts:
        _require_short(part, _LONGEST_PART)
    _require_short(path.name, LONGEST_NAME)
    folder = _nearest(path.parent)
    if not folder.is_dir():
        raise UsageError(f"{path}: {folder} is a file, and no folder.", "a name in a folder.", _ANOTHER)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UsageError(
            f"{path}: the folder {folder} cannot be written to.", "a folder of your own, on a disk that is writable.",
            f"{_ANOTHER[:-1]}, or check the permissions of that folder.",
        )  # fmt: skip


def _require_short(name: str, most: int) -> None:
    size = len(os.fsencode(name))
    if size > most:
        raise UsageError(f"{name[:40]}...: a name of {size} bytes.", f"at most {most} bytes.", _ANOTHER)


def _nearest(folder: Path) -> Path:
    """Return the nearest of a folder and those above it that exists."""
    for one in (folder, *folder.parents):
        try:
            one.stat()
        except PermissionError:
            continue
        except OSError:
            if stat.S_ISLNK(_mode(one)):
                raise UsageError(f"{folder}: {one} is a link that leads nowhere.", todo=_ANOTHER) from None
            continue
        return one
    return Path(os.curdir)


def _mode(path: Path) -> int:
    try:
        return path.lstat().st_mode
    except OSError:
        return 0
