"""Exports: each file says what the model or the dataset says, in its format's own frames, units and orders."""

import json
import shutil
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import mujoco
import numpy as np
import pycolmap
import pytest
from cgwm.cli import main
from cgwm.cli.usage import option_name
from cgwm.datasets.capture.cameras import Camera, camera_of, to_intrinsics
from cgwm.datasets.capture.colmap_model import read_colmap_model
from cgwm.datasets.capture.images import read_rgb, write_image
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.capture.transforms import read_transforms
from cgwm.datasets.exports.bop_coco import run_lengths
from cgwm.datasets.exports.glb import EXTENSION
from cgwm.datasets.exports.lerobot_stats import PictureStats, together, vector_stats
from cgwm.datasets.exports.selection import Selection
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.mjcf import write_mjcf
from cgwm.datasets.models.model import Model, read_model, write_model
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.datasets.shapes.meshes import Mesh, mass_properties
from cgwm.datasets.shapes.ply import SH_C0, Splats, read_splats
from cgwm.pipeline.export.mujoco_check import _commanded, keyframe_of, resimulate, start_of
from cgwm.pipeline.export.stage import (
    DATASET_FORMATS,
    MODEL_FORMATS,
    OPTIONS,
    SUFFIXES,
    ExportOptions,
    export,
    object_model,
)
from cgwm.pipeline.geometry.isosurface import union_mesh
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.validate import validate
from cgwm.schemas import (
    CamerasFile,
    EffectModel,
    ExportFormat,
    InputDataError,
    Pose,
    PosedImage,
    Scale,
    SynthesizeConfig,
    UsageError,
)
from helpers.small_model import HALF, small_model, write_small_model
from scipy.spatial.transform import Rotation

QUAT = (0.8, 0.2, -0.5, 0.26457513110645906)
ROLLOUTS, WIDTH, HEIGHT = 5, 48, 36


def turned_model() -> Model:
    """The small cube at a photo pose that is no identity, over a scene whose colours depend on the direction."""
    model = small_model()
    body = model.file.bodies[0].model_copy(update={"photo_pose": Pose(position_m=(0.1, -0.05, 0.2), quat_wxyz=QUAT)})
    assert model.scene is not None
    harmonics = np.random.default_rng(3).normal(0, 0.1, (len(model.scene), 8, 3))
    file = model.file.model_copy(update={"bodies": (body,)})
    return replace(model, file=file, scene=replace(model.scene, harmonics=harmonics), cameras=photo_cameras())


def photo_cameras() -> CamerasFile:
    """Three photos of two cameras, one of which distorts."""
    rng = np.random.default_rng(0)
    images, intrinsics = {}, {}
    for name, distortion in (("wide", [-0.2, 0.05, 0.001, -0.002, 0.01]), ("plain", [])):
        K = np.array([[52.0, 0, 30.5], [0, 51.0, 24.25], [0, 0, 1]])
        intrinsics[name] = to_intrinsics(
            Camera(width=60, height=48, K=K, distortion=np.array(distortion), T_world_cam=np.eye(4))
        )
    for name, camera in (("a/0.png", "wide"), ("a/1.png", "plain"), ("b.png", "plain")):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
        images[name] = PosedImage(camera=camera, T_world_cam=tuple(map(tuple, pose.tolist())))
    return CamerasFile(scale=Scale(kind="metric"), cameras=intrinsics, images=images)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models") / "turned"
    write_model(path, turned_model())
    return path


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("datasets")
    config = SynthesizeConfig(rollouts=ROLLOUTS, duration_s=0.3, width=WIDTH, height=HEIGHT, device="cpu", seed=5)
    synthesize(write_small_model(root / "model"), root / "dataset", config)
    return root / "dataset"


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("short")
    config = SynthesizeConfig(rollouts=2, duration_s=0.1, width=WIDTH, height=HEIGHT, device="cpu", seed=5)
    synthesize(write_small_model(root / "model"), root / "dataset", config)
    return root / "dataset"


@pytest.fixture
def reader(dataset: Path) -> Iterator[RolloutReader]:
    reader = RolloutReader(dataset)
    yield reader
    reader.close()


def png(path: Path) -> np.ndarray:
    """Return a PNG as it is, 8 or 16 bits."""
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


# models


def test_mjcf_flies_as_our_engine_does_and_has_the_start(model: Path, tmp_path: Path) -> None:
    result = export(model, "mjcf", tmp_path / "m.xml", ExportOptions(seed=2, duration_s=0.5))
    assert result.facts["deviation_in_flight_mm"] < 1e-3 and result.facts["deviation_in_flight_deg"] < 1e-3
    assert 0 < result.facts["first_contact_s"] < 0.5
    assert 0 < result.facts["deviation_until_0.1_s_after_contact_mm"] < 50
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "m.xml"))
    start = start_of(read_model(model), 2, 0.5)
    key = loaded.key("start")
    np.testing.assert_allclose(key.qpos, np.r_[start.position_m[0], start.quat_wxyz[0]], rtol=1e-9)
    np.testing.assert_allclose(key.qvel, np.r_[start.velocity_m_s[0], start.omega_body_rad_s[0]], rtol=1e-9)


