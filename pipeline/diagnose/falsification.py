"""Whether the effects that were found act alike wherever they act: the same numbers in every episode and segment.

A force that depends on time or place may look like a drag or a tilt in one episode and like another in the next. With
M_u and g_u of each unit u (an episode, a segment) at the fitted numbers, sum_u g_u' M_u^-1 g_u - g' M^-1 g is chi2 with
as many degrees of freedom as the units have numbers more than all together (Cochran's Q for several numbers).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..physics.world import World
from ..tails import chi2_tail
from .candidates import base_values
from .score import Picture, picture, solved
from .segments import Segments

Array = NDArray[np.float64]

LEVEL = 1e-4
ENOUGH_SHARE = 0.9
"""An effect whose numbers, the same everywhere, explain this share of what numbers of each unit's own would: what is
left is a detail of its law. Of less, it stands in for a stranger."""


@dataclass(frozen=True)
class Consistency:
    """Cochran's Q of the effects' numbers over units; share: of what is explained, by numbers that all units share."""

    statistic: float
    dof: int
    p_value: float
    share: float

    @property
    def doubtful(self) -> bool:
        """Whether the effects change from unit to unit by more than a detail of their law."""
        return self.p_value < LEVEL and self.share < ENOUGH_SHARE


def consistency(
    flight: Segments, world: World, names: Sequence[str], groups: Sequence[int], dispersion: float
) -> Consistency | None:
    """Return the least consistent of the effects' numbers over episodes and over segments; None without effects.

    Args:
        flight: Segments with states fitted by the world.
        world: With the effects at their fitted numbers.
        names: Of the effects.
        groups: Session of each episode.
        dispersion: By what factor variances exceed those of the noise.
    """
    if not names:
        return None
    seen = picture(flight, world, (), groups, robust=False)
    columns = [k for k, p in enumerate(seen.parameters) if p.name.partition(".")[0] in names]
    if not columns:
        return None
    values = base_values(world, [seen.parameters[k] for k in columns]).numpy()
    units = (seen.episode, np.arange(len(seen.episode)))
    return max((_over(seen, columns, values, unit, dispersion) for unit in units), key=lambda one: -one.p_value)


def _over(
    seen: Picture, columns: Sequence[int], values: Array, unit: NDArray[np.int64], dispersion: float
) -> Consistency:
    chosen = list(columns)
    width = np.array([seen.parameters[k].prior[1] for k in chosen])
    information, score = seen.information[:, chosen][:, :, chosen], seen.score[:, chosen]
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
