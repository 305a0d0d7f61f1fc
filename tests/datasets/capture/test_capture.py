"""Captures: what is read from a good one, and the one message that each kind of bad input gets."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from cgwm.datasets import Capture, Track, check_capture, manifest_toml, write_image, write_manifest, write_tracks
from cgwm.pipeline.validate import validate
from cgwm.schemas import (
    Body,
    BoxShape,
    CameraIntrinsics,
    CamerasFile,
    CaptureManifest,
    Episode,
    Ground,
    InputDataError,
    Marker,
    Measurement,
    Pose,
    PosedImage,
    PosedVideo,
    Scale,
    Shape,
    UsageError,
    Video,
    World,
    read_toml,
)
from cgwm.schemas.capture import Calibration
from datasets.capture.test_tracks import random_track
from datasets.shapes.test_meshes import box, obj_text

MANIFEST = """format = "cgwm-capture/1"
[[bodies]]
name = "cube"
[[bodies]]
name = "tip"
motion = "driven"
[splits]
train = ["000"]
test = ["001"]
[episodes]
"001" = { start_s = 0.0, end_s = 0.1 }
[video]
frame_rate_hz = 20.0
camera_time_offset_s = { left = 0.01 }
"""
EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def picture(seed: int, width: int = 24, height: int = 16) -> np.ndarray:
    """Return a smooth picture, so that JPEG changes it little."""
    rows, columns = np.mgrid[0:height, 0:width]
    shades = [50 + 4 * columns + 3 * seed, 200 - 5 * rows, 60 + 2 * (rows + columns) + 20 * seed]
    return np.stack(shades, axis=2).clip(0, 255).astype(np.uint8)


def label(width: int = 24, height: int = 16, value: int = 1) -> np.ndarray:
    mask = np.zeros((height, width), np.uint8)
    mask[: height // 2] = value
    return mask


def still(count: int = 6) -> dict[str, Track]:
    track = random_track(0, count)
    return {"cube": Track(np.arange(count) / 20, track.position_m, track.quat_wxyz)}


def put(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, image)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Return a good capture with photos, masks, cameras, videos and tracks."""
    root = tmp_path / "capture"
    for k in range(3):
        put(root / "images" / "walk" / f"{k}.jpg", picture(k))
        put(root / "masks" / "walk" / f"{k}.png", label())
    for episode in ("000", "001"):
        for k in range(6):
            put(root / "videos" / "left" / episode / f"{k:06d}.png", picture(k))
            put(root / "video_masks" / "left" / episode / f"{k:06d}.png", label(value=2))
        (root / "tracks").mkdir(exist_ok=True)
        write_tracks(root / "tracks" / f"{episode}.csv", still())
    (root / "capture.toml").write_text(MANIFEST)
    write_cameras(root)
    return root


def write_cameras(root: Path, names: tuple[str, ...] = ("walk/0.jpg", "walk/1.jpg"), **change: Any) -> None:
    size = {"width": 24, "height": 16, "fx": 30.0, "fy": 30.0, "cx": 12.0, "cy": 8.0} | change
    file = CamerasFile(
        scale=Scale(kind="metric"),
        cameras={"c": CameraIntrinsics(**size)},
        images={name: PosedImage(camera="c", T_world_cam=EYE) for name in names},
        videos={"left": PosedVideo(camera="c", T_world_cam=EYE)},
    )
    (root / "cameras.json").write_text(file.model_dump_json())


def fault(root: Path) -> str:
    """Open a bad capture; return the message with the capture's path shortened to C."""
    with pytest.raises(InputDataError) as caught:
        Capture.open(root)
    assert caught.value.exit_code == 2
    return str(caught.value).replace(str(root), "C")


