"""Wind and drag together: neither shows at the neutral value of the other, so that no score test finds the two.

In still air a drag is a force against the velocity; in wind the same drag has a constant force beside it. Where the
search has found a drag and something else, a drag in wind is tried instead of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..physics.effects.effect import ActiveEffect
from ..physics.world import World
from ..tails import chi2_tail
from .candidates import Candidate, base_parameters, base_values
from .refit import Refit, refit
from .score import ScoreTest
from .segments import Segments
from .slots import Evidence

DRAGS = ("linear_drag", "quadratic_drag")
WIND, FORCE = "wind", "constant_force"
ITERATIONS = 12


@dataclass(frozen=True)
class Bundle:
    """A drag and the wind: their evidence, the refit with both, and its cost with the penalty of BIC."""

    drag: Evidence
    wind: Evidence
    refitted: Refit
    total: float


def drag_in_wind(
    flight: Segments, world: World, candidates: Sequence[Candidate], count: float, dispersion: float
) -> Bundle | None:
    """Return the best drag in wind beside a world; None where the candidates have none.

    Args:
        flight: Segments with states fitted by the world.
        world: Without drag and wind.
        candidates: All candidates.
        count: Number of measured numbers, for the penalty of BIC.
        dispersion: By what factor variances exceed those of the noise.
    """
    by_name = {candidate.effect.name: candidate for candidate in candidates}
    if WIND not in by_name or FORCE not in by_name or DRAGS[0] not in by_name:
        return None
    still = _fitted(flight, world, [by_name[DRAGS[0]], by_name[FORCE]], {})
    drag = max(still.number("linear_drag.c")[0], 1e-3)
    air = [still.number(f"{FORCE}.f_{axis}")[0] / drag for axis in "xy"]
    velocity = flight.observations.state.velocity_m_s[:, flight.observations.free[0], :2]
    speed = float((velocity - torch.tensor(air).to(velocity)).norm(dim=1).mean())
    starts = {"linear_drag": {"linear_drag.c": drag}, "quadratic_drag": {"quadratic_drag.k": drag / max(speed, 0.1)}}
    nothing = refit([flight], world, base_parameters(world, "flight"))
    found = []
    for name in DRAGS:
        if name not in by_name:
            continue
        start = starts[name] | {f"{WIND}.w_{axis}": value for axis, value in zip("xy", air, strict=True)}
        alone = _fitted(flight, world, [by_name[name]], starts[name])
        both = _fitted(flight, world, [by_name[name], by_name[WIND]], start)
        numbers = len(by_name[name].effect.parameters) + len(by_name[WIND].effect.parameters)
        total = both.cost / dispersion + numbers * float(np.log(count))
        gains = tuple((without.cost - both.cost) / dispersion for without in (nothing, alone))
        evidence = [_evidence(by_name[n], both, gain, count) for n, gain in zip((name, WIND), gains, strict=True)]
        found.append(Bundle(evidence[0], evidence[1], both, total))
    return min(found, key=lambda one: one.total, default=None)


def _fitted(flight: Segments, world: World, added: Sequence[Candidate], start: dict[str, float]) -> Refit:
    like = world.gravity[0, :1]
    effects = tuple(ActiveEffect.of(candidate.effect, None, like) for candidate in added)
    full = replace(world, effects=(*world.effects, *effects))
    parameters = base_parameters(full, "flight")
    values = base_values(full, parameters)
    for place, parameter in enumerate(parameters):
        values[place] = start.get(parameter.name, values[place])  # effects have no logarithmic numbers
    return refit([flight], full, parameters, values, ITERATIONS)


def _evidence(candidate: Candidate, fitted: Refit, gain: float, count: float) -> Evidence:
    """Return the evidence of an effect of the bundle; gain: by how much chi2 falls; count: see `drag_in_wind`."""
    effect = candidate.effect
    numbers = {p.name: fitted.number(f"{effect.name}.{p.name}") for p in effect.parameters}
    size = len(numbers)
    penalty = size * float(np.log(count))
    estimate = np.array([value for value, _ in numbers.values()])
    covariance = np.diag([std**2 for _, std in numbers.values()])
    p_value = chi2_tail(max(gain, 0.0), size)
    test = ScoreTest(gain, size, p_value, estimate, covariance, True)
    return Evidence(candidate, {}, test, p_value, refitted=fitted, delta_bic=penalty - gain, numbers=numbers)
