"""Families of rigid test objects: solid extruded polygons with exact mass properties, no balls."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAMILIES = ("box", "wedge", "l_block", "hexagonal_prism", "t_block")
MASS_RANGE_KG = (0.1, 0.5)


@dataclass(frozen=True, kw_only=True)
class SolidObject:
    """A solid of uniform density in its body frame, whose origin is the mean of the corners.

    The origin therefore lies well inside, and differs from the centre of mass in asymmetric families.

    Args:
        family: One of `FAMILIES`.
        vertices: Corners of the closed surface [m], shape (vertex, 3).
        faces: Triangles, counter-clockwise from outside, shape (face, 3).
        parts: Corners of the convex parts [m], each of shape (corner, 3); their union is the solid.
        mass: Mass [kg].
        com: Centre of mass [m], shape (3,).
        inertia: Inertia about the centre of mass, body axes [kg m2], shape (3, 3).
    """

    family: str
    vertices: Array
    faces: NDArray[np.int64]
    parts: tuple[Array, ...]
    mass: float
    com: Array
    inertia: Array

    @property
    def radius(self) -> float:
        """Greatest distance of the surface from the body frame's origin [m]."""
        return float(np.linalg.norm(self.vertices, axis=1).max())


def make_object(seed: int) -> SolidObject:
    """Draw an object; consecutive seeds cycle through the families.

    Args:
        seed: Any integer >= 0; determines family, dimensions (overall 7 to 14 cm) and mass.
    """
    rng = np.random.default_rng([seed, 1])
    family = FAMILIES[seed % len(FAMILIES)]
    outline, convex, depth = _OUTLINES[family](rng)
    middle = outline.mean(axis=0)
    outline = outline - middle
    vertices, faces = extrude(outline, depth)
    parts = tuple(extrude(part - middle, depth)[0] for part in convex)
    mass = float(np.round(rng.uniform(*MASS_RANGE_KG), 3))
    volume, com, second = volume_moments(vertices, faces)
    inertia = mass / volume * (np.trace(second) * np.eye(3) - second)
    inertia -= mass * (com @ com * np.eye(3) - np.outer(com, com))
    return SolidObject(family=family, vertices=vertices, faces=faces, parts=parts, mass=mass, com=com, inertia=inertia)


def _rectangle(x0: float, x1: float, y0: float, y1: float) -> Array:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _box(rng: np.random.Generator) -> tuple[Array, list[Array], float]:
    width, height, depth = rng.uniform([0.10, 0.075, 0.07], [0.135, 0.095, 0.085])
    outline = _rectangle(0, width, 0, height)
    return outline, [outline], depth


def _wedge(rng: np.random.Generator) -> tuple[Array, list[Array], float]:
    width, height, depth = rng.uniform([0.10, 0.075, 0.075], [0.135, 0.095, 0.10])
    top = rng.uniform(0.25, 0.4) * width
    outline = np.array([[0, 0], [width, 0], [top, height], [0, height]])
    return outline, [outline], depth


def _l_block(rng: np.random.Generator) -> tuple[Array, list[Array], float]:
    width, height, depth = rng.uniform([0.11, 0.095, 0.07], [0.14, 0.12, 0.09])
    foot, stem = rng.uniform(0.42, 0.5) * height, rng.uniform(0.4, 0.5) * width
    outline = np.array([[0, 0], [width, 0], [width, foot], [stem, foot], [stem, height], [0, height]])
    return outline, [_rectangle(0, width, 0, foot), _rectangle(0, stem, foot, height)], depth


def _hexagonal_prism(rng: np.random.Generator) -> tuple[Array, list[Array], float]:
    radius, depth = rng.uniform([0.045, 0.075], [0.058, 0.12])
    angle = np.arange(6) * np.pi / 3
    outline = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return outline, [outline], depth


def _t_block(rng: np.random.Generator) -> tuple[Array, list[Array], float]:
    width, height, depth = rng.uniform([0.12, 0.10, 0.07], [0.14, 0.12, 0.09])
    bar, stem = rng.uniform(0.42, 0.5) * height, rng.uniform(0.38, 0.46) * width
    left, right, base = (width - stem) / 2, (width + stem) / 2, height - bar
    outline = np.array(
        [[left, 0], [right, 0], [right, base], [width, base], [width, height], [0, height], [0, base], [left, base]]
    )
    return outline, [_rectangle(0, width, base, height), _rectangle(left, right, 0, base)], depth


_OUTLINES = {
    "box": _box,
    "wedge": _wedge,
    "l_block": _l_block,
    "hexagonal_prism": _hexagonal_prism,
    "t_block": _t_block,
}


