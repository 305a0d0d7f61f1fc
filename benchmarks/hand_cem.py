"""Cross-entropy method over MuJoCo for a cube in a LEAP hand, with the settings that judo-rai 0.1.0 has for it.

32 samples of 1 s of the scene in which judo plans (`xml/leap_cube.xml`, 10 ms), four nodes of a cubic spline, three
elites, noise that grows along the plan, and judo's cost; written anew. Compute is for free: a plan acts at once.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.pipeline.control.hand_controller import HandController
from cgwm.pipeline.control.hand_loop import goals_of, hand_errors, hand_start
from cgwm.pipeline.control.hand_objective import turn_to
from cgwm.pipeline.control.hand_plant import HandScenePlant, HandTruth
from cgwm.pipeline.control.horizon import Array
from scipy.interpolate import interp1d

mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs
SAMPLES, ELITES, NODES, HORIZON_S = 32, 3, 4, 1.0
SIGMA, RAMP = (0.1, 1.0), 4.0
"""Smallest and largest standard deviation [rad], and its growth along the plan."""
PLACE_WEIGHT, TURN_WEIGHT = 50.0, 0.05
"""Costs of squared errors of position [1/m2] and turn [1/rad2], as means over the plan."""


class Cem:
    """The planner.

    Args:
        scene: Folder of the scenes.
        joints: Names of the joints.
        home: Their targets before the first plan [rad].
        wanted_m: Where the cube is wanted [m].
        seed: Seed of the noise.
    """

    def __init__(self, scene: Path, joints: tuple[str, ...], home: Array, wanted_m: Array, seed: int) -> None:
        self.model = model = mujoco.MjModel.from_xml_path(str(scene / "xml" / "leap_cube.xml"))
        self.data = mujoco.MjData(model)
        numbers = [model.joint(name).id for name in joints]
        self.places, self.speeds = model.jnt_qposadr[numbers], model.jnt_dofadr[numbers]
        self.servos = [next(k for k in range(model.nu) if model.actuator_trnid[k, 0] == n) for n in numbers]
        joint = model.body_jntadr[model.body("cube").id]
        self.place, self.speed = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        self.lower, self.upper = model.actuator_ctrlrange[self.servos].T
        self.wanted_m, self.rng = wanted_m, np.random.default_rng([seed, 1])
        self.nodes_s = np.linspace(0, HORIZON_S, NODES)
        self.steps_s = (1 + np.arange(round(HORIZON_S / model.opt.timestep))) * model.opt.timestep
        self.sigma = np.full((NODES, len(joints)), 0.5 * sum(SIGMA))
        self.spline = _spline(self.nodes_s, np.tile(home, (NODES, 1)))

    def plan(self, now_s: float, truth: HandTruth, goal_wxyz: Array) -> None:
        """Make a plan from a state."""
        ramp = np.linspace(RAMP / NODES, RAMP, NODES)[:, None]
        self.sigma = np.clip(self.sigma * ramp, *SIGMA)
        mean = self.spline(now_s + self.nodes_s)
        noise = self.rng.normal(size=(SAMPLES - 1, *self.sigma.shape)) * self.sigma
        nodes = np.clip(np.concatenate((mean[None], mean + noise)), self.lower, self.upper)
        elites = nodes[self._costs(truth, nodes, goal_wxyz).argsort()[:ELITES]]
        self.sigma = np.clip(elites.std(0), *SIGMA)
        self.spline = _spline(now_s + self.nodes_s, elites.mean(0))

    def target(self, time_s: float) -> Array:
        """Return the targets of the joints at a time [rad]."""
        return np.clip(self.spline(time_s), self.lower, self.upper)

    def _costs(self, truth: HandTruth, nodes: Array, goal_wxyz: Array) -> Array:
        model, data = self.model, self.data
        commands = np.zeros((len(nodes), len(self.steps_s), model.nu))
        commands[:, :, self.servos] = np.stack([_spline(self.nodes_s, one)(self.steps_s) for one in nodes])
        data.qpos[:], data.qvel[:] = model.qpos0, 0
        data.qpos[self.places], data.qvel[self.speeds] = truth.joints_rad, truth.speeds_rad_s
        data.qpos[self.place : self.place + 7] = [*truth.position_m, *truth.quat_wxyz]
        data.qvel[self.speed : self.speed + 6] = [*truth.velocity_m_s, *truth.omega_body_rad_s]
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.zeros(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, start, kind)
        rollout = importlib.import_module("mujoco.rollout")
        states, _ = rollout.rollout(model, [data], np.repeat(start[None], len(nodes), 0), commands)
        pose = states[:, :, 1 + self.place : 8 + self.place]  # behind the time
        turn = turn_to(torch.as_tensor(pose[..., 3:].copy()), torch.as_tensor(goal_wxyz)).numpy()
        place = pose[..., :3] - self.wanted_m
        return PLACE_WEIGHT * (place**2).sum(-1).mean(-1) + TURN_WEIGHT * (turn**2).sum(-1).mean(-1)


def run_cem(controller: HandController, scene: Path, seed: int, most_s: float) -> tuple[str, int, float]:
    """Run the task of a controller by the planner; return why it ended, the goals reached and its time [s].

    Args:
        controller: Has the task and its rate.
        scene: Folder of the scenes.
        seed: Seed of the run.
        most_s: Time after which it ends [s].
    """
    task, plant, interval = controller.task, HandScenePlant(controller.hand), controller.interval_s
    truth, goals = plant.reset(*hand_start(task, seed)), goals_of(task, seed)
    planner = Cem(scene, controller.joints, controller.hand.home, np.array(task.wanted_m), seed)
    goal, count, since = next(goals), 0, 0.0
    for number in range(round(most_s / interval)):
        planner.plan(number * interval, truth, goal)
        pieces = round(interval / 0.01)
        for piece in range(1, pieces + 1):
            truth = plant.advance(planner.target((number + piece / pieces) * interval), interval / pieces)
        away, turn = hand_errors(task, truth, goal)
        since += interval
        if turn <= task.success.turn_deg:
            count, goal, since = count + 1, next(goals), 0.0
        if count >= task.success.goals or away > task.success.drop_m:
            return "success" if count >= task.success.goals else "dropped", count, (number + 1) * interval
        if since >= task.success.goal_s:
            break
    return "timeout", count, (number + 1) * interval


def _spline(times_s: Array, values: Array) -> Any:
    return interp1d(times_s, values, axis=0, kind="cubic", fill_value="extrapolate")  # pyright: ignore[reportArgumentType]
