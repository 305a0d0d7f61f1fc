"""A mass distribution that first contacts ask for has to fit the flights, too, which no law of contact enters.

How an impact turns a body depends on its inertia and on the law of contact, whose error an inertia can follow. A flight
tells the ratios of the moments and the centre of mass far better than impacts do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.capture.tracks import Episode
from ..physics.world import World
from ..trajectories.track_noise import Noise
from .prepare import prepare
from .segment_states import fit_states
from .segments import Segments
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.choice


def flights_contradict(before: World, after: World, episodes: Sequence[Episode], noise: Noise) -> bool:
    """Return whether flights fit worse with another mass distribution, beyond chance, over episodes.

    Args:
        before: The world before.
        after: The world with the other mass distribution.
        episodes: Name and tracks by body of each; so many are looked at, evenly spread.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
    """
    places = np.unique(np.linspace(0, len(episodes) - 1, LIMITS.looked_at).round().astype(int))
    prepared = prepare(before, [episodes[k] for k in places], noise)
    if prepared.flight is None:
        return False
    old = _chi2(prepared.flight)
    new = _chi2(fit_states(prepared.flight.in_world(after)))
    dof = float(prepared.flight.dof.sum())
    episode = np.array([item.episode for item in prepared.flight.items])
    return rises([float((new - old)[episode == one].sum()) for one in np.unique(episode)], float(old.sum()) / dof)


def rises(changes: Sequence[float], spread: float) -> bool:
    """Return whether chi2 of episodes rises beyond chance: in most of them, and without the one of the largest rise.

    Args:
        changes: Change of chi2 of each episode.
        spread: Chi2 before per degree of freedom.
    """
    if not changes:
        return False
    others = sum(changes) - max(changes)
    return others > LIMITS.worse_chi2 * max(spread, 1.0) and 2 * sum(one > 0 for one in changes) > len(changes)


def _chi2(flight: Segments) -> NDArray[np.float64]:
    """Return chi2 of each segment (B,)."""
    rows = flight.residuals([], torch.zeros(0).to(flight.world.gravity), jacobian=False)[0]
    return rows.square().flatten(1).sum(1).double().numpy()
