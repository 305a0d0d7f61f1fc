"""Losses in joints, masses and inertia of jointed bodies that touch nothing, from their whole motions.

Between contacts the motion is a smooth function of its start and of these numbers, so that each episode is one segment,
without ties. Damping and friction of a joint change little within a segment of shooting, and much over a whole swing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ....datasets.capture.tracks import Episode, Track
from ...physics.parameters import Parameter
from ...physics.world import World
from ...trajectories.track_noise import Noise
from .multiple_shooting import Shooting, ShootingPrior
from .tempered_posterior import tempered

SHARES = (0.125, 0.25, 0.5, 1.0)
"""Parts of an episode that are fitted one after the other: over a short one the priors lead to the minimum."""
FEWEST_FRAMES = 4
"""Frames of an episode, if it has so many, in the shortest part."""
ITERATIONS = 30
"""Limit on steps for each of them."""


def fit_joints(
    world: World,
    episodes: Sequence[Episode],
    spans: Sequence[tuple[float, float]],
    parameters: Sequence[Parameter],
    noise: Noise,
) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters (P,) of jointed bodies and their covariance (P, P), in fitted coordinates.

    Args:
        world: The world.
        episodes: Name and tracks by body of each episode.
        spans: Start and end of the part of each episode that is fitted [s].
        parameters: The parameters.
        noise: Of the tracks (position [m], rotation [rad]).
    """
    prior = ShootingPrior.of(parameters)
    shared, fit = prior.mean, None
    for share in SHARES:
        parts = [
            (start, max(start + share * (end - start), _after(tracks, start)))
            for (_, tracks), (start, end) in zip(episodes, spans, strict=True)
        ]
        problem = Shooting.of(world, parameters, episodes, parts, noise, prior, segment_s=math.inf)
        fit = problem.descended(shared, ITERATIONS)
        shared = fit.shared
    assert fit is not None
    values, covariance, _ = tempered(fit, prior, 0.0)  # without ties there is no misfit of them
    return values, covariance


def _after(tracks: Mapping[str, Track], start: float) -> float:
    """Return the time of the last of the fewest frames from a time on [s]."""
    times = np.unique(np.concatenate([track.time_s for track in tracks.values()]))
    return float(times[times >= start][:FEWEST_FRAMES][-1])
