"""The entry point of the command `cgwm`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NoReturn

from .execution import run_command


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run `cgwm` with arguments (default: those of the process), and end the process with its exit code."""
    run_command(_app, sys.argv[1:] if arguments is None else arguments)


def _app() -> Callable[..., Any]:
    # inside the signal handling of `run_command`, so that an interrupt while typer is imported ends cleanly
    from ..datasets.io.processors import use_few_threads
    from .app import app

    use_few_threads()  # before any library that starts threads is loaded

    return app