def extrude(outline: Array, depth: float) -> tuple[Array, NDArray[np.int64]]:
    """Extrude a polygon along z into a closed triangle mesh.

    Args:
        outline: Simple polygon, counter-clockwise [m], shape (corner, 2).
        depth: Length along z [m]; the solid reaches from -depth/2 to depth/2.

    Returns:
        Vertices [m], shape (2 corner, 3), and faces, counter-clockwise from outside, shape (face, 3).
    """
    count = len(outline)
    vertices = np.concatenate([np.c_[outline, np.full(count, z)] for z in (-depth / 2, depth / 2)])
    cap = triangulate(outline)
    this = np.arange(count)
    following = (this + 1) % count
    sides = [np.stack([this, following, following + count], 1), np.stack([this, following + count, this + count], 1)]
    return vertices, np.concatenate([cap[:, ::-1], cap + count, *sides])


def triangulate(outline: Array) -> NDArray[np.int64]:
    """Triangulate a simple counter-clockwise polygon (corner, 2) by ear clipping; return indices (corner - 2, 3)."""
    left = list(range(len(outline)))
    triangles = []
    while len(left) > 3:
        for place, corner in enumerate(left):
            before, after = left[place - 1], left[(place + 1) % len(left)]
            triangle = outline[[before, corner, after]]
            others = [outline[i] for i in left if i not in (before, corner, after)]
            if _turn(*triangle) > 1e-12 and not any(_inside(point, triangle) for point in others):
                triangles.append((before, corner, after))
                left.remove(corner)
                break
        else:
            raise ValueError("the outline is no simple counter-clockwise polygon")
    return np.array([*triangles, tuple(left)])


def _turn(a: Array, b: Array, c: Array) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _inside(point: Array, triangle: Array) -> bool:
    a, b, c = triangle
    return min(_turn(a, b, point), _turn(b, c, point), _turn(c, a, point)) > -1e-12


def volume_moments(vertices: Array, faces: NDArray[np.int64]) -> tuple[float, Array, Array]:
    """Integrate 1, x and x xᵀ over the solid inside a closed mesh.

    Source: derived; sum over the signed tetrahedra (0, a, b, c), for which
    ∫ x xᵀ dV = V/20 (s sᵀ + Σ v vᵀ) with s = a + b + c.

    Returns:
        Volume [m3], centroid [m] of shape (3,), second moment ∫ x xᵀ dV about the origin [m5] of shape (3, 3).
    """
    corners = vertices[faces]
    volumes = np.linalg.det(corners) / 6
    volume = float(volumes.sum())
    total = corners.sum(axis=1)
    centroid = (volumes[:, None] * total / 4).sum(axis=0) / volume
    products = np.einsum("fi,fj->fij", total, total) + np.einsum("fki,fkj->fij", corners, corners)
    return volume, centroid, np.einsum("f,fij->ij", volumes, products) / 20


def facet_normals(solid: SolidObject) -> Array:
    """Return the distinct outward unit normals of the surface, body frame, shape (facet, 3)."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distinct: list[Array] = []
    for normal in normals:
        if not any(normal @ other > 1 - 1e-9 for other in distinct):
            distinct.append(normal)
    return np.array(distinct)


def resting_down(solid: SolidObject) -> Array:
    """Return the body direction that points down in the most stable pose, which has the lowest centre of mass.

    Returns:
        Unit vector in the body frame, shape (3,).
    """
    best, height = None, np.inf
    for normal in facet_normals(solid):
        along = solid.vertices @ normal
        base = solid.vertices[along > along.max() - 1e-9]
        above = along.max() - solid.com @ normal
        if above < height - 1e-6 and _stands(base, normal, solid.com):
            best, height = normal, above
    if best is None:
        raise ValueError(f"the {solid.family} rests on none of its facets")
    return best


def _stands(base: Array, normal: Array, com: Array) -> bool:
    """Return whether the centre of mass lies above the convex hull of the base, at least 5 mm inside its edge."""
    from scipy.spatial import ConvexHull

    first = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    basis = np.stack([first, np.cross(normal, first)], axis=1)
    hull = ConvexHull(base @ basis)
    return bool((hull.equations[:, :2] @ (com @ basis) + hull.equations[:, 2]).max() < -0.005)


def write_obj(path: Path, solid: SolidObject) -> None:
    """Write the surface as Wavefront OBJ, body frame, metres."""
    _write_surface(path, solid.vertices, solid.faces)


def write_parts(folder: Path, solid: SolidObject) -> tuple[str, ...]:
    """Write the convex parts as `part0.obj`, `part1.obj`, ..., body frame, metres, and return these names."""
    names = tuple(f"part{number}.obj" for number in range(len(solid.parts)))
    for name, corners in zip(names, solid.parts, strict=True):
        _write_surface(folder / name, *hull_of(corners))
    return names


def hull_of(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return corners (vertex, 3) and triangles (face, 3) of the convex hull of points, its faces outwards."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    used = np.unique(hull.simplices)
    vertices, faces = points[used], np.searchsorted(used, hull.simplices).astype(np.int64)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * (a - vertices.mean(0))).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces


def _write_surface(path: Path, vertices: Array, faces: NDArray[np.int64]) -> None:
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in vertices]
    lines += ["f {} {} {}".format(*(face + 1)) for face in faces]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
