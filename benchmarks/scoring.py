"""How a prediction of the benchmark `fall_push.py` is judged: against the truth, and its renders against the videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import Model, read_model
from cgwm.datasets.synthetic import TruthFile, read_truth
from cgwm.pipeline.demo.truth_tables import OBJECT, true_parameters
from cgwm.pipeline.evaluate.episode_errors import episode_errors
from cgwm.pipeline.evaluate.evaluation import EpisodeEvaluation
from cgwm.pipeline.evaluate.frame_strips import strips_of
from cgwm.pipeline.evaluate.image_errors import VideoErrors
from cgwm.pipeline.evaluate.prediction import MODEL, EpisodePrediction, Motion
from cgwm.pipeline.phys_geo.images.video_exposure import estimate_exposures
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.rendering.contact_sheets import FrameStrip
from cgwm.pipeline.rendering.video_view import usable_cameras
from cgwm.schemas import InputDataError, NotConvergedError
from contenders.base import Array, Cell, Fitted, Prediction

SAME_TIME_S = 1e-6


@dataclass(frozen=True, eq=False)
class TestEpisode:
    """A test episode: the frames' times (F,), the true state at the first one, commands, and the object's true poses.

    position_m (F, 3), quat_wxyz (F, 4): of the object at the frames; place: its index among the model's bodies.
    """

    __test__ = False  # no test, though its name begins so

    name: str
    times_s: Array
    start: State
    drives: dict[str, Track]
    position_m: Array
    quat_wxyz: Array
    place: int


@dataclass(frozen=True, eq=False)
class Judge:
    """Judges one cell's predictions on its test episodes; `videos` compares renders, None for no images."""

    truth: TruthFile
    episodes: tuple[TestEpisode, ...]
    videos: VideoErrors | None

    @staticmethod
    def of(cell: Cell, psnr_every: int) -> Judge:
        """Read a cell's test episodes.

        Args:
            cell: The cell; its splats render, with each camera's exposure as `cgwm fit` estimates it.
            psnr_every: Look at every so manyth frame; 0: at no pictures.

        Raises:
            InputDataError: If there is no truth, or it does not hold a frame's time.
        """
        capture, model = Capture.open(cell.capture), read_model(cell.splats)
        truth = read_truth(cell.capture)
        episodes = tuple(_episode(capture, model, truth, name) for name in capture.episodes("test"))
        if not psnr_every:
            return Judge(truth, episodes, None)
        exposures = estimate_exposures(model, capture, "train", cell.device)
        exposed = replace(model, file=model.file.model_copy(update={"exposures": exposures}))
        return Judge(truth, episodes, VideoErrors(model=exposed, capture=capture, device=cell.device, every=psnr_every))

    def episode_errors(self, fitted: Fitted) -> list[dict[str, Any]]:
        """Return a record for each test episode: its errors, or why the prediction failed.

        `translation_mm` and `rotation_deg` are means over the frames after the first, `psnr_db` and `psnr_object_db`
        means over the frames looked at and the cameras, without frames in which no mask has a pixel.
        """
        rows = []
        for episode in self.episodes:
            try:
                prediction = fitted.predict(episode.start, episode.drives, episode.times_s)
            except NotConvergedError as error:
                rows.append({"episode": episode.name, "failed": error.found})
                continue
            rows.append(
                {"episode": episode.name, **pose_errors(prediction, episode), **self._images(prediction, episode)}
            )
        return rows

    def strip(self, fitted: Fitted, name: str) -> FrameStrip:
        """Return the frames looked at of a test episode, from its first camera, with those that are predicted.

        Raises:
            NotConvergedError: If the prediction fails.
            ValueError: If no videos are looked at.
        """
        if self.videos is None:
            raise ValueError("no videos are looked at")
        episode = next(one for one in self.episodes if one.name == name)
        row = _as_prediction(fitted.predict(episode.start, episode.drives, episode.times_s), episode)
        camera = usable_cameras(self.videos.capture, name)[0][0]
        video = replace(self.videos, keep_frames=True).compare(row, camera)
        videos = () if video is None else (video,)
        errors = episode_errors(replace(row, noise_floor_m=0.0), videos)  # true poses have no noise
        return strips_of([EpisodeEvaluation(row, videos, errors)], self.videos.capture)[0]

    def parameter_errors(self, parameters: dict[str, float]) -> dict[str, float]:
        """Return relative errors (estimate / truth - 1) of the parameters that the truth has and that are not 0.

        A centre of mass of 1e-17 m is 0 but for rounding.
        """
        true = true_parameters(self.truth)
        return {name: value / true[name] - 1 for name, value in parameters.items() if abs(true.get(name, 0.0)) > 1e-12}

    def _images(self, prediction: Prediction, episode: TestEpisode) -> dict[str, float]:
        if self.videos is None:
            return {}
        cameras, _ = usable_cameras(self.videos.capture, episode.name)
        row = _as_prediction(prediction, episode)
        found = [self.videos.compare(row, camera) for camera in cameras]
        whole = np.concatenate([one.psnr_db[MODEL] for one in found if one is not None])
        inside = np.concatenate([one.psnr_object_db[MODEL] for one in found if one is not None])
        return {"psnr_db": float(whole.mean()), "psnr_object_db": float(np.nanmean(inside))}


