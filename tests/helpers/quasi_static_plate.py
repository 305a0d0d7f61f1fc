"""Quasi-static reference of a square plate that a round finger without friction pushes: numpy, nothing of the engine.

Two models of the friction of its face. Coulomb's law in each cell of a fine mesh, whose pressure is even, or grows with
a power of the distance from the middle, but for the linear part that the moment of the finger's height asks for. And
the ellipsoid through the largest force and the largest torque of that pressure (Lee & Cutkosky, "Fixture planning with
friction", 1991), to which the twist is normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Twist = Callable[[Array], Array]
"""Twist (vx, vy, w) in the plate's frame for a unit speed of the touched point along x, given that point."""


@dataclass(frozen=True, kw_only=True)
class Push:
    """A plate with edges along x and y at the origin, and a finger that moves along x beside its middle."""

    half_m: float
    """Half of the plate's side."""
    flat_m: float
    """Half of the side of the face that lies on the ground."""
    finger_m: float
    """Radius of the finger, and its height."""
    offset_m: float
    """How far beside the middle it pushes."""
    stroke_m: float
    """How far it goes from the first touch on."""
    friction: float
    """Of the ground."""
    exponent: float = 0.0
    """Power of the distance from the middle by which the pressure grows."""
    cells: int = 40
    """Cells of the mesh along a side."""

    def mesh(self) -> tuple[Array, Array]:
        """Return the middles (P, 2) of the cells and their parts (P,) of the weight."""
        ticks = ((np.arange(self.cells) + 0.5) / self.cells * 2 - 1) * self.flat_m
        points = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), -1).reshape(-1, 2)
        carried = np.linalg.norm(points, axis=1) ** self.exponent
        return points, carried / carried.sum()

    def turn_of_mesh(self) -> float:
        """Return the turn [rad] with Coulomb friction in each cell."""
        points, carried = self.mesh()
        spread = carried @ points[:, 0] ** 2
        found, force = np.array([0.0, 5.0]), np.array([1.0, 0.0])

        def twist(arm: Array) -> Array:
            nonlocal found, force
            tilt = self.friction * self.finger_m * math.hypot(*force) * points[:, 0] / spread
            found, force = slowest(points, carried * (1 + tilt), arm, found)
            return np.array([1 + found[1] * arm[1], found[0], found[1]])

        return self._turned(twist)

    def turn_of_ellipsoid(self) -> float:
        """Return the turn [rad] with the ellipsoid."""
        points, carried = self.mesh()
        radius = float(carried @ np.linalg.norm(points, axis=1))

        def twist(arm: Array) -> Array:
            turn = -arm[1] / radius**2
            return np.array([1.0, 0.0, turn]) / (1 + (arm[1] / radius) ** 2)

        return self._turned(twist)

    def _turned(self, twist: Twist, steps: int = 100) -> float:
        """Integrate the pose with the second order (Adams and Bashforth)."""
        pose, last = np.zeros(3), None
        for k in range(steps):
            c, s = math.cos(pose[2]), math.sin(pose[2])
            tip = np.array([self.stroke_m * k / steps - self.half_m - self.finger_m, self.offset_m])
            touched = tip + self.finger_m * np.array([c, s])
            arm = np.array([[c, s], [-s, c]]) @ (touched - pose[:2])
            vx, vy, w = self.stroke_m / steps * c * twist(arm)
            move = np.array([c * vx - s * vy, s * vx + c * vy, w])
            pose = pose + (move if last is None else 1.5 * move - 0.5 * last)
            last = move
        return float(pose[2])


def slowest(points: Array, carried: Array, arm: Array, found: Array) -> tuple[Array, Array]:
    """Return (vy, w) at the middle of a plate whose point `arm` moves at 1 along x, and its friction force (2,).

    Coulomb friction at every point: of all twists with this speed, the plate takes that of least power. Newton's method
    from `found`; the force is that for a friction and a weight of 1.
    """
    x, y = points.T
    to_point = np.stack((np.stack([0 * x, arm[1] - y], 1), np.stack([1 + 0 * x, x], 1)), 1)

    def slip(twist: Array) -> Array:
        return to_point @ twist + np.array([1.0, 0.0])

    def power(twist: Array) -> float:
        return float(carried @ np.linalg.norm(slip(twist), axis=1))

    for _ in range(50):
        u = slip(found)
        size = np.sqrt((u**2).sum(1) + 1e-12)
        e = u / size[:, None]
        slope = np.einsum("p,pc,pck->k", carried, e, to_point)
        bent = (np.eye(2) - e[:, :, None] * e[:, None]) * (carried / size)[:, None, None]
        move = -np.linalg.solve(np.einsum("pck,pcd,pdl->kl", to_point, bent, to_point), slope)
        k = 1.0
        while power(found + k * move) > power(found) and k > 1e-6:
            k /= 2
        found = found + k * move
        if np.abs(move).max() < 1e-8:
            break
    return found, carried @ (slip(found) / np.linalg.norm(slip(found), axis=1)[:, None])
