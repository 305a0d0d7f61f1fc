"""Shared state of the steps of the stage sg-gs: settings, photos and intermediate results."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch

from ...datasets.capture.capture import Capture
from ...datasets.capture.sparse_points import POINTS_NAME, read_points
from ...schemas import Ground, SplatConfig
from ..geometry.solid_grid import Array
from ..runtime.checkpoint import Checkpoint, Slot
from .appearance.initialization import points_of_depth
from .photos.photo_exposure import Exposures
from .photos.view_overlap import require_points_in_view
from .photos.views import View, spread_of

_FEW_IN_VIEW = 0.5
_DEPTH_POINTS = 20_000


@dataclass(kw_only=True)
class Stage:
    """Shared state of the steps of the stage."""

    capture: Capture
    """The capture."""
    config: SplatConfig
    """Settings of the stage."""
    device: torch.device
    """Device of the fits."""
    checkpoint: Checkpoint | None
    """Checkpoints of the descents; None keeps none."""
    ground: Ground | None
    """The ground; None where the capture has none or its place among the photos is unknown."""
    train: list[View]
    """The photos to fit."""
    test: list[View]
    """The held-out photos."""
    record: dict[str, Any] = field(default_factory=dict)
    """Losses, timings and other figures for fit.json."""
    warnings: list[str] = field(default_factory=list)
    """Messages for the user."""

    @cached_property
    def exposures(self) -> Exposures:
        """Current estimates of the photos' exposures."""
        return Exposures(self.train, self.config.exposure)

    @cached_property
    def points(self) -> Array | None:
        """Points of the scene [m], world frame, (n, 3), from structure from motion or depth maps, or None."""
        path = self.capture.root / POINTS_NAME
        if not path.is_file():
            return points_of_depth(self.train, _DEPTH_POINTS, self.config.seed)
        found = read_points(path)[0]
        share = require_points_in_view(found, self.train, str(path))
        if share < _FEW_IN_VIEW:
            self.warnings.append(f"Only {share:.0%} of the points of {POINTS_NAME} lie in view of any photo.")
        return found

    @property
    def spread(self) -> float:
        """Size of the cameras' arrangement [m]."""
        return spread_of(self.train)

    def slot(self, name: str) -> Slot | None:
        """Return the checkpoint file of a descent, or None if no checkpoints are kept."""
        return None if self.checkpoint is None else self.checkpoint.slot(name)

    def steps(self, share: float) -> int:
        """Return a share of the setting `iterations`, at least one."""
        return max(1, round(share * self.config.iterations))
