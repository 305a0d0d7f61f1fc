"""Episodes that fall unlike all others: recorded at another frame rate, on another scale, or of another body.

One such episode hides what the others have in common, and no effect in a library makes one of many fall otherwise.
"""

from __future__ import annotations

import numpy as np

from ..segments.flights.residual_wrench import residual_wrenches
from ..segments.prepare import Prepared
from ..trajectories.track_noise import MAD_TO_STD
from .thresholds import THRESHOLDS

LIMITS = THRESHOLDS.verdict


def unlike_episodes(prepared: Prepared) -> dict[str, tuple[float, float]]:
    """Return the acceleration [m/s2] with which each episode falls that falls unlike the others, and theirs, by name.

    Args:
        prepared: The episodes, of one free body.
    """
    flight = prepared.flight
    if flight is None or len(flight.observations.free) > 1:
        return {}
    gravity = flight.world.gravity[0].double().numpy()
    found = residual_wrenches(flight)
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-9)
    episode = np.array([item.episode for item in found.segments])
    along = found.wrench[:, :3] @ down
    weight = np.einsum("i,nij,j->n", down, found.information[:, :3, :3], down)
    units = np.unique(episode)
    falls = np.array([np.average(along[episode == k], weights=weight[episode == k] + 1e-12) for k in units])
    middle = float(np.median(falls))
    away = np.abs(falls - middle)
    limit = max(LIMITS.unlike_fall[0] * np.linalg.norm(gravity), LIMITS.unlike_fall[1] * MAD_TO_STD * np.median(away))
    odd = np.flatnonzero(away > limit)
    if len(units) < LIMITS.unlike_episodes[0] or len(odd) > LIMITS.unlike_episodes[1] * len(units):
        return {}
    pull = float(np.linalg.norm(gravity))
    return {prepared.names[units[k]]: (pull + float(falls[k]), pull + middle) for k in odd}


def unlike_warnings(found: dict[str, tuple[float, float]]) -> list[str]:
    """Return a warning for each episode that is left out."""
    return [
        f"episode '{name}' falls with {own:.1f} m/s2, the others with {others:.1f} m/s2: another frame rate, another "
        "scale or another body. It is left out."
        for name, (own, others) in found.items()
    ]
