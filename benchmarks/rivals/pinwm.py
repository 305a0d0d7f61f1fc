"""PIN-WM's own code (arXiv 2504.16693) as a row: surfels by its training, then Adam through its simulator on pictures.

Its settings are those of its script: 5,000 steps of surfels, 240 steps a second, 100 steps of Adam, one draw of the
numbers that it begins with. What differs: two cameras and all 15 frames in place of one and 12; mass is given and not
fitted, as everybody's is; the simulator runs on the CPU; and it keeps the step of least loss rather than the last. It
is given more than the other rows: the true shape, mass and inertia, and the true state at the first frame.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import read_model
from cgwm.datasets.synthetic import read_truth
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.phys_geo.images.video_episodes import kinematic_poses
from cgwm.pipeline.physics.world import State, World
from cgwm.schemas import ContactParameters, NotConvergedError
from contenders.base import TRAIN_EPISODE, Array, Cell, Prediction
from contenders.training import checked
from tabletop.capture import read_solid
from torch import Tensor

from . import bullet
from .pinwm_frames import FINGERTIP, fingertip_of, frames_of
from .pinwm_simulator import Simulator
from .pinwm_surfels import PARTS, psnr_db, render, surfels
from .source import may_lack, module, source

ITERATIONS = 100
UNUSED = ("open3d", "mediapy", "matplotlib", "skimage", "cvxpy", "imageio")
"""It imports them for meshes of surfels, films, charts and another solver."""


@dataclass(frozen=True)
class PinWmItself:
    """The rival, from the folder that `CGWM_PINWM` names."""

    name: str = "PIN-WM"
    iterations: int = ITERATIONS
    surfel_steps: int | None = None

    def fit(self, cell: Cell, budget_s: float | None) -> FittedPinWmItself:
        """Fit surfels, where they are not kept beside the splats, and then the physics within the budget.

        Raises:
            UsageError: If its code is not there.
            InputDataError: If the capture has no truth.
            NotConvergedError: If no step has a finite loss.
        """
        source("CGWM_PINWM")
        bullet.install()
        may_lack(UNUSED)
        capture, solid = Capture.open(cell.capture), read_solid(cell.capture)
        kept = cell.splats.parent / "surfels" / f"{solid.family}.pt"
        model, record = surfels(capture, solid, kept, self.surfel_steps)
        video = _Video.of(cell.capture, model)
        simulator = Simulator(solid, video.fingertip_z_m)
        found = _descend(simulator, video, self.iterations, budget_s)
        return FittedPinWmItself(
            simulator, cell.splats, found | {"surfels": record, "parameters": simulator.frictions()}
        )


@dataclass(frozen=True, eq=False)
class _Video:
    """The training video: surfels in their frame, times (F,) [s], the cameras' frames, the true state at the first."""

    model: Any
    times_s: Array
    views: list[list[Any]]
    drives: dict[str, Track]
    truth: Any

    @staticmethod
    def of(folder: Path, model: Any) -> _Video:
        """Read the training episode of a capture."""
        capture = Capture.open(folder)
        times, views = frames_of(capture, TRAIN_EPISODE)
        drives = {name: track for name, track in capture.tracks(TRAIN_EPISODE).items() if name == FINGERTIP}
        for name in PARTS:
            setattr(model, name, getattr(model, name).detach())
        return _Video(model, times, views, drives, read_truth(folder).episodes[TRAIN_EPISODE])

    @property
    def fingertip_z_m(self) -> float | None:
        """Height of the fingertip, or None."""
        tip = fingertip_of(self.drives)
        return None if tip is None else float(tip(float(self.times_s[0]))[2])

    def row(self, time_s: float) -> int:
        """Return the row of the truth at a time."""
        return int(np.abs(np.asarray(self.truth.time_s) - time_s).argmin())

    def start(self, simulator: Simulator) -> list[Array]:
        """Return the true state of the local frame at the first frame."""
        row, names = self.row(self.times_s[0]), ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")
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
            row = self.row(float(time_s))
            pose = simulator.local.pose(np.asarray(self.truth.position_m[row]), np.asarray(self.truth.quat_wxyz[row]))
            self.model.reset_position_rotation(*(torch.tensor(v, dtype=torch.float32).cuda() for v in pose))
            ratios += [psnr_db(view[number], self.model) for view in self.views]
        return round(float(np.mean(ratios)), 2)


def _descend(simulator: Simulator, video: _Video, iterations: int, budget_s: float | None) -> dict[str, Any]:
    """Descend, leave the simulator with the numbers of least loss, and return a record."""
    record: dict[str, Any] = {"true_poses_psnr_db": video.true_poses_psnr_db(simulator)}
    begun, optimizer = time.perf_counter(), simulator.optimizer()
    best, lowest, losses, ended = simulator.numbers(), float("inf"), [], "iterations"
    for step in range(iterations + 1):
        loss = video.loss(simulator)
        losses.append(round(float(loss), 6))
        if losses[-1] < lowest:
            best, lowest = simulator.numbers(), losses[-1]
        optimizer.zero_grad()
        loss.backward()
        free = [value.grad for one in simulator.materials for value in one.all.values() if value.grad is not None]
        if not all(bool(slope.isfinite().all()) for slope in (*free, loss)):
            ended = "not finite"
            break
        optimizer.step()
        spent = time.perf_counter() - begun
        if budget_s is not None and spent * (step + 2) / (step + 1) > budget_s:
            ended = "budget"
            break
    if lowest == float("inf"):
        raise NotConvergedError("PIN-WM: no step has a finite loss.")
    simulator.set_numbers(best)
    spent = round(time.perf_counter() - begun, 1)
    return record | {"seconds": spent, "evaluations": len(losses), "ended": ended, "loss": losses[::5], "least": lowest}


@dataclass(frozen=True, eq=False)
class FittedPinWmItself:
    """Its simulator with fitted numbers; `splats` names the bodies in the model's order."""

    simulator: Simulator
    splats: Path
    record: dict[str, Any]

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
        """Predict open loop.

        Raises:
            NotConvergedError: If its simulator fails, or diverges.
        """
        model = read_model(self.splats)
        world = World.from_model(replace(model, file=model.file.model_copy(update={"contact": ContactParameters()})))
        index = world.body_names.index(OBJECT)
        state = self.simulator.local.state(*(values[0, index].numpy() for values in vars(start).values()))
        try:
            with torch.no_grad():
                motion = list(self.simulator.rollout(state, np.asarray(times_s), fingertip_of(drives)))
        except (ArithmeticError, RuntimeError, TypeError, ValueError) as error:  # its solver has no error of its own
            raise NotConvergedError(f"PIN-WM: {type(error).__name__}: {error}") from error
        poses = [self.simulator.local.body_pose(p.numpy().astype(float), q.numpy().astype(float)) for p, q in motion]
        position, quat = (np.array(values.numpy()) for values in kinematic_poses(world, drives, np.asarray(times_s)))
        position[:, index], quat[:, index] = np.stack([p for p, _ in poses]), np.stack([q for _, q in poses])
        return checked(position, quat)
