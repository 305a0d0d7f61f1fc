"""The captures with hidden effects of `cgwm.datasets.synthetic.hidden_effects`, as lists, and a second truth.

From `benchmarks/`:

    from hidden_effects import Case, cases, make_capture
    make_capture("out/a", Case("a", "cube", ("quadratic_drag",), "large", seed=1))   # out/a, out/a.truth.json

    python -m hidden_effects list --stage report
    python -m hidden_effects make OUT --stage development --only ball/magnus_lift
    python -m hidden_effects make OUT --list drake         # the second truth: pip install drake
"""

from cgwm.datasets.synthetic.hidden_effects import (
    EFFECTS,
    ENGINES,
    KNOWN,
    PAIRS,
    STAGES,
    UNKNOWN,
    Case,
    cases,
    film_capture,
    filmed_cases,
    make_capture,
    odd_cases,
    rough_cases,
    sharp_filmed_cases,
)

from . import drake_engine
from .drake_cases import drake_cases

ENGINES["drake"] = drake_engine

__all__ = [
    "EFFECTS",
    "KNOWN",
    "PAIRS",
    "STAGES",
    "UNKNOWN",
    "Case",
    "cases",
    "drake_cases",
    "film_capture",
    "filmed_cases",
    "make_capture",
    "odd_cases",
    "rough_cases",
    "sharp_filmed_cases",
]
