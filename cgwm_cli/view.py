"""The verb `cgwm view`: show a dataset or a model in the browser."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import running, until_interrupted
from .options import Debug, Json, Quiet, TrustEffects, trust

if TYPE_CHECKING:
    from ..schemas import ViewReport


def view(
    thing: Annotated[
        Path, typer.Argument(metavar="DATASET|MODEL", help="The dataset or model to show.", show_default=False)
    ],
    run: Annotated[
        Path | None,
        typer.Option("--run", metavar="RUN", help="Runs of 'cgwm control' with this model, to replay, or to follow "
                     "while they go on.", show_default=False),
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port to listen on; 0: any free one.")] = 8080,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; with 0.0.0.0 everyone on the network can connect.")
    ] = "127.0.0.1",
    open_: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")] = True,
    trust_effects: TrustEffects = "",
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:  # fmt: skip
    """Show rollouts of a dataset, a model and its simulated motion, or runs of control, in the browser until Ctrl-C."""
    with contextlib.ExitStack() as ends:
        with running(json=json, quiet=quiet, debug=debug) as emit:
            trust(trust_effects)
            from ..pipeline.view import open_replays, open_view
            from ..schemas import ViewReport

            if run is None:
                viewer = ends.enter_context(open_view(thing, host, port))
            else:
                from ..pipeline.control import replays_or_following

                shown, motions, more = replays_or_following(thing, run)
                viewer = ends.enter_context(open_replays(f"run {run.name}", shown, motions, host, port, more))
            emit(ViewReport(url=viewer.url, showing=str(thing)), _summary)
        with until_interrupted():
            if open_:
                _open(viewer.url)
            viewer.run()


def _summary(report: ViewReport) -> str:
    return f"Showing {report.showing} at {report.url} (Ctrl-C ends it)."


def _open(url: str) -> None:
    """Open a page in a browser if a display exists; a text browser would occupy the terminal."""
    import os
    import sys
    import webbrowser

    if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)
