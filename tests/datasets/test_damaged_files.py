"""Whatever is in a file, its reader returns something or raises one of our errors, and never anything else."""

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets import (
    mass_properties,
    read_cameras,
    read_mesh,
    read_model,
    read_rgb,
    read_splats,
    read_tracks,
    write_image,
    write_model,
    write_splats,
    write_tracks,
)
from cgwm.schemas import CaptureManifest, CgwmError, read_toml

from datasets.capture import test_cameras, test_capture, test_tracks
from datasets.models import test_models
from datasets.shapes import test_meshes, test_ply

INSERTIONS = [b"nan", b"-1", b"1e400", b'"', b"[", b",", b"\n", b"0", b"null", b"\0"]
TRIALS = 100


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Change a byte, cut some out, put something in, or cut the rest off; a few times over."""
    for _ in range(rng.choice([1, 1, 2, 5])):
        place = rng.randrange(len(data) + 1)
        rest = [
            bytes([rng.randrange(256)]) + data[place + 1 :],
            data[place + rng.randrange(1, 20) :],
            rng.choice(INSERTIONS) + data[place:],
            b"",
        ]
        data = data[:place] + rng.choice(rest)
    return data


def cameras(write: Callable, name: str) -> Callable[[Path], tuple[Path, Callable]]:
    def make(folder: Path) -> tuple[Path, Callable]:
        write(folder, test_cameras.camera())
        return folder / name, lambda: read_cameras(folder)

    return make


def tracks(folder: Path) -> tuple[Path, Callable]:
    write_tracks(folder / "a.csv", {"cube": test_tracks.random_track(0)})
    return folder / "a.csv", lambda: read_tracks(folder / "a.csv", ["cube"])


def ply(folder: Path) -> tuple[Path, Callable]:
    write_splats(folder / "a.ply", test_ply.splats(3))
    return folder / "a.ply", lambda: read_splats(folder / "a.ply")


def mesh(name: str, data: bytes) -> Callable[[Path], tuple[Path, Callable]]:
    def make(folder: Path) -> tuple[Path, Callable]:
        (folder / name).write_bytes(data)
        return folder / name, lambda: mass_properties(read_mesh(folder / name), folder / name)

    return make


def image(suffix: str) -> Callable[[Path], tuple[Path, Callable]]:
    def make(folder: Path) -> tuple[Path, Callable]:
        path = folder / f"a{suffix}"
        write_image(path, test_capture.picture(0, 64, 48))
        return path, lambda: read_rgb(path)

    return make


def manifest(folder: Path) -> tuple[Path, Callable]:
    path = folder / "capture.toml"
    path.write_text(test_capture.MANIFEST)
    return path, lambda: read_toml(path, CaptureManifest)


def model(folder: Path) -> tuple[Path, Callable]:
    write_model(folder / "m", test_models.model())
    return folder / "m" / "model.json", lambda: read_model(folder / "m")


FORMATS = {
    "cameras.json": cameras(test_cameras.write_cgwm, "cameras.json"),
    "transforms.json": cameras(test_cameras.write_transforms, "transforms.json"),
    "COLMAP images.txt": cameras(test_cameras.write_colmap_text, "sparse/0/images.txt"),
    "COLMAP cameras.txt": cameras(test_cameras.write_colmap_text, "sparse/0/cameras.txt"),
    "COLMAP images.bin": cameras(test_cameras.write_colmap_binary, "colmap/images.bin"),
    "COLMAP cameras.bin": cameras(test_cameras.write_colmap_binary, "colmap/cameras.bin"),
    "tracks": tracks,
    "splats": ply,
    "obj": mesh("a.obj", test_meshes.obj_text(test_meshes.box()).encode()),
    "text stl": mesh("a.stl", test_meshes.stl_text(test_meshes.box()).encode()),
    "binary stl": mesh("a.stl", test_meshes.stl_binary(test_meshes.box())),
    "jpg": image(".jpg"),
    "png": image(".png"),
    "manifest": manifest,
    "model": model,
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FORMATS)
def test_only_our_errors(tmp_path: Path, name: str) -> None:
    path, read = FORMATS[name](tmp_path)
    whole, rng = path.read_bytes(), random.Random(name)
    read()
    refused = 0
    for _ in range(TRIALS):
        path.write_bytes(damaged(whole, rng))
        try:
            with np.errstate(all="ignore"):
                read()
        except CgwmError as error:
            refused += 1
            assert str(path.parent) in str(error) or str(tmp_path) in str(error), "the message names the file"
    assert refused > TRIALS / 4
