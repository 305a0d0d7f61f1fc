"""`cgwm eval`: open-loop predictions of a model against measurements.

The initial state of an episode is estimated by the model from its warm-up; from there nothing of the episode is
shown to the model. Errors are averaged within an episode first, then over episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets.cameras import require_metric
from ..datasets.capture import Capture
from ..datasets.kinds import kind_of
from ..datasets.loader import RolloutReader
from ..datasets.models import Model, read_model
from ..datasets.progress import progress
from ..datasets.tracks import Track
from ..schemas import EpisodeErrors, ErrorSummary, EvalResult, InputDataError
from .estimation.noise import estimate_noise
from .image_errors import VideoComparison, VideoErrors, renderable, usable_cameras
from .memory import enough_memory
from .own_worlds import own_parameters, with_fitted_numbers, with_known_numbers
from .physics.world import World
from .prediction import BASELINES, MODEL, STATE_FIT_EPISODES, Episode, EpisodePrediction, predict
from .threads import one_torch_thread

Array = NDArray[np.float64]

DATASET_NOISE = (1e-4, 1e-3)
"""Noise assumed for the poses of a dataset, which are exact (position [m], rotation [rad])."""


@dataclass(frozen=True, eq=False)
class EpisodeEvaluation:
    """One episode: its predictions, its videos beside them where there are any, and its errors."""

    prediction: EpisodePrediction
    videos: tuple[VideoComparison, ...]
    errors: EpisodeErrors


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What `cgwm eval` prints, and the motions and frames behind it."""

    result: EvalResult
    episodes: tuple[EpisodeEvaluation, ...]


def evaluate(model: Path, target: Path, split: str = "test", warmup_s: float = 0.1, device: str = "auto") -> EvalResult:
    """Evaluate a model on disk against a capture's tracks and frames, or against the states of a dataset.

    Args:
        model: MODEL, with fitted physics.
        target: A capture, or a dataset.
        split: The episodes to predict. A dataset has `train` and `valid` for those who learn from it; `test` takes
            all its rollouts.
        warmup_s: Length of the start of an episode that the model may see [s].
        device: Where images are rendered: auto, cpu or cuda. Rollouts of few bodies are fastest on the CPU.

    Raises:
        InputDataError: If the target has nothing to compare with, or other bodies than the model.
        UsageError: If there is no such split.
        NotConvergedError: If a rollout of the model diverges.
        NotEnoughMemoryError: If the frames cannot be rendered in the memory that there is.
    """
    loaded = read_model(model)
    if kind_of(target) == "dataset":
        return evaluate_dataset(loaded, target, split, warmup_s).result
    capture = Capture.open(target, splits=(split,))
    tried = f"{loaded.visual_count} spheres, frames of the videos at their own size"
    with enough_memory(tried, _device(device), "a model of fewer spheres (cgwm fit --spheres), smaller videos"):
        return evaluate_model(loaded, capture, split, warmup_s, device).result


def evaluate_model(
    model: Model,
    capture: Capture,
    split: str = "test",
    warmup_s: float = 0.1,
    device: str = "auto",
    keep_frames: bool = False,
    brief: bool = False,
) -> Evaluation:
    """Evaluate a model against the tracks of a capture, and its frames where model and cameras allow it.

    Args:
        model: With fitted physics.
        capture: The measurements.
        split: The episodes to predict.
        warmup_s: Length of the start of an episode that the model may see [s].
        device: Where images are rendered: auto, cpu or cuda.
        keep_frames: Keep the predicted frames beside the real ones (tens of megabytes an episode).
        brief: The errors of the poses and of the baselines alone: no frames, no fitted states.

    Raises:
        See :func:`evaluate`.
    """
    check_bodies(model, capture.body_names, str(capture.root))
    world = World.from_model(model)
    episodes, warnings = _usable(model, [(name, capture.tracks(name)) for name in capture.episodes(split)])
    if not episodes:
        raise InputDataError(
            f"{capture.root}: no episode of split '{split}' can be evaluated. {' '.join(warnings)}".rstrip(),
            "tracks/<episode>.csv with rows for every free and driven body.",
            "add tracks, or name another split with --split.",
        )
    cameras = {} if brief else _cameras(model, capture, [name for name, _ in episodes], warnings)
    videos = VideoErrors(model, capture, _device(device), keep_frames) if cameras else None
    video_times = [_video_times(capture, name, cameras.get(name, [])) for name, _ in episodes]
    noise = _noise(model, capture, episodes)
    fits = 0 if brief else STATE_FIT_EPISODES
    world, fitted = _own_worlds(world, model, capture, episodes, noise, warnings, brief)
    predictions = _predict(model, world, episodes, noise, warmup_s, video_times, fits, fitted)

    def compare(prediction: EpisodePrediction) -> tuple[VideoComparison, ...]:
        names = cameras.get(prediction.episode, [])
        found = [videos.compare(prediction, name) for name in names] if videos else []
        return tuple(comparison for comparison in found if comparison is not None)

    return _evaluation(predictions, compare, warnings)


