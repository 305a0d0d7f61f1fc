"""Captures on disk: manifest, photos, videos, tracks and cameras, read and checked."""

from .capture import Capture

__all__ = ["Capture"]
