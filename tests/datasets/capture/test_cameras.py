"""One camera in every format projects one point to one pixel."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cgwm.datasets import Camera, camera_of, read_cameras, to_intrinsics
from cgwm.datasets.capture.transforms import opencv_from_opengl
from cgwm.schemas import CamerasFile, InputDataError, PosedImage, PosedVideo, Scale

POINTS = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))


def rotation(rng: np.random.Generator) -> np.ndarray:
    matrix, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return matrix * np.sign(np.linalg.det(matrix))


def camera(distortion: tuple[float, ...] = (0.06, -0.08, -0.001, 0.0002)) -> Camera:
    """Return a camera that looks at the origin from 2 m, turned about its axis."""
    rng = np.random.default_rng(1)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = rotation(rng)
    T_world_cam[:3, 3] = -2.0 * T_world_cam[:3, 2] + [0.1, 0.0, -0.05]
    K = np.array([[310.0, 0, 161.2], [0, 305.0, 118.9], [0, 0, 1]])
    return Camera(width=320, height=240, K=K, distortion=np.array(distortion), T_world_cam=T_world_cam)


def quat_wxyz(matrix: np.ndarray) -> np.ndarray:
    """Return the quaternion of a rotation as the eigenvector of its 4x4 form (Bar-Itzhack 2000), an own way."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    form = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    return np.linalg.eigh(form)[1][:, -1]


def write_cgwm(root: Path, cam: Camera) -> None:
    pose = tuple(map(tuple, cam.T_world_cam.tolist()))
    file = CamerasFile(
        scale=Scale(kind="metric", source="test"),
        cameras={"c": to_intrinsics(cam)},
        images={"sub/a.png": PosedImage(camera="c", T_world_cam=pose)},
    )
    (root / "cameras.json").write_text(file.model_dump_json())


def transforms(cam: Camera) -> dict[str, Any]:
    k1, k2, p1, p2 = [*cam.distortion, 0, 0, 0, 0][:4]
    return {
        "fl_x": cam.K[0, 0], "fl_y": cam.K[1, 1], "cx": cam.K[0, 2], "cy": cam.K[1, 2],
        "w": 320.0, "h": 240, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "camera_model": "OPENCV",
        "frames": [
            {"file_path": "./images/sub/a.png", "transform_matrix": opencv_from_opengl(cam.T_world_cam).tolist()}
        ],
    }  # fmt: skip


def write_transforms(root: Path, cam: Camera) -> None:
    (root / "transforms.json").write_text(json.dumps(transforms(cam)))


def write_colmap_text(root: Path, cam: Camera) -> None:
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    T_cam_world = cam.T_cam_world
    pose = " ".join(repr(float(v)) for v in (*quat_wxyz(T_cam_world[:3, :3]), *T_cam_world[:3, 3]))
    params = " ".join(repr(float(v)) for v in (*cam.K[[0, 1, 0, 1], [0, 1, 2, 2]], *cam.distortion))
    (folder / "cameras.txt").write_text(f"# comment\n7 OPENCV 320 240 {params}\n")
    (folder / "images.txt").write_text(f"# comment\n3 {pose} 7 sub/a.png\n\n4 {pose} 7 sub/b c.png\n1 2 -1\n")


def write_colmap_binary(root: Path, cam: Camera) -> None:
    folder = root / "colmap"
    folder.mkdir(parents=True)
    T_cam_world = cam.T_cam_world
    params = (*cam.K[[0, 1, 0, 1], [0, 1, 2, 2]], *cam.distortion)
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ8d", 1, 7, 4, 320, 240, *params))
    images = struct.pack("<Q", 2)
    for number, name in ((3, b"sub/a.png"), (4, b"sub/b c.png")):
        images += struct.pack("<i7di", number, *quat_wxyz(T_cam_world[:3, :3]), *T_cam_world[:3, 3], 7)
        images += name + b"\0" + struct.pack("<Q", 2) + struct.pack("<ddq", 1, 2, -1) * 2
    (folder / "images.bin").write_bytes(images)


def textbook_pixels(cam: Camera, points: np.ndarray) -> np.ndarray:
    """Project point by point with OpenCV, whose pixel (0, 0) is the centre of the top-left one."""
    import cv2

    K_opencv = cam.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    turn, _ = cv2.Rodrigues(cam.T_cam_world[:3, :3])
    pixels, _ = cv2.projectPoints(points, turn, cam.T_cam_world[:3, 3], K_opencv, cam.distortion)
    return pixels[:, 0] + 0.5


