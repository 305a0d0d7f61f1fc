"""A tray of five boxes, and a model of bodies in it, built from numbers."""

from dataclasses import replace

import numpy as np
from cgwm.datasets.models.model import Model
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.schemas import Pose, Surface

from .small_model import HALF, small_model

WIDE, HIGH, THICK = 0.25, 0.12, 0.01
FLOOR_M = 0.3
"""Half the inner sides of the tray, the height of its walls, half their thickness, and the height of its floor [m]."""


def tray() -> tuple[Surface, ...]:
    """Return a floor and four walls, without a ground below."""

    def wall(name: str, position: tuple[float, ...], half: tuple[float, ...]) -> Surface:
        place = (position[0], position[1], position[2] + FLOOR_M)
        return Surface.model_validate(
            {"name": name, "pose": {"position_m": place}, "box": {"half_extents_m": half}, "material": "felt"}
        )

    far, out = WIDE + THICK, WIDE + 2 * THICK
    sides = [("left", (-far, 0), (THICK, out)), ("right", (far, 0), (THICK, out))]
    sides += [("front", (0, -far), (WIDE, THICK)), ("back", (0, far), (WIDE, THICK))]
    floor = wall("floor", (0, 0, -THICK), (out, out, THICK))
    return (floor, *(wall(name, (*at, HIGH / 2), (*half, HIGH / 2)) for name, at, half in sides))


def bowl() -> tuple[Surface, Mesh]:
    """Return a square bowl with a flat bottom as an open mesh, at the height of the tray."""
    ring = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
    vertices = np.concatenate((np.c_[0.2 * ring, np.zeros(4)], np.c_[0.35 * ring, np.full(4, 0.15)]))
    faces = [(0, 1, 2), (0, 2, 3)]
    for k in range(4):
        n = (k + 1) % 4
        faces += [(k, k + 4, n + 4), (k, n + 4, n)]
    shape = {"name": "bowl", "pose": {"position_m": (0, 0, FLOOR_M)}, "mesh": {"path": "bowl.obj", "inside": "none"}}
    return Surface.model_validate(shape), Mesh(vertices, np.array(faces))


def in_tray(surfaces: tuple[Surface, ...] | None = None, mesh: Mesh | None = None) -> Model:
    """Return the small model with two cubes over the tray, or over other surfaces, and without a ground."""
    plain = small_model(visible=False)
    first = plain.file.bodies[0]
    bodies = tuple(
        first.model_copy(update={"name": name, "photo_pose": Pose(position_m=(x, 0, FLOOR_M + HALF))})
        for name, x in (("cube", -0.1), ("other", 0.1))
    )
    update = {"bodies": bodies, "ground": None, "surfaces": tray() if surfaces is None else surfaces}
    file = plain.file.model_copy(update={**update, "parameters": plain.file.parameters[:2]})
    collision = {name: plain.collision["cube"] for name in ("cube", "other")}
    meshes = {} if mesh is None else {file.surfaces[0].name: mesh}
    return replace(plain, file=file, collision=collision, surface_meshes=meshes)
