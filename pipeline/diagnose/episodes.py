"""The episodes that a diagnosis looks at: with measured tracks, or with those that the model's fit found in videos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...datasets.capture import Capture
from ...datasets.models import POSE_TRACKS, Model
from ...datasets.tracks import Track
from ...schemas import InputDataError
from ..phys_geo import track_episodes

MIN_EPISODES = 3
"""Fewer leave nothing to hold out: what helps one episode would be proved by that episode."""
MAX_EPISODES = 40
"""Of more episodes so many, evenly spread, are looked at: everything missing shows in them."""


@dataclass(frozen=True)
class DiagnosedEpisodes:
    """Name and tracks by body of each episode; noise (position [m], rotation [rad]) where it is known; warnings."""

    episodes: tuple[tuple[str, dict[str, Track]], ...]
    noise: tuple[float | None, float | None]
    warnings: tuple[str, ...]


def diagnosed_episodes(model: Model, capture: Capture, split: str) -> DiagnosedEpisodes:
    """Return the episodes of a split with tracks of all that moves.

    Measured tracks are taken where any episode of the split has them; otherwise those that the fit of the model found
    in the videos.

    Raises:
        InputDataError: If there are too few.
        UsageError: If there is no such split.
    """
    free = {body.name for body in model.file.bodies if body.motion == "free"}
    known = (capture.manifest.measurement.position_std_m, capture.manifest.measurement.rotation_std_rad)
    warnings: tuple[str, ...] = ()
    names = capture.episodes(split)
    if any(free & set(capture.tracks(name)) for name in names) or not any(capture.videos(name) for name in names):
        found = track_episodes(capture, split)
    else:
        found, known = _filmed(model, capture, split), _filmed_noise(model, names)
        warnings = (
            f"the tracks are those that the fit found in the videos ({POSE_TRACKS}/ of the model): poses of "
            "neighbouring frames err alike, and what bends them all, as a wrong shape does, can pass for physics.",
        )
    moving = {body.name for body in model.file.bodies if body.motion != "fixed"}
    episodes = [(name, tracks) for name, tracks in found if moving <= set(tracks)]
    if len(episodes) < MIN_EPISODES:
        raise InputDataError(
            f"{capture.root}: split '{split}' has {len(episodes)} episodes with tracks of all that moves.",
            f"at least {MIN_EPISODES}: what helps one has to be proved on others.",
            "record more, or name another split with --split.",
        )
    chosen = np.linspace(0, len(episodes) - 1, min(len(episodes), MAX_EPISODES)).round().astype(int)
    return DiagnosedEpisodes(tuple(episodes[k] for k in chosen), known, warnings)


def _filmed(model: Model, capture: Capture, split: str) -> list[tuple[str, dict[str, Track]]]:
    """Return the episodes with the poses that the model's fit found, and the commands of the driven bodies."""
    names = [name for name in capture.episodes(split) if name in model.tracks]
    if not names:
        raise InputDataError(
            f"{capture.root}: split '{split}' has videos and no track of a free body, and {model.root} holds no poses "
            "found in these videos.",
            f"tracks/<episode>.csv in the capture, or {POSE_TRACKS}/<episode>.csv in the model.",
            f"run 'cgwm fit {capture.root} --supervise images --out MODEL', which looks for the poses.",
        )
    return [(name, model.tracks[name] | capture.tracks(name)) for name in names]


def _filmed_noise(model: Model, names: list[str]) -> tuple[float | None, float | None]:
    """Return the noise of the found poses, the median over the episodes; None where `fit.json` does not say it."""
    stage = model.fit.stages.get("phys-geo", {}).get("pose_tracks", {})
    records = [stage[name] for name in names if "position_std_m" in stage.get(name, {})]
    if not records:
        return None, None
    return (
        float(np.median([record["position_std_m"] for record in records])),
        float(np.median([record["rotation_std_rad"] for record in records])),
    )
