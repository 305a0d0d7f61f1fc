"""The entry point of the command `cgwm`."""

from __future__ import annotations

import gc
import sys

from .interrupts import caught

TYPE_CHECKING = False  # as in typing; what is imported before signals are handled takes no time
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any, NoReturn

_COLLECT = (700, 10, 100)
"""Thresholds of the garbage collector: it searches all objects ten times less often than by itself, because
the modules that a command imports make half a million objects that stay."""


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run `cgwm` with arguments, and raise SystemExit with its exit code.

    Args:
        arguments: The words after `cgwm`; None takes those of the process, which then ends with the command.
    """
    if arguments is None:
        gc.set_threshold(*_COLLECT)
    with caught(owned=arguments is None):
        from .execution import run_command

        run_command(_app, sys.argv[1:] if arguments is None else arguments, ends=arguments is None)


def _app() -> Callable[..., Any]:
    from ..datasets.io.processors import use_few_threads
    from .app import app

    use_few_threads()  # before any library that starts threads is loaded

    return app
