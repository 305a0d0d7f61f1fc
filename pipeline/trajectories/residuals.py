"""Residuals of rollouts against measured motion, in units of the measurement noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..geometry.rotation import quat_exp, quat_multiply, quat_turn
from ..optimization.forward_mode import batched_jacobian
from ..physics.chains.state import on_joints
from ..physics.engine import length_groups, ragged_rollout
from ..physics.observation_model import measure
from ..physics.parameters import Parameter, apply_parameters
from ..physics.rollout import Rollout
from ..physics.state import State
from ..physics.world import World
from .observations import Observations

STATE_SIZE = 12
"""Coordinates of a free body's state: position [m], rotation [rad] (body), velocity [m/s], omega_body [rad/s]."""
STATE_STEPS = (2e-4, 2e-3, 5e-3, 5e-2)
"""Difference steps in position [m], rotation [rad], velocity [m/s] and omega [rad/s], where differences replace
derivatives."""
SMOOTH_STEPS = (1e-6, 1e-6, 1e-6, 1e-5)
"""The same where motion is smooth: one side of such a step is closer to the derivative than both of the larger ones."""
SPIN_STD_RAD_S = 0.5
"""Standard deviation [rad/s] of a measured spin, where the orientation was not measured."""
STATE_PRIOR_STD = (0.1, 1.0, 5.0, 30.0)
"""Standard deviations of the weak prior on these coordinates about the first guess; it fixes what was not measured."""


def state_prior(bodies: int) -> Tensor:
    """Return the information of the prior on a state change, shape (12 bodies,)."""
    return torch.tensor([1 / std**2 for std in STATE_PRIOR_STD for _ in range(3)], dtype=torch.float64).repeat(bodies)


def retract(state: State, change: Tensor, free: Sequence[int]) -> State:
    """Return the states (B, nb) moved by changes (B, 12 nf) of the free bodies, rotations in the body frame."""
    position, quat = list(state.position_m.unbind(1)), list(state.quat_wxyz.unbind(1))
    velocity, omega = list(state.velocity_m_s.unbind(1)), list(state.omega_body_rad_s.unbind(1))
    for column, body in enumerate(free):
        dp, dr, dv, dw = change[:, STATE_SIZE * column : STATE_SIZE * (column + 1)].split(3, -1)
        position[body] = position[body] + dp
        quat[body] = quat_multiply(quat[body], quat_exp(dr))
        velocity[body], omega[body] = velocity[body] + dv, omega[body] + dw
    return State(*(torch.stack(values, 1) for values in (position, quat, velocity, omega)))