def replace_text(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


# What a good capture holds


def test_facts(root: Path) -> None:
    facts = check_capture(Capture.open(root))
    assert (facts.photos, facts.photos_with_camera, facts.masks, facts.scale) == (3, 2, 3, "metric")
    assert facts.mask_coverage == {"cube": 0.5, "tip": 0.0}
    assert (facts.episodes, facts.splits, facts.videos) == (2, {"train": 1, "test": 1}, 2)
    assert facts.track_samples == 6 + 3 and facts.video_frames == 6 + 2
    assert validate(root).facts["photos"] == 3 and validate(root).passed


def test_photos_masks_and_cameras(root: Path) -> None:
    capture = Capture.open(root)
    assert capture.photos() == ["walk/0.jpg", "walk/1.jpg", "walk/2.jpg"]
    error = capture.photo("walk/1.jpg").astype(int) - picture(1)
    assert error.shape == (16, 24, 3) and np.abs(error).mean() < 5
    mask = capture.photo_mask("walk/1.jpg")
    assert mask is not None and np.array_equal(mask, label())
    (root / "masks" / "walk" / "1.png").unlink()
    assert capture.photo_mask("walk/1.jpg") is None
    assert capture.photo_camera("walk/1.jpg").K[0, 2] == 12.0
    with pytest.raises(InputDataError, match=r"no pose for the photo 'walk/2\.jpg' \(2 images have one\)"):
        capture.photo_camera("walk/2.jpg")


def test_channels_are_in_the_order_red_green_blue(tmp_path: Path) -> None:
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0] = 200
    (tmp_path / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    put(tmp_path / "images" / "red.png", red)
    assert Capture.open(tmp_path).photo("red.png")[0, 0].tolist() == [200, 0, 0]


def test_episodes_tracks_and_videos(root: Path) -> None:
    capture = Capture.open(root)
    assert capture.episodes() == ["000", "001"] and capture.episodes("test") == ["001"]
    assert capture.video_cameras() == ["left"] and capture.videos("000") == ["left"]
    assert len(capture.tracks("000")["cube"]) == 6
    assert capture.tracks("001")["cube"].time_s.tolist() == [0, 0.05, 0.1]
    np.testing.assert_allclose(capture.frame_times("left", "000"), np.arange(6) / 20 + 0.01)
    np.testing.assert_allclose(capture.frame_times("left", "001"), [0.01, 0.06])
    assert capture.frame_numbers("left", "001").tolist() == [0, 1]
    frames, masks = capture.video_frames("left", "001"), capture.video_masks("left", "001")
    assert np.array_equal(frames, np.stack([picture(0), picture(1)]))
    assert masks is not None and masks.shape == (2, 16, 24) and masks.max() == 2
    assert capture.video_camera("left", "001", 1).width == 24
    assert capture.tracks("002") == {}


def test_unknown_names_are_answered_with_the_nearest(root: Path) -> None:
    capture = Capture.open(root)
    with pytest.raises(UsageError) as caught:
        capture.episodes("tets")
    assert str(caught.value).replace(str(root), "C") == (
        "C/capture.toml: no split 'tets'.\nAllowed: test, train. Did you mean 'test'?\nNext: name it in [splits]."
    )
    bare = replace(capture, manifest=capture.manifest.model_copy(update={"splits": {}}))
    with pytest.raises(UsageError, match=r"\[splits\] is empty\.\nNext: list its episodes in \[splits\]"):
        bare.episodes("test")
    with pytest.raises(UsageError, match="no body 'cub'"):
        capture.body("cub")
    with pytest.raises(InputDataError, match="no video of episode '00'"):
        capture.video_path("left", "00")


@pytest.mark.parametrize("suffix", ["mp4", "mov"])
def test_video_file(root: Path, suffix: str) -> None:
    path = root / "videos" / "right" / f"000.{suffix}"
    path.parent.mkdir()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (64, 48))
    for k in range(5):
        writer.write(np.full((48, 64, 3), 40 * k, np.uint8))
    writer.release()
    capture = Capture.open(root)
    info = capture.video_info("right", "000")
    assert (info.frames, info.width, info.height, info.frame_rate_hz) == (5, 64, 48, 20.0)
    frames = capture.video_frames("right", "000")
    assert frames.shape == (5, 48, 64, 3) and np.abs(frames[3].astype(int) - 120).max() < 10
    assert capture.videos("000") == ["left", "right"] and len(capture.frame_times("right", "000")) == 5
    replace_text(root / "capture.toml", "frame_rate_hz = 20.0", "frame_rate_hz = 240.0")
    replace_text(root / "capture.toml", '"001" = { start_s = 0.0, end_s = 0.1 }', "")
    warnings = check_capture(Capture.open(root)).warnings
    assert warnings == [f"{path}: the file says 20 frames/s; capture.toml's 240 is used."]
    path.write_bytes(path.read_bytes()[:100])
    assert f"C/videos/right/000.{suffix}: the video does not decode." in fault(root)


