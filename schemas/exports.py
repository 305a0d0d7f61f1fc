"""What `cgwm export --json` prints."""

from __future__ import annotations

from typing import Literal

from .base import FileModel

ExportFormat = Literal[
    "lerobot", "bop", "nerfstudio", "rerun", "mjcf", "urdf", "sdf", "usd", "ply", "colmap", "glb", "mesh",
]  # fmt: skip


class ExportResult(FileModel):
    """What was exported."""

    source: str
    format: ExportFormat
    out: str
    """The file or directory that was written."""
    facts: dict[str, int | float | str]
    """What was counted and measured; names carry the unit."""
    notes: tuple[str, ...] = ()
    """What the format cannot hold, and what was left out."""
