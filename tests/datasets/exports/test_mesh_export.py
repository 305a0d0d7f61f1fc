"""Meshes with colours in glTF, read again by trimesh: shape, place, colours, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.models.model import write_model
from cgwm.pipeline.export import export
from cgwm.schemas import InputDataError, UsageError
from helpers.small_model import HALF, small_model


def test_trimesh_reads_shape_place_and_colours(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="trimesh comes with viser: pip install 'cgwm[view]'")
    model = small_model()
    red = replace(model.body_splats["cube"], colors=np.tile([0.9, 0.1, 0.1], (400, 1)))
    write_model(tmp_path / "model", replace(model, body_splats={"cube": red}))
    result = export(tmp_path / "model", "mesh", tmp_path / "meshes.glb")
    scene = trimesh.load_scene(tmp_path / "meshes.glb")
    (mesh,) = scene.geometry.values()
    assert result.facts == {"cube_triangles": len(mesh.faces)}
    whole = scene.to_mesh()
    # y is up in glTF; the cube of 27 spheres lies on the ground
    sizes = np.ptp(whole.vertices, axis=0)
    assert sizes == pytest.approx(2 * HALF, abs=0.02 * HALF)
    assert whole.vertices[:, 1].min() == pytest.approx(0.0, abs=0.02 * HALF)
    outward = np.sum(mesh.vertex_normals * mesh.vertices, axis=1)  # the file's own normals
    assert np.mean(outward > 0) > 0.5
    colors = np.asarray(mesh.visual.vertex_attributes["color"], float)[:, :3]
    colors = colors / max(1.0, colors.max())  # bytes in some versions
    assert np.abs(colors - colors[0]).max() < 0.01 and colors[0, 0] > 4 * colors[0, 1]


def test_what_has_no_surface_is_refused(tmp_path: Path) -> None:
    model = small_model()
    looks = model.file.model_copy(update={"contact": None, "parameters": ()})
    write_model(tmp_path / "model", replace(model, file=looks, collision={}, body_splats={}))
    with pytest.raises(InputDataError, match="no body has collision spheres"):
        export(tmp_path / "model", "mesh", tmp_path / "meshes.glb")
    with pytest.raises(UsageError, match=r"(?s)--to mesh writes one file.*ends in .glb"):
        export(tmp_path / "model", "mesh", tmp_path / "meshes")
    assert [path.name for path in tmp_path.iterdir()] == ["model"]
