"""Episodes in which measured forces drive a jointed body: which link each pushes, from which zero of its sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ....datasets.capture.tracks import Episode, Track
from ...physics.world import World
from ...trajectories.initial_state import clearance
from ...trajectories.observations import Observations
from .force_driven import Grid, Pushes, Samples, between, loaded
from .joint_losses import FIRST_FRAMES, MOST_FRAMES
from .measured_forces import force_noise

BEFORE_S = 0.2
"""How long before the first force [s]."""
APART_M = 0.003
"""Gap between links and what does not drive them above which they touch nothing else [m]."""
ZERO_M = 0.005
"""Gap above which a driven body touches nothing, so that its sensor reads its zero [m]."""


@dataclass(frozen=True, kw_only=True)
class Pushed:
    """Part of an episode in which measured forces drive the links."""

    episode: Episode
    """Its tracks, those of driven bodies of their whole length."""
    std_n: dict[str, float]
    """Noise of a component of the forces of each driven body [N]."""

    @staticmethod
    def of(world: World, episode: Episode, std_n: float | None) -> Pushed | None:
        """Cut an episode; None where a driven body has no forces, or none pushes."""
        names = [body.name for body in world.bodies if body.motion == "driven" and body.name in episode.tracks]
        driven = {name: episode.tracks[name] for name in names}
        if not driven or any(track.force_n is None or len(track) < 3 for track in driven.values()):
            return None
        noise = {n: std_n or force_noise(t.force_n) for n, t in driven.items() if t.force_n is not None}
        pushes = [t.time_s[loaded(t, noise[n], t.time_s)] for n, t in driven.items()]
        if not any(len(times) for times in pushes):
            return None
        begins = min(float(times[0]) for times in pushes if len(times)) - BEFORE_S
        first = max(begins, *(float(track.time_s[0]) for track in driven.values()))
        last = min(float(track.time_s[-1]) for track in driven.values())
        links = {n: t for n, t in episode.tracks.items() if n in world.chains[0].links}
        times = np.unique(np.concatenate([track.time_s for track in links.values()]))
        times = times[(times >= first) & (times <= last)][:MOST_FRAMES]
        if len(times) < FIRST_FRAMES:
            return None
        cut = {name: track.window(float(times[0]), float(times[-1])) for name, track in links.items()}
        kept = {name: track for name, track in cut.items() if len(track)}
        return Pushed(episode=Episode(episode.name, kept | driven), std_n=noise)

    def from_zero(self, zeros: Mapping[str, NDArray[np.float64]]) -> Pushed:
        """Return the part with forces from other zeros (3,) of the sensors [N], by driven body."""
        tracks = dict(self.episode.tracks)
        for name, zero in zeros.items():
            track = self.force(name)
            if track is not None and track.force_n is not None:
                tracks[name] = replace(track, force_n=track.force_n - zero)
        return replace(self, episode=Episode(self.episode.name, tracks))

    def force(self, name: str) -> Track | None:
        """Return the track of a driven body with forces, if it is in the episode."""
        return self.episode.tracks.get(name)


def pushed_link(world: World, seen: Observations, pushed: Sequence[Pushed], name: str) -> int | None:
    """Return the place in the chain of the link that a driven body pushes; None where it may be one of several."""
    chain = world.chains[0]
    links = {link: chain.links.index(world.bodies[link_index].name) for link, link_index in enumerate(seen.free)}
    moving = {column: place for column, place in links.items() if chain.moves(chain.links[place])}
    if len(moving) == 1:
        return next(iter(moving.values()))
    near = {place: gaps_to_links(world, seen, name, column) for column, place in moving.items()}
    touched = np.zeros(seen.times_s.shape, bool)
    for e, one in enumerate(pushed):
        track = one.force(name)
        if track is not None:
            touched[e] = loaded(track, one.std_n[name], seen.times_s[e].numpy()) & (seen.seen[e].amax(-1) > 0).numpy()
    ranked = sorted(near, key=lambda place: float(np.median(near[place][touched])))
    return ranked[0] if float(near[ranked[1]][touched].min()) > APART_M else None


def gaps_to_links(world: World, seen: Observations, name: str, column: int | None = None) -> NDArray[np.float64]:
    """Return the smallest gap (E, T) [m] between a driven body and the links, or the one in a column of these."""
    alone = replace(seen, drives={name: seen.drives[name]})
    if column is not None:
        alone = replace(
            alone,
            free=(seen.free[column],),
            position_m=seen.position_m[:, :, [column]],
            quat_wxyz=seen.quat_wxyz[:, :, [column]],
        )
    bodies = tuple(body for body in world.bodies if body.motion != "fixed")
    return clearance(replace(world, bodies=bodies, ground_normal=None, surfaces=()), alone).numpy()


def sensor_zero(
    world: World, seen: Observations, pushed: Sequence[Pushed], name: str
) -> tuple[NDArray[np.float64], float]:
    """Return what a sensor reads apart from all links (3,) [N], and its error: 0 and the noise where it never is."""
    gaps, read, noise = gaps_to_links(world, seen, name), [np.zeros((0, 3))], 0.0
    for e, one in enumerate(pushed):
        track = one.force(name)
        if track is not None and track.force_n is not None:
            count, noise = int(seen.frames[e]), max(noise, one.std_n[name])
            at = np.interp(track.time_s, seen.times_s[e, :count].numpy(), gaps[e, :count], left=0.0, right=0.0)
            read.append(track.force_n[at > ZERO_M])
    every = np.concatenate(read)
    return (np.median(every, 0), 1.25 * noise / len(every) ** 0.5) if len(every) else (np.zeros(3), noise)


def pushes_of(pushed: Sequence[Pushed], name: str, link: int, grid: Grid, zero_std_n: float) -> Pushes:
    """Return what a driven body exerts in all steps of the episodes; the zero of its sensor has an error [N]."""
    tracks = [one.force(name) for one in pushed]
    samples, none = Samples.of(tracks), torch.zeros(*grid.middle_s.shape, 3).to(grid.middle_s)
    place, torque = none.clone(), none.clone()
    for e, track in enumerate(tracks):
        if track is not None:
            place[e] = between(track.time_s, track.position_m, grid.middle_s[e])
            torque[e] = (
                none[e] if track.torque_n_m is None else between(track.time_s, track.torque_n_m, grid.middle_s[e])
            )
    every = torch.arange(len(tracks))
    force = samples.at(every, grid.middle_s, torch.zeros(len(tracks)).to(none))
    mean = force.mean((0, 1))
    offset = zero_std_n * mean / mean.norm().clamp_min(1e-12)
    return Pushes(link=link, samples=samples, force_n=force, place_m=place, torque_n_m=torque, offset_n=offset)
