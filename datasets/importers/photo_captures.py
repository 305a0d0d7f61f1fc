"""Common parts of the importers of photos: files that become photos of a capture, and the capture that is written."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import Calibration, CameraIntrinsics, CamerasFile, CaptureManifest, InputDataError
from ...schemas.imports import ImportResult
from ...schemas.printable import typed_path
from ...schemas.regular_files import require_regular_file
from ..capture.files import entries_of
from ..capture.images import (
    HEIF_BRANDS,
    IMAGE_SUFFIXES,
    PNG_SIGNATURE,
    UNREAD_SUFFIXES,
    image_size,
    named_as_photo,
    write_image,
)
from ..capture.manifest import write_manifest
from ..capture.video import VIDEO_SUFFIXES
from ..io.progress import progress

HEIF_SUFFIXES = (".heic", ".heif")
"""Suffixes of photos that are converted, in lower case."""
_VIDEO_SUFFIXES = (*VIDEO_SUFFIXES, ".m4v", ".avi", ".mkv")
_QUALITY = 97
"""JPEG quality of a converted photo: what it loses lies below the noise of the sensor."""


@dataclass(frozen=True)
class Photo:
    """A photo on its way into a capture."""

    source: Path
    """The file."""
    name: str
    """Its name in `images/`, with the suffix that it will have there."""


def require_unpacked(source: Path) -> Path:
    """Return what an importer was given; an archive, as apps of phones write them, is refused as such."""
    if source.is_file() and _head(source).startswith(b"PK\x03\x04"):
        raise InputDataError(
            f"{source}: is a zip archive.", "the folder that is in it.", "unpack it, and name the folder."
        )
    return source


def require_size(photo: Photo, size: tuple[int, int]) -> None:
    """Refuse a photo whose size (width, height) [px] is not that of its camera."""
    found = image_size(photo.source)
    if found != size:
        raise InputDataError(
            f"{photo.source}: {found[0]}x{found[1]} px, but its camera has {size[0]}x{size[1]} px.",
            "photos of the size for which the camera was written.",
            "export photos and cameras together.",
        )


def photos_in(folder: Path) -> list[Photo]:
    """Return the photos of a folder, sorted by name; HEIC becomes JPEG.

    Raises:
        InputDataError: If there is none, or two would have one name.
    """
    _require_folder(folder)
    files = [path for path in entries_of(folder) if path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)]
    if not files:
        raise _no_photos(folder)
    photos = [Photo(path, _name_of(path)) for path in files]
    _refuse_both_kinds(photos)
    require_distinct(photos)
    return photos


def _name_of(path: Path) -> str:
    """Return the name of a photo in the capture, with the suffix of its content where it is or says HEIC."""
    if path.suffix.lower() not in HEIF_SUFFIXES and not _is_heif(path):
        return path.name
    return f"{path.stem}.png" if _head(path).startswith(PNG_SIGNATURE) else f"{path.stem}.jpg"


def _refuse_both_kinds(photos: Sequence[Photo]) -> None:
    """Refuse a folder that holds photos as HEIC and, converted, as JPEG or PNG too."""
    converted = {photo.source.stem.lower() for photo in photos if photo.source.suffix.lower() not in HEIF_SUFFIXES}
    both = [photo.source for photo in photos if photo.source.suffix.lower() in HEIF_SUFFIXES
            and photo.source.stem.lower() in converted]  # fmt: skip
    if both:
        others = f", as are {len(both) - 1} others" if len(both) > 1 else ""
        raise InputDataError(
            f"{both[0]}: the photo is there as JPEG or PNG, too{others}.",
            "each photo once.",
            "move one of the two kinds to another folder.",
        )


def _require_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    is_file = folder.is_file()
    todo = "name the folder that holds the photos"
    todo += "." if named_as_photo(folder) else f" (a video: cgwm import video {typed_path(folder)})."
    raise InputDataError(
        f"{folder}: {'is a file' if is_file else 'no such folder'}.",
        "a folder of photos.",
        todo if is_file else "check the path.",
    )


def _no_photos(folder: Path) -> InputDataError:
    """Return the error of a folder without photos, which says what is in it instead."""
    entries = entries_of(folder)
    others = sorted({path.suffix for path in entries if path.suffix})
    posed = any(path.name == "transforms.json" for path in entries)
    within = [str(path) for path in entries if path.is_dir() and _photos_within(path)]
    todo = "name the folder that holds them"
    if within:
        several = f" and {len(within) - 1} more; copy them into one folder" if len(within) > 1 else ""
        todo += f": {within[0]}{several}"
    elif videos := [path for path in entries if path.suffix.lower() in _VIDEO_SUFFIXES]:
        todo += f"; of a video: cgwm import video {typed_path(videos[0])} --out CAPTURE"
    elif any(suffix.lower() in UNREAD_SUFFIXES for suffix in others):
        todo = "save them as JPEG with a picture program, at their size and with their EXIF data"
    return InputDataError(
        f"{folder}: no photos" + (f", but files {', '.join(others[:6])}." if others else "."),
        "photos .jpg, .jpeg, .png, .heic or .heif.",
        f"{todo}, or with their cameras: cgwm import nerfstudio {typed_path(folder)}." if posed else f"{todo}.",
    )


def left_in(folder: Path) -> list[str]:
    """Return what stays behind in a folder whose photos were taken: photos of other kinds, and those in its folders."""
    entries = entries_of(folder)
    suffixes = Counter(path.suffix.lower() for path in entries)
    others = [f"{suffixes[one]} {one}" for one in UNREAD_SUFFIXES if suffixes[one] and one not in HEIF_SUFFIXES]
    notes = [f"left out: {', '.join(others)} (save photos of these kinds as JPEG)"] if others else []
    counts = {path.name: _photos_within(path) for path in entries if path.is_dir()}
    within = [f"{count} in {name}/" for name, count in counts.items() if count]
    return [*notes, *([f"left out: photos in folders, {', '.join(within)} (copy them into one)"] if within else [])]


def _photos_within(folder: Path) -> int:
    return sum(path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES) for path in entries_of(folder))


def require_distinct(photos: Iterable[Photo]) -> None:
    """Refuse two photos that would have one name in the capture."""
    seen: dict[str, Path] = {}
    for photo in photos:
        key = photo.name.lower()
        if key in seen:
            raise InputDataError(
                f"{photo.source} and {seen[key]} would both be images/{photo.name}.",
                "photos of different names.",
                "rename one of the two, or remove it.",
            )
        seen[key] = photo.source


def inside(name: str) -> str:
    """Return the name that a photo gets in `images/`, from a path that may lead anywhere."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "..", ".")]
    parts = parts[1:] if len(parts) > 1 and parts[0] == "images" else parts
    return "/".join(parts)


