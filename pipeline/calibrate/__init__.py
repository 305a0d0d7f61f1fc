"""Calibrate cameras from photos with COLMAP, with a metric scale and the world's axes."""

from .stage import calibrate

__all__ = ["calibrate"]
