"""Score tests: is an effect missing? One Jacobian of all states, the model's numbers and all candidates at neutral.

For an effect e beside the model's numbers b, with M and g summed over segments (their states projected out):
M_e = M_ee - M_eb M_bb^-1 M_be, g_e = g_e - M_eb M_bb^-1 g_b, LM = g_e' M_e^-1 g_e, distributed as chi2 with as many
degrees of freedom as e has numbers where nothing is missing (Rao 1948; Breusch & Pagan 1980). In flight that holds; in
contact, where the law itself misses more than noise, the same number is compared with what data without an effect
give, see `verdict.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..physics.fused.packing import reason_against
from ..physics.parameters import Parameter
from ..physics.world import World
from ..tails import chi2_tail, normal_tail
from .candidates import Variant, acts_in, base_parameters, base_values, with_variants
from .linear import Linear, projected
from .segments import Segments

Array = NDArray[np.float64]

MEASURED = 0.04
"""A direction is measured where its standard error is below five widths of the parameters' priors: information times
their variance above this."""
PART_ROLLOUTS = 700
"""Rollouts of candidates in one world: more effects at once cost more than the calls that they save."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The linear picture of segments with the model's numbers (b) and all candidates, in scales that matter.

    parameters (P); information (B, P, P) and score (B, P) of each segment, unweighted; weight (B,); episode (B,);
    group (B,): session of each segment; prior (P,): information on each number beside the data.
    """

    parameters: tuple[Parameter, ...]
    base: int
    information: Array
    score: Array
    weight: Array
    episode: NDArray[np.int64]
    group: NDArray[np.int64]
    prior: Array
    chi2: Array
    dof: Array

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the places of parameters by name."""
        place = {p.name: k for k, p in enumerate(self.parameters)}
        return [place[name] for name in names]

    def without_episode(self, episode: int) -> Picture:
        """Return the picture in which an episode counts nothing."""
        return replace(self, weight=np.where(self.episode == episode, 0.0, self.weight))

    def only_episode(self, episode: int) -> Picture:
        """Return the picture in which only one episode counts."""
        return replace(self, weight=np.where(self.episode == episode, self.weight, 0.0))


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """What a score test says of an effect.

    statistic: LM; dof; p_value: one-sided where the sign is known; estimate (k,) and covariance (k, k): one step from
    neutral, in the parameters' units; admissible: whether the signs are those that the effect admits.
    """

    statistic: float
    dof: int
    p_value: float
    estimate: Array
    covariance: Array
    admissible: bool


def picture(
    segments: Segments, world: World, variants: Sequence[Variant], groups: Sequence[int], robust: bool
) -> Picture:
    """Return the linear picture of fitted segments of one kind.

    Args:
        segments: With fitted states.
        world: The model's world.
        variants: The candidates.
        groups: Session of each episode.
        robust: Whether segments that fit badly count less.
    """
    base = base_parameters(world, segments.kind)
    variants = [variant for variant in variants if acts_in(variant, segments.kind)]
    parameters = [*base, *with_variants(world, variants, segments.kind)[1]]
    if not parameters:
        raise ValueError("no candidate acts in these segments")
    at = segments.in_world(world)
    rows, jacobian = at.residuals(base, base_values(world, base))
    assert jacobian is not None
    columns = {p.name: jacobian[..., k] for k, p in enumerate(base)}
    # at neutral a candidate does nothing, so that each part of them has a world, and rollouts, of its own
    for part in _parts(variants, segments, at.world):
        beside, numbers = with_variants(world, part, segments.kind)
        at = segments.in_world(beside)
        slopes = at.slopes(numbers, base_values(beside, numbers), rows)
        columns |= {p.name: slopes[..., k] for k, p in enumerate(numbers)}
    own = torch.stack([columns[p.name] for p in parameters], -1)
    linear = projected(segments, rows, torch.cat((own, jacobian[..., len(base) :]), -1), len(parameters))
    return _picture(linear, segments, parameters, len(base), groups, robust)


