"""The verbs of `cgwm`, in the order in which a capture meets them."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from .calibrate import calibrate
from .compare import compare
from .demo import demo
from .diagnose import diagnose
from .doctor import doctor
from .effects import list_effects, new_effect, show_effect
from .eval import evaluate
from .export import export
from .fit import fit
from .import_ import import_capture
from .merge import merge
from .synthesize import synthesize
from .validate import validate
from .view import view

VERBS = (
    ("demo", demo, "The whole pipeline on a scene that it makes itself."),
    ("calibrate", calibrate, "Photos to cameras, with a metric scale."),
    ("fit", fit, "A capture to a world model."),
    ("synthesize", synthesize, "A model to labelled rollouts in HDF5."),
    ("merge", merge, "The shards of a dataset as one HDF5 file."),
    ("view", view, "A dataset or a model in the browser."),
    ("eval", evaluate, "A model against measurements."),
    ("compare", compare, "Where and when each model fails, side by side."),
    ("diagnose", diagnose, "Which effect a model lacks."),
    ("import", import_capture, "Recordings in another format to a capture."),
    ("export", export, "A dataset or a model in the format of another tool."),
    ("validate", validate, "Check a capture, a model or a dataset."),
    ("doctor", doctor, "What this machine has, and what would be used."),
)

GROUPS = {
    "effects": (
        "Effects that can be added to a model; a template.",
        (
            ("list", list_effects, "All effects that there are."),
            ("show", show_effect, "An effect's formula, parameters, and what reveals it."),
            ("new", new_effect, "A template of one's own effect."),
        ),
    ),
}
"""Verbs with verbs of their own."""

_MANNERS: dict[str, Any] = {
    "no_args_is_help": True,
    "add_completion": False,
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
app = typer.Typer(
    name="cgwm",
    help="From photos and one short contact-rich motion to a fitted physical world model and labelled 4D datasets.",
    epilog="Exit codes: 0 done, 1 the work failed, 2 wrong usage or bad input, 130 interrupted.",
    **_MANNERS,
)
for _name, _function, _short_help in VERBS:
    app.command(_name, short_help=_short_help)(_function)
for _name, (_short_help, _verbs) in GROUPS.items():
    _group = typer.Typer(name=_name, help=_short_help, **_MANNERS)
    for _verb, _function, _help in _verbs:
        _group.command(_verb, short_help=_help)(_function)
    app.add_typer(_group)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version as installed_version

        typer.echo(f"cgwm {installed_version('cgwm')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Take the options that stand before the verb."""
