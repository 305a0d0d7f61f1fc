"""Photos, videos and posed photos become captures: what is read, at the right pixels, and each refusal."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.datasets import (
    Capture,
    import_colmap,
    import_nerfstudio,
    import_photos,
    import_polycam,
    import_record3d,
    import_video,
    read_rgb,
    write_image,
)
from cgwm.datasets.capture.transforms import read_transforms
from cgwm.datasets.importers.recordings import Units
from cgwm.datasets.importers.walk_video import FrameFigures, choose
from cgwm.datasets.synthetic.rig import look_at
from cgwm.schemas import InputDataError

ROOT = Path(__file__).resolve().parents[3]
WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
POINT = np.array([0.1, -0.05, 0.2])
"""A point whose pixel tells whether poses were read right."""


def _texture(seed: int, width: int, height: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.normal(size=(height, width, 3)), (0, 0), 2)
    return np.clip(128 + 500 * image, 0, 255).astype(np.uint8)


def _poses(count: int = 3) -> list[np.ndarray]:
    angles = np.linspace(0, 1.5, count)
    return [look_at(np.array([np.cos(a), np.sin(a), 0.5]), np.array([0, 0, 0.1])) for a in angles]


def _pixel(pose: np.ndarray) -> np.ndarray:
    local = np.linalg.inv(pose) @ [*POINT, 1.0]
    return FOCAL * local[:2] / local[2] + [WIDTH / 2, HEIGHT / 2]


def _photos(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for k, name in enumerate(names):
        write_image(folder / name, _texture(k, WIDTH, HEIGHT))


def _require_cameras(root: Path, poses: dict[str, np.ndarray], metric: bool) -> None:
    """Check that a capture has these photos, and sees the point where the truth sees it."""
    capture = Capture.open(root)
    assert capture.photos() == sorted(poses) and capture.cameras is not None
    assert capture.cameras.scale.kind == ("metric" if metric else "unscaled")
    for name, pose in poses.items():
        pixel, depth = capture.photo_camera(name).project(POINT[None])
        assert depth[0] > 0 and pixel[0] == pytest.approx(_pixel(pose), abs=1e-6)


def write_transforms(folder: Path, names: list[str], name: str = "transforms.json") -> None:
    """Write a transforms.json of nerfstudio with its photos."""
    _photos(folder / "images", [Path(one).name for one in names])
    frames = [
        {"file_path": one, "transform_matrix": (pose @ OPENGL).tolist()}
        for one, pose in zip(names, _poses(), strict=True)
    ]
    data = {"fl_x": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "frames": frames}
    (folder / name).write_text(json.dumps(data))


def write_colmap(folder: Path) -> None:
    """Write a COLMAP model as text, with its photos."""
    from scipy.spatial.transform import Rotation

    _photos(folder / "images", ["a.png", "b.png", "c.png"])
    (folder / "sparse" / "0").mkdir(parents=True)
    lines = []
    for k, (name, pose) in enumerate(zip("abc", _poses(), strict=True)):
        inverse = np.linalg.inv(pose)
        quat = Rotation.from_matrix(inverse[:3, :3]).as_quat(scalar_first=True)
        numbers = " ".join(f"{value:.12f}" for value in (*quat, *inverse[:3, 3]))
        lines += [f"{k + 1} {numbers} 1 {name}.png", ""]
    (folder / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    camera = f"1 SIMPLE_PINHOLE {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    (folder / "sparse/0/cameras.txt").write_text(camera)


def write_polycam(folder: Path) -> None:
    """Write a raw export of Polycam by its documentation: ARKit's world has y up."""
    keyframes = folder / "keyframes"
    _photos(keyframes / "images", ["100.jpg", "101.jpg", "102.jpg"])
    for name in ("cameras", "depth", "confidence"):
        (keyframes / name).mkdir()
    for k, pose in enumerate(_poses()):
        arkit = TURN @ pose @ OPENGL
        entries = {f"t_{row}{column}": arkit[row, column] for row in range(3) for column in range(4)}
        lens = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "width": WIDTH, "height": HEIGHT}
        (keyframes / "cameras" / f"{100 + k}.json").write_text(json.dumps({**entries, **lens, "blur_score": 20.0}))
        cv2.imwrite(str(keyframes / "depth" / f"{100 + k}.png"), np.full((12, 16), 1500, np.uint16))
        sure = np.full((12, 16), 255, np.uint8)
        sure[0] = 0
        cv2.imwrite(str(keyframes / "confidence" / f"{100 + k}.png"), sure)


