"""Contact law of the ContactGaussian-WM paper, reproduced with its known defects.

Source: ContactGaussian-WM (arXiv 2602.11021) as read by its public re-implementation (contact model notes, sections 2
to 5). One explicit evaluation of polyhedral rows n - mu d on every contact, stiffness and damping in SI units:

    lambda = SoftPlus(-K (h J b + phi) - D J b),    v = b + h M^-1 J^T lambda

Differences from the default law: the stiffness grows with the number of touching spheres, the restitution depends on
the step, bodies creep on slopes on which friction should hold them, and a sliding body floats higher than one at rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import softplus

from .contact_law import Touch


@dataclass(frozen=True, kw_only=True)
class PaperLaw:
    """Coefficients of the paper's contact law; tensors have shape (1,) or (B,)."""

    name: ClassVar[str] = "published"
    friction: Tensor
    """Coulomb friction coefficient [1]."""
    stiffness_n_m: Tensor
    """Stiffness K of a row [N/m]."""
    damping_n_s_m: Tensor
    """Damping D of a row [N s/m]."""
    directions: int = 4
    """Number of rows of a contact's friction pyramid."""
    softplus_per_n: float = math.inf
    """Sharpness of SoftPlus [1/N]; infinite for a plain maximum."""
    sharpness_per_m: float | None = None
    """Sharpness beta of the log-sum-exp distance between bodies [1/m]; None for the simplex smooth minimum."""
    clamp_depth_m: float | None = None
    """Depth delta of the sigmoid clamp of the distance [m]; None for no clamp."""
    clamp_per_m: float | None = None
    """Sharpness gamma of the sigmoid clamp of the distance [1/m]; None for no clamp."""


def clamped(distance: Tensor, depth_m: float, per_m: float) -> Tensor:
    """Return the published clamp of a distance [m]: sig(gamma d) d - (1 - sig(gamma d)) delta, any shape."""
    inside = torch.sigmoid(per_m * distance)
    return inside * distance - (1 - inside) * depth_m


def rest_penetration(mass: float, gravity: float, rows: int, law: tuple[float, float], step_s: float) -> float:
    """Return the distance [m] at which a body rests on `rows` rows of (K, D): g h^2 + D g h / K - m g / (rows K).

    Derived (contact model notes, section 5.5), for a hard maximum; negative: it has sunk in.
    """
    stiffness, damping = law
    return gravity * step_s**2 + damping * gravity * step_s / stiffness - mass * gravity / (rows * stiffness)


def creep_speed(
    slope_rad: float, friction: float, mass: float, rows: int, law: tuple[float, float], step_s: float, gravity: float
) -> float:
    """Return the speed [m/s] at which a body creeps down a slope that Coulomb friction would hold.

    Derived (contact model notes, section 5.9), while all rows carry load.
    """
    stiffness, damping = law
    held = 2 * mass / (rows * friction**2 * (stiffness * step_s + damping))
    return gravity * math.sin(slope_rad) * (held - step_s)


def stable_step(law: PaperLaw, mass: Tensor, rows: int) -> Tensor:
    """Return the largest stable step [s] for a persistent contact of `rows` rows on a mass [kg], same shape.

    Derived (contact model notes, section 5.6): 3 kappa + 2 c < 4 with kappa = h^2 rows K / m, c = h rows D / m.
    """
    a, b = 3 * rows * law.stiffness_n_m / mass, 2 * rows * law.damping_n_s_m / mass
    return 8 / (b + (b.square() + 16 * a).sqrt())


def paper_impulses(law: PaperLaw, touch: Touch, axes: Tensor) -> Tensor:
    """Return the impulses (n, C, 3) [N s] on body a along normal and tangents.

    Args:
        law: The law; its K and D have shape (1,) or (n,).
        touch: The contacts; of its coefficients only the friction is used.
        axes: Normal and tangents as rows (n, C, 3, 3).
    """
    free = (axes @ touch.velocity[..., None]).squeeze(-1)
    gap = touch.gap
    if law.clamp_depth_m is not None and law.clamp_per_m is not None:
        gap = clamped(gap, law.clamp_depth_m, law.clamp_per_m)
    angle = torch.arange(law.directions).to(gap) * (2 * math.pi / law.directions)
    facets = torch.stack((angle.cos(), angle.sin()), -1)
    along = free[..., :1] - touch.friction[..., None] * (free[..., 1:] @ facets.T)
    h, stiffness, damping = touch.step_s[..., None], law.stiffness_n_m[:, None, None], law.damping_n_s_m[:, None, None]
    force = -stiffness * (h * along + gap[..., None]) - damping * along
    force = force.clamp_min(0.0) if math.isinf(law.softplus_per_n) else softplus(force, law.softplus_per_n)
    impulse = h * force
    return torch.cat((impulse.sum(-1, keepdim=True), -touch.friction[..., None] * (impulse @ facets)), -1)
