"""The first step of phys-geo from videos: the episodes with their image losses, and the tracks found in them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datasets.capture import Capture
from ..datasets.models import Model
from ..datasets.tracks import Track
from ..schemas import InputDataError
from .checkpoint import Slot
from .imaging.coarse import coarse_model
from .imaging.footage import Footage, load_footage
from .imaging.image_loss import ImageLoss
from .imaging.pose_search import small_silhouette_px
from .imaging.pose_tracks import PoseTrack, PoseTracker, pose_noise, stored_track, track_state
from .imaging.silhouette_loss import image_loss
from .phys_geo import MAX_SPAN_S
from .physics.driven import Drive
from .physics.world import World
from .splats.mesh import Mesh

COARSE_SIZE, COARSE_BODY_PX = 80, 20.0
"""Longer side [px] of the pictures for searching poses, more where a body would cover less than so many pixels."""
MAX_INSTANTS = 90
"""More instants of an episode are thinned evenly: the image loss of each costs a render a camera."""
RIVAL_NATS = 10.0
"""A history of poses that is less likely by less than this is said to be possible too."""


@dataclass(frozen=True)
class Episode:
    """An episode with its losses, and its track: from the images, or measured.

    tracks: by body, of the free bodies as far as found and of the driven ones; found: from images, or None.
    """

    name: str
    footage: Footage | None
    loss: ImageLoss | None
    tracks: dict[str, Track]
    found: PoseTrack | None


def filmed_episode(
    world: World,
    model: Model,
    capture: Capture,
    name: str,
    outlines: Mapping[str, Mesh],
    slot: Slot,
    *,
    tracks_too: bool,
    image_size: int,
    device: torch.device,
) -> Episode:
    """Read an episode and find its tracks.

    Args:
        world: The world.
        model: The model whose renders are compared with the frames.
        capture: The capture.
        name: Name of the episode.
        outlines: Surfaces of the bodies, where only masks can be compared.
        slot: Where found poses are kept, so that an interrupted fit does not look for them again.
        tracks_too: Use measured tracks where there are any, instead of looking for them.
        image_size: Longer side [px] of the pictures to be compared.
        device: Where pictures are rendered.

    Raises:
        InputDataError: If the episode lacks what is needed.
        NotConvergedError: If the body is not found.
    """
    measured = capture.tracks(name)
    drives = commands(world, capture, name, measured)
    own = {body.name: measured[body.name] for body in world.bodies if body.free and body.name in measured}
    if tracks_too and own and not capture.videos(name):
        return Episode(name, None, None, own | drives, None)
    footage = _within_span(load_footage(capture, name, image_size, device))
    loss = image_loss(model, footage, world.free, outlines)
    if tracks_too and own:
        return Episode(name, footage, loss, own | drives, None)
    if len(world.free) > 1 and any(video.covers is None for video in footage.videos):
        raise InputDataError(
            f"{capture.root}: {len(world.free)} free bodies, and videos of episode '{name}' without masks.",
            "video_masks/<camera>/<episode>, or a single free body.",
            "add masks, so that the bodies can be told apart.",
        )
    state = slot.read(torch.device("cpu"))
    if state is not None:
        return Episode(
            name, footage, loss, _tracks_of(world, footage, stored_track(state)) | drives, stored_track(state)
        )
    small = _within_span(load_footage(capture, name, _coarse_size(loss), device))
    coarse = image_loss(coarse_model(model), small, world.free, outlines)
    position, quat = driven_poses(world, drives, footage.times_s)
    found = PoseTracker(coarse, loss, position, quat).run()
    slot.write(track_state(found))
    return Episode(name, footage, loss, _tracks_of(world, footage, found) | drives, found)


def _coarse_size(loss: ImageLoss) -> int:
    """Return the longer side [px] of the pictures for searching: large enough for bodies that are small in them."""
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
    """Return the tracks of the driven bodies, which are their commands, with images as well.

    Args:
        world: The world.
        capture: The capture.
        episode: Name of the episode.
        measured: All its measured tracks, by body.

    Raises:
        InputDataError: If a driven body has none.
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


def driven_poses(world: World, drives: Mapping[str, Track], times_s: NDArray[np.float64]) -> tuple[Tensor, Tensor]:
    """Return poses in the world frame with those of driven bodies; the others lie unturned at the origin.

    Args:
        world: The world, of nb bodies.
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


def _within_span(footage: Footage) -> Footage:
    """Return the footage up to the span of the fit, thinned evenly to the most instants."""
    times = footage.times_s
    keep = np.flatnonzero(times <= times[0] + MAX_SPAN_S + 1e-9)
    if len(keep) > MAX_INSTANTS:
        keep = keep[np.linspace(0, len(keep) - 1, MAX_INSTANTS).round().astype(int)]
    return Footage(footage.episode, footage.videos, times[keep], footage.frame_at[:, keep])


def tracks_noise(capture: Capture, episodes: Sequence[Episode]) -> tuple[float | None, float | None]:
    """Return the noise of the tracks (position [m], rotation [rad]); None where it is to be estimated from them.

    For tracks from images it comes from the pixels: their scatter about smooth motion is no measure, because a video
    of some fifteen frames has an impact in every window.
    """
    found = [episode.found for episode in episodes if episode.found is not None]
    if not found:
        return capture.manifest.measurement.position_std_m, capture.manifest.measurement.rotation_std_rad
    return pose_noise(found)


def track_record(episode: Episode) -> dict[str, Any]:
    """Return how the tracks of an episode were found, for `fit.json`."""
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


def track_warnings(episodes: Sequence[Episode]) -> list[str]:
    """Return what a user should know about the tracks that were found."""
    texts = []
    for episode in episodes:
        if episode.found is None:
            continue
        lost = int((~episode.found.found).sum())
        if lost:
            texts.append(f"{episode.name}: the body was not found in {lost} of {len(episode.found.found)} instants.")
        if episode.found.rival_nats < RIVAL_NATS:
            texts.append(
                f"{episode.name}: another history of poses, from another orientation, explains the frames about as "
                f"well; masks, a second camera or a body with more pattern would tell them apart."
            )
        if episode.footage is not None and all(video.covers is None for video in episode.footage.videos):
            texts.append(
                f"{episode.name}: videos without masks; orientations rest on colours alone, which changing light on a "
                f"turning body can mislead. Add video_masks/ to be sure."
            )
        if episode.footage is not None and len(episode.footage.videos) == 1:
            texts.append(f"{episode.name}: one camera; depth comes from the body's size alone.")
    return texts
