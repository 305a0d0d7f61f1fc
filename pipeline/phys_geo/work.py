"""The work of fitting physics to motion, estimated from counts."""

from __future__ import annotations

from collections.abc import Sequence

from ...schemas import PhysConfig
from ..physics.chains.parameters import chain_parameters
from ..physics.parameters import contact_parameters
from ..physics.rollout_cost import rollout_part
from ..physics.world import World
from ..runtime.work_budget import Part
from .tracks.contact_fit import MAX_EPISODES, MAX_SPAN_S
from .tracks.open_loop_search import ENOUGH_EPISODES, MAX_ROLLOUTS, SEVERAL_EPISODES, default_population

LESS = "pass a longer --set phys-geo.step_s, or smaller phys-geo.generations or phys-geo.population."
_SHOOTING_COLUMNS, _SHOOTING_STARTS = 20, (25, 4)
"""Rollouts of the whole motion for a step of multiple shooting, and number of its descents with their line searches,
for fewer episodes than `SEVERAL_EPISODES` and for more."""
_EFFECT_ROLLOUTS = 400
"""Rollouts of the whole motion for the fit of an effect."""
_USUAL_STEPS = 100
"""Number of steps after which any descent has converged, whatever the settings allow."""


def fit_parts(world: World, spans_s: Sequence[float], config: PhysConfig) -> list[Part]:
    """Return the parts of the work of fitting physics.

    Args:
        world: The world.
        spans_s: Duration of each episode [s].
        config: The stage's settings.
    """
    parameters = len(contact_parameters(world)) + len(chain_parameters(world)) + 1
    used = [min(span, MAX_SPAN_S) for span in spans_s][:MAX_EPISODES]
    rollouts = float(config.generations) * (config.population or default_population(max(len(used), 1), parameters))
    parts = [rollout_part("the search", world, used, rollouts, MAX_ROLLOUTS)]
    if len(used) < ENOUGH_EPISODES:
        starts = _SHOOTING_STARTS[len(used) >= SEVERAL_EPISODES]
        steps = min(config.iterations, _USUAL_STEPS) * _SHOOTING_COLUMNS * starts
        parts.append(rollout_part("multiple shooting", world, used, steps, MAX_ROLLOUTS))
    if world.effects:
        rollouts = _EFFECT_ROLLOUTS * len(world.effects)
        parts.append(rollout_part("the fit of effects", world, spans_s, rollouts, MAX_ROLLOUTS))
    return parts
