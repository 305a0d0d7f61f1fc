"""The stage evaluate (`cgwm eval`): compare open-loop predictions of a model with measurements.

The initial state of an episode is estimated from its warm-up with the model; the prediction uses no later data. An
episode that begins in a hand begins at its release, as for `fit` and `diagnose`.
Errors are averaged within an episode first, then over episodes.

Where a capture has videos and no tracks of the free bodies, their poses are found in the videos (`filmed_poses.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.cameras import require_metric
from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Episode, Track
from ...datasets.io.atomic import new_file
from ...datasets.io.kinds import kind_of
from ...datasets.io.outputs import reads, refuse_output
from ...datasets.io.progress import progress
from ...datasets.models.fit_inputs import changed_since_fit
from ...datasets.models.model import Model, read_model
from ...datasets.rollouts.loader import RolloutReader
from ...schemas import ErrorSummary, EvalResult, InputDataError, Reference, UsageError
from ...schemas.printable import typed_path
from ..physics.model_world import world_of_model
from ..physics.world import World
from ..rendering.video_view import renderable, usable_cameras
from ..report.page_file import shows_the_same
from ..runtime.device import resolve_device
from ..runtime.resources import enough_memory, one_torch_thread
from ..segments.group_parameters import group_parameters, with_known_groups
from ..segments.random_effects import with_fitted_groups
from ..segments.release_detection import from_releases
from ..trajectories.frame_times import episodes_at_clock
from ..trajectories.track_noise import Noise, noise_of
from .episode_errors import episode_errors, silhouette_mean, video_mean, within
from .evaluation import EpisodeEvaluation, Evaluation
from .filmed_poses import PoseUncertainty, filmed_poses
from .image_errors import VideoComparison, VideoErrors
from .page import evaluation_html, mark_of
from .prediction import BASELINES, MODEL, STATE_FIT_EPISODES, EpisodePrediction, predict
from .work import checked_work

Array = NDArray[np.float64]

WARMUP_S = 0.1
"""Usual duration of the start of an episode that a model may use [s]."""
DATASET_NOISE = Noise(1e-4, 1e-3)
"""Assumed noise of the poses of a dataset, which are exact (position [m], rotation [rad])."""


@reads("model", "target")
def evaluate(
    model: Path,
    target: Path,
    split: str = "test",
    warmup_s: float = WARMUP_S,
    device: str = "auto",
    accept_units: bool = False,
    reference: Reference = "auto",
    page: Path | None = None,
    overwrite: bool = False,
) -> EvalResult:
    """Evaluate a model on disk against a capture's tracks and frames, or against the states of a dataset.

    Args:
        model: MODEL, with fitted physics.
        target: A capture, or a dataset.
        split: The episodes to predict. A dataset has `train` and `valid` for learning; `test` selects all its
            rollouts.
        warmup_s: Duration of the start of an episode that the model may use [s].
        device: Device of the renderer: auto, cpu or cuda. Rollouts of few bodies are fastest on the CPU.
        accept_units: Do not refuse units and frames of the capture that its motion contradicts.
        reference: With what predictions begin and are compared: tracks, or poses found in the images of the videos;
            auto takes tracks where the split has any of the free bodies, and videos otherwise.
        page: The page to write, of a capture; None writes none.
        overwrite: Replace what is at `page`; a page of the same model, capture and split is replaced in any case.

    Raises:
        InputDataError: If the target has no data to compare with, or other bodies than the model.
        UsageError: If the split does not exist, `page` exists, or a dataset is to be compared by images or shown.
        NotConvergedError: If a rollout of the model diverges.
        NotEnoughMemoryError: If the available memory is not sufficient to render the frames.
    """
    mark = ""
    if page is not None:
        mark = mark_of(page, model, target, split)
        overwrite = overwrite or shows_the_same(page, mark)
        refuse_output(page, "page", overwrite)
    loaded = read_model(model)
    if kind_of(target) == "dataset":
        _refuse_images(target, reference, page)
        return evaluate_dataset(loaded, target, split, warmup_s).result
    capture = Capture.open(target, splits=(split,), accept_units=accept_units or loaded.accepts_units)
    tried = f"{loaded.visual_count} spheres, frames of the videos at their own size"
    with enough_memory(
        tried, str(resolve_device(device)), "a model of fewer spheres (cgwm fit --spheres), smaller videos"
    ):
        found = evaluate_model(loaded, capture, split, warmup_s, device, page is not None, reference=reference)
    if page is None:
        return found.result
    with new_file(page, "page", overwrite) as path:
        path.write_text(evaluation_html(found, capture, page, model, split, mark), encoding="utf-8")
    return found.result.model_copy(update={"report": str(page)})


def _refuse_images(target: Path, reference: Reference, page: Path | None) -> None:
    if page is not None:
        raise UsageError(
            f"--page {page}: {target} is a dataset, which has no videos.",
            "a page for a capture.",
            "leave --page out; cgwm view shows rollouts.",
        )
    if reference == "images":
        raise UsageError(
            f"--reference images: {target} is a dataset, whose states are exact.",
            "auto or tracks for a dataset.",
            "leave --reference out.",
        )


def evaluate_model(
    model: Model,
    capture: Capture,
    split: str = "test",
    warmup_s: float = WARMUP_S,
    device: str = "auto",
    keep_frames: bool = False,
    brief: bool = False,
    reference: Reference = "tracks",
) -> Evaluation:
    """Evaluate a model against the tracks of a capture, and against its frames if model and cameras allow.

    Args:
        model: A model with fitted physics.
        capture: The measurements.
        split: The episodes to predict.
        warmup_s: Duration of the start of an episode that the model may use [s].
        device: Device of the renderer: auto, cpu or cuda.
        keep_frames: Keep the predicted and the real frames (tens of megabytes an episode).
        brief: Compute only the errors of the poses and of the baselines, without frames and fitted states.
        reference: See :func:`evaluate`.

    Raises:
        See :func:`evaluate`.
    """
    check_bodies(model, capture.body_names, str(capture.root))
    world = world_of_model(model)
    uncertainty: dict[str, PoseUncertainty] | None = None
    if _by_images(model, capture, split, reference):
        filmed = filmed_poses(world, model, capture, split, device)
        episodes, noise, warnings, uncertainty = filmed.episodes, filmed.noise, filmed.warnings, filmed.uncertainty
    else:
        episodes, warnings = _tracked(model, capture, split)
        noise = _noise(model, capture, episodes)
    episodes, held = _released(world, episodes, noise)
    warnings += [*held, *changed_since_fit(model.file.provenance, capture)]
    cameras = {} if brief else _cameras(model, capture, [name for name, _ in episodes], warnings)
    videos = (
        VideoErrors(model=model, capture=capture, device=str(resolve_device(device)), keep_frames=keep_frames)
        if cameras
        else None
    )
    video_times = [_video_times(capture, name, cameras.get(name, [])) for name, _ in episodes]
    fits = 0 if brief else STATE_FIT_EPISODES
    world, fitted = _worlds_with_random_effects(world, model, capture, episodes, noise, warnings, brief)
    warmup_s = _outlasted(warmup_s, episodes, warnings)
    predictions = _predict(model, world, episodes, noise, warmup_s, video_times, fits, fitted)
    warnings += _assumed_spins(predictions)

    def compare(prediction: EpisodePrediction) -> tuple[VideoComparison, ...]:
        names = cameras.get(prediction.episode, [])
        found = [videos.compare(prediction, name) for name in names] if videos else []
        return tuple(comparison for comparison in found if comparison is not None)

    return _evaluation(predictions, compare, warnings, uncertainty)


def _by_images(model: Model, capture: Capture, split: str, reference: Reference) -> bool:
    """Return whether the poses of the free bodies are to be found in the videos."""
    _require_free(model)
    if reference != "auto":
        return reference == "images"
    names = capture.episodes(split)
    tracked = any(set(model.file.tracked) & set(capture.tracks(name)) for name in names)
    return not tracked and any(capture.videos(name) for name in names)


def _tracked(model: Model, capture: Capture, split: str) -> tuple[list[Episode], list[str]]:
    """Return the episodes of a split with tracks of every moving body, and warnings.

    Raises:
        InputDataError: If there is none.
    """
    timed, clocked = episodes_at_clock(capture, capture.episodes(split), set(model.file.tracked))
    episodes, warnings = _usable(model, timed)
    if episodes:
        return episodes, [*warnings, *clocked]
    filmed = any(capture.videos(name) for name in capture.episodes(split))
    raise InputDataError(
        f"{capture.root}: no episode of split '{split}' can be evaluated. {' '.join(warnings)}".rstrip(),
        "tracks/<episode>.csv with rows for every free and driven body.",
        "add tracks; cgwm eval finds poses in the videos where there are none."
        if filmed
        else "add tracks or videos, or name another split with --split.",
    )


@one_torch_thread()
def _worlds_with_random_effects(
    world: World,
    model: Model,
    capture: Capture,
    episodes: Sequence[Episode],
    noise: Noise,
    warnings: list[str],
    brief: bool,
) -> tuple[World, World]:
    """Return the world with the random effects known from the fit, and the one with those fitted to all episodes."""
    names = [name for name, _ in episodes]
    known = with_known_groups(world, model.file, names, capture.groups)
    unknown = [name for name in names if len(known.own_values.get(name, {})) < len(group_parameters(world))]
    if brief or not unknown:
        return known, known
    warnings.append(
        f"{len(unknown)} of the {len(names)} episodes belong to groups that the fit has not seen: their "
        "group parameters have the mean in open loop, and are fitted with the state in the state-fitted residual."
    )
    return known, with_fitted_groups(world, episodes, model.file, capture.groups, noise)


def evaluate_dataset(model: Model, dataset: Path, split: str = "test", warmup_s: float = WARMUP_S) -> Evaluation:
    """Evaluate a model against the stored states of a dataset's rollouts; see :func:`evaluate`."""
    reader = RolloutReader(dataset, None if split == "test" else split)
    try:
        if len(reader) == 0:
            raise InputDataError(f"{dataset}: split '{split}' has no rollout.", todo="name another with --split.")
        names = [name.decode() for name in reader.group(0)["bodies/names"][()]]
        check_bodies(model, names, str(dataset))
        world = world_of_model(model)
        # A dataset stores true states, not measured ones.
        world = replace(world, effects=tuple(a for a in world.effects if a.effect.phase != "measurement"))
        found = [Episode(info.demo, _stored_tracks(reader, number)) for number, info in enumerate(reader.rollouts)]
    finally:
        reader.close()
    episodes, warnings = _usable(model, found)
    if not episodes:
        raise InputDataError(
            f"{dataset}: its rollouts have no free body with two frames or more.",
            todo="synthesize longer ones: --duration.",
        )
    none = [np.zeros(0)] * len(episodes)
    predictions = _predict(model, world, episodes, DATASET_NOISE, warmup_s, none)
    return _evaluation(predictions, lambda _: (), warnings)