def write_record3d(folder: Path, count: int = 7) -> None:
    """Write an unpacked recording of Record3D by the readers of others."""
    from scipy.spatial.transform import Rotation

    _photos(folder / "rgbd", [f"{k}.jpg" for k in range(count)])
    poses = []
    for pose in _poses(count):
        arkit = TURN @ pose @ OPENGL
        poses.append([*Rotation.from_matrix(arkit[:3, :3]).as_quat(), *arkit[:3, 3]])
    K = [FOCAL, 0, 0, 0, FOCAL, 0, WIDTH / 2, HEIGHT / 2, 1]
    (folder / "metadata").write_text(json.dumps({"w": WIDTH, "h": HEIGHT, "K": K, "fps": 60, "poses": poses}))


TURN = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From a world whose z axis points up to ARKit's, whose y axis does."""


def write_walk(path: Path, count: int = 24, still: bool = False) -> None:
    """Write a video of a wide texture that passes by, with every second frame out of focus."""
    wall = _texture(5, 1200, 240)
    frames = []
    for k in range(count):
        frame = wall[:, 0 if still else 20 * k : (0 if still else 20 * k) + 320]
        frames.append(cv2.GaussianBlur(frame, (0, 0), 4) if k % 2 else frame)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (320, 240))  # quicker than VP9
    for frame in frames:
        writer.write(np.ascontiguousarray(frame))
    writer.release()


def test_photos_are_copied_and_heic_is_converted_upright_with_its_focal_length(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif", reason="photos of phones need pillow-heif")
    from PIL import Image

    _photos(tmp_path / "in", ["a.jpg", "b.png"])
    smooth = cv2.GaussianBlur(_texture(3, WIDTH, HEIGHT), (0, 0), 5)  # JPEG halves the resolution of colours
    image = Image.fromarray(smooth)
    exif = image.getexif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 26
    heif.from_pillow(image).save(tmp_path / "in" / "c.HEIC", quality=95, exif=exif.tobytes())
    result = import_photos(tmp_path / "in", tmp_path / "out")
    assert (result.photos, result.posed) == (3, False)
    assert Capture.open(tmp_path / "out").photos() == ["a.jpg", "b.png", "c.jpg"]
    assert (tmp_path / "out/images/a.jpg").read_bytes() == (tmp_path / "in/a.jpg").read_bytes()
    found = read_rgb(tmp_path / "out/images/c.jpg")
    upright = heif.open_heif(tmp_path / "in" / "c.HEIC").to_pillow()
    assert found.shape[:2] == upright.size[::-1]
    assert np.abs(found.astype(int) - np.asarray(upright.convert("RGB")).astype(int)).mean() < 6
    kept = Image.open(tmp_path / "out/images/c.jpg").getexif()
    assert kept.get_ifd(0x8769)[0xA405] == 26 and 0x0112 not in kept


def test_a_photo_is_what_its_content_says(tmp_path: Path) -> None:
    _photos(tmp_path / "in", ["a.jpg", "b.png"])
    (tmp_path / "in" / "a.jpg").rename(tmp_path / "in" / "a.HEIC")  # as some phones hand photos on
    (tmp_path / "in" / "b.png").rename(tmp_path / "in" / "b.heic")
    import_photos(tmp_path / "in", tmp_path / "out")
    assert Capture.open(tmp_path / "out").photos() == ["a.jpg", "b.png"]


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="DCIM: no such folder"):
        import_photos(tmp_path / "DCIM", tmp_path / "out")


def test_a_photo_that_is_there_twice_is_taken_once(tmp_path: Path) -> None:
    _photos(tmp_path / "in", ["IMG 1.jpg", "IMG 2.jpg"])
    (tmp_path / "in" / "IMG 1 (1).jpg").write_bytes((tmp_path / "in" / "IMG 1.jpg").read_bytes())
    result = import_photos(tmp_path / "in", tmp_path / "out")
    assert result.warnings == ("IMG 1 (1).jpg is the same file as IMG 1.jpg and was left out",)
    assert Capture.open(tmp_path / "out").photos() == ["IMG 1.jpg", "IMG 2.jpg"]