@pytest.mark.parametrize("distortion", [(), (0.06, -0.08, -0.001, 0.0002), (0.1, -0.05, 0.002, 0.001, 0.03)])
def test_projection_is_that_of_opencv(distortion: tuple[float, ...]) -> None:
    cam = camera(distortion)
    pixels, depth = cam.project(POINTS)
    np.testing.assert_allclose(pixels, textbook_pixels(cam, POINTS), atol=1e-9)
    np.testing.assert_allclose(depth, (POINTS - cam.center) @ cam.T_world_cam[:3, 2], atol=1e-12)


def test_a_point_behind_the_camera_has_no_pixel() -> None:
    cam = camera()
    pixels, depth = cam.project(np.stack([cam.center - cam.T_world_cam[:3, 2], cam.center]))
    assert np.isnan(pixels).all() and depth == pytest.approx([-1, 0])


@pytest.mark.parametrize(
    ("write", "scale"),
    [
        (write_cgwm, "metric"),
        (write_transforms, "unscaled"),
        (write_colmap_text, "unscaled"),
        (write_colmap_binary, "unscaled"),
    ],
)
def test_formats_agree_on_the_same_pixel(tmp_path: Path, write: Any, scale: str) -> None:
    cam = camera()
    write(tmp_path, cam)
    file = read_cameras(tmp_path)
    assert file is not None and file.scale.kind == scale
    found = camera_of(file, "sub/a.png")
    assert (found.width, found.height) == (320, 240)
    np.testing.assert_allclose(found.project(POINTS)[0], cam.project(POINTS)[0], atol=1e-9)
    if write in (write_colmap_text, write_colmap_binary):
        assert set(file.images) == {"sub/a.png", "sub/b c.png"}


def test_supplied_cameras_may_be_metric(tmp_path: Path) -> None:
    write_transforms(tmp_path, camera())
    file = read_cameras(tmp_path, metric=True)
    assert file is not None and file.scale.kind == "metric"


def test_cameras_json_counts_first(tmp_path: Path) -> None:
    write_colmap_text(tmp_path, camera())
    write_cgwm(tmp_path, camera(()))
    file = read_cameras(tmp_path)
    assert file is not None and list(file.cameras) == ["c"] and read_cameras(tmp_path / "sparse") is None


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", "300 160 120", (300, 300, ())),
        ("PINHOLE", "300 310 160 120", (300, 310, ())),
        ("SIMPLE_RADIAL", "300 160 120 0.1", (300, 300, (0.1, 0, 0, 0))),
        ("RADIAL", "300 160 120 0.1 0.2", (300, 300, (0.1, 0.2, 0, 0))),
        ("FULL_OPENCV", "300 310 160 120 1 2 3 4 5 0 0 0", (300, 310, (1, 2, 3, 4, 5))),
    ],
)
def test_colmap_models(tmp_path: Path, model: str, params: str, expected: tuple) -> None:
    write_colmap_text(tmp_path, camera())
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text(f"7 {model} 320 240 {params}\n")
    file = read_cameras(tmp_path)
    assert file is not None
    intrinsics = file.cameras["camera7"]
    assert (intrinsics.fx, intrinsics.fy, intrinsics.distortion) == expected
    assert (intrinsics.cx, intrinsics.cy) == (160, 120)


def test_colmap_faults(tmp_path: Path) -> None:
    write_colmap_text(tmp_path, camera())
    path = tmp_path / "sparse" / "0" / "cameras.txt"
    path.write_text("7 OPENCV_FISHEYE 320 240 1 1 1 1 0 0 0 0\n")
    with pytest.raises(InputDataError) as caught:
        read_cameras(tmp_path)
    assert str(caught.value).startswith(
        f"{path}, line 1: camera 7 has the model OPENCV_FISHEYE.\n"
        "Allowed: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV."
    )


