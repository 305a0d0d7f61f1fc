"""Room on the disk, for what appears complete or not at all."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..schemas import NotEnoughSpaceError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def enough_room(place: Path, what: str) -> Iterator[None]:
    """Turn a full disk, quota or size limit into the error that says what was being made.

    Args:
        place: The output.
        what: What is written of it.

    Raises:
        NotEnoughSpaceError: If there was no room. The block has removed what was unfinished by then.
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
