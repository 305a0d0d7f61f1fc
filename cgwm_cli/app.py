"""The verbs of `cgwm`, in the order in which a capture meets them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from .calibrate import calibrate
from .demo import demo
from .doctor import doctor
from .eval import evaluate
from .fit import fit
from .import_ import import_capture
from .synthesize import synthesize
from .validate import validate

VERBS: dict[str, Callable[..., Any]] = {
    "demo": demo,
    "calibrate": calibrate,
    "fit": fit,
    "synthesize": synthesize,
    "eval": evaluate,
    "import": import_capture,
    "validate": validate,
    "doctor": doctor,
}

app = typer.Typer(
    name="cgwm",
    help="From photos and one short contact-rich motion to a fitted physical world model and labelled 4D datasets.",
    epilog="Exit codes: 0 done, 1 the work failed, 2 wrong usage or bad input, 130 interrupted.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _name, _function in VERBS.items():
    app.command(_name)(_function)


def _print_version(wanted: bool) -> None:
    if wanted:
        from .. import __version__

        typer.echo(f"cgwm {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Take the options that stand before the verb."""