def _parts(variants: Sequence[Variant], segments: Segments, world: World) -> list[list[Variant]]:
    """Return candidates in parts of one batch each: every rollout pays for all effects of its world.

    Those that the fused kernel takes are kept apart from those that it does not, and it takes one of a kind.
    """
    most = max(1, PART_ROLLOUTS // len(segments.items))
    parts: list[tuple[bool, list[Variant]]] = []
    for variant in variants:
        fast = reason_against(replace(world, effects=(*world.effects, variant.active))) is None
        part = next((part for kind, part in parts if kind == fast and _fits(part, variant, most, fast)), None)
        if part is None:
            parts.append((fast, [variant]))
        else:
            part.append(variant)
    return [part for _, part in parts]


def _fits(part: Sequence[Variant], variant: Variant, most: int, one_of_a_kind: bool) -> bool:
    """Whether a part takes one candidate more."""
    alike = any(type(other.active.effect) is type(variant.active.effect) for other in part)
    return sum(len(v.parameters) for v in (*part, variant)) <= most and not (one_of_a_kind and alike)


def _picture(
    linear: Linear,
    segments: Segments,
    parameters: Sequence[Parameter],
    base: int,
    groups: Sequence[int],
    robust: bool,
) -> Picture:
    episode = np.array([item.episode for item in segments.items])
    weight = linear.weight if robust else torch.ones_like(linear.chi2)
    prior = np.array([1 / p.prior[1] ** 2 if k < base else 0.0 for k, p in enumerate(parameters)])
    return Picture(
        tuple(parameters),
        base,
        linear.information.numpy(),
        linear.score.numpy(),
        weight.numpy(),
        episode,
        np.asarray(groups)[episode],
        prior,
        linear.chi2.numpy(),
        linear.dof.numpy(),
    )


def score_test(
    seen: Picture, columns: Sequence[int], nuisance: Sequence[int] | None = None, dispersion: float = 1.0
) -> ScoreTest:
    """Return the score test of the parameters in `columns` beside those in `nuisance` (default: the model's numbers).

    Args:
        seen: The picture.
        columns: Places of the effect's parameters.
        nuisance: Places of what is fitted along.
        dispersion: By what factor variances are larger than those of the noise.
    """
    beside = list(range(seen.base)) if nuisance is None else list(nuisance)
    information, score = sums(seen, [*beside, *columns])
    width = widths(seen, [*beside, *columns])
    count = len(width) - len(widths(seen, columns))
    size = len(width) - count
    reduced, slope = _eliminate(information, score, count)
    estimate, covariance, statistic, rank = solved(reduced, slope, width[count:])
    statistic, covariance = statistic / dispersion, covariance * dispersion
    given = [seen.parameters[k] for k in columns]
    nonnegative = np.array([p.bounds[0] == 0.0 for p in given])
    shared = estimate[: len(given)] if size == len(given) else estimate
    if rank == 0:
        return ScoreTest(0.0, 0, 1.0, estimate, covariance, True)
    if size == 1 and nonnegative[0]:
        z = float(np.sign(estimate[0]) * np.sqrt(statistic))
        return ScoreTest(statistic if z > 0 else 0.0, 1, normal_tail(z), estimate, covariance, z > 0)
    fine = not (size == len(given) and bool((shared[nonnegative] < 0).any()))
    return ScoreTest(statistic, rank, chi2_tail(statistic, rank), estimate, covariance, fine)


def gain_by_episode(seen: Picture, columns: Sequence[int], nuisance: Sequence[int] | None = None) -> Array:
    """Return by how much each episode's cost falls when the others tell the effect's parameters, linearised.

    Of episode t: (2 g_t' x - x' M_t x) with effect and model's numbers x from the other episodes, less the same with
    the model's numbers alone. Positive: the effect helps where it was not fitted.
    """
    beside = list(range(seen.base)) if nuisance is None else list(nuisance)
    gains = []
    for episode in np.unique(seen.episode):
        others, own = seen.without_episode(episode), seen.only_episode(episode)
        parts = []
        for chosen in ([*beside, *columns], beside):
            if not chosen:
                parts.append(0.0)
                continue
            information, score = sums(others, chosen)
            x = solved(information, score, widths(seen, chosen))[0]
            mine, slope = sums(replace(own, prior=np.zeros_like(own.prior)), chosen)
            parts.append(float(2 * slope @ x - x @ mine @ x))
        gains.append(parts[0] - parts[1])
    return np.array(gains)


def canonical_correlation(seen: Picture, a: Sequence[int], b: Sequence[int]) -> float:
    """Return how well the effect of parameters `a` can be taken for one of `b`, the model's numbers fitted along.

    The largest canonical correlation of their blocks of the information.
    """
    beside = list(range(seen.base))
    information, score = sums(seen, [*beside, *a, *b])
    reduced, _ = _eliminate(information, score, len(beside))
    n = len(a)
    roots = [_inverse_root(block) for block in (reduced[:n, :n], reduced[n:, n:])]
    return float(np.clip(np.linalg.svd(roots[0].T @ reduced[:n, n:] @ roots[1], compute_uv=False).max(), 0.0, 1.0))


def sums(seen: Picture, columns: Sequence[int], beside: Array | None = None) -> tuple[Array, Array]:
    """Return information and score of chosen parameters, one of each for every session or episode where they say so.

    Args:
        seen: The picture.
        columns: Places of the parameters.
        beside: Information on the numbers beside the data; that of the picture by default.
    """
    chosen = list(columns)
    m = seen.information[:, chosen][:, :, chosen] * seen.weight[:, None, None]
    g = seen.score[:, chosen] * seen.weight[:, None]
    places, prior = layout(seen, chosen)
    information, score = np.diag(prior if beside is None else beside), np.zeros(len(prior))
    np.add.at(score, places, g)
    np.add.at(information, (places[:, :, None], places[:, None, :]), m)
    return information, score


def layout(seen: Picture, columns: Sequence[int]) -> tuple[NDArray[np.int64], Array]:
    """Return the place (B, k) of each parameter of each segment among the numbers, and their prior information."""
    places, count = np.zeros((len(seen.episode), len(columns)), np.int64), 0
    prior: list[float] = []
    for k, column in enumerate(columns):
        parameter = seen.parameters[column]
        places[:, k], number = count, 1
        if parameter.shared != "all":
            owner = seen.group if parameter.shared == "group" else seen.episode
            places[:, k] += np.unique(owner, return_inverse=True)[1]
            number = int(places[:, k].max()) - count + 1
        count += number
        # a prior ties the values of sessions to each other, about neutral
        prior += [seen.prior[column] if parameter.shared == "all" else 1 / parameter.prior[1] ** 2] * number
    return places, np.array(prior)


def widths(seen: Picture, columns: Sequence[int]) -> Array:
    """Return the widths of the priors of the numbers that `sums` gives."""
    places, prior = layout(seen, columns)
    widths = np.ones(len(prior))
    for k, column in enumerate(columns):
        widths[places[:, k]] = seen.parameters[column].prior[1]
    return widths


def _eliminate(information: Array, score: Array, count: int) -> tuple[Array, Array]:
    """Return information and score of what follows the first `count` numbers, those projected out."""
    if count == 0:
        return information, score
    inverse = _pinv(information[:count, :count])
    mixed = information[count:, :count] @ inverse
    return information[count:, count:] - mixed @ information[:count, count:], score[count:] - mixed @ score[:count]


def solved(information: Array, score: Array, width: Array) -> tuple[Array, Array, float, int]:
    """Return estimate, covariance, statistic and rank, of the directions that were measured; widths (k,) of priors."""
    values, vectors = np.linalg.eigh(information * np.outer(width, width))
    kept = values > MEASURED
    vectors = vectors[:, kept] * width[:, None]
    along = vectors.T @ score
    estimate = vectors @ (along / values[kept])
    covariance = (vectors / values[kept]) @ vectors.T
    return estimate, covariance, float((along**2 / values[kept]).sum()), int(kept.sum())


def _pinv(matrix: Array) -> Array:
    scale = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
    return np.linalg.pinv(matrix / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)


def _inverse_root(matrix: Array) -> Array:
    """Return W with W W' the inverse of an information matrix."""
    scale = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    kept = values > 1e-8 * max(values.max(initial=0.0), 1e-300)
    return (vectors[:, kept] / np.sqrt(values[kept])) / scale[:, None]
