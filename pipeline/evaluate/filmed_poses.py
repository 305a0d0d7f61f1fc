"""Poses of held-out episodes that were filmed but not tracked: found in their videos, as a fit to videos finds them.

They serve as the measurement with which predictions begin and are compared. The physics of the model has no part in
them, but its shape, its colours and the cameras have: an error of these is in the prediction and in the reference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.cameras import require_metric
from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Episode
from ...datasets.models.joints import refuse_joints
from ...datasets.models.model import Model
from ...schemas import InputDataError, NotConvergedError, PhysConfig
from ..geometry.rotation import geodesic_angle
from ..optimization.uncertainty import size_interval
from ..phys_geo.images.pose_tracking import pose_noise
from ..phys_geo.images.silhouettes import body_outlines
from ..phys_geo.images.video_episodes import VideoEpisode, load_video_episode, track_warnings
from ..phys_geo.images.video_frames import Footage
from ..physics.world import World
from ..runtime.device import resolve_device
from ..trajectories.track_noise import Noise
from .prediction import EpisodePrediction

Array = NDArray[np.float64]

IMAGE_SIZE = PhysConfig().image_size
"""Longer side to which frames are reduced [px], as for a fit to videos."""
DOUBTFUL_TURN_DEG = 90.0
"""Turn between two frames above which the poses are doubted: the largest true one in 15 episodes is 38 deg, and the one
wrong turn 140 deg."""
SHARED_PX = 0.25
"""Standard deviation of the place of an edge in the compared images by errors of shape, colour and camera [px], which
last as long as an episode and do not show in the scatter of the pixels. Chosen on 15 filmed episodes of five benchmark
captures with true cameras, where 0.1 is enough for mean errors of position and 0.25 for those of rotation, and one film
of the scene `fall` with calibrated cameras, where poses are off by 1.2 mm or 0.4 px."""


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """Uncertainty of the poses of one episode, from the scatter of the pixels and from errors that all frames share."""

    times_s: Array
    """Times of the poses [s], shape (F,)."""
    covariance: Array
    """Covariances of shift [m2] and rotation [rad2] of the nf free bodies, shape (F, 6 nf, 6 nf)."""

    def intervals(self, prediction: EpisodePrediction, moved: float, turned: float) -> tuple[Interval, Interval]:
        """Return 95 % intervals of the mean errors after the warm-up, [m] and [deg].

        Errors that all frames share are not lowered by averaging: the half width is that of one frame, along the error.

        Args:
            prediction: The prediction.
            moved: Its mean error of translation [m].
            turned: Its mean error of rotation [deg].
        """
        after = np.flatnonzero(prediction.seen.any(1) & ~prediction.warmup)
        rows = np.abs(self.times_s[:, None] - prediction.time_s[after]).argmin(0)
        shift = (prediction.predicted()[0] - prediction.position_m)[after]
        length = np.linalg.norm(shift, axis=-1, keepdims=True)
        along = np.where(length > 0, shift / np.where(length > 0, length, 1.0), 3**-0.5)
        spread = []
        for body in range(shift.shape[1]):
            block = self.covariance[rows][:, 6 * body : 6 * body + 6, 6 * body : 6 * body + 6]
            place = np.einsum("fi,fij,fj->f", along[:, body], block[:, :3, :3], along[:, body])
            turn = np.trace(block[:, 3:, 3:], axis1=1, axis2=2) / 3
            spread.append(np.sqrt(np.maximum([place, turn], 0.0)).mean(1))
        place_std, turn_std = np.mean(spread, axis=0)
        return size_interval(moved, float(place_std)), size_interval(turned, float(np.degrees(turn_std)))


Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class FilmedPoses:
    """Poses found in the videos of some episodes."""

    episodes: list[Episode]
    """Tracks of the episodes in whose videos the bodies were found."""
    noise: Noise
    """Standard deviations of a pose by axis (position [m], rotation [rad])."""
    uncertainty: dict[str, PoseUncertainty]
    """By episode."""
    warnings: list[str]
    """Which episodes are left out, and what is doubtful."""


def filmed_poses(world: World, model: Model, capture: Capture, split: str, device: str) -> FilmedPoses:
    """Find the poses of the free bodies in the videos of a split.

    Args:
        world: The model's world.
        model: A model whose bodies can be drawn: with visual spheres and a scene, or with shapes, and masks.
        capture: The capture with calibrated, metric cameras.
        split: The episodes.
        device: Device of the renderer: auto, cpu or cuda.

    Raises:
        InputDataError: If the videos cannot be used, or the bodies are found in none of them.
    """
    refuse_joints(model.file.articulations, str(capture.root), "an evaluation by images")
    if capture.cameras is not None:
        require_metric(capture.cameras)
    names = [name for name in capture.episodes(split) if capture.videos(name)]
    if not names:
        raise InputDataError(
            f"{capture.root}: no episode of split '{split}' has a video.",
            "videos/<camera>/<episode>.mp4, or a directory of frames.",
            "add videos, or name another split with --split.",
        )
    outlines, notes = body_outlines(model, capture, names)
    found: list[VideoEpisode] = []
    for name in names:
        try:
            found.append(
                load_video_episode(
                    world, model, capture, name, outlines, None, tracks_too=False, image_size=IMAGE_SIZE,
                    device=resolve_device(device), span_s=np.inf,
                )
            )  # fmt: skip
        except NotConvergedError as error:
            notes.append(f"episode '{name}' is left out: {error.found.removeprefix(f'{name}: ')}")
    if not found:
        raise InputDataError(
            f"{capture.root}: the free bodies are found in no video of split '{split}'. {' '.join(notes)}",
            "videos that show the bodies of the model, from cameras that are calibrated in the capture's frame.",
            "add video_masks/ (cgwm mask --empty), or check that the cameras did not move since they were calibrated.",
        )
    tracks = [episode.found for episode in found if episode.found is not None]
    uncertainty = {episode.name: _uncertainty(episode, world.free) for episode in found}
    episodes = [Episode(episode.name, episode.tracks) for episode in found]
    return FilmedPoses(episodes, pose_noise(tracks), uncertainty, [*notes, *_doubts(found, world.free)])


def _uncertainty(episode: VideoEpisode, free: Sequence[int]) -> PoseUncertainty:
    """Return the uncertainty of the poses that were found, of the free bodies of a model."""
    found, footage, loss = episode.found, episode.footage, episode.loss
    assert found is not None and footage is not None and loss is not None  # as no measured track was taken
    instants = np.flatnonzero(found.found.numpy())
    covariance = found.covariance[found.found].numpy().copy()
    for row, instant in enumerate(instants):
        for k, body in enumerate(free):
            block = slice(6 * k, 6 * k + 6)
            position = found.position_m[instant, body].numpy()
            covariance[row, block, block] += shared_covariance(footage, int(instant), position, loss.radii[body])
    return PoseUncertainty(footage.times_s[instants], covariance)


def shared_covariance(footage: Footage, instant: int, position_m: Array, radius_m: float) -> Array:
    """Return the covariance of a pose by errors of `SHARED_PX` in the place of the body's edges.

    A camera sees the shift of the edges by a motion across its view, by the size of the body along it, and by a turn at
    the distance of the radius.

    Args:
        footage: The videos at the size that is compared.
        instant: Index of the instant.
        position_m: Body frame origin [m], world, shape (3,).
        radius_m: Radius of the body [m].

    Returns:
        Covariance of shift [m2] and rotation [rad2], shape (6, 6).
    """
    information, radii_px = np.zeros((3, 3)), []
    for video, frame in zip(footage.videos, footage.frame_at[:, instant], strict=True):
        if frame < 0:
            continue
        T_cam_world, focal = video.viewmats[frame].cpu().numpy().astype(np.float64), float(video.K[0, 0])
        rotation = T_cam_world[:3, :3]
        x, y, z = rotation @ position_m + T_cam_world[:3, 3]
        across = np.array([[1, 0, -x / z], [0, 1, -y / z], [0, 0, -radius_m / z]]) * (focal / z) @ rotation
        information += across.T @ across
        radii_px.append(focal * radius_m / z)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = SHARED_PX**2 * np.linalg.inv(information)
    covariance[3:, 3:] = np.eye(3) * SHARED_PX**2 / np.square(radii_px).sum()
    return covariance


def _doubts(episodes: Sequence[VideoEpisode], free: Sequence[int]) -> list[str]:
    """Return warnings about the poses, and about turns that are too large to be true."""
    doubts = [f"poses of {text}" for text in track_warnings(episodes)]
    for episode in episodes:
        assert episode.found is not None  # as no measured track was taken
        quat = episode.found.quat_wxyz[episode.found.found][:, list(free)]
        turn = math.degrees(float(geodesic_angle(quat[:-1], quat[1:]).max()))
        if turn > DOUBTFUL_TURN_DEG:
            doubts.append(
                f"poses of {episode.name}: the body turns by {turn:.0f} deg from one frame to the next, so one "
                "orientation was probably taken for another that looks alike: do not trust the errors of rotation; "
                "those of position hardly depend on it."
            )
    return doubts
