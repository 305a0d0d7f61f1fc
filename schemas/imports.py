"""What `cgwm import --json` prints."""

from __future__ import annotations

from .base import FileModel


class ImportResult(FileModel):
    """What was imported."""

    capture: str
    """The capture directory that was written."""
    episodes: int
    samples: int
    """Number of poses in all tracks."""
    splits: dict[str, int]
    """Number of episodes by split."""
    photos: int = 0
    """Number of photos."""
    posed: bool = False
    """Whether their cameras are known."""
    warnings: tuple[str, ...] = ()
    """What the files have and the capture has not."""
