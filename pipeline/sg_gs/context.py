"""What the steps of the stage sg-gs share: settings, photos, and what is found on the way."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch

from ..datasets.capture import Capture
from ..schemas import Ground, SplatConfig
from .checkpoint import Checkpoint, Slot
from .sfm.points import POINTS_NAME, read_points
from .splats.exposures import Exposures
from .splats.overlap import require_points_in_view
from .splats.seeds import points_of_depth
from .splats.views import View, spread_of
from .splats.volume import Array

_FEW_IN_VIEW = 0.5
_DEPTH_POINTS = 20_000


@dataclass
class Stage:
    """What the steps of the stage share."""

    capture: Capture
    config: SplatConfig
    device: torch.device
    checkpoint: Checkpoint | None
    ground: Ground | None
    train: list[View]
    test: list[View]
    record: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @cached_property
    def exposures(self) -> Exposures:
        """What is known of the photos' exposures so far."""
        return Exposures(self.train, self.config.exposure)

    @cached_property
    def points(self) -> Array | None:
        """Points of the scene, world frame, (n, 3): from structure from motion, or from depth maps; or None."""
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
        """Return where the checkpoints of a descent go, or None where none are kept."""
        return None if self.checkpoint is None else self.checkpoint.slot(name)

    def steps(self, share: float) -> int:
        """Return a share of the setting `iterations`, at least one."""
        return max(1, round(share * self.config.iterations))
