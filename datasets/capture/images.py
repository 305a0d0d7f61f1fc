"""Reading and writing of photos and label images, and their size from the headers."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.regular_files import read_binary_file

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
"""Suffixes of readable images, in lower case."""
UNREAD_SUFFIXES = (
    ".heic", ".heif", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".avif", ".jxl", ".dng", ".raw", ".npy",
)  # fmt: skip
"""Suffixes of images that are not read, in lower case."""
HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"mif1", b"msf1")
"""First brands of HEIF files (ISO/IEC 23008-12), at byte 8; phones and clouds name some of them .jpg."""
_OTHER_KINDS = (
    (0, b"RIFF", "WebP"), (0, b"II*\0", "TIFF"), (0, b"MM\0*", "TIFF"), (0, b"GIF8", "GIF"), (0, b"BM", "BMP"),
    (4, b"ftypavif", "AVIF"), (4, b"JXL ", "JPEG XL"), (0, b"\xff\x0a", "JPEG XL"),
)  # fmt: skip
"""Where files of other kinds begin with what; some pages and messengers name them .jpg."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG."""
_JPEG_STANDALONE = {0x01, *range(0xD0, 0xD8)}
_JPEG_FRAME_HEADERS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_REPLACE = "replace the file, or remove it."
MOST_PIXELS = 256_000_000
"""Maximum number of pixels of a picture: the header of a small file may declare any number."""


def read_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Return a photo as RGB, uint8, shape (height, width, 3).

    An EXIF orientation is not applied: pixel (0, 0) is the file's first one, as in COLMAP and in masks.

    Raises:
        InputDataError: If it is missing, truncated or not an image.
    """
    image = decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_label(path: Path | str) -> NDArray[np.uint8]:
    """Return a label image, uint8, shape (height, width): 0 background, k the k-th body.

    Raises:
        InputDataError: If it is missing, truncated, or not 8 bits and one channel.
    """
    image = decoded(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint8:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise InputDataError(
            f"{path}: a mask of {channels} channel(s) with {image.dtype.itemsize * 8} bits.",
            "one channel of 8 bits (no palette, no colours): 0 background, k the k-th [[bodies]].",
            "save it as an 8-bit greyscale PNG.",
        )
    return image


def named_as_photo(path: Path) -> bool:
    """Return whether a file is called as a picture is, of a kind that is read or of another one."""
    return path.suffix.lower() in (*IMAGE_SUFFIXES, *UNREAD_SUFFIXES)


def unread_kinds(paths: Iterable[Path]) -> list[str]:
    """Return the suffixes of pictures that are not read among files, in order."""
    return sorted({path.suffix for path in paths if path.suffix.lower() in UNREAD_SUFFIXES})


def read_alpha(path: Path | str) -> NDArray[np.uint8]:
    """Return the opacity of a picture with four channels, uint8, shape (height, width).

    Raises:
        InputDataError: If it is missing, truncated, or has no opacity.
    """
    image = decoded(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 3 or image.shape[2] != 4 or image.dtype != np.uint8:
        raise InputDataError(
            f"{path}: a picture without opacity.",
            "four channels of 8 bits.",
            "save the picture as PNG with an alpha channel.",
        )
    return image[..., 3]


def cut_out(path: Path | str) -> NDArray[np.bool_] | None:
    """Return where a picture is opaque, shape (height, width); None where it has no opacity or is opaque everywhere.

    Raises:
        InputDataError: If it is missing, truncated or not an image.
    """
    image = decoded(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 3 or image.shape[2] != 4:
        return None
    opaque = image[..., 3] > np.iinfo(image.dtype).max // 2
    return None if opaque.all() else opaque


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
    path.write_bytes(encoded_image(path.suffix, pixels, settings).tobytes())


def write_depth(path: Path | str, depth: NDArray[np.uint16]) -> None:
    """Write depth (height, width), uint16 in a unit of the caller's choice, as a 16-bit PNG."""
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise ValueError(f"depth is uint16 (H, W); found {depth.dtype} {depth.shape}")
    Path(path).write_bytes(encoded_image(".png", depth).tobytes())


def encoded_image(suffix: str, pixels: NDArray, settings: Sequence[int] = ()) -> NDArray[np.uint8]:
    """Return an image in OpenCV's order of channels, (H, W) or (H, W, 3), as the bytes of a file, uint8 (n,).

    Args:
        suffix: Suffix of the format, ".png" or ".jpg".
        pixels: The image.
        settings: OpenCV's settings for the format.

    Raises:
        InputDataError: If the format does not take the image, such as a JPEG of more than 65535 pixels a side.
    """
    done, data = cv2.imencode(suffix, pixels, settings)  # returns False, and raises nothing
    if not done:
        height, width = pixels.shape[:2]
        raise InputDataError(
            f"an image of {width} x {height} px cannot be written as {suffix}.", todo="write smaller images."
        )
    return np.asarray(data, np.uint8).reshape(-1)


