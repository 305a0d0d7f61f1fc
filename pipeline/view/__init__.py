"""Viewer of models and datasets in the browser."""

from .stage import open_replays, open_view

__all__ = ["open_replays", "open_view"]
