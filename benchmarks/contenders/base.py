"""What a contender of the benchmark is given, and what it must return.

All fit the same 15 frames of one episode and predict the same test episodes, each open loop from the same true state at
its first frame. In training nobody knows the start: it is found in the images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.physics.state import State
from numpy.typing import NDArray

Array = NDArray[np.float64]

TRAIN_EPISODE = "000"
"""The episode that every contender learns from; split `train`."""


@dataclass(frozen=True)
class Cell:
    """What a contender learns from.

    capture: A capture directory; a fit sees its manifest (masses, ground, splits), cameras, and of the training episode
        the frames, masks and the tracks of driven bodies, which are commands. Never the tracks of free bodies, the
        truth or a test episode, except where the contender's own row says so.
    splats: A model directory of the same object, made by `cgwm fit --stage sg-gs`, without physics.
    device: cpu or cuda.
    seed: Of everything that is drawn.
    """

    capture: Path
    splats: Path
    device: str
    seed: int


@dataclass(frozen=True, eq=False)
class Prediction:
    """Poses at the video frame times of one test episode, of all bodies in the model's order.

    position_m (F, nb, 3): of the body frames' origins [m], world; quat_wxyz (F, nb, 4). Row 0 is the given start.
    """

    position_m: Array
    quat_wxyz: Array


class Fitted(Protocol):
    """A contender after its fit."""

    @property
    def record(self) -> dict[str, Any]:
        """How the fit went, JSON: `seconds` [s], `evaluations` and what else tells.

        `parameters` are values by name (`friction`, `contact_time_s`, ...), as far as the contender has such numbers.
        """
        ...

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
        """Predict open loop.

        Args:
            start: The true state of all bodies at the first time; batch 1, float64, on the CPU.
            drives: The command of each driven body over the whole episode.
            times_s: Times of the video frames [s], shape (F,).

        Raises:
            NotConvergedError: If the prediction diverges.
        """
        ...


class Contender(Protocol):
    """One row of the benchmark."""

    @property
    def name(self) -> str:
        """The row's name in the table."""
        ...

    def fit(self, cell: Cell, budget_s: float | None) -> Fitted:
        """Learn from a cell's training episode.

        Args:
            cell: What may be seen.
            budget_s: Wall time [s] that the fit may take; None for as long as it takes by itself.

        Raises:
            CgwmError: If the fit fails; the benchmark stores the reason.
        """
        ...