POSE = "1 0 0 0 0 0 0"


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("cameras", "# by hand\n7 PINHOLE 320 240 1 1\n", "line 2: 2 parameters for the model PINHOLE, which has 4"),
        (
            "cameras",
            "7 PINHOLE 320 240 inf 1 1 1\n",
            "line 1: camera 7 has parameters that are not finite: (inf, 1.0, ",
        ),
        ("cameras", "7 PINHOLE 320 240 1 1_0 1 1\n", "line 1: no number: '1_0'"),
        ("cameras", f"7 PINHOLE {'9' * 30} 240 1 1 1 1\n", f"line 1: no whole number: '{'9' * 30}'"),
        ("cameras", "7 PINHOLE\n", "line 1: 2 words for a camera"),
        (
            "images",
            "3 1 0 0 0 nan 0 0 7 sub/a.png\n\n",
            "line 1: image 'sub/a.png' has a pose that is not finite, or no",
        ),
        (
            "images",
            f"3 {POSE} 7 sub/a.png\n\n4 {POSE} 8 sub/b.png\n",
            "line 3: image 'sub/b.png' is of the camera 8, wh",
        ),
        ("images", "3 1 0 0\n\n", "line 1: 4 words for an image"),
    ],
)
def test_faults_of_colmaps_texts_name_file_and_line(tmp_path: Path, name: str, text: str, found: str) -> None:
    write_colmap_text(tmp_path, camera())
    path = tmp_path / "sparse" / "0" / f"{name}.txt"
    path.write_text(text)
    with pytest.raises(InputDataError) as caught:
        read_cameras(tmp_path)
    assert str(caught.value).startswith(f"{path}, {found}")
    assert caught.value.allowed and caught.value.todo


@pytest.mark.parametrize("name", ["cameras", "images"])
def test_faults_of_colmaps_binary_files_name_the_file(tmp_path: Path, name: str) -> None:
    write_colmap_binary(tmp_path, camera())
    path = tmp_path / "colmap" / f"{name}.bin"
    whole = path.read_bytes()
    for damaged in (
        whole[:4],
        whole[: len(whole) // 2],
        b"\xff" * 8 + whole[8:],
        whole[:12] + b"\xff" * len(whole[12:]),
    ):
        path.write_bytes(damaged)
        with pytest.raises(InputDataError) as caught:
            read_cameras(tmp_path)
        assert str(caught.value).startswith(f"{path}") and "\nNext: export it again" in str(caught.value)


def test_real_pycolmap_reads_the_same(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    cam = camera()
    write_colmap_text(tmp_path, cam)
    (tmp_path / "sparse" / "0" / "points3D.txt").touch()
    image = pycolmap.Reconstruction(tmp_path / "sparse" / "0").images[3]
    np.testing.assert_allclose(image.projection_center(), cam.center, atol=1e-12)
    (tmp_path / "binary").mkdir()
    pycolmap.Reconstruction(tmp_path / "sparse" / "0").write(tmp_path / "binary")
    (tmp_path / "binary").rename(tmp_path / "colmap")
    (tmp_path / "sparse" / "0" / "cameras.txt").unlink()
    file = read_cameras(tmp_path)
    assert file is not None
    np.testing.assert_allclose(camera_of(file, "sub/a.png").project(POINTS)[0], cam.project(POINTS)[0], atol=1e-9)


def test_resizing_scales_pixels_and_back(tmp_path: Path) -> None:
    cam = camera()
    small = cam.resized(80, 120)
    np.testing.assert_allclose(small.project(POINTS)[0], cam.project(POINTS)[0] * [0.25, 0.5], atol=1e-9)
    np.testing.assert_allclose(small.resized(320, 240).K, cam.K)


def test_undistorting_moves_a_mark_to_where_the_pinhole_sees_it() -> None:
    cam = replace(camera(), distortion=np.array([-0.3, 0.05, 0.002, -0.001]))
    point = cam.center + 2 * cam.T_world_cam[:3, 2] + 0.6 * cam.T_world_cam[:3, 0]
    x, y = cam.project(point[None])[0][0]
    rows, columns = np.mgrid[0:240, 0:320] + 0.5
    image = (255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18)).astype(np.uint8)
    straight, pinhole = cam.undistorted(image)
    weights = straight / straight.sum()
    centre = np.array([(weights * columns).sum(), (weights * rows).sum()])
    expected = pinhole.project(point[None])[0][0]
    assert np.linalg.norm(expected - [x, y]) > 2 and np.linalg.norm(centre - expected) < 0.2


def test_transforms_variants(tmp_path: Path) -> None:
    data = transforms(camera(()))
    for name in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"):
        del data[name]
    frame = data["frames"][0]
    data |= {
        "camera_angle_x": 2 * np.arctan(160 / 300),
        "frames": [frame, {**frame, "file_path": "b.png", "fl_x": 400}],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    file = read_cameras(tmp_path)
    assert file is not None and set(file.images) == {"sub/a.png", "b.png"}
    first, second = camera_of(file, "sub/a.png"), camera_of(file, "b.png")
    assert first.K[0, 0] == pytest.approx(300) == first.K[1, 1] and first.K[0, 2] == 160
    assert second.K[0, 0] == 400


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "frames[0]: the camera model is OPENCV_FISHEYE."),
        ({"k4": 0.1}, "frames[0]: k4 = 0.1."),
        ({"fl_x": "long"}, "frames[0]: 'fl_x' is 'long', no finite number."),
        ({"frames": []}, "no list 'frames' with at least one frame."),
        ({"frames": [{"file_path": "a.png"}]}, "frames[0]: 'transform_matrix' is no 4x4 matrix of finite numbers."),
        ({"frames": [{}]}, "frames[0]: no 'file_path'."),
    ],
)
def test_transforms_faults(tmp_path: Path, change: dict[str, Any], expected: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(transforms(camera()) | change))
    with pytest.raises(InputDataError) as caught:
        read_cameras(tmp_path)
    assert str(caught.value).splitlines()[0] == f"{path}: {expected}"


