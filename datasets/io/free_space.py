"""Errors of a full disk while output is written."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...schemas import NotEnoughSpaceError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def enough_room(place: Path, what: str) -> Iterator[None]:
    """Convert the error of a full disk, quota or size limit to one that names the output.

    Args:
        place: The output.
        what: The part of it that is written.

    Raises:
        NotEnoughSpaceError: If the disk is full; the block has removed unfinished output by then.
    """
    try:
        yield
    except (OSError, NotEnoughSpaceError) as error:
        cause = error.__cause__ if isinstance(error, NotEnoughSpaceError) else error
        if not isinstance(cause, OSError) or cause.errno not in _FULL:
            raise
        raise NotEnoughSpaceError(
            f"{place}: no room for {what}: {os.strerror(cause.errno)}. What was unfinished is removed.",
            "what df, quota and ulimit -f leave.",
            "make room, or choose another --out, and run the command again; what is complete is still there.",
        ) from None
