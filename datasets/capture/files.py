"""Files in directories that users fill: whatever stands there is returned or refused, and nothing is passed over."""

from __future__ import annotations

import os
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path

from ...schemas import InputDataError
from ...schemas.regular_files import require_regular_file
from ..io.atomic import sha256

MOST_FILES = 1_000_000
"""Maximum number of files under a directory: links to directories multiply, and may do so without end."""
_UNPRINTABLE = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories that no name has: control characters, bytes that are no UTF-8, ends of lines."""


def optional_file(path: Path) -> Path | None:
    """Return the path of a regular, readable file, or None if nothing has that name.

    Raises:
        InputDataError: If something has that name and is no such file, such as a link that leads nowhere; or if the
            directory that should contain it is none.
    """
    if os.path.lexists(path):
        return require_regular_file(path)
    has_folder(path.parent)
    return None


def has_folder(path: Path) -> bool:
    """Return whether there is a directory of that name; links to one are followed.

    Raises:
        InputDataError: If something has that name and is no directory that can be listed.
    """
    if path.is_dir():
        if not os.access(path, os.R_OK | os.X_OK):
            raise InputDataError(f"{path}: cannot be listed: Permission denied.", todo="check its permissions.")
        return True
    if os.path.lexists(path):
        require_regular_file(path)  # tells what else it is: a link that leads nowhere or in circles, a named pipe
        raise InputDataError(f"{path}: is a file.", "a directory.", "move it away, or put the directory there.")
    return path != path.parent and path.parent != Path() and not path.parent.is_dir() and has_folder(path.parent)


def entries_of(folder: Path) -> list[Path]:
    """Return everything in a directory except hidden entries, sorted; nothing if there is no such directory.

    Raises:
        InputDataError: If it is no directory, or a name in it contains a control character.
    """
    if not has_folder(folder):
        return []
    try:
        found = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise InputDataError(f"{folder}: cannot be listed: {error.strerror}.", todo="check its permissions.") from None
    for path in found:
        require_printable(path.name, f"{folder}: the name")
    return sorted(found)


def files_under(folder: Path, suffixes: Collection[str] = ()) -> list[str]:
    """Return the sorted relative names of all files under a directory, except hidden ones.

    Links to directories are followed, except those back to a directory around them, whose files are found already.

    Args:
        folder: The directory, which may be absent.
        suffixes: Those of the files that are wanted, in lower case; a directory with such a name is returned like a
            file.

    Raises:
        InputDataError: As `entries_of`. What is no regular file, such as a link that leads nowhere, is returned, for
            its reader to refuse it by name.
    """
    names: list[str] = []
    places: list[tuple[Path, tuple[str, ...]]] = [(folder, (os.path.realpath(folder),))]
    while places:
        place, within = places.pop()
        for path in entries_of(place):
            if path.suffix.lower() in suffixes or not path.is_dir():
                names.append(path.relative_to(folder).as_posix())
            elif (real := os.path.realpath(path)) not in within:
                places.append((path, (*within, real)))
        if len(names) > MOST_FILES or len(places) > MOST_FILES:
            raise InputDataError(f"{folder}: more than {MOST_FILES} files.", f"{MOST_FILES}.", "remove some.")
    return sorted(names)


def repeated(paths: Iterable[Path]) -> dict[Path, Path]:
    """Return the files whose bytes are those of another one, each with that one, the shortest name first.

    Raises:
        InputDataError: If one is no regular file that can be read.
    """
    sized: dict[int, list[Path]] = defaultdict(list)
    for path in sorted(paths, key=lambda one: (len(one.name), one)):
        sized[require_regular_file(path).stat().st_size].append(path)
    found: dict[Path, Path] = {}
    for alike in sized.values():
        first: dict[str, Path] = {}
        for path in alike if len(alike) > 1 else ():
            earlier = first.setdefault(sha256(path), path)
            if earlier is not path:
                found[path] = earlier
    return found


def require_printable(name: str, where: str) -> None:
    """Refuse a name with control characters, with bytes that are no UTF-8, or with ends of lines.

    Args:
        name: The name.
        where: What it is and where it stands, for the message.

    Raises:
        InputDataError: If it contains one.
    """
    if any(unicodedata.category(character) in _UNPRINTABLE for character in name):
        raise InputDataError(
            f"{where} {name!a:.200} contains control characters or is no UTF-8.",
            "printable characters.",
            "rename it.",
        )
