"""Lock of a directory of unfinished work, so that one process at a time writes it."""

from __future__ import annotations

from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # no POSIX: two processes are not told apart there
    fcntl = None

NAME = "lock"
"""File in the directory that the writing process holds; the system lets go when the process ends, however it does."""


class DirectoryLock:
    """Lock of a directory that exists when it is held."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._file: IO[str] | None = None

    def hold(self) -> bool:
        """Hold the directory for this process, and return whether no other one does."""
        if fcntl is None:
            return True
        if self._file is None:
            self._file = (self._directory / NAME).open("a", encoding="utf-8")
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            self.release()
            return False
        except OSError:  # a file system without locks
            return True
        return True

    def release(self) -> None:
        """Let go of the directory, if it is held."""
        if self._file is not None:
            self._file.close()
            self._file = None