def test_videos_and_photos_are_told_apart(tmp_path: Path) -> None:
    _photos(tmp_path / "in", ["1.jpg"])
    for source in (tmp_path / "in", tmp_path / "in" / "1.jpg"):
        with pytest.raises(InputDataError, match=r"(?s)is a (folder|photo)\..*cgwm import photos .*in --out CAPTURE"):
            import_video(source, tmp_path / "out")
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "walk.MOV").write_bytes(b"film")
    for source in (tmp_path / "films", tmp_path / "films" / "walk.MOV"):
        with pytest.raises(InputDataError, match=r"cgwm import video .*walk\.MOV"):
            import_photos(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_photos_that_stay_behind_are_told(tmp_path: Path) -> None:
    _photos(tmp_path / "in", ["1.jpg", "2.jpg"])
    _photos(tmp_path / "in" / "older", ["3.jpg"])
    (tmp_path / "in" / "4.DNG").write_bytes(b"raw")
    (tmp_path / "in" / "1.MOV").write_bytes(b"a live photo's film")
    result = import_photos(tmp_path / "in", tmp_path / "out")
    assert result.photos == 2
    raw, folders = result.warnings
    assert raw == "left out: 1 .dng (save photos of these kinds as JPEG)" and "1 in older/" in folders


def test_a_photo_of_another_kind_under_the_name_of_a_jpeg_is_named(tmp_path: Path) -> None:
    _photos(tmp_path / "in", ["1.jpg"])
    (tmp_path / "in" / "2.jpg").write_bytes(b"RIFF\x10\0\0\0WEBPVP8 ")
    with pytest.raises(InputDataError, match=r"2\.jpg: .* WebP, whatever its name: save it as JPEG or PNG"):
        import_photos(tmp_path / "in", tmp_path / "out")


def test_a_transforms_json_without_sizes_names_the_photo_that_is_missing(tmp_path: Path) -> None:
    frame = {"file_path": "images/0001.jpg", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame]}))
    with pytest.raises(InputDataError, match=r"images/0001\.jpg: no such file"):
        import_nerfstudio(tmp_path, tmp_path / "out")


def test_a_walk_gives_sharp_frames_at_equal_distances(tmp_path: Path) -> None:
    write_walk(tmp_path / "walk.mp4")
    result = import_video(tmp_path / "walk.mp4", tmp_path / "out", photos=6)
    numbers = [int(name.split(".")[0]) for name in Capture.open(tmp_path / "out").photos()]
    assert result.photos == len(numbers) == 6
    assert all(number % 2 == 0 for number in numbers), "an unsharp frame was taken"
    assert max(np.diff(numbers)) <= 8
    assert read_rgb(tmp_path / "out/images" / f"{numbers[0]:06d}.jpg").shape == (240, 320, 3)


def test_a_video_of_a_phone_in_hevc_is_read(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="makes the video: pip install av")
    if "libx265" not in av.codecs_available:
        pytest.skip("this build of av writes no HEVC")
    write_walk(tmp_path / "plain.mp4", 8)
    source = cv2.VideoCapture(str(tmp_path / "plain.mp4"))
    with av.open(str(tmp_path / "walk.mov"), "w") as container:
        stream = container.add_stream("libx265", rate=30, options={"preset": "ultrafast", "log-level": "none"})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        while (read := source.read())[0]:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(read[1], format="bgr24")))
        container.mux(stream.encode())
    assert import_video(tmp_path / "walk.mov", tmp_path / "out", photos=3).photos == 3


