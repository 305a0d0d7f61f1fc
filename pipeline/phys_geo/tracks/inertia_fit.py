"""Mass distribution of bodies: centre of mass and second moments from the motion around first contacts.

A published inertia or the assumption of uniform density may be far off, and it determines how every impact turns the
body.
"""

from __future__ import annotations

from collections.abc import Sequence

from ....datasets.capture.tracks import Episode, Track
from ....schemas import InputDataError
from ...physics.parameters import Parameter, mass_distribution
from ...physics.world import World
from ...segments.first_contact_fit import EffectEstimate, fit_first_contacts
from ...trajectories.track_noise import Noise

LEAST_EPISODES = 8
"""Minimum number of episodes; with fewer the mass distribution cannot be separated from the scatter of the impacts."""
MASS_PARTS = ("centre_of_mass", "second_moments")
"""Parts of a mass distribution."""


def fit_mass_distribution(
    world: World,
    episodes: Sequence[Episode],
    contact: Sequence[tuple[Parameter, float]],
    noise: Noise,
    parts: Sequence[str] = MASS_PARTS,
) -> EffectEstimate:
    """Fit centre of mass and second moments of every free body, or one of them, together with the contact parameters.

    Args:
        world: The world; its centres and inertias are the start.
        episodes: Name and tracks by body of each training episode.
        contact: Contact parameters that are fitted with them, and their start; the open-loop search refits them later.
        noise: Of the tracks (position [m], rotation [rad]).
        parts: Of `MASS_PARTS`, those that are fitted.

    Raises:
        InputDataError: If there are too few episodes, or an orientation was not measured.
        NotConvergedError: If the rollouts diverge at the start.
    """
    turning = [e for e in episodes if all(turns(e.tracks.get(world.bodies[i].name)) for i in world.free)]
    if len(turning) < LEAST_EPISODES:
        raise InputDataError(
            f"{len(turning)} of {len(episodes)} episodes have orientations of all free bodies.",
            f"{LEAST_EPISODES} or more, to find where the mass is.",
            "record more, or leave phys-geo.mass_distribution at auto.",
        )
    return fit_first_contacts(world, turning, mass_parameters(world, parts), contact, noise)


def mass_parameters(world: World, parts: Sequence[str] = MASS_PARTS) -> list[tuple[Parameter, float]]:
    """Return the parameters of the mass distributions of free bodies, with their present values.

    Args:
        world: The world.
        parts: Of `MASS_PARTS`, those that are wanted.
    """
    wanted: list[tuple[Parameter, float]] = []
    for index in world.free:
        every = mass_distribution(world.bodies[index].name, _size_m(world, index))
        values = [float(value) for value in world.bodies[index].com[0]] + [1.0, 1.0, 1.0]
        pairs = list(zip(every, values, strict=True))
        wanted += (pairs[:3] if MASS_PARTS[0] in parts else []) + (pairs[3:] if MASS_PARTS[1] in parts else [])
    return wanted


def turns(track: Track | None) -> bool:
    """Return whether a track has orientations."""
    return track is not None and track.quat_wxyz is not None


def _size_m(world: World, index: int) -> float:
    """Return the largest distance of a body's surface from its centre of mass [m]."""
    body = world.bodies[index]
    return float(((body.centers[0] - body.com[0]).square().sum(-1).sqrt() + body.radii[0]).max())
