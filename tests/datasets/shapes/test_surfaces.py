"""Fixed surfaces from files: what is read, what a model keeps, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from cgwm.datasets.models.mjcf import write_mjcf
from cgwm.datasets.models.model import read_model, write_model
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.datasets.shapes.surfaces import obj_text, read_surface, stored
from cgwm.pipeline.geometry.rotation import quat_to_matrix
from cgwm.pipeline.physics import world_of_model
from cgwm.pipeline.physics.surfaces.fixed_surface import BOX, CYLINDER, HALF_SPACE, MESH
from cgwm.schemas import InputDataError, Surface
from helpers.fixed_surfaces import box_mesh, groove
from helpers.small_model import small_model
from pydantic import ValidationError


def write_obj(path: Path, vertices: Any, faces: Any) -> None:
    path.write_text(obj_text(Mesh(np.asarray(vertices, float), np.asarray(faces))))


def surface(**shape: Any) -> Surface:
    return Surface.model_validate({"name": "tray", **shape})


def test_a_height_field_from_a_picture_and_from_numbers(tmp_path: Path) -> None:
    grid = np.array([[0, 65535, 0], [13107, 0, 26214]], np.uint16)  # the first row is at the highest y
    cv2.imwrite(str(tmp_path / "h.png"), grid)
    np.save(tmp_path / "h.npy", grid / 65535)
    for name in ("h.png", "h.npy"):
        field = surface(height_field={"path": name, "size_m": (2, 1), "height_m": 0.5})
        mesh = read_surface(field, tmp_path)
        assert mesh is not None and len(mesh.faces) == 4
        at = {(x, y): z for x, y, z in mesh.vertices.tolist()}
        assert at[0, 0.5] == 0.5 and at[-1, -0.5] == pytest.approx(0.1) and at[1, -0.5] == pytest.approx(0.2)
        corners = mesh.corners()
        assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()
        kept = stored(field, mesh, "tray.obj")
        assert kept.height_field is None and kept.mesh is not None and kept.mesh.inside == "behind"


def test_a_closed_mesh_has_an_inside_and_faces_outwards(tmp_path: Path) -> None:
    vertices, faces = box_mesh((0.1, 0.2, 0.3), 1)
    write_obj(tmp_path / "in.obj", vertices, faces[:, ::-1])
    mesh = read_surface(surface(mesh={"path": "in.obj"}), tmp_path)
    assert mesh is not None and np.linalg.det(mesh.corners()).sum() / 6 == pytest.approx(8 * 0.1 * 0.2 * 0.3)
    kept = stored(surface(mesh={"path": "in.obj"}), mesh, "tray.obj")
    assert kept.mesh is not None and kept.mesh.inside == "closed"


def test_a_model_keeps_its_surfaces(tmp_path: Path) -> None:
    vertices, faces = groove(0.3, 4)
    track = Mesh(vertices, faces)
    shapes = [
        surface(mesh={"path": "x.obj"}),
        Surface.model_validate({"name": "sheet", "rectangle": {"half_extents_m": (0.1, 0.2)}}),
        Surface.model_validate({"name": "post", "cylinder": {"radius_m": 0.1, "half_length_m": 0.2}}),
        Surface.model_validate({"name": "block", "box": {"half_extents_m": (0.1, 0.2, 0.3)}, "material": "wood"}),
        Surface.model_validate({"name": "floor", "half_space": {}, "pose": {"position_m": (0, 0, -0.1)}}),
    ]
    model = small_model()
    file = model.file.model_copy(update={"surfaces": tuple(shapes)})
    written = write_model(tmp_path / "m", replace(model, file=file, surface_meshes={"tray": track}))
    again = read_model(tmp_path / "m")
    assert again.file.surfaces == written.file.surfaces
    shape = again.file.surfaces[0].mesh
    assert shape is not None and (shape.path, shape.inside) == ("tray.obj", "none")
    world = world_of_model(again)
    assert [one.kind for one in world.surfaces] == [MESH, BOX, CYLINDER, BOX, HALF_SPACE]
    assert world.surfaces[1].size.tolist() == [[0.1, 0.2, 0.0]] and world.surfaces[3].material == "wood"
    mesh = world.surfaces[0].mesh
    assert mesh is not None and not mesh.solid
    assert {tuple(x) for x in mesh.topology.corners.reshape(-1, 3)} == {tuple(x) for x in vertices}
    mujoco = pytest.importorskip("mujoco")
    scene = mujoco.MjModel.from_xml_string(write_mjcf(again))
    assert scene.ngeom == 27 + 1 + 4 + len(faces)


def test_surfaces_are_where_mujoco_puts_them() -> None:
    mujoco = pytest.importorskip("mujoco")
    pose = {"position_m": (0.3, -0.2, 0.1), "quat_wxyz": (0.5, 0.5, -0.1, 0.7)}
    shapes = [
        Surface.model_validate({"name": "track", "pose": pose, "mesh": {"path": "track.obj", "inside": "none"}}),
        Surface.model_validate({"name": "post", "pose": pose, "cylinder": {"radius_m": 0.1, "half_length_m": 0.2}}),
        Surface.model_validate({"name": "block", "pose": pose, "box": {"half_extents_m": (0.1, 0.2, 0.3)}}),
        Surface.model_validate({"name": "sheet", "pose": pose, "rectangle": {"half_extents_m": (0.1, 0.2)}}),
        Surface.model_validate({"name": "floor", "pose": pose, "half_space": {}}),
    ]
    model, track = small_model(), Mesh(*groove(0.3, 4))
    file = model.file.model_copy(update={"surfaces": tuple(shapes)})
    model = replace(model, file=file, surface_meshes={"track": track})
    scene = mujoco.MjModel.from_xml_string(write_mjcf(model))
    data = mujoco.MjData(scene)
    mujoco.mj_forward(scene, data)
    world = world_of_model(model)
    rotation = quat_to_matrix(world.surfaces[0].quat_wxyz)[0].numpy()
    for one in shapes[1:]:
        geom = scene.geom(one.name).id
        np.testing.assert_allclose(data.geom_xpos[geom], pose["position_m"], atol=1e-12)
        np.testing.assert_allclose(data.geom_xmat[geom].reshape(3, 3), rotation, atol=1e-9)
    expected = track.corners() @ rotation.T + pose["position_m"]
    for index, triangle in enumerate(expected):
        geom = scene.geom(f"track_{index}").id
        first = scene.mesh_vertadr[scene.geom_dataid[geom]]
        corners = scene.mesh_vert[first : first + 4] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        apart = np.linalg.norm(triangle[:, None] - corners, axis=2).min(1)
        assert apart.max() < 1e-6  # MuJoCo keeps corners in single precision


def _refused(edit: Callable[[Path], Surface], tmp_path: Path, body_m: float | None = None) -> str:
    with pytest.raises(InputDataError) as caught:
        read_surface(edit(tmp_path), tmp_path, body_m)
    return str(caught.value).replace(str(tmp_path), "")


def _open(root: Path) -> Surface:
    vertices, faces = box_mesh((0.1, 0.1, 0.1), 1)
    write_obj(root / "m.obj", vertices, faces[1:])
    return surface(mesh={"path": "m.obj", "inside": "closed"})


def _degenerate(root: Path) -> Surface:
    write_obj(root / "m.obj", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.5, 0, 0)], [(0, 1, 2), (0, 3, 1)])
    return surface(mesh={"path": "m.obj"})


def _millimetres(root: Path) -> Surface:
    write_obj(root / "m.obj", 1000 * groove(0.3)[0], groove(0.3)[1])
    return surface(mesh={"path": "m.obj"})


def _holes(root: Path) -> Surface:
    np.save(root / "h.npy", np.array([[0.0, 1.0], [np.nan, 0.0]]))
    return surface(height_field={"path": "h.npy", "size_m": (1, 1)})


def _line(root: Path) -> Surface:
    np.save(root / "h.npy", np.zeros(7))
    return surface(height_field={"path": "h.npy", "size_m": (1, 1)})


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (_open, "/m.obj: a surface with inside = 'closed' is not watertight: the mesh is not closed"),
        (_degenerate, "/m.obj: 1 of 2 triangles are degenerate, the first at (0, 0, 0) m."),
        (_millimetres, "/m.obj: the surface is 300 m long, 3000 times as long as the largest body."),
        (_holes, "/h.npy: the height in row 1, column 0 is not finite."),
        (_line, "/h.npy: float64 (7,)."),
    ],
)
def test_what_is_refused(edit: Callable[[Path], Surface], text: str, tmp_path: Path) -> None:
    assert text in _refused(edit, tmp_path, 0.1)


def test_a_surface_has_one_shape() -> None:
    with pytest.raises(ValidationError, match=r"exactly one of half_space, .*; found none"):
        surface()
    with pytest.raises(ValidationError, match=r"exactly one of half_space, .*; found \['rectangle', 'box'\]"):
        surface(rectangle={"half_extents_m": (1, 1)}, box={"half_extents_m": (1, 1, 1)})
