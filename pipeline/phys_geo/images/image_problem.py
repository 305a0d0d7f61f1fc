"""Image loss of rollouts as the problem of the end-to-end refinement, with its start states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ....datasets.capture.tracks import Episode, Track
from ....schemas import PhysConfig
from ...optimization.levenberg_marquardt import minimise
from ...physics.observation_model import measure
from ...physics.parameters import apply_parameters
from ...physics.state import State
from ...physics.world import World
from ...trajectories.initial_state import estimate_states, warmup_frames
from ...trajectories.observations import Observations
from ...trajectories.residuals import TrajectoryResiduals, retract, state_prior
from ...trajectories.track_noise import Noise
from ..tracks.contact_result import ContactEstimate, PhysicsFit
from .contact_spheres import ContactSpheres, dense_times
from .end_to_end import ImageObjective, TrackTerm
from .image_loss import ImageLoss
from .video_episodes import VideoEpisode

STATE_ITERATIONS = 6
"""Maximum number of steps in the fit of states to whole tracks; each needs a Jacobian of all rollouts."""
STATE_NOISE = (0.003, 0.03)
"""Noise assumed in the fit of a state to a whole track (position [m], rotation [rad]), dominated by errors of the
contact model."""
HOLD_OUT_EVERY, HOLD_OUT_FROM = 4, 8
"""Period of the instants that are held out of the image loss, and minimum number of instants of an episode for it."""
DENSE_S = 0.004
"""Time step at which rollouts are checked for contact spheres [s]."""


@dataclass(frozen=True)
class TracksEstimate:
    """Result of the fit to the pose tracks, from which the image refinement starts."""

    world: World
    """The world with the fitted effects."""
    contact: ContactEstimate
    """Contact parameters in fitted coordinates."""


@dataclass(frozen=True)
class FilmedEpisode:
    """An episode with videos."""

    name: str
    """Name of the episode."""
    tracks: dict[str, Track]
    """Tracks by body, found in the videos or measured."""
    loss: ImageLoss
    """Image loss of its frames."""
    measured: bool
    """Whether the tracks were measured, not found in the videos."""

    @property
    def times_s(self) -> np.ndarray:
        """Instants of the videos [s], shape (I,)."""
        return self.loss.footage.times_s


def filmed_episodes(episodes: Sequence[VideoEpisode]) -> list[FilmedEpisode]:
    """Return the episodes that have videos."""
    return [
        FilmedEpisode(episode.name, episode.tracks, episode.loss, episode.found is None)
        for episode in episodes
        if episode.loss is not None
    ]


@dataclass(frozen=True)
class ImageProblem:
    """Refinement of a fit by the image loss, with its start."""

    objective: ImageObjective
    """The image loss of rollouts, at the best start states."""
    shared: Tensor
    """Start of the parameters and spheres in fitted coordinates, shape (P + G,)."""
    start_state: str
    """Origin of the start states: `warm-up`, `whole track` or `shooting`."""


def image_problem(
    estimate: TracksEstimate, filmed: Sequence[FilmedEpisode], start: PhysicsFit, config: PhysConfig
) -> ImageProblem:
    """Return the image loss on time grids with all instants, at the start states with the lowest loss.

    Candidates for the start states are those of the warm-up, of a fit to the whole track, and of shooting.
    """
    world, names = estimate.world, estimate.contact.parameters
    shared = torch.as_tensor(estimate.contact.values)
    values = torch.stack([p.decode(z) for p, z in zip(names, shared, strict=True)])[None]
    fitted = apply_parameters(world, names, values)
    observations = _warm_started(fitted, _observed(world, filmed), config.warmup_s, start.noise)
    columns, held = _instants(observations, filmed)
    plain = ImageObjective(
        world=world,
        parameters=names,
        observations=observations,
        losses=[episode.loss for episode in filmed],
        columns=columns,
        held=held,
    )
    starts = {"warm-up": observations, "whole track": _whole_track(fitted, observations)}
    shot = _shot_states(observations, start)
    if shot is not None:
        starts["shooting"] = shot
    losses = {name: _loss_at(replace(plain, observations=one), shared) for name, one in starts.items()}
    chosen = min(losses, key=lambda name: losses[name])
    objective = replace(plain, observations=starts[chosen], unit=losses[chosen])
    if all(episode.measured for episode in filmed):
        term = TrackTerm(objective.observations, start.noise)
        objective = replace(objective, tracks=term, scale=losses[chosen], unit=1.0)
    if config.geometry:
        objective = replace(objective, geometry=_touching(fitted, objective.observations))
    return ImageProblem(objective, torch.cat([shared, shared.new_zeros(objective.moved)]), chosen)


def _observed(world: World, filmed: Sequence[FilmedEpisode]) -> Observations:
    """Return the tracks on time grids that hold every instant of the videos."""
    rows, windows = [], []
    for episode in filmed:
        times = episode.times_s
        completed = {name: _completed(track, times) for name, track in episode.tracks.items()}
        rows.append(Episode(episode.name, completed))
        windows.append((float(times[0]) - 1e-9, float(times[-1]) + 1e-9))
    return _measured_only(world, Observations.of(world, rows, windows), filmed)


def _warm_started(world: World, observations: Observations, warmup_s: float, noise: Noise) -> Observations:
    """Return the observations with initial states from their warm-up."""
    warm = warmup_frames(world, observations, warmup_s)
    observations, _ = estimate_states(world, observations, warm, noise)
    return observations


def _instants(observations: Observations, filmed: Sequence[FilmedEpisode]) -> tuple[list[Tensor], Sequence[Tensor]]:
    """Return for each episode the fitted instants and their frames in the grid (2, k), and the held-out ones.

    The second is empty if no episode has held-out instants.
    """
    columns, held = [], []
    for item, episode in enumerate(filmed):
        grid = observations.times_s[item].numpy()
        frames = [int(np.abs(grid - t).argmin()) for t in episode.times_s]
        pair = torch.tensor([list(range(len(frames))), frames])
        out = torch.arange(len(frames)) % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1
        out &= torch.tensor(len(frames) >= HOLD_OUT_FROM)
        columns.append(pair[:, ~out])
        held.append(pair[:, out])
    return columns, held if any(pair.shape[1] for pair in held) else ()


def _loss_at(objective: ImageObjective, shared: Tensor) -> float:
    """Return the image loss of parameters (P,) at the objective's start states."""
    observations = objective.observations
    unchanged = torch.zeros(len(observations.names), 12 * len(observations.free), dtype=torch.float64)
    return float(objective.parts(objective.rollout(shared, unchanged))[:2].sum())


