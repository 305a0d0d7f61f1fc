"""Detection limits in contact: the smallest size from which a contact effect would have been selected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from ...physics.world import World
from ...segments.candidates import Candidate, Variant, admissible, base_values, variants_of, with_variants
from ...segments.sliding.descent import SlidingFit
from ...segments.sliding.fit import StartedSliding, fit_sliding, noiseless_misfits, nuisance_parameters
from ...segments.sliding.variant_fits import batches
from ..thresholds import THRESHOLDS


@dataclass(frozen=True)
class DetectionLimit:
    """Detection limit of a candidate that acts in contact."""

    candidate: Candidate
    """The candidate."""
    sizes: dict[str, float] = field(default_factory=dict)
    """Limit by parameter, in its unit; empty where no admissible size would have been detected."""
    constants: dict[str, float] = field(default_factory=dict)
    """Constants with the lowest limit."""


@dataclass(frozen=True)
class _VariantLimit:
    """Detection limit of a candidate at one choice of its constants."""

    variant: Variant
    """The candidate with these constants."""
    times: float
    """Limit in units of the usual sizes of the parameters."""
    values: NDArray[np.float64]
    """Parameters (P,) at the limit, in the direction with the largest standard error."""


def detection_limits(
    started: StartedSliding | None,
    world: World,
    candidates: Sequence[Candidate],
    score: tuple[float, float],
    turned: bool,
    blind_to: Sequence[str],
) -> list[DetectionLimit]:
    """Return the detection limits of all contact candidates in sliding segments; empty without sliding segments.

    The score of an effect of size x is (x / sigma)^2, with sigma the standard error of its parameter, estimated jointly
    with the friction and the nuisance parameters; for several parameters it is the largest standard error over all
    directions. An effect has no limit where a fit without it reproduces the motions that it would cause: one so strong
    that it ends a slide at once looks like friction.

    Args:
        started: The sliding segments and their fit; None without any.
        world: The model's world.
        candidates: All candidates.
        score: Minimum scores of a selected effect of one parameter, and of one with more.
        turned: Whether orientations were measured.
        blind_to: Names of effects that sliding segments do not show.
    """
    if started is None:
        return []
    kept, _ = admissible(world, candidates, turned)
    acting = [c for c in kept if c.effect.phase == "contact"]
    asked = [c for c in acting if c.effect.name not in blind_to]
    spread = max(1.0, started.base.cost / float(started.segments.dof.sum()))
    least_chi2 = spread * score[0], spread * score[1]
    limits = _lowest_limits(started, variants_of(asked, world.gravity[0, :1]), least_chi2)
    sizes = {}
    for one, misfit in zip(limits, _misfits(started, limits), strict=True):
        if misfit > least_chi2[len(one.variant.parameters) > 1]:
            sizes[asked[one.variant.place].effect.name] = one
    return [_limit(candidate, sizes.get(candidate.effect.name)) for candidate in acting]


def _lowest_limits(
    started: StartedSliding, variants: Sequence[Variant], least_chi2: tuple[float, float]
) -> list[_VariantLimit]:
    """Return the lowest limit of each candidate over its constants, where it is an admissible size.

    Args:
        started: The sliding segments and their fit.
        variants: The candidates with each choice of their constants.
        least_chi2: Minimum decrease of chi2 by a selected effect of one parameter, and of one with more.
    """
    best: dict[int, _VariantLimit] = {}
    for part in batches(variants):
        start = [(started.base.segments, started.base.values[0])] * len(part)
        # the information where the fits begin, without a step
        fits = fit_sliding(started.segments.world, part, start, started.flight_parameters, iterations=0)
        for variant, fit in zip(part, fits, strict=True):
            one = _variant_limit(
                variant, fit, THRESHOLDS.experiment.safe * math.sqrt(least_chi2[len(variant.parameters) > 1])
            )
            if variant.place not in best or one.times < best[variant.place].times:
                best[variant.place] = one
    return [
        one
        for one in best.values()
        if one.times <= min(n.limit / n.scale for n in one.variant.active.effect.parameters)
    ]


def _variant_limit(variant: Variant, fit: SlidingFit, sigmas: float) -> _VariantLimit:
    """Return the size of a candidate that equals a number of standard errors."""
    parameters = variant.active.effect.parameters
    covariance = torch.linalg.pinv(fit.information[0], hermitian=True)[-len(parameters) :, -len(parameters) :].numpy()
    usual = np.array([parameter.scale for parameter in parameters])
    variances, directions = np.linalg.eigh(covariance / usual / usual[:, None])
    times = sigmas * math.sqrt(max(float(variances[-1]), 0.0))
    direction = directions[:, -1] * np.sign(directions[:, -1].sum() or 1.0)
    return _VariantLimit(variant, times, times * usual * direction)


def _misfits(started: StartedSliding, limits: Sequence[_VariantLimit]) -> list[float]:
    """Return chi2 (K,) of fits without the candidates to noiseless sliding motions simulated with each of them."""
    if not limits:
        return []
    extended, own = with_variants(started.segments.world, [one.variant for one in limits], "contact")
    known = nuisance_parameters(started.segments.world, started.flight_parameters)
    parameters = [*known, *own]
    values = base_values(extended, parameters)
    values[: len(known)] = started.base.values[0, : len(known)]
    place = {p.name: k for k, p in enumerate(parameters)}
    others = values.repeat(len(limits), 1)
    for row, one in zip(others, limits, strict=True):
        row[[place[name] for name in one.variant.parameters]] = torch.as_tensor(one.values).to(row)
    segments = started.base.segments.in_world(extended)
    return noiseless_misfits(segments, parameters, values, others, len(known))


def _limit(candidate: Candidate, found: _VariantLimit | None) -> DetectionLimit:
    """Return the detection limit of a candidate, empty where none was found."""
    if found is None:
        return DetectionLimit(candidate)
    sizes = {parameter.name: found.times * parameter.scale for parameter in candidate.effect.parameters}
    return DetectionLimit(candidate, sizes, found.variant.constants)
