"""DreamerV3's own code as a row: its world model learns the object's motions, and imagines those of the test.

A world model of this kind needs many episodes. It is given what the lookalike's better row is: 100 true trajectories of
the true object with the true contact numbers, by MuJoCo, filmed by the splats, and the true state in each frame. It
predicts from the true state and the rendered picture of a test's first frame: the mean of 16 imaginations.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from cgwm.datasets.synthetic.objects import SolidObject
from contenders.base import Cell
from contenders.latent import Cameras, FittedLatent, frame_s, simulated
from contenders.latent_model import LENGTH_M, SPEED_M_S, SPIN_RAD_S, Sequences
from contenders.training import open_training
from torch import Tensor

from .dreamer_agent import Agent, Arrays
from .source import source

TRAJECTORIES, DRAWS = 100, 16
FREE_S = 1800.0
"""Without a budget it learns for so long."""
REACH_M = 0.5
"""Unit of the fingertip's place: its actions lie within -1 and 1."""


@dataclass(frozen=True)
class DreamerV3:
    """The rival, from the folder that `CGWM_DREAMERV3` names.

    solid: reads the true solid of a capture; size: one of its own sizes.
    """

    name: str
    solid: Callable[[Path], SolidObject]
    size: str = "size12m"
    trajectories: int = TRAJECTORIES

    def fit(self, cell: Cell, budget_s: float | None) -> FittedLatent:
        """Learn for the budget; trajectories are given, and the compilation of its code is not counted.

        Raises:
            UsageError: If its code is not there.
        """
        folder = source("CGWM_DREAMERV3")
        training = open_training(cell)
        cameras = Cameras.of(training, cell)
        data = observed(simulated(training, cameras, cell, self.solid(cell.capture), self.trajectories))
        begun = time.perf_counter()
        agent = Agent(folder, data, self.size, cell.device, cell.seed)
        agent.train(0.0)
        compiled = time.perf_counter()
        losses = agent.train(FREE_S if budget_s is None else budget_s)
        record = {
            "seconds": round(time.perf_counter() - compiled, 1),
            "seconds_by_step": {"compilation": round(compiled - begun, 1)},
            "evaluations": agent.steps,
            "weights": agent.size(),
            "loss": {name: round(value, 3) for name, value in losses.items()},
            "parameters": {},
        }
        length = data["image"].shape[1]
        return FittedLatent(partial(ahead, agent, length), training.world, cameras, frame_s(training), record)


def observed(data: Sequences) -> Arrays:
    """Return sequences (S, T, ...) as the agent observes them, positions and velocities in the lookalike's units."""
    frames = data.position_m.shape[:2]
    parts = (
        data.position_m / LENGTH_M,
        data.rotation.flatten(2),
        data.velocity_m_s / SPEED_M_S,
        data.omega_world_rad_s / SPIN_RAD_S,
    )
    tip = data.driven_m.flatten(2) / REACH_M
    action = torch.cat((tip, torch.cat((tip[:, 1:], tip[:, -1:]), 1)), -1)
    if not tip.shape[-1]:
        action = torch.zeros(*frames, 1)  # nothing is done; it must have an action
    first, last = np.zeros(frames, bool), np.zeros(frames, bool)
    first[:, 0], last[:, -1] = True, True
    return {
        "image": (data.images.permute(0, 1, 3, 4, 2) * 255).round().to(torch.uint8).cpu().numpy(),
        "state": torch.cat(parts, -1).float().cpu().numpy(),
        "action": action.clamp(-1, 1).float().cpu().numpy(),
        "reward": np.zeros(frames, np.float32),
        "is_first": first,
        "is_last": last,
        "is_terminal": np.zeros(frames, bool),
    }


def ahead(agent: Agent, length: int, data: Sequences) -> tuple[Tensor, Tensor, Tensor]:
    """Return position (1, T, 3), rotation (1, T, 3, 3) and images (1, T, C, H, W) of what follows a first frame.

    Args:
        agent: The agent.
        length: Frames of the sequences that it learned from.
        data: One sequence, at most as long.
    """
    frames = data.position_m.shape[1]
    first = torch.zeros(1, dtype=torch.long, device=data.position_m.device)
    one = observed(data.chunk(first, first, length))  # the last frame is repeated
    state, image = agent.imagine(one, DRAWS)
    mean = torch.as_tensor(state[:, :frames].mean(0), dtype=torch.float64)
    u, _, vt = torch.linalg.svd(mean[:, 3:12].unflatten(-1, (3, 3)))
    sign = torch.ones(frames, 1, 3, dtype=torch.float64)
    sign[:, 0, 2] = torch.linalg.det(u @ vt)
    pictures = torch.as_tensor(image[None, :frames]).permute(0, 1, 4, 2, 3)
    return LENGTH_M * mean[None, :, :3], (u * sign @ vt)[None], pictures
