"""What a capture of the benchmark is before anything is drawn: object, ground, and every episode's true motion."""

from __future__ import annotations

FRAME_RATE = 30.0
TRAIN_FRAMES, TEST_FRAMES = 15, 60


def episode_names(tests: int) -> list[str]:
    """Return the names of the episodes: "000" is trained on, the others are tests."""
    return [f"{index:03d}" for index in range(tests + 1)]