def test_the_deviation_finds_another_gravity_and_another_mass() -> None:
    model = small_model(com_m=(0.01, 0, 0))
    start = start_of(model, 0, 0.2)
    text = write_mjcf(model, keyframe=keyframe_of(start))
    right = resimulate(model, text, start, 0.2)
    assert right.flight is not None and right.flight[0] < 1e-3
    wrong = resimulate(model, text.replace("-9.81", "-9.7"), start, 0.2)
    assert wrong.flight is not None and wrong.first_contact_s is not None
    steps = round(wrong.first_contact_s / 0.01) - 1
    assert wrong.flight[0] == pytest.approx(1e3 * 0.5 * 0.11 * (0.01 * steps) ** 2, rel=1e-2)
    shifted = resimulate(model, text.replace('pos="0.01 0 0" mass', 'pos="0.02 0 0" mass'), start, 0.2)
    assert shifted.flight is not None and shifted.flight[0] > 0.1


def test_a_command_turns_and_moves_the_mocap_body() -> None:
    quats = np.array([[1.0, 0, 0, 0], [np.cos(0.3), 0, 0, np.sin(0.3)]])
    track = Track(np.array([0.0, 0.2]), np.array([[0.0, 0, 0], [0.1, 0, 0]]), quats)
    position, quat = _commanded(track, 0.1)
    np.testing.assert_allclose(position, [0.05, 0, 0], atol=1e-12)
    np.testing.assert_allclose(quat, [np.cos(0.15), 0, 0, np.sin(0.15)], atol=1e-12)
    np.testing.assert_allclose(_commanded(track, 9.0)[1], quats[1], atol=1e-12)


def test_mjcf_says_what_it_lacks(tmp_path: Path) -> None:
    driven = small_model(driven=True)
    path = tmp_path / "driven"
    effects = (EffectModel(name="linear_drag", parameters={"c": 0.1}),)
    write_model(path, replace(driven, file=driven.file.model_copy(update={"effects": effects})))
    result = export(path, "mjcf", tmp_path / "m.xml", ExportOptions(duration_s=0.1))
    assert "the effect linear_drag is not in the MJCF" in result.notes
    assert any("mocap" in note for note in result.notes)
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "m.xml"))
    start = start_of(read_model(path), 0, 0.1)
    np.testing.assert_allclose(loaded.key("start").mpos, start.position_m[1], rtol=1e-9)


def test_ply_holds_the_scene_and_each_body(model: Path, tmp_path: Path) -> None:
    source = read_model(model)
    result = export(model, "ply", tmp_path / "parts", ExportOptions(sh_degree=3))
    assert result.facts == {"scene.ply_spheres": 400, "cube.ply_spheres": 400}
    for name, splats in (("scene", source.scene), ("cube", source.body_splats["cube"])):
        assert splats is not None
        data = (tmp_path / "parts" / f"{name}.ply").read_bytes()
        assert data[: data.index(b"end_header")].count(b"f_rest_") == 45
        same_splats(read_splats(tmp_path / "parts" / f"{name}.ply"), splats)
    assert (tmp_path / "parts" / "cube.ply").read_bytes().find(b"comment frame body") > 0


def test_one_ply_has_the_bodies_where_the_photos_show_them(model: Path, tmp_path: Path) -> None:
    source = read_model(model)
    export(model, "ply", tmp_path / "all.ply")
    whole = read_splats(tmp_path / "all.ply", harmonics=True)
    assert source.scene is not None and source.scene.harmonics is not None and whole.harmonics is not None
    np.testing.assert_allclose(whole.harmonics[:400], source.scene.harmonics, atol=1e-6)
    assert not whole.harmonics[400:].any()
    body = source.body_splats["cube"]
    world = Rotation.from_quat(QUAT, scalar_first=True).apply(body.means) + np.array([0.1, -0.05, 0.2])
    np.testing.assert_allclose(whole.means[400:], world, atol=1e-6)


def same_splats(found: Splats, wanted: Splats) -> None:
    for name in ("means", "scales", "opacities", "colors"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-5, err_msg=name)


def test_pycolmap_reads_cameras_frames_and_points(model: Path, tmp_path: Path) -> None:
    result = export(model, "colmap", tmp_path / "out")
    assert result.facts == {"cameras": 2, "images": 3, "points": 800, "photos_copied": 0}
    sparse = tmp_path / "out" / "sparse" / "0"
    found = pycolmap.Reconstruction(str(sparse))
    assert (found.num_rigs(), found.num_frames(), found.num_reg_images(), found.num_points3D()) == (2, 3, 3, 800)
    cameras = photo_cameras()
    points = np.random.default_rng(1).normal(size=(50, 3)) * 3
    for image in found.images.values():
        ours = camera_of(cameras, image.name)
        np.testing.assert_allclose(image.cam_from_world().matrix(), ours.T_cam_world[:3], atol=1e-12)
        np.testing.assert_allclose(image.projection_center(), ours.center, atol=1e-12)
        local = points @ ours.T_cam_world[:3, :3].T + ours.T_cam_world[:3, 3]
        ahead = (local[:, 2] > 0.2) & (np.abs(local[:, :2]) < local[:, 2:]).all(1)
        theirs = np.array([image.camera.img_from_cam(point) for point in local[ahead]])
        np.testing.assert_allclose(theirs, ours.project(points[ahead])[0], atol=1e-9)
    colors = np.array([found.points3D[k].color for k in range(1, 801)])
    assert np.abs(colors / 255 - read_splats(model / "scene.ply").colors[:1]).max(1)[0] < 0.003
    again = read_colmap_model(sparse, metric=True)
    for name, image in cameras.images.items():
        np.testing.assert_allclose(again.images[name].T_world_cam, image.T_world_cam, atol=1e-12)