def _touching(world: World, observations: Observations) -> ContactSpheres | None:
    """Return the contact spheres of the rollouts; None if nothing touches."""
    step = float(observations.times_s.diff(dim=1).max())
    dense = dense_times(observations.times_s, max(1, round(step / DENSE_S)))
    with torch.no_grad():
        spheres = ContactSpheres.of(world, measure(world, observations.state, dense, observations.drives))
    return spheres if spheres.count else None


def _shot_states(observations: Observations, start: PhysicsFit) -> Observations | None:
    """Return the observations with the start states of shooting; None if it has not one for each first frame."""
    states = []
    for name, time_s in zip(observations.names, observations.times_s[:, 0], strict=True):
        found = start.starts.get(name)
        if found is None or abs(found[0] - float(time_s)) > 1e-6:
            return None
        states.append(found[1])
    return replace(observations, state=State.joined(*states))


def _completed(track: Track, times_s: np.ndarray) -> Track:
    """Return a track with additional samples at given times, which repeat the nearest sample as a placeholder."""
    extra = np.array([t for t in times_s if np.abs(track.time_s - t).min() > 1e-6])
    every = np.concatenate([track.time_s, extra])
    order = np.argsort(every, kind="stable")
    nearest = np.abs(track.time_s[:, None] - every[order]).argmin(0)
    quat = None if track.quat_wxyz is None else track.quat_wxyz[nearest]
    return Track(every[order], track.position_m[nearest], quat)


def _measured_only(world: World, observations: Observations, filmed: Sequence[FilmedEpisode]) -> Observations:
    """Return the observations with placeholders marked as not seen."""
    seen, turned = observations.seen.clone(), observations.has_orientation.clone()
    for item, episode in enumerate(filmed):
        for column, index in enumerate(world.free):
            track = episode.tracks.get(world.bodies[index].name)
            grid = observations.times_s[item].numpy()
            away = np.ones(len(grid), bool) if track is None else np.abs(grid[:, None] - track.time_s).min(1) > 1e-6
            seen[item, torch.as_tensor(away), column] = 0.0
            turned[item, torch.as_tensor(away), column] = 0.0
    return replace(observations, seen=seen, has_orientation=turned)


def _whole_track(world: World, observations: Observations) -> Observations:
    """Return the observations with states fitted to all frames of the tracks."""
    bodies = len(observations.free)
    solution = minimise(
        TrajectoryResiduals(world, [], observations, *STATE_NOISE, differences=True),
        torch.zeros(0, dtype=torch.float64),
        torch.zeros(len(observations.names), 12 * bodies, dtype=torch.float64),
        torch.zeros(0, 2, dtype=torch.float64),
        robust_scale=3.0,
        iterations=STATE_ITERATIONS,
        prior_information=state_prior(bodies),
    )
    return replace(observations, state=retract(observations.state, solution.states, observations.free))
