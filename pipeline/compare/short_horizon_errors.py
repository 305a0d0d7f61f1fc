"""Short predictions of a model in units of the noise: segments with fitted states, frame by frame, phase by phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..schemas import PHASES, Phase
from .diagnosis.cuts import whole_episodes
from .diagnosis.phases import phases_of
from .diagnosis.prepared import Prepared
from .diagnosis.segment_states import fit_states
from .diagnosis.segments import Segments
from .estimation.observations import Observations
from .estimation.trajectory import state_prior
from .physics.world import World

if TYPE_CHECKING:
    from .prediction import Episode

Array = NDArray[np.float64]

FREEDOMS = ("x", "y", "z", "rx", "ry", "rz")
"""Of a residual: position in the world frame, rotation vector in the body frame."""
DIVERGED = 1e4
"""Residual of a short prediction that diverged, in units of the noise."""


@dataclass(frozen=True, eq=False)
class ShortErrors:
    """Short predictions of one episode against its measurements, frame by frame.

    Attributes:
        episode: Its name.
        bodies: Names of the free bodies (nf).
        time_s: Times of the measured frames on the track's clock [s], shape (T,).
        sigmas: Residuals in units of the noise, shape (T, nf, 6), in the order of `FREEDOMS`; NaN where not measured.
        freedom: What the fitted states leave of each residual's variance, shape (T, nf, 6), 0 to 1.
        phase: Place in `PHASES`, -1 where no segment has the frame, shape (T,).
        cause: The same for the segment that a frame's residuals are of: impact where it holds one, else what most of
            its frames in contact do. Before and after a contact there is flight that its segment cannot fit either.
        span_s: Start and end of the segment that a frame's residuals are of [s], shape (T, 2).
    """

    episode: str
    bodies: tuple[str, ...]
    time_s: Array
    sigmas: Array
    freedom: Array
    phase: NDArray[np.int64]
    cause: NDArray[np.int64]
    span_s: Array

    @staticmethod
    def phase_name(place: int) -> Phase:
        """Return the name of a phase."""
        return PHASES[place]

    def largest(self) -> Array:
        """Return the largest residual of any body and degree of freedom (T,), in units of the noise; NaN without."""
        size = np.abs(self.sigmas).reshape(len(self.time_s), -1)
        known = np.isfinite(size)
        return np.where(known.any(1), np.where(known, size, 0.0).max(1), np.nan)


@dataclass(frozen=True, eq=False)
class ShortFit:
    """Short predictions of one model.

    whole: the episodes, without outliers; contact: its fitted segments, None where there are none; errors by episode.
    """

    whole: Observations
    contact: Segments | None
    errors: dict[str, ShortErrors]


def short_errors(world: World, episodes: Sequence[Episode], prepared: Prepared, bodies: Sequence[str]) -> ShortFit:
    """Fit the states of all segments to their frames by a model, and return what is left.

    Args:
        world: The model's.
        episodes: Names, and tracks of all that moves.
        prepared: The same episodes as they were cut, the same way for all models that are compared.
        bodies: The free bodies in the order that `prepared` has them in.
    """
    whole = whole_episodes(world, episodes)
    columns = [list(bodies).index(world.bodies[k].name) for k in whole.free]
    whole = replace(whole, seen=prepared.whole.seen[..., columns], turned=prepared.whole.turned[..., columns])
    noise, contact = prepared.noise, None
    flight = None
    if prepared.flight is not None:
        flight = fit_states(Segments.of("flight", world, whole, prepared.flight.items, noise))
    if prepared.contact_items:
        contact = fit_states(Segments.of("contact", world, whole, prepared.contact_items, noise), thorough=True)
    names = [name for name, _ in episodes]
    phases = phases_of(names, whole, prepared.clear, contact)
    own = tuple(world.bodies[k].name for k in whole.free)
    found = {
        one.episode: ShortErrors(
            one.episode,
            own,
            one.time_s,
            np.full((len(one.time_s), len(own), 6), np.nan),
            np.zeros((len(one.time_s), len(own), 6)),
            np.full(len(one.time_s), -1),
            np.full(len(one.time_s), -1),
            np.full((len(one.time_s), 2), np.nan),
        )
        for one in phases
    }
    # contact segments begin and end in flight: there the flight's own, longer ones count
    for segments in (contact, flight):
        if segments is not None:
            _fill(segments, whole, names, found)
    for one in phases:
        places = np.array([PHASES.index(name) for name in one.phase.tolist()], np.int64)
        covered = np.isfinite(found[one.episode].span_s[:, 0])
        found[one.episode].phase[:] = _placed(places, covered, one.clear)
        found[one.episode].cause[:] = _causes(found[one.episode])
    return ShortFit(whole, contact, found)


def _fill(segments: Segments, whole: Observations, names: Sequence[str], found: dict[str, ShortErrors]) -> None:
    """Write residuals and their freedom into the frames of the episodes; a shared frame keeps the larger freedom."""
    nothing = torch.zeros(0).to(segments.world.gravity)
    rows, jacobian = segments.residuals((), nothing)
    assert jacobian is not None
    bodies = len(segments.observations.free)
    left = _freedom(jacobian, bodies).unflatten(1, (-1, bodies)).numpy()
    residuals = (
        torch.nan_to_num(rows, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED).unflatten(1, (-1, bodies)).numpy()
    )
    seen = segments.observations
    mask = torch.cat(
        (seen.seen[..., None] * seen.measured_axes[:, None], seen.turned[..., None].expand(-1, -1, -1, 3)), -1
    )
    measured = mask.numpy() > 0
    for item, segment in enumerate(segments.items):
        one = found[names[segment.episode]]
        count = segment.last - segment.first + 1
        places = np.arange(segment.first, segment.last + 1)
        times = whole.times_s[segment.episode, places].numpy()
        known, own = measured[item, :count], left[item, :count]
        total = np.where(known, own, 0.0).sum((1, 2))
        better = (total >= one.freedom[places].sum((1, 2))) | (segments.kind == "flight")
        at = places[better]
        one.sigmas[at] = np.where(known, residuals[item, :count], np.nan)[better]
        one.freedom[at] = np.where(known, own, 0.0)[better]
        one.span_s[at] = times[0], times[-1]


def _placed(places: NDArray[np.int64], covered: NDArray[np.bool_], clear: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the phase (T,) of each frame, -1 where it is unknown.

    Of a long rest only the first segments are fitted: what stays in contact after a rest goes on resting.
    """
    found = np.where(covered, places, -1)
    rest = PHASES.index("rest")
    for k in range(1, len(found)):
        if not covered[k] and not clear[k] and found[k - 1] == rest:
            found[k] = rest
    return found


