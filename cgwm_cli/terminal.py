"""The one way from a command to the terminal: messages, results, warnings and logs with control characters escaped."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TextIO


def say(text: object, stream: TextIO | None = None) -> None:
    """Print a message, on stderr unless another stream is given."""
    from ..schemas.printable import printable

    _print(printable(str(text)), stream or sys.stderr)


def print_result(text: str, json: bool) -> None:
    """Print the result of a command on stdout: a summary, or a JSON document."""
    from ..schemas.printable import printable, printable_json

    _print(printable_json(text) if json else printable(text), sys.stdout)


def say_traceback() -> None:
    """Print the traceback of the exception that is being handled."""
    import traceback

    say(traceback.format_exc().rstrip("\n"))


def escape_logs() -> None:
    """Escape what loggers and warnings without a handler of their own print."""
    import logging
    import warnings

    from ..schemas.printable import printable

    class Escaped(logging.Formatter):
        def format(self, record: logging.LogRecord) -> str:
            return printable(super().format(record))

    if logging.lastResort is not None:
        logging.lastResort.setFormatter(Escaped())
    if not hasattr(warnings.formatwarning, "as_before"):  # once, also if a process runs several commands
        escaped = _escaping(warnings.formatwarning)
        setattr(escaped, "as_before", warnings.formatwarning)  # noqa: B010
        warnings.formatwarning = escaped


def _escaping(formatted: Callable[..., str]) -> Callable[..., str]:
    from ..schemas.printable import printable

    return lambda *args, **options: printable(formatted(*args, **options))


def _print(text: str, stream: TextIO) -> None:
    """Write a text whole, in the characters that the stream has; signals arrive meanwhile, but interrupt nothing."""
    encoding = stream.encoding or "utf-8"
    rest = memoryview(f"{text}\n".encode(encoding, "backslashreplace"))
    stream.flush()
    while rest:  # with PYTHONUNBUFFERED a write that a signal meets takes only a part
        rest = rest[stream.buffer.write(rest) or 0 :]
    stream.flush()
