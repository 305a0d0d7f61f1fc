"""Bodies that are thrown, and their contact with the ground, drawn from the seed of a case."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["cube", "ball"]

BALL_RADIUS_M = 0.035
_CORNER_M = 1e-4
"""Radius of the spheres in the corners of a box, its contact geometry in MuJoCo; each can have a different friction."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Thing:
    """A homogeneous body and its contact with the ground.

    Args:
        kind: "cube" or "ball".
        half_extents_m: Half extents of the box, shape (3,); for a ball three times the same number, its radius.
        mass_kg: Its mass.
        friction: Coulomb's coefficient [1].
        natural_time_s: Inverse of the natural angular frequency of a contact.
        damping_ratio: Damping ratio of a contact [1] (`restitution_of`).
    """

    kind: Kind
    half_extents_m: Array
    mass_kg: float
    friction: float
    natural_time_s: float
    damping_ratio: float

    @property
    def inertia_kg_m2(self) -> Array:
        """Principal moments of the homogeneous body about its centre, body axes [kg m2], shape (3,)."""
        square = self.half_extents_m**2
        return self.mass_kg * (0.4 * square if self.kind == "ball" else (square.sum() - square) / 3)

    @property
    def spheres(self) -> tuple[Array, float]:
        """Centres (n, 3) in the body frame and radius [m] of the spheres that touch the ground."""
        if self.kind == "ball":
            return np.zeros((1, 3)), float(self.half_extents_m[0])
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
        return signs * (self.half_extents_m - _CORNER_M), _CORNER_M

    @property
    def size_m(self) -> float:
        """Distance of the farthest point from the centre [m]."""
        return float(self.half_extents_m[0] if self.kind == "ball" else np.linalg.norm(self.half_extents_m))


def draw_thing(kind: Kind, law: int, rng: np.random.Generator) -> Thing:
    """Draw a body of a kind: a box of about 10 cm, 250 to 600 g, or a ball of 70 mm, 60 to 200 g.

    Friction 0.2 to 0.4, restitution about 0.3 to 0.65; a contact takes 2 to 3 ms under law 1, 4 to 6 ms under law 2.
    """
    half = rng.uniform(0.045, 0.055, 3).round(4) if kind == "cube" else np.full(3, BALL_RADIUS_M)
    mass = rng.uniform(0.25, 0.6) if kind == "cube" else rng.uniform(0.06, 0.2)
    friction, damping = rng.uniform(0.2, 0.4), rng.uniform(0.16, 0.45)
    time = rng.uniform(0.7e-3, 1.0e-3) * (1.0 if law == 1 else 2.0)
    return Thing(
        kind=kind,
        half_extents_m=half,
        mass_kg=round(mass, 4),
        friction=round(friction, 4),
        natural_time_s=round(time, 7),
        damping_ratio=round(damping, 4),
    )


def restitution_of(damping_ratio: float | Array) -> Array:
    """Return exp(-2 z arccos(z) / sqrt(1 - z^2)): restitution of a damped spring up to zero force (derived)."""
    z = np.asarray(damping_ratio)
    return np.asarray(np.exp(-2 * z * np.arccos(z) / np.sqrt(1 - z * z)))


_RATIOS = np.linspace(1e-4, 0.999, 2000)
_RESTITUTIONS = restitution_of(_RATIOS)


def damping_ratio_of(restitution: float | Array) -> Array:
    """Return the damping ratio for a restitution above 0.14, by interpolation."""
    return np.asarray(np.interp(restitution, _RESTITUTIONS[::-1], _RATIOS[::-1]))
