"""The Gauss-Newton linearization of all segments: parameters of the model and of all candidates, states eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..optimization.uncertainty import scaled_pinv
from ..physics.fused.packing import reason_against
from ..physics.parameters import Parameter
from ..physics.world import World
from .candidates import Together, Variant, acts_in, base_parameters, base_values, with_variants
from .impulse_errors import ImpulseErrors, estimated_errors, impacts_of, projected_with
from .segment_fit import Linear, projected
from .segments import Segments

Array = NDArray[np.float64]

PART_ROLLOUTS = 700
"""Maximum number of rollouts of candidates in one world: more effects at once cost more than the calls they save."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearization:
    """Gauss-Newton model of segments (B) in the parameters (P) of the model and all candidates."""

    parameters: tuple[Parameter, ...]
    """Parameters (P), those of the model first."""
    base: int
    """Number of the model's parameters."""
    information: Array
    """Information of each segment, unweighted, shape (B, P, P)."""
    score: Array
    """Score (negative gradient) of each segment, unweighted, shape (B, P)."""
    weight: Array
    """Weight of each segment, shape (B,)."""
    episode: NDArray[np.int64]
    """Index of the episode of each segment, shape (B,)."""
    group: NDArray[np.int64]
    """Session of each segment, shape (B,)."""
    prior: Array
    """Prior information on each parameter, shape (P,)."""
    chi2: Array
    """Chi-square of each segment, shape (B,)."""
    dof: Array
    """Degrees of freedom of each segment, shape (B,)."""

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the indices of parameters by name."""
        place = {p.name: k for k, p in enumerate(self.parameters)}
        return [place[name] for name in names]

    def without_episode(self, episode: int) -> Linearization:
        """Return the linearization in which one episode has no weight."""
        return replace(self, weight=np.where(self.episode == episode, 0.0, self.weight))

    def only_episode(self, episode: int) -> Linearization:
        """Return the linearization in which only one episode has weight."""
        return replace(self, weight=np.where(self.episode == episode, self.weight, 0.0))


def linearize(
    segments: Segments, world: World, variants: Sequence[Variant], groups: Sequence[int], robust: bool
) -> Linearization:
    """Return the linearization of fitted segments of one kind.

    Args:
        segments: With fitted states.
        world: The model's world.
        variants: The candidates.
        groups: Session of each episode.
        robust: Whether segments that fit badly get less weight.

    Raises:
        ValueError: If there is no parameter.
    """
    parameters, rows, jacobian = derivatives(segments, world, variants)
    if not parameters:
        raise ValueError("no candidate acts in these segments")
    linear = projected(segments, rows, jacobian, len(parameters))
    return _linearization(linear, segments, parameters, len(base_parameters(world, segments.kind)), groups, robust)


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactLinearization:
    """Contact segments linearised beside the errors of their impulses."""

    plain: Linearization
    """The linearization under the contact law alone."""
    beside: Linearization
    """The linearization without what errors of impulses can follow."""
    errors: ImpulseErrors
    """The errors."""


def linearize_contact(
    segments: Segments,
    world: World,
    variants: Sequence[Variant],
    groups: Sequence[int],
    errors: ImpulseErrors | None = None,
) -> ContactLinearization:
    """Return the linearization of fitted contact segments; those that fit badly get less weight.

    Args:
        segments: With fitted states.
        world: The model's world.
        variants: The candidates.
        groups: Session of each episode.
        errors: Errors of the impulses; estimated from the segments by default.
    """
    parameters, rows, jacobian = derivatives(segments, world, variants)
    impacts, count, base = impacts_of(segments.in_world(world)), len(parameters), len(base_parameters(world, "contact"))
    if errors is None:
        errors = estimated_errors(segments, rows, jacobian[..., count:], impacts)
    plain, beside = (
        _linearization(one, segments, parameters, base, groups, robust=True)
        for one in (
            projected(segments, rows, jacobian, count),
            projected_with(segments, rows, jacobian, impacts, errors, count),
        )
    )
    return ContactLinearization(plain=plain, beside=beside, errors=errors)


def derivatives(
    segments: Segments, world: World, variants: Sequence[Variant]
) -> tuple[list[Parameter], Tensor, Tensor]:
    """Return parameters (P), residuals (B, F, 6), and their Jacobian (B, F, 6, P + S) by parameters and states.

    Args:
        segments: With fitted states.
        world: The model's world, whose parameters come first.
        variants: The candidates, whose parameters follow.
    """
    base = base_parameters(world, segments.kind)
    variants = [variant for variant in variants if acts_in(variant, segments.kind)]
    parameters = [*base, *with_variants(world, variants, segments.kind)[1]]
    at = segments.in_world(world)
    rows, jacobian = at.residuals(base, base_values(world, base))
    columns = {p.name: jacobian[..., k] for k, p in enumerate(base)}
    # a candidate at neutral changes nothing, so that the parts can be computed in separate worlds
    for part in _parts(variants, segments, at.world):
        together = Together.of(world, part, segments.kind)
        values = base_values(together.world, together.parameters).repeat(len(part), 1)
        together.set_constants(values, 0)
        names = [name for variant in part for name in variant.parameters]
        places = [place for own in together.columns for place in own]
        owner = [k for k, own in enumerate(together.columns) for _ in own]
        slopes = segments.in_world(together.world).slopes(together.parameters, values[owner], places, rows)
        columns |= {name: slopes[..., k] for k, name in enumerate(names)}
    own = [columns[p.name][..., None] for p in parameters]
    return parameters, rows, torch.cat((*own, jacobian[..., len(base) :]), -1)


def _parts(variants: Sequence[Variant], segments: Segments, world: World) -> list[list[Variant]]:
    """Return candidates in parts of one batch each, because every rollout computes all effects of its world.

    Candidates that the fused kernel supports are kept apart from the others, and it takes one of each type, with values
    of its constants for each item.
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
    """Return whether a part has room for one candidate more."""
    alike = any(
        type(other.active.effect) is type(variant.active.effect) and other.place != variant.place for other in part
    )
    return sum(len(v.parameters) for v in (*part, variant)) <= most and not (one_of_a_kind and alike)


