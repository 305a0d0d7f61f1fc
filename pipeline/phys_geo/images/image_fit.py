"""The stage phys-geo from videos: pose tracks by rendering and comparing, dynamics on them, then end to end.

1. Pose tracks: `imaging.pose_tracks`, frame by frame.
2. The dynamics on these tracks: `phys_geo.fit_physics`, whose search does not trust gradients through impacts.
3. The method's image loss of the whole rollout, from there: parameters, start states and the spheres that touch
   (`imaging.refinement`). It ends when frames that are held out are no longer explained better, and keeps the best.
   The renderer gives geometry no gradient, as published; appearance is tuned afterwards (`appearance`).

The loss is full-image L1, with each camera's exposure estimated on the background, and the silhouettes where there are
masks. The method's second term, the difference of LoFTR features (weight 1, formula undisclosed), is left out: a
public re-implementation found every weight of it to make things worse than L1 alone (contact model notes, section 10).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..datasets.cameras import require_metric
from ..datasets.capture import Capture
from ..datasets.models import Model
from ..datasets.ply import Splats
from ..datasets.tracks import Track
from ..schemas import PhysConfig, UsageError
from .checkpoint import Checkpoint
from .estimation.least_squares import minimise
from .estimation.observations import Observations
from .estimation.trajectory import TrajectoryResiduals, retract, state_prior
from .estimation.warmup import estimate_states, warmup_frames
from .filmed import Episode, filmed_episode, track_record, track_warnings, tracks_noise
from .fit_effects import fit_with_effects
from .imaging.refinement import ImageObjective, Refined, TrackTerm, refine_end_to_end
from .imaging.silhouettes import body_outlines
from .imaging.touching import TouchingSpheres, dense_times
from .phys_geo import PhysicsFit, physics_fit
from .physics.measured import measure
from .physics.parameters import CONTACT_PARAMETERS, GROUND_SHIFT, Parameter, apply_parameters, effect_parameters
from .physics.world import State, World
from .sg_gs import resolve_device
from .video_checks import examine_tracks

STATE_ITERATIONS, IMAGE_ITERATIONS = 6, 6
"""Most steps on a state for a whole track, and on the images: each costs a Jacobian of all rollouts."""
HOLD_OUT_EVERY, HOLD_OUT_FROM = 4, 8
"""Of so many instants one is held out of the image loss, where an episode has at least so many."""
DENSE_S = 0.004
"""Between two frames a rollout is looked at this often for spheres that touch."""
SPHERES_LIMIT = 2.5
"""Most that a sphere is moved, in widths of its prior."""
STATE_NOISE = (0.003, 0.03)
"""Noise (m, rad) with which a state is fitted to a whole track: the contact model's own errors count more than the
tracks'."""
TRUST_STD = 1.5
"""The images move a parameter by at most this many standard errors of the tracks' fit: what neither sees stays."""
UNCERTAINTY_NOTE = "standard error from the pose tracks, not lowered by the image refinement"


