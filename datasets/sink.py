"""A file that HDF5 writes to without ever being told that the disk is full."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..schemas import DiskFullError

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Sink(io.FileIO):
    """A file opened for writing and reading that remembers its first fault instead of raising it.

    HDF5 cannot recover from a failed write: closing the file fails as well, errors of single arrays are swallowed, and
    the process dies of a segmentation fault when it ends (HDF5 2.0). So it is told that all went well, and whoever
    writes asks :meth:`check` after each piece of work and at the end. What was written by then is of no use.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.fault: OSError | None = None

    def write(self, data: memoryview) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Write all of `data`, or remember why not."""
        rest = memoryview(data)
        try:
            while rest and self.fault is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.fault = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Set the file's length, or remember why not."""
        return self._remembered(lambda: io.FileIO.truncate(self, size), size or 0)

    def readinto(self, buffer: memoryview) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Read, and fill with zeros what was never written."""
        found = self._remembered(lambda: io.FileIO.readinto(self, buffer) or 0, 0)
        view = memoryview(buffer)
        view[found:] = bytes(len(view) - found)
        return len(view)

    def check(self) -> None:
        """Raise what went wrong, an OSError."""
        if self.fault is not None:
            raise self.fault

    def _remembered(self, action: Callable[[], int], otherwise: int) -> int:
        try:
            return action() if self.fault is None else otherwise
        except OSError as error:
            self.fault = error
            return otherwise


@contextmanager
def enough_room(place: Path, what: str) -> Iterator[None]:
    """Turn a full disk, quota or size limit into the error that says so.

    Args:
        place: The output that is being made.
        what: What is written of it.

    Raises:
        DiskFullError: If there was no room. The block has removed what was unfinished by then.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        raise DiskFullError(
            f"{place}: no room for {what}: {os.strerror(error.errno)}. What was unfinished is removed.",
            "what df, quota and ulimit -f leave.",
            "make room, or choose another --out, and run the command again; what is complete is still there.",
        ) from None
