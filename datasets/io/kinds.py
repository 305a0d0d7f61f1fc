"""Detection of the kind of a directory: capture, model, dataset, ladder of models, run of control, or masks."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from ...schemas import CAPTURE_FORMAT, InputDataError
from ...schemas.printable import typed_path

Kind = Literal["capture", "model", "dataset", "ladder", "run", "masks"]

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".heic", ".heif")
"""Suffixes of photos, in lower case."""
_MARKS: dict[Kind, str] = {
    "capture": "capture.toml",
    "model": "model.json",
    "dataset": "dataset.json",
    "ladder": "improve.json",
    "run": "control.json",
    "masks": "masks.json",
}
_USED_BY: dict[Kind, str] = {
    "capture": "cgwm calibrate, fit, compare and diagnose take one",
    "model": "cgwm synthesize, eval and compare take one",
    "dataset": "cgwm eval takes one as its target",
    "ladder": "cgwm validate takes one, the other commands one of its models",
    "run": "cgwm validate takes one",
    "masks": "cgwm calibrate and fit read them as CAPTURE/masks",
}


def kind_of(path: Path | str) -> Kind | None:
    """Return the kind of a directory from the files in it, or None if it is none of these."""
    path = Path(path)
    return next((kind for kind, mark in _MARKS.items() if path.is_dir() and any(path.glob(mark))), None)


def worded(kind: Kind) -> str:
    """Return the kind of a directory with its article."""
    return "a folder of masks" if kind == "masks" else f"a {kind}"


def refuse_other_kind(path: Path, wanted: Kind) -> None:
    """Raise InputDataError unless the directory is of the wanted kind; the message says what it is instead."""
    if path.is_dir() and any(path.glob(_MARKS[wanted])):
        return
    found = kind_of(path)
    if not path.exists():
        raise InputDataError(f"{path}: no such {wanted}.", todo="check the path.")
    if not path.is_dir():
        raise InputDataError(
            f"{path} is a file; a {wanted} is a directory with {_MARKS[wanted]}.", todo="pass that directory."
        )
    if found is not None:
        raise InputDataError(
            f"{path} is {worded(found)} (it holds {_MARKS[found]}), not a {wanted}.",
            f"a {wanted}, a directory with {_MARKS[wanted]}.",
            f"{_USED_BY[found]}; pass a {wanted} here.",
        )
    todo = _way_to_capture(path) if wanted == "capture" else "check the path."
    raise InputDataError(f"{path} is no {wanted}: it has no {_MARKS[wanted]}.", todo=todo)


def _way_to_capture(path: Path) -> str:
    """Return how a folder of data becomes a capture."""
    if any((path / folder).is_dir() for folder in ("images", "videos", "tracks")):
        manifest = typed_path(path / "capture.toml")
        return f"write a manifest; the shortest one: echo 'format = \"{CAPTURE_FORMAT}\"' > {manifest}"
    if any(one.suffix.lower() in PHOTO_SUFFIXES for one in path.iterdir()):
        return f"make a capture of its photos: cgwm import photos {typed_path(path)} --out CAPTURE"
    return "check the path."
