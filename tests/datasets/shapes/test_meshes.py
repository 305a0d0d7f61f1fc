"""Mass properties of meshes against the formulas of solids, and the readers of .obj and .stl."""

import struct
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets import Mesh, mass_properties, read_mesh
from cgwm.datasets.shapes.meshes import box_properties, sphere_properties
from cgwm.schemas import InputDataError

BOX_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
BOX_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
BOX_FACES = np.concatenate([BOX_QUADS[:, [0, 1, 2]], BOX_QUADS[:, [0, 2, 3]]])


def box(half_extents: tuple[float, float, float] = (0.01, 0.02, 0.03)) -> Mesh:
    return Mesh(BOX_CORNERS * half_extents, BOX_FACES)


def ball(subdivisions: int) -> Mesh:
    """Return a unit ball: an octahedron whose triangles are halved again and again."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    triangles = vertices[faces]
    for _ in range(subdivisions):
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        ab, bc, ca = a + b, b + c, c + a
        triangles = (
            np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]).transpose(0, 2, 1, 3).reshape(-1, 3, 3)
        )
        triangles /= np.linalg.norm(triangles, axis=-1, keepdims=True)
    corners, index = np.unique(triangles.reshape(-1, 3).round(12), axis=0, return_inverse=True)
    return Mesh(corners, index.reshape(-1, 3))


def test_box_is_exact() -> None:
    found, expected = mass_properties(box()), box_properties(np.array([0.01, 0.02, 0.03]))
    assert found.volume_m3 == pytest.approx(8 * 6e-6, rel=1e-12) == expected.volume_m3
    np.testing.assert_allclose(found.com_m, 0, atol=1e-17)
    np.testing.assert_allclose(found.inertia_per_kg, expected.inertia_per_kg, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(np.diag(found.inertia_per_kg), np.array([4 + 9, 1 + 9, 1 + 4]) * 1e-4 / 3, rtol=1e-12)


def test_ellipsoid_converges_to_its_formula() -> None:
    """A mesh inscribed in the ellipsoid is smaller than it; both errors fall fourfold with each halving."""
    half_axes = np.array([0.05, 0.03, 0.02])
    inertia = np.diag((half_axes @ half_axes - half_axes**2) / 5)
    errors = []
    for subdivisions in (3, 4):
        unit = ball(subdivisions)
        found = mass_properties(Mesh(unit.vertices * half_axes, unit.faces))
        volume = 4 / 3 * np.pi * half_axes.prod()
        assert found.volume_m3 < volume
        errors.append([1 - found.volume_m3 / volume, np.abs(found.inertia_per_kg - inertia).max() / inertia.max()])
    ratio = np.array(errors[0]) / errors[1]
    assert np.all(np.array(errors[1]) < 0.01) and np.all((ratio > 3.5) & (ratio < 4.5))
    np.testing.assert_allclose(sphere_properties(2.0).inertia_per_kg, np.eye(3) * 1.6)


def test_law_of_rotation_and_translation() -> None:
    """Turned and moved, inertia turns with the body and the centre of mass goes along, far from the origin too."""
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    shift = np.array([10.0, -20.0, 5.0])
    still, moved = mass_properties(box()), mass_properties(Mesh(box().vertices @ rotation.T + shift, BOX_FACES))
    np.testing.assert_allclose(moved.com_m, shift, atol=1e-13)
    np.testing.assert_allclose(moved.inertia_per_kg, rotation @ still.inertia_per_kg @ rotation.T, atol=1e-13)


def test_triangles_that_all_face_inwards_give_the_same_solid() -> None:
    inward = mass_properties(Mesh(box().vertices, BOX_FACES[:, ::-1]))
    np.testing.assert_allclose(inward.inertia_per_kg, mass_properties(box()).inertia_per_kg)
    assert inward.volume_m3 > 0


def obj_text(mesh: Mesh) -> str:
    vertices = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in mesh.vertices.tolist())
    return (
        "# a box\nmtllib a.mtl\n"
        + vertices
        + "vt 0 0\n"
        + "".join(f"f {a + 1}/1 {b + 1}/1/1 {c + 1}//1\n" for a, b, c in mesh.faces)
    )


def stl_binary(mesh: Mesh) -> bytes:
    triangles = b"".join(struct.pack("<12fH", 0, 0, 0, *mesh.vertices[face].ravel(), 0) for face in mesh.faces)
    return b"solid but binary".ljust(80) + struct.pack("<I", len(mesh.faces)) + triangles


def stl_text(mesh: Mesh) -> str:
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x!r} {y!r} {z!r}\n" for x, y, z in mesh.vertices[face].tolist())
        + "endloop\nendfacet\n"
        for face in mesh.faces
    )
    return f"solid box\n{facets}endsolid box\n"


def test_formats_agree(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(obj_text(box()))
    (tmp_path / "b.stl").write_bytes(stl_binary(box()))
    (tmp_path / "c.STL").write_text(stl_text(box()))
    quads = "".join("f " + " ".join(str(k - 8) for k in quad) + "\n" for quad in BOX_QUADS)
    (tmp_path / "d.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in box().vertices) + quads)
    for name in ("a.obj", "b.stl", "c.STL", "d.obj"):
        mesh = read_mesh(tmp_path / name)
        assert mesh.vertices.shape == (8, 3) and mesh.faces.shape == (12, 3)
        expected = mass_properties(box()).inertia_per_kg
        np.testing.assert_allclose(mass_properties(mesh).inertia_per_kg, expected, rtol=1e-6, atol=1e-12)


def test_open_mesh_is_refused() -> None:
    with pytest.raises(InputDataError) as caught:
        mass_properties(Mesh(box().vertices, BOX_FACES[1:]), "box.obj")
    assert str(caught.value) == (
        "box.obj: the mesh is not closed, or its triangles are not oriented alike: at 3 of 18 edges the triangles do "
        "not match.\nAllowed: a closed surface whose triangles all face outwards.\n"
        "Next: close it (for example in MeshLab or Blender), or give another shape."
    )
    flipped = BOX_FACES.copy()
    flipped[0] = flipped[0, ::-1]
    with pytest.raises(InputDataError, match="at 3 of 18 edges"):
        mass_properties(Mesh(box().vertices, flipped))


@pytest.mark.parametrize(("thickness", "sheet"), [(1e-7, True), (1e-6, True), (8e-6, False), (0.03, False)])
def test_a_sheet_is_refused_as_a_solid(thickness: float, sheet: bool) -> None:
    plate = Mesh(box().vertices * np.array([1.0, 1.0, thickness / 0.06]), BOX_FACES)
    if not sheet:
        assert mass_properties(plate).volume_m3 == pytest.approx(0.02 * 0.04 * thickness)
        return
    with pytest.raises(InputDataError) as caught:
        mass_properties(plate, "plate.obj")
    assert str(caught.value) == (
        f"plate.obj: the mesh is a sheet: {thickness:.2g} m thick on average, and 0.04 m long.\n"
        "Allowed: a solid that is thicker than 0.0001 of its length.\n"
        "Next: give the surface its thickness (in Blender: Solidify), or give another shape, such as a box."
    )


def test_two_boxes_that_share_an_edge_are_closed() -> None:
    """Four triangles meet at the shared edge; the solid is that of both boxes."""
    corners = np.concatenate([box().vertices, box().vertices + np.array([0.02, 0.04, 0.0])])
    vertices, index = np.unique(corners.round(9), axis=0, return_inverse=True)
    both = Mesh(vertices, index.reshape(-1)[np.concatenate([BOX_FACES, BOX_FACES + 8])])
    assert len(vertices) == 14
    found = mass_properties(both)
    assert found.volume_m3 == pytest.approx(2 * 8 * 6e-6)
    np.testing.assert_allclose(found.com_m, [0.01, 0.02, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("a.ply", b"", "a mesh with the suffix '.ply'"),
        ("a.obj", b"v 0 0 0\n", "the mesh has no triangles"),
        ("a.obj", b"v 0 0 0\nf 1 2 3\n", "line 2: a face of 3 corners, after 1 vertices"),
        ("a.obj", b"v 0 0\n", "line 1: a vertex of 2 coordinate"),
        ("a.obj", b"v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n", "vertices that are not finite"),
        ("a.stl", stl_binary(box())[:-7], "it is cut off"),
        ("a.stl", b"x" * 80 + stl_binary(box())[80:-7], "677 bytes for 12 triangles; it is cut off or no .stl"),
        ("a.stl", stl_text(box())[:-20].encode(), "it is cut off"),
    ],
)
def test_files_that_are_no_meshes(tmp_path: Path, name: str, data: bytes, expected: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputDataError) as caught:
        read_mesh(tmp_path / name)
    assert expected in str(caught.value) and str(tmp_path / name) in str(caught.value)