def copy_photos(directory: Path, photos: Iterable[Photo]) -> None:
    """Copy photos into `images/` of a capture; their headers are checked, HEIC is converted.

    Raises:
        InputDataError: If a file is no photo or is cut off.
    """
    photos = list(photos)
    for photo in progress(photos, "photos", unit="photo"):
        path = directory / "images" / photo.name
        path.parent.mkdir(parents=True, exist_ok=True)
        if _is_heif(photo.source):
            _convert(photo.source, path)
        else:
            image_size(photo.source)
            shutil.copyfile(require_regular_file(photo.source), path)


def write_photo_capture(
    directory: Path,
    out: Path | str,
    photos: int,
    cameras: CamerasFile | None = None,
    warnings: Iterable[str] = (),
    intrinsics: tuple[CameraIntrinsics, ...] = (),
) -> ImportResult:
    """Write the manifest, and the cameras where there are some, of a capture whose photos are in place.

    Args:
        directory: The unfinished capture.
        out: What it will be called.
        photos: Number of photos.
        cameras: Cameras with poses; None if they are to be calibrated.
        warnings: What is to be said.
        intrinsics: Known intrinsics of photos whose poses are to be calibrated.
    """
    known = Calibration(intrinsics=intrinsics)
    write_manifest(directory / "capture.toml", CaptureManifest(format="cgwm-capture/1", calibration=known))
    if cameras is not None:
        (directory / "cameras.json").write_text(cameras.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return ImportResult(
        capture=str(out), episodes=0, samples=0, splits={}, photos=photos, posed=cameras is not None,
        warnings=tuple(warnings),
    )  # fmt: skip


def _is_heif(path: Path) -> bool:
    """Return whether a file is HEIC by its content; a text named .heic is left to the reader, which refuses it."""
    head = _head(path)
    if path.suffix.lower() in HEIF_SUFFIXES:
        return not head.startswith((PNG_SIGNATURE, b"\xff\xd8"))
    return head[4:8] == b"ftyp" and head[8:12] in HEIF_BRANDS


def _head(path: Path) -> bytes:
    with require_regular_file(path).open("rb") as file:
        return file.read(12)


def _convert(source: Path, path: Path) -> None:
    """Write a HEIC photo as JPEG, upright, with its EXIF data (the focal length)."""
    heif = _heif_reader(source)
    try:
        image = heif.open_heif(require_regular_file(source), convert_hdr_to_8bit=True).to_pillow()
    except (ValueError, EOFError, OSError, RuntimeError, SyntaxError) as error:
        raise InputDataError(
            f"{source}: no HEIC photo that can be read ({error}).", todo="take the original."
        ) from None
    exif = image.getexif()
    exif.pop(0x0112, None)  # the orientation: pixels are upright already
    write_image(path, pixels_of(image.convert("RGB")), _QUALITY)
    if exif and path.suffix.lower() in IMAGE_SUFFIXES[:2]:
        _insert_exif(path, exif.tobytes())


def pixels_of(image: Any) -> NDArray[np.uint8]:
    """Return a picture of Pillow as RGB (H, W, 3)."""
    return np.ascontiguousarray(np.asarray(image, np.uint8))


def _insert_exif(path: Path, exif: bytes) -> None:
    """Put EXIF data behind the start of a JPEG file (a segment APP1; one holds at most 65533 bytes)."""
    if len(exif) <= 65533 - 2:
        data = path.read_bytes()
        path.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])


def _heif_reader(source: Path) -> Any:
    try:
        import pillow_heif  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputDataError(
            f"{source}: HEIC photos need the package pillow-heif, which is not installed.",
            "photos .jpg or .png without it.",
            'pip install "cgwm[heif]" (in a checkout: pip install ".[heif]").',
        ) from None
    return pillow_heif
