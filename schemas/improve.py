"""What `cgwm improve` reports, and writes as `improve.json`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .base import FileModel
from .diagnose import DiagnoseResult
from .model import FittedParameter
from .results import ErrorSummary

IMPROVE_FORMAT = "cgwm-improve/1"

Reason = Literal["selected", "one_left_out", "one_of_the_selected", "first_of_the_ranking", "law"]


class ImproveConfig(FileModel):
    """Settings of `cgwm improve`."""

    steps: Annotated[int, Field(ge=1, le=20)] = 6
    """Largest number of models that are added to the first one."""
    folds: Annotated[int, Field(ge=2, le=20)] = 4
    """Parts of the split for the cross-validation; fewer where there are fewer episodes."""


class ErrorRatio(FileModel):
    """Errors on the same unseen episodes with one model and with the next one."""

    episodes: int
    better: int
    """Episodes with the smaller error after the step."""
    before: float
    after: float
    """Medians over the episodes, in the unit of the error."""
    ratio: float
    """Geometric mean over the episodes of the error after over the error before."""
    interval_95: tuple[float, float] | None = None
    """Of that ratio: paired bootstrap over the episodes, Student's t for fewer than six; null for fewer than three."""


class ImproveTrial(FileModel):
    """One addition that was tried in a step, and how it predicts episodes that its fit has not seen."""

    effects: tuple[str, ...]
    """What was passed to `fit --effects`; a law by the name of its file in the model."""
    why: Reason
    flight: ErrorRatio | None = None
    """Of predictions of the second halves of flights, in units of the noise; null without flight or where the fit
    failed."""
    contact: ErrorRatio | None = None
    """The same of segments with contact."""
    helps: bool
    """Whether one of the two falls beyond chance, by at least the least fall, and none rises beyond chance."""
    failure: str = ""
    """The message of a fit that failed."""


class ImproveStep(DiagnoseResult):
    """The diagnosis of a model of the ladder, and what was done about it."""

    model: str
    """The diagnosed model, by its folder."""
    tried: tuple[ImproveTrial, ...] = ()
    added: tuple[str, ...] = ()
    """The effects of the next model; empty where the ladder ends."""
    next_model: str | None = None
    next_parameters: tuple[FittedParameter, ...] = ()
    """Of the added effects, in the next model."""


class ImproveTestFigures(FileModel):
    """Errors of a model of the ladder on the split `test`, which no step has seen."""

    model: str
    translation_error_m: ErrorSummary
    """In open loop, as `cgwm eval` prints it."""
    rotation_error_deg: ErrorSummary | None = None
    state_fitted_residual_m: ErrorSummary | None = None
    reduced_chi2: float | None = None
    """Of short predictions."""
    flight: float | None = None
    """Of predictions of half segments of flight, in units of the noise, median over the episodes."""
    contact: float | None = None
    """The same of segments with contact."""


class ImproveTestStep(FileModel):
    """A step of the ladder on the split `test`; null what was not measured."""

    model: str
    than: str
    flight: ErrorRatio | None = None
    contact: ErrorRatio | None = None
    translation_error_m: ErrorRatio | None = None
    state_fitted_residual_m: ErrorRatio | None = None


class ImproveTest(FileModel):
    """The split `test`, opened once, after the last step."""

    split: str
    episodes: int
    verdict: str
    """Of `cgwm compare` on all models of the ladder."""
    models: tuple[ImproveTestFigures, ...]
    steps: tuple[ImproveTestStep, ...] = ()
    """Each model against the one before it; the last entry of several is the last model against the first."""
    measurement_std: dict[str, float] = {}


class ImproveResult(FileModel):
    """`cgwm improve --json`, and `improve.json`."""

    format: Literal["cgwm-improve/1"] = IMPROVE_FORMAT
    capture: str
    split: str
    episodes: int
    """Of the split, which all decisions rest on."""
    folds: tuple[tuple[str, ...], ...]
    """Episodes of each part of the cross-validation."""
    models: tuple[str, ...]
    """Folders of the ladder, the first model first."""
    model_sha256: dict[str, str]
    """SHA-256 of the `model.json` of each."""
    sentence: str
    """The outcome in words."""
    stopped: Literal["nothing_helps", "nothing_proposed", "steps", "not_diagnosed"]
    """Why the ladder ends."""
    steps: tuple[ImproveStep, ...] = ()
    """Diagnosis by diagnosis; of the last model, too, unless the number of steps or a refusal ended the ladder."""
    refusal: str = ""
    """Why the last model could not be diagnosed."""
    test: ImproveTest | None = None
    """Null without such a split."""
    page: str
    """File of the page, in the same folder."""
    input_sha256: dict[str, str] = {}
    versions: dict[str, str] = {}
    settings: dict[str, str] = {}
    warnings: tuple[str, ...] = ()