def _linearization(
    linear: Linear,
    segments: Segments,
    parameters: Sequence[Parameter],
    base: int,
    groups: Sequence[int],
    robust: bool,
) -> Linearization:
    """Return the linearization with the segments' weights, episodes and sessions."""
    episode = np.array([item.episode for item in segments.items])
    weight = linear.weight if robust else torch.ones_like(linear.chi2)
    prior = np.array([1 / p.prior[1] ** 2 if k < base else 0.0 for k, p in enumerate(parameters)])
    return Linearization(
        parameters=tuple(parameters),
        base=base,
        information=linear.information.numpy(),
        score=linear.score.numpy(),
        weight=weight.numpy(),
        episode=episode,
        group=np.asarray(groups)[episode],
        prior=prior,
        chi2=linear.chi2.numpy(),
        dof=linear.dof.numpy(),
    )


def sums(
    linearization: Linearization, columns: Sequence[int], prior_information: Array | None = None
) -> tuple[Array, Array]:
    """Return information and score of chosen parameters, separate for each session or episode where they differ there.

    Args:
        linearization: Of the segments.
        columns: Indices of the parameters.
        prior_information: Of each value; that of the linearization by default.
    """
    chosen = list(columns)
    m = linearization.information[:, chosen][:, :, chosen] * linearization.weight[:, None, None]
    g = linearization.score[:, chosen] * linearization.weight[:, None]
    places, prior = layout(linearization, chosen)
    information, score = np.diag(prior if prior_information is None else prior_information), np.zeros(len(prior))
    np.add.at(score, places, g)
    np.add.at(information, (places[:, :, None], places[:, None, :]), m)
    return information, score


def layout(linearization: Linearization, columns: Sequence[int]) -> tuple[NDArray[np.int64], Array]:
    """Return the index (B, k) of each parameter of each segment among all group values, and the prior information."""
    places, count = np.zeros((len(linearization.episode), len(columns)), np.int64), 0
    prior: list[float] = []
    for k, column in enumerate(columns):
        parameter = linearization.parameters[column]
        places[:, k], number = count, 1
        if parameter.shared != "all":
            owner = linearization.group if parameter.shared == "group" else linearization.episode
            places[:, k] += np.unique(owner, return_inverse=True)[1]
            number = int(places[:, k].max()) - count + 1
        count += number
        # a prior ties the values of sessions to each other, about neutral
        prior += [linearization.prior[column] if parameter.shared == "all" else 1 / parameter.prior[1] ** 2] * number
    return places, np.array(prior)


def widths(linearization: Linearization, columns: Sequence[int]) -> Array:
    """Return the widths of the priors of the values that `sums` gives."""
    places, prior = layout(linearization, columns)
    widths = np.ones(len(prior))
    for k, column in enumerate(columns):
        widths[places[:, k]] = linearization.parameters[column].prior[1]
    return widths


def eliminate(information: Array, score: Array, count: int) -> tuple[Array, Array]:
    """Return information and score of all but the first `count` values, with those projected out."""
    if count == 0:
        return information, score
    inverse = scaled_pinv(information[:count, :count])
    mixed = information[count:, :count] @ inverse
    return information[count:, count:] - mixed @ information[:count, count:], score[count:] - mixed @ score[:count]
