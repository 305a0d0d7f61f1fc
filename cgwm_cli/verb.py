"""The decorator of a verb: the options that every verb has, and the way in which its work runs."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .execution import Emit, running
from .options import Debug, Json, Quiet
from .repeats import request_of

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
            request = request_of(work.__name__.replace("_", "-"), options)
            if not request:
                work(emit, **options)
                return
            from ..datasets.io.outputs import answers, made_for
            from ..schemas import OutputExistsError

            try:
                with made_for(request):
                    work(emit, **options)
            except OutputExistsError as error:
                if not answers(error.path, request):
                    raise
                _emit_kept(emit, error.path)

    parameters = [one.replace(kind=last) for one in arguments] + shared
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    vars(command)["__signature__"] = inspect.Signature(parameters)
    del command.__wrapped__  # typer reads the signature of the innermost function
    return command


def _emit_kept(emit: Emit, path: Path) -> None:
    """Say that an output is already what this command would write."""
    from ..schemas import KeptOutput

    emit(KeptOutput(output=str(path)), lambda kept: f"{kept.output} is already the result of this command.")
