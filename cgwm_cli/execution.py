"""Execution of the verbs: signals, errors, exit codes, and a stdout that carries only the result."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import typer

if TYPE_CHECKING:
    from ..schemas import FileModel

INTERRUPTED = 130
REPEAT_S = 0.5
"""Time between an interrupt and the check whether some code has swallowed it."""
_interrupted = False
_typed: list[str] = []
_RAY_ADDRESS = re.compile(r"auto|local|ray://.+|[\w.-]+:\d+")


def run_command(load_app: Callable[[], Callable[..., Any]], arguments: list[str]) -> NoReturn:
    """Run the application that `load_app` imports with arguments, and end the process with its exit code."""
    _catch_signals()
    try:
        code = _invoke(load_app, arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        code = _say_interrupted()
    except BrokenPipeError:
        # the reader of our output has closed it ("cgwm ... | head"), so the exit code is the only message
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    if _interrupted:
        _leave(code)
    sys.exit(code)


Emit = Callable[["FileModel", Callable[[Any], str]], None]


@contextlib.contextmanager
def running(*, json: bool = False, quiet: bool = False, debug: bool = False) -> Iterator[Emit]:
    """Run the work of a verb, and turn any exception into one message on stderr and the right exit code.

    Yields a function that takes the result and a function that summarises it; the text is printed when the work is
    done. Progress, logs and the output of libraries go to stderr if that is a terminal; otherwise they are discarded.

    Raises:
        typer.Exit: With the exit code, if the work failed.
    """
    watched = _is_watched(quiet, debug)
    if not watched:
        _hush()
    printed: list[str] = []

    def emit(result: FileModel, summary: Callable[[Any], str]) -> None:
        if json:
            printed.append(result.model_dump_json(indent=2))
        elif not quiet:
            printed.append(summary(result))

    try:
        with _warnings_kept(discarded=watched or quiet), _stdout_for_results_only(watched):
            yield emit
        for text in printed:
            print(text, flush=True)
    except (typer.Exit, BrokenPipeError):
        raise
    except BaseException as error:
        if debug:
            traceback.print_exc()
        raise typer.Exit(_report(error, debug)) from None


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """Run work that an interrupt ends as it should end, such as a server."""
    try:
        yield
    except KeyboardInterrupt:
        _set_alarm(0.0)


def with_values(arguments: list[str]) -> list[str]:
    """Add the value of a `--ray` without one, because typer has no options with an optional value.

    >>> with_values(["synthesize", "--ray", "model", "--out", "data"])
    ['synthesize', '--ray', 'auto', 'model', '--out', 'data']
    """
    completed: list[str] = []
    for word, following in zip(arguments, [*arguments[1:], ""], strict=False):
        completed.append(word)
        if word == "--ray" and not _RAY_ADDRESS.fullmatch(following):
            completed.append("auto")
    return completed


def typed() -> list[str]:
    """Return the arguments that the command was called with."""
    return _typed


def _invoke(load_app: Callable[[], Callable[..., Any]], arguments: list[str]) -> int:
    _typed[:] = arguments
    try:
        return int(load_app()(with_values(arguments), prog_name="cgwm", standalone_mode=False) or 0)
    except Exception as error:
        # typer's errors are recognised by this method, because their classes are private since 0.26
        if not hasattr(error, "format_message"):
            raise
        from .usage import explain

        print(explain(error, arguments), file=sys.stderr)
        return 2


def _report(error: BaseException, debug: bool) -> int:
    if _interrupted or isinstance(error, KeyboardInterrupt):
        # recognised by its name, because the interrupt may have come while cgwm.schemas was imported
        return _say_interrupted(str(error) if type(error).__name__ == "InterruptedWork" else "")
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else 1
    from ..schemas import CgwmError

    if isinstance(error, CgwmError):
        print(error, file=sys.stderr)
        return error.exit_code
    print(_unforeseen(error, debug), file=sys.stderr)
    return 1


def _unforeseen(error: BaseException, debug: bool) -> str:
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror}."
    from ..pipeline.runtime.resources import ran_out_of_memory

    if ran_out_of_memory(error):
        return "Out of memory.\nNext: close other programs, or work on less at a time."
    if isinstance(error, ModuleNotFoundError) and not (error.name or "").startswith("cgwm"):
        return f"The package '{error.name}' is not installed.\nNext: run 'cgwm doctor', which prints the pip line."
    hint = "" if debug else "\nNext: run the command again with --debug, and report the traceback."
    return f"Internal error in cgwm: {type(error).__name__}: {error}{hint}"


def _say_interrupted(state: str = "") -> int:
    """Print that the command was interrupted and the state that the work reports; most work leaves no output."""
    _set_alarm(0.0)
    state = state or "no output was written."
    print(f"Interrupted; {state}", file=sys.stderr)
    return INTERRUPTED


def _catch_signals() -> None:
    """Make SIGINT, SIGTERM and SIGHUP raise KeyboardInterrupt, so that unfinished output is cleaned up."""
    handlers = {"SIGINT": _interrupt, "SIGTERM": _interrupt, "SIGHUP": _interrupt, "SIGALRM": _interrupt_again}
    for name, handler in handlers.items():
        number = getattr(signal, name, None)
        # a signal that the parent process set to be ignored (nohup, a background job) stays ignored
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            with contextlib.suppress(ValueError):  # not in the main thread
                signal.signal(number, handler)


def _leave(code: int) -> NoReturn:
    """End the process without waiting for threads: a thread whose start was interrupted may never end."""
    import atexit

    with contextlib.suppress(BaseException):
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    global _interrupted  # noqa: PLW0603  remembered because a library may convert the exception
    _interrupted = True
    _set_alarm(REPEAT_S)
    raise KeyboardInterrupt


def _interrupt_again(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt again if the one before was swallowed, and leave the code that cleans up alone.

    An interrupt is lost where Python cannot raise it (in a finalizer, a weak reference's callback) and where a library
    catches everything. While it propagates, `finally`, `except` and `__exit__` run with it as the handled exception.
    """
    _set_alarm(REPEAT_S)
    error = sys.exc_info()[1]
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return
        error = error.__cause__ or error.__context__
    raise KeyboardInterrupt


