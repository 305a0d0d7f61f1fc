"""Contact sheets of video frames for a comparison: recorded, and rendered from the prediction of each model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...datasets.capture.capture import Capture
from ..evaluate.evaluation import EpisodeEvaluation
from ..evaluate.frame_strips import strips_of
from ..evaluate.image_errors import VideoErrors
from ..evaluate.prediction import MODEL
from ..rendering.contact_sheets import FrameStrip, Image, jpeg_uri, tiles
from ..runtime.device import resolve_device
from .model_comparison import ComparedModel

MOST_EPISODES = 6
"""Maximum number of episodes with frames."""
MOST_FRAMES = 48
"""Maximum number of frames per video; longer videos are subsampled."""
MOST_BYTES = 5_000_000
"""Maximum size of all sheets together, as text in the page [bytes]."""
COLUMNS = 8
"""Number of tiles in a row of a sheet."""
WIDTH = 240
"""Width of a tile [px]."""
QUALITY = 70
"""JPEG quality of a sheet."""


def footage_of(models: Sequence[ComparedModel], capture: Capture, device: str) -> dict[str, list[dict[str, Any]]]:
    """Return the player's sheets of the filmed episodes, by episode; empty if no episode was filmed.

    Episodes are ordered by the error of the last model, worst first. The first camera of every episode comes before
    the second camera of any, until `MOST_BYTES` is reached.

    Args:
        models: The models; frames are taken where their evaluations have image errors.
        capture: Capture with the videos.
        device: Device to render on.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    used = 0
    for name, camera in _videos_by_interest(models):
        sheets = _sheets(models, capture, str(resolve_device(device)), name, camera)
        size = len(sheets["real"]) + sum(len(uri or "") for uri in sheets["models"])
        if found and used + size > MOST_BYTES:
            break
        used += size
        found.setdefault(name, []).append(sheets)
    return found


def _videos_by_interest(models: Sequence[ComparedModel]) -> list[tuple[str, str]]:
    """Return (episode, camera) of the videos: the first camera of each episode, worst first, then the second ones."""
    filmed = {
        (one.prediction.episode, video.camera): None
        for model in models
        for one in model.evaluation.episodes
        for video in one.videos
    }
    errors = models[-1].errors_m
    names = sorted({name for name, _ in filmed}, key=lambda name: -errors.get(name, 0.0))[:MOST_EPISODES]
    cameras = {name: [camera for episode, camera in filmed if episode == name] for name in names}
    return [
        (name, cameras[name][k])
        for k in range(max(map(len, cameras.values()), default=0))
        for name in names
        if k < len(cameras[name])
    ]


def _sheets(
    models: Sequence[ComparedModel], capture: Capture, device: str, episode: str, camera: str
) -> dict[str, Any]:
    strips = [_strip(model, capture, device, episode, camera) for model in models]
    first = next(strip for strip in strips if strip is not None)
    real, _ = tiles(first, WIDTH, outlined=False)
    return {
        "camera": camera,
        "t": [round(float(t), 4) for t in first.times_s],
        "size": [real.shape[2], real.shape[1]],
        "columns": COLUMNS,
        "real": jpeg_uri(_sheet(real), QUALITY),
        "models": [
            None if strip is None else jpeg_uri(_sheet(tiles(strip, WIDTH, outlined=False)[1]), QUALITY)
            for strip in strips
        ],
    }


def _strip(one: ComparedModel, capture: Capture, device: str, episode: str, camera: str) -> FrameStrip | None:
    """Return the recorded and rendered frames of one episode and camera; None if the model was not rendered there."""
    for evaluated in one.evaluation.episodes:
        prediction = evaluated.prediction
        if prediction.episode != episode or camera not in [video.camera for video in evaluated.videos]:
            continue
        count = next(len(video.time_s) for video in evaluated.videos if video.camera == camera)
        alone = replace(prediction, motions={MODEL: prediction.motions[MODEL]})
        videos = VideoErrors(
            model=one.model, capture=capture, device=device, keep_frames=True, every=-(-count // MOST_FRAMES)
        )
        compared = videos.compare(alone, camera)
        if compared is not None:
            return strips_of([EpisodeEvaluation(alone, (compared,), evaluated.errors)], capture)[0]
    return None


def _sheet(frames: Image) -> Image:
    """Arrange tiles (F, H, W, 3) in rows of `COLUMNS`; the last row is padded with black."""
    count, height, width = frames.shape[:3]
    rows = -(-count // COLUMNS)
    sheet = np.zeros((rows * COLUMNS, height, width, 3), np.uint8)
    sheet[:count] = frames
    return np.ascontiguousarray(
        sheet.reshape(rows, COLUMNS, height, width, 3).swapaxes(1, 2).reshape(rows * height, COLUMNS * width, 3)
    )
