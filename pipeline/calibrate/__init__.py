"""Calibrate cameras from photos with COLMAP, with a metric scale and the world's axes."""

from .stage import calibrate
from .target.board import print_target
from .target.intrinsics import calibrate_target

__all__ = ["calibrate", "calibrate_target", "print_target"]
