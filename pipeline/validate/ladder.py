"""Checks of a ladder of models, as `cgwm improve` writes it."""

from __future__ import annotations

from collections.abc import Callable
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
        raise InputDataError(f"{document}: '{outside[0]}' lies outside of the ladder.", "names in its directory.")
    faults = [] if (path / file.page).is_file() else [f"the page {file.page} is missing."]
    facts = {"capture": file.capture, "models": list(file.models), "added": [], "stopped": file.stopped}
    for name in file.models:
        if not (path / name / "model.json").is_file():
            faults.append(f"the model {name} is missing.")
            continue
        if file.model_sha256.get(name) != sha256(path / name / "model.json"):
            faults.append(f"{name}/model.json has another content than when the ladder was written (SHA-256).")
        faults += [f"{name}: {fault}" for fault in check_model(path / name).faults]
    climbed = [step for step in file.steps if step.added]
    if [file.models[:1], *((step.next_model,) for step in climbed)] != [(name,) for name in file.models]:
        faults.append("the steps do not lead from model to model.")
    facts["added"] = [", ".join(step.added) for step in climbed]
    listed = [name for fold in file.folds for name in fold]
    if len(listed) != file.episodes or len(set(listed)) != len(listed):
        faults.append(f"the folds hold {len(listed)} episodes, not {file.episodes} different ones.")
    return ValidationReport(path=str(path), kind="ladder", facts=facts, faults=tuple(faults))
