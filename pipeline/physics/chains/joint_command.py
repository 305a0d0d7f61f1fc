"""Commands of the servos of a chain: targets or speeds of its joints at knots, between which they are interpolated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ....schemas import InputDataError, UsageError

if TYPE_CHECKING:
    from .chain import Chain

HOLDS = ("zero", "linear", "cubic")
"""How a command goes from knot to knot: constant, linear, or a cubic through the knots with continuous speed."""
ORDER = 5
"""Coefficients of a piece: a cubic command of speeds is a target of fourth order."""


@dataclass(frozen=True)
class JointCommand:
    """Targets of the servos of a batch as polynomials between knots; constant before the first and after the last."""

    times_s: Tensor
    """Times of the knots [s], increasing, shape (1 or B, K)."""
    coefficients: Tensor
    """Coefficients of each piece in the time since its knot, shape (1 or B, K, joints, 5); the last is constant."""

    @staticmethod
    def targets(times_s: Tensor, values: Tensor, hold: str = "linear") -> JointCommand:
        """Build a command from joint targets at knots.

        Args:
            times_s: Times of the knots [s], shape (1 or B, K).
            values: Targets [rad or m], shape (1 or B, K, joints), joints as in `Chain.joint_names`.
            hold: One of `HOLDS`.

        Raises:
            UsageError: If the shapes do not fit, times do not increase or `hold` is unknown.
        """
        _require(times_s, values, hold)
        return JointCommand(times_s, _pieces(times_s, values, hold))

    @staticmethod
    def speeds(times_s: Tensor, values: Tensor, start: Tensor, hold: str = "linear") -> JointCommand:
        """Build a command from joint speeds at knots, whose integral is the target.

        Args:
            times_s: Times of the knots [s], shape (1 or B, K).
            values: Speeds [rad/s or m/s], shape (1 or B, K, joints).
            start: Targets at the first knot [rad or m], shape (1 or B, joints).
            hold: One of `HOLDS`.

        Raises:
            UsageError: If the shapes do not fit, times do not increase or `hold` is unknown.
        """
        _require(times_s, values, hold)
        rates = _pieces(times_s, values, hold)[..., : ORDER - 1]
        each = torch.arange(1, ORDER, dtype=rates.dtype, device=rates.device)
        raised = rates / each
        batch = max(start.shape[0], raised.shape[0])
        raised = raised.expand(batch, *raised.shape[1:])
        length = times_s.diff(dim=1)[..., None, None]
        gained = (raised[:, :-1] * length**each).sum(-1).cumsum(1)
        first = torch.cat((start.expand(batch, -1)[:, None], start[:, None] + gained), 1)
        raised = torch.cat((raised[:, :-1], torch.zeros_like(raised[:, -1:])), 1)
        return JointCommand(times_s, torch.cat((first[..., None], raised), -1))

    @staticmethod
    def hold_still(values: Tensor) -> JointCommand:
        """Return the command that keeps targets (1 or B, joints) [rad or m]."""
        return JointCommand.targets(values.new_zeros(1, 1), values[:, None], "zero")

    def repeat(self, times: int) -> JointCommand:
        """Return the command with its batch repeated, as `Tensor.repeat` does."""
        return JointCommand(
            *(x if x.shape[0] == 1 else x.repeat(times, *[1] * (x.ndim - 1)) for x in vars(self).values())
        )

    def select(self, rows: Tensor) -> JointCommand:
        """Return the command at some rows of the batch."""
        return JointCommand(*(x if x.shape[0] == 1 else x[rows] for x in (getattr(self, f.name) for f in fields(self))))

    def at(self, time_s: Tensor) -> Tensor:
        """Return the targets (B, joints) at times (1 or B,) [s]."""
        batch = max(time_s.shape[0], self.times_s.shape[0], self.coefficients.shape[0])
        grid = self.times_s.expand(batch, -1).contiguous()  # or searchsorted warns and copies
        time = time_s.expand(batch)
        index = torch.searchsorted(grid.detach(), time.detach()[:, None].contiguous(), right=True).squeeze(-1) - 1
        index = index.clamp_min(0)
        rows = torch.arange(batch, device=time.device)
        since = (time - grid[rows, index]).clamp_min(0.0)[:, None]
        piece = self.coefficients.expand(batch, *self.coefficients.shape[1:])[rows, index]
        value = piece[..., -1]
        for k in range(ORDER - 2, -1, -1):
            value = value * since + piece[..., k]
        return value

    @staticmethod
    def of(chain: Chain, driven: Mapping[str, object], like: Tensor) -> JointCommand | None:
        """Return the command of a chain; None where no joint of it has a servo.

        Raises:
            InputDataError: If its servos have no command, or one for another number of joints.
        """
        count = len(chain.moving)
        if not chain.has_servos:
            return None
        command = driven.get(chain.name)
        if not isinstance(command, JointCommand):
            raise InputDataError(
                f"the joints of the chain '{chain.name}' have servos and no command.",
                f"a JointCommand for {', '.join(chain.joint_names)}.",
                f"give targets of the joints under the name '{chain.name}'.",
            )
        if command.coefficients.shape[-2] != count:
            raise InputDataError(
                f"the command of the chain '{chain.name}' has {command.coefficients.shape[-2]} joints.",
                f"{count}: {', '.join(chain.joint_names)}.",
                todo="give a value for each of these joints, in this order.",
            )
        return JointCommand(*(x.to(like) for x in vars(command).values()))


def _require(times_s: Tensor, values: Tensor, hold: str) -> None:
    if hold not in HOLDS:
        raise UsageError(
            f"the command of the joints goes between knots as '{hold}'.",
            ", ".join(HOLDS) + ".",
            todo="give one of these as hold.",
        )
    if times_s.ndim != 2 or values.ndim != 3 or times_s.shape[1] != values.shape[1]:
        raise UsageError(
            f"the command of the joints has times {tuple(times_s.shape)} and values {tuple(values.shape)}.",
            "times (B, K) and values (B, K, joints).",
            todo="give as many values as times.",
        )
    if not bool((times_s.detach().diff(dim=1) > 0).all()):
        raise UsageError(
            "the times of the joints' command do not increase.",
            "increasing times.",
            todo="sort the knots by time, and leave out those that repeat.",
        )


def _pieces(times_s: Tensor, values: Tensor, hold: str) -> Tensor:
    """Return the coefficients (B, K, joints, 5) of the pieces.

    The slopes of a cubic are those of parabolas through three knots, one-sided at the ends.
    """
    batch = max(times_s.shape[0], values.shape[0])
    values = values.expand(batch, -1, -1)
    zero = torch.zeros_like(values)
    if hold == "zero" or values.shape[1] == 1:
        return torch.stack((values, *[zero] * (ORDER - 1)), -1)
    length = times_s.diff(dim=1)[..., None]
    secant = values.diff(dim=1) / length
    last = zero[:, -1:]
    if hold == "linear":
        return torch.stack((values, torch.cat((secant, last), 1), *[zero] * (ORDER - 2)), -1)
    inner = (secant[:, :-1] * length[:, 1:] + secant[:, 1:] * length[:, :-1]) / (length[:, 1:] + length[:, :-1])
    slope = torch.cat((secant[:, :1], inner, secant[:, -1:]), 1)
    second = (3 * secant - 2 * slope[:, :-1] - slope[:, 1:]) / length
    third = (slope[:, :-1] + slope[:, 1:] - 2 * secant) / length.square()
    padded = [torch.cat((x, last), 1) for x in (slope[:, :-1], second, third)]
    return torch.stack((values, *padded, zero), -1)
