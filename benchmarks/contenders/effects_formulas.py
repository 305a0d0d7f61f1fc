"""The library for rivals, formulas of `cgwm effects show` written again; without friction_patch and time_offset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
GRAVITY, MAGNET_M, GAP_M, TOUCHING_M, NEAR_M = 9.81, 0.1, 0.002, 2e-4, 0.006
LIBRARY: dict[str, tuple[float, ...]] = {
    "linear_drag": (0.02,),
    "quadratic_drag": (0.02,),
    "wind": (0.02, 0.02, 0.02),
    "magnus_lift": (0.002,),
    "spin_damping": (0.02,),
    "constant_force": (0.02, 0.02, 0.02),
    "gravity_tilt": (0.002, 0.002),
    "gravity_scale": (0.002,),
    "buoyancy": (0.02,),
    "ground_magnet": (0.2,),
    "rolling_resistance": (3e-5,),
    "torsional_friction": (1e-4,),
    "viscous_friction": (0.05,),
    "stribeck_friction": (0.01,),
    "anisotropic_friction": (0.01,),
    "velocity_restitution": (0.02,),
    "adhesion": (0.2,),
    "com_offset": (2e-4, 2e-4, 2e-4),
    "inertia_shape": (0.01,) * 5,
    "length_scale": (0.001,),
    "frame_tilt": (0.001, 0.001),
    "clock_scale": (0.001,),
    "marker_offset": (2e-4, 2e-4, 2e-4),
}
"""Effects, and the step of each parameter in differences; 0 is no effect."""
_NONE, _UP, _LEVEL = np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Moving:
    """A body's motion: speed [m/s] and omega [rad/s], world axes (3,), its lowest point's height [m].

    turning: mean moment of inertia over mass [m2].
    """

    speed: Array
    omega: Array
    lowest: float
    turning: float

    @property
    def fast(self) -> float:
        """Absolute speed [m/s]."""
        return float(np.sqrt(self.speed @ self.speed))

    @property
    def touches(self) -> float:
        """1 on the ground, else 0."""
        return float(self.lowest < TOUCHING_M)


def _against(spin: Array, length: float, moving: Moving) -> Array:
    """Return the torque over mass of a friction of a length under the body's weight."""
    speed = float(np.sqrt(spin @ spin))
    return -length * GRAVITY * moving.touches * np.tanh(speed) * spin / max(speed, 1e-9)


Wrench = Callable[[Array, Moving], tuple[Array, Array]]
WRENCHES: dict[str, Wrench] = {
    "linear_drag": lambda v, m: (-v[0] * m.speed, _NONE),
    "quadratic_drag": lambda v, m: (-v[0] * m.fast * m.speed, _NONE),
    "wind": lambda v, m: (m.fast * (np.array([v[1], v[2], 0.0]) - v[0] * m.speed), _NONE),
    "magnus_lift": lambda v, m: (v[0] * np.cross(m.omega, m.speed), _NONE),
    "spin_damping": lambda v, m: (_NONE, -v[0] * m.turning * m.omega),
    "constant_force": lambda v, m: (v, _NONE),
    "gravity_tilt": lambda v, m: (GRAVITY * np.array([v[0], v[1], 0.0]), _NONE),
    "gravity_scale": lambda v, m: (-GRAVITY * v[0] * _UP, _NONE),
    "buoyancy": lambda v, m: (v[0] * _UP, _NONE),
    "ground_magnet": lambda v, m: (-v[0] * np.exp(-max(m.lowest, 0.0) / MAGNET_M) * _UP, _NONE),
    "adhesion": lambda v, m: (-v[0] * float(np.clip(1 - m.lowest / GAP_M, 0.0, 1.0)) * _UP, _NONE),
    "viscous_friction": lambda v, m: (-v[0] * m.touches * m.speed * _LEVEL, _NONE),
    "rolling_resistance": lambda v, m: (_NONE, _against(m.omega * _LEVEL, v[0], m)),
    "torsional_friction": lambda v, m: (_NONE, _against(m.omega * _UP, v[0], m)),
}
"""Force and torque over mass, world axes, of the effects that are forces."""


def first_touch(lowest: Array) -> int:
    """Return the first frame that may come after a touch, by the heights of the lowest point (T,) [m]; T if none.

    A body falls by centimetres between two frames: a frame whose height the two before it foretell as near counts.
    """
    foretold = np.concatenate((lowest[:2], 2 * lowest[1:-1] - lowest[:-2]))
    near = np.flatnonzero(np.minimum(lowest, foretold) < NEAR_M)
    return int(near[0]) if near.size else len(lowest)
