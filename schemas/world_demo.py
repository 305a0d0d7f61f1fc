"""What `cgwm demo --scene bin` and `--scene ramp` report."""

from __future__ import annotations

from typing import Literal

from .base import FileModel
from .dataset import DatasetSummary
from .demo import ComparedParameter
from .model import Provenance
from .results import EvalResult


class RolloutCheck(FileModel):
    """The rollouts of the dataset, judged by their labels."""

    rollouts: int
    deepest_m: float
    """Deepest penetration at any frame of any rollout [m]."""
    at_rest: float
    """Share of the bodies whose origin is slower than 5 mm/s at the end."""
    fastest_end_m_s: float
    """Speed of the fastest body at the end [m/s]."""
    escaped: int
    """Rollouts in which a body left the scene."""
    labels_hold: bool
    """Whether `cgwm validate` passes: changes of momentum are the labelled impulses, among its other checks."""


class WorldDemoResult(FileModel):
    """`report.json` of the scenes bin and ramp, and what `cgwm demo --json` prints of them."""

    format: Literal["cgwm-world-demo/1"] = "cgwm-world-demo/1"
    scene: Literal["bin", "ramp"]
    seed: int
    device: str
    verdict: str
    parameters: tuple[ComparedParameter, ...]
    """Contact parameters of the pairs of materials beside the truth."""
    evaluation: EvalResult
    """Open-loop prediction of the test episodes."""
    dataset: DatasetSummary
    check: RolloutCheck
    seconds: dict[str, float]
    """Wall time by stage [s]."""
    paths: dict[str, str]
    """What was written, by kind, relative to OUT."""
    warnings: tuple[str, ...] = ()
    provenance: Provenance
    """Of the model."""