@one_torch_thread()
def _own_worlds(
    world: World,
    model: Model,
    capture: Capture,
    episodes: Sequence[Episode],
    noise: tuple[float, float],
    warnings: list[str],
    brief: bool,
) -> tuple[World, World]:
    """Return the world with the own numbers that the fit knows, and with those of all episodes, fitted to them."""
    names = [name for name, _ in episodes]
    known = with_known_numbers(world, model.file, names, capture.groups)
    unknown = [name for name in names if len(known.own.get(name, {})) < len(own_parameters(world))]
    if brief or not unknown:
        return known, known
    warnings.append(
        f"{len(unknown)} of the {len(names)} episodes should have numbers of their own, and the fit has not seen them: "
        "open loop they have the mean; in the state-fitted residual they are fitted, as the state is."
    )
    return known, with_fitted_numbers(world, episodes, model.file, capture.groups, noise)


def evaluate_dataset(model: Model, dataset: Path, split: str = "test", warmup_s: float = 0.1) -> Evaluation:
    """Evaluate a model against the stored states of a dataset's rollouts; see :func:`evaluate`."""
    reader = RolloutReader(dataset, None if split == "test" else split)
    try:
        if len(reader) == 0:
            raise InputDataError(f"{dataset}: split '{split}' has no rollout.", todo="name another with --split.")
        names = [name.decode() for name in reader.group(0)["bodies/names"][()]]
        check_bodies(model, names, str(dataset))
        world = World.from_model(model)
        # what a dataset stores are true states, not measured ones
        world = replace(world, effects=tuple(a for a in world.effects if a.effect.phase != "measurement"))
        found = [(info.demo, _stored_tracks(reader, number)) for number, info in enumerate(reader.rollouts)]
    finally:
        reader.close()
    episodes, warnings = _usable(model, found)
    if not episodes:
        raise InputDataError(f"{dataset}: its rollouts have no free body with two frames or more.")
    none = [np.zeros(0)] * len(episodes)
    predictions = _predict(model, world, episodes, DATASET_NOISE, warmup_s, none)
    return _evaluation(predictions, lambda _: (), warnings)


def _stored_tracks(reader: RolloutReader, number: int) -> dict[str, Track]:
    """Return the states of a rollout as tracks of what moves."""
    group = reader.group(number)
    time, position, quat = (group[key][()] for key in ("time", "bodies/pos", "bodies/quat_wxyz"))
    names, motions = (group[f"bodies/{key}"][()] for key in ("names", "motions"))
    return {
        name.decode(): Track(time, position[:, k], quat[:, k]) for k, name in enumerate(names) if motions[k] != b"fixed"
    }


def check_bodies(model: Model, names: Sequence[str], target: str) -> None:
    """Refuse a model whose bodies do not have the names of a target's.

    Raises:
        InputDataError: With both lists.
    """
    own = [body.name for body in model.file.bodies]
    if set(own) != set(names):
        raise InputDataError(
            f"the model's bodies are {_listed(own)}; those of {target} are {_listed(names)}.",
            "a model of the target's bodies, by name.",
            "pass a model that was fitted to this capture, or give the bodies the same names.",
        )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names) or "none"