def test_other_splits_are_not_opened(root: Path) -> None:
    """What works on one split gives the same whether or not the episodes of another are there."""
    (root / "tracks" / "001.csv").write_text("garbage")
    capture = Capture.open(root, splits=["train"])
    assert capture.episodes() == ["000"]
    (root / "tracks" / "001.csv").unlink()
    for path in sorted((root / "videos" / "left" / "001").iterdir()):
        path.unlink()
    (root / "videos" / "left" / "001").rmdir()
    assert check_capture(Capture.open(root, splits=["train"])) == check_capture(capture)
    with pytest.raises(InputDataError, match=r"\[splits\] test names the episode '001'"):
        Capture.open(root)


def test_manifest_round_trip(tmp_path: Path) -> None:
    manifest = CaptureManifest(
        format="cgwm-capture/1",
        world=World(gravity_m_s2=(0.0, 0.1, -9.81), ground=Ground(offset_m=-1e-5)),
        bodies=(
            Body(name="a.b", mass_kg=0.1, inertia_kg_m2=(1e-5, 2e-5, 3e-5, 0.0, 1e-7, 0.0), com_m=(0.0, 0.01, 0.0)),
            Body(name="c", motion="fixed", shape=Shape(box=BoxShape(half_extents_m=(1.0, 2.0, 3.0)))),
            Body(name="d", photo_pose=Pose(position_m=(1.0, 2.0, 3.0))),
        ),
        measurement=Measurement(position_std_m=0.001),
        splits={"train": ("000", 'a "quoted" \\ name\n')},
        episodes={"000": Episode(group="grüße", end_s=1.5)},
        video=Video(frame_rate_hz=24.0, camera_time_offset_s={"left one": -0.5}),
        calibration=Calibration(markers=(Marker(id=3, side_m=0.05, pose=Pose()),), same_camera=False),
    )
    write_manifest(tmp_path / "capture.toml", manifest)
    assert read_toml(tmp_path / "capture.toml", CaptureManifest) == manifest
    shortest = CaptureManifest(format="cgwm-capture/1")
    assert manifest_toml(shortest) == ('format = "cgwm-capture/1"\n\n[world]\ngravity_m_s2 = [0.0, 0.0, -9.81]\n')


