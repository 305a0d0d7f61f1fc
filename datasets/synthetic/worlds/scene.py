"""A world before it is simulated: bodies, fixed surfaces, materials, and how every episode starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ....schemas import Ground, Pose, Shape, Surface
from ....schemas.capture import BoxShape, FileShape, SphereShape
from ..objects import SolidObject

Array = NDArray[np.float64]
Color = tuple[float, float, float]

GRAVITY_M_S2 = 9.81


@dataclass(frozen=True, kw_only=True)
class Thing:
    """A body of a world: a box, a ball, or a solid of convex parts."""

    name: str
    """Name of the body."""
    mass_kg: float
    """Its mass."""
    color: Color
    """Colour in pictures, red, green, blue from 0 to 1."""
    place: Pose
    """Pose before the scene begins; a dataset's rollouts begin near it."""
    half_extents_m: tuple[float, float, float] | None = None
    """Half the sides of a box; None for another shape."""
    radius_m: float | None = None
    """Radius of a ball; None for another shape."""
    solid: SolidObject | None = None
    """A solid with a mesh of its own; None for another shape."""

    @property
    def shape(self) -> Shape:
        """The shape, as a capture has it."""
        if self.solid is not None:
            return Shape(mesh=FileShape(path=f"{self.name}.obj"))
        if self.radius_m is not None:
            return Shape(sphere=SphereShape(radius_m=self.radius_m))
        assert self.half_extents_m is not None  # one of the three is given
        return Shape(box=BoxShape(half_extents_m=self.half_extents_m))

    @property
    def size_m(self) -> float:
        """Distance of its farthest point from the origin of its frame [m]."""
        if self.solid is not None:
            return self.solid.radius
        return self.radius_m or float(np.linalg.norm(self.half_extents_m or 0.0))


@dataclass(frozen=True, kw_only=True)
class WorldContact:
    """The true contact of all pairs: a damped spring along the normal, and friction by pair of materials."""

    natural_time_s: float
    """Inverse of the natural angular frequency of a contact."""
    damping_ratio: float
    """Damping ratio [1]."""
    stated: bool
    """Whether the capture states all numbers of the contact, so that none need be fitted."""
    friction: dict[tuple[str, str], float]
    """Coulomb coefficient [1] of each pair of materials that can touch, names in alphabetical order."""


@dataclass(frozen=True, kw_only=True)
class WorldEpisode:
    """Start of an episode."""

    name: str
    """Its name."""
    split: str
    """train or test."""
    length_s: float
    """Its duration [s]."""
    qpos: Array
    """Position [m] and quat_wxyz of each body, world frame, shape (bodies, 7)."""
    qvel: Array
    """Velocity of its frame's origin, world frame [m/s], and omega_body [rad/s], shape (bodies, 6)."""


@dataclass(frozen=True, kw_only=True)
class WorldPlan:
    """A world and its episodes."""

    name: str
    """Name of the scene."""
    seed: int
    """Its seed."""
    things: tuple[Thing, ...]
    """The bodies."""
    surfaces: tuple[Surface, ...]
    """Fixed surfaces, boxes all."""
    ground: Ground | None
    """The ground; None where the surfaces are all there is."""
    material: str
    """Material of the bodies."""
    contact: WorldContact
    """The true contact."""
    episodes: tuple[WorldEpisode, ...]
    """The episodes."""
    look_from_m: tuple[float, float, float]
    """Position of the camera of pictures, world frame."""
    look_at_m: tuple[float, float, float]
    """The point in the middle of pictures, world frame."""


def random_quat(rng: np.random.Generator) -> Array:
    """Return a uniformly random unit quaternion (w, x, y, z)."""
    quat = rng.standard_normal(4)
    return quat / np.linalg.norm(quat)
