"""Captures with hidden effects, by an independent truth: what `cgwm diagnose` is judged by, and `cgwm demo` walks on.

Nothing here knows of `cgwm.pipeline`: MuJoCo moves the bodies, and the effects have their own formulas, which differ
from cgwm's where a real one would.
"""

from . import contact, flight, measured, unknown
from .case import Case
from .filmed import film_capture
from .mystery import draw_mystery, make_mystery, open_sealed
from .plan import KNOWN, PAIRS, STAGES, UNKNOWN, cases, filmed_cases, odd_cases, rough_cases
from .record import ENGINES, make_capture
from .registry import EFFECTS

TRUTHS = (flight, contact, measured, unknown)
"""The modules of the effects, which enter them in the registry."""

__all__ = [
    "EFFECTS",
    "ENGINES",
    "KNOWN",
    "PAIRS",
    "STAGES",
    "TRUTHS",
    "UNKNOWN",
    "Case",
    "cases",
    "draw_mystery",
    "film_capture",
    "filmed_cases",
    "make_capture",
    "make_mystery",
    "odd_cases",
    "open_sealed",
    "rough_cases",
]
