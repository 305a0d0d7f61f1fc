"""What stands in a capture is read or refused, by name: nothing is passed over, waited for or believed to be huge."""

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets import Capture, check_capture, read_mesh, read_rgb, read_splats, write_image
from cgwm.datasets.capture.check import find_faults
from cgwm.datasets.capture.files import files_under
from cgwm.datasets.capture.geometry_maps import read_map
from cgwm.datasets.io.arrays import read_npz
from cgwm.schemas import CgwmError, InputDataError

MANIFEST = """format = "cgwm-capture/1"
[[bodies]]
name = "ball"
shape = { sphere = { radius_m = 0.02 } }
[[bodies]]
name = "box"
shape = { box = { half_extents_m = [0.02, 0.02, 0.02] } }
"""
ROWS = "time_s,body,px_m,py_m,pz_m,qw,qx,qy,qz\n" + "".join(f"{k / 100},ball,{k},0,0,1,0,0,0\n" for k in range(5))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "capture"
    for folder in ("tracks", "images", "masks", "depth", "videos/cam/filmed", "video_masks/cam"):
        (root / folder).mkdir(parents=True)
    (root / "capture.toml").write_text(MANIFEST)
    (root / "tracks" / "good.csv").write_text(ROWS)
    write_image(root / "images" / "a.png", np.zeros((3, 4, 3), np.uint8))
    for k in range(2):
        write_image(root / "videos" / "cam" / "filmed" / f"{k}.png", np.zeros((3, 4, 3), np.uint8))
    return root


def broken_link(path: Path) -> None:
    path.symlink_to("gone")


def circle(path: Path) -> None:
    path.symlink_to(path.name)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


KINDS = {
    "a link to gone, which does not exist": broken_link,
    "a link that leads in circles": circle,
    "is a device": device,
    "is a named pipe": os.mkfifo,
}
PLACES = (
    *("tracks/e.csv", "tracks/notes", "images/b.jpg", "images/more", "masks/a.png", "depth/a.npy", "depth/a.png"),
    *("videos/other", "videos/cam/e.mp4", "videos/cam/e", "videos/cam/filmed/2.png", "video_masks/cam/filmed"),
    *("cameras.json", "transforms.json", "sparse/0/cameras.bin", "sparse/0/images.txt", "normals", "features"),
)


@pytest.mark.parametrize("found", KINDS)
def test_what_is_no_file_is_refused_wherever_it_stands(found: str, root: Path) -> None:
    (root / "sparse" / "0").mkdir(parents=True)
    (root / "sparse" / "0" / "cameras.txt").touch()
    assert check_capture(Capture.open(root)).episodes == 2
    for place in PLACES:
        KINDS[found](root / place)
        with pytest.raises(InputDataError) as refused:
            Capture.open(root)
        assert found in str(refused.value) and str(root / place) in str(refused.value)
        (root / place).unlink()
    Capture.open(root)


@pytest.mark.parametrize("place", ["tracks/e.csv", "images/b.jpg", "depth/a.npy", "videos/cam/filmed/2.png"])
def test_a_folder_with_the_name_of_a_file_is_refused(place: str, root: Path) -> None:
    (root / place).mkdir()
    with pytest.raises(InputDataError, match="is a directory"):
        Capture.open(root)


@pytest.mark.parametrize("folder", ["tracks", "masks", "videos", "video_masks", "features"])
@pytest.mark.parametrize("make", [Path.touch, broken_link, os.mkfifo])
def test_what_stands_in_place_of_a_folder_is_refused(folder: str, make: Callable[[Path], None], root: Path) -> None:
    if (root / folder).exists():
        (root / folder).rename(root / "away")
    make(root / folder)
    with pytest.raises(InputDataError, match=str(root / folder)):
        Capture.open(root)


def test_validate_lists_every_fault_once(root: Path) -> None:
    places = ["tracks/e.csv", "tracks/f.csv", "images/b.jpg", "images/more"]
    for place in places:
        broken_link(root / place)
    faults = [str(fault) for fault in find_faults(Capture.open(root, check=False))[1]]
    assert len(faults) == 4 and all(sum(str(root / place) in fault for fault in faults) == 1 for place in places)


