"""Captures with hidden effects, by an independent truth: what `cgwm diagnose` is judged by.

Nothing here comes from `cgwm.pipeline`: MuJoCo moves the bodies, and the effects have their own formulas, which differ
from cgwm's where a real one would. From `benchmarks/`:

    from hidden_effects import Case, cases, make_capture
    make_capture("out/a", Case("a", "cube", ("quadratic_drag",), "large", seed=1))   # out/a, out/a.truth.json

    python -m hidden_effects list --stage report
    python -m hidden_effects make OUT --stage development --only ball/magnus_lift
    python -m hidden_effects make OUT --list drake         # the second truth: pip install drake
"""

from . import contact, flight, measured, unknown
from .case import Case
from .plan import KNOWN, PAIRS, UNKNOWN, cases, drake_cases, rough_cases
from .record import make_capture
from .registry import EFFECTS

TRUTHS = (flight, contact, measured, unknown)
"""The modules of the effects, which enter them in the registry."""

__all__ = [
    "EFFECTS",
    "KNOWN",
    "PAIRS",
    "TRUTHS",
    "UNKNOWN",
    "Case",
    "cases",
    "drake_cases",
    "make_capture",
    "rough_cases",
]
