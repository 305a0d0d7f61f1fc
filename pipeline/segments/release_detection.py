"""Detection of episodes that begin before the release: in the first frames the body moves or turns unlike the rest.

A step of acceleration of the size of gravity shows in the positions (`carried_starts`), of each episode alone; smaller
torques show in how it turns:

A hand or a machine that still touches a body when a recording begins applies a torque for some frames. In free flight a
body turns by its inertia alone, whatever forces act on its centre of mass, so the orientation shows the release without
knowledge of drag, wind or tilt. A model error that lasts the whole flight (a wrong inertia, damping of the spin) is
equally large without the last frames as without the first ones, and is not taken for a hand; neither is an error that
all flights share.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ...datasets.capture.tracks import Episode
from ..trajectories.observations import Observations
from ..trajectories.segmentation import Segment, cut_episodes, whole_episodes
from ..trajectories.track_noise import noise_of
from .carried_starts import carried_ends, carried_starts
from .segment_states import fit_states
from .segments import Segments
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.input

if TYPE_CHECKING:
    from ..physics.world import World


def held_starts(flight: Segments, whole: Observations, known: Collection[int] = ()) -> dict[int, int]:
    """Return the first free frame of each episode that begins in a hand, by index of the episode.

    Args:
        flight: All flights, with fitted states.
        whole: The episodes that they are cut from.
        known: Episodes of which this was found before, with a noise that frames in a hand had inflated: without that
            part, what is left of them may still not be free flight.
    """
    share = _rotation_chi2(flight)
    measured = torch.isfinite(share)
    if not bool(measured.any()):
        return {}
    usual = max(float(share[measured].median()), 1.0)
    least = torch.tensor([LIMITS.free_chi2 if item.episode in known else LIMITS.held_chi2 for item in flight.items])
    found: dict[int, int] = {}
    for place in torch.nonzero(measured & (share > least.to(share) * usual))[:, 0].tolist():
        item = flight.items[place]
        count = item.last - item.first + 1
        counts = range(1, min(count // 2, count - LIMITS.least_free) + 1)
        if item.first > int((whole.seen[item.episode].amax(-1) > 0).to(torch.int64).argmax()) or not counts:
            continue
        late = [replace(item, first=item.first + k) for k in counts]
        early = [replace(item, last=item.last - k) for k in counts]
        left = _rotation_chi2(_fitted(flight, whole, [*late, *early]))
        for k, without_first, without_last in zip(counts, *left.unflatten(0, (2, -1)).tolist(), strict=True):
            if without_first <= LIMITS.free_chi2 * usual and without_last >= LIMITS.skew * without_first:
                found[item.episode] = item.first + k
                break
    return found


def find_releases(
    world: World, episodes: Sequence[Episode], noise: tuple[float | None, float | None]
) -> tuple[dict[str, float], list[str]]:
    """Return release times [s] of episodes that begin in a hand, by name, and warnings about them.

    Args:
        world: With the shape, the ground and the inertia.
        episodes: Name and tracks by body of each episode.
        noise: Standard deviations of the tracks (position [m], rotation [rad]); estimated where None.
    """
    free = [world.bodies[k].name for k in world.free]
    found = [tracks[name] for _, tracks in episodes for name in free if name in tracks]
    std = noise_of(noise, found)
    whole = whole_episodes(world, episodes)
    held = carried_starts(world, whole, std)
    freed = without_held(whole, held)
    items, _, _ = cut_episodes(world, freed, std)
    if items and any(track.quat_wxyz is not None for track in found):
        held |= held_starts(fit_states(Segments.of("flight", world, freed, items, std)), freed)
    released_s = {episodes[k][0]: float(whole.times_s[k, first]) for k, first in held.items()}
    return released_s, release_warnings(released_s, {episodes[k][0]: float(whole.times_s[k, 0]) for k in held})


def from_releases(
    world: World, episodes: Sequence[Episode], noise: tuple[float | None, float | None]
) -> tuple[list[Episode], list[str]]:
    """Return the episodes without what begins or ends in a hand or a net, and warnings about these.

    Jointed bodies have none: the detection takes the flight of a single body. Arguments as of `find_releases`.
    """
    if world.chains:
        return list(episodes), []
    released_s, warnings = find_releases(world, episodes, noise)
    freed = after_release(episodes, released_s)
    caught_s, said = find_catches(world, freed, noise)
    return after_release(freed, {}, caught_s), [*warnings, *said]


def without_held(whole: Observations, held: Mapping[int, int]) -> Observations:
    """Return the episodes with the frames before each release (`held`, by episode) marked as not measured."""
    seen, turned = whole.seen.clone(), whole.has_orientation.clone()
    for episode, first in held.items():
        seen[episode, :first], turned[episode, :first] = 0.0, 0.0
    return replace(whole, seen=seen, has_orientation=turned)


def find_catches(
    world: World, episodes: Sequence[Episode], noise: tuple[float | None, float | None]
) -> tuple[dict[str, float], list[str]]:
    """Return the last free times [s] of episodes that end in a hand or a net, by name, and warnings about them.

    Arguments as of `find_releases`.
    """
    free = [world.bodies[k].name for k in world.free]
    whole = whole_episodes(world, episodes)
    std = noise_of(noise, [tracks[name] for _, tracks in episodes for name in free if name in tracks])
    caught = carried_ends(world, whole, std)
    return {episodes[k][0]: float(whole.times_s[k, last]) for k, last in caught.items()}, catch_warnings(
        episodes, whole, caught
    )


def without_caught(whole: Observations, caught: Mapping[int, int]) -> Observations:
    """Return the episodes with the frames after each last free one (`caught`, by episode) marked as not measured."""
    seen, turned = whole.seen.clone(), whole.has_orientation.clone()
    for episode, last in caught.items():
        seen[episode, last + 1 :], turned[episode, last + 1 :] = 0.0, 0.0
    return replace(whole, seen=seen, has_orientation=turned)


def catch_warnings(episodes: Sequence[Episode], whole: Observations, caught: Mapping[int, int]) -> list[str]:
    """Return a warning for each episode that ends in a hand or a net (`caught`: last free frames, by index)."""
    said = []
    for episode, last in caught.items():
        times = whole.times_s[episode, whole.seen[episode].amax(-1) > 0]
        at = float(whole.times_s[episode, last])
        said.append(
            f"episode '{episodes[episode][0]}' ends in a hand or a net: for the last "
            f"{1e3 * (float(times[-1]) - at):.0f} ms something slows the body down. These frames are left out; end the "
            f"recording there ([episodes] end_s in capture.toml: {at:.3f} on the track's clock)."
        )
    return said


def after_release(
    episodes: Iterable[Episode], released_s: Mapping[str, float], caught_s: Mapping[str, float] | None = None
) -> list[Episode]:
    """Return the episodes cut to start at their release times [s] and to end at their catches, where they have one."""
    ends = caught_s or {}
    return [
        Episode(name, {body: track.window(released_s.get(name), ends.get(name)) for body, track in tracks.items()})
        for name, tracks in episodes
    ]


def release_warnings(released_s: Mapping[str, float], starts_s: Mapping[str, float]) -> list[str]:
    """Return a warning for each episode that begins in a hand.

    Args:
        released_s: Time [s] of the release, by name.
        starts_s: Time [s] of the first frame, by name.
    """
    return [
        f"episode '{name}' begins in a hand: for the first {1e3 * (at - starts_s[name]):.0f} ms the body moves or "
        "turns unlike the rest, as if something still touched it or the tracker had not found it yet. These "
        "frames are left out; start the recording there ([episodes] start_s in capture.toml: "
        f"{at:.3f} on the track's clock)."
        for name, at in released_s.items()
    ]


def _fitted(flight: Segments, whole: Observations, items: Sequence[Segment]) -> Segments:
    """Return segments of the same kind as given flights, with fitted states."""
    return fit_states(Segments.of("flight", flight.world, whole, items, flight.noise, flight.noise_model))


def _rotation_chi2(flight: Segments) -> Tensor:
    """Return the reduced chi-square (B,) of the rotations of flights; NaN where too few were measured."""
    rows, _ = flight.residuals((), torch.zeros(0).to(flight.world.gravity), jacobian=False)
    square = torch.nan_to_num(rows[..., 3:], posinf=0.0, neginf=0.0).square().sum((1, 2))
    dof = 3 * (flight.observations.has_orientation.sum(1) - 2).clamp_min(0).sum(-1)
    return torch.where(dof > 0, square / dof.clamp_min(1.0), torch.nan)
