"""Options that several verbs share, so that their names and help texts agree.

An option that is also a setting of a stage defaults to None, so that a settings file can give it. The help shows the
default of the stage, and a test compares the two.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

DeviceName = Literal["auto", "cpu", "cuda"]

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only (and the document of --json).")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Seed = Annotated[int | None, typer.Option("--seed", min=0, show_default="0", help="Seed of everything random.")]
AnyDevice = Annotated[DeviceName, typer.Option("--device", help="auto takes a CUDA device if one is available.")]
"""Device of verbs without settings: only the option sets it."""
Device = Annotated[
    DeviceName | None,
    typer.Option("--device", show_default="auto", help="auto takes a CUDA device if one is available."),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace an output that cgwm wrote, once the new one is complete.")
]
TrustEffects = Annotated[
    str,
    typer.Option(
        "--trust-effects",
        metavar="FILE|SHA256|MODEL,...",
        help="Python files of custom effects that may be run: the file, its SHA-256, or the model that brings it.",
        show_default=False,
    ),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="Settings: a TOML file with a table for each stage."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="STAGE.KEY=VALUE", help="One setting; may be repeated. Overrides --config."),
]


AcceptUnits = Annotated[
    bool,
    typer.Option(
        "--accept-units", help="Take units and frames of the capture as they are, although its motion contradicts them."
    ),
]


def trust(named: str) -> None:
    """Consent to what `--trust-effects` names; without it nothing is imported."""
    names = [name.strip() for name in named.split(",") if name.strip()]
    if names:
        from ..pipeline.physics.effects.trust import trust_effects

        trust_effects(names)


def require_models_first(verb: str, models: Sequence[Path], capture: Path) -> None:
    """Refuse a capture among the models that has been given before the capture, and say which order is meant."""
    from ..datasets.io.kinds import kind_of

    swapped = [path for path in models if kind_of(path) == "capture"]
    if not swapped or kind_of(capture) == "capture":
        return
    from ..schemas import UsageError

    right = " ".join(map(str, (*(path for path in models if path not in swapped), capture, swapped[0])))
    raise UsageError(
        f"{swapped[0]} is a capture, and {capture} is none: the capture comes last.",
        f"cgwm {verb} MODEL{'...' if verb == 'compare' else ''} CAPTURE.",
        f"cgwm {verb} {right}",
    )


def require_warmup(warmup_s: float) -> None:
    """Refuse a start that models may see if it is no positive duration."""
    if not warmup_s > 0:
        from ..schemas import UsageError

        raise UsageError(
            f"--warmup-s {warmup_s:g}: not a positive duration.",
            "more than 0 s.",
            "pass a duration in seconds, such as --warmup-s 0.1.",
        )
