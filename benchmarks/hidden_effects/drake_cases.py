"""The cases whose truth is drake."""

from __future__ import annotations

from dataclasses import replace

from cgwm.datasets.synthetic.hidden_effects import Case
from cgwm.datasets.synthetic.hidden_effects.plan import SIZES, THINGS, Noise, Stage, planned_case
from cgwm.datasets.synthetic.hidden_effects.things import Kind

DRAKE: tuple[tuple[Kind, str], ...] = (
    ("cube", "linear_drag"),
    ("ball", "magnus_lift"),
    ("cube", "com_offset"),
    ("ball", "gravity_tilt"),
    ("cube", "spin_damping"),
    ("cube", "viscous_friction"),
    ("cube", "length_scale"),
    ("ball", "gust"),
)
"""Effects that the second engine hides, too."""


def drake_cases(stage: Stage, repeats: int = 1, nulls: int = 40, noise: Noise = "spread") -> list[Case]:
    """Return cases whose truth is drake: nulls, and eight effects, small and large; see `cases`."""
    found = [
        planned_case(stage, noise, thing, (name,), size, k, "/drake")
        for thing, name in DRAKE
        for size in SIZES
        for k in range(repeats)
    ]
    found += [planned_case(stage, noise, THINGS[k % 2], (), "large", k, "/drake") for k in range(nulls)]
    return [replace(case, engine="drake", law=1) for case in found]
