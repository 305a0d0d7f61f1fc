"""The stage phys-geo from videos: pose tracks by rendering and comparing, dynamics on them, then end to end.

1. Pose tracks: `imaging.pose_tracks`, frame by frame.
2. The dynamics on these tracks: `phys_geo.fit_physics`, whose search does not trust gradients through impacts.
3. The method's image loss of the whole rollout, by exact gradients from there: `imaging.refinement`.

The loss is full-image L1, with each camera's exposure estimated on the background, and the silhouettes where there are
masks. The method's second term, the difference of LoFTR features (weight 1, formula undisclosed), is left out: a
public re-implementation found every weight of it to make things worse than L1 alone (contact model notes, section 10).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..datasets.cameras import require_metric
from ..datasets.capture import Capture
from ..datasets.models import Model
from ..datasets.tracks import Track
from ..schemas import InputDataError, PhysConfig
from .estimation.least_squares import Residuals, minimise
from .estimation.observations import Observations
from .estimation.trajectory import TrajectoryResiduals, retract, state_prior
from .estimation.warmup import estimate_states, warmup_frames
from .fit_effects import fit_with_constants
from .imaging.coarse import coarse_model
from .imaging.footage import Footage, load_footage
from .imaging.image_loss import ImageLoss
from .imaging.pose_tracks import PoseTrack, PoseTracker
from .imaging.refinement import ImageObjective, Refined, TrackTerm, refine_end_to_end
from .imaging.silhouette_loss import image_loss
from .imaging.silhouettes import body_outlines
from .phys_geo import MAX_SPAN_S, PhysicsFit, physics_fit
from .physics.driven import Drive
from .physics.parameters import CONTACT_PARAMETERS, GROUND_SHIFT, Parameter, apply_parameters
from .physics.world import World
from .splats.mesh import Mesh
from .video_checks import examine_tracks

COARSE_SIZE, FINE_SIZE = 80, 144
"""Longer side [px] of the pictures for searching poses, and for everything else."""
MAX_INSTANTS = 90
"""More instants of an episode are thinned evenly: the image loss of each costs a render a camera."""
TRACK_ITERATIONS, STATE_ITERATIONS, IMAGE_ITERATIONS = 4, 6, 6
"""Most steps on the tracks, on a state for a whole track, and on the images: each costs a Jacobian of all rollouts."""
STATE_NOISE = (0.003, 0.03)
"""Noise (m, rad) with which a state is fitted to a whole track: the contact model's own errors count more than the
tracks'."""
STATE_STEPS = (2e-4, 2e-3, 5e-3, 5e-2)
"""Differences in position [m], rotation [rad], velocity [m/s] and omega [rad/s]."""
TRUST_STD = 1.5
"""The images move a parameter by at most this many standard errors of the tracks' fit: what neither sees stays."""
UNCERTAINTY_NOTE = "standard error from the pose tracks, not lowered by the image refinement"


@dataclass(frozen=True)
class _Episode:
    """An episode with its losses, and its track: from the images, or measured.

    tracks: by body, of the free bodies as far as found and of the driven ones; found: from images, or None.
    """

    name: str
    footage: Footage | None
    loss: ImageLoss | None
    tracks: dict[str, Track]
    found: PoseTrack | None


