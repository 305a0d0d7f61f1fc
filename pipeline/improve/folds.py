"""Parts of a split for cross-validation, and models that are fitted without one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ...datasets.capture.capture import Capture
from ...datasets.models.model import Model, read_model, write_model
from ...schemas import PhysConfig
from ..phys_geo.stage import fit_motion
from ..runtime.checkpoint import Checkpoint

_OTHERS = "other-episodes"
"""Name of the split, in memory, of the episodes outside of a fold."""


def folds_of(episodes: Sequence[str], count: int) -> tuple[tuple[str, ...], ...]:
    """Return at most `count` parts of the episodes, each with every count-th episode.

    >>> folds_of(["a", "b", "c", "d", "e"], 2)
    (('a', 'c', 'e'), ('b', 'd'))
    """
    used = min(count, len(episodes))
    return tuple(tuple(episodes[k::used]) for k in range(used))


def fitted_without(
    fold: Sequence[str], model: Model, capture: Capture, split: str, config: PhysConfig, out: Path
) -> Model:
    """Return a model that is fitted to the episodes of a split outside of a fold, from the file if it was written.

    Args:
        fold: Episodes that the fit does not see.
        model: The model to start from.
        capture: The capture.
        split: Name of the split.
        config: Settings of phys-geo, with the effects to add.
        out: Directory of the model.

    Raises:
        InputDataError: If the other episodes lack what is to be fitted.
        NotConvergedError: If the fit diverges.
    """
    if not (out / "model.json").is_file():
        others = tuple(name for name in capture.episodes(split) if name not in fold)
        manifest = capture.manifest.model_copy(update={"splits": {**capture.manifest.splits, _OTHERS: others}})
        seen = replace(capture, manifest=manifest, only_splits=None)
        checkpoint = Checkpoint(out.with_name(f"{out.name}.checkpoint"), {})
        write_model(out, fit_motion(model, seen, _OTHERS, config, checkpoint, ()))
    return read_model(out)