def test_colmap_takes_the_cameras_and_photos_of_a_capture(tmp_path: Path) -> None:
    write_small_model(tmp_path / "model")
    capture = tmp_path / "capture"
    (capture / "images" / "a").mkdir(parents=True)
    (capture / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    (capture / "cameras.json").write_text(photo_cameras().model_dump_json())
    write_image(capture / "images" / "a" / "0.png", np.full((48, 60, 3), 77, np.uint8))
    with pytest.raises(InputDataError, match=r"contains no cameras of photos(.|\n)*--capture CAPTURE"):
        export(tmp_path / "model", "colmap", tmp_path / "out")
    result = export(tmp_path / "model", "colmap", tmp_path / "out", ExportOptions(capture=capture))
    assert result.facts["photos_copied"] == 1
    assert read_rgb(tmp_path / "out" / "images" / "a" / "0.png").mean() == 77
    assert pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0")).num_reg_images() == 3


def read_glb(path: Path) -> tuple[dict[str, Any], Callable[[int], np.ndarray]]:
    """Return the document of a .glb, and a reader of its accessors; checks the lengths on the way."""
    data = path.read_bytes()
    magic, version, size = struct.unpack_from("<4sII", data)
    assert (magic, version, size) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and length % 4 == 0
    document = json.loads(data[20 : 20 + length])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0" and 28 + length + binary_size == len(data) and binary_size % 4 == 0
    assert document["buffers"] == [{"byteLength": binary_size}]
    binary = data[28 + length :]

    def accessor(index: int) -> np.ndarray:
        entry = document["accessors"][index]
        view = document["bufferViews"][entry["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
        assert entry["componentType"] == 5126 and view["byteLength"] == 4 * width * entry["count"]
        return np.frombuffer(binary, "<f4", width * entry["count"], view["byteOffset"]).reshape(-1, width)

    return document, accessor


def test_glb_has_one_node_a_body_and_the_splats_of_the_extension(model: Path, tmp_path: Path) -> None:
    source = read_model(model)
    assert export(model, "glb", tmp_path / "m.glb").facts == {"scene_spheres": 400, "cube_spheres": 400}
    document, accessor = read_glb(tmp_path / "m.glb")
    root, scene, cube = document["nodes"]
    assert root["children"] == [1, 2] and document["extensionsUsed"] == [EXTENSION]
    # the world's z is glTF's y
    np.testing.assert_allclose(Rotation.from_quat(root["rotation"]).apply([0, 0, 1]), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(cube["translation"], [0.1, -0.05, 0.2])
    np.testing.assert_allclose(
        Rotation.from_quat(cube["rotation"]).as_matrix(),
        Rotation.from_quat(QUAT, scalar_first=True).as_matrix(),
        atol=1e-12,
    )
    assert "translation" not in scene
    for node, splats in ((scene, source.scene), (cube, source.body_splats["cube"])):
        assert splats is not None
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        assert primitive["mode"] == 0
        assert primitive["extensions"][EXTENSION] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        value = {name: accessor(index) for name, index in primitive["attributes"].items()}
        np.testing.assert_allclose(value["POSITION"], splats.means, atol=1e-6)
        np.testing.assert_allclose(value[f"{EXTENSION}:SCALE"], np.tile(splats.scales[:, None], 3), rtol=1e-5)
        np.testing.assert_allclose(value[f"{EXTENSION}:OPACITY"][:, 0], splats.opacities, atol=1e-6)
        np.testing.assert_array_equal(value[f"{EXTENSION}:ROTATION"], np.tile([0, 0, 0, 1], (len(splats), 1)))
        dc = value[f"{EXTENSION}:SH_DEGREE_0_COEF_0"]
        np.testing.assert_allclose(0.5 + SH_C0 * dc, splats.colors, atol=1e-6)
        bounds = document["accessors"][primitive["attributes"]["POSITION"]]
        np.testing.assert_allclose(bounds["min"], value["POSITION"].min(0))
        assert value["COLOR_0"].min() >= 0 and value["COLOR_0"].max() <= 1
        higher = [name for name in value if "SH_DEGREE" in name and "_0_COEF" not in name]
        if splats.harmonics is None:
            assert higher == []
            continue
        assert len(higher) == 8
        np.testing.assert_allclose(value[f"{EXTENSION}:SH_DEGREE_2_COEF_4"], splats.harmonics[:, 7], atol=1e-6)
        np.testing.assert_allclose(value[f"{EXTENSION}:SH_DEGREE_1_COEF_0"], splats.harmonics[:, 0], atol=1e-6)


# datasets


def test_nerfstudio_has_cameras_pictures_depth_and_time(dataset: Path, reader: RolloutReader, tmp_path: Path) -> None:
    out = tmp_path / "ns"
    result = export(dataset, "nerfstudio", out, ExportOptions(rollout=3, every=4, mask="scene"))
    assert result.facts["images"] == 6
    cameras = read_transforms(out / "transforms.json", metric=True)
    document = json.loads((out / "transforms.json").read_text())
    time_s = reader.read(3, "time")
    points = reader.read(3, "bodies/pos")[:, 0]
    for frame in document["frames"]:
        _, view, file = frame["file_path"].split("/")
        number = int(Path(file).stem)
        ours = Selection(dataset).camera(3, view, number)
        theirs = camera_of(cameras, f"{view}/{file}")
        np.testing.assert_allclose(theirs.project(points)[0], ours.project(points)[0], atol=1e-9)
        np.testing.assert_array_equal(read_rgb(out / frame["file_path"]), reader.read(3, f"obs/{view}_image")[number])
        depth = png(out / frame["depth_file_path"])
        assert depth.dtype == np.uint16
        np.testing.assert_allclose(depth / 1e3, reader.read(3, f"obs/{view}_depth")[number], atol=0.00051)
        mask = png(out / frame["mask_path"])
        np.testing.assert_array_equal(mask == 0, reader.read(3, f"obs/{view}_mask")[number] > 0)
        assert set(np.unique(mask)) <= {0, 255}
        assert frame["time"] == pytest.approx(time_s[number] / time_s[-1])
        assert frame["time_s"] == time_s[number]
    first = (out / "points.ply").read_bytes()
    assert b"element vertex 800" in first and len(first) == first.index(b"end_header\n") + 11 + 800 * 15
    xyz = np.frombuffer(first[-800 * 15 :], np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))["xyz"]
    assert np.linalg.norm(xyz[400:].mean(0) - points[0]) < 0.01


def test_bop_poses_depth_and_masks_agree(
    dataset: Path, reader: RolloutReader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Selection, "_amodal", lambda *arguments: None)
    out = tmp_path / "bop"
    result = export(dataset, "bop", out, ExportOptions(every=3))
    assert result.facts == {"scenes": 5, "images": 40, "instances": 40, "objects": 1}
    assert any("no amodal masks" in note for note in result.notes)
    assert sorted(path.name for path in (out / "train").iterdir()) == [f"{k:06d}" for k in range(4)]
    scene = out / "val" / "000004"
    assert sorted(path.name for path in scene.iterdir()) == [
        *("depth", "mask_visib", "rgb", "scene_camera.json", "scene_gt.json")
    ]
    cameras, poses = (json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt"))
    assert list(map(int, cameras)) == sorted(map(int, cameras))
    vertices = np.array(
        [
            [float(word) for word in line.split()[:3]]
            for line in (out / "models" / "obj_000001.ply").read_text().split("end_header\n")[1].splitlines()
            if len(line.split()) == 9
        ]
    )
    assert np.abs(np.ptp(vertices, axis=0) - 100.0).max() < 1.0  # the cube's side in millimetres
    for key, (pose,) in poses.items():
        frame, view = divmod(int(key), 2)
        K = np.reshape(cameras[key]["cam_K"], (3, 3))
        ours = Selection(dataset).camera(4, f"view{view}", frame)
        # OpenCV's pixel origin: half a pixel less
        np.testing.assert_allclose(ours.K - K, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], atol=1e-12)
        local = vertices @ np.reshape(pose["cam_R_m2c"], (3, 3)).T + pose["cam_t_m2c"]
        R_wc, t_wc = np.reshape(cameras[key]["cam_R_w2c"], (3, 3)), np.array(cameras[key]["cam_t_w2c"])
        body = 1e3 * reader.read(4, "bodies/pos")[frame, 0]
        np.testing.assert_allclose(R_wc @ body + t_wc, pose["cam_t_m2c"], atol=1e-6)
        pixels = np.round((local @ K.T)[:, :2] / local[:, 2:]).astype(int)
        mask = png(scene / "mask_visib" / f"{int(key):06d}_000000.png")
        inside = ((pixels >= 0) & (pixels < [WIDTH, HEIGHT])).all(1)
        assert (mask[pixels[inside, 1], pixels[inside, 0]] > 0).mean() > 0.9
        depth = png(scene / "depth" / f"{int(key):06d}.png")
        master = reader.read(4, f"obs/view{view}_depth")[frame]
        np.testing.assert_allclose(depth * cameras[key]["depth_scale"] / 1e3, master, atol=6e-5)
        np.testing.assert_array_equal(
            read_rgb(scene / "rgb" / f"{int(key):06d}.png"), reader.read(4, f"obs/view{view}_image")[frame]
        )
    about = json.loads((out / "models" / "models_info.json").read_text())["1"]
    assert about["diameter"] == pytest.approx(np.sqrt(3) * 90 + 10, abs=1.5)  # of the spheres at the corners


def test_bop_has_whole_silhouettes_where_the_dataset_has(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def whole(self: Selection, number: int, camera: str, start: int, stop: int) -> np.ndarray:
        """As if half of what there is of the body were hidden: a silhouette that covers the upper left quarter."""
        masks = np.zeros((stop - start, 1, HEIGHT, WIDTH), bool)
        masks[:, :, : HEIGHT // 2, : WIDTH // 2] = True
        return masks

    monkeypatch.setattr(Selection, "_amodal", whole)
    result = export(dataset, "bop", tmp_path / "bop", ExportOptions(every=9, cameras=("view1",), split="valid"))
    assert result.facts["scenes"] == 1 and not any("amodal" in note for note in result.notes)
    scene = tmp_path / "bop" / "val" / "000004"
    facts = json.loads((scene / "scene_gt_info.json").read_text())
    reader = RolloutReader(dataset)
    for key, (fact,) in facts.items():
        visible = reader.read(4, "obs/view1_mask")[int(key)] == 1
        silhouette = visible | whole(None, 0, "", 0, 1)[0, 0]
        mask = png(scene / "mask" / f"{int(key):06d}_000000.png")
        np.testing.assert_array_equal(mask > 0, silhouette)
        assert (fact["px_count_all"], fact["px_count_visib"]) == (silhouette.sum(), visible.sum())
        assert fact["visib_fract"] == pytest.approx(visible.sum() / silhouette.sum())
        rows, columns = np.nonzero(visible)
        left, top, width, height = fact["bbox_visib"]
        assert (left, top, left + width, top + height) == (columns.min(), rows.min(), columns.max(), rows.max())
    coco = json.loads((scene / "scene_gt_coco.json").read_text())
    assert [image["id"] for image in coco["images"]] == list(map(int, facts)) and len(coco["annotations"]) > 0
    for entry in coco["annotations"]:
        visible = reader.read(4, "obs/view1_mask")[entry["image_id"]] == 1
        np.testing.assert_array_equal(from_run_lengths(entry["segmentation"]), visible)
        rows, columns = np.nonzero(visible | whole(None, 0, "", 0, 1)[0, 0])
        assert entry["bbox"] == [0, 0, columns.max() + 1, rows.max() + 1] and entry["area"] == visible.sum()
        assert entry["ignore"] == (visible.sum() < 0.1 * len(rows))
    reader.close()


def test_bop_masks_are_the_amodal_masks_of_the_dataset(dataset: Path, reader: RolloutReader, tmp_path: Path) -> None:
    export(dataset, "bop", tmp_path / "bop", ExportOptions(every=9, cameras=("view1",), split="valid"))
    scene = tmp_path / "bop" / "val" / "000004"
    facts = json.loads((scene / "scene_gt_info.json").read_text())
    amodal, shares = reader.read(4, "obs/view1_amodal"), reader.read(4, "bodies/visible_fraction")
    for key, (fact,) in facts.items():
        np.testing.assert_array_equal(png(scene / "mask" / f"{int(key):06d}_000000.png") > 0, amodal[int(key)] == 1)
        assert fact["visib_fract"] == pytest.approx(shares[int(key), 1, 0])
    assert facts


def from_run_lengths(runs: dict[str, list[int]]) -> np.ndarray:
    """Decode COCO's run lengths: background and mask by turns, column after column."""
    values = np.repeat(np.arange(len(runs["counts"])) % 2, runs["counts"])
    return values.reshape(runs["size"], order="F").astype(bool)


@pytest.mark.parametrize("corner", [False, True])
def test_run_lengths_begin_with_the_background(corner: bool) -> None:
    mask = np.random.default_rng(0).random((7, 5)) < 0.4
    mask[0, 0] = corner
    assert (run_lengths(mask)["counts"][0] == 0) == corner
    np.testing.assert_array_equal(from_run_lengths(run_lengths(mask)), mask)


def test_amodal_bits_are_read(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = Selection(dataset)
    bits = np.array([[[0, 1, 2, 3]]], np.uint8)
    monkeypatch.setattr(chosen, "bodies", lambda number=0: ["a", "b"])
    monkeypatch.setattr(chosen.reader, "group", lambda number: {"obs/view0_amodal"})
    monkeypatch.setattr(chosen.reader, "read", lambda *arguments: bits)
    found = chosen._amodal(0, "view0", 0, 1)
    assert found is not None and found.shape == (1, 2, 1, 4)
    np.testing.assert_array_equal(found[0, 0, 0], [False, True, False, True])
    np.testing.assert_array_equal(found[0, 1, 0], [False, False, True, True])


def test_the_net_of_a_union_is_closed_and_encloses_its_volume() -> None:
    vertices, faces = union_mesh(np.array([[0.3, 0, 0]]), np.array([0.1]))
    solid = mass_properties(Mesh(vertices, faces))  # refuses what is not closed
    assert solid.volume_m3 == pytest.approx(4 / 3 * np.pi * 1e-3, rel=5e-3)
    np.testing.assert_allclose(solid.com_m, [0.3, 0, 0], atol=1e-4)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    outwards = (np.cross(b - a, c - a) * (a - [0.3, 0, 0])).sum(1)
    assert (outwards > 0).all()
    assert np.abs(np.linalg.norm(vertices - [0.3, 0, 0], axis=1) - 0.1).max() < 5e-4
    # two spheres of radius r, their centres r apart: 2 (4/3) pi r3 - (5/12) pi r3
    vertices, faces = union_mesh(np.array([[0, 0, 0], [0, 0.1, 0]]), np.array([0.1, 0.1]))
    volume = mass_properties(Mesh(vertices, faces)).volume_m3
    assert volume == pytest.approx((8 / 3 - 5 / 12) * np.pi * 1e-3, rel=5e-3)


def test_meshes_have_outward_normals_and_the_spheres_colours() -> None:
    mesh = object_model(small_model(), "cube")
    assert np.abs(mesh.vertices).max() == pytest.approx(HALF, rel=0.02)
    centres = np.round(mesh.vertices / (0.9 * HALF)) * 0.9 * HALF  # 27 spheres on a grid
    assert ((mesh.vertices - centres) * mesh.normals()).sum(1).min() > 0
    np.testing.assert_allclose(np.linalg.norm(mesh.normals(), axis=1), 1)
    assert len(np.unique(mesh.colors, axis=0)) > 10


# LeRobot


def test_lerobot_tables_videos_and_statistics(dataset: Path, reader: RolloutReader, tmp_path: Path) -> None:
    pytest.importorskip("av", reason="the extra 'lerobot' is not installed")
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'lerobot' is not installed")
    out = tmp_path / "lr"
    result = export(dataset, "lerobot", out, ExportOptions(task="Throw."))
    count = reader.rollouts[0].frames
    assert result.facts["episodes"] == 5 and result.facts["frames"] == 5 * count and result.facts["fps"] == 30
    info = json.loads((out / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30 and info["splits"] == {"train": "0:5"}
    table = parquet.read_table(out / "data/chunk-000/file-000.parquet")
    assert set(table.column_names) == {name for name, entry in info["features"].items() if entry["dtype"] != "video"}
    state = np.stack(table["observation.state"].to_pylist())
    np.testing.assert_allclose(state[2 * count : 3 * count], reader.read(2, "obs/object"), rtol=1e-6)
    assert info["features"]["observation.state"]["names"][3] == "cube.qw"
    np.testing.assert_array_equal(table["index"].to_numpy(), np.arange(5 * count))
    np.testing.assert_array_equal(table["frame_index"].to_numpy()[count : 2 * count], np.arange(count))
    np.testing.assert_allclose(table["timestamp"].to_numpy()[:count], reader.read(0, "time"), atol=1e-6)
    episodes = parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    rows = [(entry["dataset_from_index"], entry["dataset_to_index"]) for entry in episodes]
    assert rows == [(k * count, (k + 1) * count) for k in range(5)] and episodes[0]["tasks"] == ["Throw."]
    from_s = [entry["videos/observation.images.view1/from_timestamp"] for entry in episodes]
    np.testing.assert_allclose(from_s, np.arange(5) * count / 30, atol=1e-9)
    frames = decoded(out / "videos/observation.images.view1/chunk-000/file-000.mp4")
    assert frames.shape == (5 * count, HEIGHT, WIDTH, 3)
    master = np.concatenate([reader.read(number, "obs/view1_image") for number in range(5)])
    error = ((frames.astype(float) - master) ** 2).mean((1, 2, 3))
    psnr = 10 * np.log10(255**2 / error)
    assert psnr.min() > 25 and np.argmin([((frames[20].astype(float) - m) ** 2).mean() for m in master]) == 20
    tasks = parquet.read_table(out / "meta" / "tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]
    stats = json.loads((out / "meta" / "stats.json").read_text())
    np.testing.assert_allclose(stats["observation.state"]["std"], state.std(0), atol=1e-6)
    np.testing.assert_allclose(np.ravel(stats["observation.images.view1"]["mean"]), master.mean((0, 1, 2)) / 255)
    about = json.loads((out / "meta" / "cgwm.json").read_text())
    assert [entry["rollout"] for entry in about["episodes"]] == list(range(5))
    assert about["episodes"][4]["splits"] == ["valid"]
    np.testing.assert_array_equal(about["episodes"][0]["cameras"]["view0"]["K"], reader.read(0, "cameras/view0/K"))


def decoded(path: Path) -> np.ndarray:
    import av

    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_lerobot_takes_episodes_of_few_frames(short: Path, tmp_path: Path) -> None:
    # the encoder has written nothing yet when the second episode begins
    facts = export(short, "lerobot", tmp_path / "out", ExportOptions(every=3)).facts
    assert facts["episodes"] == 2 and facts["frames"] == 4


def test_lerobot_begins_new_files(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("av", reason="the extra 'lerobot' is not installed")
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'lerobot' is not installed")
    from cgwm.datasets.exports import lerobot, lerobot_files, lerobot_video

    monkeypatch.setattr(lerobot, "MAX_TABLE_BYTES", 1)
    monkeypatch.setattr(lerobot_files, "FILES_PER_CHUNK", 2)
    monkeypatch.setattr(lerobot_video, "MAX_FILE_BYTES", -1)
    export(dataset, "lerobot", tmp_path / "lr", ExportOptions(every=2, cameras=("view0",)))
    tables = sorted(path.relative_to(tmp_path / "lr/data").as_posix() for path in tmp_path.glob("lr/data/*/*"))
    assert tables == [f"chunk-{k // 2:03d}/file-{k % 2:03d}.parquet" for k in range(5)]
    episodes = parquet.read_table(tmp_path / "lr/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for entry in episodes:
        place = "videos/observation.images.view0"
        file = f"chunk-{entry[f'{place}/chunk_index']:03d}/file-{entry[f'{place}/file_index']:03d}.mp4"
        assert entry[f"{place}/from_timestamp"] == 0
        assert len(decoded(tmp_path / "lr" / place / file)) == entry["length"]
    assert len(list(tmp_path.glob("lr/videos/*/*/*.mp4"))) == 5


def test_lerobot_says_what_to_install(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputDataError, match=r"needs the package 'av'(.|\n)*pip install 'cgwm\[lerobot\]'"):
        export(dataset, "lerobot", tmp_path / "lr")
    assert list(tmp_path.iterdir()) == []


def test_statistics_of_parts_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(3, 2, (count, 4)) for count in (40, 7, 300)]
    joined = together([{"x": vector_stats(part)} for part in parts])["x"]
    whole = np.concatenate(parts)
    for name, value in (("mean", whole.mean(0)), ("std", whole.std(0)), ("min", whole.min(0)), ("max", whole.max(0))):
        np.testing.assert_allclose(joined[name], value, err_msg=name)
    assert joined["count"] == [347] and (np.abs(joined["q50"] - np.median(whole, axis=0)) < 0.5).all()
    pictures = PictureStats(3)
    for grey in (0, 51, 255):
        pictures.add(np.full((4, 6, 3), grey, np.uint8))
    stats = pictures.stats()
    assert stats["mean"].shape == (3, 1, 1) and stats["mean"][0, 0, 0] == pytest.approx((0 + 0.2 + 1) / 3)
    assert stats["count"].tolist() == [3]


# refusals


@pytest.mark.parametrize("format_", [*DATASET_FORMATS, *MODEL_FORMATS])
def test_the_wrong_kind_is_named(dataset: Path, model: Path, tmp_path: Path, format_: ExportFormat) -> None:
    thing, found = (model, "model") if format_ in DATASET_FORMATS else (dataset, "dataset")
    with pytest.raises(InputDataError, match=rf"is a {found}; --to {format_} takes a (.|\n)*for a dataset: lerobot"):
        export(thing, format_, tmp_path / "out")
    with pytest.raises(InputDataError, match="no such"):
        export(tmp_path / "nothing", format_, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "format_", ["ply", *(pytest.param(f, marks=pytest.mark.evidence) for f in ("glb", "nerfstudio")), "bop"]
)
def test_what_exists_stays(short: Path, model: Path, tmp_path: Path, format_: ExportFormat) -> None:
    out = tmp_path / ("out.glb" if format_ == "glb" else "out")
    thing = short if format_ in DATASET_FORMATS else model
    out.write_text("mine") if format_ == "glb" else (out / "mine").mkdir(parents=True)
    if format_ != "glb":
        (out / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="exists"):
        export(thing, format_, out)
    with pytest.raises(UsageError, match="--overwrite does not remove it"):
        export(thing, format_, out, overwrite=True)
    out.unlink() if format_ == "glb" else shutil.rmtree(out)
    export(thing, format_, out, ExportOptions(every=10))
    first = sha256(out)
    export(thing, format_, out, ExportOptions(every=10), overwrite=True)
    assert sha256(out) == first  # the same bytes again


@pytest.mark.parametrize(("format_", "name"), [("ply", "m.ply"), ("glb", "m.glb")])
def test_a_file_is_written_again_only_with_the_same_bytes(
    model: Path, tmp_path: Path, format_: ExportFormat, name: str
) -> None:
    export(model, format_, tmp_path / name)
    first = sha256(tmp_path / name)
    export(model, format_, tmp_path / name)
    assert sha256(tmp_path / name) == first
    with (tmp_path / name).open("ab") as stream:
        stream.write(b" ")
    with pytest.raises(UsageError, match="exists"):
        export(model, format_, tmp_path / name)
    assert sorted(one.name for one in tmp_path.iterdir()) == [name]


def test_what_is_not_there_is_refused(dataset: Path, model: Path, tmp_path: Path) -> None:
    for options, message in (
        (ExportOptions(cameras=("view7",)), r"no camera 'view7'. Did you mean(.|\n)*view0, view1"),
        (ExportOptions(rollout=9), r"no rollout 9.\nAllowed: 5 rollouts, 0 to 4"),
        (ExportOptions(every=0), "--every 0"),
    ):
        with pytest.raises(UsageError, match=message):
            export(dataset, "nerfstudio", tmp_path / "out", options)
    with pytest.raises(UsageError, match="no split 'test'"):
        export(dataset, "bop", tmp_path / "out", ExportOptions(split="test"))
    with pytest.raises(UsageError, match=r"writes one file(.|\n)*ends in \.glb"):
        export(model, "glb", tmp_path / "out.gltf")
    unseen = write_small_model(tmp_path / "unseen", visible=False)
    with pytest.raises(InputDataError, match="no visual spheres"):
        export(unseen, "ply", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["unseen"]


def test_states_alone_are_no_pictures(tmp_path: Path) -> None:
    config = SynthesizeConfig(rollouts=1, duration_s=0.1, device="cpu")
    synthesize(write_small_model(tmp_path / "model", visible=False), tmp_path / "dataset", config)
    with pytest.raises(InputDataError, match="states and no images"):
        export(tmp_path / "dataset", "bop", tmp_path / "out")


def test_odd_sides_are_refused_before_a_video_is_begun(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="the extra 'lerobot' is not installed")
    pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
    config = SynthesizeConfig(rollouts=1, duration_s=0.1, width=31, height=24, device="cpu")
    synthesize(write_small_model(tmp_path / "model"), tmp_path / "dataset", config)
    with pytest.raises(UsageError, match="31x24 px"):
        export(tmp_path / "dataset", "lerobot", tmp_path / "out")


def test_the_command_tells_what_was_measured(model: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def run(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stopped:
            main(["export", str(model), *words])
        out, err = capfd.readouterr()
        return int(stopped.value.code or 0), out, err

    code, out, _ = run("--to", "mjcf", "--out", str(tmp_path / "m.xml"), "--duration", "0.2", "--json")
    assert code == 0 and json.loads(out)["facts"]["deviation_in_flight_mm"] < 1e-3
    code, out, _ = run("--to", "mjcf", "--out", str(tmp_path / "n.xml"), "--duration", "0.2")
    assert code == 0 and "deviation in flight mm" in out
    code, _, err = run("--to", "mjcf", "--out", str(tmp_path / "o.xml"), "--every", "2")
    assert code == 2 and err == "--every does not apply to --to mjcf.\nAllowed: --seed, --duration.\n"


def test_every_format_has_its_options() -> None:
    assert set(OPTIONS) == {*DATASET_FORMATS, *MODEL_FORMATS}
    assert {name for names in OPTIONS.values() for name in names} == set(ExportOptions.__dataclass_fields__)
    assert option_name("duration_s") == "--duration" and option_name("sh_degree") == "--sh-degree"


# what cannot be right


def rolled_pictures(demo: h5py.Group) -> None:
    for key in ("mask", "amodal", "depth"):
        pictures = demo[f"obs/view0_{key}"]
        pictures[...] = np.roll(pictures[()], 9, axis=1)


def smaller_image(demo: h5py.Group) -> None:
    attributes, images = dict(demo["obs/view1_image"].attrs), demo["obs/view1_image"][()]
    del demo["obs/view1_image"]
    demo.create_dataset("obs/view1_image", data=images[:, :-2]).attrs.update(attributes)


def miscounted(demo: h5py.Group) -> None:
    demo["bodies/visible_px"][0, 0, 0] += 5


def zero_focal_length(demo: h5py.Group) -> None:
    demo["cameras/view0/K"][...] = 0


def no_rotation(demo: h5py.Group) -> None:
    demo["cameras/view1/T_world_cam"][...] = 0


def no_orientation(demo: h5py.Group) -> None:
    demo["bodies/quat_wxyz"][2, 0] = 0


def no_number(demo: h5py.Group) -> None:
    demo["bodies/pos"][2, 0, 0] = np.nan


def split_above(demo: h5py.Group) -> None:
    demo.file["mask"].create_dataset("..", data=np.array([b"demo_1"]))


@pytest.mark.parametrize(
    ("edit", "format_", "message"),
    [
        (rolled_pictures, "bop", "body 'cube': .* the pose or the camera is wrong"),
        (smaller_image, "lerobot", r"obs/view1_image: its shape is \(4, 34, 48, 3\); \(T, H, W, 3\) is documented"),
        (miscounted, "nerfstudio", r"bodies/visible_px: frame 0, camera view0, body 'cube'"),
        *(
            pytest.param(*row, marks=pytest.mark.evidence)  # what is refused is that of test_dataset_structure.py
            for row in (
                (zero_focal_length, "bop", "cameras/view0: the focal lengths in K are 0 and 0 px"),
                (no_rotation, "nerfstudio", "cameras/view1: the pose is no rotation and translation"),
                (no_orientation, "bop", "bodies/quat_wxyz: frame 2: a norm differs from 1 by 1"),
                (no_number, "lerobot", "bodies/pos: frame 2: contains numbers that are not finite"),
                (split_above, "bop", "mask: the name '..' is no name of a file"),
            )
        ),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_a_dataset_is_refused_as_validate_would(
    short: Path, tmp_path: Path, edit: Callable[[h5py.Group], None], format_: ExportFormat, message: str
) -> None:
    copy = shutil.copytree(short, tmp_path / "dataset")
    with h5py.File(next(copy.glob("*.h5")), "r+") as file:
        edit(file["data/demo_1"])
    with pytest.raises(InputDataError, match=message) as caught:
        export(copy, format_, tmp_path / "out", ExportOptions(rollout=1 if format_ == "nerfstudio" else 0))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dataset"]
    assert caught.value.found.removeprefix(f"{copy}: ").removeprefix(f"{copy}/") in validate(copy).faults
    if edit is no_number:  # what is not exported is not looked at
        export(copy, "nerfstudio", tmp_path / "out", ExportOptions(rollout=0))


def test_an_image_of_another_size_in_jpeg_is_refused(tmp_path: Path) -> None:
    config = SynthesizeConfig(rollouts=1, duration_s=0.1, width=48, height=36, device="cpu", compression="jpeg")
    synthesize(write_small_model(tmp_path / "model"), tmp_path / "dataset", config)
    with h5py.File(next((tmp_path / "dataset").glob("*.h5")), "r+") as file:
        images = file["data/demo_0/obs/view0_image"]
        small = cv2.imencode(".jpg", np.zeros((20, 20, 3), np.uint8))[1].reshape(-1)
        images[2] = np.resize(small, images.shape[1])
    message = "obs/view0_image: frame 2: 20 x 20 px; the camera has 48 x 36"
    with pytest.raises(InputDataError, match=message):
        export(tmp_path / "dataset", "lerobot", tmp_path / "out")
    assert any(message in fault for fault in validate(tmp_path / "dataset").faults)
    with pytest.raises(InputDataError, match="demo_0/obs/view0_image: an image is no JPEG of 48 x 36 px"):
        RolloutReader(tmp_path / "dataset").read(0, "obs/view0_image")


@pytest.mark.parametrize("format_", MODEL_FORMATS)
def test_a_model_with_a_singular_camera_is_refused(model: Path, tmp_path: Path, format_: ExportFormat) -> None:
    copy = shutil.copytree(model, tmp_path / "model")
    cameras = json.loads((copy / "cameras.json").read_text())
    cameras["images"]["b.png"]["T_world_cam"][1] = [0, 0, 0, 0]
    (copy / "cameras.json").write_text(json.dumps(cameras))
    with pytest.raises(InputDataError, match=r"cameras\.json: image 'b\.png': the pose is no rotation and translation"):
        export(copy, format_, tmp_path / f"out{SUFFIXES.get(format_, '')}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model"]