def fit_physics_from_images(
    world: World,
    model: Model,
    capture: Capture,
    split: str,
    config: PhysConfig,
    tracks_too: bool,
    checkpoint: Checkpoint,
) -> PhysicsFit:
    """Fit friction, contact time, damping ratio, ground height and touching spheres to the videos of a split.

    The standard errors are those of the fit to the pose tracks; the correlated errors of neighbouring pixels would make
    the image loss's own far too small.

    Args:
        world: The world with its geometry and inertia.
        model: The model with visual spheres and a background.
        capture: The capture with calibrated, metric cameras and videos.
        split: The episodes to fit.
        config: The stage's settings.
        tracks_too: Use measured tracks where there are any, and images as well; else measured tracks of free bodies
            are not looked at.
        checkpoint: Takes the poses of each episode when they are found.

    Raises:
        InputDataError: If cameras are missing or unscaled, an episode has no video, or the model lacks what is to
            be rendered.
        NotConvergedError: If the body is not found in the images, or the rollouts diverge.
    """
    clock = _Clock()
    if capture.cameras is not None:
        require_metric(capture.cameras)
    outlines, left_out = body_outlines(model, capture, capture.episodes(split))
    episodes = [
        filmed_episode(
            world,
            model,
            capture,
            name,
            outlines,
            checkpoint.slot(f"poses of {name}"),
            tracks_too=tracks_too,
            image_size=config.image_size,
            device=resolve_device(config.device),
        )
        for name in capture.episodes(split)
    ]
    clock.lap("pose_tracks")
    noise = tracks_noise(capture, episodes)
    known = noise[0] or 0.0, noise[1] or 0.0
    doubts = examine_tracks(world, [(episode.name, episode.tracks, known) for episode in episodes])
    if any(number.shared != "all" for number in effect_parameters(world)):
        raise UsageError(
            "numbers of each group's or episode's own with --supervise images: images do not tell them apart yet.",
            "NAME@group and NAME@episode with --supervise tracks.",
        )
    start = fit_with_effects(world, [(episode.name, episode.tracks) for episode in episodes], config, noise)
    clock.lap("dynamics")

    world = start.effects.world if start.effects is not None else world
    names: list[Parameter] = list(CONTACT_PARAMETERS)
    if start.ground_offset_m is not None:
        names.append(GROUND_SHIFT)
    covariance = _covariance(names, start)
    filmed = [episode for episode in episodes if episode.loss is not None]
    objective, shared, chosen = _objective(world, names, filmed, start, config)
    refined = _refine(objective, shared, covariance, config)
    clock.lap("images")
    numbers, spheres = refined.shared[: len(names)], refined.shared[len(names) :]
    record = start.record | {
        "image_loss": _loss_record(objective, refined) | {"photometric": not outlines},
        "pose_tracks": {episode.name: track_record(episode) for episode in episodes},
        "exposure_gain": {e.name: e.loss.gains for e in filmed if e.loss is not None},
        "start_state": chosen,
        "parameters_from_tracks": {p.name: p.estimate for p in start.parameters},
        "geometry": {} if objective.geometry is None else objective.geometry.record(world, spheres),
        "image_size_px": config.image_size,
        "seconds_by_step": clock.seconds,
    }
    found = physics_fit(world, names, numbers.numpy(), covariance, start.noise, record)
    parameters = tuple(
        p.model_copy(update={"note": f"{p.note}; {UNCERTAINTY_NOTE}" if p.note else UNCERTAINTY_NOTE})
        for p in found.parameters
    )
    effects = () if start.effects is None else start.effects.parameters
    return replace(
        found,
        parameters=(*parameters, *effects),
        correlations=(*found.correlations, *start.correlations[1:]),
        effects=start.effects,
        constants=start.constants,
        warnings=(*found.warnings, *left_out, *doubts, *track_warnings(episodes)),
        collision=_moved(model, objective, spheres),
        tracks={episode.name: episode.tracks for episode in episodes if episode.found is not None},
    )


@dataclass
class _Clock:
    """Seconds by step."""

    started: float = field(default_factory=time.perf_counter)
    seconds: dict[str, float] = field(default_factory=dict)

    def lap(self, name: str) -> None:
        """Give the time since the last lap to a step."""
        now = time.perf_counter()
        self.seconds[name] = round(now - self.started, 2)
        self.started = now


def _moved(model: Model, objective: ImageObjective, spheres: Tensor) -> dict[str, Splats]:
    """Return the colliding spheres of the bodies of which some were moved."""
    if objective.geometry is None:
        return {}
    world, found = objective.geometry.apply(objective.world, spheres[None]), {}
    for index, _ in objective.geometry.chosen:
        body, factor = world.bodies[index], model.file.bodies[index].radius_factor
        old = model.collision[body.name]
        found[body.name] = replace(old, means=body.centers[0].numpy(), scales=body.radii[0].numpy() / factor)
    return found


