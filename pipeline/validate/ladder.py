"""Checks of a ladder of models, as `cgwm improve` writes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from ...datasets.io.atomic import sha256
from ...schemas import ImproveResult, InputDataError, ValidationReport, read_json
from ...schemas.regular_files import real_path


def validate_ladder(path: Path, check_model: Callable[[Path], ValidationReport]) -> ValidationReport:
    """Check that a ladder agrees with its models, and check these.

    Args:
        path: Directory of the ladder.
        check_model: Function that checks a model.

    Raises:
        InputDataError: If `improve.json` does not fit its schema, or names a model or page elsewhere.
    """
    document = path / "improve.json"
    file = read_json(document, ImproveResult)
    outside = [name for name in (*file.models, file.page) if real_path(path / name).parent != real_path(path)]
    if outside:
        raise InputDataError(
            f"{document}: '{outside[0]}' lies outside of the ladder.",
            "names in its directory.",
            todo="copy the whole directory that 'cgwm improve' wrote, or run it again.",
        )
    faults = [] if (path / file.page).is_file() else [f"the page {file.page} is missing."]
    faults += [fault for name in file.models for fault in _model_faults(path / name, file, check_model)]
    faults += _step_faults(file)
    added = [", ".join(step.added) for step in file.steps if step.added]
    facts = {"capture": file.capture, "models": list(file.models), "added": added, "stopped": file.stopped}
    return ValidationReport(path=str(path), kind="ladder", facts=facts, faults=tuple(faults))


def _model_faults(model: Path, file: ImproveResult, check_model: Callable[[Path], ValidationReport]) -> Iterator[str]:
    """Yield the faults of a model, and whether it is that of the ladder."""
    if not (model / "model.json").is_file():
        yield f"the model {model.name} is missing."
        return
    if file.model_sha256.get(model.name) != sha256(model / "model.json"):
        yield f"{model.name}/model.json has another content than when the ladder was written (SHA-256)."
    yield from (f"{model.name}: {fault}" for fault in check_model(model).faults)


def _step_faults(file: ImproveResult) -> Iterator[str]:
    """Yield whether the steps do not lead from model to model, and the folds do not hold each episode once."""
    climbed = [step.next_model for step in file.steps if step.added]
    if not file.models or [file.models[0], *climbed] != list(file.models):
        yield "the steps do not lead from model to model."
    held = [name for fold in file.folds for name in fold]
    if len(held) != file.episodes or len(set(held)) != len(held):
        yield f"the folds hold {len(held)} episodes, not {file.episodes} different ones."
