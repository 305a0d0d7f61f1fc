"""Consistency test of selected effects: the same parameters in every episode and segment.

A force that depends on time or place may look like one drag or tilt in one episode and like another in the next. With
the information M_u and score g_u of each unit u (an episode, a segment) at the fitted parameters, and their sums M and
g, the statistic sum_u g_u' M_u^-1 g_u - g' M^-1 g is distributed as chi2. Its degrees of freedom are the number of
parameters of all units less those of the common fit (Cochran's Q for several parameters).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..optimization.uncertainty import chi2_tail
from ..physics.world import World
from ..segments.candidates import base_values
from ..segments.linearization import Linearization, linearize
from ..segments.segments import Segments
from .score_test import solved
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Consistency:
    """Cochran's Q of the effects' parameters over units."""

    statistic: float
    """Cochran's Q in units of the dispersion."""
    dof: int
    """Degrees of freedom."""
    p_value: float
    """Probability of a larger statistic if all units share the parameters."""
    share: float
    """Share of what separate parameters explain that common parameters explain."""

    @property
    def doubtful(self) -> bool:
        """Whether the effects differ between units by more than a detail of their law."""
        return self.p_value < LIMITS.consistent_p and self.share < LIMITS.consistent_share


def consistency(
    flight: Segments, world: World, names: Sequence[str], groups: Sequence[int], dispersion: float
) -> Consistency | None:
    """Test the effects' parameters over episodes and over segments, and return the less consistent result.

    Args:
        flight: Segments with states fitted by the world.
        world: The world with the effects at their fitted parameters.
        names: Names of the effects.
        groups: Session of each episode.
        dispersion: Factor by which variances exceed those of the noise.

    Returns:
        The result with the smaller p-value; None without effects.
    """
    if not names:
        return None
    linear = linearize(flight, world, (), groups, robust=False)
    columns = [k for k, p in enumerate(linear.parameters) if p.name.partition(".")[0] in names]
    if not columns:
        return None
    values = base_values(world, [linear.parameters[k] for k in columns]).numpy()
    units = (linear.episode, np.arange(len(linear.episode)))
    return max((_over(linear, columns, values, unit, dispersion) for unit in units), key=lambda one: -one.p_value)


def _over(
    linear: Linearization, columns: Sequence[int], values: Array, unit: NDArray[np.int64], dispersion: float
) -> Consistency:
    """Return Cochran's Q over units; unit (B,): index of each segment's unit."""
    chosen = list(columns)
    width = np.array([linear.parameters[k].prior[1] for k in chosen])
    information, score = linear.information[:, chosen][:, :, chosen], linear.score[:, chosen]
    places = np.unique(unit, return_inverse=True)[1]
    by_unit, slopes = np.zeros((places.max() + 1, len(chosen), len(chosen))), np.zeros((places.max() + 1, len(chosen)))
    np.add.at(by_unit, places, information)
    np.add.at(slopes, places, score)
    own = [solved(m, g, width)[2:] for m, g in zip(by_unit, slopes, strict=True)]
    common, rank = solved(by_unit.sum(0), slopes.sum(0), width)[2:]
    statistic = max(sum(q for q, _ in own) - common, 0.0) / dispersion
    dof = sum(k for _, k in own) - rank
    shared = float(values @ by_unit.sum(0) @ values) / dispersion
    excess = max(statistic - dof, 0.0)
    share = shared / (shared + excess) if shared + excess > 0 else 1.0
    return Consistency(statistic, dof, chi2_tail(statistic, dof) if dof > 0 else 1.0, share)
