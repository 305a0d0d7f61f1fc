"""Residuals of short predictions of a model in units of the noise, by frame and by phase.

A short prediction starts from the state that fits its segment best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...schemas import PHASES, Phase
from ..physics.state import State
from ..physics.world import World
from ..segments.contact_phases import phases_of
from ..segments.prepare import Prepared
from ..segments.segment_states import fit_states
from ..segments.segments import Segments
from ..trajectories.observations import Observations
from ..trajectories.residuals import state_prior
from ..trajectories.segmentation import whole_episodes

if TYPE_CHECKING:
    from ...datasets.capture.tracks import Episode

Array = NDArray[np.float64]

FREEDOMS = ("x", "y", "z", "rx", "ry", "rz")
"""Components of a residual: position in the world frame, rotation vector in the body frame."""
DIVERGED = 1e4
"""Residual that a diverged short prediction is given, in units of the noise."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShortErrors:
    """Residuals of the short predictions of one episode, by frame."""

    episode: str
    """Name of the episode."""
    bodies: tuple[str, ...]
    """Names of the free bodies (nf)."""
    time_s: Array
    """Times of the measured frames on the track's clock [s], shape (T,)."""
    sigmas: Array
    """Residuals in units of the noise, shape (T, nf, 6), in the order of `FREEDOMS`; NaN where not measured."""
    freedom: Array
    """Share of each residual's variance that remains after the fit of the states, shape (T, nf, 6), 0 to 1."""
    phase: NDArray[np.int64]
    """Index into `PHASES`, shape (T,); -1 for frames outside all segments."""
    cause: NDArray[np.int64]
    """Index into `PHASES` of the phase to which the residuals of the frame's segment are attributed, shape (T,): impact
    if the segment contains one, else the most frequent phase of its frames in contact. A misfit in contact also spreads
    to the segment's frames in flight.
    """
    span_s: Array
    """Start and end of the segment that gives a frame's residuals [s], shape (T, 2)."""

    @staticmethod
    def phase_name(place: int) -> Phase:
        """Return the name of a phase."""
        return PHASES[place]

    def largest(self) -> Array:
        """Return the largest residual over bodies and degrees of freedom (T,), in units of the noise; NaN if none."""
        size = np.abs(self.sigmas).reshape(len(self.time_s), -1)
        known = np.isfinite(size)
        return np.where(known.any(1), np.where(known, size, 0.0).max(1), np.nan)


@dataclass(frozen=True, eq=False)
class ShortFit:
    """Short predictions of one model."""

    observations: Observations
    """The full episodes, without outliers."""
    contact: Segments | None
    """The fitted segments with contact; None if no segment has contact."""
    errors: dict[str, ShortErrors]
    """The residuals by episode."""


def contact_fit(
    world: World, episodes: Sequence[Episode], prepared: Prepared, bodies: Sequence[str], known: Sequence[State] = ()
) -> Segments | None:
    """Fit the states of the segments with contact to their frames with a model; None without contact.

    Args:
        world: The world of the model.
        episodes: Names of the episodes and tracks of their bodies.
        prepared: The same episodes, cut into segments in the same way for all compared models.
        bodies: Names of the free bodies in the order of `prepared`.
        known: States that other models were fitted with, from which this one starts, too.
    """
    if not prepared.contact_items:
        return None
    whole = _whole(world, episodes, prepared, bodies)
    cut = Segments.of("contact", world, whole, prepared.contact_items, prepared.noise)
    return fit_states(cut, thorough=True, also=known)


def beside_others(contact: Segments | None, known: Sequence[State]) -> Segments | None:
    """Return a fit, or the one from the states of other models where it is nearer: no model owes a minimum to luck."""
    return None if contact is None else fit_states(contact, search=False, also=known)


def short_errors(
    world: World,
    episodes: Sequence[Episode],
    prepared: Prepared,
    bodies: Sequence[str],
    contact: Segments | None = None,
) -> ShortFit:
    """Fit the states of all segments to their frames with a model, and return the residuals.

    Args:
        world: The world of the model.
        episodes: Names of the episodes and tracks of their bodies.
        prepared: The same episodes, cut into segments in the same way for all compared models.
        bodies: Names of the free bodies in the order of `prepared`.
        contact: The segments with contact where they are fitted already.
    """
    whole, noise, flight = _whole(world, episodes, prepared, bodies), prepared.noise, None
    if prepared.flight is not None:
        flight = fit_states(Segments.of("flight", world, whole, prepared.flight.items, noise))
    contact = contact or contact_fit(world, episodes, prepared, bodies)
    names = [name for name, _ in episodes]
    phases = phases_of(names, whole, prepared.airborne, contact)
    free = tuple(world.bodies[k].name for k in whole.free)
    found = {
        one.episode: ShortErrors(
            episode=one.episode,
            bodies=free,
            time_s=one.time_s,
            sigmas=np.full((len(one.time_s), len(free), 6), np.nan),
            freedom=np.zeros((len(one.time_s), len(free), 6)),
            phase=np.full(len(one.time_s), -1),
            cause=np.full(len(one.time_s), -1),
            span_s=np.full((len(one.time_s), 2), np.nan),
        )
        for one in phases
    }
    # contact segments begin and end in flight; in those frames the longer flight segments take precedence
    for segments in (contact, flight):
        if segments is not None:
            _fill(segments, whole, names, found)
    for one in phases:
        places = np.array([PHASES.index(name) for name in one.phase.tolist()], np.int64)
        covered = np.isfinite(found[one.episode].span_s[:, 0])
        found[one.episode].phase[:] = _placed(places, covered, one.airborne)
        found[one.episode].cause[:] = _causes(found[one.episode])
    return ShortFit(whole, contact, found)