def _set_alarm(seconds: float) -> None:
    """Schedule SIGALRM after a number of seconds; zero cancels it. There is no SIGALRM on Windows."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _is_watched(quiet: bool, debug: bool) -> bool:
    """Return whether progress and logs are shown."""
    return debug or (sys.stderr.isatty() and not quiet)


def _hush() -> None:
    """Silence logs and warnings; the progress bars of cgwm.datasets.io.progress read the variable."""
    import logging
    import warnings

    os.environ["CGWM_QUIET"] = "1"
    warnings.simplefilter("ignore")
    logging.disable(logging.INFO)
    logging.getLogger().addHandler(logging.NullHandler())


@contextlib.contextmanager
def _warnings_kept(discarded: bool) -> Iterator[None]:
    """Print cgwm's own warnings on the real stderr, as what is printed inside is discarded, unless they are, too.

    They are printed at once: a warning that the work takes days is of no use after it.
    """
    if discarded:
        yield
        return
    import logging

    handler = logging.Handler(logging.WARNING)
    stderr = os.dup(2)

    def emit(record: logging.LogRecord) -> None:
        with contextlib.suppress(OSError):
            os.write(stderr, f"Warning: {record.getMessage()}\n".encode(errors="backslashreplace"))

    handler.emit = emit  # type: ignore[method-assign]
    logger = logging.getLogger("cgwm")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        os.close(stderr)


@contextlib.contextmanager
def _stdout_for_results_only(watched: bool) -> Iterator[None]:
    """Redirect what is printed inside to stderr if `watched`, and discard it otherwise.

    The file descriptors are redirected, because compiled libraries bypass `sys.stdout`.
    """
    _flush()
    saved = [os.dup(1), os.dup(2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(2 if watched else nowhere, 1)
        if not watched:
            os.dup2(nowhere, 2)
        yield
    finally:
        _flush()
        for descriptor, original in enumerate(saved, 1):
            os.dup2(original, descriptor)
            os.close(original)
        os.close(nowhere)


def _flush() -> None:
    sys.stdout.flush()
    sys.stderr.flush()
