"""Video episodes for phys-geo: image losses, and tracks found in the videos."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.capture import Capture
from ....datasets.capture.tracks import Track
from ....datasets.models.model import Model
from ....datasets.shapes.meshes import Mesh
from ....schemas import InputDataError
from ...physics.kinematic import Drive
from ...physics.world import World
from ...runtime.checkpoint import Slot
from ..tracks.contact_fit import MAX_SPAN_S
from .coarse_spheres import coarse_model
from .image_loss import ImageLoss
from .pose_search import small_silhouette_px
from .pose_tracking import PoseTrack, PoseTracker, pose_noise, stored_track, track_state
from .silhouette_loss import image_loss
from .video_frames import Footage, load_footage

COARSE_SIZE, COARSE_BODY_PX = 80, 20.0
"""Longer side of the images for the pose search [px], and minimum area of a body in them [px], for which they are made
larger."""
MAX_INSTANTS = 90
"""Maximum number of instants of an episode, evenly spread; each costs a render for each camera."""
RIVAL_NATS = 25.0
"""Log-likelihood ratio below which another history of poses is reported as possible [nats]. A body that looks exactly
the same turned about reaches 15, as the search knows it by a part of its spheres only."""


@dataclass(frozen=True, kw_only=True)
class VideoEpisode:
    """An episode with its image loss and its tracks, which are measured or found in the images."""

    name: str
    """Name of the episode."""
    footage: Footage | None
    """Videos of the episode; None if there are none."""
    loss: ImageLoss | None
    """Image loss of the videos; None if there are none."""
    tracks: dict[str, Track]
    """Tracks by body: of the free bodies as far as known, and of the driven ones."""
    found: PoseTrack | None
    """Poses found in the images; None for measured tracks."""


def load_video_episode(
    world: World,
    model: Model,
    capture: Capture,
    name: str,
    outlines: Mapping[str, Mesh],
    slot: Slot | None,
    *,
    tracks_too: bool,
    image_size: int,
    device: torch.device,
    span_s: float = MAX_SPAN_S,
) -> VideoEpisode:
    """Read an episode and find its tracks.

    Args:
        world: The world.
        model: The model whose renders are compared with the frames.
        capture: The capture.
        name: Name of the episode.
        outlines: Surfaces of the bodies, where only masks can be compared.
        slot: Part of the checkpoint for the found poses, so that an interrupted fit does not search for them again;
            None for none.
        tracks_too: Use measured tracks where there are any, instead of finding them in the images.
        image_size: Longer side of the compared images [px].
        device: Device of the renderer.
        span_s: Duration of the start of the episode that is used [s].

    Raises:
        InputDataError: If the episode lacks videos, masks or tracks that are needed.
        NotConvergedError: If the body is not found.
    """
    measured = capture.tracks(name)
    drives = commands(world, capture, name, measured)
    own = {body.name: measured[body.name] for body in world.bodies if body.free and body.name in measured}
    if tracks_too and own and not capture.videos(name):
        return VideoEpisode(name=name, footage=None, loss=None, tracks=own | drives, found=None)
    footage = _within_span(load_footage(capture, name, image_size, device), span_s)
    loss = image_loss(model, footage, world.free, outlines)
    if tracks_too and own:
        return VideoEpisode(name=name, footage=footage, loss=loss, tracks=own | drives, found=None)
    if len(world.free) > 1 and any(video.covers is None for video in footage.videos):
        raise InputDataError(
            f"{capture.root}: {len(world.free)} free bodies, and videos of episode '{name}' without masks.",
            "video_masks/<camera>/<episode>, or a single free body.",
            "add masks, which are needed to distinguish the bodies.",
        )
    stored = None if slot is None else slot.read(torch.device("cpu"))
    if stored is not None:
        found = stored_track(stored)
    else:
        found = _found_track(world, model, capture, loss, outlines, drives, device, span_s)
        if slot is not None:
            slot.write(track_state(found))
    return VideoEpisode(
        name=name, footage=footage, loss=loss, tracks=_tracks_of(world, footage, found) | drives, found=found
    )


def _found_track(
    world: World,
    model: Model,
    capture: Capture,
    loss: ImageLoss,
    outlines: Mapping[str, Mesh],
    drives: Mapping[str, Track],
    device: torch.device,
    span_s: float,
) -> PoseTrack:
    """Find the poses of an episode in its videos."""
    small = _within_span(load_footage(capture, loss.footage.episode, _coarse_size(loss), device), span_s)
    coarse = image_loss(coarse_model(model), small, world.free, outlines)
    position, quat = kinematic_poses(world, drives, loss.footage.times_s)
    return PoseTracker(coarse, loss, position, quat).run()


def _coarse_size(loss: ImageLoss) -> int:
    """Return the longer side of the images for the pose search [px], larger for small bodies."""
    side = max(max(video.size) for video in loss.footage.videos)
    area = small_silhouette_px(loss)
    if area is None:
        return COARSE_SIZE
    return max(COARSE_SIZE, min(side, math.ceil(side * math.sqrt(COARSE_BODY_PX / area))))


def _tracks_of(world: World, footage: Footage, found: PoseTrack) -> dict[str, Track]:
    """Return the found poses of the free bodies as tracks."""
    return {
        world.bodies[index].name: Track(
            footage.times_s[found.found.numpy()],
            found.position_m[found.found, index].numpy(),
            found.quat_wxyz[found.found, index].numpy(),
        )
        for index in world.free
    }


def commands(world: World, capture: Capture, episode: str, measured: Mapping[str, Track]) -> dict[str, Track]:
    """Return the tracks of the driven bodies, which are their commands.

    Args:
        world: The world.
        capture: The capture.
        episode: Name of the episode.
        measured: Measured tracks of the episode, by body.

    Raises:
        InputDataError: If a driven body has no track.
    """
    drives = {}
    for body in world.bodies:
        if body.motion == "driven":
            if body.name not in measured:
                raise InputDataError(
                    f"{capture.root}: the driven body '{body.name}' has no track in episode '{episode}'; "
                    f"its track is its command.",
                    todo=f"add rows for '{body.name}' to tracks/{episode}.csv.",
                )
            drives[body.name] = measured[body.name]
    return drives


def kinematic_poses(world: World, drives: Mapping[str, Track], times_s: NDArray[np.float64]) -> tuple[Tensor, Tensor]:
    """Return poses in the world frame, from the tracks for driven bodies and the identity for others.

    Args:
        world: The world with nb bodies.
        drives: Commands by body.
        times_s: Times [s], shape (I,).

    Returns:
        Positions [m], shape (I, nb, 3), and orientations `quat_wxyz`, shape (I, nb, 4).
    """
    count, bodies = len(times_s), len(world.bodies)
    position = torch.zeros(count, bodies, 3, dtype=torch.float64)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(count, bodies, 1)
    for index, body in enumerate(world.bodies):
        if body.name in drives:
            motion = Drive.of([drives[body.name]] * count, position).at(torch.as_tensor(times_s))
            position[:, index], quat[:, index] = motion.com, motion.quat_wxyz
    return position, quat


def _within_span(footage: Footage, span_s: float) -> Footage:
    """Return the footage of the first `span_s` seconds, evenly thinned to at most `MAX_INSTANTS`."""
    times = footage.times_s
    keep = np.flatnonzero(times <= times[0] + span_s + 1e-9)
    if len(keep) > MAX_INSTANTS:
        keep = keep[np.linspace(0, len(keep) - 1, MAX_INSTANTS).round().astype(int)]
    return Footage(footage.episode, footage.videos, times[keep], footage.frame_at[:, keep])


def tracks_noise(capture: Capture, episodes: Sequence[VideoEpisode]) -> tuple[float | None, float | None]:
    """Return the noise of the tracks (position [m], rotation [rad]); None for estimation from the tracks.

    For tracks from images it comes from the pixels. Their scatter around smooth motion is no measure, because a video
    of about fifteen frames has an impact in every window.
    """
    found = [episode.found for episode in episodes if episode.found is not None]
    if not found:
        return capture.manifest.measurement.position_std_m, capture.manifest.measurement.rotation_std_rad
    return pose_noise(found)


def track_record(episode: VideoEpisode) -> dict[str, Any]:
    """Return source and quality of the tracks of an episode, for `fit.json`."""
    if episode.found is None:
        return {"source": "measured"}
    found, quality = episode.found, episode.found.quality
    spread = found.variance.mean(-1).sqrt()
    std = spread.median(0)
    overlap = quality.iou[found.found].nanmedian()
    return {
        "source": "images",
        "instants": len(found.found),
        "found": int(found.found.sum()),
        "searches": found.searches,
        "rival_nats": found.rival_nats if math.isfinite(found.rival_nats) else None,
        "mask_iou": None if bool(overlap.isnan()) else float(overlap),
        "color_error": float(quality.error[found.found].median()),
        "color_error_without_body": float(quality.blank[found.found].median()),
        "position_std_m": float(std.values[..., 0].mean()),
        "rotation_std_rad": float(std.values[..., 1].mean()),
        "position_std_m_by_frame": [round(value, 6) for value in spread[..., 0].mean(-1).tolist()],
        "rotation_std_rad_by_frame": [round(value, 5) for value in spread[..., 1].mean(-1).tolist()],
    }


def track_warnings(episodes: Sequence[VideoEpisode]) -> list[str]:
    """Return warnings about the tracks that were found in videos."""
    texts = []
    for episode in episodes:
        if episode.found is None:
            continue
        lost = int((~episode.found.found).sum())
        if lost:
            texts.append(
                f"{episode.name}: the body was not found, or could hardly be placed, in {lost} of "
                f"{len(episode.found.found)} instants; these are left out."
            )
        if episode.found.rival_nats < RIVAL_NATS:
            texts.append(
                f"{episode.name}: another history of poses, from another orientation, explains the frames about as "
                f"well; masks, a second camera or a body with more texture would distinguish them."
            )
        if episode.footage is not None and all(video.covers is None for video in episode.footage.videos):
            texts.append(
                f"{episode.name}: videos without masks; orientations come from colours alone, which changing light on "
                f"a turning body can falsify. Add video_masks/ to be sure."
            )
        if episode.footage is not None and len(episode.footage.videos) == 1:
            texts.append(f"{episode.name}: one camera; depth comes from the body's size alone.")
    return texts
