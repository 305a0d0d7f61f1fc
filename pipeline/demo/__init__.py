"""Demonstrations: run the whole pipeline on synthetic scenes and report the results."""

from .control_demo import run_control_demo
from .mystery import run_mystery
from .stage import run_demo
from .world_demo import run_world

__all__ = ["run_control_demo", "run_demo", "run_mystery", "run_world"]
