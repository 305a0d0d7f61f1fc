"""Captures with hidden effects from an independent simulator, for the benchmark of `cgwm diagnose` and `cgwm demo`.

Nothing here imports `cgwm.pipeline`: MuJoCo simulates the bodies, and the effects are implemented independently, with
formulas that differ from those of cgwm where those of real effects would.
"""

from . import contact, flight, measured, unknown
from .case import Case
from .filmed import film_capture
from .mystery import draw_mystery, make_mystery, open_sealed
from .plan import (
    KNOWN,
    PAIRS,
    STAGES,
    UNKNOWN,
    cases,
    filmed_cases,
    odd_cases,
    rough_cases,
    sharp_filmed_cases,
)
from .record import ENGINES, make_capture
from .registry import EFFECTS

TRUTHS = (flight, contact, measured, unknown)
"""Modules of the effects; importing one registers its effects."""

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
    "sharp_filmed_cases",
]
