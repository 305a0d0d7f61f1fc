"""What tosses and pushes have in common: their lengths and names, and when an object is at rest."""

from __future__ import annotations

import numpy as np
from cgwm.datasets.synthetic.dynamics import Motion
from cgwm.datasets.synthetic.objects import SolidObject

FRAME_RATE = 30.0
TRAIN_FRAMES, TEST_FRAMES = 15, 60
RESTING_M_S = 0.01
"""At rest is what nowhere moves faster."""
CANDIDATES = 4
"""Truth has no rolling friction, so that a round object may rock for long. A motion that ends at rest is taken at once,
otherwise the calmest of so many."""


def episode_names(tests: int) -> list[str]:
    """Return the names of the episodes: "000" is trained on, the others are tests."""
    return [f"{index:03d}" for index in range(tests + 1)]


def speed_at_end(solid: SolidObject, motion: Motion) -> float:
    """Return a bound on the speed of any point of the object at the end of a motion [m/s]."""
    velocity, omega = motion.qvel[-1, :3], motion.qvel[-1, 3:6]
    return float(np.linalg.norm(velocity) + solid.radius * np.linalg.norm(omega))