def fit_physics_from_images(
    world: World, model: Model, capture: Capture, split: str, config: PhysConfig, tracks_too: bool
) -> PhysicsFit:
    """Fit friction, contact time, damping ratio (and the ground's height) to the videos of a split.

    Appearance and geometry stay as they are. The standard errors are those of the fit to the pose tracks; the
    correlated errors of neighbouring pixels would make the image loss's own far too small.

    Args:
        world: The world with its geometry and inertia.
        model: The model with visual spheres and a background.
        capture: The capture with calibrated, metric cameras and videos.
        split: The episodes to fit.
        config: The stage's settings.
        tracks_too: Use measured tracks where there are any, and images as well; else measured tracks of free bodies
            are not looked at.

    Raises:
        InputDataError: If cameras are missing or unscaled, an episode has no video, or the model lacks what is to
            be rendered.
        NotConvergedError: If the body is not found in the images, or the rollouts diverge.
    """
    started = time.perf_counter()
    if capture.cameras is not None:
        require_metric(capture.cameras)
    outlines, left_out = body_outlines(model, capture, capture.episodes(split))
    episodes = [_episode(world, model, capture, name, tracks_too, outlines) for name in capture.episodes(split)]
    seconds = {"pose_tracks": round(time.perf_counter() - started, 2)}
    noise = _noise(capture, episodes)
    known = noise[0] or 0.0, noise[1] or 0.0
    doubts = examine_tracks(world, [(episode.name, episode.tracks, known) for episode in episodes])
    brief = config.model_copy(update={"iterations": min(config.iterations, TRACK_ITERATIONS)})
    start = fit_with_constants(world, [(episode.name, episode.tracks) for episode in episodes], brief, noise)
    seconds["dynamics"] = round(time.perf_counter() - started - seconds["pose_tracks"], 2)

    names: list[Parameter] = list(CONTACT_PARAMETERS)
    world = start.effects.world if start.effects is not None else world
    if start.ground_offset_m is not None:
        names.append(GROUND_SHIFT)
    shared = _coordinates(world, names, start)
    covariance = _covariance(names, start)
    filmed = [episode for episode in episodes if episode.loss is not None]
    objective = _objective(world, names, filmed, shared, start.noise, config)
    refined, chosen = _refine(objective, shared, covariance, config)
    seconds["images"] = round(time.perf_counter() - started - sum(seconds.values()), 2)
    record = start.record | {
        "image_loss": _loss_record(objective, refined) | {"photometric": not outlines},
        "pose_tracks": {episode.name: _track_record(episode) for episode in episodes},
        "exposure_gain": {e.name: e.loss.gains for e in filmed if e.loss is not None},
        "start_state": chosen,
        "parameters_from_tracks": {p.name: p.estimate for p in start.parameters},
        "image_size_px": FINE_SIZE,
        "seconds_by_step": seconds,
    }
    found = physics_fit(world, names, refined.shared.numpy(), covariance, start.noise, record)
    parameters = tuple(
        p.model_copy(update={"note": f"{p.note}; {UNCERTAINTY_NOTE}" if p.note else UNCERTAINTY_NOTE})
        for p in found.parameters
    )
    effects = () if start.effects is None else start.effects.parameters
    warnings = (*found.warnings, *left_out, *doubts, *_warnings(episodes))
    return replace(
        found,
        parameters=(*parameters, *effects),
        effects=start.effects,
        constants=start.constants,
        warnings=warnings,
    )


def _episode(
    world: World, model: Model, capture: Capture, name: str, tracks_too: bool, outlines: Mapping[str, Mesh]
) -> _Episode:
    """Read an episode and find its tracks."""
    measured = capture.tracks(name)
    drives = _drives(world, capture, name, measured)
    own = {body.name: measured[body.name] for body in world.bodies if body.free and body.name in measured}
    if tracks_too and own and not capture.videos(name):
        return _Episode(name, None, None, own | drives, None)
    footage = _within_span(load_footage(capture, name, FINE_SIZE))
    loss = image_loss(model, footage, world.free, outlines)
    if tracks_too and own:
        return _Episode(name, footage, loss, own | drives, None)
    if len(world.free) > 1 and any(video.covers is None for video in footage.videos):
        raise InputDataError(
            f"{capture.root}: {len(world.free)} free bodies, and videos of episode '{name}' without masks.",
            "video_masks/<camera>/<episode>, or a single free body.",
            "add masks, so that the bodies can be told apart.",
        )
    small = _within_span(load_footage(capture, name, COARSE_SIZE))
    coarse = image_loss(coarse_model(model), small, world.free, outlines)
    position, quat = _given_poses(world, drives, footage.times_s)
    found = PoseTracker(coarse, loss, position, quat).run()
    tracks = {
        world.bodies[index].name: Track(
            footage.times_s[found.found.numpy()],
            found.position_m[found.found, index].numpy(),
            found.quat_wxyz[found.found, index].numpy(),
        )
        for index in world.free
    }
    return _Episode(name, footage, loss, tracks | drives, found)


def _drives(world: World, capture: Capture, name: str, measured: dict[str, Track]) -> dict[str, Track]:
    """Return the tracks of driven bodies: they are commands, with images as well."""
    drives = {}
    for body in world.bodies:
        if body.motion == "driven":
            if body.name not in measured:
                raise InputDataError(
                    f"{capture.root}: the driven body '{body.name}' has no track in episode '{name}'; "
                    f"its track is its command.",
                    todo=f"add rows for '{body.name}' to tracks/{name}.csv.",
                )
            drives[body.name] = measured[body.name]
    return drives


