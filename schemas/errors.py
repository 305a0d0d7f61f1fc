"""The errors that users meet, each with the exit code that the command line ends with.

A message has three parts: what was found and where, what is allowed, what to do next.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path

from .printable import in_one_line


class InterruptedWork(KeyboardInterrupt):
    """An interrupt after which something is left; the message says what, and how to go on.

    The message of a plain KeyboardInterrupt says nothing to a user: a codec that is interrupted puts its own there.
    """


class CgwmError(Exception):
    """Base of every error that cgwm raises on purpose.

    Args:
        found: What was found, and where (file, line or field).
        allowed: What is allowed instead.
        todo: What to do next, with a command to type where there is one.
    """

    exit_code = 1

    def __init__(self, found: str, allowed: str = "", todo: str = "") -> None:
        found, allowed, todo = in_one_line(found), in_one_line(allowed), in_one_line(todo)
        self.found, self.allowed, self.todo = found, allowed, todo
        lines = [found]
        if allowed:
            lines.append(f"Allowed: {allowed}")
        if todo:
            lines.append(f"Next: {todo}")
        super().__init__("\n".join(lines))


class UsageError(CgwmError):
    """The command was called in a way that it cannot be (exit code 2)."""

    exit_code = 2


class OutputExistsError(UsageError):
    """An output exists and may not be replaced without being asked (exit code 2); `path` is its name."""

    def __init__(self, path: Path, todo: str = "choose another name or pass --overwrite.") -> None:
        super().__init__(f"{path} exists.", todo=todo)
        self.path = path


class InputDataError(CgwmError):
    """A file or field that the user gave is wrong (exit code 2)."""

    exit_code = 2


class SlowPlansError(InputDataError):
    """Plans take longer here than a task of control allows (exit code 2)."""


class NotConvergedError(CgwmError):
    """A fit, a calibration or a simulation failed to reach a usable result (exit code 1)."""


class NotEnoughMemoryError(CgwmError):
    """What was asked for needs more memory than there is (exit code 1)."""


class NotEnoughSpaceError(CgwmError):
    """What was asked for needs more room on the disk than there is (exit code 1)."""


class DamagedShardError(InputDataError):
    """A finished shard is not what it was when it was written (exit code 2)."""


class CheckFailedError(CgwmError):
    """A check found faults (exit code 1)."""


LONGEST_NAME = 100
"""Longest name that is compared with others [characters]; comparing takes time by its length."""


def did_you_mean(name: str, legal: Iterable[str]) -> str:
    """Return `` Did you mean 'x'?`` with the nearest legal name, or an empty string."""
    if len(name) > LONGEST_NAME:
        return ""
    bare = {one.lstrip("-"): one for one in legal}  # the dashes of options make all of them alike
    near = difflib.get_close_matches(name.lstrip("-"), bare, n=1, cutoff=0.5)
    return f" Did you mean '{bare[near[0]]}'?" if near else ""