def _usable(model: Model, episodes: Sequence[Episode]) -> tuple[list[Episode], list[str]]:
    """Return the episodes in which everything that moves has a track, and a message on the others."""
    moving = [body.name for body in model.file.bodies if body.motion != "fixed"]
    if not any(body.motion == "free" for body in model.file.bodies):
        raise InputDataError("none of the model's bodies is free, so there is no motion to predict.")
    usable, warnings = [], []
    for name, tracks in episodes:
        lacking = [body for body in moving if body not in tracks]
        if lacking:
            warnings.append(f"episode '{name}' is left out: no track of {_listed(lacking)}.")
        else:
            usable.append((name, tracks))
    return usable, warnings


def _noise(model: Model, capture: Capture, episodes: Sequence[Episode]) -> tuple[float, float]:
    """Return the measurement noise (position [m], rotation [rad]): the model's, the manifest's, or an estimate."""
    known, given = model.file.measurement_std, capture.manifest.measurement
    position = known.get("position_m") or given.position_std_m
    rotation = known.get("rotation_rad") or given.rotation_std_rad
    if position and rotation:
        return position, rotation
    free = [body.name for body in model.file.bodies if body.motion == "free"]
    estimated = estimate_noise([tracks[name] for _, tracks in episodes for name in free])
    return position or estimated[0], rotation or estimated[1]


@one_torch_thread()
def _predict(
    model: Model,
    world: World,
    episodes: Sequence[Episode],
    noise: tuple[float, float],
    warmup_s: float,
    video_times: Sequence[Array],
    state_fits: int = STATE_FIT_EPISODES,
    fitted: World | None = None,
) -> list[EpisodePrediction]:
    with progress(desc="eval: rollouts", total=len(episodes), unit="episode") as bar:
        return predict(world, episodes, noise, warmup_s, video_times, bar.update, state_fits, fitted)


def _cameras(model: Model, capture: Capture, episodes: Sequence[str], warnings: list[str]) -> dict[str, list[str]]:
    """Return the cameras by episode whose frames can be compared; say in `warnings` why others cannot."""
    filmed = [name for name in episodes if capture.videos(name)]
    if not filmed:
        return {}
    if not renderable(model):
        warnings.append("no PSNR: the model has no scene, or a free body of it no visual spheres.")
        return {}
    if capture.cameras is None:
        warnings.append(f"no PSNR: the cameras are not calibrated; run 'cgwm calibrate {capture.root}'.")
        return {}
    require_metric(capture.cameras)
    found = {name: usable_cameras(capture, name) for name in filmed}
    unknown = sorted({camera for _, lacking in found.values() for camera in lacking})
    if unknown:
        warnings.append(f"no PSNR from {_listed(unknown)}: no pose in the capture's cameras.")
    known = sorted({camera for cameras, _ in found.values() for camera in cameras})
    unexposed = [camera for camera in known if camera not in model.file.exposures]
    if unexposed:
        warnings.append(f"the model has no exposure of {_listed(unexposed)}: its colours are compared as they are.")
    return {name: cameras for name, (cameras, _) in found.items() if cameras}


def _device(name: str) -> str:
    from .sg_gs import resolve_device

    return str(resolve_device(name))


def _video_times(capture: Capture, episode: str, cameras: Sequence[str]) -> Array:
    times = [capture.frame_times(camera, episode) for camera in cameras]
    return np.unique(np.concatenate(times)) if times else np.zeros(0)


def _evaluation(
    predictions: Sequence[EpisodePrediction],
    compare: Callable[[EpisodePrediction], tuple[VideoComparison, ...]],
    warnings: list[str],
) -> Evaluation:
    episodes = []
    filmed = progress(predictions, "eval: frames", len(predictions), "episode")
    for prediction in filmed:
        if not bool((prediction.seen & ~prediction.warmup[:, None]).any()):
            warnings.append(f"episode '{prediction.episode}' is left out: no measured frame follows the warm-up.")
            continue
        videos = compare(prediction)
        episodes.append(EpisodeEvaluation(prediction, videos, _episode_errors(prediction, videos)))
    if not episodes:
        raise InputDataError(
            "in none of the episodes does a measured frame follow the warm-up.",
            "episodes longer than the warm-up.",
            "shorten it: --warmup-s.",
        )
    if any(not video.true_masks for episode in episodes for video in episode.videos):
        warnings.append("psnr_object_db: without video_masks it is over the predicted mask alone where there are none.")
    fitted = sum(episode.prediction.state_fitted_m is not None for episode in episodes)
    if 0 < fitted < len(episodes):
        warnings.append(
            f"state_fitted_residual_m is that of {fitted} of {len(episodes)} episodes, evenly spread "
            f"(at most {STATE_FIT_EPISODES} are fitted)."
        )
    return Evaluation(_result(episodes, warnings), tuple(episodes))


