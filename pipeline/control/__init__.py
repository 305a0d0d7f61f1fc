"""A fitted model as the environment of a controller, and as the model by which one plans (`cgwm control`)."""

from .closed_loop import ClosedLoop, Reach, Targets, Velocity
from .controller import Controller, ControlPlan, ControlState
from .stage import control

__all__ = ["ClosedLoop", "ControlPlan", "ControlState", "Controller", "Reach", "Targets", "Velocity", "control"]