def pose_errors(prediction: Prediction, episode: TestEpisode) -> dict[str, float]:
    """Return the mean error of the object's place [mm] and orientation [deg] over the frames after the first."""
    errors = _as_prediction(prediction, episode)
    return {
        "translation_mm": 1e3 * float(errors.translation_error_m()[1:].mean()),
        "rotation_deg": float(errors.rotation_error_deg()[1:].mean()),
    }


def _as_prediction(prediction: Prediction, episode: TestEpisode) -> EpisodePrediction:
    """Return a prediction as `cgwm eval` has it: the truth is what was measured, the first frame is the warm-up."""
    count = len(episode.times_s)
    every = np.ones((count, 1), bool)
    return EpisodePrediction(
        episode=episode.name,
        bodies=(OBJECT,),
        free=(episode.place,),
        time_s=episode.times_s,
        warmup=np.arange(count) == 0,
        position_m=episode.position_m[:, None],
        quat_wxyz=episode.quat_wxyz[:, None],
        seen=every,
        turned=every,
        grid_s=episode.times_s,
        rows=np.arange(count),
        motions={MODEL: Motion(prediction.position_m, prediction.quat_wxyz)},
        noise_floor_m=float("nan"),
        state_fitted_m=None,
    )


def _episode(capture: Capture, model: Model, truth: TruthFile, name: str) -> TestEpisode:
    cameras, _ = usable_cameras(capture, name)
    times = np.unique(np.concatenate([capture.frame_times(camera, name) for camera in cameras]))
    times = times[np.concatenate([[True], np.diff(times) > SAME_TIME_S])]
    motion = truth.episodes[name]
    rows = _rows(np.asarray(motion.time_s), times, f"{capture.root}: truth of episode '{name}'")
    tracks = capture.tracks(name)
    names = [body.name for body in model.file.bodies]
    drives = {body.name: tracks[body.name] for body in model.file.bodies if body.motion == "driven"}
    place, first = names.index(OBJECT), int(rows[0])
    start = _start(len(names))
    for values, true in zip(
        vars(start).values(),
        (motion.position_m, motion.quat_wxyz, motion.velocity_m_s, motion.omega_body_rad_s),
        strict=True,
    ):
        values[0, place] = torch.tensor(true[first], dtype=torch.float64)
    position, quat = (np.asarray(values, np.float64)[rows] for values in (motion.position_m, motion.quat_wxyz))
    return TestEpisode(name, times, start, drives, position, quat, place)


def _start(bodies: int) -> State:
    """Return bodies at rest at the origin; driven ones take their place from their commands."""
    zero = torch.zeros(1, bodies, 3, dtype=torch.float64)
    unturned = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(1, bodies, 1)
    return State(zero.clone(), unturned, zero.clone(), zero.clone())


def _rows(known_s: Array, wanted_s: Array, where: str) -> Sequence[int]:
    """Return the places of wanted times among known ones."""
    gap = np.abs(known_s[:, None] - wanted_s)
    if gap.min(0).max() > SAME_TIME_S:
        missing = float(wanted_s[gap.min(0).argmax()])
        raise InputDataError(f"{where}: nothing at {missing:g} s, the time of a video frame.")
    return gap.argmin(0)
