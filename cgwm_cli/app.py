"""The verbs of `cgwm`, in the order in which they are usually run."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from .calibrate import calibrate
from .compare import compare
from .control import control
from .demo import demo
from .diagnose import diagnose
from .doctor import doctor
from .effects import list_effects, new_effect, show_effect
from .eval import evaluate
from .export import export
from .fit import fit
from .import_ import import_capture
from .improve import improve
from .mask import mask
from .merge import merge
from .synthesize import synthesize
from .validate import validate
from .view import view

VERBS = (
    ("demo", demo, "Run the whole pipeline on a simulated scene."),
    ("mask", mask, "Cut a body out of photos: masks for calibrate and fit."),
    ("calibrate", calibrate, "Estimate cameras from photos, with a metric scale."),
    ("fit", fit, "Fit a world model to a capture."),
    ("synthesize", synthesize, "Make labelled rollouts of a model, in HDF5."),
    ("merge", merge, "Join the shards of a dataset into one HDF5 file."),
    ("view", view, "Show a dataset or a model in the browser."),
    ("eval", evaluate, "Evaluate a model against measurements."),
    ("compare", compare, "Compare models: where and when each fails."),
    ("diagnose", diagnose, "Find the effect that a model lacks."),
    ("improve", improve, "Fit, diagnose, add and refit until nothing helps."),
    ("control", control, "Let a robot act through a model."),
    ("import", import_capture, "Convert recordings in another format to a capture."),
    ("export", export, "Convert a dataset or model to another tool's format."),
    ("validate", validate, "Check a capture, model, dataset, ladder, run or masks."),
    ("doctor", doctor, "Report what this machine has and what would be used."),
)

GROUPS = {
    "effects": (
        "List, show and create effects that extend a model.",
        (
            ("list", list_effects, "List all available effects."),
            ("show", show_effect, "Show an effect's formula, parameters and evidence."),
            ("new", new_effect, "Write a template of a custom effect."),
        ),
    ),
}
"""Groups of verbs."""

_MANNERS: dict[str, Any] = {
    "no_args_is_help": True,
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
app = typer.Typer(
    name="cgwm",
    help="From photos and one short contact-rich motion to a fitted physical world model and labelled 4D datasets.",
    epilog="Exit codes: 0 done, 1 the work failed, 2 wrong usage or bad input, 130 interrupted.",
    add_completion=True,
    **_MANNERS,
)
for _name, _function, _short_help in VERBS:
    app.command(_name, short_help=_short_help)(_function)
for _name, (_short_help, _verbs) in GROUPS.items():
    _group = typer.Typer(name=_name, help=_short_help, add_completion=False, **_MANNERS)
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
    """Handle the options before the verb."""
