"""A file for HDF5 whose errors are kept for the writer instead of being reported to HDF5.

HDF5 cannot close a file after a failed write: on a full disk h5py 3.16 crashes the process at its exit.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py


class GuardedFile(io.RawIOBase):
    """A file object for h5py's driver `fileobj`.

    Attributes:
        error: Error of the first failed write; later data are lost, and the file is invalid.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0), 0o666)
        self._place = 0
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all data at the current position."""
        view = memoryview(data).cast("B")
        size = len(view)
        try:
            os.lseek(self._descriptor, self._place, os.SEEK_SET)
            while self.error is None and len(view):
                view = view[os.write(self._descriptor, view) :]
        except OSError as error:
            self.error = error
        self._place += size
        return size

    def readinto(self, buffer: Any) -> int:
        """Read at the current position; zeros after the end of the file."""
        view = memoryview(buffer).cast("B")
        os.lseek(self._descriptor, self._place, os.SEEK_SET)
        done = 0
        while done < len(view) and (part := os.read(self._descriptor, len(view) - done)):
            view[done : done + len(part)] = part
            done += len(part)
        view[done:] = bytes(len(view) - done)
        self._place += len(view)
        return len(view)

    def seek(self, place: int, origin: int = os.SEEK_SET) -> int:
        """Move to a position of the file."""
        if origin == os.SEEK_END:
            place += os.fstat(self._descriptor).st_size
        self._place = place + (self._place if origin == os.SEEK_CUR else 0)
        return self._place

    def tell(self) -> int:
        """Return the current position."""
        return self._place

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file."""
        length = self._place if size is None else size
        try:
            os.ftruncate(self._descriptor, length)
        except OSError as error:
            self.error = self.error or error
        return length

    def close(self) -> None:
        """Close the file."""
        if not self.closed:
            os.close(self._descriptor)
        super().close()


@contextmanager
def written_hdf5(path: Path) -> Iterator[h5py.File]:
    """Write an HDF5 file; pass a temporary path.

    Raises:
        OSError: If the file cannot be written, as on a full disk.
    """
    guarded = GuardedFile(path)
    try:
        with h5py.File(guarded, "w", track_order=False) as file:
            yield file
    finally:
        guarded.close()
        if guarded.error is not None:
            raise guarded.error
