"""A fitted model as the environment of a controller: a command in, a frame and the state out, step by step."""

from .closed_loop import ClosedLoop, Reach, Velocity

__all__ = ["ClosedLoop", "Reach", "Velocity"]