# Manifest


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            'name = "tip"\n',
            'name = "tip"\nmass = 0.3\n',
            "C/capture.toml, line 6: [[bodies]] 'tip' has an unknown field 'mass'.\n"
            "Allowed: name, motion, mass_kg, inertia_kg_m2, com_m, shape, photo_pose, material, face_points, "
            "face_exponent, photo_box. Did you mean 'mass_kg'?\n"
            "Next: correct the field.",
        ),
        (
            'format = "cgwm-capture/1"\n',
            "",
            "C/capture.toml: the top level lacks the field 'format'.\n"
            "Allowed: format, world, bodies, articulations, materials, pairs, surfaces, measurement, "
            "splits, episodes, video, calibration.\n"
            "Next: correct the field.",
        ),
        (
            'name = "cube"\n',
            "mass_kg = 1.0\n",
            "C/capture.toml, line 2: [[bodies]] lacks the field 'name'.\n"
            "Allowed: name, motion, mass_kg, inertia_kg_m2, com_m, shape, photo_pose, material, face_points, "
            "face_exponent, photo_box.\n"
            "Next: correct the field.",
        ),
        (
            "[splits]",
            "[split]",
            "C/capture.toml, line 7: the top level has an unknown field 'split'.\n"
            "Allowed: format, world, bodies, articulations, materials, pairs, surfaces, measurement, "
            "splits, episodes, video, calibration. "
            "Did you mean 'splits'?\nNext: correct the field.",
        ),
        (
            'name = "tip"',
            'name = "cube"',
            "C/capture.toml: two bodies have the name 'cube'; names must differ.\nNext: correct the field.",
        ),
        (
            'name = "cube"\n',
            'name = "cube"\ninertia_kg_m2 = [1.0, 1.0]\n',
            "C/capture.toml, line 4: [[bodies]] 'cube' inertia_kg_m2: takes 3 numbers (xx, yy, zz) or 6 "
            "(xx, yy, zz, xy, xz, yz); found 2.\nNext: correct the field.",
        ),
        (
            'name = "cube"\n',
            'name = "cube"\ninertia_kg_m2 = [1.0, 1.0, 3.0]\n',
            "C/capture.toml, line 4: [[bodies]] 'cube' inertia_kg_m2: no body has this inertia: one moment is larger "
            "than the other two together.\nNext: correct the field.",
        ),
        (
            'name = "cube"\n',
            'name = "cube"\nphoto_pose = { quat_wxyz = [0.9, 0.0, 0.0, 0.0] }\n',
            "C/capture.toml, line 4: [[bodies]] 'cube' photo_pose.quat_wxyz: the quaternion has norm 0.9000; "
            "it must be 1 within 0.001 (order w, x, y, z).\nNext: correct the field.",
        ),
        (
            'name = "cube"\n',
            'name = "cube"\nshape = { box = { half_extents_m = [1.0, 1.0] } }\n',
            "C/capture.toml, line 4: [[bodies]] 'cube' shape.box.half_extents_m: takes 3 values; found 2 "
            "(found [1.0, 1.0]).\nNext: correct the field.",
        ),
        (
            "frame_rate_hz = 20.0",
            "frame_rate_hz = 0",
            "C/capture.toml, line 13: video.frame_rate_hz: input should be greater than or equal to 0.001 (found 0).\n"
            "Next: correct the field.",
        ),
        (
            'test = ["001"]',
            'test = ["0001"]',
            "C/capture.toml: [splits] test names the episode '0001', which has neither track nor video.\n"
            "Allowed: 000, 001. Did you mean '001'?\n"
            "Next: correct the name, or add tracks/<episode>.csv or videos/<camera>/<episode> to C.",
        ),
        (
            '"001" = {',
            '"002" = {',
            "C/capture.toml: [episodes] names '002', which has neither track nor video.\n"
            "Allowed: 000, 001. Did you mean '001'?\n"
            "Next: correct the name, or add tracks/<episode>.csv or videos/<camera>/<episode> to C.",
        ),
        (
            'name = "cube"\n',
            'name = "cube"\nmaterial = "stel"\n',
            "C/capture.toml: body 'cube' names the material 'stel', which is not among [[materials]]; there are none.\n"
            "Next: correct the field.",
        ),
        (
            "[video]",
            '[[materials]]\nname = "steel"\n[[materials]]\nname = "steel"\n[video]',
            "C/capture.toml: two [[materials]] have the name 'steel'; names must differ.\nNext: correct the field.",
        ),
        (
            "[video]",
            '[[materials]]\nname = "steel"\n[[pairs]]\nmaterials = ["steel", "wood"]\n[video]',
            "C/capture.toml: [[pairs]] names the material 'wood', which is not among [[materials]]; they are steel.\n"
            "Next: correct the field.",
        ),
        (
            "[video]",
            '[[materials]]\nname = "a"\n[[materials]]\nname = "b"\n'
            '[[pairs]]\nmaterials = ["a", "b"]\n[[pairs]]\nmaterials = ["b", "a"]\n[video]',
            "C/capture.toml: two [[pairs]] are of 'a' and 'b'; each pair of materials stands once, in either order.\n"
            "Next: correct the field.",
        ),
        (
            "[video]",
            '[[materials]]\nname = "a"\nrestitution = 0.3\n[video]',
            "C/capture.toml, line 14: [[materials]] 'a' has an unknown field 'restitution'.\n"
            "Allowed: name, friction. Did you mean 'friction'?\n"
            "Next: correct the field.",
        ),
        (
            "{ left = ",
            "{ lefty = ",
            "C/capture.toml: [video] camera_time_offset_s names the camera 'lefty', which has no directory in "
            "videos/.\nAllowed: left. Did you mean 'left'?\nNext: correct the name, or remove the entry.",
        ),
    ],
)
def test_manifest_faults(root: Path, old: str, new: str, expected: str) -> None:
    replace_text(root / "capture.toml", old, new)
    assert fault(root) == expected


