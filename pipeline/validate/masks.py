"""Check of masks that `cgwm mask` wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...datasets.capture.images import read_label
from ...schemas import MasksReport, read_json
from ...schemas.validation import ValidationReport

_SHARE_DIGITS = 5e-3
"""Largest difference of a share from its entry: masks are found in reduced photos."""


def validate_masks(path: Path) -> ValidationReport:
    """Check that each photo of `masks.json` has its mask, with no label but the body's and as many pixels as stated."""
    report = read_json(path / "masks.json", MasksReport)
    faults = [
        fault for name, photo in report.photos.items() for fault in _faults(path, report.label, name, photo.share)
    ]
    facts = {"method": report.method, "body": report.body, "photos": len(report.photos), "doubtful": report.doubtful}
    return ValidationReport(path=str(path), kind="masks", facts=facts, faults=tuple(faults))


def _faults(path: Path, label: int, name: str, share: float) -> list[str]:
    file = (path / name).with_suffix(".png")
    if not file.is_file():
        return [f"{file}: missing; masks.json lists the photo {name}."]
    mask = read_label(file)
    others = sorted(set(np.unique(mask).tolist()) - {0, label})
    if others:
        return [f"{file}: has label {others[0]}; masks.json names {label}."]
    found = float((mask > 0).mean())
    if abs(found - share) > _SHARE_DIGITS:
        return [f"{file}: the body fills {100 * found:.1f} % of it, {100 * share:.1f} % by masks.json."]
    return []