@pytest.mark.parametrize("name", ["a\nb.csv", "a\x1b[31m.csv", os.fsdecode(b"\xff.csv"), "a\u2028b.csv"])
def test_names_with_control_characters_are_refused(name: str, root: Path) -> None:
    (root / "tracks" / name).write_text(ROWS)
    with pytest.raises(InputDataError, match="contains control characters or is no UTF-8") as refused:
        Capture.open(root)
    assert str(refused.value.found).isprintable()


def test_links_that_multiply_without_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cgwm.datasets.capture.files.MOST_FILES", 1000)
    for k in range(20):
        (tmp_path / f"{k}").mkdir()
        for name in ("x", "y"):
            (tmp_path / f"{k}" / name).symlink_to(f"../{k + 1}")
    with pytest.raises(InputDataError, match="more than 1000 files"):
        files_under(tmp_path / "0")


def png(width: int, height: int, *more: bytes) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(more) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")


def npy(shape: tuple[int, ...]) -> bytes:
    text = repr({"descr": "<f4", "fortran_order": False, "shape": shape}).ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def ply(kind: str, count: str, *properties: str) -> bytes:
    lines = ["ply", f"format {kind} 1.0", f"element vertex {count}", *properties, "end_header", ""]
    return "\n".join(lines).encode()


FLOATS = [f"property float {name}" for name in ("x", "y", "z")]
HUGE = {
    "a.png": (png(60000, 60000), read_rgb, "declares 60000x60000 px"),
    "none.png": (png(0, 5), read_rgb, "declares 0x5 px"),
    "a.stl": (b"\0" * 80 + struct.pack("<I", 10**9) + b"\0" * 50, read_mesh, "134 bytes for 1000000000 triangles"),
    "a.ply": (ply("binary_little_endian", "1" + "0" * 12, *FLOATS), read_splats, "cut off"),
    "text.ply": (ply("ascii", "1" + "0" * 12, *FLOATS) + b"1 2 3\n", read_splats, "cut off"),
    "minus.ply": (ply("binary_little_endian", "-1", *FLOATS), read_splats, "'-1' is no number of splats"),
    "twice.ply": (ply("ascii", "1", *FLOATS, FLOATS[0]), read_splats, "the property 'x' stands twice"),
    "words.ply": (ply("ascii", "1", *FLOATS) + b"a b c\n", read_splats, "a value that is no number"),
    "bare.ply": (ply("binary_little_endian", "5"), read_splats, "no properties"),
    "a.npy": (npy((10**6, 10**6)), lambda path: read_map(path, "depth"), "which is not 0 bytes"),
    "a.npz": (b"PK\x03\x04", lambda path: read_npz(path, ("a",)), "not an .npz that can be read"),
}


@pytest.mark.parametrize("name", HUGE)
def test_what_is_declared_is_compared_with_what_is_there(name: str, tmp_path: Path) -> None:
    data, read, found = HUGE[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputDataError) as refused:
        read(tmp_path / name)
    assert found in str(refused.value) and str(tmp_path / name) in str(refused.value)


def test_a_playlist_is_no_video(root: Path) -> None:
    (root / "videos" / "cam" / "e.mp4").write_text("#EXTM3U\n/etc/hostname\n")
    with pytest.raises(CgwmError, match="the video does not decode"):
        Capture.open(root)


def test_a_ball_that_never_turns_was_tracked_without_orientation(root: Path) -> None:
    both = ROWS + "".join(row.replace("ball", "box") + "\n" for row in ROWS.splitlines()[1:])
    (root / "tracks" / "good.csv").write_text(both)
    capture = Capture.open(root)
    tracks = capture.tracks("good")
    assert tracks["ball"].quat_wxyz is None and tracks["box"].quat_wxyz is not None
    (warning,) = check_capture(capture).warnings
    assert "ball, box is the same in all rows of 1 episodes (good)" in warning
    assert "that of ball is not used" in warning and "leave the columns" in warning
    (root / "tracks" / "good.csv").write_text(ROWS.replace("ball,1,0,0,1,0,0,0", "ball,1,0,0,0,1,0,0"))
    assert Capture.open(root).tracks("good")["ball"].quat_wxyz is not None
