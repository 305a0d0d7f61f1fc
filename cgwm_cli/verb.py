"""The decorator of a verb: the options that every verb has, and the way in which its work runs."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

from .execution import running
from .options import Debug, Json, Quiet

_SHARED = {"json": Json, "quiet": Quiet, "debug": Debug}
"""Options of every verb, which come last in its help."""


def verb(work: Callable[..., None]) -> Callable[..., None]:
    """Return the command of a verb: its own options, then --json, --quiet and --debug.

    Args:
        work: The verb's work; its first parameter is the function that takes the result and its summary, the others are
            the verb's arguments and options. It runs inside `running`.
    """
    _, *arguments = inspect.signature(work, eval_str=True).parameters.values()
    last = inspect.Parameter.KEYWORD_ONLY
    shared = [inspect.Parameter(name, last, default=False, annotation=kind) for name, kind in _SHARED.items()]

    @functools.wraps(work)
    def command(json: bool, quiet: bool, debug: bool, **options: Any) -> None:
        with running(json=json, quiet=quiet, debug=debug) as emit:
            work(emit, **options)

    parameters = [one.replace(kind=last) for one in arguments] + shared
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    vars(command)["__signature__"] = inspect.Signature(parameters)
    del command.__wrapped__  # typer reads the signature of the innermost function
    return command