def _causes(one: ShortErrors) -> NDArray[np.int64]:
    """Return the phase (T,) that the residuals of each frame's segment are due to."""
    causes = one.phase.copy()
    flight, impact = PHASES.index("flight"), PHASES.index("impact")
    for span in np.unique(one.span_s[np.isfinite(one.span_s).all(1)], axis=0):
        rows = (one.span_s == span).all(1)
        touching = one.phase[rows & (one.phase != flight)]
        if len(touching):
            causes[rows] = impact if (touching == impact).any() else np.bincount(touching).argmax()
    return causes


def _freedom(jacobian: Tensor, bodies: int) -> Tensor:
    """Return what a fit of the state leaves of each residual's variance (B, F, 6): 1 less its leverage.

    The leverage of row j is j (J'J + P)^-1 j', with P the information of the weak prior on states.
    """
    flat = torch.nan_to_num(jacobian.flatten(1, 2), posinf=0.0, neginf=0.0)
    normal = flat.transpose(1, 2) @ flat + torch.diag(state_prior(bodies)).to(flat)
    solved = torch.linalg.solve(normal, flat.transpose(1, 2))
    leverage = (flat * solved.transpose(1, 2)).sum(-1)
    return (1 - leverage).clamp(0, 1).unflatten(1, (-1, 6))
