"""Sliding fit: friction and effects shared by all sliding segments, with a start state for each, by Gauss-Newton.

A sliding segment starts on the ground and stays there: only the state coordinates along the ground are fitted, as
otherwise the fit would press the body into the ground to get more friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...physics.contact_law import ContactLaw
from ...physics.parameters import FRICTION, GROUND_SHIFT, Parameter, effect_parameters
from ...physics.state import State
from ...physics.world import World
from ...trajectories.bursts import without_grounded_bursts
from ...trajectories.residuals import STATE_SIZE, TrajectoryResiduals
from ...trajectories.segmentation import Segment
from ..candidates import Together, Variant, base_parameters, base_values
from ..contact_phases import is_round
from ..linearization import linearize, sums
from ..prepare import Prepared
from ..segments import Segments, line_state
from ..thresholds import SEGMENT_THRESHOLDS
from .descent import ITERATIONS, SlidingFit, fit_groups
from .residuals import soft_world
from .segments import find_sliding_segments, grounded_states, segments_on_surfaces
from .sliding_noise import noise_of_fit
from .support import on_surfaces

LIMITS = SEGMENT_THRESHOLDS.sliding_data

START_FRAMES = (4, 7)
"""Numbers of frames of the straight lines from which states are fitted first."""
FACTORS = (0.5, 0.8, 1.25, 2.0, 4.0, 12.0)
"""Multiples of a fitted effect at which friction and states are fitted again."""
HELD_ITERATIONS = 5
"""Maximum number of steps of these fits."""
START_FRICTION = (0.15, 0.35)
"""Friction coefficients from which each segment is fitted first."""


@dataclass(frozen=True)
class StartedSliding:
    """Sliding segments, each fitted with its own friction, before any effect is tested."""

    segments: Segments
    """Sliding segments in the world with the soft contact."""
    separate: SlidingFit
    """Fit of each segment alone, with a friction of its own."""
    friction: Tensor
    """Median logarithm of the friction over well-determined segments."""
    base: SlidingFit
    """Fit of the model without a candidate, with one friction for all."""
    flight_parameters: tuple[Parameter, ...]
    """Parameters of effects that act in flight, with their standard errors from the flights as priors. They act during
    sliding too, and are not known exactly: an error of half a thousandth of a radian in a tilt is a millimetre in a
    slide of half a second."""

    @staticmethod
    def of(prepared: Prepared, world: World, flight: Segments | None) -> StartedSliding | None:
        """Find and start the sliding segments of all episodes; return None where there are none.

        Args:
            prepared: The episodes.
            world: The model's world.
            flight: Flights with fitted states; None where there are none.
        """
        if not isinstance(world.contact, ContactLaw):
            return None
        if on_surfaces(world):
            return StartedSliding._on_surfaces(prepared, world, flight)
        if not prepared.has_orientation:
            return None
        prepared = replace(
            prepared, observations=without_grounded_bursts(prepared.observations, prepared.airborne, prepared.noise)
        )
        items = find_sliding_segments(world, prepared.observations, prepared.airborne, prepared.noise)
        if not items:
            return None
        return StartedSliding._of_items(prepared, world, flight, items)

    @staticmethod
    def _on_surfaces(prepared: Prepared, world: World, flight: Segments | None) -> StartedSliding | None:
        """Return the same where fixed surfaces carry the body.

        Without flights, its rolls and slides show the noise. The turns of a ball do not count: it turns by its way over
        its radius, which they tell ten times more exactly than positions, but not than triangles of a surface are.
        """
        if not prepared.has_orientation and not all(is_round(body) for body in world.bodies):
            return None
        whole = without_grounded_bursts(prepared.observations, prepared.airborne, prepared.noise)
        if len(whole.free) != 1 or len(world.bodies) != 1:
            return None
        items, carrying = segments_on_surfaces(world, whole, prepared.airborne, prepared.noise)
        if not items:
            return None
        whole = replace(whole, carried=carrying.carried)
        if is_round(world.bodies[whole.free[0]]):
            whole = replace(whole, has_orientation=torch.zeros_like(whole.has_orientation))
        prepared = replace(prepared, observations=whole)
        return StartedSliding._of_items(prepared, world, flight, items)

    @staticmethod
    def _of_items(
        prepared: Prepared, world: World, flight: Segments | None, items: Sequence[Segment]
    ) -> StartedSliding:
        """Start sliding segments."""
        soft = soft_world(world)
        segments = prepared.segments("contact", soft, items)
        separate, friction = _started(segments, float(world.contact.friction[0]))
        if on_surfaces(world) and prepared.flight is None:
            separate = with_own_noise(separate)
        segments = separate.segments
        flight_parameters = _flight_priors(flight, soft, prepared.groups)
        base = _base(segments, (friction, world.contact.friction[0].log().to(friction)), flight_parameters)
        return StartedSliding(segments, separate, friction, base, flight_parameters)


def _base(segments: Segments, frictions: Sequence[Tensor], flight_parameters: Sequence[Parameter]) -> SlidingFit:
    """Return the best fit of the model without a candidate, from the first guesses of the logarithm of the friction.

    The guesses are the median over segments and the contact law's value: a single segment can mislead the former, and a
    wrong friction is a local minimum.
    """
    tried = fit_sliding(segments.world, [], [(segments, one) for one in frictions], flight_parameters)
    return min(tried, key=lambda fit: fit.cost)


def _started(segments: Segments, known: float) -> tuple[SlidingFit, Tensor]:
    """Return sliding segments each fitted with its own friction, and the median logarithm of these frictions."""
    count = len(segments.items)
    states = [grounded_states(segments, line_state(segments, frames)) for frames in START_FRAMES]
    every = segments.in_states(states * len(START_FRICTION))
    values = torch.tensor([[FRICTION.encode(mu)] for mu in START_FRICTION]).repeat_interleave(len(states) * count, 0)
    values = values.to(segments.world.gravity)
    group = torch.arange(len(values))
    found = fit_groups(every, [FRICTION], values, torch.zeros(len(values), 1, dtype=torch.long), group)
    best = found.chi2.unflatten(0, (-1, count)).argmin(0) * count + torch.arange(count)
    certainty = found.information[best, 0, 0] - 1 / FRICTION.prior[1] ** 2
    good = (certainty > LIMITS.well_known) & (found.chi2[best] < LIMITS.well_fitted * segments.dof)
    own = found.values[best, 0]
    friction = own[good].median() if bool(good.any()) else torch.full_like(own[0], FRICTION.encode(known))
    states = found.segments.observations.state.at(best)
    alone = SlidingFit(segments.with_state(states), found.chi2[best], found.values[best], found.information[best])
    return alone, friction


def with_own_noise(alone: SlidingFit) -> SlidingFit:
    """Return fits of single segments with the noise that their residuals have, fitted again."""
    noise, model = noise_of_fit(alone.segments)
    segments, count = replace(alone.segments, noise=noise, noise_model=model), len(alone.chi2)
    free = torch.zeros(count, 1, dtype=torch.long)
    return fit_groups(segments, [FRICTION], alone.values, free, torch.arange(count), HELD_ITERATIONS)


def fit_sliding(
    world: World,
    variants: Sequence[Variant],
    starts: Sequence[tuple[Segments, Tensor]],
    flight_parameters: Sequence[Parameter],
    iterations: int = ITERATIONS,
) -> list[SlidingFit]:
    """Return the fit of each variant together with the nuisance parameters; of these alone without variants.

    Args:
        world: With the soft contact.
        variants: To fit, all in one batch.
        starts: For each variant, segments with states, and the values to start from, of a fit without or with it: as
            many of the first parameters as are known. Without variants, each start is fitted.
        flight_parameters: Parameters estimated in flight, with their standard errors as priors.
        iterations: Maximum number of steps.
    """
    every = Together.of(world, variants)
    known = nuisance_parameters(world, flight_parameters)
    parameters, shared = [*known, *every.parameters], list(range(len(known)))
    rows = [[*shared, *(len(known) + k for k in columns)] for columns in every.columns] or [shared] * len(starts)
    size, count = max(map(len, rows)), len(starts[0][0].items)
    free = torch.tensor([row + [-1] * (size - len(row)) for row in rows])
    values = base_values(every.world, parameters).repeat(len(rows), 1)
    every.set_constants(values, len(known))
    middle = values.clone()
    for k, (row, (_, value)) in enumerate(zip(rows, starts, strict=True)):
        given = value.reshape(-1)
        values[k, row[: len(given)]] = given
    free_start = [k for k, p in enumerate(parameters) if p not in flight_parameters]
    middle[:, free_start] = values[:, free_start]
    segments = starts[0][0]
    some = segments.in_world(every.world).select(list(range(count)) * len(rows))
    some = some.with_state(State.joined(*(one.observations.state for one, _ in starts)))
    group = torch.arange(len(rows)).repeat_interleave(count)
    found = fit_groups(some, parameters, values, free, group, iterations, middle)
    fits = []
    for k, row in enumerate(rows):
        chosen = slice(k * count, (k + 1) * count)
        states = found.segments.observations.state.at(torch.arange(k * count, (k + 1) * count))
        information = found.information[k : k + 1, : len(row), : len(row)]
        fits.append(
            SlidingFit(segments.with_state(states), found.chi2[chosen], found.values[k : k + 1, row], information)
        )
    return fits


def better_starts(
    world: World, variants: Sequence[Variant], fits: Sequence[SlidingFit], flight_parameters: Sequence[Parameter]
) -> list[tuple[Segments, Tensor]]:
    """Return for each fit of a variant where to go on: there, or at a multiple of its effect if that fits better.

    A friction that grows with the speed and a lower constant one cancel each other: along that valley the cost falls
    slowly and is curved, and joint steps stall in it. With the effect held, friction and states follow in a few steps.

    Args:
        world: With the soft contact.
        variants: As fitted, all in one batch.
        fits: Of the variants.
        flight_parameters: See :func:`fit_sliding`.
    """
    together = Together.of(world, variants)
    known = nuisance_parameters(world, flight_parameters)
    parameters = [*known, *together.parameters]
    columns_of = [[len(known) + k for k in columns] for columns in together.columns]
    count, each = len(fits[0].segments.items), len(FACTORS)
    values = base_values(together.world, parameters).repeat(len(variants) * each, 1)
    together.set_constants(values, len(known), each)
    low, high = torch.tensor([p.limits for p in together.parameters]).to(values).T
    for k, (columns, fit) in enumerate(zip(columns_of, fits, strict=True)):
        rows = slice(k * each, (k + 1) * each)
        values[rows, : len(known)] = fit.values[0, : len(known)]
        values[rows, columns] = torch.tensor(FACTORS).to(values)[:, None] * fit.values[0, len(known) :]
    values[:, len(known) :] = torch.minimum(torch.maximum(values[:, len(known) :], low), high)
    values, owner, place_of = _distinct(values, each)
    every = fits[0].segments.in_world(together.world).select(list(range(count)) * len(values))
    every = every.with_state(State.joined(*(fits[k].segments.observations.state for k in owner)))
    free = torch.arange(len(known)).expand(len(values), -1)
    group = torch.arange(len(values)).repeat_interleave(count)
    found = fit_groups(every, parameters, values, free, group, HELD_ITERATIONS)
    costs = found.chi2.unflatten(0, (len(values), count)).sum(-1)[place_of]
    starts = []
    for k, (columns, fit) in enumerate(zip(columns_of, fits, strict=True)):
        best = int(costs[k].argmin())
        if float(costs[k, best]) >= fit.cost:
            starts.append((fit.segments, fit.values[0]))
            continue
        row = int(place_of[k, best])
        states = found.segments.observations.state.at(torch.arange(row * count, (row + 1) * count))
        starts.append((fit.segments.with_state(states), found.values[row, [*range(len(known)), *columns]]))
    return starts


def _distinct(values: Tensor, each: int) -> tuple[Tensor, list[int], Tensor]:
    """Return values without those that occur again: multiples of 0 are all the same, and a bound stops large ones.

    Args:
        values: Of some variants, `each` rows for each of them (V each, P).
        each: Number of rows of a variant.

    Returns:
        The rows that differ (D, P), the variant of each, and for each row of a variant its place among them (V, each).
    """
    owner = torch.arange(len(values)) // each
    keys, place = torch.cat((owner[:, None].to(values), values), 1).unique(dim=0, return_inverse=True)
    return keys[:, 1:], keys[:, 0].long().tolist(), place.unflatten(0, (-1, each))


def noiseless_misfits(
    segments: Segments, parameters: Sequence[Parameter], values: Tensor, others: Tensor, along: int
) -> list[float]:
    """Return the chi2 (K,) that the first parameters alone leave of noiseless motions generated with other values.

    Args:
        segments: Sliding segments with fitted states, from which the motions begin.
        parameters: Parameters of their world (P), first those that are fitted.
        values: Their values (P,), in fitted coordinates; the fits start there.
        others: Values that generate the motions (K, P).
        along: Number of parameters that are fitted.
    """
    count, each, free = len(segments.items), len(others), list(segments.observations.free)
    every = segments.select(list(range(count)) * each)
    seen = every.observations
    made = TrajectoryResiduals(every.world, parameters, seen, *every.noise).rollout(
        others.repeat_interleave(count, 0), torch.zeros(count * each, STATE_SIZE * len(free)).to(values)
    )
    seen = replace(seen, position_m=made.position_m[:, :, free], quat_wxyz=made.quat_wxyz[:, :, free])
    group = torch.arange(each).repeat_interleave(count)
    columns = torch.arange(along).expand(each, along)
    found = fit_groups(replace(every, observations=seen), parameters, values.repeat(each, 1), columns, group)
    return found.chi2.unflatten(0, (each, count)).sum(1).tolist()


def nuisance_parameters(world: World, flight_parameters: Sequence[Parameter]) -> list[Parameter]:
    """Return the nuisance parameters of sliding: friction, height of a ground, contact effects, flight parameters."""
    ground = [GROUND_SHIFT] if world.ground_normal is not None else []
    return [FRICTION, *ground, *contact_effect_parameters(world), *flight_parameters]


def contact_effect_parameters(world: World) -> list[Parameter]:
    """Return the parameters of the contact effects that the model already has."""
    own = {a.effect.name for a in world.effects if a.effect.phase == "contact"}
    return [p for p in effect_parameters(world) if p.name.partition(".")[0] in own]


def _flight_priors(flight: Segments | None, world: World, groups: Sequence[int]) -> tuple[Parameter, ...]:
    """Return the parameters of effects that act in flight, with the standard errors from the flights as priors."""
    parameters = base_parameters(world, "flight")
    if flight is None or not parameters:
        return ()
    seen = linearize(flight, world, (), groups, robust=False)
    information, _ = sums(seen, range(seen.base))
    deviations = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    return tuple(replace(p, prior=(p.prior[0], float(s))) for p, s in zip(parameters, deviations, strict=True))