def _whole(world: World, episodes: Sequence[Episode], prepared: Prepared, bodies: Sequence[str]) -> Observations:
    """Return the full episodes in the world's order of bodies, without outliers."""
    whole = whole_episodes(world, episodes)
    columns = [list(bodies).index(world.bodies[k].name) for k in whole.free]
    shift = prepared.observations.time_shift
    return replace(
        whole,
        seen=prepared.observations.seen[..., columns],
        has_orientation=prepared.observations.has_orientation[..., columns],
        time_shift=None if shift is None else shift[:, :, columns],
    )


def _fill(segments: Segments, whole: Observations, names: Sequence[str], found: dict[str, ShortErrors]) -> None:
    """Write residuals and their freedom into the frames of the episodes.

    A frame that several segments of contact share keeps the residuals with the larger freedom.
    """
    nothing = torch.zeros(0).to(segments.world.gravity)
    rows, jacobian = segments.residuals((), nothing)
    assert jacobian is not None
    bodies = len(segments.observations.free)
    freedom = _freedom(jacobian, bodies).unflatten(1, (-1, bodies)).numpy()
    residuals = (
        torch.nan_to_num(rows, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED).unflatten(1, (-1, bodies)).numpy()
    )
    seen = segments.observations
    mask = torch.cat(
        (seen.seen[..., None] * seen.measured_axes[:, None], seen.has_orientation[..., None].expand(-1, -1, -1, 3)), -1
    )
    measured = mask.numpy() > 0
    for item, segment in enumerate(segments.items):
        one = found[names[segment.episode]]
        count = segment.last - segment.first + 1
        places = np.arange(segment.first, segment.last + 1)
        times = whole.times_s[segment.episode, places].numpy()
        known, free = measured[item, :count], freedom[item, :count]
        total = np.where(known, free, 0.0).sum((1, 2))
        better = (total >= one.freedom[places].sum((1, 2))) | (segments.kind == "flight")
        at = places[better]
        one.sigmas[at] = np.where(known, residuals[item, :count], np.nan)[better]
        one.freedom[at] = np.where(known, free, 0.0)[better]
        one.span_s[at] = times[0], times[-1]


def _placed(places: NDArray[np.int64], covered: NDArray[np.bool_], airborne: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the phase (T,) of each frame, -1 where it is unknown.

    Only the first segments of a long rest are fitted; later frames in contact count as rest, too.
    """
    found = np.where(covered, places, -1)
    rest = PHASES.index("rest")
    for k in range(1, len(found)):
        if not covered[k] and not airborne[k] and found[k - 1] == rest:
            found[k] = rest
    return found


def _causes(one: ShortErrors) -> NDArray[np.int64]:
    """Return the phase (T,) to which the residuals of each frame's segment are attributed."""
    causes = one.phase.copy()
    flight, impact = PHASES.index("flight"), PHASES.index("impact")
    for span in np.unique(one.span_s[np.isfinite(one.span_s).all(1)], axis=0):
        rows = (one.span_s == span).all(1)
        touching = one.phase[rows & (one.phase != flight)]
        if len(touching):
            causes[rows] = impact if (touching == impact).any() else np.bincount(touching).argmax()
    return causes


def _freedom(jacobian: Tensor, bodies: int) -> Tensor:
    """Return the share of each residual's variance that remains after the fit of the state (B, F, 6): 1 - leverage.

    The leverage of row j is j (J'J + P)^-1 j', with P the information of the weak prior on states.
    """
    flat = torch.nan_to_num(jacobian.flatten(1, 2), posinf=0.0, neginf=0.0)
    normal = flat.transpose(1, 2) @ flat + torch.diag(state_prior(bodies)).to(flat)
    solved = torch.linalg.solve(normal, flat.transpose(1, 2))
    leverage = (flat * solved.transpose(1, 2)).sum(-1)
    return (1 - leverage).clamp(0, 1).unflatten(1, (-1, 6))