def _given_poses(world: World, drives: dict[str, Track], times_s: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return poses of all bodies (I, nb, ...) at times (I,), those of driven bodies filled in."""
    count, bodies = len(times_s), len(world.bodies)
    position = torch.zeros(count, bodies, 3, dtype=torch.float64)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(count, bodies, 1)
    for index, body in enumerate(world.bodies):
        if body.name in drives:
            drive = Drive.of([drives[body.name]] * count, position)
            motion = drive.at(torch.as_tensor(times_s))
            position[:, index], quat[:, index] = motion.com, motion.quat_wxyz
    return position, quat


def _within_span(footage: Footage) -> Footage:
    """Return the footage up to the span of the fit, thinned evenly to the most instants."""
    times = footage.times_s
    keep = np.flatnonzero(times <= times[0] + MAX_SPAN_S + 1e-9)
    if len(keep) > MAX_INSTANTS:
        keep = keep[np.linspace(0, len(keep) - 1, MAX_INSTANTS).round().astype(int)]
    return Footage(footage.episode, footage.videos, times[keep], footage.frame_at[:, keep])


def _noise(capture: Capture, episodes: Sequence[_Episode]) -> tuple[float | None, float | None]:
    """Return the noise of the tracks (position [m], rotation [rad]); None where it is to be estimated from them.

    For tracks from images it comes from the pixels: their scatter about smooth motion is no measure, because a video
    of some fifteen frames has an impact in every window.
    """
    found = [episode.found for episode in episodes if episode.found is not None]
    if not found:
        return capture.manifest.measurement.position_std_m, capture.manifest.measurement.rotation_std_rad
    variance = torch.cat([track.covariance[track.found].diagonal(dim1=1, dim2=2) for track in found])
    std = variance.unflatten(1, (-1, 2, 3)).median(0).values.mean((0, 2)).sqrt()
    return float(std[0]), float(std[1])


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
    return np.asarray(fit.record["correlation"]) * np.outer(std, std)


def _objective(
    world: World,
    names: Sequence[Parameter],
    filmed: Sequence[_Episode],
    shared: Tensor,
    noise: tuple[float, float],
    config: PhysConfig,
) -> ImageObjective:
    """Put the episodes on time grids that hold every instant, with states estimated by the fitted world."""
    rows = []
    for episode in filmed:
        assert episode.footage is not None
        rows.append({name: _completed(track, episode.footage.times_s) for name, track in episode.tracks.items()})
    windows = []
    for episode in filmed:
        assert episode.footage is not None
        windows.append((float(episode.footage.times_s[0]) - 1e-9, float(episode.footage.times_s[-1]) + 1e-9))
    pairs = [(episode.name, tracks) for episode, tracks in zip(filmed, rows, strict=True)]
    observations = _measured_only(world, Observations.of(world, pairs, windows), filmed)
    fitted = apply_parameters(
        world, names, torch.stack([p.decode(z) for p, z in zip(names, shared, strict=True)])[None]
    )
    warm = warmup_frames(fitted, observations, config.warmup_s)
    observations, _ = estimate_states(fitted, observations, warm, noise)
    losses, columns = [], []
    for item, episode in enumerate(filmed):
        assert episode.loss is not None and episode.footage is not None
        grid = observations.times_s[item].numpy()
        columns.append(
            torch.tensor(
                [
                    list(range(len(episode.footage.times_s))),
                    [int(np.abs(grid - t).argmin()) for t in episode.footage.times_s],
                ]
            )
        )
        losses.append(episode.loss)
    measured = all(episode.found is None for episode in filmed)
    term = TrackTerm(observations, noise) if measured else None
    objective = ImageObjective(world, names, observations, losses, columns, term)
    if term is None:
        return objective
    zero = torch.zeros(len(filmed), 12 * len(world.free), dtype=torch.float64)
    return replace(objective, scale=float(objective.parts(objective.rollout(shared, zero))[:2].sum()))


def _completed(track: Track, times_s: np.ndarray) -> Track:
    """Return a track that has a sample at each of the given times as well: the nearest one, as a placeholder."""
    extra = np.array([t for t in times_s if np.abs(track.time_s - t).min() > 1e-6])
    every = np.concatenate([track.time_s, extra])
    order = np.argsort(every, kind="stable")
    nearest = np.abs(track.time_s[:, None] - every[order]).argmin(0)
    quat = None if track.quat_wxyz is None else track.quat_wxyz[nearest]
    return Track(every[order], track.position_m[nearest], quat)


def _measured_only(world: World, observations: Observations, filmed: Sequence[_Episode]) -> Observations:
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


def _refine(
    objective: ImageObjective, shared: Tensor, covariance: np.ndarray, config: PhysConfig
) -> tuple[Refined, str]:
    """Refine from the better of two states: that of the warm-up, and the one that fits the whole track."""
    limits = torch.tensor([parameter.limits for parameter in objective.parameters], dtype=torch.float64)
    reach = TRUST_STD * torch.as_tensor(np.sqrt(np.diag(covariance)))
    bounds = torch.stack([(shared - reach).maximum(limits[:, 0]), (shared + reach).minimum(limits[:, 1])], -1)
    batch = len(objective.observations.names)
    states = torch.zeros(batch, 12 * len(objective.observations.free), dtype=torch.float64)
    whole = _state_of_whole_track(objective, shared)
    starts = {"warm-up": objective, "whole track": whole}
    values = {name: one.value(one.parts(one.rollout(shared, states))) for name, one in starts.items()}
    chosen = min(values, key=lambda name: values[name])
    return refine_end_to_end(starts[chosen], shared, states, bounds, min(config.iterations, IMAGE_ITERATIONS)), chosen


def _state_of_whole_track(objective: ImageObjective, shared: Tensor) -> ImageObjective:
    """Return the objective with states fitted to all frames of the tracks at the given parameters."""
    values = torch.stack([p.decode(z) for p, z in zip(objective.parameters, shared, strict=True)])[None]
    world = apply_parameters(objective.world, objective.parameters, values)
    observations = objective.observations
    exact = TrajectoryResiduals(world, [], observations, *STATE_NOISE)
    bodies = len(observations.free)
    nothing = shared[:0]
    solution = minimise(
        _differenced(exact),
        nothing,
        torch.zeros(len(observations.names), 12 * bodies, dtype=torch.float64),
        torch.zeros(0, 2, dtype=torch.float64),
        robust_scale=3.0,
        iterations=STATE_ITERATIONS,
        prior_information=state_prior(bodies),
    )
    return replace(
        objective,
        observations=replace(observations, state=retract(observations.state, solution.states, observations.free)),
    )


def _differenced(exact: TrajectoryResiduals) -> Residuals:
    """Return residuals whose Jacobian by the states comes from differences: a quarter of the exact one's time.

    It only leads to a start of the refinement, which has exact derivatives.
    """

    def residuals(shared: Tensor, states: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor | None]:
        if not with_jacobian:
            return exact(shared, states, False)
        batch, size = states.shape
        steps = torch.tensor([s for s in STATE_STEPS for _ in range(3)], dtype=states.dtype).repeat(size // 12)
        changes = torch.cat([torch.zeros(1, size).to(states), torch.diag(steps)])
        every = replace(exact, observations=exact.observations.select(list(range(batch)) * (size + 1)))
        rows, _ = every(shared, (states + changes[:, None]).flatten(0, 1), False)
        rows = rows.unflatten(0, (size + 1, batch))
        return rows[0], ((rows[1:] - rows[0]) / steps[:, None, None, None]).movedim(0, -1)

    return residuals


def _loss_record(objective: ImageObjective, refined: Refined) -> dict[str, Any]:
    def parts(values: Tensor) -> dict[str, float]:
        photometric, mask, tracks = values.tolist()
        row = {"total": photometric + mask, "photometric_l1": photometric, "mask_l1": mask}
        return row | ({"tracks": tracks} if objective.tracks is not None else {})

    return {
        "before": parts(refined.before),
        "after": parts(refined.after),
        "history": refined.history,
        "iterations": len(refined.history) - 1,
        "stopped": refined.stopped,
    }


def _track_record(episode: _Episode) -> dict[str, Any]:
    if episode.found is None:
        return {"source": "measured"}
    found, quality = episode.found, episode.found.quality
    std = found.covariance.diagonal(dim1=1, dim2=2).unflatten(1, (-1, 2, 3)).mean(-1).sqrt()[found.found].median(0)
    overlap = quality.iou[found.found].nanmedian()
    return {
        "source": "images",
        "instants": len(found.found),
        "found": int(found.found.sum()),
        "searches": found.searches,
        "mask_iou": None if bool(overlap.isnan()) else float(overlap),
        "color_error": float(quality.error[found.found].median()),
        "color_error_without_body": float(quality.blank[found.found].median()),
        "position_std_m": float(std.values[..., 0].mean()),
        "rotation_std_rad": float(std.values[..., 1].mean()),
    }


def _warnings(episodes: Sequence[_Episode]) -> list[str]:
    texts = []
    for episode in episodes:
        if episode.found is None:
            continue
        lost = int((~episode.found.found).sum())
        if lost:
            texts.append(f"{episode.name}: the body was not found in {lost} of {len(episode.found.found)} instants.")
        if episode.footage is not None and all(video.covers is None for video in episode.footage.videos):
            texts.append(
                f"{episode.name}: videos without masks; orientations rest on colours alone, which changing light on a "
                f"turning body can mislead. Add video_masks/ to be sure."
            )
        if episode.footage is not None and len(episode.footage.videos) == 1:
            texts.append(f"{episode.name}: one camera; depth comes from the body's size alone.")
    return texts
