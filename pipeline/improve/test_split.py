"""The split `test`: the errors of all models of a ladder on episodes that none of its decisions has seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ...datasets.capture.capture import Capture
from ...datasets.models.model import read_model
from ...schemas import ImproveTest, ImproveTestFigures, ImproveTestStep
from ..compare.model_comparison import ComparedModel
from ..compare.stage import compare_models
from .held_out_errors import HeldOutErrors, error_ratio, prepared_episodes, typical_errors

TEST = "test"


def has_test_split(capture: Capture, split: str) -> bool:
    """Return whether there is a split `test` with episodes beside the one that decides."""
    return split != TEST and bool(capture.manifest.splits.get(TEST))


def tested(folder: Path, names: Sequence[str], capture: Path, device: str, accept_units: bool) -> ImproveTest:
    """Open the split `test`, and return the errors of the models of a ladder on it.

    Args:
        folder: Directory with the models.
        names: Their folders, the first model first.
        capture: The capture.
        device: Device of rollouts and renderer.
        accept_units: Whether the capture's units are right although its motion contradicts them.

    Raises:
        InputDataError: If no episode can be predicted.
        NotConvergedError: If a rollout diverges.
    """
    opened = Capture.open(capture, splits=(TEST,), accept_units=accept_units)
    models = [read_model(folder / name) for name in names]
    found = compare_models(list(zip(names, models, strict=True)), opened, TEST, device=device)
    shared = [name for name in opened.episodes(TEST) if name in found.models[0].short]
    prepared = prepared_episodes(models[0], opened, shared)
    errors = [
        {**_kinds(typical_errors(model, opened, *prepared)), **_errors(compared)}
        for model, compared in zip(models, found.models, strict=True)
    ]
    pairs = [(k, k - 1) for k in range(1, len(names))] + ([(len(names) - 1, 0)] if len(names) > 2 else [])
    return ImproveTest(
        split=TEST,
        episodes=found.result.episodes,
        verdict=found.result.verdict,
        models=tuple(
            ImproveTestFigures(
                model=one.model,
                translation_error_m=one.translation_error_m,
                rotation_error_deg=one.rotation_error_deg,
                state_fitted_residual_m=one.state_fitted_residual_m,
                reduced_chi2=one.reduced_chi2,
                flight=_median(errors[k]["flight"]),
                contact=_median(errors[k]["contact"]),
            )
            for k, one in enumerate(found.result.models)
        ),
        steps=tuple(
            ImproveTestStep(
                model=names[k],
                than=names[j],
                flight=error_ratio(errors[j]["flight"], errors[k]["flight"]),
                contact=error_ratio(errors[j]["contact"], errors[k]["contact"]),
                translation_error_m=error_ratio(errors[j]["open_loop"], errors[k]["open_loop"]),
                state_fitted_residual_m=error_ratio(errors[j]["fitted"], errors[k]["fitted"]),
            )
            for k, j in pairs
        ),
        measurement_std=found.result.measurement_std,
    )


def _kinds(errors: HeldOutErrors) -> dict[str, dict[str, float]]:
    return {"flight": errors.flight, "contact": errors.contact}


def _median(errors: Mapping[str, float]) -> float | None:
    return float(np.median(list(errors.values()))) if errors else None


def _errors(model: ComparedModel) -> dict[str, dict[str, float]]:
    """Return the errors of a model by kind and episode."""
    listed = model.evaluation.result.per_episode
    return {
        "open_loop": {one.episode: one.translation_error_m for one in listed},
        "fitted": {one.episode: r for one in listed if (r := one.state_fitted_residual_m) is not None},
    }
