"""Reading and writing of photos and label images, and their size from the headers."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
"""Suffixes of readable images, in lower case."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_STANDALONE = {0x01, *range(0xD0, 0xD8)}
_JPEG_FRAME_HEADERS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_REPLACE = "replace the file, or remove it."


def read_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Return a photo as RGB, uint8, shape (height, width, 3).

    An EXIF orientation is not applied: pixel (0, 0) is the file's first one, as in COLMAP and in masks.

    Raises:
        InputDataError: If it is missing, truncated or not an image.
    """
    image = _decode(Path(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_label(path: Path | str) -> NDArray[np.uint8]:
    """Return a label image, uint8, shape (height, width): 0 background, k the k-th body.

    Raises:
        InputDataError: If it is missing, truncated, or not 8 bits and one channel.
    """
    image = _decode(Path(path), cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint8:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise InputDataError(
            f"{path}: a mask of {channels} channel(s) with {image.dtype.itemsize * 8} bits.",
            "one channel of 8 bits (no palette, no colours): 0 background, k the k-th [[bodies]].",
            "save it as an 8-bit greyscale PNG.",
        )
    return image


def read_alpha(path: Path | str) -> NDArray[np.uint8]:
    """Return the opacity of a picture with four channels, uint8, shape (height, width).

    Raises:
        InputDataError: If it is missing, truncated, or has no opacity.
    """
    image = _decode(Path(path), cv2.IMREAD_UNCHANGED)
    if image.ndim != 3 or image.shape[2] != 4 or image.dtype != np.uint8:
        raise InputDataError(f"{path}: a picture without opacity.", "four channels of 8 bits.")
    return image[..., 3]


def write_image(path: Path | str, array: NDArray[np.uint8], quality: int = 95) -> None:
    """Write RGB (height, width, 3) or labels (height, width), uint8, as PNG or JPEG by the suffix.

    Args:
        path: The file; labels must be `.png`, because JPEG changes values.
        array: The pixels.
        quality: JPEG quality, 0 to 100.
    """
    path = Path(path)
    if array.dtype != np.uint8 or array.ndim not in (2, 3):
        raise ValueError(f"an image is uint8 (H, W, 3) or (H, W); found {array.dtype} {array.shape}")
    if array.ndim == 2 and path.suffix != ".png":
        raise ValueError(f"labels are written as .png; found {path.name}")
    pixels = array if array.ndim == 2 else cv2.cvtColor(array, cv2.COLOR_RGB2BGR)
    # OpenCV warns on stderr about a JPEG setting that is given to a PNG.
    settings = [] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, quality]
    done, data = cv2.imencode(path.suffix, pixels, settings)
    if not done:
        raise ValueError(f"OpenCV cannot write {path.name}")
    path.write_bytes(data.tobytes())


def write_depth(path: Path | str, depth: NDArray[np.uint16]) -> None:
    """Write depth (height, width), uint16 in a unit of the caller's choice, as a 16-bit PNG."""
    done, data = cv2.imencode(".png", depth)
    if depth.dtype != np.uint16 or depth.ndim != 2 or not done:
        raise ValueError(f"depth is uint16 (H, W); found {depth.dtype} {depth.shape}")
    Path(path).write_bytes(data.tobytes())


def image_size(path: Path | str) -> tuple[int, int]:
    """Return (width, height) [px] of a PNG or JPEG from its headers, after a check that it is complete.

    A PNG's chunks are checked by their checksums, a JPEG must have its end marker: a truncated file is found
    without decoding it.

    Raises:
        InputDataError: If it is missing, truncated or neither PNG nor JPEG.
    """
    return _size(Path(path), _bytes(Path(path)))


def _decode(path: Path, flags: int) -> NDArray:
    data = _bytes(path)
    _size(path, data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise InputDataError(f"{path}: the image does not decode.", todo=_REPLACE)
    return image


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputDataError(f"{path}: no such file.") from None
    except OSError as error:
        raise InputDataError(f"{path}: cannot be read: {error.strerror}.") from None


def _size(path: Path, data: bytes) -> tuple[int, int]:
    try:
        if data.startswith(_PNG_SIGNATURE):
            return _png_size(data)
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
    except (struct.error, IndexError):
        raise _undecodable(path, data, "truncated") from None
    except ValueError as error:
        raise _undecodable(path, data, str(error)) from None
    raise _undecodable(path, data, "neither PNG nor JPEG")


def _undecodable(path: Path, data: bytes, reason: str) -> InputDataError:
    return InputDataError(
        f"{path}: the image does not decode: {reason} ({len(data)} bytes).", "PNG and JPEG.", _REPLACE
    )


def _png_size(data: bytes) -> tuple[int, int]:
    offset, size = len(_PNG_SIGNATURE), None
    while True:
        length, kind = struct.unpack_from(">I4s", data, offset)
        (checksum,) = struct.unpack_from(">I", data, offset + 8 + length)
        if zlib.crc32(data[offset + 4 : offset + 8 + length]) != checksum:
            raise ValueError(f"damaged at byte {offset}")
        if kind == b"IHDR":
            size = struct.unpack_from(">II", data, offset + 8)
        if kind == b"IEND":
            if size is None:
                raise ValueError("no image header")
            return size
        offset += 12 + length


def _jpeg_size(data: bytes) -> tuple[int, int]:
    offset, size = 2, None
    while True:
        if data[offset] != 0xFF:
            raise ValueError(f"damaged at byte {offset}")
        marker = data[offset + 1]
        if marker == 0xFF or marker in _JPEG_STANDALONE:
            offset += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", data, offset + 2)
        if marker in _JPEG_FRAME_HEADERS:
            height, width = struct.unpack_from(">HH", data, offset + 5)
            size = (width, height)
        offset += 2 + length
        if marker == 0xDA:  # start of scan: from here on 0xFF is stuffed, so the end marker is unmistakable
            break
    if size is None:
        raise ValueError("no image header")
    if data.find(b"\xff\xd9", offset) < 0:
        raise ValueError("truncated")
    return size
