"""Triangles of fixed surfaces: meshes and height fields from files, checked, and the .obj that a model keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.regular_files import read_binary_file
from ...schemas.surfaces import HeightFieldShape, Surface, SurfaceMeshShape
from ..io.arrays import read_npy
from .meshes import Mesh, check_closed, mass_properties, read_mesh

Array = NDArray[np.float64]

LEAST_HEIGHT = 1e-9
"""Least height of a triangle in units of its longest side; below, it is degenerate."""
MOST_TRIANGLES = 4_000_000
"""Maximum number of triangles of a surface."""
LARGEST_RATIO, LARGEST_M = 100.0, 10.0
"""Largest extent of a mesh in units of the largest body, and in metres; beyond both, it is in another unit."""


def read_surface(surface: Surface, root: Path, body_m: float | None = None) -> Mesh | None:
    """Read the triangles of a surface, and check them; None for shapes without a file.

    Args:
        surface: The surface.
        root: The directory that its file lies in.
        body_m: Diameter of the largest body [m], where it is known.

    Raises:
        InputDataError: If the file is missing or wrong, a triangle is degenerate, heights are not finite, the mesh is
            not closed where a solid is wanted, or it is far too large for the bodies.
    """
    if surface.height_field is not None:
        mesh = _height_field(surface.height_field, root / surface.height_field.path)
        path = root / surface.height_field.path
    elif surface.mesh is not None:
        path = root / surface.mesh.path
        mesh = read_mesh(path)
    else:
        return None
    if len(mesh.faces) > MOST_TRIANGLES:
        raise InputDataError(
            f"{path}: {len(mesh.faces)} triangles.",
            f"up to {MOST_TRIANGLES}.",
            "simplify the mesh, or coarsen the grid.",
        )
    require_areas(mesh.corners(), str(path))
    _require_metres(mesh, path, body_m)
    if surface.mesh is not None and inside_of(surface.mesh, mesh, path) == "closed":
        return _outward(mesh, path)
    return mesh


def inside_of(shape: SurfaceMeshShape, mesh: Mesh, path: Path | str) -> str:
    """Return what is inside a mesh: as the shape says, or closed where the mesh is closed, else none.

    Raises:
        InputDataError: If the shape says that it is closed, and it is not.
    """
    if shape.inside in ("none", "behind"):
        return str(shape.inside)
    try:
        check_closed(mesh, path)
    except InputDataError as error:
        if shape.inside is None:
            return "none"
        raise InputDataError(
            f"{path}: a surface with inside = 'closed' is not watertight: {error.found.split(': ', 1)[-1]}",
            error.allowed,
            "close it, or leave out inside: an open mesh is a sheet that bodies touch from both sides.",
        ) from error
    return "closed"


def stored(surface: Surface, mesh: Mesh | None, name: str) -> Surface:
    """Return a surface as a model keeps it: its triangles in a file of the model, and what is inside."""
    if mesh is None:
        return surface
    if surface.height_field is not None:
        inside = "behind"
    else:
        inside = inside_of(surface.mesh or SurfaceMeshShape(path=name), mesh, name)
    shape = SurfaceMeshShape.model_validate({"path": name, "inside": inside})
    return surface.model_copy(update={"mesh": shape, "height_field": None})


def surface_meshes(surfaces: Sequence[Surface], root: Path, body_m: float | None = None) -> Mapping[str, Mesh]:
    """Read the triangles of all surfaces that have some, by name; see :func:`read_surface`."""
    found = {surface.name: read_surface(surface, root, body_m) for surface in surfaces}
    return {name: mesh for name, mesh in found.items() if mesh is not None}


def obj_text(mesh: Mesh) -> str:
    """Return a mesh as the text of an .obj; its numbers are read back bit for bit."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join(lines) + "\n"


def require_areas(corners: Array, name: str) -> None:
    """Refuse triangles (F, 3, 3) without an area."""
    sides = np.roll(corners, -1, 1) - corners
    longest = np.linalg.norm(sides, axis=2).max(1)
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    wrong = np.flatnonzero(~(area > LEAST_HEIGHT * longest**2))
    if len(wrong):
        place = ", ".join(f"{x:g}" for x in corners[wrong[0], 0])
        raise InputDataError(
            f"{name}: {len(wrong)} of {len(corners)} triangles are degenerate, the first at ({place}) m.",
            "triangles with an area.",
            "clean the mesh (remove degenerate faces) and export it again.",
        )


def _outward(mesh: Mesh, path: Path) -> Mesh:
    """Return a closed mesh with its triangles facing outwards; a sheet is refused."""
    mass_properties(mesh, path)
    volume = float(np.linalg.det(mesh.corners() - mesh.vertices.mean(0)).sum())
    return mesh if volume > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def _require_metres(mesh: Mesh, path: Path, body_m: float | None) -> None:
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if body_m is not None and extent > LARGEST_M and extent > LARGEST_RATIO * body_m:
        raise InputDataError(
            f"{path}: the surface is {extent:.4g} m long, {extent / body_m:.0f} times as long as the largest body.",
            f"metres: up to {LARGEST_M:g} m, or {LARGEST_RATIO:g} times the largest body.",
            "export the mesh in metres (is it in millimetres?).",
        )


def _heights(path: Path) -> Array:
    """Return the numbers of a .npy (R, C), or the brightness of a grey picture, 0 to 1."""
    if path.suffix.lower() == ".npy":
        grid = read_npy(path)
        found, white = f"{grid.dtype} {grid.shape}", 1.0
    elif path.suffix.lower() == ".png":
        grid = _picture(path)
        found, white = f"a picture of shape {grid.shape}", float(np.iinfo(grid.dtype.name).max)
    else:
        raise InputDataError(
            f"{path}: a height field with the suffix '{path.suffix}'.",
            ".png or .npy.",
            "save the heights as .npy or .npz.",
        )
    if not (grid.ndim == 2 and min(grid.shape, default=0) >= 2 and grid.dtype.kind in "fiu"):
        raise InputDataError(
            f"{path}: {found}.",
            "a grey picture, or numbers in rows and columns, at least 2 x 2.",
            "correct the file, or take the original.",
        )
    return grid.astype(float) / white


def _picture(path: Path) -> NDArray[Any]:
    """Return the pixels of a picture as they are stored."""
    pixels = cv2.imdecode(np.frombuffer(read_binary_file(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputDataError(f"{path}: the picture does not decode.", todo="export the height field again.")
    return pixels


def _height_field(shape: HeightFieldShape, path: Path) -> Mesh:
    heights = shape.height_m * _heights(path)
    rows, columns = heights.shape
    if not np.isfinite(heights).all():
        row, column = (int(k) for k in np.argwhere(~np.isfinite(heights))[0])
        raise InputDataError(
            f"{path}: the height in row {row}, column {column} is not finite.",
            todo="fill the gaps of the height field.",
        )
    x = np.linspace(-0.5, 0.5, columns) * shape.size_m[0]
    y = np.linspace(0.5, -0.5, rows) * shape.size_m[1]
    vertices = np.stack((*np.meshgrid(x, y), heights), -1).reshape(-1, 3)
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel(), at[:-1, :-1].ravel()
    return Mesh(vertices, np.concatenate((np.stack((a, b, c), 1), np.stack((a, c, d), 1))))
