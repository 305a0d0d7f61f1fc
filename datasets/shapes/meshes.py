"""Closed triangle meshes (.obj, .stl), and the mass properties of solids of uniform density."""

# Why trimesh does not do this: it reads a truncated .stl without an error, its messages have no line numbers, and its
# `is_watertight` is False where four triangles meet at an edge, as in scans and unions of parts. Its mass properties
# are as accurate as these only if the mesh is centred first; they would replace seven lines and take 0.2 s to import.

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError, Shape
from ...schemas.regular_files import read_binary_file
from ..io.cells import number_of

Array = NDArray[np.float64]

_EXPORT = "export the mesh again, or take the original."

MOST_BYTES = 8 << 30
"""Largest size of the file of a mesh [bytes]."""
LEAST_THICKNESS = 1e-4
"""Smallest mean thickness of a solid, in units of its length: half of that of a sheet of paper."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh."""

    vertices: Array
    """Corners [m], body frame, shape (V, 3)."""
    faces: NDArray[np.int64]
    """Indices of each triangle's corners, anticlockwise seen from outside, shape (F, 3)."""

    def corners(self) -> Array:
        """Return the triangles' corners [m], shape (F, 3 corners, 3)."""
        return self.vertices[self.faces]


@dataclass(frozen=True, eq=False)
class SolidProperties:
    """A solid of uniform density."""

    volume_m3: float
    """Volume [m3]."""
    com_m: Array
    """Centre of mass [m], in the frame of the solid, shape (3,)."""
    inertia_per_kg: Array
    """Inertia tensor about the centre of mass per kilogram [m2], shape (3, 3)."""


def read_mesh(path: Path | str, merge: bool = True) -> Mesh:
    """Read a mesh by its suffix: .obj (polygons are cut into triangles) or .stl (text or binary), in metres.

    Args:
        path: The file.
        merge: Join vertices at one place, which sorts them, and drop triangles without area. False keeps the order of
            the vertices of an .obj; an .stl has none, so its vertices are joined in any case.

    Raises:
        InputDataError: If it is missing, cut off, empty or holds numbers that are not finite.
    """
    path = Path(path)
    mesh = _parsed(path, merge)
    if len(mesh.faces) == 0:
        raise InputDataError(f"{path}: the mesh has no triangles.", "a mesh with faces, not points alone.", _EXPORT)
    if not np.isfinite(mesh.vertices).all():
        raise InputDataError(f"{path}: the mesh has vertices that are not finite.", todo=_EXPORT)
    return mesh


def _parsed(path: Path, merge: bool) -> Mesh:
    """Return what a file says, by its suffix."""
    readers = {".obj": _read_obj, ".stl": _read_stl}
    if path.suffix.lower() not in readers:
        raise InputDataError(
            f"{path}: a mesh with the suffix '{path.suffix}'.",
            ".obj or .stl.",
            "convert the mesh to one of these formats.",
        )
    data = read_binary_file(path, MOST_BYTES)
    try:
        mesh = readers[path.suffix.lower()](data)
        return _merged(mesh) if merge or path.suffix.lower() == ".stl" else mesh
    except (ValueError, IndexError, OverflowError) as error:
        raise InputDataError(f"{path}: no mesh that can be read: {str(error)[:200]}.", todo=_EXPORT) from None


def mass_properties(mesh: Mesh, path: Path | str = "mesh") -> SolidProperties:
    """Check that a mesh is closed, and return volume, centre of mass and inertia of the solid that it bounds, exactly.

    Args:
        mesh: A closed mesh with joined vertices; if its triangles all face inwards, they are taken the other way round.
        path: Its file, for messages.

    Raises:
        InputDataError: If it is not closed, not consistently oriented, encloses no volume, or is a sheet.
    """
    check_closed(mesh, path)
    return solid_properties(mesh, path)


def joined_properties(parts: Sequence[Mesh], what: str) -> SolidProperties:
    """Return volume, centre of mass and inertia of closed parts of one density that do not overlap.

    Source: the parallel-axis theorem.

    Args:
        parts: Closed meshes.
        what: One of them, for messages.

    Raises:
        InputDataError: If one is not closed, or as of `mass_properties`.
    """
    solids = [mass_properties(part, what) for part in parts]
    volume = sum(solid.volume_m3 for solid in solids)
    com = sum((solid.volume_m3 * solid.com_m for solid in solids), np.zeros(3)) / volume
    inertia = np.zeros((3, 3))
    for solid in solids:
        arm, share = solid.com_m - com, solid.volume_m3 / volume
        inertia += share * (solid.inertia_per_kg + arm @ arm * np.eye(3) - np.outer(arm, arm))
    return SolidProperties(volume, com, inertia)


