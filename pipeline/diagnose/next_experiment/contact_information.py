"""Information about effects of contact: what data have, and what each of many motions would add, by kind of motion.

In sliding and in impacts each test compares candidates that are fitted together with the same nuisance
parameters. The information matrices of both, for all candidates at once and with the states eliminated, follow from
one Jacobian at the values without any candidate; those of motions add up. Motions that were not made are simulated
with the model.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.tracks import Episode, Track
from ...optimization.problem import NormalEquations
from ...physics.contact_law import ContactLaw
from ...physics.engine import rollout as rolled_out
from ...physics.observation_model import as_measured, true_times
from ...physics.parameters import Parameter
from ...physics.rollout import Rollout
from ...physics.state import State
from ...physics.world import World
from ...segments.candidates import Together, Variant, base_values
from ...segments.contact_phases import is_round
from ...segments.impacts.fit import ImpactBase
from ...segments.impacts.flat import flat_impacts
from ...segments.impacts.velocities import measured_impacts
from ...segments.prepare import Prepared
from ...segments.segment_states import fit_states
from ...segments.segments import Segments
from ...segments.sliding.descent import WEAK
from ...segments.sliding.fit import StartedSliding, nuisance_parameters
from ...segments.sliding.residuals import finite_differences, soft_world
from ...segments.sliding.segments import find_sliding_segments
from ...trajectories.segmentation import GroundPlane, cut_episodes, whole_episodes
from .hand_motions import HandMotion, start_states

Array = NDArray[np.float64]

WEAK_SHARE = 1e-9
"""Share of its own by which the information on a parameter is raised: one that nothing shows stays solvable."""
LEAST_STEP_S = 0.005
"""Minimum frame interval of simulated motions [s]; the information of denser frames is obtained by scaling."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Channel:
    """Information of one kind of motion on nuisance parameters and candidates."""

    name: str
    """sliding or impact."""
    base: int
    """Number of nuisance parameters; they come first."""
    columns: tuple[tuple[int, ...], ...]
    """Columns of the parameters of each variant (V)."""
    prior: Array
    """Prior information on the nuisance parameters, shape (base,)."""
    data: Array
    """Information of the data, shape (P, P)."""
    motions: Array
    """Information of each motion, shape (M, P, P)."""
    count: int
    """Degrees of freedom (sliding) or number of impacts of the data."""
    episodes: Array
    """Information of each episode of the data, (E, P, P): tests ask that held-out episodes are predicted."""

    def reduced(self, information: Array) -> Reduced:
        """Return the candidates' part of information (M, P, P) with the nuisance parameters eliminated."""
        base = self.base
        weak = np.diagonal(information, axis1=1, axis2=2) * WEAK_SHARE + WEAK_SHARE
        inner = information[:, :base, :base] + (weak[:, :base] + self.prior)[..., None] * np.eye(base)
        mixed = information[:, :base, base:]
        left = information[:, base:, base:] - mixed.swapaxes(1, 2) @ np.linalg.solve(inner, mixed)
        return Reduced(left=left, weak=weak[:, base:])

    def noncentrality(self, reduced: Reduced, sizes: Array, variant: int, beside: Sequence[int] | None = None) -> Array:
        """Return the expected fall of chi2 (M,) by a missing effect of given sizes, averaged over its parameters.

        Args:
            reduced: Of the information of data and motions together.
            sizes: Of the effect's parameters, one of which it has at a time, shape (k,).
            variant: Place of the effect.
            beside: Places of others, one of which is fitted in its stead and may imitate it: the smallest fall counts,
                infinite without any; None for no other one.
        """
        own = self._places(variant)
        alone = reduced.left[:, own][..., own]
        if beside is None:
            return _mean_fall(alone, sizes)
        least = np.full(len(alone), np.inf)
        for width in {len(self.columns[other]) for other in beside}:
            alike = np.array([self._places(other) for other in beside if len(self.columns[other]) == width])
            inner = reduced.left[:, alike[:, :, None], alike[:, None]]
            inner = inner + reduced.weak[:, alike][..., None] * np.eye(width)
            mixed = reduced.left[:, alike][..., own]
            left = alone[:, None] - mixed.swapaxes(2, 3) @ np.linalg.solve(inner, mixed)
            least = np.minimum(least, _mean_fall(left, sizes).min(1))
        return least

    def _places(self, variant: int) -> list[int]:
        """Return the columns of a variant among those of the candidates."""
        return [column - self.base for column in self.columns[variant]]


@dataclass(frozen=True, eq=False, kw_only=True)
class Reduced:
    """Information on the parameters of candidates (Q) with the nuisance parameters eliminated."""

    left: Array
    """The information, shape (M, Q, Q)."""
    weak: Array
    """What is added to the diagonal where a candidate is eliminated, shape (M, Q)."""


