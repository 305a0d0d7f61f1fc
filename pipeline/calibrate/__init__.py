"""Calibrate cameras from photos with COLMAP, with a metric scale and the world's axes."""

from .stage import calibrate
from .target import calibrate_target
from .target_board import print_target

__all__ = ["calibrate", "calibrate_target", "print_target"]
