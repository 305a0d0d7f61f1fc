"""Files in directories that users fill."""

from __future__ import annotations

import os
from pathlib import Path


def files_under(folder: Path) -> list[str]:
    """Return the sorted relative names of all files under a directory except hidden ones; links are followed."""
    names: list[str] = []
    seen: set[str] = set()
    for place, folders, files in os.walk(folder, followlinks=True):
        seen.add(os.path.realpath(place))
        # A link to a directory that was visited already would lead round in circles.
        folders[:] = [f for f in folders if f[0] != "." and os.path.realpath(Path(place, f)) not in seen]
        names += [Path(place, file).relative_to(folder).as_posix() for file in files if file[0] != "."]
    return sorted(names)
