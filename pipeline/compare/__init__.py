"""Comparison of models with measured motion: figures and a page that show where and when each model fails."""

from .stage import compare

__all__ = ["compare"]
