"""Recordings with sensors beside the pictures: ARKit's poses and LiDAR, and RealSense cameras."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.datasets import Capture, import_arkit, import_realsense, write_image
from cgwm.datasets.importers.realsense import in_color_pixels
from cgwm.datasets.importers.realsense_file import StreamGeometry
from cgwm.schemas import InputDataError
from scipy.spatial.transform import Rotation

from .test_photo_importers import FOCAL, HEIGHT, TURN, WIDTH, _poses, _require_cameras, _texture

FRAMES = 8
COLOR = {"width": 160, "height": 120, "fx": 150.0, "fy": 151.0, "ppx": 81.0, "ppy": 59.0}
DEPTH = {"width": 80, "height": 60, "fx": 70.0, "fy": 70.0, "ppx": 39.5, "ppy": 29.5}
OFFSET_M = (0.015, 0.0, 0.0)
"""Where the depth camera's origin is in the axes of the colour camera."""


def _frames() -> list[np.ndarray]:
    wall = _texture(5, 700, 120)
    return [np.ascontiguousarray(wall[:, 40 * k : 40 * k + 160]) for k in range(FRAMES)]


def write_stray(folder: Path, count: int = FRAMES) -> None:
    """Write a recording of Stray Scanner by its documentation: OpenCV's camera axes in ARKit's world."""
    for name in ("depth", "confidence"):
        (folder / name).mkdir(parents=True)
    writer = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (160, 120))
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for k, (frame, pose) in enumerate(zip(_frames()[:count], _poses(count), strict=True)):
        writer.write(frame)
        arkit = TURN @ pose
        values = [*arkit[:3, 3], *Rotation.from_matrix(arkit[:3, :3]).as_quat()]
        lines.append(", ".join(map(str, [100 + k / 30, f"{k:06d}", *values])))
        cv2.imwrite(str(folder / "depth" / f"{k:06d}.png"), np.full((12, 16), 1500, np.uint16))
        sure = np.full((12, 16), 2, np.uint8)
        sure[0] = 0
        cv2.imwrite(str(folder / "confidence" / f"{k:06d}.png"), sure)
    writer.release()
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    (folder / "camera_matrix.csv").write_text("150.0, 0.0, 80.0\n0.0, 150.0, 60.0\n0.0, 0.0, 1.0\n")


def write_arkitscenes(folder: Path, count: int = 5) -> None:
    """Write a scene of ARKitScenes by its documentation: world to camera, z up."""
    for name in ("lowres_wide", "lowres_wide_intrinsics", "lowres_depth", "confidence"):
        (folder / name).mkdir(parents=True)
    lines = []
    for k, pose in enumerate(_poses(count)):
        time, inverse = 10 + k / 10, np.linalg.inv(pose)
        name = f"42_{time:.3f}"
        write_image(folder / "lowres_wide" / f"{name}.png", _texture(k, WIDTH, HEIGHT))
        off = 0.001 if k == 2 else 0.0  # as some of Apple's files
        lens = f"{WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}"
        (folder / "lowres_wide_intrinsics" / f"42_{time + off:.3f}.pincam").write_text(lens)
        cv2.imwrite(str(folder / "lowres_depth" / f"{name}.png"), np.full((12, 16), 1500, np.uint16))
        values = [time + 0.0004, *Rotation.from_matrix(inverse[:3, :3]).as_rotvec(), *inverse[:3, 3]]
        lines.append(" ".join(map(str, values)))
    (folder / "lowres_wide.traj").write_text("\n".join(lines[:-1]) + "\n")  # the last photo has no pose


def test_stray_scanner_is_metric_with_z_up_and_depth_without_unsure_pixels(tmp_path: Path) -> None:
    write_stray(tmp_path / "in")
    result = import_arkit(tmp_path / "in", tmp_path / "out", photos=4)
    capture = Capture.open(tmp_path / "out")
    assert len(capture.photos()) == result.photos >= 3 and capture.cameras is not None
    assert capture.cameras.scale.kind == "metric"
    for name in capture.photos():
        truth = _poses(FRAMES)[int(name[:6])]
        np.testing.assert_allclose(capture.cameras.images[name].T_world_cam, truth, atol=1e-9)
        depth = cv2.imread(str(tmp_path / "out/depth" / f"{name[:6]}.png"), cv2.IMREAD_UNCHANGED)
        assert depth is not None and depth.shape == (120, 160)
        assert (depth[:10] == 0).all() and (depth[10:] == 1500).all()
    assert capture.cameras.cameras["camera0"].fx == 150.0


