"""Quantities with the bounds that every file and setting has to keep.

The bounds are far beyond what anybody measures or needs, and within what can be computed: a value outside them is a
mistake of units or of digits, would never end, or cannot be told from infinity.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import AfterValidator, Field

Vector3 = tuple[float, float, float]

Length = Annotated[float, Field(ge=1e-9, le=1e5)]
"""Size of something, or a distance [m]."""
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
"""Position along an axis [m]; the Earth's surface has room in it, for georeferenced worlds."""
Position3 = tuple[Coordinate, Coordinate, Coordinate]
Mass = Annotated[float, Field(ge=1e-12, le=1e9)]
"""[kg]."""
Instant = Annotated[float, Field(ge=-1e11, le=1e11)]
"""A time on any clock [s], also seconds since 1970."""
MOST_DURATION_S = 3600.0
"""Longest simulated motion [s]."""
Duration = Annotated[float, Field(ge=1e-6, le=MOST_DURATION_S)]
"""Length of a simulated motion [s]."""
Step = Annotated[float, Field(ge=1e-6, le=1)]
"""Time step of a simulation [s]."""
FrameRate = Annotated[float, Field(ge=1e-3, le=1e7)]
"""[Hz]."""
Speed = Annotated[float, Field(ge=-1e5, le=1e5)]
"""[m/s]."""
Deviation = Annotated[float, Field(ge=1e-12, le=1e6)]
"""Standard deviation of a measurement, in its unit."""
FacePoints = Annotated[int, Field(ge=0, le=1000)]
"""Number of points on a face."""
FaceExponent = Annotated[float, Field(ge=0, le=20)]
"""Power of the distance from the middle of a face by which its points carry more [1]."""
Friction = Annotated[float, Field(ge=0, le=100)]
"""Coulomb coefficient [1]."""
ContactTime = Annotated[float, Field(ge=1e-7, le=10)]
"""Natural contact time [s]."""
DampingRatio = Annotated[float, Field(ge=0, le=100)]
"""Of a contact [1]; from about 10 on nothing bounces measurably."""
MOST_SEED = 2**62
"""Largest seed; sums of a seed and a small number stay within 64 bits."""
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]
Side = Annotated[int, Field(ge=16, le=16384)]
"""Side of a picture that is drawn [px]."""
Steps = Annotated[int, Field(ge=1, le=10_000_000)]
"""Steps of a descent."""
RadiusFactor = Annotated[float, Field(ge=0.01, le=100)]
"""Collision radius of a sphere in units of its Gaussian scale [1]."""


def unit_vector(value: Vector3, what: str) -> Vector3:
    """Return a vector with a length of exactly 1, or raise a ValueError unless it is 1 within 0.001."""
    norm = math.hypot(*value)
    if not abs(norm - 1.0) <= 1e-3:
        raise ValueError(f"{what} has length {norm:.4f}; it must be 1")
    return value[0] / norm, value[1] / norm, value[2] / norm


def _unlike_any_planet(value: Vector3) -> Vector3:
    if math.hypot(*value) > MAX_GRAVITY_M_S2:
        raise ValueError(f"gravity of {math.hypot(*value):g} m/s2; at most {MAX_GRAVITY_M_S2:g} m/s2")
    return value


MAX_GRAVITY_M_S2 = 1000.0
"""Largest gravitational acceleration; that of Jupiter is 25 m/s2."""
Gravity = Annotated[Vector3, AfterValidator(_unlike_any_planet)]
"""Gravitational acceleration, world frame [m/s2]."""
