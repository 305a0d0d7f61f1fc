"""Intrinsics that are known before a calibration: of the manifest, of a target, of an earlier calibration."""

from __future__ import annotations

from pathlib import Path

from ...datasets.capture.capture import Capture
from ...schemas import CameraIntrinsics, CamerasFile, InputDataError, IntrinsicsFile, parse
from ...schemas.documents import parse_json
from ...schemas.intrinsics import INTRINSICS_FORMAT
from ...schemas.regular_files import read_text_file

Size = tuple[int, int]


def read_intrinsics(path: Path) -> tuple[CameraIntrinsics, ...]:
    """Return the cameras of `intrinsics.json` (from a target) or `cameras.json` (from an earlier calibration).

    Raises:
        InputDataError: If the file is neither, or has a camera that a calibration cannot take as it is.
    """
    text = read_text_file(path)
    data = parse_json(text, path)
    if isinstance(data, dict) and data.get("format") == INTRINSICS_FORMAT:
        found: tuple[CameraIntrinsics, ...] = (parse(data, IntrinsicsFile, path, text).camera,)
    else:
        file = parse(data, CamerasFile, path, text)
        found = tuple(file.cameras[name] for name in sorted({image.camera for image in file.images.values()}))
    for camera in found:
        if len(camera.distortion) > 4 and camera.distortion[4] != 0:
            raise InputDataError(
                f"{path}: a camera with k3 = {camera.distortion[4]:g}.",
                "the distortion k1, k2, p1, p2.",
                "estimate the intrinsics without k3.",
            )
    return found


def known_by_size(capture: Capture, sizes: set[Size], file: Path | None) -> dict[Size, CameraIntrinsics]:
    """Return the given intrinsics of photos and videos by their size.

    Args:
        capture: The capture, with the intrinsics of its manifest.
        sizes: Sizes of its photos and videos (width, height) [px].
        file: File of further ones, or None.

    Raises:
        InputDataError: If the manifest has those of a size that nothing has, the file none of these sizes, or
            two are of one size.
    """
    manifest, name = capture.manifest.calibration.intrinsics, capture.root / "capture.toml"
    known = {(one.width, one.height): one for one in manifest}
    for size in known:
        if size not in sizes:
            raise _other_size(f"{name}: [[calibration.intrinsics]] are", [size], sizes)
    if file is None:
        return known
    further = read_intrinsics(file)
    fitting = [one for one in further if (one.width, one.height) in sizes]
    if not fitting:
        raise _other_size(f"{file}: its intrinsics are", [(one.width, one.height) for one in further], sizes)
    for one in fitting:
        if (size := (one.width, one.height)) in known:
            raise InputDataError(
                f"{file}: a second camera for photos of {size[0]}x{size[1]}.",
                "one camera for each size of photos, in the file or in [[calibration.intrinsics]].",
                "leave one of the two out.",
            )
        known[size] = one
    return known


def _other_size(found: str, given: list[Size], sizes: set[Size]) -> InputDataError:
    wrong, right = (", ".join(f"{width}x{height}" for width, height in sorted(some)) for some in (given, sizes))
    return InputDataError(
        f"{found} of photos of {wrong}, and no photo or video has that size.",
        f"the size of photos that are there: {right}.",
        "give the intrinsics at the size of the photos (fx, fy, cx and cy grow with the size).",
    )