def _coordinates(world: World, names: Sequence[Parameter], fit: PhysicsFit) -> Tensor:
    """Return the fit's estimates in fitted coordinates (P,)."""
    estimate = {p.name: p.estimate for p in fit.parameters}
    values = [parameter.encode(estimate[parameter.name]) for parameter in names if parameter is not GROUND_SHIFT]
    if GROUND_SHIFT in names:
        assert world.ground_offset is not None and fit.ground_offset_m is not None
        values.append(fit.ground_offset_m - float(world.ground_offset[0]))
    limits = torch.tensor([parameter.limits for parameter in names], dtype=torch.float64)
    return torch.tensor(values, dtype=torch.float64).clamp(limits[:, 0], limits[:, 1])


def _covariance(names: Sequence[Parameter], fit: PhysicsFit) -> np.ndarray:
    """Return the covariance of the fit in fitted coordinates (P, P)."""
    by_name = {p.name: p for p in fit.parameters}
    std = []
    for parameter in names:
        found = by_name["ground_offset_m" if parameter is GROUND_SHIFT else parameter.name]
        std.append((found.std_error or 0.0) / (found.estimate if parameter.logarithmic else 1.0))
    return np.asarray(fit.correlations[0].matrix) * np.outer(std, std)


def _objective(
    world: World, names: Sequence[Parameter], filmed: Sequence[Episode], start: PhysicsFit, config: PhysConfig
) -> tuple[ImageObjective, Tensor, str]:
    """Put the episodes on time grids that hold every instant; return with it where the refinement starts.

    The start states are those of the warm-up, of the shooting, or of a fit to the whole track: which has the lowest
    image loss.
    """
    rows, windows = [], []
    for episode in filmed:
        assert episode.footage is not None
        times = episode.footage.times_s
        rows.append((episode.name, {name: _completed(track, times) for name, track in episode.tracks.items()}))
        windows.append((float(times[0]) - 1e-9, float(times[-1]) + 1e-9))
    shared = _coordinates(world, names, start)
    values = torch.stack([p.decode(z) for p, z in zip(names, shared, strict=True)])[None]
    fitted = apply_parameters(world, names, values)
    observations = _measured_only(world, Observations.of(world, rows, windows), filmed)
    warm = warmup_frames(fitted, observations, config.warmup_s)
    observations, _ = estimate_states(fitted, observations, warm, start.noise)
    losses, columns, held = [], [], []
    for item, episode in enumerate(filmed):
        assert episode.loss is not None and episode.footage is not None
        grid = observations.times_s[item].numpy()
        frames = [int(np.abs(grid - t).argmin()) for t in episode.footage.times_s]
        pair = torch.tensor([list(range(len(frames))), frames])
        out = torch.arange(len(frames)) % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1
        out &= torch.tensor(len(frames) >= HOLD_OUT_FROM)
        columns.append(pair[:, ~out])
        held.append(pair[:, out])
        losses.append(episode.loss)
    some = any(pair.shape[1] for pair in held)
    plain = ImageObjective(world, names, observations, losses, columns, held if some else ())
    zero = torch.zeros(len(filmed), 12 * len(world.free), dtype=torch.float64)
    starts = {"warm-up": observations, "whole track": _whole_track(fitted, observations)}
    shot = _shot_states(observations, start)
    if shot is not None:
        starts["shooting"] = shot
    losses_at = {
        name: float(plain_at.parts(plain_at.rollout(shared, zero))[:2].sum())
        for name, plain_at in ((name, replace(plain, observations=one)) for name, one in starts.items())
    }
    chosen = min(losses_at, key=lambda name: losses_at[name])
    objective = replace(plain, observations=starts[chosen], unit=losses_at[chosen])
    if all(episode.found is None for episode in filmed):
        term = TrackTerm(objective.observations, start.noise)
        objective = replace(objective, tracks=term, scale=losses_at[chosen], unit=1.0)
    if config.geometry:
        objective = replace(objective, geometry=_touching(fitted, objective.observations))
    return objective, torch.cat([shared, shared.new_zeros(objective.moved)]), chosen