def test_arkitscenes_have_the_poses_at_the_times_of_the_photos(tmp_path: Path) -> None:
    write_arkitscenes(tmp_path / "in")
    result = import_arkit(tmp_path / "in", tmp_path / "out")
    poses = dict(zip([f"42_{10 + k / 10:.3f}.png" for k in range(4)], _poses(5), strict=False))
    _require_cameras(tmp_path / "out", poses, metric=True)
    assert result.warnings == ("1 of 5 photos are left out (--photos, or without a pose)",)


def _spoil(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new, 1))


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("odometry.csv", "frame, x", "number, x", "the columns timestamp, number, x"),
        ("odometry.csv", "000003, ", "000003, nan", "is not a number"),
        ("camera_matrix.csv", "150.0, 0.0, 80.0\n", "", "not a matrix of 3 x 3 numbers"),
        ("camera_matrix.csv", "80.0", "800.0", "but the principal point is (800, 60)"),
    ],
)
def test_what_is_wrong_in_a_recording_is_named(tmp_path: Path, name: str, old: str, new: str, message: str) -> None:
    write_stray(tmp_path / "in", 4)
    _spoil(tmp_path / "in" / name, old, new)
    with pytest.raises(InputDataError, match=f"{name.replace('.', '[.]')}|rgb.mp4") as refused:
        import_arkit(tmp_path / "in", tmp_path / "out")
    assert message in str(refused.value) and not (tmp_path / "out").exists()


def test_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    with pytest.raises(InputDataError, match=r"neither odometry.csv \(Stray Scanner\) nor lowres_wide.traj"):
        import_arkit(tmp_path / "in", tmp_path / "out")


# RealSense


def _depth_map() -> np.ndarray:
    depth = np.full((60, 80), 2000, np.uint16)  # 1 m, in units of 0.5 mm
    depth[:, :20] = 0
    return depth


def _lens_text(lens: dict[str, float]) -> str:
    return ";".join(f"{key}={value}" for key, value in lens.items()) + ";model=None;coeffs=0,0,0,0,0"