def test_shapes_stay_inside_the_capture_and_are_read(root: Path) -> None:
    for path, expected in (
        ("../../x.obj", "lies outside the capture."),
        ("/etc/passwd", "lies outside the capture."),
        ("x.obj", "no such file."),
        ("capture.toml", "the suffix is '.toml'."),
    ):
        text = MANIFEST.replace('name = "cube"\n', f'name = "cube"\nshape = {{ mesh = {{ path = "{path}" }} }}\n')
        (root / "capture.toml").write_text(text)
        separator = " " if "outside" in expected else ": "
        assert fault(root).splitlines()[0] == (
            f"C/capture.toml: [[bodies]] 'cube': shape path '{path}'{separator}{expected}"
        )
    (root / "x.obj").write_text(obj_text(box()))
    (root / "capture.toml").write_text(
        MANIFEST.replace('name = "cube"\n', 'name = "cube"\nshape = { mesh = { path = "x.obj" } }\n')
    )
    capture = Capture.open(root)
    assert capture.shape_file(capture.body("cube")) == root / "x.obj"
    replace_text(root / "x.obj", "f 1/1 2/1/1 4//1\n", "")
    assert fault(root).startswith("C/x.obj: the mesh is not closed")


# Photos, masks and cameras


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_image_that_does_not_decode(root: Path, suffix: str) -> None:
    path = root / "images" / f"z{suffix}"
    put(path, picture(0, 200, 100))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    size = len(whole) // 2
    assert fault(root) == (
        f"C/images/z{suffix}: the image does not decode: truncated ({size} bytes).\n"
        "Allowed: PNG and JPEG.\nNext: replace the file, or remove it."
    )
    path.write_bytes(b"")
    assert fault(root).startswith(f"C/images/z{suffix}: the image does not decode: neither PNG nor JPEG (0 bytes).")
    path.write_bytes(whole[:-20] + b"x" * 20)
    assert "the image does not decode" in fault(root)


def test_mask_of_another_size(root: Path) -> None:
    put(root / "masks" / "walk" / "1.png", label(12, 8))
    assert fault(root) == (
        "C/masks/walk/1.png: the mask has 12x8 px, images/walk/1.jpg has 24x16 px.\n"
        "Allowed: a mask of its image's size.\nNext: make the mask at the size of the picture."
    )
    put(root / "masks" / "walk" / "1.png", label(16, 24))
    assert "at the size of the picture, turned upright as its EXIF data say." in fault(root)


def test_mask_label_beyond_the_bodies(root: Path) -> None:
    put(root / "masks" / "walk" / "1.png", label(value=3))
    assert fault(root) == (
        "C/masks/walk/1.png: label 3, but the manifest has 2 [[bodies]].\n"
        "Allowed: 0 (background) to 2: label k is the k-th of [[bodies]].\n"
        "Next: correct the mask, or add the bodies to capture.toml."
    )
    put(root / "masks" / "walk" / "1.png", label(value=255))
    assert "Next: for a mask of 0 and 255, divide it by 255" in fault(root)