def _mean_fall(left: Array, sizes: Array) -> Array:
    """Return the falls of chi2 (...) by effects of given sizes (k,) about which information (..., k, k) is left."""
    return (np.diagonal(left, axis1=-2, axis2=-1) @ sizes**2 / len(sizes)).clip(0.0)


def contact_information(
    prepared: Prepared,
    world: World,
    started: StartedSliding | None,
    variants: Sequence[Variant],
    motions: Sequence[HandMotion],
    flat: Sequence[int] = (),
) -> tuple[list[Channel], State]:
    """Return the information of the data and of motions, by kind of motion, and the motions' first states (M).

    Args:
        prepared: The data.
        world: Their world, without the candidates.
        started: The sliding segments of the data with the fit without candidates; None without any.
        variants: Effects that act in contact (V).
        motions: The motions (M).
        flat: Places of the effects that flat impacts tell.
    """
    fitted = world if started is None else _with_friction(world, started)
    middle = prepared.observations.position_m[prepared.observations.seen > 0].median(0).values
    state = start_states(fitted, world.free[0], motions, middle, prepared.observations.state)
    made, true, share = _simulated(prepared, fitted, motions, state)
    found = [
        _sliding(prepared, fitted, started, variants, made, true, share, len(motions)),
        _impacts(prepared, fitted, variants, made, len(motions), flat),
    ]
    return [channel for channel in found if channel is not None], state


def _with_friction(world: World, started: StartedSliding) -> World:
    """Return the world with the friction that its slides have."""
    law = world.contact
    friction = started.base.values[0, 0].exp()
    return replace(world, contact=replace(law, friction=torch.full_like(law.friction, float(friction))))


def _simulated(
    prepared: Prepared, world: World, motions: Sequence[HandMotion], state: State
) -> tuple[Prepared, Rollout, float]:
    """Return motions as noiseless episodes with the data's noise, their true motion, and the factor of their frames."""
    items = prepared.contact_items or (() if prepared.flight is None else prepared.flight.items)
    seen = prepared.observations.times_s
    step = float(torch.cat([seen[i.episode, i.first : i.last + 1].diff() for i in items]).median())
    used = max(step, LEAST_STEP_S)
    times = used * torch.arange(round(max(m.duration_s for m in motions) / used) + 1).to(seen)
    with torch.no_grad():
        true = rolled_out(world, state, true_times(world, times.expand(len(motions), -1)))
    shown, body = as_measured(world, true, times), world.free[0]
    episodes = []
    for k, motion in enumerate(motions):
        keep = (times <= motion.duration_s + 1e-9).numpy()
        position, quat = (values[k, :, body].numpy()[keep] for values in (shown.position_m, shown.quat_wxyz))
        track = Track(times.numpy()[keep], position, quat if prepared.has_orientation else None)
        episodes.append(Episode(f"{k}", {world.bodies[body].name: track}))
    whole = whole_episodes(world, episodes)
    flight, contact, airborne = cut_episodes(world, whole, prepared.noise)
    flights = None
    if flight:
        flights = fit_states(
            Segments.of("flight", world, whole, flight, prepared.noise, prepared.noise_model), search=False
        )
    made = replace(
        prepared,
        names=tuple(name for name, _ in episodes),
        groups=tuple(0 for _ in episodes),
        observations=whole,
        airborne=airborne,
        supported=torch.zeros_like(airborne),
        flight=flights,
        contact_items=tuple(contact),
        warnings=(),
        released_s={},
    )
    return made, true, used / step


def _sliding(
    prepared: Prepared,
    world: World,
    started: StartedSliding | None,
    variants: Sequence[Variant],
    made: Prepared,
    true: Rollout,
    share: float,
    count: int,
) -> Channel | None:
    """Return the information of sliding segments; None where they cannot be judged."""
    if not isinstance(world.contact, ContactLaw) or not prepared.has_orientation:
        return None
    soft = soft_world(world)
    known = nuisance_parameters(soft, () if started is None else started.flight_parameters)
    size = len(known) + sum(len(variant.parameters) for variant in variants)
    data, total = np.zeros((1, size, size)), np.zeros((count, size, size))
    if started is not None:
        seen = started.base.segments
        episode = np.array([item.episode for item in seen.items])
        data = np.zeros((1 + int(episode.max()), size, size))
        np.add.at(data, episode, _eliminated(seen, soft, known, started.base.values[0], variants))
    items = find_sliding_segments(world, made.observations, made.airborne, made.noise)
    if items:
        segments = made.segments("contact", soft, items)
        segments = segments.with_state(_states_at(true, segments))
        # a missing effect may have moved the ground of the fit to the data
        found = _eliminated(segments, soft, known, base_values(soft, known), variants)
        np.add.at(total, np.array([item.episode for item in items]), share * found)
    ends = np.cumsum([len(known), *(len(variant.parameters) for variant in variants)])
    return Channel(
        name="sliding",
        base=len(known),
        columns=tuple(tuple(range(a, b)) for a, b in itertools.pairwise(ends.tolist())),
        prior=np.array([1 / p.prior[1] ** 2 for p in known]),
        data=data.sum(0),
        motions=total,
        count=0 if started is None else int(started.segments.dof.sum()),
        episodes=data,
    )


