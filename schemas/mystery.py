"""What `cgwm demo --scene mystery` reports: the loop from model to diagnosis, and what had been hidden."""

from __future__ import annotations

from typing import Literal

from .base import FileModel
from .compare import CompareResult
from .demo import ComparedParameter
from .diagnose import DiagnoseResult

SEALED_FORMAT = "cgwm-sealed/1"
Outcome = Literal["right", "right_class", "partly", "wrong", "unnamed", "silent"]
"""right: the effect, and nothing else (or rightly nothing); right_class: a class that the data cannot tell apart, and
the effect is in it; partly: the effect, and something beside it that was not hidden; wrong: something else; unnamed:
that something is missing, but not what; silent: nothing, though there was something."""


class SealedFile(FileModel):
    """`sealed.json`: what is hidden, sealed so that it is not read by accident."""

    format: Literal["cgwm-sealed/1"] = SEALED_FORMAT
    how_to_open: str
    zlib_base64: str
    """The generator's account of the truth as JSON, compressed by zlib and written in base64."""


class HiddenEffect(FileModel):
    """An effect that the capture was made with."""

    name: str
    """As in `cgwm effects list`."""
    values: dict[str, float | list[float]]
    """Its true numbers, in the units of `cgwm effects show`."""
    form: str
    """What the simulator did, in words."""


class MysteryResult(FileModel):
    """`report.json` of the scene mystery, and what `cgwm demo --scene mystery --json` prints."""

    format: Literal["cgwm-mystery/1"] = "cgwm-mystery/1"
    scene: Literal["mystery"] = "mystery"
    seed: int
    device: str
    body: str
    train_episodes: int
    test_episodes: int
    settings: str
    """Options of both fits that differ from those of `cgwm fit`."""
    diagnosis: DiagnoseResult
    parameters: tuple[ComparedParameter, ...]
    """The numbers of the added effects, with the true ones where the same effect was hidden."""
    comparison: CompareResult
    """The model without the effects, and with them, on episodes that neither saw."""
    hidden: tuple[HiddenEffect, ...]
    """None: nothing was missing."""
    outcome: Outcome
    sentence: str
    """What was hidden beside what was found, in words."""
    seconds: dict[str, float]
    """Wall time by stage [s]."""
    paths: dict[str, str]
    """What was written, by kind, relative to OUT."""
    warnings: tuple[str, ...] = ()
