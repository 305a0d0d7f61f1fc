"""Starts for fits to all sliding segments, from fits of each segment alone with a friction of its own.

Where a body slides under two frictions, as on a patch, no common friction is near both, and a spin that is predicted
wrongly by more than half a turn shows the descent the wrong way: it stalls, with the effect and without. Each segment
alone is fitted well. About these fits chi2 is a quadratic form of the friction and of any effect, and where the effect
is what makes the frictions differ, the minimum of the sum of these forms is near the joint one (derived).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...physics.parameters import FRICTION
from ...physics.state import State
from ..candidates import Variant, base_values, with_variants
from ..segments import Segments
from .descent import fit_groups, information_by_segment
from .fit import HELD_ITERATIONS, StartedSliding, nuisance_parameters


def separate_starts(started: StartedSliding, variants: Sequence[Variant]) -> list[tuple[Segments, Tensor, float]]:
    """Return for each variant segments with states, values to start from, and their chi2; of the model alone for none.

    Args:
        started: The sliding segments and their fits.
        variants: To fit, all in one batch.
    """
    world, alone = started.segments.world, started.separate
    extended, own = with_variants(world, variants, "contact")
    known = nuisance_parameters(world, started.flight_parameters)
    parameters = [*known, *own]
    place, count = {p.name: k for k, p in enumerate(parameters)}, len(alone.chi2)
    centre = base_values(extended, parameters)
    values = centre.expand(count, -1).clone()
    values[:, place[FRICTION.name]] = alone.values[:, 0]
    segments = alone.segments.in_world(extended)
    information, score = information_by_segment(segments, parameters, values)
    # a segment that its own friction does not explain counts as little as its residuals say
    weight = (segments.dof / torch.maximum(alone.chi2, segments.dof)).to(values)[:, None]
    prior = torch.tensor([p.prior[1] for p in parameters]).to(values).pow(-2)
    low, high = torch.tensor([p.limits for p in parameters]).to(values).T
    total = (weight[..., None] * information).sum(0) + torch.diag(prior)
    slope = (weight * (score + (information @ values[..., None])[..., 0])).sum(0) + prior * centre
    shared = list(range(len(known)))
    rows = [[*shared, *(place[name] for name in v.parameters)] for v in variants] or [shared]
    begun = centre.repeat(len(rows), 1)
    for k, row in enumerate(rows):
        begun[k, row] = torch.linalg.solve(total[row][:, row], slope[row])
    begun = torch.minimum(torch.maximum(begun, low), high)
    every = segments.select(list(range(count)) * len(rows))
    every = every.with_state(State.joined(*(segments.observations.state for _ in rows)))
    group = torch.arange(len(rows)).repeat_interleave(count)
    free = torch.arange(len(known)).expand(len(rows), -1)
    found = fit_groups(every, parameters, begun, free, group, HELD_ITERATIONS)
    costs, state = found.chi2.unflatten(0, (-1, count)).sum(-1), found.segments.observations.state
    return [
        (
            started.segments.with_state(state.at(torch.arange(k * count, (k + 1) * count))),
            found.values[k, row],
            float(costs[k]),
        )
        for k, row in enumerate(rows)
    ]