@dataclass(frozen=True)
class TrajectoryResiduals:
    """Residuals of an open-loop rollout from every item's state, as `levenberg_marquardt.minimise` takes them.

    Rows are (frame, free body); their six columns are position and rotation, in sigmas.
    """

    world: World
    """The world in which the items move."""
    parameters: Sequence[Parameter]
    """Parameters of the world that are varied (P)."""
    observations: Observations
    """The measured motion (B)."""
    position_std_m: float | Tensor
    """Standard deviation of positions [m], or one for every row, shape (B, F, 1)."""
    rotation_std_rad: float | Tensor
    """Standard deviation of rotations [rad], or one for every row, shape (B, F, 1)."""
    differences: bool = False
    """Whether the Jacobian is that of differences over `STATE_STEPS`: exact derivatives of a body that rests on many
    spheres grow by a third in every step of 1 ms, and are useless."""
    smooth: bool = False
    """With `differences`, whether motion is smooth: states are moved up only, by `SMOOTH_STEPS`, in half the time."""
    parameter_steps: Sequence[tuple[float, float]] = ()
    """With `differences`, how far down and how far up each parameter is moved, in fitted coordinates; 0 leaves that
    side out."""

    def __call__(self, shared: Tensor, states: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor | None]:
        """Return residuals (B, F, 6) and, if wanted, their Jacobian (B, F, 6, P + S)."""
        inputs = torch.cat((shared.expand(states.shape[0], -1), states), -1)
        if not with_jacobian:
            with torch.no_grad():
                return self._residuals(inputs, 1).unflatten(1, (-1, 6)), None
        value, jacobian = (self._differenced if self.differences else self._exact)(inputs)
        return value.unflatten(1, (-1, 6)), jacobian.unflatten(1, (-1, 6))

    def _exact(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (B, m) and their exact derivatives (B, m, P + S)."""
        return batched_jacobian(self._residuals, inputs)

    def _differenced(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (B, m) and their differences (B, m, P + S) by the inputs (B, P + S)."""
        batch, size = inputs.shape
        states = (size - len(self.parameters)) // STATE_SIZE
        pairs = [(0.0, step) for step in SMOOTH_STEPS] if self.smooth else [(step, step) for step in STATE_STEPS]
        own = [pair for pair in pairs for _ in range(3)] * states
        down, up = torch.tensor([*self.parameter_steps, *own]).to(inputs).T
        below, above = (down > 0).nonzero()[:, 0], (up > 0).nonzero()[:, 0]
        moves = torch.cat([torch.zeros(1, size).to(inputs), torch.diag(up)[above], -torch.diag(down)[below]])
        with torch.no_grad():
            rows = self._residuals((inputs + moves[:, None]).flatten(0, 1), len(moves)).unflatten(0, (-1, batch))
        ends = rows[:1].expand(size, -1, -1)
        high = (
            rows[1:] if len(above) == size and not len(below) else ends.index_copy(0, above, rows[1 : 1 + len(above)])
        )
        low = ends.index_copy(0, below, rows[1 + len(above) :]) if len(below) else rows[:1]
        slopes = (high - low) / (down + up)[:, None, None]
        return rows[0], torch.nan_to_num(slopes, posinf=0.0, neginf=0.0).movedim(0, -1)

    def varied(self, values: Tensor, states: Tensor) -> Tensor:
        """Return residuals (K, B, F, 6) of K variations of each item: values (K, B, P), changes of states (K, B, S)."""
        inputs = torch.cat((values, states), -1)
        with torch.no_grad():
            rows = self._residuals(inputs.flatten(0, 1), len(inputs))
        return rows.unflatten(0, (len(inputs), -1)).unflatten(-1, (-1, 6))

    def rollout(self, shared: Tensor, states: Tensor) -> Rollout:
        """Return the rollout of given parameters (P,) and state changes (B, S)."""
        with torch.no_grad():
            return self._roll(torch.cat((shared.expand(states.shape[0], -1), states), -1), 1)

    def _roll(self, inputs: Tensor, repeats: int) -> Rollout:
        """Return the rollout, as measured, of inputs (repeats * B, P + S): parameters, then state changes."""
        every, seen = inputs.unflatten(0, (repeats, -1)), self.observations

        def roll(items: list[int], frames: int) -> Rollout:
            some = replace(self, observations=seen if len(items) == len(seen.names) else seen.select(items))
            return some._roll_together(every[:, items].flatten(0, 1), repeats, frames)

        return ragged_rollout(seen.times_s.repeat(repeats, 1), seen.ends.tolist(), repeats, roll)

    def _roll_together(self, inputs: Tensor, repeats: int, frames: int) -> Rollout:
        """Return the first frames of the rollout, as measured, of inputs (repeats * B, P + S)."""
        count = len(self.parameters)
        values = [p.decode(inputs[:, k]) for k, p in enumerate(self.parameters)]
        seen = self.observations
        world = seen.world(self.world, repeats)
        if count:
            world = apply_parameters(world, self.parameters, torch.stack(values, -1))
        state = on_joints(world, retract(seen.state.repeat(repeats), inputs[:, count:], seen.free))
        drives = {name: drive.repeat(repeats) for name, drive in seen.drives.items()}
        return measure(world, state, seen.times_s[:, :frames], drives)

    def _residuals(self, inputs: Tensor, repeats: int) -> Tensor:
        """Return the flat residuals (repeats * B, F * 6) of inputs (repeats * B, P + S).

        Items are rolled out up to their last measured frame; the residuals of later frames are 0.
        """
        seen, bodies = self.observations, len(self.observations.free)
        batch, frames = seen.times_s.shape
        groups = length_groups(seen.ends.tolist(), repeats)
        if len(groups) == 1:
            return self._rows(inputs, repeats, frames).flatten(1)
        every, parts = inputs.unflatten(0, (repeats, batch)), []
        for items, ends in groups:
            own = {name: _some(getattr(self, name), items) for name in ("position_std_m", "rotation_std_rad")}
            rows = replace(self, observations=seen.select(items), **own)._rows(
                every[:, items].flatten(0, 1), repeats, ends
            )
            parts.append(torch.nn.functional.pad(rows, (0, 0, 0, (frames - ends) * bodies)).unflatten(0, (repeats, -1)))
        back = torch.cat([torch.tensor(items) for items, _ in groups]).argsort()
        return torch.cat(parts, 1)[:, back].flatten(0, 1).flatten(1)

    def _rows(self, inputs: Tensor, repeats: int, frames: int) -> Tensor:
        """Return the residuals (repeats * B, frames * nf, 6) of the first frames."""
        rollout, seen, free = self._roll_together(inputs, repeats, frames), self.observations, self.observations.free
        bodies = slice(None) if free == tuple(range(len(self.world.bodies))) else list(free)
        position, quat = (x[:, :, bodies].unflatten(0, (repeats, -1)) for x in (rollout.position_m, rollout.quat_wxyz))
        moved = self._weighted(position - seen.position_m[:, :frames], seen.seen, self.position_std_m)
        if bool(seen.has_orientation[:, :frames].any()):
            turn = quat_turn(seen.quat_wxyz[:, :frames], quat)
            turned = self._weighted(turn, seen.has_orientation, self.rotation_std_rad)
        else:
            turned = torch.zeros_like(moved)
        if seen.first_spin is not None:
            first = turned[:, : len(free)] + self._spin_residuals(inputs, *seen.first_spin, repeats)
            turned = torch.cat((first, turned[:, len(free) :]), 1)
        return torch.cat((moved, turned), -1)

    def _weighted(self, away: Tensor, mask: Tensor, std: float | Tensor) -> Tensor:
        """Return differences (repeats, B, F, nf, 3) over their standard deviations, shape (repeats * B, F nf, 3)."""
        weight = mask.flatten(1)[..., None] / std
        return (away.flatten(2, 3) * weight[:, : away.shape[2] * away.shape[3]]).flatten(0, 1)

    def _spin_residuals(self, inputs: Tensor, spin: Tensor, known: Tensor, repeats: int) -> Tensor:
        """Return the residuals (repeats * B, nf, 3) of measured initial spins, in sigmas; 0 where there is none.

        They take the place of the rotation of the first frame, which was not measured.
        """
        free = self.observations.free
        change = inputs[:, len(self.parameters) :].unflatten(1, (len(free), STATE_SIZE))[..., 9:]
        away = self.observations.state.omega_body_rad_s[:, list(free)] - spin
        weight = known[..., None].to(spin) / SPIN_STD_RAD_S
        return (away.repeat(repeats, 1, 1) + change) * weight.repeat(repeats, 1, 1)


def _some(std: float | Tensor, items: list[int]) -> float | Tensor:
    """Return the standard deviations of some items."""
    return std[items] if isinstance(std, Tensor) and std.ndim > 0 else std
