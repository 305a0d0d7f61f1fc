"""Contact law of the ContactGaussian-WM paper, reproduced with its known defects.

Source: ContactGaussian-WM (arXiv 2602.11021) as read by its public re-implementation (contact model notes, sections 2
to 5). One explicit evaluation of polyhedral rows n - mu d on every contact, stiffness and damping in SI units:

    lambda = SoftPlus(-K (h J b + phi) - D J b),    v = b + h M^-1 J^T lambda

A row acts where the gap of its contact is closed, or closes within the step: of a gap that is open, damping would brake
a body on its way, and SoftPlus push it.

Differences from the default law: the stiffness grows with the number of touching spheres, the restitution depends on
the step, bodies creep on slopes on which friction should hold them, and a sliding body floats higher than one at rest.

K and D are given by a natural time tau and a damping ratio zeta of a body of mass m that rests on `ROWS` rows (contact
model notes, section 11): K = m / (ROWS tau^2), D = 2 zeta m / (ROWS tau). That is a change of variables and no more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import softplus

from .contact_law import Touch

DIRECTIONS = 4
"""Rows of a contact's friction pyramid."""
ROWS = 16
"""Rows in contact for which K and D are stated: those of a box on its four lower corners."""
SHARPNESS_PER_M = 2000.0
"""beta of the log-sum-exp distance [1/m]."""
CLAMP_DEPTH_M = 0.005
"""delta of the clamp [m]; gamma is its inverse. Less would let a body of tau = 20 ms sink through: delta > g tau^2."""
CLAMP_ZERO = 0.5671432904097838
"""W(1): for gamma delta = 1 the clamped distance vanishes at W(1) delta."""
SOFTPLUS_OF_WEIGHT = 100.0
"""Sharpness of SoftPlus times the share of a body's weight that a row carries [1]."""


@dataclass(frozen=True, kw_only=True)
class PaperLaw:
    """Coefficients of the paper's contact law; tensors have shape (1,) or (B,)."""

    name: ClassVar[str] = "published"
    friction: Tensor
    """Coulomb friction coefficient [1]."""
    contact_time_s: Tensor
    """Natural time tau [s] of `row_mass_kg` on one row."""
    damping_ratio: Tensor
    """Damping ratio zeta [1] of `row_mass_kg` on one row."""
    row_mass_kg: float = 1.0
    """Mass by which tau and zeta give K and D: K = mass / tau^2, D = 2 zeta mass / tau [kg]."""
    directions: int = DIRECTIONS
    """Number of rows of a contact's friction pyramid."""
    softplus_per_n: float = math.inf
    """Sharpness of SoftPlus [1/N]; infinite for a plain maximum."""
    sharpness_per_m: float | None = None
    """Sharpness beta of the log-sum-exp distance between bodies [1/m]; None for the simplex smooth minimum."""
    clamp_depth_m: float | None = None
    """Depth delta of the sigmoid clamp of the distance [m]; None for no clamp."""
    clamp_per_m: float | None = None
    """Sharpness gamma of the sigmoid clamp of the distance [1/m]; None for no clamp."""
    zero_m: float = 0.0
    """Distance [m] at which the clamped distance vanishes, which is taken off: bodies then touch at their surfaces."""

    @property
    def stiffness_n_m(self) -> Tensor:
        """Stiffness K of a row [N/m]."""
        return self.row_mass_kg / self.contact_time_s.square()

    @property
    def damping_n_s_m(self) -> Tensor:
        """Damping D of a row [N s/m]."""
        return 2 * self.row_mass_kg * self.damping_ratio / self.contact_time_s

    @staticmethod
    def of_rows(friction: Tensor, stiffness_n_m: Tensor, damping_n_s_m: Tensor) -> PaperLaw:
        """Return the law of rows of K [N/m] and D [N s/m], with a plain maximum and distances that are not clamped."""
        time = stiffness_n_m.rsqrt()
        return PaperLaw(friction=friction, contact_time_s=time, damping_ratio=0.5 * damping_n_s_m * time)

    @staticmethod
    def of_body(
        friction: Tensor, contact_time_s: Tensor, damping_ratio: Tensor, mass_kg: float, weight_n: float
    ) -> PaperLaw:
        """Return the law as published, with this file's values of what the paper does not disclose.

        Args:
            friction: Coulomb friction coefficient [1].
            contact_time_s: Natural time of the body on `ROWS` rows [s].
            damping_ratio: Damping ratio of the same [1].
            mass_kg: Mass of the body [kg].
            weight_n: Its weight [N].
        """
        return PaperLaw(
            friction=friction,
            contact_time_s=contact_time_s,
            damping_ratio=damping_ratio,
            row_mass_kg=mass_kg / ROWS,
            softplus_per_n=SOFTPLUS_OF_WEIGHT * ROWS / weight_n if weight_n > 0 else math.inf,
            sharpness_per_m=SHARPNESS_PER_M,
            clamp_depth_m=CLAMP_DEPTH_M,
            clamp_per_m=1 / CLAMP_DEPTH_M,
            zero_m=CLAMP_ZERO * CLAMP_DEPTH_M,
        )


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
        gap = clamped(gap + law.zero_m, law.clamp_depth_m, law.clamp_per_m)
    angle = torch.arange(law.directions).to(gap) * (2 * math.pi / law.directions)
    facets = torch.stack((angle.cos(), angle.sin()), -1)
    along = free[..., :1] - touch.friction[..., None] * (free[..., 1:] @ facets.T)
    h, stiffness, damping = touch.step_s[..., None], law.stiffness_n_m[:, None, None], law.damping_n_s_m[:, None, None]
    force = -stiffness * (h * along + gap[..., None]) - damping * along
    force = force.clamp_min(0.0) if math.isinf(law.softplus_per_n) else softplus(force, law.softplus_per_n)
    ahead = touch.gap + touch.step_s * free[..., 0]
    closed = (touch.gap < 0) | (ahead < 0)
    impulse = torch.where(closed[..., None], h * force, torch.zeros_like(force))
    return torch.cat((impulse.sum(-1, keepdim=True), -touch.friction[..., None] * (impulse @ facets)), -1)
