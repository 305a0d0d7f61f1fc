"""Viewer of models and datasets in the browser."""

from .stage import open_view

__all__ = ["open_view"]
