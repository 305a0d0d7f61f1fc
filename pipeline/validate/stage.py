"""The stage validate (`cgwm validate`): check a capture, model, dataset, ladder of models, run or masks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ...datasets.capture.capture import Capture
from ...datasets.capture.check import find_faults
from ...datasets.io.kinds import Kind, kind_of, worded
from ...datasets.models.agreement import require_contact
from ...datasets.models.model import read_model
from ...schemas import InputDataError, IntrinsicsFile, UsageError, read_json
from ...schemas.validation import ValidationReport


def validate(
    thing: Path | str, sample: int | None = None, seed: int = 0, accept_units: bool = False
) -> ValidationReport:
    """Check a capture, a model, a dataset, the ladder of models of `cgwm improve`, a run of `cgwm control`, or masks.

    Args:
        thing: CAPTURE, MODEL, DATASET, RUN, MASKS, the folder of a ladder, or the file `intrinsics.json` of a target.
        sample: Number of rollouts of a dataset to check, drawn at random; None checks all.
        seed: Seed of that draw.
        accept_units: Do not refuse units and frames of a capture that its motion contradicts.

    Returns:
        The facts that were found and measured; its `faults` are those of files that cgwm wrote (hashes, reprojection,
        ...).

    Raises:
        InputDataError: If the directory is none of these, a file in it cannot be read, or a capture is wrong; the
            message lists all faults of the capture, because the user has to correct them.
        UsageError: If a sample is requested of a capture or model.
    """
    path = Path(thing)
    if path.is_file():
        return validate_intrinsics(path)
    kind = kind_of(path)
    if sample is not None and kind in ("capture", "model", "ladder", "run", "masks"):
        raise UsageError(f"--sample: {path} is {worded(kind)}, which is checked whole.", "a dataset.", "omit --sample.")
    if kind == "capture":
        return validate_capture(path, accept_units)
    if kind == "model":
        return validate_model(path)
    if kind == "dataset":
        from .dataset import validate_dataset

        return validate_dataset(path, sample, seed)
    if kind is not None:
        return _validated_output(kind, path)
    found = "no such directory" if not path.exists() else "no capture, model, dataset, ladder, run or masks"
    raise InputDataError(
        f"{path}: {found}.",
        "a directory with capture.toml, model.json, dataset.json, improve.json, control.json or masks.json.",
        "name a capture, a model, a dataset or a run.",
    )


def _validated_output(kind: Kind, path: Path) -> ValidationReport:
    if kind == "ladder":
        from .ladder import validate_ladder

        return validate_ladder(path, validate_model)
    if kind == "run":
        from .run import validate_run

        return validate_run(path)
    from .masks import validate_masks

    return validate_masks(path)


def validate_capture(path: Path | str, accept_units: bool = False) -> ValidationReport:
    """Check a capture completely, and count its contents."""
    capture = Capture.open(path, check=False)
    facts, faults = find_faults(capture, accept_units)
    if len(faults) == 1:
        raise faults[0]
    if faults:
        texts = (str(fault).replace("\n", "\n   ") for fault in faults)
        listed = "\n".join(f"{number}. {text}" for number, text in enumerate(texts, 1))
        raise InputDataError(f"{path}: {len(faults)} faults.\n{listed}", todo="correct them, and validate it again.")
    return ValidationReport(path=str(path), kind="capture", facts=dataclasses.asdict(facts))


def validate_intrinsics(path: Path) -> ValidationReport:
    """Check a file of intrinsics that a calibration target gave."""
    file = read_json(path, IntrinsicsFile)
    facts = file.model_dump(exclude={"format", "photos", "camera", "versions"}) | file.camera.model_dump()
    used = sum(not photo.reason for photo in file.photos.values())
    return ValidationReport(path=str(path), kind="intrinsics", facts={"photos_used": used} | facts)


def validate_model(path: Path | str) -> ValidationReport:
    """Check the files of a model, and that its world can be simulated (`trial_run`)."""
    model = read_model(path)
    require_contact(model.file, Path(path) / "model.json")
    facts = {
        "bodies": [body.name for body in model.file.bodies],
        "visual_spheres": {name: len(splats) for name, splats in model.body_splats.items()},
        "colliding_spheres": {name: len(splats) for name, splats in model.collision.items()},
        "scene_spheres": 0 if model.scene is None else len(model.scene),
        "stages": sorted(model.fit.stages),
        "parameters": {entry.name: f"{entry.estimate:.6g} {entry.unit}".strip() for entry in model.file.parameters},
        "warnings": list(dict.fromkeys((*model.file.warnings, *model.fit.warnings))),
    }
    custom = [f"{effect.name} (SHA-256 {effect.sha256})" for effect in model.file.effects if effect.sha256]
    if custom:
        facts["effects_not_run"] = custom
    from .trial_run import run_faults

    faults, run = run_faults(model)
    return ValidationReport(path=str(path), kind="model", facts=facts | run, faults=tuple(faults))