def _touching(world: World, observations: Observations) -> TouchingSpheres | None:
    """Return the spheres that touch something in the rollouts; None where none does."""
    step = float(observations.times_s.diff(dim=1).max())
    dense = dense_times(observations.times_s, max(1, round(step / DENSE_S)))
    with torch.no_grad():
        spheres = TouchingSpheres.of(world, measure(world, observations.state, dense, observations.drives))
    return spheres if spheres.count else None


def _shot_states(observations: Observations, start: PhysicsFit) -> Observations | None:
    """Return the observations with the shooting's start states, where it has one of every episode's first frame."""
    states = []
    for name, time_s in zip(observations.names, observations.times_s[:, 0], strict=True):
        found = start.starts.get(name)
        if found is None or abs(found[0] - float(time_s)) > 1e-6:
            return None
        states.append(found[1])
    return replace(observations, state=State.joined(*states))


def _completed(track: Track, times_s: np.ndarray) -> Track:
    """Return a track that has a sample at each of the given times as well: the nearest one, as a placeholder."""
    extra = np.array([t for t in times_s if np.abs(track.time_s - t).min() > 1e-6])
    every = np.concatenate([track.time_s, extra])
    order = np.argsort(every, kind="stable")
    nearest = np.abs(track.time_s[:, None] - every[order]).argmin(0)
    quat = None if track.quat_wxyz is None else track.quat_wxyz[nearest]
    return Track(every[order], track.position_m[nearest], quat)


def _measured_only(world: World, observations: Observations, filmed: Sequence[Episode]) -> Observations:
    """Return the observations with the placeholders marked as not seen."""
    seen, turned = observations.seen.clone(), observations.turned.clone()
    for item, episode in enumerate(filmed):
        for column, index in enumerate(world.free):
            track = episode.tracks.get(world.bodies[index].name)
            grid = observations.times_s[item].numpy()
            away = np.ones(len(grid), bool) if track is None else np.abs(grid[:, None] - track.time_s).min(1) > 1e-6
            seen[item, torch.as_tensor(away), column] = 0.0
            turned[item, torch.as_tensor(away), column] = 0.0
    return replace(observations, seen=seen, turned=turned)


def _refine(objective: ImageObjective, shared: Tensor, covariance: np.ndarray, config: PhysConfig) -> Refined:
    """Refine parameters within reach of what the tracks said, and spheres within that of what the photos did."""
    count = len(objective.parameters)
    limits = torch.tensor([parameter.limits for parameter in objective.parameters], dtype=torch.float64)
    reach = TRUST_STD * torch.as_tensor(np.sqrt(np.diag(covariance)))
    low, high = (shared[:count] - reach).maximum(limits[:, 0]), (shared[:count] + reach).minimum(limits[:, 1])
    spheres = torch.full((objective.moved,), SPHERES_LIMIT, dtype=torch.float64)
    bounds = torch.stack([torch.cat([low, -spheres]), torch.cat([high, spheres])], -1)
    batch = len(objective.observations.names)
    states = torch.zeros(batch, 12 * len(objective.observations.free), dtype=torch.float64)
    return refine_end_to_end(objective, shared, states, bounds, min(config.iterations, IMAGE_ITERATIONS))


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


def _loss_record(objective: ImageObjective, refined: Refined) -> dict[str, Any]:
    def parts(values: Tensor) -> dict[str, float]:
        photometric, mask, tracks = values.tolist()
        row = {"total": photometric + mask, "photometric_l1": photometric, "mask_l1": mask}
        return row | ({"tracks": tracks} if objective.tracks is not None else {})

    return {
        "before": parts(refined.before),
        "after": parts(refined.after),
        "history": refined.history,
        "held_out": refined.held,
        "held_out_instants": sum(pair.shape[1] for pair in objective.held),
        "kept_step": refined.kept,
        "iterations": len(refined.history) - 1,
        "stopped": refined.stopped,
    }
