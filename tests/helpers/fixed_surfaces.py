"""Fixed surfaces for the tests of physics, and closed and open meshes for them."""

import math

import numpy as np
from cgwm.pipeline.physics.surfaces.fixed_surface import BOX, CYLINDER, HALF_SPACE, MESH, FixedSurface
from cgwm.pipeline.physics.surfaces.mesh_topology import Topology
from cgwm.pipeline.physics.surfaces.surface_mesh import SurfaceMesh

from .worlds import batch

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def surface(name: str, kind: int, position=(0, 0, 0), quat=UPRIGHT, size=(0, 0, 0), mesh=None) -> FixedSurface:
    quat = np.asarray(quat, float)
    return FixedSurface(
        name=name,
        kind=kind,
        position=batch(position),
        quat_wxyz=batch(quat / np.linalg.norm(quat)),
        size=batch(size),
        mesh=mesh,
    )


def half_space(name="plane", **more) -> FixedSurface:
    return surface(name, HALF_SPACE, **more)


def box(half, name="box", **more) -> FixedSurface:
    return surface(name, BOX, size=half, **more)


def cylinder(radius, half, name="cylinder", **more) -> FixedSurface:
    return surface(name, CYLINDER, size=(radius, radius, half), **more)


def mesh_surface(vertices, faces, solid=False, name="mesh", **more) -> FixedSurface:
    mesh = SurfaceMesh(Topology.of(np.asarray(vertices, float), np.asarray(faces), solid=solid, name=name))
    return surface(name, MESH, mesh=mesh, **more)


def turn(axis, degrees) -> tuple[float, ...]:
    half = math.radians(degrees) / 2
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return (math.cos(half), *(math.sin(half) * axis))


def times_turn(a, b) -> tuple[float, ...]:
    """Return the product of two quaternions."""
    (w, *v), (s, *u) = a, b
    v, u = np.array(v), np.array(u)
    return (w * s - v @ u, *(w * u + s * v + np.cross(v, u)))


def groove(length=1.1, count=30, half_width=0.05):
    """Return a V-groove of 90 degrees along x, its bottom at z = 0, of triangles."""
    vertices, faces = [], []
    for x in np.linspace(-0.05, length - 0.05, count):
        vertices += [(x, -half_width, half_width), (x, 0, 0), (x, half_width, half_width)]
    for first in range(0, 3 * count - 3, 3):
        for k in (first, first + 1):
            faces += [(k, k + 3, k + 1), (k + 1, k + 3, k + 4)]
    return np.array(vertices, float), np.array(faces)


def box_mesh(half, pieces=3):
    """Return a closed box of pieces x pieces x 2 triangles a side, and its half sides."""
    steps = np.linspace(-1, 1, pieces + 1)
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            first = len(vertices)
            for u in steps:
                for v in steps:
                    point = np.zeros(3)
                    point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3] = sign, u, v
                    vertices.append(point * half)
            for i in range(pieces):
                for j in range(pieces):
                    a = first + i * (pieces + 1) + j
                    b, c, d = a + pieces + 1, a + pieces + 2, a + 1
                    quads = [(a, b, c), (a, c, d)]
                    faces += quads if sign > 0 else [face[::-1] for face in quads]
    return np.array(vertices), np.array(faces)
