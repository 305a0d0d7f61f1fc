"""Rigid-body motion over one step, with exact conservation of momentum in free flight."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry.rotation import cross, quat_exp, quat_multiply, quat_normalize, quat_rotate, quat_to_matrix
from .body import Body


@dataclass(frozen=True)
class Motion:
    """Motion of a body in the world frame."""

    com: Tensor
    """Centre of mass [m], shape (B, 3); origin of the frame where the body is not free."""
    quat_wxyz: Tensor
    """Orientation, body to world, shape (B, 4)."""
    velocity: Tensor
    """Velocity of the centre of mass [m/s], shape (B, 3)."""
    spin: Tensor
    """Angular momentum about the centre of mass [kg m2/s], shape (B, 3); angular velocity [rad/s] of a driven body."""


@dataclass(frozen=True)
class Inertia:
    """Inertial constants of a free body, body axes."""

    mass: Tensor
    """Mass [kg], shape (B,)."""
    inverse: Tensor
    """Inverse inertia [1/(kg m2)], shape (B, 3, 3)."""
    root: Tensor
    """Cholesky root of the inverse inertia, shape (B, 3, 3)."""
    matrix: Tensor
    """Inertia [kg m2], shape (B, 3, 3)."""

    @staticmethod
    def of(body: Body) -> Inertia:
        """Compute the constants of a body once for a rollout; links of chains, which may have no mass, need none."""
        if body.motion == "link":
            return Inertia(body.mass, body.inertia, body.inertia, body.inertia)
        inverse = torch.linalg.inv(body.inertia)
        return Inertia(body.mass, inverse, torch.linalg.cholesky(inverse), body.inertia)

    def omega(self, rotation: Tensor, spin: Tensor) -> Tensor:
        """Return the angular velocity (B, 3) [rad/s], world frame, of an angular momentum (B, 3) [kg m2/s]."""
        return (rotation @ self.omega_body(rotation, spin)[..., None]).squeeze(-1)

    def omega_body(self, rotation: Tensor, spin: Tensor) -> Tensor:
        """Return the angular velocity (B, 3) [rad/s], body frame, of an angular momentum (B, 3) [kg m2/s]."""
        return (self.inverse @ (rotation.transpose(-1, -2) @ spin[..., None])).squeeze(-1)


def start(body: Body, position: Tensor, quat: Tensor, velocity: Tensor, omega_body: Tensor) -> Motion:
    """Return the motion of a free body from the pose and velocity of its frame's origin."""
    arm = quat_rotate(quat, body.com)
    omega = quat_rotate(quat, omega_body)
    momentum = quat_rotate(quat, (body.inertia @ omega_body[..., None]).squeeze(-1))
    return Motion(position + arm, quat, velocity + cross(omega, arm), momentum)


def finish(body: Body, inertia: Inertia, motion: Motion) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return position, quaternion, velocity of the body frame's origin and omega_body; inverse of :func:`start`."""
    rotation = quat_to_matrix(motion.quat_wxyz)
    omega_body = inertia.omega_body(rotation, motion.spin)
    omega = (rotation @ omega_body[..., None]).squeeze(-1)
    arm = (rotation @ body.com[..., None]).squeeze(-1)
    return motion.com - arm, motion.quat_wxyz, motion.velocity - cross(omega, arm), omega_body


def advance(
    inertia: Inertia, before: Motion, velocity: Tensor, spin: Tensor, step_s: Tensor, semi_implicit: bool = False
) -> Motion:
    """Move a body over one step in which its velocity and angular momentum went from `before` to the given ones.

    Positions follow the mean velocity (exact for constant acceleration); the rotation follows the angular velocity
    that the mean angular momentum has half-way through the step (explicit midpoint, second order; derived). The
    paper's law is `semi_implicit`: positions and rotations follow the velocities at the end of the step.
    """
    h = step_s[:, None]
    mean_spin, mean_velocity = (
        (spin, velocity) if semi_implicit else (0.5 * (before.spin + spin), 0.5 * (before.velocity + velocity))
    )
    rotation = quat_to_matrix(before.quat_wxyz)
    omega_start = inertia.omega_body(rotation, before.spin)
    half = quat_normalize(quat_multiply(before.quat_wxyz, quat_exp(0.5 * h * omega_start)))
    omega_half = inertia.omega_body(quat_to_matrix(half), mean_spin)
    quat = quat_normalize(quat_multiply(before.quat_wxyz, quat_exp(h * omega_half)))
    return Motion(before.com + h * mean_velocity, quat, velocity, spin)
