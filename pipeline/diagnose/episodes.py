"""Episodes of a diagnosis: with measured tracks, or with the pose tracks that the model's fit estimated from videos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Episode
from ...datasets.models.model import POSE_TRACKS, Model
from ...schemas import InputDataError
from ...schemas.printable import typed_path
from ..trajectories.frame_times import with_regular_times
from ..trajectories.observations import track_episodes
from .thresholds import THRESHOLDS

MAX_EPISODES = 40
"""Maximum number of episodes; of more, an evenly spread subset is used, which suffices to show a missing effect."""


@dataclass(frozen=True)
class DiagnosedEpisodes:
    """Episodes with their noise."""

    episodes: tuple[Episode, ...]
    """Name and tracks by body of each episode."""
    noise: tuple[float | None, float | None]
    """Standard deviation of position [m] and rotation [rad]; None where it is unknown."""
    warnings: tuple[str, ...]
    """Warnings for the report."""
    filmed: bool = False
    """Whether the tracks are those that the model's fit found in videos."""


def diagnosed_episodes(model: Model, capture: Capture, split: str) -> DiagnosedEpisodes:
    """Return the episodes of a split that have tracks of all moving bodies.

    Measured tracks are used if any episode of the split has them, otherwise the tracks that the model's fit estimated
    from the videos.

    Raises:
        InputDataError: If these are too few.
        UsageError: If the split does not exist.
    """
    free = {body.name for body in model.file.bodies if body.motion == "free"}
    known = (capture.manifest.measurement.position_std_m, capture.manifest.measurement.rotation_std_rad)
    warnings: tuple[str, ...] = ()
    filmed, names = False, capture.episodes(split)
    if any(free & set(capture.tracks(name)) for name in names) or not any(capture.videos(name) for name in names):
        found, warnings = with_regular_times(track_episodes(capture, split), free)
    else:
        filmed, found, known = True, _filmed(model, capture, split), _filmed_noise(model, names)
        warnings = (
            f"the tracks are those that the fit found in the videos ({POSE_TRACKS}/ of the model): errors of "
            "neighbouring frames are correlated, and a systematic error, as of a wrong shape, can look like physics.",
        )
    moving = {body.name for body in model.file.bodies if body.motion != "fixed"}
    episodes = [episode for episode in found if moving <= set(episode.tracks)]
    if len(episodes) < THRESHOLDS.verdict.min_episodes:
        raise InputDataError(
            f"{capture.root}: split '{split}' has {len(episodes)} episodes with tracks of all moving bodies.",
            f"at least {THRESHOLDS.verdict.min_episodes}: an effect found in one has to be confirmed in others.",
            _more_episodes(capture, split),
        )
    chosen = np.linspace(0, len(episodes) - 1, min(len(episodes), MAX_EPISODES)).round().astype(int)
    return DiagnosedEpisodes(tuple(episodes[k] for k in chosen), known, warnings, filmed)


def _more_episodes(capture: Capture, split: str) -> str:
    """Return what to do where a split has too few episodes: others of the capture may go into it."""
    splits = capture.manifest.splits
    others = [name for one, names in splits.items() if one != split for name in names if name not in splits[split]]
    moved = f"move some of {', '.join(others[:3])} into '{split}' of [splits] in capture.toml, " if others else ""
    return f"{moved}{'or ' if others else ''}record more, or name another split with --split."


def _filmed(model: Model, capture: Capture, split: str) -> list[Episode]:
    """Return the episodes with the poses that the model's fit estimated, and the tracks of the kinematic bodies."""
    names = [name for name in capture.episodes(split) if name in model.tracks]
    if not names:
        raise InputDataError(
            f"{capture.root}: split '{split}' has videos and no track of a free body, and {model.root} holds no poses "
            "found in these videos.",
            f"tracks/<episode>.csv in the capture, or {POSE_TRACKS}/<episode>.csv in the model.",
            f"run 'cgwm fit {typed_path(capture.root)} --supervise images --out MODEL', which looks for the poses.",
        )
    return [Episode(name, model.tracks[name] | capture.tracks(name)) for name in names]


def _filmed_noise(model: Model, names: list[str]) -> tuple[float | None, float | None]:
    """Return the noise of the estimated poses, the median over the episodes; None if `fit.json` does not contain it."""
    stage = model.fit.stages.get("phys-geo", {}).get("pose_tracks", {})
    records = [stage[name] for name in names if "position_std_m" in stage.get(name, {})]
    if not records:
        return None, None
    return (
        float(np.median([record["position_std_m"] for record in records])),
        float(np.median([record["rotation_std_rad"] for record in records])),
    )
