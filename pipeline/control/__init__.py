"""A fitted model as the environment of a controller, and as the model by which one plans (`cgwm control`)."""

from .closed_loop import ClosedLoop, Reach, Targets, Velocity
from .controller import Controller
from .hand.controller import HandController
from .planning import ControlPlan, ControlState
from .replay import Following, replays_of, replays_or_following
from .stage import control

__all__ = [
    "ClosedLoop",
    "ControlPlan",
    "ControlState",
    "Controller",
    "Following",
    "HandController",
    "Reach",
    "Targets",
    "Velocity",
    "control",
    "replays_of",
    "replays_or_following",
]
