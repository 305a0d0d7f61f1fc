"""Masks of a body in photos that have none yet."""

from .stage import mask

__all__ = ["mask"]