def _result(episodes: Sequence[EpisodeEvaluation], warnings: Sequence[str]) -> EvalResult:
    errors = [episode.errors for episode in episodes]
    model = _figures(episodes, MODEL)
    return EvalResult(
        episodes=len(episodes),
        translation_error_m=model["translation_error_m"],
        rotation_error_deg=model["rotation_error_deg"],
        psnr_db=model["psnr_db"],
        psnr_object_db=model["psnr_object_db"],
        ssim=model["ssim"],
        state_fitted_residual_m=_summary([e.state_fitted_residual_m for e in errors]),
        state_noise_floor_m=_summary([e.state_noise_floor_m for e in errors]),
        baselines={method: _plain(_figures(episodes, method)) for method in BASELINES},
        per_episode=tuple(errors),
        warnings=tuple(warnings),
    )


def _figures(episodes: Sequence[EpisodeEvaluation], method: str) -> dict[str, Any]:
    """Return the summaries over episodes for one method."""
    moved = [_within(e.prediction, e.prediction.translation_error_m(method)) for e in episodes]
    turned = [_within(e.prediction, e.prediction.rotation_error_deg(method)) for e in episodes]
    return {
        "translation_error_m": _summary([mean for mean, _ in moved], [last for _, last in moved]),
        "rotation_error_deg": _summary([mean for mean, _ in turned], [last for _, last in turned]),
        "psnr_db": _summary([_video_mean(e.videos, "psnr_db", method) for e in episodes]),
        "psnr_object_db": _summary([_video_mean(e.videos, "psnr_object_db", method) for e in episodes]),
        "ssim": _summary([_video_mean(e.videos, "ssim", method) for e in episodes]),
    }


def _plain(figures: dict[str, ErrorSummary | None]) -> dict[str, Any]:
    return {name: None if summary is None else summary.model_dump() for name, summary in figures.items()}


def _episode_errors(prediction: EpisodePrediction, videos: Sequence[VideoComparison]) -> EpisodeErrors:
    moved, moved_last = _within(prediction, prediction.translation_error_m())
    turned, turned_last = _within(prediction, prediction.rotation_error_deg())
    assert moved is not None and moved_last is not None  # a measured frame follows the warm-up
    after = prediction.seen.any(1) & ~prediction.warmup
    return EpisodeErrors(
        episode=prediction.episode,
        frames=int(after.sum()),
        duration_s=float(prediction.time_s[-1] - prediction.time_s[0]),
        translation_error_m=moved,
        translation_final_m=moved_last,
        rotation_error_deg=turned,
        rotation_final_deg=turned_last,
        psnr_db=_video_mean(videos, "psnr_db", MODEL),
        psnr_object_db=_video_mean(videos, "psnr_object_db", MODEL),
        ssim=_video_mean(videos, "ssim", MODEL),
        state_fitted_residual_m=prediction.state_fitted_m,
        state_noise_floor_m=prediction.noise_floor_m,
    )


def _within(prediction: EpisodePrediction, error: Array) -> tuple[float | None, float | None]:
    """Return mean and last of an error (T, nf) after the warm-up; None where nothing was measured there."""
    after = error[~prediction.warmup]
    measured = np.flatnonzero(np.isfinite(after).any(1))
    if len(measured) == 0:
        return None, None
    return float(np.nanmean(after)), float(np.nanmean(after[measured[-1]]))


def _video_mean(videos: Sequence[VideoComparison], figure: str, method: str) -> float | None:
    """Return the mean over all frames of all cameras; None where there is none."""
    values = np.concatenate([getattr(video, figure)[method] for video in videos]) if videos else np.zeros(0)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


def _summary(means: Sequence[float | None], finals: Sequence[float | None] = ()) -> ErrorSummary | None:
    known = [value for value in means if value is not None]
    last = [value for value in finals if value is not None]
    if not known:
        return None
    final = float(np.median(last)) if last else None
    return ErrorSummary(mean=float(np.mean(known)), median=float(np.median(known)), final=final)
