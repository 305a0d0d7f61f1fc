"""Where compiled kernels are kept: built once on a machine, and taken from there by every later command."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def built(recipe: str, suffix: str, build: Callable[[Path], Path], load: Callable[[Path], T]) -> T:
    """Build something, or take what an earlier process built of the same recipe, and load it.

    Args:
        recipe: All that the product depends on: source, compiler, options, machine.
        suffix: Of the file that is kept.
        build: Makes the product in an empty folder, and returns its path.
        load: Reads the product.
    """
    name = hashlib.sha256(recipe.encode()).hexdigest()[:32] + suffix
    kept = folder()
    if kept is not None and (kept / name).exists():
        return load(kept / name)
    # an interrupt kills the compiler, which then leaves what it had in its own temporary files: they lie here, too
    with tempfile.TemporaryDirectory(dir=kept, prefix="build-", ignore_cleanup_errors=True) as work:
        product = build(Path(work))
        if kept is None:
            return load(product)
        # in one step: other processes see all of it or nothing
        product.replace(kept / name)
    return load(kept / name)


def folder() -> Path | None:
    """Return where built kernels are kept; None where that cannot be written, or another user could."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    found = Path(base) / "cgwm" / "kernels"
    try:
        found.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = found.stat()
    except OSError:
        return None
    safe = status.st_uid == os.getuid() and not status.st_mode & 0o022
    return found if safe and os.access(found, os.W_OK) else None
