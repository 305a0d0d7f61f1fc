"""PIN-WM's fit of the physics: Adam through its simulator and renderer on the pictures of the training video."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.synthetic import read_truth
from contenders.base import TRAIN_EPISODE, Array
from torch import Tensor

from .pinwm_frames import FINGERTIP, fingertip_of, frames_of
from .pinwm_simulator import FAILURES, Simulator
from .pinwm_surfels import PARTS, psnr_db, render
from .source import module


@dataclass(frozen=True, eq=False)
class Video:
    """The training video: surfels in their frame, times (F,) [s], the cameras' frames, commands, and the true motion.

    Of the truth the fit reads the state at the first frame alone.
    """

    model: Any
    times_s: Array
    views: list[list[Any]]
    drives: dict[str, Track]
    truth: Any

    @staticmethod
    def of(folder: Path, model: Any) -> Video:
        """Read the training episode of a capture; `model` are the object's surfels."""
        capture = Capture.open(folder)
        times, views = frames_of(capture, TRAIN_EPISODE)
        drives = {name: track for name, track in capture.tracks(TRAIN_EPISODE).items() if name == FINGERTIP}
        for name in PARTS:
            setattr(model, name, getattr(model, name).detach())
        return Video(model, times, views, drives, read_truth(folder).episodes[TRAIN_EPISODE])

    @property
    def fingertip_z_m(self) -> float | None:
        """Height of the fingertip, or None."""
        tip = fingertip_of(self.drives)
        return None if tip is None else float(tip(float(self.times_s[0]))[2])

    def start(self, simulator: Simulator) -> list[Array]:
        """Return the true state of the local frame at the first frame."""
        row, names = self._row(self.times_s[0]), ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")
        return simulator.local.state(*(np.asarray(getattr(self.truth, name)[row]) for name in names))

    def loss(self, simulator: Simulator) -> Tensor:
        """Return its loss of a rollout, the mean over the cameras."""
        pictures, frames = [], []
        motion = simulator.rollout(self.start(simulator), self.times_s, fingertip_of(self.drives))
        for number, (position, quat) in enumerate(motion):
            self.model.reset_position_rotation(position.cuda(), quat.cuda())
            pictures += [render(view[number], self.model) for view in self.views]
            frames += [view[number].original_image for view in self.views]
        losses = module("diff_rendering.gaussian_splatting_2d.utils.loss_utils")
        return losses.rendering_loss_batch(pictures, frames) / len(self.views)

    def true_poses_psnr_db(self, simulator: Simulator) -> float:
        """Return the PSNR [dB] at the true poses: whether surfels, cameras and frames agree."""
        ratios = []
        for number, time_s in enumerate(self.times_s):
            row = self._row(float(time_s))
            pose = simulator.local.pose(np.asarray(self.truth.position_m[row]), np.asarray(self.truth.quat_wxyz[row]))
            self.model.reset_position_rotation(*(torch.tensor(v, dtype=torch.float32).cuda() for v in pose))
            ratios += [psnr_db(view[number], self.model) for view in self.views]
        return round(float(np.mean(ratios)), 2)

    def _row(self, time_s: float) -> int:
        return int(np.abs(np.asarray(self.truth.time_s) - time_s).argmin())


class Descent:
    """The descent, which can be gone on with.

    best: the numbers of least loss; losses: of every step; spent_s: wall time; ended: why it stopped.
    """

    def __init__(self, simulator: Simulator, video: Video) -> None:
        self.simulator, self.video, self.optimizer = simulator, video, simulator.optimizer()
        self.best, self.least, self.losses = simulator.numbers(), float("inf"), list[float]()
        self.spent_s, self.ended = 0.0, ""

    def run(self, iterations: int, budget_s: float | None) -> None:
        """Descend until there are so many steps, or so much time is spent, all in all; it does at least one step."""
        self.ended = ""
        while not self.ended:
            begun = time.perf_counter()
            try:
                finite = self._step()
            except FAILURES as error:
                self.ended = f"{type(error).__name__}: {error}"
                return
            self.spent_s += time.perf_counter() - begun
            late = budget_s is not None and self.spent_s * (1 + 1 / len(self.losses)) > budget_s
            over = len(self.losses) > iterations
            self.ended = "not finite" if not finite else "iterations" if over else "budget" if late else ""

    def _step(self) -> bool:
        """Make a step, and return whether loss and gradient were finite."""
        loss = self.video.loss(self.simulator)
        self.losses.append(round(float(loss), 6))
        if self.losses[-1] < self.least:
            self.best, self.least = self.simulator.numbers(), self.losses[-1]
        self.optimizer.zero_grad()
        loss.backward()
        every = [value.grad for one in self.simulator.materials for value in one.all.values()]
        if not all(bool(slope.isfinite().all()) for slope in [loss, *every] if slope is not None):
            return False
        self.optimizer.step()
        return True

    def record(self) -> dict[str, Any]:
        """Return how it went."""
        return {
            "seconds": round(self.spent_s, 1),
            "evaluations": len(self.losses),
            "ended": self.ended,
            "image_loss": {"best": self.least, "history": self.losses[::5]},
        }
