"""Interrupts: what SIGINT, SIGTERM and SIGHUP do while a command starts, works and ends.

| the command | a signal |
| --- | --- |
| starts: nothing is written yet | ends the process at once, with exit code 130 |
| works | raises KeyboardInterrupt, again and again if something swallows it, so that unfinished output is removed |
| ends: its result stands, or its error is printed | changes nothing; the process has `GRACE_S` to end by itself |

Before the first line of cgwm runs, a signal does what Python's start makes of it. This module is loaded before all
others of the command, so it imports nothing that takes time.
"""

from __future__ import annotations

import _signal as signal  # pyright: ignore[reportMissingImports]  (signal wraps it in enums, which takes time)
import atexit
import os
import sys

TYPE_CHECKING = False  # as in typing, whose import takes longer than everything here
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType, TracebackType
    from typing import Any, NoReturn, Self

INTERRUPTED = 130
REPEAT_S = 0.5
"""Time between an interrupt and the check whether some code has swallowed it [s]."""
GRACE_S = 10.0
"""Time that a process has to end after a signal when its work is done [s]."""
NOTHING_WRITTEN = "Interrupted; no output was written."
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGALRM")
_STARTS, _WORKS, _ENDS = range(3)


class _Command:
    """The one command that the process runs: signals belong to the process."""

    phase = _STARTS
    interrupted = False
    """Whether a signal has interrupted it."""
    late = False
    """Whether a signal came while it ended."""
    told = False
    """Whether the user was told of the interrupt."""
    code = INTERRUPTED
    """Exit code of a process that does not end by itself."""


_now = _Command()


class caught:
    """Handle signals inside of the block, which runs one command.

    Args:
        owned: Whether the process ends with the command. If not, it is interrupted by exceptions alone, and the
            handlers are put back at the end.
    """

    def __init__(self, owned: bool) -> None:
        self._owned = owned
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        _now.phase, _now.interrupted, _now.late, _now.told = _STARTS if self._owned else _WORKS, False, False, False
        for name, number in _numbers():
            handler = _again if name == "SIGALRM" else _interrupt
            try:
                self._before[number] = signal.signal(number, handler)
            except ValueError:  # not in the main thread
                return self
        if self._owned:
            atexit.register(_ignore)  # the first to be registered is the last to run
            sys.unraisablehook = _unless_interrupt(sys.unraisablehook)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._owned:
            _set_alarm(0.0)
            for number, handler in self._before.items():
                if handler is not None:  # it was set by other code than Python's
                    signal.signal(number, handler)


def was_interrupted() -> bool:
    """Return whether a signal has interrupted the work; a library may have converted its exception."""
    return _now.interrupted


def was_told() -> bool:
    """Return whether this was asked before for this command: its user is told of an interrupt once."""
    before, _now.told = _now.told, True
    return before


def begin_work() -> None:
    """Let signals raise KeyboardInterrupt from now on; one that came while the last work ended does so at once."""
    _now.phase = _WORKS
    if _now.late:
        _now.late = False
        signal.raise_signal(signal.SIGINT)


def end_work(code: int = INTERRUPTED) -> None:
    """Let signals change nothing from now on.

    Args:
        code: Exit code of a process that a signal has to end because it does not end by itself.
    """
    _now.phase, _now.code = _ENDS, code
    if not _now.late:
        _set_alarm(0.0)


def leave(code: int) -> NoReturn:
    """End the process without waiting for threads: a thread whose start was interrupted may never end."""
    end_work(code)
    try:
        atexit._run_exitfuncs()
    except BaseException:
        pass
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            pass
    os._exit(code)


def _numbers() -> list[tuple[str, int]]:
    """Return the signals of this system, without those that the parent process set to be ignored (nohup, a job)."""
    found = [(name, number) for name in _SIGNALS if (number := getattr(signal, name, None)) is not None]
    return [(name, number) for name, number in found if signal.getsignal(number) != signal.SIG_IGN]


def _interrupt(number: int, frame: FrameType | None) -> None:
    if _now.phase == _ENDS:
        if not _now.late:
            _now.late = True
            _set_alarm(GRACE_S)
        return
    _now.interrupted = True
    if _now.phase == _STARTS:
        try:
            os.write(2, f"{NOTHING_WRITTEN}\n".encode())
        finally:
            os._exit(INTERRUPTED)
    _set_alarm(REPEAT_S)
    raise KeyboardInterrupt


def _again(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt again if the one before was swallowed, and leave the code that cleans up alone.

    An interrupt is lost where Python cannot raise it (in a finalizer, a weak reference's callback) and where a library
    catches everything. While it propagates, `finally`, `except` and `__exit__` run with it as the handled exception.
    """
    if _now.phase == _ENDS:
        os._exit(_now.code)
    _set_alarm(REPEAT_S)
    error = sys.exc_info()[1]
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return
        error = error.__cause__ or error.__context__
    raise KeyboardInterrupt


def _ignore() -> None:
    """Ignore signals while the interpreter is taken down, where Python puts back the action that kills."""
    _set_alarm(0.0)
    for _, number in _numbers():
        signal.signal(number, signal.SIG_IGN)


def _unless_interrupt(hook: Callable[[Any], object]) -> Callable[[Any], object]:
    """Return a hook for exceptions that cannot be raised, without the interrupts, which come again."""

    def report(unraisable: Any) -> None:
        if not (_now.interrupted and issubclass(unraisable.exc_type, KeyboardInterrupt)):
            hook(unraisable)

    return report


def _set_alarm(seconds: float) -> None:
    """Schedule SIGALRM after a number of seconds; zero cancels it. There is no SIGALRM on Windows."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)
