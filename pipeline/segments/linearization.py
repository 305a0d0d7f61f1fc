"""The linear picture of every segment: information and score of parameters, the segment's own state projected out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..estimation.trajectory import state_prior
from ..physics.parameters import Parameter
from .segments import Segments

ROBUST_EXCESS = 20.0
"""k of rho(e) = 2 k log(1 + e / 2k) for the excess e = chi2 - dof of a contact segment: what the contact law misses of
an impact is one error, not one in each frame (study of diagnosis, section 3)."""


@dataclass(frozen=True)
class Linear:
    """Segments linearised at their states and at given values of the parameters.

    information (B, P, P) and score (B, P): M_i = Jp'Jp - B_i' A_i^-1 B_i and g_i = -(Jp'r - B_i' A_i^-1 Jx'r) of the
    parameters, in fitted coordinates; state_step (B, S) and by_parameter (B, S, P): the states that go with a change d
    of the parameters move by state_step - by_parameter d; chi2 (B,); dof (B,).
    """

    information: Tensor
    score: Tensor
    state_step: Tensor
    by_parameter: Tensor
    chi2: Tensor
    dof: Tensor

    @property
    def weight(self) -> Tensor:
        """The robust weight (B,) of each segment."""
        return robust_excess(self.chi2 - self.dof)[1]


def linearised(segments: Segments, parameters: Sequence[Parameter], values: Tensor) -> Linear:
    """Return the linear picture of segments; values (P,) or (B, P) in fitted coordinates."""
    rows, jacobian = segments.residuals(parameters, values)
    assert jacobian is not None
    return projected(segments, rows, jacobian, len(parameters))


def projected(segments: Segments, rows: Tensor, jacobian: Tensor, count: int) -> Linear:
    """Return the linear picture from residuals (B, F, 6) and their Jacobian (B, F, 6, P + S), with P = count."""
    error = torch.nan_to_num(rows.flatten(1), posinf=0.0, neginf=0.0)
    flat = torch.nan_to_num(jacobian.flatten(1, 2), posinf=0.0, neginf=0.0)
    by_value, by_state = flat[..., :count], flat[..., count:]
    prior = torch.diag(state_prior(len(segments.observations.free))).to(error)
    states = by_state.transpose(1, 2) @ by_state + prior
    mixed = by_state.transpose(1, 2) @ by_value
    slope = (by_state.transpose(1, 2) @ error[..., None]).squeeze(-1)
    solved = torch.linalg.solve(states, torch.cat((mixed, slope[..., None]), -1))
    by_parameter, state_step = solved[..., :-1], -solved[..., -1]
    information = by_value.transpose(1, 2) @ by_value - mixed.transpose(1, 2) @ by_parameter
    score = -(by_value.transpose(1, 2) @ error[..., None]).squeeze(-1) - (
        mixed.transpose(1, 2) @ state_step[..., None]
    ).squeeze(-1)
    return Linear(information, score, state_step, by_parameter, rows.square().sum((1, 2)), segments.dof)


def robust_excess(excess: Tensor) -> tuple[Tensor, Tensor]:
    """Return the loss rho and the weight rho' of excesses e = chi2 - dof, any shape: e below 0, a logarithm above."""
    above = excess.clamp_min(0.0) / (2 * ROBUST_EXCESS)
    loss = torch.where(excess < 0, excess, 2 * ROBUST_EXCESS * torch.log1p(above))
    return loss, 1 / (1 + above)


def summed(values: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the sum over segments (B, ...) with weights (B,)."""
    if weight is None:
        return values.sum(0)
    return (values * weight.view(-1, *[1] * (values.ndim - 1))).sum(0)