def test_mask_with_colours_and_mask_without_photo(root: Path) -> None:
    put(root / "masks" / "walk" / "1.png", picture(0))
    assert fault(root).startswith("C/masks/walk/1.png: a mask of 3 channel(s) with 8 bits.\nAllowed: one channel")
    put(root / "masks" / "walk" / "1.png", label())
    put(root / "masks" / "walk" / "9.png", label())
    assert fault(root).splitlines()[0] == "C/masks/walk/9.png: there is no photo of that name in images/."


def test_cameras_for_images_that_are_not_there(root: Path) -> None:
    write_cameras(root, ("walk/0.jpg", "walk/7.jpg", "walk/8.jpg"))
    assert fault(root) == (
        "C/cameras.json: 2 of 3 cameras are for photos that are not in images/, such as 'walk/7.jpg'.\n"
        "Allowed: names relative to images/. Did you mean 'walk/2.jpg'?\n"
        "Next: add the photos, or remove the cameras."
    )


def test_camera_of_another_size(root: Path) -> None:
    write_cameras(root, width=48, height=32)
    message = fault(root)
    assert message.splitlines()[0] == "C/images/walk/0.jpg: 24x16 px, but its camera 'c' has 48x32 px."
    assert "(2 more fault(s); 'cgwm validate C' lists all.)" in message


def test_camera_for_a_video_that_is_not_there(root: Path) -> None:
    data = json.loads((root / "cameras.json").read_text())
    data["videos"]["lift"] = data["videos"]["left"]
    (root / "cameras.json").write_text(json.dumps(data))
    assert fault(root) == (
        "C/cameras.json: a camera for the videos 'lift', which are not in videos/.\n"
        "Allowed: left. Did you mean 'left'?\nNext: add the videos, or remove the camera from cameras.json."
    )


def test_misspelt_field_in_cameras_json(root: Path) -> None:
    replace_text(root / "cameras.json", '"fx"', '"focal_x"')
    assert fault(root).splitlines()[0] == "C/cameras.json, line 1: [cameras.c] has an unknown field 'focal_x'."


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("images/IMG_1.HEIC", "C/images/IMG_1.HEIC: .HEIC is not read.\nAllowed: .jpg and .png."),
        ("masks/a.tif", "C/masks/a.tif: .tif is not read.\nAllowed: .png."),
        ("videos/left/002.AVI", "C/videos/left/002.AVI: .AVI is not read.\nAllowed: .mp4, .mov, .webm, or a directory"),
    ],
)
def test_no_photo_or_video_is_passed_over_in_silence(root: Path, name: str, expected: str) -> None:
    (root / name).touch()
    assert fault(root).startswith(expected)


def test_links_are_followed_but_not_in_circles(root: Path, tmp_path: Path) -> None:
    put(tmp_path / "elsewhere" / "b.png", picture(4))
    (root / "images" / "linked").symlink_to(tmp_path / "elsewhere")
    (root / "images" / "circle").symlink_to(root / "images")
    (root / "images" / ".hidden.png").touch()
    assert Capture.open(root).photos() == ["linked/b.png", "walk/0.jpg", "walk/1.jpg", "walk/2.jpg"]


# Episodes


def test_fault_in_a_track(root: Path) -> None:
    (root / "tracks" / "000.csv").write_text("time_s,body,px_mm,py_mm,pz_mm\n0,cube,1,2,3\n")
    assert fault(root).splitlines()[0] == "C/tracks/000.csv, line 1: unknown column 'px_mm'."


def test_a_window_that_cuts_nothing_off_is_a_warning(root: Path) -> None:
    replace_text(root / "capture.toml", "end_s = 0.1", "end_s = 9.0")
    (said,) = check_capture(Capture.open(root)).warnings
    assert said.startswith("episode '001': its end_s = 9 lies outside of its tracks, which last from 0 s to")


