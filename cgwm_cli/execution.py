"""Execution of the verbs: errors, exit codes, and a stdout that carries only the result."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from . import interrupts
from .terminal import escape_logs, print_result, say, say_traceback

if TYPE_CHECKING:
    from ..schemas import FileModel

_typed: list[str] = []
_RAY_ADDRESS = re.compile(r"auto|local|ray://.+|[\w.-]+:\d+")


def run_command(load_app: Callable[[], Callable[..., Any]], arguments: list[str], ends: bool = False) -> NoReturn:
    """Run the application that `load_app` imports with arguments, and raise SystemExit with its exit code.

    Args:
        load_app: Function that imports the application.
        arguments: The words after `cgwm`.
        ends: Whether the process ends with the command: then it is left at once where no thread works on, as to free
            half a million objects one by one takes a seventh of a second.
    """
    try:
        code = _invoke(load_app, arguments)
        if code == interrupts.INTERRUPTED:  # typer makes this code of an interrupt, too
            _say_interrupted()
    except KeyboardInterrupt:
        code = _say_interrupted()
    except BrokenPipeError:  # the reader of our output has closed it ("cgwm ... | head")
        code = 1
    interrupts.end_work(code)
    code = code if _flushed() else code or 1
    working = [thread for thread in threading.enumerate() if not thread.daemon]
    if interrupts.was_interrupted() or (ends and working == [threading.main_thread()]):
        interrupts.leave(code)
    sys.exit(code)


def _flushed() -> bool:
    """Write what is left for stdout; if it cannot be written, drop it, since the exit code is then the only message."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True


_OUTPUTS = "cgwm.datasets.io.outputs"
"""Module that knows the outputs, once something that writes them has imported it."""

Emit = Callable[["FileModel", Callable[[Any], str]], None]


@contextlib.contextmanager
def running(*, json: bool = False, quiet: bool = False, debug: bool = False) -> Iterator[Emit]:
    """Run the work of a verb, and turn any exception into one message on stderr and the right exit code.

    Yields a function that takes the result and a function that summarises it; the text is printed when the work is
    done. Progress, logs and the output of libraries go to stderr if that is a terminal; otherwise they are discarded.

    Raises:
        typer.Exit: With the exit code, if the work failed.
    """
    if (outputs := sys.modules.get(_OUTPUTS)) is not None:
        outputs.forget_completed()
    interrupts.begin_work()
    watched = _is_watched(quiet, debug)
    if not watched:
        _hush()
    escape_logs()
    printed: list[str] = []

    def emit(result: FileModel, summary: Callable[[Any], str]) -> None:
        if json:
            printed.append(result.model_dump_json(indent=2))
        elif not quiet:
            printed.append(summary(result))

    try:
        with _warnings_kept(discarded=watched or quiet), _stdout_for_results_only(watched):
            try:
                yield emit
            finally:
                interrupts.end_work()  # the result stands, and is printed whole
        for text in printed:
            print_result(text, json)
    except (typer.Exit, BrokenPipeError):
        raise
    except BaseException as error:
        if debug:
            say_traceback()
        raise typer.Exit(_report(error, debug)) from None


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Pause the collection of garbage while a verb imports the pipeline, and exempt what it imported from later ones.

    None of it is garbage, and to look through it again and again takes an eighth of the time of the imports.
    """
    if "torch" in sys.modules or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """Run work that an interrupt ends as it should end, such as a server."""
    try:
        interrupts.begin_work()
        yield
    except KeyboardInterrupt:
        pass
    finally:
        interrupts.end_work()


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
    except BrokenPipeError:
        raise
    except Exception as error:
        # typer's errors are recognised by this method, because their classes are private since 0.26
        if not hasattr(error, "format_message"):
            return _report(error, debug=False)
        from .usage import explain

        say(explain(error, arguments))
        return 2


def _report(error: BaseException, debug: bool) -> int:
    if interrupts.was_interrupted() or isinstance(error, KeyboardInterrupt):
        # recognised by its name, because the interrupt may have come while cgwm.schemas was imported
        return _say_interrupted(str(error) if type(error).__name__ == "InterruptedWork" else "")
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else 1
    from ..schemas import CgwmError

    if isinstance(error, CgwmError):
        say(error)
        return error.exit_code
    say(_unforeseen(error, debug))
    return 1


def _unforeseen(error: BaseException, debug: bool) -> str:
    if isinstance(error, OSError) and error.strerror:
        from ..schemas.printable import in_one_line

        place = f"{in_one_line(str(error.filename))}: " if error.filename else ""
        return f"{place}{error.strerror}."
    from ..pipeline.runtime.resources import ran_out_of_memory

    if ran_out_of_memory(error):
        return "Out of memory.\nNext: close other programs, or work on less at a time."
    if isinstance(error, ModuleNotFoundError):
        return _without_module(error.name or "")
    hint = "" if debug else "\nNext: run the command again with --debug, and report the traceback."
    return f"Internal error in cgwm: {type(error).__name__}: {error}{hint}"


def _without_module(name: str) -> str:
    """Return the message about a module that is not there."""
    if name.partition(".")[0] == "cgwm":
        return (
            f"This installation of cgwm lacks '{name}', as it does after new files came into a checkout.\n"
            "Next: run 'make install' in the checkout, or install cgwm again."
        )
    return f"The package '{name}' is not installed.\nNext: run 'cgwm doctor', which prints the pip line."


def _say_interrupted(state: str = "") -> int:
    """Print that the command was interrupted and the state that the work reports, or which outputs it has completed."""
    interrupts.end_work()
    if not interrupts.was_told():
        state = state or _completed()
        if state:
            say(f"Interrupted; {state}")
        else:  # without an import: it may be the import of `say`'s modules that was interrupted
            print(interrupts.NOTHING_WRITTEN, file=sys.stderr)
    return interrupts.INTERRUPTED


def _completed() -> str:
    """Return the outputs that an interrupted command has completed, in words; empty for none."""
    outputs = sys.modules.get(_OUTPUTS)
    names = [str(path) for path in outputs.completed()] if outputs is not None else []
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} complete." if names else ""


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

    from ..schemas.printable import printable

    handler = logging.Handler(logging.WARNING)
    stderr = os.dup(2)

    def emit(record: logging.LogRecord) -> None:
        with contextlib.suppress(OSError):
            os.write(stderr, f"Warning: {printable(record.getMessage())}\n".encode(errors="backslashreplace"))

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
