"""Errors of a full disk while output is written, whichever library reports them."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...schemas import CgwmError, NotEnoughSpaceError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_WORDS = re.compile(
    "no space left on device|disk quota exceeded|file too large|disk is full|[0-9]+ requested and [0-9]+ written", re.I
)
"""How libraries without error numbers say it: SQLite below COLMAP, numpy, HDF5, codecs."""
_AGAIN = "make room, or choose another --out, and run the command again; what is complete is still there."


@contextmanager
def enough_room(place: Path, what: str, todo: str = _AGAIN) -> Iterator[None]:
    """Convert the error of a full disk, quota or size limit to one that names the output.

    Args:
        place: The output.
        what: The part of it that is written.
        todo: Advice; left out, to make room or to write elsewhere.

    Raises:
        NotEnoughSpaceError: If the disk is full; the block has removed unfinished output by then.
    """
    try:
        yield
    except Exception as error:
        reason = full_disk(error)
        if reason is None:
            raise
        raise NotEnoughSpaceError(
            f"{place}: no room for {what}: {reason}. What was unfinished is removed.",
            "what df, quota and ulimit -f leave.",
            todo,
        ) from error


def full_disk(error: BaseException) -> str | None:
    """Return the words for a full disk, quota or size limit if an error, or one that it follows from, reports it."""
    if isinstance(error, OSError) and error.errno in _FULL:
        return os.strerror(error.errno)
    if isinstance(error, CgwmError):
        before = error.__cause__ if isinstance(error, NotEnoughSpaceError) else None
    elif _WORDS.search(str(error)):
        return os.strerror(errno.ENOSPC)
    else:
        before = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return None if before is None else full_disk(before)
