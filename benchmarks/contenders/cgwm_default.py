"""cgwm itself: `cgwm fit --stage phys-geo --supervise images`, as a user runs it, from the same splats."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import Model, read_model
from cgwm.pipeline.fit import fit
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.state import State
from cgwm.schemas import PhysConfig, UsageError

from .base import Array, Cell, Prediction
from .training import rolled_out


@dataclass(frozen=True)
class Cgwm:
    """The default fit, or one with other settings of the stage phys-geo."""

    name: str = "cgwm"
    settings: dict[str, Any] = field(default_factory=dict)

    def fit(self, cell: Cell, budget_s: float | None) -> FittedCgwm:
        """Fit the training episode; it takes the time that it takes.

        Raises:
            CgwmError: As `cgwm fit` has them.
            ValidationError: If the stage has no such setting.
        """
        settings = {"supervise": "images", "seed": cell.seed, "device": cell.device, **self.settings}
        config = PhysConfig.model_validate(settings)
        with tempfile.TemporaryDirectory() as folder:
            started = time.perf_counter()
            out = Path(folder) / "model"
            fit(cell.capture, out, stage="phys-geo", parent=cell.splats, phys_config=config)
            return FittedCgwm(read_model(out), time.perf_counter() - started)


@dataclass(frozen=True, eq=False)
class FittedCgwm:
    """The fitted model."""

    model: Model
    seconds: float

    @property
    def record(self) -> dict[str, Any]:
        """Seconds, estimates with their intervals, and the stage's own record."""
        file, stage = self.model.file, self.model.fit.stages["phys-geo"]
        return {
            "seconds": round(self.seconds, 2),
            "parameters": {p.name: p.estimate for p in file.parameters},
            "intervals_95": {p.name: p.interval_95 for p in file.parameters if p.interval_95 is not None},
            "seconds_by_step": stage.get("seconds_by_step", {}),
            "image_loss": stage.get("image_loss", {}),
            "pose_tracks": stage.get("pose_tracks", {}),
            "parameters_from_tracks": stage.get("parameters_from_tracks", {}),
            "warnings": list(file.warnings),
        }

    def with_friction(self, ground: float, fingertip: float | None) -> FittedCgwm:
        """Return the model with other frictions, of the ground and of a fingertip, where there is one [1]."""
        file = self.model.file
        if file.contact is None:
            raise UsageError("the model has no fitted physics.")
        change: dict[str, Any] = {"contact": file.contact.model_copy(update={"friction": ground})}
        if fingertip is not None:
            change["pairs"] = tuple(pair.model_copy(update={"friction": fingertip}) for pair in file.pairs)
        return replace(self, model=replace(self.model, file=file.model_copy(update=change)))

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
        """Predict open loop with the fitted world."""
        return rolled_out(world_of_model(self.model), start, drives, times_s)
