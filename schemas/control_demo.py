"""What `cgwm demo --scene control` reports."""

from __future__ import annotations

from typing import Literal

from .base import FileModel
from .control import ControlResult
from .demo import ComparedParameter
from .model import Provenance


class ControlDemoResult(FileModel):
    """`report.json` of the scene control, and what `cgwm demo --json` prints of it."""

    format: Literal["cgwm-control-demo/1"] = "cgwm-control-demo/1"
    scene: Literal["control"] = "control"
    seed: int
    device: str
    family: str
    """Family of the object, such as box."""
    verdict: str
    parameters: tuple[ComparedParameter, ...]
    """What the video gave, beside the truth."""
    control: ControlResult
    """The runs in MuJoCo, with the true mesh and the true numbers as the plant."""
    seconds: dict[str, float]
    """Wall time by stage [s]."""
    paths: dict[str, str]
    """What was written, by kind, relative to OUT."""
    warnings: tuple[str, ...] = ()
    provenance: Provenance
    """Of the model."""
