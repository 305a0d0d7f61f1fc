"""Frames of videos for a comparison: recorded, and as each model renders its prediction; as sheets of small tiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...datasets.capture import Capture
from ..compared import ComparedModel
from ..eval import EpisodeEvaluation
from ..image_errors import VideoErrors
from ..prediction import MODEL
from ..sg_gs import resolve_device
from .episodes import strips_of
from .pictures import FrameStrip, Image, jpeg_uri, tiles

MOST_EPISODES = 6
MOST_FRAMES = 48
"""Of a video; of a longer one every so manyth."""
MOST_BYTES = 5_000_000
"""Of all sheets together, as text in the page."""
COLUMNS = 8
WIDTH = 240
"""Of a tile [px]."""
QUALITY = 70


def footage_of(models: Sequence[ComparedModel], capture: Capture, device: str) -> dict[str, list[dict[str, Any]]]:
    """Return the sheets of the filmed episodes, by episode, for the player; empty where nothing is filmed.

    The episodes that the last model predicts worst come first, one camera of each before the second of any, as long
    as there is room.

    Args:
        models: The models; frames are those whose errors their evaluations have.
        capture: With the videos.
        device: Where to render.
    """
    filmed = {
        (one.prediction.episode, video.camera): None
        for model in models
        for one in model.evaluation.episodes
        for video in one.videos
    }
    errors = models[-1].errors_m
    names = sorted({name for name, _ in filmed}, key=lambda name: -errors.get(name, 0.0))[:MOST_EPISODES]
    cameras = {name: [camera for episode, camera in filmed if episode == name] for name in names}
    order = [
        (name, cameras[name][k])
        for k in range(max(map(len, cameras.values()), default=0))
        for name in names
        if k < len(cameras[name])
    ]
    found: dict[str, list[dict[str, Any]]] = {}
    used = 0
    for name, camera in order:
        sheets = _sheets(models, capture, str(resolve_device(device)), name, camera)
        size = len(sheets["real"]) + sum(len(uri or "") for uri in sheets["models"])
        if found and used + size > MOST_BYTES:
            break
        used += size
        found.setdefault(name, []).append(sheets)
    return found


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
    """Return the frames of one episode and camera beside the model's; None where the model has no picture of them."""
    for evaluated in one.evaluation.episodes:
        prediction = evaluated.prediction
        if prediction.episode != episode or camera not in [video.camera for video in evaluated.videos]:
            continue
        count = next(len(video.time_s) for video in evaluated.videos if video.camera == camera)
        alone = replace(prediction, motions={MODEL: prediction.motions[MODEL]})
        videos = VideoErrors(one.model, capture, device, keep_frames=True, every=-(-count // MOST_FRAMES))
        compared = videos.compare(alone, camera)
        if compared is not None:
            return strips_of([EpisodeEvaluation(alone, (compared,), evaluated.errors)], capture)[0]
    return None


def _sheet(frames: Image) -> Image:
    """Return tiles (F, H, W, 3) in rows of `COLUMNS`, the last row filled up with black."""
    count, height, width = frames.shape[:3]
    rows = -(-count // COLUMNS)
    sheet = np.zeros((rows * COLUMNS, height, width, 3), np.uint8)
    sheet[:count] = frames
    return np.ascontiguousarray(
        sheet.reshape(rows, COLUMNS, height, width, 3).swapaxes(1, 2).reshape(rows * height, COLUMNS * width, 3)
    )
