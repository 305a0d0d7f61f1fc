"""Cross-entropy method over MuJoCo for a cube in a LEAP hand, with the settings that judo-rai 0.1.0 has for it.

32 samples of 1 s of the scene in which judo plans (`xml/leap_cube.xml`, 10 ms), four nodes of a cubic spline, three
elites, noise that grows along the plan, and judo's cost; written anew. It is a controller like that of cgwm, so that
one loop drives both: commands of 10 ms, without limits of speed, and a plan as often as the task has commands.
"""

from __future__ import annotations

import importlib
import math
import time
from typing import Any

import numpy as np
import torch
from cgwm.datasets.models.model import Model
from cgwm.pipeline.control.hand.controller import HandController
from cgwm.pipeline.control.horizon import Array, Forecast, Targets
from cgwm.pipeline.control.planning import ControlPlan, ControlState
from cgwm.pipeline.geometry.rotation import quat_turn
from cgwm.schemas import HandTask
from scipy.interpolate import interp1d

mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs
SAMPLES, ELITES, NODES, HORIZON_S = 32, 3, 4, 1.0
SIGMA, RAMP = (0.1, 1.0), 4.0
"""Smallest and largest standard deviation [rad], and its growth along the plan."""
PIECE_S = 0.01
"""Length of commands, and of the steps of predictions [s]."""
NODES_S = np.linspace(0, HORIZON_S, NODES)
STEPS_S = PIECE_S * (1 + np.arange(round(HORIZON_S / PIECE_S), dtype=float))
PLACE_WEIGHT, TURN_WEIGHT = 50.0, 0.05
"""Costs of squared errors of position [1/m2] and turn [1/rad2], as means over the plan."""


class CemController(HandController):
    """The planner as a controller.

    Args:
        model: The object.
        task: The task, whose plant is one of judo's scenes; `control_hz` is the rate of plans.
    """

    def __init__(self, model: Model, task: HandTask) -> None:
        super().__init__(model, task)
        self.every_s, self.interval_s = self.interval_s, PIECE_S
        self.scene = scene = mujoco.MjModel.from_xml_path(str(task.folder / "xml" / "leap_cube.xml"))
        self.data = mujoco.MjData(scene)
        numbers = [scene.joint(name).id for name in self.joints]
        self.places, self.speeds = scene.jnt_qposadr[numbers], scene.jnt_dofadr[numbers]
        self.servos = [next(k for k in range(scene.nu) if scene.actuator_trnid[k, 0] == n) for n in numbers]
        joint = scene.body_jntadr[scene.body("cube").id]
        self.place, self.speed = scene.jnt_qposadr[joint], scene.jnt_dofadr[joint]
        self.lower, self.upper = scene.actuator_ctrlrange[self.servos].T

    def restart(self, seed: int) -> None:
        """See :class:`HandController`."""
        super().restart(seed)
        self.sigma = np.full((NODES, len(self.joints)), 0.5 * sum(SIGMA))
        self.spline = _spline(NODES_S, np.tile(self.hand.home, (NODES, 1)))

    def limits(self, joint: str) -> tuple[float, float, float]:
        """See :class:`HandController`; commands have no limit of speed."""
        return *super().limits(joint)[:2], math.inf

    def plan(self, state: ControlState | None, acts_s: float | None = None) -> ControlPlan | None:
        """Return a plan from a state; None where the next one is not due, so that the one before goes on."""
        if state is None or (self._plan and state.time_s < self._plan.state_s + self.every_s - 1e-9):
            return None
        wall, cpu = time.perf_counter(), time.process_time()
        acts = max(state.time_s, acts_s or 0.0)
        cost = self._search(state, acts)
        times = acts + PIECE_S * np.arange(len(STEPS_S) + 1, dtype=float)
        targets = Targets(times_s=times, values_m=np.clip(self.spline(times), self.lower, self.upper))
        self._plan = ControlPlan(
            state_s=state.time_s, acts_s=acts, targets=targets, cost=cost,
            wall_s=time.perf_counter() - wall, cpu_s=time.process_time() - cpu,
        )  # fmt: skip
        return self._plan

    def forecast(self) -> Forecast:
        """Return what the best sample of the last plan does."""
        return self.best

    def _search(self, state: ControlState, acts_s: float) -> float:
        """Make a plan, and return the cost of the best sample."""
        self.sigma = np.clip(self.sigma * np.linspace(RAMP / NODES, RAMP, NODES)[:, None], *SIGMA)
        mean = self.spline(acts_s + NODES_S)
        noise = self._rng.normal(size=(SAMPLES - 1, *self.sigma.shape)) * self.sigma
        nodes = np.clip(np.concatenate((mean[None], mean + noise)), self.lower, self.upper)
        pose = self._predicted(state, nodes)
        turn = quat_turn(torch.as_tensor(self.goal_wxyz), torch.as_tensor(pose[..., 3:].copy())).numpy()
        place = pose[..., :3] - np.array(self.task.wanted_m)
        costs = PLACE_WEIGHT * (place**2).sum(-1).mean(-1) + TURN_WEIGHT * (turn**2).sum(-1).mean(-1)
        elites = costs.argsort()[:ELITES]
        self.sigma = np.clip(nodes[elites].std(0), *SIGMA)
        self.spline = _spline(acts_s + NODES_S, nodes[elites].mean(0))
        best = pose[elites[0]]
        self.best = Forecast(times_s=acts_s + STEPS_S, position_m=best[:, :3], quat_wxyz=best[:, 3:])
        return float(costs[elites[0]])

    def _predicted(self, state: ControlState, nodes: Array) -> Array:
        """Return the poses (samples, steps, 7) of the cube."""
        scene, data = self.scene, self.data
        commands = np.zeros((len(nodes), len(STEPS_S), scene.nu))
        commands[:, :, self.servos] = np.stack([_spline(NODES_S, one)(STEPS_S) for one in nodes])
        data.qpos[:], data.qvel[:] = scene.qpos0, 0
        data.qpos[self.places] = [state.joints[name] for name in self.joints]
        data.qvel[self.speeds] = [(state.joint_speeds or {})[name] for name in self.joints]
        data.qpos[self.place : self.place + 7] = np.concatenate((state.position_m, state.quat_wxyz))
        moving = (state.velocity_m_s, state.omega_body_rad_s)
        data.qvel[self.speed : self.speed + 6] = np.concatenate([x for x in moving if x is not None])
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.zeros(mujoco.mj_stateSize(scene, kind))
        mujoco.mj_getState(scene, data, start, kind)
        rollout = importlib.import_module("mujoco.rollout")
        states, _ = rollout.rollout(scene, [data], np.repeat(start[None], len(nodes), 0), commands)
        return states[:, :, 1 + self.place : 8 + self.place]  # behind the time


def _spline(times_s: Array, values: Array) -> Any:
    return interp1d(times_s, values, axis=0, kind="cubic", fill_value="extrapolate")  # pyright: ignore[reportArgumentType]
