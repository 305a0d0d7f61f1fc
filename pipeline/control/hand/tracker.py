"""What a hand's controller holds to be true: the object's state from noisy poses, and which draw of the model fits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...geometry.rotation import quat_exp, quat_multiply, quat_normalize, quat_turn
from ...physics.chains.joint_command import JointCommand
from ...physics.chains.state import joints_of, with_joints
from ...physics.engine import rollout
from ...physics.rollout import Rollout
from ...physics.state import State
from ..horizon import Array, Targets
from ..objective import Worlds
from ..planning import ControlState
from .world import HandWorld

MEMBERS = 32
"""States that stand for what noisy poses leave open; each is predicted from pose to pose."""
STEP_S = 0.004
"""Largest time step of these predictions, which are as short as a command [s]."""
DRIFT = (0.0035, math.radians(6.0))
"""Growth of a prediction's error of place [m] and turn [rad], per coordinate and root of a second: 0.5 mm and 0.8 deg
in 20 ms."""
FELT = (math.radians(0.4), 0.5)
"""Standard deviations of what such a prediction lacks of the joints [rad] and of their speeds [rad/s] at its end. They
are measured without noise, so that a finger that the object stops tells where that is."""
LEAST_NOISE = (1e-4, math.radians(0.1))
"""Smallest standard deviations of place [m] and turn [rad] that poses are filtered with: one of them may be exact."""
LONGEST_S = 0.25
"""Time without a state after which the next one is believed as it is [s]."""
WINDOW_S = 0.2
"""Time over which draws are compared: in a single command the motion under twice the friction differs by less than
what no draw predicts, in this time by several times as much [s]."""
DEGREES, MEMORY_S = 4.0, 12.0
"""Of the agreement of draws: degrees of freedom of Student's distribution of errors, which are not normal where
contacts slip, and memory [s]."""
SURE = 2.0
"""Number of standard errors of a draw's lead over the estimate that are taken off. Without, frictions far from the true
one are planned with by chance: on an Allegro hand under noise, factors below 0.6 or above 1.6 in 72 % of the time."""

VELOCITIES = ("velocity_m_s", "omega_body_rad_s")


@dataclass(frozen=True)
class _Ensemble:
    """States of the object at a time, all alike probable, with the joints."""

    time_s: float
    position_m: Tensor
    quat_wxyz: Tensor
    velocity_m_s: Tensor
    omega_body_rad_s: Tensor
    joints: Mapping[str, float]
    speeds: Mapping[str, float]

    @property
    def motion(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The states."""
        return self.position_m, self.quat_wxyz, self.velocity_m_s, self.omega_body_rad_s

    @property
    def mean(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Their mean, shape (1, ...)."""
        sides = torch.sign((self.quat_wxyz * self.quat_wxyz[:1]).sum(-1, keepdim=True))
        turn = quat_normalize((sides * self.quat_wxyz).mean(0, keepdim=True))
        place, velocity, omega = (
            part.mean(0, keepdim=True) for part in (self.position_m, self.velocity_m_s, self.omega_body_rad_s)
        )
        return place, turn, velocity, omega


@dataclass(frozen=True)
class _Trial:
    """Where each draw has the object now, predicted from a time on."""

    since_s: float
    motion: tuple[Tensor, ...]


class HandTracker:
    """Follows the object from state to state, by the commands that were sent.

    Noisy poses are filtered by an ensemble Kalman filter (Evensen, "Sequential data assimilation with a nonlinear
    quasi-geostrophic model", 1994): some states are predicted by the model, so that contacts keep them out of the
    fingers, whose joints are known, and say how pose, velocities and the joints that the object stops vary together.
    Where there are several draws of the model, each predicts the motion over pieces of `WINDOW_S`. The first, the
    estimate, is used for the filter and for plans until another one predicted better by more than chance, by the
    scatter of their differences between pieces.

    Args:
        hand: The task.
        worlds: The worlds of the predictions.
    """

    def __init__(self, hand: HandWorld, worlds: Worlds) -> None:
        sensing = hand.task.sensing
        self._hand, self._worlds = hand, worlds
        noise = np.array([sensing.noise_m, math.radians(sensing.noise_deg)])
        self._noise = np.maximum(noise, LEAST_NOISE) if noise.any() else noise
        self.restart(0)

    def restart(self, seed: int) -> None:
        """Forget everything, and begin with a seed."""
        self._rng = np.random.default_rng([seed, 5])
        self._known: _Ensemble | None = None
        self._trial: _Trial | None = None
        self._behind, self._scatter = np.zeros((2, self._worlds.draws))

    @property
    def draw(self) -> int:
        """The draw whose predictions were surely the best; the first one where none was surely better."""
        return int((self._behind + SURE * np.sqrt(self._scatter)).argmin())

    def update(self, state: ControlState, sent: Targets | None) -> State:
        """Return the state (1, nb, ...) that is held to be true, for rollouts, which place the links.

        Args:
            state: The measured state.
            sent: The targets that the joints had since the state before; None where they are unknown.
        """
        if not (self._noise.any() or self._worlds.draws > 1 or state.velocity_m_s is None or
                state.omega_body_rad_s is None):  # fmt: skip
            self._known = None
            quat = np.asarray(state.quat_wxyz, float) / np.linalg.norm(state.quat_wxyz)
            given = state.velocity_m_s, state.omega_body_rad_s, state.joint_speeds
            return self._hand.state(state.position_m, quat, state.joints, *given, placed=False)
        before, found = self._known, self._measured(state)
        gone = math.inf if before is None else state.time_s - before.time_s
        if before is not None and sent is not None and 0 < gone <= LONGEST_S:
            found = self._corrected(before, found, state, sent)
        else:
            self._trial = None
        self._known = found
        place, turn, velocity, omega = (part[0].numpy() for part in found.mean)
        return self._hand.state(place, turn, found.joints, velocity, omega, found.speeds, placed=False)

    def _measured(self, state: ControlState) -> _Ensemble:
        """Return states that a measured one alone leaves open; velocities that are not known are 0."""
        count = MEMBERS if self._noise.any() else 1
        (place, turn), zero = _pose(state), np.zeros(3)
        velocity, omega = (
            torch.as_tensor(np.asarray(zero if part is None else part, float)).expand(count, 3)
            for part in (state.velocity_m_s, state.omega_body_rad_s)
        )
        position, quat = self._shaken(place.expand(count, 3), turn.expand(count, 4), self._noise)
        return _Ensemble(
            state.time_s, position, quat, velocity, omega, dict(state.joints), dict(state.joint_speeds or {})
        )

    def _shaken(self, position: Tensor, quat: Tensor, size: np.ndarray) -> tuple[Tensor, Tensor]:
        """Return poses with errors of a size [m, rad] per coordinate; of one state alone none."""
        if len(position) == 1:
            return position, quat
        place, turn = (torch.as_tensor(each * self._rng.normal(size=position.shape)) for each in size)
        return position + place, quat_multiply(quat, quat_exp(turn))

    def _corrected(self, before: _Ensemble, measured: _Ensemble, state: ControlState, sent: Targets) -> _Ensemble:
        """Return the states after a prediction from those before and a measured pose."""
        gone = state.time_s - before.time_s
        position, quat = self._shaken(*before.motion[:2], math.sqrt(gone) * np.array(DRIFT))
        found, felt = self._predicted(replace(before, position_m=position, quat_wxyz=quat), state, sent)
        seen = _pose(state)
        found = _followed(found, *seen, gone) if len(position) == 1 else self._filtered(found, felt, *seen)
        given = {name: getattr(measured, name) for name in VELOCITIES if getattr(state, name) is not None}
        return replace(found, joints=measured.joints, speeds=measured.speeds, time_s=state.time_s, **given)

    @torch.no_grad()
    def ahead(self, believed: State, sent: Targets) -> State:
        """Return a state (1, nb, ...) after further targets, predicted in the steps of the filter, with all links."""
        times = torch.as_tensor(sent.times_s - sent.times_s[0])
        rows = (self.draw,) if self._worlds.draws > 1 else ()
        motion = rollout(self._worlds.batch(rows), believed, times[[0, -1]], self._commanded(times, sent))
        return _end_of(motion)

    def _commanded(self, times_s: Tensor, sent: Targets) -> dict[str, JointCommand]:
        return {self._hand.chain.name: JointCommand.targets(times_s[None], torch.as_tensor(sent.values_m)[None])}

    @torch.no_grad()
    def _predicted(self, known: _Ensemble, state: ControlState, sent: Targets) -> tuple[_Ensemble, Array]:
        """Return the states after the targets, under the best draw; count how well each draw predicts the mean.

        Also returns how far the measured joints and speeds are from predicted ones, in units of `FELT`, shape (states,
        joints and speeds); of one state alone none.
        """
        count, draws, thing = len(known.position_m), self._worlds.draws, self._hand.object
        rows = (self.draw,) * count + tuple(range(draws)) if draws > 1 else ()
        trial = self._trial or _Trial(known.time_s, tuple(mean.expand(draws, -1) for mean in known.mean))
        parts = [torch.cat((part, tried)) if draws > 1 else part
                 for part, tried in zip(known.motion, trial.motion, strict=True)]  # fmt: skip
        base = self._hand.state(parts[0][0], parts[1][0], {}, placed=False)
        start = State(*(part.expand(len(parts[0]), *part.shape[1:]).clone() for part in base.tensors))
        for whole, part in zip(start.tensors, parts, strict=True):
            whole[:, thing] = part
        start = with_joints(self._hand.world, start, known.joints, known.speeds, placed=False)
        times = torch.as_tensor(sent.times_s - sent.times_s[0])
        motion = rollout(self._worlds.batch(rows), start, times[[0, -1]], self._commanded(times, sent))
        end = _end_of(motion)
        position, quat, velocity, omega = (part[:, thing] for part in end.tensors)
        if draws > 1:
            self._tried(replace(trial, motion=tuple(part[count:, thing] for part in end.tensors)), state)
        felt = self._felt(State(*(part[:count] for part in end.tensors)), state) if count > 1 else np.zeros((count, 0))
        return replace(known, position_m=position[:count], quat_wxyz=quat[:count], velocity_m_s=velocity[:count],
                       omega_body_rad_s=omega[:count]), felt  # fmt: skip

    def _felt(self, end: State, state: ControlState) -> Array:
        """Return how far the measured joints are from those of predicted states, see `_predicted`."""
        found = joints_of(self._hand.world, end, self._hand.chain, exact=False)
        away = [
            (torch.tensor([given[name] for name in self._hand.joints]) - part) / size
            for given, part, size in zip((state.joints, state.joint_speeds), found, FELT, strict=True)
            if given is not None
        ]
        return torch.cat(away, -1).numpy()

    def _filtered(self, found: _Ensemble, felt: Array, position_m: Tensor, quat_wxyz: Tensor) -> _Ensemble:
        """Return predicted states after a measured pose (1, ...) and joints, by the gains of the ensemble's covariance.

        All measurements are in units of their standard deviations.
        """
        middle = found.mean[1]
        rows = torch.cat((found.position_m, quat_turn(middle, found.quat_wxyz), found.velocity_m_s,
                          found.omega_body_rad_s), -1).numpy()  # fmt: skip
        seen = torch.cat((position_m, quat_turn(middle, quat_wxyz)), -1).numpy()
        away = np.concatenate(((seen - rows[:, :6]) / np.repeat(self._noise, 3), felt), -1)
        covariance, size = np.cov(np.concatenate((rows, -away), -1).T), rows.shape[1]
        gain = np.linalg.solve(covariance[size:, size:] + np.eye(away.shape[1]), covariance[size:, :size]).T
        errors = self._rng.normal(size=away.shape)
        rows = torch.as_tensor(rows + (away + errors - errors.mean(0)) @ gain.T)
        quat = quat_multiply(middle.expand(len(rows), 4), quat_exp(rows[:, 3:6]))
        return replace(
            found, position_m=rows[:, :3], quat_wxyz=quat, velocity_m_s=rows[:, 6:9], omega_body_rad_s=rows[:, 9:]
        )

    def _tried(self, trial: _Trial, state: ControlState) -> None:
        """Carry the predictions of the draws on; at the end of a piece, count how well each predicted the pose."""
        gone_s = state.time_s - trial.since_s
        over = gone_s >= WINDOW_S - 1e-9
        self._trial = None if over else trial
        if over:
            self._weigh(trial, state, gone_s)

    def _weigh(self, trial: _Trial, state: ControlState, gone_s: float) -> None:
        """Count how well each draw predicted a pose."""
        size2 = self._noise**2 + np.square(DRIFT) * gone_s
        place, aim = _pose(state)
        away, turn = trial.motion[0] - place, quat_turn(trial.motion[1], aim)
        square = (away.square().sum(-1) / size2[0] + turn.square().sum(-1) / size2[1]).numpy()
        each = 0.5 * (DEGREES + 6) * np.log1p(np.nan_to_num(square, nan=1e6) / DEGREES)
        kept, behind = math.exp(-gone_s / MEMORY_S), each - each[0]
        self._behind = self._behind * kept + behind
        self._scatter = self._scatter * kept**2 + behind**2


def _end_of(motion: Rollout) -> State:
    """Return the last state of a motion."""
    every = (motion.position_m, motion.quat_wxyz, motion.velocity_m_s, motion.omega_body_rad_s)
    return State(*(part[:, -1] for part in every))


def _pose(state: ControlState) -> tuple[Tensor, Tensor]:
    """Return the measured pose, shapes (1, 3) [m] and (1, 4)."""
    place, turn = (torch.as_tensor(np.asarray(part, float))[None] for part in (state.position_m, state.quat_wxyz))
    return place, quat_normalize(turn)


def _followed(found: _Ensemble, position_m: Tensor, quat_wxyz: Tensor, gone_s: float) -> _Ensemble:
    """Return one predicted state after an exact pose (1, ...), which corrects its velocities, too."""
    return replace(
        found,
        position_m=position_m,
        quat_wxyz=quat_wxyz,
        velocity_m_s=found.velocity_m_s + (position_m - found.position_m) / gone_s,
        omega_body_rad_s=found.omega_body_rad_s + quat_turn(found.quat_wxyz, quat_wxyz) / gone_s,
    )
