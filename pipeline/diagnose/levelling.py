"""Whether a force across gravity is more than frames that are level in another way in each episode.

A frame is levelled anew for each recording, or a ground is not level everywhere. Such tilts differ from episode to
episode, but a few episodes may agree by chance, above all where one long flight tells nearly all that is known. A
common tilt is therefore judged beside tilts of each episode's own: with the information I of an episode, its tilt is
known to within I^-1 + tau^2, tau the usual tilt, so that the precision of all is P = sum I (1 + tau^2 I)^-1, the common
tilt that of the scores g, P t = sum (1 + tau^2 I)^-1 g, and t' P t is distributed as chi2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..optimization.tails import chi2_tail
from ..physics.effects.registry import load_effect
from ..physics.world import World
from ..segments.candidates import Candidate, variants_of
from ..segments.linearization import linearize
from ..segments.segments import Segments
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

TILTS = ("gravity_tilt", "frame_tilt")
"""Effects that are tilts, the same in flight."""


def common_tilt_p(flight: Segments, world: World, groups: Sequence[int], dispersion: float) -> float:
    """Return the p-value of a tilt that all episodes have beside such of each episode's own.

    Args:
        flight: Segments with states fitted by the world.
        world: The world without the tilt.
        groups: Session of each episode.
        dispersion: Factor by which variances exceed those of the noise.
    """
    (tilt,) = variants_of([Candidate(TILTS[0], load_effect(TILTS[0]))], world.gravity[0, :1])
    linear = linearize(flight, world, [tilt], groups, robust=False)
    columns, own = linear.columns(tilt.parameters), LIMITS.levelled_rad**2
    precision, slope = np.zeros((2, 2)), np.zeros(2)
    for episode in np.unique(linear.episode):
        mine = linear.episode == episode
        information = linear.information[mine][:, columns][:, :, columns].sum(0) / dispersion
        shrunk = np.linalg.inv(np.eye(2) + own * information)
        precision += information @ shrunk
        slope += shrunk.T @ linear.score[mine][:, columns].sum(0) / dispersion
    return chi2_tail(float(slope @ np.linalg.pinv(precision) @ slope), 2)
