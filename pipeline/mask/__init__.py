"""Masks of a body in photos and videos that have none yet."""

from .stage import mask
from .videos import mask_videos

__all__ = ["mask", "mask_videos"]
