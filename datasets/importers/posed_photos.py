"""Import of photos with known cameras: transforms.json (nerfstudio, instant-ngp, Blender) and COLMAP models."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import CamerasFile, InputDataError, PosedImage, Scale
from ...schemas.documents import parse_json
from ...schemas.imports import ImportResult
from ...schemas.regular_files import read_text_file
from ..capture.colmap_model import MODEL_PLACES, find_colmap_model, read_colmap_model
from ..capture.files import optional_file
from ..capture.transforms import cameras_of, matrix4
from ..io.atomic import new_directory
from ..io.outputs import reads
from .photo_captures import (
    Photo,
    copy_photos,
    inside,
    require_distinct,
    require_size,
    require_unpacked,
    write_photo_capture,
)
from .recordings import LENGTHS_M, SI, Units

TRANSFORMS = ("transforms.json", "transforms_train.json")
"""Names of the file in a folder, in order of precedence; the second is that of Blender's synthetic scenes."""


@reads("source")
def import_nerfstudio(source: Path | str, out: Path | str, units: Units = SI, overwrite: bool = False) -> ImportResult:
    """Write the photos and cameras of a `transforms.json` as a capture.

    Args:
        source: The file, or the folder of a `transforms.json` or `transforms_train.json`.
        out: The capture directory to write.
        units: Its unit of length where the poses are metric; without one the capture is unscaled.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the file or a photo is missing or wrong.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        path = _transforms(require_unpacked(Path(source)))
        data = parse_json(read_text_file(path), path)
        cameras = cameras_of(data, path)
        written = (path.parent / "images", path.parent)
        result = _write(directory, out, cameras, lambda name: _found(name, written), units, f"{path.name}")
        left = _left_out(data)
        return result.model_copy(update={"warnings": (*left, *result.warnings)})


@reads("source")
def import_colmap(source: Path | str, out: Path | str, units: Units = SI, overwrite: bool = False) -> ImportResult:
    """Write the photos and cameras of a COLMAP model as a capture.

    Args:
        source: The project: photos in `images/`, the model in `sparse/0`, `sparse`, `colmap/sparse/0` or `colmap`.
        out: The capture directory to write.
        units: Its unit of length where the poses are metric; without one the capture is unscaled.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the model or a photo is missing or wrong.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        source = require_unpacked(Path(source))
        model = find_colmap_model(source)
        if model is None:
            raise InputDataError(
                f"{source}: no COLMAP model.",
                f"cameras and images (.bin or .txt) in {', '.join(MODEL_PLACES)}.",
                "name the folder that holds images/ and the model.",
            )
        places = (source / "images", source)
        return _write(directory, out, read_colmap_model(model), lambda name: _found(name, places), units, "COLMAP")


def scaled(cameras: CamerasFile, units: Units, source: str) -> CamerasFile:
    """Return cameras in metres where their unit of length is given; otherwise they stay unscaled."""
    if units.length is None:
        return cameras
    images = {
        name: PosedImage(camera=image.camera, T_world_cam=matrix4(_moved(image.T_world_cam, LENGTHS_M[units.length])))
        for name, image in cameras.images.items()
    }
    return cameras.model_copy(update={"images": images, "scale": Scale(kind="metric", source=f"{source}, as given")})


def _moved(pose: Any, metres: float) -> np.ndarray:
    matrix = np.array(pose, float)
    matrix[:3, 3] *= metres
    return matrix


def _write(
    directory: Path,
    out: Path | str,
    cameras: CamerasFile,
    file_of: Callable[[str], Path],
    units: Units,
    source: str,
) -> ImportResult:
    photos = {name: Photo(file_of(name), inside(name)) for name in cameras.images}
    require_distinct(photos.values())
    for name, image in cameras.images.items():
        camera = cameras.cameras[image.camera]
        require_size(photos[name], (camera.width, camera.height))
    copy_photos(directory, photos.values())
    named = {photos[name].name: image for name, image in cameras.images.items()}
    posed = scaled(cameras.model_copy(update={"images": named}), units, source)
    notes = [] if units.length else ["the unit of the poses is not known (--length-unit): the cameras are unscaled"]
    return write_photo_capture(directory, out, len(photos), posed, notes)


def _transforms(source: Path) -> Path:
    if not source.is_dir():
        return source
    for name in TRANSFORMS:
        if (path := optional_file(source / name)) is not None:
            return path
    raise InputDataError(f"{source}: no {' and no '.join(TRANSFORMS)}.", todo="name the file itself.")


def _found(name: str, folders: tuple[Path, ...]) -> Path:
    # a name with accents may be written in two ways, of which macOS has one and archives the other
    for written in dict.fromkeys((name, unicodedata.normalize("NFC", name), unicodedata.normalize("NFD", name))):
        for folder in folders:
            if (path := optional_file(folder / written)) is not None:
                return path
    raise InputDataError(
        f"the photo '{name}' is neither in {' nor in '.join(str(folder) for folder in folders)}.",
        "all photos that the cameras name.",
        "put it there, or remove its entry.",
    )


def _left_out(data: Mapping[str, Any]) -> list[str]:
    """Return what a transforms.json names and the capture does not get."""
    frames = data["frames"]
    keys = {"mask_path": "masks", "depth_file_path": "depth"}
    there = [word for key, word in keys.items() if any(key in frame for frame in frames)]
    return [f"not taken over: {' and '.join(there)} (put them into the capture by hand)"] if there else []