def test_episode_of_one_sample_and_of_one_frame(root: Path) -> None:
    replace_text(root / "capture.toml", "end_s = 0.1", "end_s = 0.04")
    message = fault(root)
    assert message.splitlines()[0] == (
        "C/tracks/001.csv: body 'cube' has 1 of 6 samples between the episode's start_s and end_s."
    )
    (root / "tracks" / "001.csv").unlink()
    assert fault(root) == (
        "C/videos/left/001: episode '001' has 1 frame(s) between start_s and end_s (6 in all).\n"
        "Allowed: at least 2.\nNext: add frames, or remove it."
    )
    for k in range(1, 6):
        (root / "videos" / "left" / "000" / f"{k:06d}.png").unlink()
    assert fault(root).splitlines()[0] == "C/videos/left/000: episode '000' has 1 frame(s)."


def test_frames_with_a_gap_of_another_size_or_with_words(root: Path) -> None:
    folder = root / "videos" / "left" / "000"
    (folder / "000002.png").unlink()
    assert fault(root) == (
        "C/videos/left/000: frame 2 is missing (5 frames, the last is 5).\n"
        "Allowed: frames numbered 0, 1, 2, ... without gaps, since the number is the time.\n"
        "Next: number the frames from 0."
    )
    put(folder / "000002.png", picture(0, 12, 8))
    assert fault(root).splitlines()[0] == ("C/videos/left/000/000002.png: 12x8 px, but 000000.png has 24x16 px.")
    (folder / "000002.png").rename(folder / "first.png")
    assert fault(root).splitlines()[0] == "C/videos/left/000/first.png: the name is no frame number."


def test_video_masks_must_match_their_video(root: Path) -> None:
    folder = root / "video_masks" / "left" / "000"
    (folder / "000005.png").unlink()
    assert fault(root).splitlines()[0] == "C/video_masks/left/000: 5 masks for 6 frames."
    put(folder / "000005.png", label(value=9))
    assert fault(root).splitlines()[0] == (
        "C/video_masks/left/000/000005.png: label 9, but the manifest has 2 [[bodies]]."
    )


# The whole


def test_validate_lists_every_fault(root: Path) -> None:
    (root / "images" / "z.png").write_bytes(b"text")
    (root / "tracks" / "000.csv").write_text("time_s,body,px_m,py_m,pz_m\n0,cube,1,2,nan\n1,cube,1,2,3\n")
    with pytest.raises(InputDataError) as caught:
        validate(root)
    lines = str(caught.value).replace(str(root), "C").splitlines()
    assert lines[0] == "C: 2 faults."
    assert lines[1].startswith("1. C/images/z.png: the image does not decode")
    second = next(k for k, line in enumerate(lines) if line.startswith("2. "))
    assert lines[second] == "2. C/tracks/000.csv, line 2: body 'cube', column 'pz_m' is nan."
    assert lines[second + 1].startswith("   Allowed: ") and lines[second + 2].startswith("   Next: ")


def test_what_is_no_capture(root: Path, tmp_path: Path) -> None:
    model = tmp_path / "model"
    model.mkdir()
    (model / "model.json").write_text("{}")
    with pytest.raises(InputDataError) as caught:
        Capture.open(model)
    assert str(caught.value) == (
        f"{model} is a model (it holds model.json), not a capture.\n"
        "Allowed: a capture, a directory with capture.toml.\n"
        "Next: cgwm synthesize, eval and compare take one; pass a capture here."
    )
    (root / "capture.toml").unlink()
    assert fault(root) == (
        "C is no capture: it has no capture.toml.\n"
        "Next: write a manifest; the shortest one: echo 'format = \"cgwm-capture/1\"' > C/capture.toml"
    )
    assert fault(root / "images" / "walk").endswith("of its photos: cgwm import photos C --out CAPTURE")
    with pytest.raises(InputDataError) as caught:
        validate(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}: no capture, model, dataset, ladder, run or masks.")


def test_opening_is_quick_and_decodes_no_photo(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("a photo was decoded")

    monkeypatch.setattr("cgwm.datasets.capture.images.cv2.cvtColor", refuse)
    Capture.open(root)