@pytest.mark.parametrize("value", ["NaN", "Infinity"])
def test_a_pose_that_is_not_finite_is_told_with_its_place(tmp_path: Path, value: str) -> None:
    write_cgwm(tmp_path, camera())
    path = tmp_path / "cameras.json"
    data = json.loads(path.read_text())
    data["images"]["sub/a.png"]["T_world_cam"][1][3] = float(value.lower().replace("infinity", "inf"))
    path.write_text(json.dumps(data))
    with pytest.raises(InputDataError) as caught:
        read_cameras(tmp_path)
    found = str(caught.value)
    assert found.startswith(f"{path}") and "T_world_cam" in found and "finite" in found


def test_pose_with_a_scale_or_a_mirror_is_refused(tmp_path: Path) -> None:
    for factor, expected in ((1.1, "R R^T differs from 1 by 0.21"), (-1.0, "it mirrors (determinant -1)")):
        cam = camera()
        pose = cam.T_world_cam.copy()
        pose[:3, :3] *= factor
        write_cgwm(tmp_path, replace(cam, T_world_cam=pose))
        with pytest.raises(InputDataError) as caught:
            read_cameras(tmp_path)
        assert str(caught.value).splitlines()[0] == (
            f"{tmp_path / 'cameras.json'}: image 'sub/a.png': the pose is no rotation and translation: {expected}."
        )


def test_video_cameras_stand_or_move() -> None:
    pose = tuple(map(tuple, camera().T_world_cam.tolist()))
    other = tuple(map(tuple, np.eye(4).tolist()))
    file = CamerasFile(
        scale=Scale(kind="metric"),
        cameras={"c": to_intrinsics(camera())},
        videos={
            "still": PosedVideo(camera="c", T_world_cam=pose),
            "moving": PosedVideo(camera="c", T_world_cam=(pose, other)),
            "still/002": PosedVideo(camera="c", T_world_cam=other),
        },
    )
    assert np.array_equal(camera_of(file, "still", 9, "videos", "001").T_world_cam, pose)
    assert np.array_equal(camera_of(file, "still", 9, "videos", "002").T_world_cam, other)
    assert np.array_equal(camera_of(file, "moving", 1, "videos").T_world_cam, other)
    with pytest.raises(InputDataError) as caught:
        camera_of(file, "moving", 2, "videos")
    assert str(caught.value) == (
        "the video camera 'moving' has 2 poses, one a frame; frame 2 was asked for.\nAllowed: 0 to 1.\n"
        "Next: remove the frames without a pose, or add these."
    )
    with pytest.raises(InputDataError) as caught:
        camera_of(file, "stil", kind="videos")
    assert str(caught.value) == (
        "no pose for the video camera 'stil' (3 videos have one). Did you mean 'still'?\n"
        "Next: run 'cgwm calibrate', or add it to cameras.json."
    )
