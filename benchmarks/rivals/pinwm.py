"""PIN-WM's own code (arXiv 2504.16693) as a row: surfels by its training, then Adam through its simulator on pictures.

Its settings are those of its script: 5,000 steps of surfels, 240 steps a second, 100 steps of Adam, one draw of the
numbers that it begins with. What differs: two cameras and all 15 frames in place of one and 12; mass is given and not
fitted, as everybody's is; the simulator runs on the CPU; and it keeps the step of least loss rather than the last. It
is given more than the other rows: the true shape, mass and inertia, and the true state at the first frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.phys_geo.images.video_episodes import kinematic_poses
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.state import State
from cgwm.schemas import ContactParameters, NotConvergedError
from contenders.base import Array, Cell, Prediction
from contenders.training import checked
from tabletop.capture import read_solid

from . import bullet
from .pinwm_descent import Descent, Video
from .pinwm_frames import fingertip_of
from .pinwm_simulator import FAILURES, Simulator
from .pinwm_surfels import surfels
from .source import may_lack, source

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
        video = Video.of(cell.capture, model)
        simulator = Simulator(solid, video.fingertip_z_m)
        record = {"surfels": record, "true_poses_psnr_db": video.true_poses_psnr_db(simulator)}
        descent = Descent(simulator, video)
        descent.run(self.iterations, budget_s)
        return fitted(descent, cell.splats, record)


def fitted(descent: Descent, splats: Path, record: dict[str, Any]) -> FittedPinWmItself:
    """Return the simulator with the numbers of least loss.

    Raises:
        NotConvergedError: If no step had a finite loss.
    """
    if descent.least == float("inf"):
        raise NotConvergedError("PIN-WM: no step has a finite loss.")
    descent.simulator.set_numbers(descent.best)
    every = record | descent.record() | {"parameters": descent.simulator.frictions()}
    return FittedPinWmItself(descent.simulator, splats, every)


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
        world = world_of_model(replace(model, file=model.file.model_copy(update={"contact": ContactParameters()})))
        index = world.body_names.index(OBJECT)
        state = self.simulator.local.state(*(values[0, index].numpy() for values in vars(start).values()))
        try:
            with torch.no_grad():
                motion = list(self.simulator.rollout(state, np.asarray(times_s), fingertip_of(drives)))
        except FAILURES as error:
            raise NotConvergedError(f"PIN-WM: {type(error).__name__}: {error}") from error
        poses = [self.simulator.local.body_pose(p.numpy().astype(float), q.numpy().astype(float)) for p, q in motion]
        position, quat = (np.array(values.numpy()) for values in kinematic_poses(world, drives, np.asarray(times_s)))
        position[:, index], quat[:, index] = np.stack([p for p, _ in poses]), np.stack([q for _, q in poses])
        return checked(position, quat)