def solid_properties(mesh: Mesh, path: Path | str = "mesh") -> SolidProperties:
    """Integrate the mass properties of a mesh that is known to be closed; its vertices need not be joined.

    Source: the signed tetrahedra (0, a, b, c) of the triangles; over one, the integral of x xT is
    det [a b c] / 120 (aaT + bbT + ccT + (a+b+c)(a+b+c)T) (derived; as Tonon, J. Math. Stat. 1(1), 2004).

    Args:
        mesh: A closed mesh; if its triangles all face inwards, they are taken the other way round.
        path: Its file, for messages.

    Raises:
        InputDataError: If it encloses no volume, or is a sheet.
    """
    # About the vertices' mean, so that a solid far from its origin loses no digits.
    origin = mesh.vertices.mean(axis=0)
    corners = mesh.corners() - origin
    six_volumes = np.linalg.det(corners)
    six_volume = float(six_volumes.sum())
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if abs(six_volume) < 1e-9 * extent**3:
        raise InputDataError(
            f"{path}: the mesh encloses no volume.",
            "a closed surface around a solid.",
            "close the mesh, or describe the shape by spheres or a box.",
        )
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    twice_area = float(np.linalg.norm(np.cross(*sides), axis=1).sum())
    # that of a plate; of other solids their volume over half of their surface
    thickness = abs(six_volume) / 6 / (twice_area / 4)
    if thickness < LEAST_THICKNESS * extent:
        raise InputDataError(
            f"{path}: the mesh is a sheet: {thickness:.2g} m thick on average, and {extent:.2g} m long.",
            f"a solid that is thicker than {LEAST_THICKNESS:g} of its length.",
            "give the surface its thickness (in Blender: Solidify), or give another shape, such as a box.",
        )
    sums = corners.sum(axis=1)
    com = np.einsum("f,fi->i", six_volumes, sums) / (4 * six_volume)
    outer = np.einsum("f,fki,fkj->ij", six_volumes, corners, corners)
    outer += np.einsum("f,fi,fj->ij", six_volumes, sums, sums)
    second_moment = outer / (20 * six_volume) - np.outer(com, com)
    inertia = np.trace(second_moment) * np.eye(3) - second_moment
    return SolidProperties(abs(six_volume) / 6, com + origin, inertia)


def check_closed(mesh: Mesh, path: Path | str = "mesh") -> None:
    """Raise InputDataError unless along every edge as many triangles run one way as the other.

    Then the surface has no boundary, which is what the divergence theorem needs; edges where more than two
    triangles meet, as scans have them, are no fault.
    """
    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, index = np.unique(low * len(mesh.vertices) + high, return_inverse=True)
    balance = np.bincount(index.reshape(-1), np.where(edges[:, 0] == low, 1, -1))
    unbalanced = int(np.count_nonzero(balance))
    if unbalanced:
        raise InputDataError(
            f"{path}: the mesh is not closed, or its triangles are not oriented alike: at {unbalanced} of "
            f"{len(balance)} edges the triangles do not match.",
            "a closed surface whose triangles all face outwards.",
            "close it (for example in MeshLab or Blender), or give another shape.",
        )


def box_properties(half_extents_m: Array) -> SolidProperties:
    """Return the properties of a box, centred at the origin; half extents [m], shape (3,)."""
    squares = np.asarray(half_extents_m, np.float64) ** 2
    inertia = np.diag((squares.sum() - squares) / 3)
    return SolidProperties(8 * float(np.prod(half_extents_m)), np.zeros(3), inertia)


def sphere_properties(radius_m: float) -> SolidProperties:
    """Return the properties of a solid ball of radius [m], centred at the origin."""
    return SolidProperties(4 / 3 * np.pi * radius_m**3, np.zeros(3), np.eye(3) * 0.4 * radius_m**2)


def primitive_properties(shape: Shape | None) -> SolidProperties | None:
    """Return the properties of a box or a ball; None of other shapes."""
    if shape is not None and shape.box is not None:
        return box_properties(np.array(shape.box.half_extents_m))
    return None if shape is None or shape.sphere is None else sphere_properties(shape.sphere.radius_m)


def _read_obj(data: bytes) -> Mesh:
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            if len(words) < 4:
                raise ValueError(f"line {number}: a vertex of {len(words) - 1} coordinate(s)")
            vertices.append([number_of(word) for word in words[1:4]])
        elif words[0] == "f":
            corners = _face_corners(words[1:], len(vertices), number)
            faces += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
    return Mesh(np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3))


def _face_corners(words: list[str], count: int, number: int) -> list[int]:
    """Return the vertices of a face, from 0, on line `number` of an .obj with `count` vertices so far.

    Indices count from 1, negative ones from the vertex read last.
    """
    listed = [int(word.split("/")[0]) for word in words]
    corners = [k - 1 if k > 0 else count + k for k in listed]
    absent = [k for k, corner in zip(listed, corners, strict=True) if not 0 <= corner < count]
    if len(corners) < 3 or absent:
        fault = f"line {number}: a face of {len(corners)} corners, after {count} vertices"
        if absent:
            fault += f" (a face names vertex {max(absent, key=abs)} of {count})"
        raise ValueError(fault)
    return corners


def _read_stl(data: bytes) -> Mesh:
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + 50 * count:
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.frombuffer(data, record, count, 84)["corners"].astype(np.float64)
    elif data[:5] == b"solid":
        corners = _stl_corners(data.decode("utf-8", "replace"))
    else:
        raise ValueError(f"{len(data)} bytes for {count} triangles; it is cut off or no .stl")
    corners = corners.reshape(-1, 3)
    return Mesh(corners, np.arange(len(corners)).reshape(-1, 3))


def _stl_corners(text: str) -> Array:
    """Return the corners (3 F, 3) of the triangles of an .stl in text."""
    words = [line.split() for line in text.splitlines()]
    listed = [[number_of(number) for number in word[1:4]] for word in words if word[:1] == ["vertex"]]
    if len(listed) % 3 or not any(word[:1] == ["endsolid"] for word in words):
        raise ValueError("it is cut off")
    return np.array(listed, np.float64)


def _merged(mesh: Mesh) -> Mesh:
    """Join vertices at one place (textures and .stl repeat them), and drop triangles without area."""
    if len(mesh.vertices) == 0:
        return mesh
    unique, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    a, b, c = faces.T
    return Mesh(unique, faces[(a != b) & (b != c) & (c != a)])