def test_a_rotated_video_is_turned_upright(tmp_path: Path) -> None:
    write_walk(tmp_path / "walk.mp4", 12)
    data = bytearray((tmp_path / "walk.mp4").read_bytes())
    # the matrix of the track header (ISO/IEC 14496-12, 8.3.2), 16.16 and 2.30: a quarter turn
    place = data.index(b"tkhd") + 4 + 40
    quarter = (0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    data[place : place + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in quarter)
    (tmp_path / "turned.mp4").write_bytes(data)
    import_video(tmp_path / "turned.mp4", tmp_path / "out", photos=4)
    first = sorted((tmp_path / "out/images").iterdir())[0]
    assert read_rgb(first).shape == (320, 240, 3)


def test_parts_without_a_sharp_frame_are_left_out() -> None:
    figures = FrameFigures(np.array([5.0, 9.0, 8.0, 0.1, 0.2, 7.0]), np.array([0.0, 0.1, 0.4, 0.6, 0.7, 1.0]))
    assert choose(figures, 4) == ([1, 2, 5], 1)


@pytest.mark.parametrize("names", [["a.png", "b.png", "c.png"], ["./images/a.png", "images/b.png", "../images/c.png"]])
def test_transforms_json_keeps_its_pixels(tmp_path: Path, names: list[str]) -> None:
    folder = tmp_path / "in" / "scene" if names[2].startswith("..") else tmp_path / "in"
    if folder.name == "scene":
        _photos(tmp_path / "in" / "images", ["c.png"])
    write_transforms(folder, names)
    expected = dict(zip(["a.png", "b.png", "c.png"], _poses(), strict=True))
    result = import_nerfstudio(folder, tmp_path / "out")
    assert result.posed and "unscaled" in result.warnings[0]
    _require_cameras(tmp_path / "out", expected, metric=False)


def test_the_fox_of_instant_ngp_keeps_its_cameras(tmp_path: Path) -> None:
    folder = Path(os.environ.get("CGWM_SHARED_DATA", ROOT.parent / "shared" / "data")) / "fox"
    if not folder.is_dir():
        pytest.skip("no measured photos: set CGWM_SHARED_DATA to the folder that holds fox/")
    assert import_nerfstudio(folder, tmp_path / "out").photos == 50
    found, there = Capture.open(tmp_path / "out").cameras, read_transforms(folder / "transforms.json")
    assert found is not None and found.images == there.images and found.cameras == there.cameras


def test_a_unit_makes_the_poses_metric(tmp_path: Path) -> None:
    write_transforms(tmp_path / "in", ["a.png", "b.png", "c.png"], "transforms_train.json")
    import_nerfstudio(tmp_path / "in", tmp_path / "out", Units("cm"))
    cameras = Capture.open(tmp_path / "out").cameras
    assert cameras is not None and cameras.scale.kind == "metric"
    assert np.array(cameras.images["a.png"].T_world_cam)[:3, 3] == pytest.approx(0.01 * _poses()[0][:3, 3])


def test_a_colmap_model_keeps_its_pixels(tmp_path: Path) -> None:
    write_colmap(tmp_path / "in")
    import_colmap(tmp_path / "in", tmp_path / "out", Units("m"))
    expected = dict(zip(["a.png", "b.png", "c.png"], _poses(), strict=True))
    _require_cameras(tmp_path / "out", expected, metric=True)


def test_polycam_is_metric_with_z_up_and_depth_without_unsure_pixels(tmp_path: Path) -> None:
    write_polycam(tmp_path / "in")
    import_polycam(tmp_path / "in", tmp_path / "out")
    _require_cameras(tmp_path / "out", dict(zip(["100.jpg", "101.jpg", "102.jpg"], _poses(), strict=True)), metric=True)
    depth = cv2.imread(str(tmp_path / "out/depth/100.png"), cv2.IMREAD_UNCHANGED)
    assert depth is not None and depth.shape == (HEIGHT, WIDTH)
    assert (depth[:4] == 0).all() and (depth[4:] == 1500).all()


def test_record3d_is_metric_with_z_up_and_thinned(tmp_path: Path) -> None:
    write_record3d(tmp_path / "in")
    result = import_record3d(tmp_path / "in", tmp_path / "out", photos=4)
    poses = _poses(7)
    _require_cameras(tmp_path / "out", {f"{k}.jpg": poses[k] for k in (0, 2, 4, 6)}, metric=True)
    assert result.warnings == ("3 of 7 frames are left out (--photos)",)


def _spoil(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


HEIC_HEAD = b"\0\0\0\x18ftypheic" + bytes(40)

REFUSED = {
    "no photos": (lambda r: (r / "in").mkdir(), import_photos, "no photos."),
    "a video in place of photos": (
        lambda r: (r / "in").write_text("a video"),
        import_photos,
        "(a video: cgwm import video ",
    ),
    "photos in a folder of it": (
        lambda r: (r / "in").mkdir() or _photos(r / "in" / "day 1", ["a.jpg"]),
        import_photos,
        "name the folder that holds them: ",
    ),
    "photos to be converted": (
        lambda r: (r / "in").mkdir() or (r / "in" / "a.webp").write_bytes(b"RIFF"),
        import_photos,
        "save them as JPEG",
    ),
    "each photo as HEIC and as JPEG": (
        lambda r: _photos(r / "in", ["a.jpg", "b.jpg"]) or (r / "in" / "A.HEIC").write_bytes(HEIC_HEAD),
        import_photos,
        "A.HEIC: the photo is there as JPEG or PNG, too.",
    ),
    "HEIC under another name": (
        lambda r: _photos(r / "in", ["a.jpg"]) or (r / "in" / "b.jpg").write_bytes(HEIC_HEAD),
        import_photos,
        "b.jpg: ",
    ),
    "photos with cameras": (
        lambda r: (r / "in").mkdir() or (r / "in" / "transforms.json").write_text("{}"),
        import_photos,
        "cgwm import nerfstudio",
    ),
    "two of one name": (
        lambda r: _photos(r / "in", ["a.jpg", "A.JPG".lower().replace("a", "A")]),
        import_photos,
        "would both be images/",
    ),
    "a camera that stands": (
        lambda r: (r / "in").mkdir() or write_walk(r / "in" / "v.mp4", 8, still=True),
        lambda source, out: import_video(source / "v.mp4", out),
        "the camera stands.",
    ),
    "no video": (
        lambda r: (r / "in").mkdir() or (r / "in" / "v.mp4").write_text("no video"),
        lambda source, out: import_video(source / "v.mp4", out),
        "the video does not decode.",
    ),
    "no transforms": (lambda r: (r / "in").mkdir(), import_nerfstudio, "no transforms.json and no transforms_train"),
    "a photo is missing": (
        lambda r: write_transforms(r / "in", ["a.png", "b.png", "c.png"]) or (r / "in/images/b.png").unlink(),
        import_nerfstudio,
        "the photo 'b.png' is neither in ",
    ),
    "no model": (lambda r: (r / "in").mkdir(), import_colmap, "no COLMAP model."),
    "a mirrored pose": (
        lambda r: write_polycam(r / "in") or _mirror(r / "in/keyframes/cameras/101.json"),
        import_polycam,
        "101.json: ",
    ),
    "another size": (
        lambda r: write_polycam(r / "in") or _spoil(r / "in/keyframes/cameras/100.json", '"width": 64', '"width": 640'),
        import_polycam,
        "64x48 px, but its camera has 640x48 px.",
    ),
    "another size beside transforms.json": (
        lambda r: (
            write_transforms(r / "in", ["a.png", "b.png", "c.png"])
            or _spoil(r / "in/transforms.json", '"w": 64', '"w": 128')
        ),
        import_nerfstudio,
        "64x48 px, but its camera has 128x48 px.",
    ),
    "an archive": (lambda r: (r / "in").write_bytes(b"PK\x03\x04"), import_record3d, "in: is a zip archive."),
    "a scan that is none": (lambda r: (r / "in").mkdir(), import_polycam, "in is no raw export of Polycam."),
    "a recording that is none": (lambda r: (r / "in").mkdir(), import_record3d, "in is no recording of Record3D."),
    "more frames than poses": (
        lambda r: write_record3d(r / "in") or write_image(r / "in/rgbd/7.jpg", _texture(0, WIDTH, HEIGHT)),
        import_record3d,
        "no number of one of the 7 poses of metadata.",
    ),
}


def _mirror(path: Path) -> None:
    data = json.loads(path.read_text())
    for column in range(3):
        data[f"t_0{column}"] *= -1
    path.write_text(json.dumps(data))


def test_a_name_is_found_in_the_other_way_of_writing_its_accents(tmp_path: Path) -> None:
    write_transforms(tmp_path / "in", ["\u00e4.png", "b.png", "c.png"])  # one letter; macOS writes two
    (tmp_path / "in/images/\u00e4.png").rename(tmp_path / "in/images/a\u0308.png")
    assert import_nerfstudio(tmp_path / "in", tmp_path / "out").photos == 3


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused_leaves_nothing(tmp_path: Path, case: str) -> None:
    prepare, importer, message = REFUSED[case]
    prepare(tmp_path)
    with pytest.raises(InputDataError) as raised:
        importer(tmp_path / "in", tmp_path / "out")
    assert message in str(raised.value)
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
