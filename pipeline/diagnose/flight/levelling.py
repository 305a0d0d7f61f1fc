"""Whether a force across gravity is more than frames that are level in another way in each episode.

A frame is levelled anew for each recording, or a ground is not level everywhere. Such tilts differ from episode to
episode, but a few episodes may agree by chance, above all where one long flight tells nearly all that is known. A
common tilt is therefore judged beside tilts of each episode's own: with the information I of an episode, its tilt is
known to within I^-1 + tau^2, tau the usual tilt, so that the precision of all is P = sum I (1 + tau^2 I)^-1, the common
tilt t that of the scores g, P t = sum (1 + tau^2 I)^-1 g. How far the episodes scatter about it (Cochran's Q) says how
large their own tilts are; the usual tilt counts for some degrees of freedom beside it, as in `falsification`, and
t' P t / 2 over that scatter is distributed as F.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...optimization.tails import f_tail
from ...physics.effects.registry import load_effect
from ...physics.world import World
from ...segments.candidates import Candidate, variants_of
from ...segments.linearization import linearize
from ...segments.segments import Segments
from ..thresholds import THRESHOLDS
from .own_tilt import OWN_TILTS

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]


def common_tilt_p(flight: Segments, world: World, groups: Sequence[int], dispersion: float) -> float:
    """Return the p-value of a tilt that all episodes have beside such of each episode's own.

    Args:
        flight: Segments with states fitted by the world.
        world: The world without the tilt.
        groups: Session of each episode.
        dispersion: Factor by which variances exceed those of the noise.
    """
    (tilt,) = variants_of([Candidate(OWN_TILTS[0], load_effect(OWN_TILTS[0]))], world.gravity[0, :1])
    linear = linearize(flight, world, [tilt], groups, robust=False)
    columns, own = linear.columns(tilt.parameters), LIMITS.levelled_rad**2
    parts: list[tuple[Array, Array, int]] = []
    for episode in np.unique(linear.episode):
        mine = linear.episode == episode
        information = linear.information[mine][:, columns][:, :, columns].sum(0) / dispersion
        shrunk = np.linalg.inv(np.eye(2) + own * information)
        score = linear.score[mine][:, columns].sum(0) / dispersion
        told = int((np.linalg.eigvalsh(information) * own > LIMITS.levelled_told).sum())
        parts.append((information @ shrunk, shrunk.T @ score, told))
    common = _explained(np.sum([matrix for matrix, *_ in parts], 0), np.sum([slope for _, slope, _ in parts], 0))
    q = max(sum(_explained(matrix, slope) for matrix, slope, _ in parts) - common, 0.0)
    dof, counts = max(sum(part[2] for part in parts) - 2, 0), LIMITS.model_counts
    return f_tail(0.5 * common * (counts + dof) / (counts + q), 2, counts + dof)


def _explained(precision: Array, slope: Array) -> float:
    """Return the fall of chi2 by the tilt (2,) with a precision (2, 2) and slope (2,)."""
    return float(slope @ np.linalg.pinv(precision, rcond=1e-3) @ slope)
