"""Demonstrations: run the whole pipeline on synthetic scenes and report the results."""

from .mystery import run_mystery
from .stage import run_demo

__all__ = ["run_demo", "run_mystery"]