def _stored_tracks(reader: RolloutReader, number: int) -> dict[str, Track]:
    """Return the states of a rollout as tracks of the moving bodies."""
    group = reader.group(number)
    time, position, quat = (group[key][()] for key in ("time", "bodies/pos", "bodies/quat_wxyz"))
    names, motions = (group[f"bodies/{key}"][()] for key in ("names", "motions"))
    return {
        name.decode(): Track(time, position[:, k], quat[:, k]) for k, name in enumerate(names) if motions[k] != b"fixed"
    }


@one_torch_thread()
def _released(world: World, episodes: Sequence[Episode], noise: Noise) -> tuple[list[Episode], list[str]]:
    """Return the episodes, those that begin in a hand from their releases on, and warnings about these."""
    return from_releases(world, episodes, noise)


def check_bodies(model: Model, names: Sequence[str], target: str) -> None:
    """Check that the bodies of a model have the names of those of a target.

    Raises:
        InputDataError: If they do not, with both lists.
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
    """Return the episodes in which every moving body has a track, and messages on the others."""
    moving = [*model.file.tracked, *model.file.commanded]
    _require_free(model)
    usable, warnings = [], []
    for name, tracks in episodes:
        lacking = [body for body in moving if body not in tracks]
        if lacking:
            warnings.append(f"episode '{name}' is left out: no track of {_listed(lacking)}.")
        else:
            usable.append(Episode(name, tracks))
    return usable, warnings


def _require_free(model: Model) -> None:
    if not model.file.tracked:
        raise InputDataError(
            f"{model.place}: none of its bodies is free, so there is no motion to predict.",
            'a body with the motion "free".',
            "take a model with one, or fit one.",
        )


def _noise(model: Model, capture: Capture, episodes: Sequence[Episode]) -> Noise:
    """Return the measurement noise (position [m], rotation [rad]): from the model, the manifest or an estimate."""
    known, given = model.file.measurement_std, capture.manifest.measurement
    position = known.get("position_m") or given.position_std_m
    rotation = known.get("rotation_rad") or given.rotation_std_rad
    free = model.file.tracked
    return noise_of((position, rotation), (tracks[name] for _, tracks in episodes for name in free))


@one_torch_thread()
def _predict(
    model: Model,
    world: World,
    episodes: Sequence[Episode],
    noise: Noise,
    warmup_s: float,
    video_times: Sequence[Array],
    state_fits: int = STATE_FIT_EPISODES,
    fitted: World | None = None,
) -> list[EpisodePrediction]:
    bar = progress(desc="eval: rollouts", total=len(episodes), unit="episode")
    with checked_work(world, episodes, state_fits), bar:
        return predict(world, episodes, noise, warmup_s, video_times, bar.update, state_fits, fitted)


def _assumed_spins(predictions: Sequence[EpisodePrediction]) -> list[str]:
    """Return what was assumed of spins that nobody measured."""
    rolling = [f"'{one.episode}'" for one in predictions if one.rolls]
    if not rolling:
        return []
    begin = f"episode {rolling[0]} begins" if len(rolling) == 1 else f"{len(rolling)} episodes begin"
    return [
        f"{begin} in contact without measured turns: the ball is taken to roll with the velocity of its warm-up, as "
        "far as the model's friction lets it."
    ]


def _outlasted(warmup_s: float, episodes: Sequence[Episode], warnings: list[str]) -> float:
    """Return the warm-up [s]: half of the longest episode in place of a usual one that none of them outlasts."""
    longest = max(float(np.ptp(track.time_s)) for _, tracks in episodes for track in tracks.values())
    if warmup_s != WARMUP_S or longest > warmup_s:
        return warmup_s
    warnings.append(f"no episode is longer than {1e3 * longest:.0f} ms: models see the first half of it.")
    return longest / 2


def _cameras(model: Model, capture: Capture, episodes: Sequence[str], warnings: list[str]) -> dict[str, list[str]]:
    """Return the cameras with comparable frames by episode; add the reasons for the others to `warnings`."""
    filmed = [name for name in episodes if capture.videos(name)]
    if not filmed:
        return {}
    if not renderable(model):
        warnings.append("no PSNR: the model has no scene, or a free body of it no visual spheres.")
        return {}
    if capture.cameras is None:
        warnings.append(f"no PSNR: the cameras are not calibrated; run 'cgwm calibrate {typed_path(capture.root)}'.")
        return {}
    require_metric(capture.cameras)
    found = {name: usable_cameras(capture, name) for name in filmed}
    usable = {name: cameras for name, (cameras, _) in found.items() if cameras}
    unknown = {camera for _, lacking in found.values() for camera in lacking}
    if unknown:
        warnings.append(f"no PSNR from {_listed(sorted(unknown))}: no pose in the capture's cameras.")
    unexposed = {camera for cameras in usable.values() for camera in cameras} - set(model.file.exposures)
    if unexposed:
        names = _listed(sorted(unexposed))
        warnings.append(f"the model has no exposure of {names}: its colours are compared as they are.")
    return usable


def _video_times(capture: Capture, episode: str, cameras: Sequence[str]) -> Array:
    times = [capture.frame_times(camera, episode) for camera in cameras]
    return np.unique(np.concatenate(times)) if times else np.zeros(0)


def _evaluation(
    predictions: Sequence[EpisodePrediction],
    compare: Callable[[EpisodePrediction], tuple[VideoComparison, ...]],
    warnings: list[str],
    uncertainty: Mapping[str, PoseUncertainty] | None = None,
) -> Evaluation:
    episodes = []
    filmed = progress(predictions, "eval: frames", len(predictions), "episode")
    for prediction in filmed:
        if not bool((prediction.seen & ~prediction.warmup[:, None]).any()):
            warnings.append(f"episode '{prediction.episode}' is left out: no measured frame follows the warm-up.")
            continue
        videos = compare(prediction)
        known = None if uncertainty is None else uncertainty[prediction.episode]
        episodes.append(EpisodeEvaluation(prediction, videos, episode_errors(prediction, videos, known)))
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
    if uncertainty is not None and not any(video.true_masks for episode in episodes for video in episode.videos):
        warnings.append("no IoU, no distances of silhouettes and centroids: the videos have no masks.")
    reference = "tracks" if uncertainty is None else "images"
    return Evaluation(_result(episodes, reference, warnings), tuple(episodes))


def _result(
    episodes: Sequence[EpisodeEvaluation], reference: Literal["tracks", "images"], warnings: Sequence[str]
) -> EvalResult:
    errors = [episode.errors for episode in episodes]
    model = _figures(episodes, MODEL)
    return EvalResult(
        episodes=len(episodes),
        reference=reference,
        translation_error_m=model["translation_error_m"],
        rotation_error_deg=model["rotation_error_deg"],
        psnr_db=model["psnr_db"],
        psnr_object_db=model["psnr_object_db"],
        ssim=model["ssim"],
        mask_iou=model["mask_iou"],
        centroid_error_px=model["centroid_error_px"],
        outline_error_px=model["outline_error_px"],
        centroid_error_m=_summary([e.centroid_error_m for e in errors], [e.centroid_final_m for e in errors]),
        state_fitted_residual_m=_summary([e.state_fitted_residual_m for e in errors]),
        state_noise_floor_m=_summary([e.state_noise_floor_m for e in errors]),
        baselines={method: _plain(_figures(episodes, method)) for method in BASELINES},
        per_episode=tuple(errors),
        warnings=tuple(warnings),
    )


def _figures(episodes: Sequence[EpisodeEvaluation], method: str) -> dict[str, Any]:
    """Return the summaries over episodes for one method."""
    moved = [within(e.prediction, e.prediction.translation_error_m(method)) for e in episodes]
    turned = [within(e.prediction, e.prediction.rotation_error_deg(method)) for e in episodes]
    return {
        "translation_error_m": _summary([mean for mean, _ in moved], [last for _, last in moved]),
        "rotation_error_deg": _summary([mean for mean, _ in turned], [last for _, last in turned]),
        "psnr_db": _summary([video_mean(e.videos, "psnr_db", method) for e in episodes]),
        "psnr_object_db": _summary([video_mean(e.videos, "psnr_object_db", method) for e in episodes]),
        "ssim": _summary([video_mean(e.videos, "ssim", method) for e in episodes]),
        "mask_iou": _summary([silhouette_mean(e.videos, "iou", method) for e in episodes]),
        "centroid_error_px": _summary([silhouette_mean(e.videos, "centroid_px", method) for e in episodes]),
        "outline_error_px": _summary([silhouette_mean(e.videos, "outline_px", method) for e in episodes]),
    }


def _plain(figures: dict[str, ErrorSummary | None]) -> dict[str, Any]:
    return {name: None if summary is None else summary.model_dump() for name, summary in figures.items()}


def _summary(means: Sequence[float | None], finals: Sequence[float | None] = ()) -> ErrorSummary | None:
    known = [value for value in means if value is not None]
    last = [value for value in finals if value is not None]
    if not known:
        return None
    final = float(np.median(last)) if last else None
    return ErrorSummary(mean=float(np.mean(known)), median=float(np.median(known)), final=final)
