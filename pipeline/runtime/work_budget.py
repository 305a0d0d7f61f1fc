"""Work, memory and disk that a command needs, estimated from counts before it starts.

What would take more than an hour is warned of, with the counts that make it long. What cannot be finished is refused:
more than 30 days, more memory than the machine has, more bytes than the disk has room for. The estimates are good to a
factor of about 3 (`docs/scale.md`); the limits leave room for that.
"""

from __future__ import annotations

import logging
import math
import os
import resource
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from ...schemas import UsageError

SLOW_S = 3600.0
"""Estimated duration from which a command warns [s]."""
ENDLESS_S = 30 * 86400.0
"""Estimated duration from which a command is refused [s]."""
_CONTAINER = Path("/sys/fs/cgroup/memory.max")
_UNITS = ((365.25 * 86400, "years"), (86400.0, "days"), (3600.0, "h"), (60.0, "min"), (0.0, "s"))
_SHOWN = 3

_inside: ContextVar[bool] = ContextVar("inside_a_checked_command", default=False)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a command's work."""

    what: str
    """What is done, with the counts that make it long."""
    seconds: float = 0.0
    """Estimated duration on this machine [s]."""
    memory_bytes: float = 0.0
    """Lower bound of the memory that it needs at once [bytes]."""
    disk_bytes: float = 0.0
    """Lower bound of what it writes [bytes]."""


@contextmanager
def within_budget(
    parts: Sequence[Part], less: str, out: Path | None = None, doubt: str = "", endless_s: float = ENDLESS_S
) -> Iterator[None]:
    """Refuse work that this machine cannot finish, and warn of work that takes long; checks inside are left out.

    Args:
        parts: The parts of the work.
        less: Advice that reduces it.
        out: Where the output is written; None if nothing large is.
        doubt: A likely mistake that would explain so much work, as a question.
        endless_s: Duration from which the work is refused [s].

    Raises:
        UsageError: If it cannot be finished, with the numbers.
    """
    if not _inside.get():
        _check(parts, less, out, doubt, endless_s)
    token = _inside.set(True)
    try:
        yield
    finally:
        _inside.reset(token)


def _check(parts: Sequence[Part], less: str, out: Path | None, doubt: str, endless_s: float) -> None:
    todo = f"{doubt} Otherwise {less}" if doubt else less
    memory, limit = sum(part.memory_bytes for part in parts), memory_limit()
    if memory > limit:
        heaviest = max(parts, key=lambda part: part.memory_bytes)
        raise UsageError(
            f"{heaviest.what}: this needs {data_size(memory)} of memory or more.",
            f"what this machine has: {data_size(limit)}.",
            todo,
        )
    disk = sum(part.disk_bytes for part in parts)
    if out is not None and disk > (free := _free_bytes(out)):
        largest = max(parts, key=lambda part: part.disk_bytes)
        raise UsageError(
            f"{largest.what}: this writes {data_size(disk)} or more.",
            f"what the disk of {out} has free: {data_size(free)}.",
            f"{todo.removesuffix('.')}, or make room there.",
        )
    seconds = sum(part.seconds for part in parts)
    if seconds > endless_s:
        raise UsageError(
            f"this would take about {duration(seconds)} on this machine: {_made_of(parts)}.",
            f"work of {duration(endless_s)} at most.",
            todo,
        )
    if seconds > SLOW_S:
        logging.getLogger("cgwm").warning(
            "this takes about %s on this machine: %s. %s", duration(seconds), _made_of(parts), todo
        )


def duration(seconds: float) -> str:
    """Return a duration in the largest unit of which it has one or more.

    >>> duration(42), duration(10_900.0), duration(1e12)
    ('42 s', '3 h', '32,000 years')
    """
    if not math.isfinite(seconds):
        return "forever"
    size, unit = next((size, unit) for size, unit in _UNITS if seconds >= size)
    return f"{_rounded(seconds / (size or 1.0))} {unit}"


def data_size(count: float) -> str:
    """Return a number of bytes in the largest unit of which it has one or more.

    >>> data_size(1536), data_size(3e13)
    ('1.5 KiB', '27 TiB')
    """
    power = min(max(int(math.log2(max(count, 1.0)) // 10), 0), 6)
    return f"{_rounded(count / 1024**power)} {('bytes', 'KiB', 'MiB', 'GiB', 'TiB', 'PiB', 'EiB')[power]}"


def motion_doubt(durations_s: Sequence[float], longest_plausible_s: float = 60.0) -> str:
    """Return the question whether times are in milliseconds, for recorded motion that lasts long; else nothing."""
    longest = max(durations_s, default=0.0)
    return f"an episode lasts {duration(longest)}: are the times in ms?" if longest > longest_plausible_s else ""


def memory_limit() -> float:
    """Return the memory that this process may use [bytes]: of the machine with its swap, its container, its limits."""
    limits = [_physical_bytes()]
    try:
        limits.append(float(_CONTAINER.read_text(encoding="ascii")))
    except (OSError, ValueError):
        pass  # no container, or one without a limit ("max")
    soft = resource.getrlimit(resource.RLIMIT_AS)[0]
    return min([*limits, math.inf if soft == resource.RLIM_INFINITY else float(soft)])


def _rounded(value: float) -> str:
    """Return a number with two digits that count."""
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 10 else f"{value:.2g}"


def _physical_bytes() -> float:
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (OSError, ValueError, AttributeError):
        return math.inf


def _free_bytes(out: Path) -> float:
    folder = out.absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        return float(shutil.disk_usage(folder).free)
    except OSError:
        return math.inf


def _made_of(parts: Sequence[Part]) -> str:
    """Return the longest parts with their durations."""
    longest = sorted(parts, key=lambda part: -part.seconds)[:_SHOWN]
    return "; ".join(f"{duration(part.seconds)} for {part.what}" for part in longest if part.seconds > 0)
