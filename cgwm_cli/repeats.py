"""Commands that are typed twice: the request by which an existing output is recognised as their result."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

REMEMBERED = frozenset({"import-capture", "demo", "export", "mask", "merge"})
"""Verbs whose output records its request. A fit and a dataset tell themselves what they were made of."""
_MANNERS = frozenset({"out", "overwrite", "resume", "trust_effects", "json", "quiet", "debug"})
"""Options that do not change what is written."""
_WHOLE_BYTES = 1 << 23
"""Maximum size of the files that are read whole; of larger ones the size, the beginning and the end count."""
_END_BYTES = 1 << 20


def request_of(verb: str, options: Mapping[str, Any]) -> str:
    """Return the digest of a verb, its settings and the content of its inputs; empty for verbs that record none."""
    if verb not in REMEMBERED:
        return ""
    out = options.get("out")
    wanted = {name: _told(value, out) for name, value in options.items() if name not in _MANNERS}
    return hashlib.sha256(json.dumps([verb, wanted], sort_keys=True, default=str).encode()).hexdigest()


def _told(value: Any, out: Path | None) -> Any:
    if isinstance(value, list | tuple):
        return [_told(one, out) for one in value]
    if not isinstance(value, Path):
        return value
    # a device has no end, and a pipe no second reading
    return f"sha256 {_content(value, out)}" if value.is_file() or value.is_dir() else str(value)


def _content(path: Path, out: Path | None) -> str:
    """Return a digest of a file, or of the names and contents of the files in a directory, without its own output."""
    from ..schemas.regular_files import require_regular_file

    digest = hashlib.sha256()
    files = [path]
    if path.is_dir():
        own = None if out is None else path / os.path.relpath(out, path)  # masks of a capture lie in it
        files = sorted(one for one in path.rglob("*") if one.is_file() and (own is None or own not in one.parents))
    for file in files:
        size = file.stat().st_size
        digest.update(f"{file.relative_to(path).as_posix()}\0{size}\0".encode())
        with require_regular_file(file).open("rb") as stream:
            if size <= _WHOLE_BYTES:
                digest.update(stream.read())
                continue
            digest.update(stream.read(_END_BYTES))
            stream.seek(size - _END_BYTES)
            digest.update(stream.read())
    return digest.hexdigest()
