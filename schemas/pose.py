"""A rigid pose."""

from __future__ import annotations

import math

from pydantic import field_validator

from .base import FileModel
from .quantities import Position3

QUATERNION_NORM_TOLERANCE = 1e-3
"""A quaternion whose norm is off by no more than this is normalised; by more, it is refused."""


def unit_quaternion(quat_wxyz: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Return the normalised quaternion; refuse one whose norm is off by more than the tolerance."""
    norm = math.sqrt(sum(value * value for value in quat_wxyz))
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise ValueError(
            f"the quaternion has norm {norm:.4f}; it must be 1 within {QUATERNION_NORM_TOLERANCE:g} (order w, x, y, z)"
        )
    w, x, y, z = (value / norm for value in quat_wxyz)
    return w, x, y, z


class Pose(FileModel):
    """A rigid pose: position [m] and unit quaternion (w, x, y, z)."""

    position_m: Position3 = (0.0, 0.0, 0.0)
    quat_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @field_validator("quat_wxyz")
    @classmethod
    def _unit(cls, value: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        return unit_quaternion(value)