def _eliminated(
    segments: Segments, soft: World, known: Sequence[Parameter], values: Tensor, variants: Sequence[Variant]
) -> Array:
    """Return the information (B, P, P) of sliding segments with their states eliminated, the known parameters first."""
    together, first, count = Together.of(soft, variants), len(known), len(segments.items)
    parameters = [*known, *together.parameters]
    every = base_values(together.world, parameters).repeat(1 + len(variants), 1)
    every[:, :first] = values
    together.set_constants(every[1:], first)
    owner = [0] * first + [1 + k for k, columns in enumerate(together.columns) for _ in columns]
    asked = torch.tensor([*range(first), *(first + column for columns in together.columns for column in columns)])
    found = finite_differences(
        segments.in_world(together.world),
        parameters,
        every[0].expand(count, -1),
        asked.expand(count, -1),
        at=every[owner][:, None].expand(-1, count, -1),
    )
    normal = NormalEquations.of_rows(found.rows, found.jacobian, len(owner), found.chi2, prior=WEAK)
    return np.nan_to_num(normal.eliminated().information.numpy())


def _states_at(true: Rollout, segments: Segments) -> State:
    """Return the true states at the first frames of segments of simulated motions, without speed along the normal."""
    row = torch.tensor([item.episode for item in segments.items])
    first = torch.tensor([item.first for item in segments.items])
    fields = [getattr(true, key)[row, first].clone() for key in State.__dataclass_fields__]
    normal, index = GroundPlane.of(segments.world).normal, segments.observations.free[0]
    fields[2][:, index] -= (fields[2][:, index] @ normal)[:, None] * normal
    return State(*fields)


def _impacts(
    prepared: Prepared, world: World, variants: Sequence[Variant], made: Prepared, count: int, flat: Sequence[int]
) -> Channel | None:
    """Return the information of the impacts of a ball, or flat on a face; None where they cannot be judged.

    Flat impacts tell some effects alone. The information is divided by the scatter of the measured impacts about their
    law, as the test divides their misfit.
    """
    if not isinstance(world.contact, ContactLaw):
        return None
    measure = measured_impacts if is_round(world.bodies[world.free[0]]) else flat_impacts
    impacts = measure(made, world) if measure is measured_impacts or flat else None
    if impacts is None:
        return None
    found, base, columns = _of_impacts(ImpactBase.of(world, impacts), variants)
    data, number, spread = np.zeros((1, *found.shape[1:])), 0, 1.0
    known = measure(prepared, world)
    if known is not None:
        fitted, number = ImpactBase.of(world, known), len(known)
        data = np.zeros((1 + int(known.episode.max()), *found.shape[1:]))
        np.add.at(data, known.episode, _of_impacts(fitted, variants)[0])
        degrees = np.maximum([number - 1, 5 * number - 1], 1)
        spread = max(1.0, float((fitted.fit.chi2 / degrees).max()))
    total = np.zeros((count, *found.shape[1:]))
    if measure is flat_impacts:  # what rebounds from a flat impact turns, and is seldom flat again
        once = np.unique(impacts.episode, return_index=True)[1]
        impacts, found = impacts.select(once), found[once]
    np.add.at(total, impacts.episode, found)
    if measure is flat_impacts:
        untold = [column for k, own in enumerate(columns) if k not in flat for column in own]
        for information in (data, total):
            information[:, untold], information[:, :, untold] = 0.0, 0.0
    return Channel(
        name="impact",
        base=len(base),
        columns=columns,
        prior=base,
        data=data.sum(0) / spread,
        motions=total / spread,
        count=number,
        episodes=data / spread,
    )


def _of_impacts(base: ImpactBase, variants: Sequence[Variant]) -> tuple[Array, Array, tuple[tuple[int, ...], ...]]:
    """Return the information (n, P, P) of impacts, the prior of the nuisance parameters, and each variant's columns."""
    problem, together, value = base.beside_each(variants)
    first = len(base.parameters)
    owner = [-1] * first + [k for k, columns in enumerate(together.columns) for _ in columns]
    free = [*range(first), *(first + column for columns in together.columns for column in columns)]
    starts = value.repeat(1 + len(variants), 1)
    together.set_constants(starts[1:], first)
    slopes = problem.slopes(starts[[1 + k for k in owner]], torch.tensor(free))
    found = torch.einsum("nip,niq->npq", slopes, slopes).numpy()
    ends = np.cumsum([first, *(len(columns) for columns in together.columns)]).tolist()
    columns = tuple(tuple(range(a, b)) for a, b in itertools.pairwise(ends))
    return found, np.array([1 / p.prior[1] ** 2 for p in base.parameters]), columns