def write_realsense_db3(path: Path) -> None:
    """Write a recording as librealsense 2.59 does."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    rows: list[tuple[str, str, int, bytes]] = []

    def text(topic: str, value: str) -> None:
        kind = "std_msgs/msg/String"
        rows.append((topic, kind, 0, bytes(store.serialize_cdr(kinds[kind](value), kind))))

    def picture(topic: str, time: int, data: bytes) -> None:
        kind = "sensor_msgs/msg/CompressedImage"
        header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](0, time), "Color")
        message = kinds[kind](header, "png", np.frombuffer(data, np.uint8))
        rows.append((topic, kind, time, bytes(store.serialize_cdr(message, kind))))

    color, depth = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    text(f"{color}/camera_info", _lens_text(COLOR))
    text(f"{depth}/camera_info", _lens_text(DEPTH))
    text("/device_0/sensor_0/option/Depth_Units/value", "0.0005")
    upright = "rotation=1,0,0,0,1,0,0,0,1;translation="
    text(f"{color}/tf/ref_1", f"{upright}0,0,0")
    text(f"{depth}/tf/ref_1", upright + ",".join(str(-x) for x in OFFSET_M))
    for k, frame in enumerate(_frames()):
        picture(f"{color}/image/data/compressed", 33_000_000 * k, cv2.imencode(".png", frame)[1].tobytes())
        if k < 6:
            packed = cv2.imencode(".png", _depth_map())[1].tobytes()
            picture(f"{depth}/image/data/compressedDepth", 33_000_000 * k + 9_000_000, bytes(12) + packed)
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        topics = {name: k for k, name in enumerate(dict.fromkeys(row[0] for row in rows))}
        base.executemany("INSERT INTO topics VALUES (?, ?, ?)", {(topics[n], n, kind) for n, kind, _, _ in rows})
        values = [(topics[name], time, data) for name, _, time, data in rows]
        base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", values)
    base.close()


def write_realsense_bag(path: Path) -> None:
    """Write a recording as librealsense 2.55 does: four bytes more behind each image."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kinds = store.types
    header = kinds["std_msgs/msg/Header"](0, kinds["builtin_interfaces/msg/Time"](0, 1), "1")

    def info(lens: dict[str, float]):
        K = np.array([lens["fx"], 0, lens["ppx"], 0, lens["fy"], lens["ppy"], 0, 0, 1])
        roi = kinds["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        size = int(lens["height"]), int(lens["width"])
        return kinds["sensor_msgs/msg/CameraInfo"](
            header, *size, "None", np.zeros(5), K, np.zeros(9), np.zeros(12), 0, 0, roi
        )

    def moved(offset: tuple[float, ...]):
        turn = kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, -1.0)
        return kinds["geometry_msgs/msg/Transform"](kinds["geometry_msgs/msg/Vector3"](*offset), turn)

    def image(frame: np.ndarray, encoding: str):
        height, width = frame.shape[:2]
        data = frame.reshape(-1).view(np.uint8)
        return kinds["sensor_msgs/msg/Image"](header, height, width, encoding, 0, len(data) // height, data)

    color, depth = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    with Writer(path) as writer:

        def write(topic: str, kind: str, messages: list[tuple[int, object]], more: bytes = b"") -> None:
            connection = writer.add_connection(topic, kind, typestore=store)
            for time, message in messages:
                writer.write(connection, time, bytes(store.serialize_ros1(message, kind)) + more)

        write(f"{color}/info/camera_info", "sensor_msgs/msg/CameraInfo", [(1, info(COLOR))])
        write(f"{depth}/info/camera_info", "sensor_msgs/msg/CameraInfo", [(1, info(DEPTH))])
        write(f"{color}/tf/1", "geometry_msgs/msg/Transform", [(1, moved((0.0, 0.0, 0.0)))])
        write(f"{depth}/tf/1", "geometry_msgs/msg/Transform", [(1, moved(tuple(-x for x in OFFSET_M)))])
        units = kinds["std_msgs/msg/Float32"](0.0005)
        write("/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", [(1, units)])
        pictures = [(33_000_000 * k + 2, image(f[:, :, ::-1].copy(), "rgb8")) for k, f in enumerate(_frames())]
        write(f"{color}/image/data", "sensor_msgs/msg/Image", pictures, bytes(4))
        maps = [(33_000_000 * k + 9_000_000, image(_depth_map(), "mono16")) for k in range(6)]
        write(f"{depth}/image/data", "sensor_msgs/msg/Image", maps, bytes(4))


@pytest.mark.parametrize(("name", "write"), [("a.db3", write_realsense_db3), ("a.bag", write_realsense_bag)])
def test_realsense_gives_frames_intrinsics_and_depth_in_their_pixels(tmp_path: Path, name: str, write) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'cgwm[ros]'")
    write(tmp_path / name)
    result = import_realsense(tmp_path / name, tmp_path / "out", photos=FRAMES)
    capture = Capture.open(tmp_path / "out")
    assert len(capture.photos()) == result.photos >= 6
    (intrinsics,) = capture.manifest.calibration.intrinsics
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == (150.0, 151.0, 81.5, 59.5)
    first = capture.photos()[0]
    assert np.abs(capture.photo(first)[:, :, ::-1].astype(int) - _frames()[int(first[:6])]).mean() < 12
    depth = capture.photo_maps(first).depth_m
    assert depth is not None
    # the wall at 1 m begins at column 20 of the depth map: in the colour image, 15 mm farther to the right
    edge = 81 + 150 * ((19.5 - 39.5) / 70 + 0.015)
    row = depth[60]
    assert row[int(edge) + 2 :][:60] == pytest.approx(1.0, abs=1e-3) and not row[: int(edge) - 2].any()
    if "000007.jpg" in capture.photos():
        assert f"1 of {result.photos} photos have no depth at their time" in result.warnings


def test_depth_of_a_turned_camera_is_where_the_colour_camera_sees_it() -> None:
    turn = Rotation.from_euler("xyz", [0.05, -0.2, 0.1]).as_matrix()
    K = np.array([[100.0, 0, 49.5], [0, 100.0, 39.5], [0, 0, 1]])
    lens = {"size": (100, 80), "K": K, "lens": "None", "distortion": np.zeros(5)}
    color = StreamGeometry(**lens, R_stream_reference=np.eye(3), t_stream_reference=np.zeros(3))
    depth = StreamGeometry(**lens, R_stream_reference=turn, t_stream_reference=np.array([0.05, 0.01, -0.02]))
    x, y = np.meshgrid(np.arange(100), np.arange(80))
    rays = np.stack([(x - 49.5) / 100, (y - 39.5) / 100, np.ones(x.shape)], -1) @ turn  # in axes of the colour camera
    origin = -turn.T @ depth.t_stream_reference
    seen = (1.5 - origin[2]) / rays[..., 2]  # a wall at 1.5 m before the colour camera; the depth along its own axis
    found = in_color_pixels(seen, depth, color)
    assert (found[10:70, 30:70] > 0).mean() > 0.99
    assert found[found > 0] == pytest.approx(1.5, abs=2e-3)  # each pixel has one depth


def test_other_files_are_no_recordings(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'cgwm[ros]'")
    for name, content in (("a.txt", "x"), ("a.bag", "no bag"), ("a.db3", "no base")):
        (tmp_path / name).write_text(content)
        with pytest.raises(InputDataError, match=r"no recording of"):
            import_realsense(tmp_path / name, tmp_path / "out")
    assert not (tmp_path / "out").exists()
