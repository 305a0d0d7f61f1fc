"""The stage view (`cgwm view`): rollouts of a dataset, or a model and its simulated motion, in the browser."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from ...datasets.io.kinds import kind_of
from ...datasets.models.model import Model, read_model
from ...datasets.rollouts.dataset import read_manifest
from ...datasets.rollouts.loader import RolloutReader
from ...datasets.rollouts.replay import Replay
from ...schemas import InputDataError
from ...schemas.printable import typed_path
from .motions import Motion, can_move, own_motion, recorded_motion, replayed, still
from .viewer import Viewer, require_viser

OWN_MOTIONS = 6
"""Number of simulated motions offered for a model."""


def open_view(thing: Path | str, host: str = "127.0.0.1", port: int = 8080) -> Viewer:
    """Start a server that shows a dataset or a model; it stops with the process or with the returned context.

    Args:
        thing: DATASET or MODEL.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.

    Raises:
        UsageError: If viser is not installed, or the address is not available.
        InputDataError: If the directory is neither, or a file in it is missing or wrong.
    """
    path = Path(thing)
    require_viser()
    kind = kind_of(path)
    if kind == "run":
        raise InputDataError(
            f"{path}: runs of a task of control.",
            "their model, with --run.",
            f"cgwm view MODEL --run {typed_path(path)}.",
        )
    if kind == "dataset":
        return _dataset(path, host, port)
    if kind == "model":
        return _model(path, host, port)
    found = "no such directory" if not path.exists() else f"a {kind}" if kind else "neither a dataset nor a model"
    raise InputDataError(
        f"{path}: {found}.",
        "a directory with dataset.json or model.json.",
        todo="name a dataset of 'cgwm synthesize' or a model of 'cgwm fit'.",
    )


def open_replays(
    title: str,
    model: Model,
    motions: Mapping[str, Replay],
    host: str = "127.0.0.1",
    port: int = 8080,
    more: Callable[[], Mapping[str, Replay]] | None = None,
) -> Viewer:
    """Start a server that shows motions of a model, such as those of `pipeline.control.replays_of`.

    Args:
        title: Title of the page.
        model: The model.
        motions: The motions, by name.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        more: Returns the motions that are new or longer than at its last call, by name; of motions that go on.

    Raises:
        UsageError: If viser is not installed, or the address is not available.
    """
    require_viser()

    def made_of(given: Mapping[str, Replay]) -> dict[str, Callable[[], Motion]]:
        return {name: partial(replayed, motion) for name, motion in given.items()}

    follow = None if more is None else lambda: made_of(more())
    return Viewer(title, model, made_of(motions), host, port, playing=True, follow=follow)


def _dataset(path: Path, host: str, port: int) -> Viewer:
    model = read_model(path / read_manifest(path).model)
    reader = RolloutReader(path)
    if not len(reader):
        raise InputDataError(f"{path}: no rollout in it.", todo="synthesize it again, or view its model.")
    motions = {info.demo: partial(recorded_motion, reader, number) for number, info in enumerate(reader.rollouts)}
    return Viewer(f"dataset {path.resolve().name}", model, motions, host, port)


def _model(path: Path, host: str, port: int) -> Viewer:
    model = read_model(path)
    moves = can_move(model)
    motions: dict[str, Callable[[], Motion]] = {}
    if moves:
        motions |= {f"rollout {number}": partial(own_motion, model, number) for number in range(OWN_MOTIONS)}
    motions["as in the photos"] = partial(still, model)
    return Viewer(f"model {path.resolve().name}", model, motions, host, port, playing=moves)
