"""Coupled test of drag and wind, which no score test finds together.

Neither shows at the neutral value of the other. In still air a drag is a force against the velocity; in wind the same
drag adds a constant force. Where the search has selected a drag and another effect, a drag in wind is tried instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ...optimization.tails import chi2_tail
from ...physics.effects.effect import ActiveEffect
from ...physics.world import World
from ...segments.candidates import Candidate, base_parameters, base_values
from ...segments.segment_fit import Refit, refit
from ...segments.segments import Segments
from ..evidence.evidence import Evidence
from ..evidence.score_test import ScoreTest

DRAGS = ("linear_drag", "quadratic_drag")
"""Names of the drags that are tried in wind."""
WIND, FORCE = "wind", "constant_force"
"""Names of the wind, and of the force that replaces it in the first fit."""
ITERATIONS = 12
"""Maximum number of iterations of a refit."""


@dataclass(frozen=True)
class CoupledFit:
    """Refit with a drag and the wind."""

    drag: Evidence
    """Evidence of the drag."""
    wind: Evidence
    """Evidence of the wind."""
    refitted: Refit
    """Refit with both."""
    total: float
    """Cost of the refit in units of the dispersion, plus the penalty of BIC."""


def drag_in_wind(
    flight: Segments, world: World, candidates: Sequence[Candidate], count: float, dispersion: float
) -> CoupledFit | None:
    """Fit each drag in wind and return the better one; None if the candidates do not include them.

    Args:
        flight: Segments with states fitted by the world.
        world: The world without drag and wind.
        candidates: All candidates.
        count: Number of measured values, for the penalty of BIC.
        dispersion: Factor by which variances exceed those of the noise.
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
        parameters = len(by_name[name].effect.parameters) + len(by_name[WIND].effect.parameters)
        total = both.cost / dispersion + parameters * float(np.log(count))
        gains = tuple((without.cost - both.cost) / dispersion for without in (nothing, alone))
        evidence = [_evidence(by_name[n], both, gain, count) for n, gain in zip((name, WIND), gains, strict=True)]
        found.append(CoupledFit(evidence[0], evidence[1], both, total))
    return min(found, key=lambda one: one.total, default=None)


def _fitted(flight: Segments, world: World, added: Sequence[Candidate], start: dict[str, float]) -> Refit:
    """Refit a world with added effects, from given start values by parameter name and from neutral otherwise."""
    like = world.gravity[0, :1]
    effects = tuple(ActiveEffect.of(candidate.effect, None, like) for candidate in added)
    full = replace(world, effects=(*world.effects, *effects))
    parameters = base_parameters(full, "flight")
    values = base_values(full, parameters)
    for place, parameter in enumerate(parameters):
        values[place] = start.get(parameter.name, values[place])  # effects have no logarithmic parameters
    return refit([flight], full, parameters, values, ITERATIONS)


def _evidence(candidate: Candidate, fitted: Refit, gain: float, count: float) -> Evidence:
    """Return the evidence of one of the coupled effects.

    Args:
        candidate: The effect.
        fitted: Refit with both effects.
        gain: Fall of chi2 that this effect causes.
        count: Number of measured values, for the penalty of BIC.
    """
    effect = candidate.effect
    estimates = {p.name: fitted.number(f"{effect.name}.{p.name}") for p in effect.parameters}
    size = len(estimates)
    penalty = size * float(np.log(count))
    estimate = np.array([value for value, _ in estimates.values()])
    covariance = np.diag([std**2 for _, std in estimates.values()])
    p_value = chi2_tail(max(gain, 0.0), size)
    test = ScoreTest(
        statistic=gain, dof=size, p_value=p_value, estimate=estimate, covariance=covariance, admissible=True
    )
    return Evidence(
        candidate=candidate,
        constants={},
        test=test,
        p_value=p_value,
        refitted=fitted,
        delta_bic=penalty - gain,
        numbers=estimates,
    )
