"""What PIN-WM's simulator asks of the module pybullet, of which there is no wheel: contacts by Bullet's own library.

Bodies are convex parts or spheres in place of URDF files. `CGWM_BULLET` names the library that `bullet.cpp` makes.
"""

from __future__ import annotations

import ctypes
import os
import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from cgwm.schemas import UsageError
from numpy.typing import NDArray

Array = NDArray[np.float64]
MARGIN_M = 0.001
"""That of the module for convex hulls of URDF files."""
MOST_CONTACTS = 4000


@dataclass(frozen=True, eq=False)
class Shape:
    """Convex parts (their corners [m], each of shape (corner, 3)), or a sphere of a radius [m]."""

    parts: tuple[Array, ...] = ()
    radius_m: float = 0.0
    fixed: bool = False


class Bullet(ModuleType):
    """The module's functions that are called."""

    GUI, DIRECT, COV_ENABLE_GUI = 1, 2, 1

    def __init__(self, path: str) -> None:
        super().__init__("pybullet")
        self._library = ctypes.CDLL(path)
        self._library.bullet_sphere.argtypes = [ctypes.c_double]
        parts = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_double, ctypes.c_int]
        self._library.bullet_parts.argtypes = parts
        self._rows = np.zeros((MOST_CONTACTS, 12))

    def connect(self, mode: int) -> int:
        """Begin an empty world."""
        self._library.bullet_open()
        return 0

    def configureDebugVisualizer(self, *given: Any) -> None:
        """Nothing is shown."""

    def resetDebugVisualizerCamera(self, **given: Any) -> None:
        """Nothing is shown."""

    def disconnect(self, client: int) -> None:
        """The world stays until the next one begins."""

    def loadURDF(self, shape: Shape, position_m: Array, quat_xyzw: Array) -> int:
        """Add a body, and return its number."""
        if shape.parts:
            corners = np.ascontiguousarray(np.concatenate(shape.parts), np.float64)
            counts = np.array([len(part) for part in shape.parts], np.int32)
            number = self._library.bullet_parts(_at(corners), _at(counts), len(counts), MARGIN_M, int(shape.fixed))
        else:
            number = self._library.bullet_sphere(shape.radius_m)
        self.resetBasePositionAndOrientation(number, position_m, quat_xyzw)
        return number

    def resetBasePositionAndOrientation(self, number: int, position_m: Array, quat_xyzw: Array) -> None:
        """Place a body."""
        position, quat = np.array(position_m, np.float64), np.array(quat_xyzw, np.float64)
        self._library.bullet_place(number, _at(position), _at(quat))

    def performCollisionDetection(self) -> None:
        """Contacts are found when they are asked for."""

    def getContactPoints(self) -> list[tuple[Any, ...]]:
        """Return the contacts as the module does, as far as they are read."""
        count = self._library.bullet_contacts(_at(self._rows), len(self._rows))
        rows = self._rows[:count].copy()
        return [(0, int(r[0]), int(r[1]), -1, -1, tuple(r[2:5]), tuple(r[5:8]), tuple(r[8:11]), r[11]) for r in rows]


def _at(array: NDArray[Any]) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def install() -> None:
    """Let `import pybullet` find this.

    Raises:
        UsageError: If `CGWM_BULLET` does not name a library.
    """
    path = os.environ.get("CGWM_BULLET", "")
    if not os.path.exists(path):
        raise UsageError(f"CGWM_BULLET: {path or 'not set'}.", "build benchmarks/rivals/bullet.cpp (docs/rivals.md).")
    sys.modules["pybullet"] = Bullet(path)
