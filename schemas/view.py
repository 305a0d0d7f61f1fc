"""What `cgwm view` prints."""

from __future__ import annotations

from .base import FileModel


class ViewReport(FileModel):
    """Where to look."""

    url: str
    """Address of the page; it holds the secret without which the server answers nothing."""
    showing: str
    """The dataset or model."""