def image_size(path: Path | str) -> tuple[int, int]:
    """Return (width, height) [px] of a PNG or JPEG from its headers, after a check that it is complete.

    A PNG's chunks are checked by their checksums, a JPEG must have its end marker: a truncated file is found
    without decoding it.

    Raises:
        InputDataError: If it is missing, truncated, neither PNG nor JPEG, or of more pixels than `MOST_PIXELS`.
    """
    return _size(Path(path), read_binary_file(path))


def decoded(path: Path | str, flags: int) -> NDArray:
    """Return a PNG or JPEG as OpenCV decodes it, after a look at its headers.

    Args:
        path: The file.
        flags: OpenCV's flags of decoding.

    Raises:
        InputDataError: As `image_size`, or if it does not decode.
    """
    path = Path(path)
    data = read_binary_file(path)
    _size(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise InputDataError(f"{path}: the image does not decode.", todo=_REPLACE)
    return image


def _size(path: Path, data: bytes) -> tuple[int, int]:
    try:
        if data.startswith(PNG_SIGNATURE):
            width, height = _png_size(data)
        elif data.startswith(b"\xff\xd8"):
            width, height = _jpeg_size(data)
        else:
            raise ValueError(_other_kind(data))
    except (struct.error, IndexError):
        raise _undecodable(path, data, "truncated") from None
    except ValueError as error:
        raise _undecodable(path, data, str(error)) from None
    if not 0 < width * height <= MOST_PIXELS:
        raise InputDataError(
            f"{path}: its header declares {width}x{height} px ({len(data)} bytes).",
            f"1 to {MOST_PIXELS // 10**6} million pixels.",
            _REPLACE,
        )
    return width, height


def _other_kind(data: bytes) -> str:
    """Return what a file is that is neither PNG nor JPEG, and what makes it one."""
    if data[4:8] == b"ftyp" and data[8:12] in HEIF_BRANDS:
        return "HEIC, whatever its name ('cgwm import photos' converts it)"
    kind = next((kind for at, start, kind in _OTHER_KINDS if data[at : at + len(start)] == start), None)
    return f"{kind}, whatever its name: save it as JPEG or PNG" if kind else "neither PNG nor JPEG"


def _undecodable(path: Path, data: bytes, reason: str) -> InputDataError:
    return InputDataError(
        f"{path}: the image does not decode: {reason} ({len(data)} bytes).", "PNG and JPEG.", _REPLACE
    )


def _png_size(data: bytes) -> tuple[int, int]:
    offset, size = len(PNG_SIGNATURE), None
    while True:
        length, kind = struct.unpack_from(">I4s", data, offset)
        (checksum,) = struct.unpack_from(">I", data, offset + 8 + length)
        if zlib.crc32(data[offset + 4 : offset + 8 + length]) != checksum:
            raise ValueError(f"damaged at byte {offset}")
        if (kind == b"IHDR") != (size is None):
            raise ValueError("two image headers" if size else "no image header")
        if size is None:
            size = struct.unpack_from(">II", data, offset + 8)
        elif kind == b"IEND":
            return size
        offset += 12 + length


def _jpeg_size(data: bytes) -> tuple[int, int]:
    headers, end = [], 2
    for marker, offset, length in _jpeg_segments(data):
        end = offset + 2 + length
        if marker in _JPEG_FRAME_HEADERS:
            headers.append(struct.unpack_from(">HH", data, offset + 5))
    if len(headers) != 1:
        raise ValueError("two image headers" if headers else "no image header")
    if data.find(b"\xff\xd9", end) < 0:
        raise ValueError("truncated")
    height, width = headers[0]
    return width, height


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield marker, place and length of each segment, up to the start of the scan.

    From there on 0xFF is stuffed, so that the end marker is unmistakable.
    """
    offset, marker = 2, 0
    while marker != 0xDA:
        if data[offset] != 0xFF:
            raise ValueError(f"damaged at byte {offset}")
        marker = data[offset + 1]
        if marker == 0xFF or marker in _JPEG_STANDALONE:
            offset += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", data, offset + 2)
        yield marker, offset, length
        offset += 2 + length
