"""Validation of captures, models and datasets."""

from .stage import validate

__all__ = ["validate"]
