"""Which lens took a photo, and how it is turned, from its EXIF data.

EXIF is a TIFF structure in a segment APP1 of a JPEG or a chunk eXIf of a PNG (CIPA DC-008-2019, "Exif 2.32", sections
4.5 and 4.6; PNG specification, third edition, section 11.3.4.5).
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas.regular_files import read_binary_file

Value = str | float

_MAKE, _MODEL, _ORIENTATION, _SUBDIRECTORY = 0x010F, 0x0110, 0x0112, 0x8769
_FOCAL_MM, _FOCAL_35_MM = 0x920A, 0xA405
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}
"""Bytes of a value by its TIFF type."""
_MOST_ENTRIES = 1000
_FROM_RIGHT, _FROM_BELOW = (2, 3, 7, 8), (3, 4, 6, 7)
"""Orientations in which the file's columns run from the right of what is shown, or its rows from below, after those of
5 to 8 have been exchanged."""


def photo_lens(path: Path) -> str:
    """Return maker, model and focal lengths of the camera that took a photo, as a text; empty where it names none.

    Photos with one text were taken through one lens at one zoom. Data that do not parse count as absent, as in other
    readers: they are no part of the picture.

    Args:
        path: The photo, JPEG or PNG.
    """
    tags = _photo_tags(path)
    words = [tag for key in (_MAKE, _MODEL) if isinstance(tag := tags.get(key), str) and tag]
    for key, note in ((_FOCAL_MM, " mm"), (_FOCAL_35_MM, " mm (35 mm)")):
        length = tags.get(key)
        if isinstance(length, float) and length > 0:
            words.append(f"{length:g}{note}")
    return " ".join(words)


def upright_size(path: Path, size: tuple[int, int]) -> tuple[int, int]:
    """Return the width and height [px] of a photo of this size as viewers show it."""
    width, height = size
    return (height, width) if _orientation(path) >= 5 else size


def upright_in_file(path: Path) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return where an upright photo's right and its lower side are in its file: steps along columns and rows."""
    orientation = _orientation(path)
    column, row = -1.0 if orientation in _FROM_RIGHT else 1.0, -1.0 if orientation in _FROM_BELOW else 1.0
    return ((0.0, row), (column, 0.0)) if orientation >= 5 else ((column, 0.0), (0.0, row))


def turned_upright(path: Path, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image (H, W) or (H, W, 3) with the pixels of a photo's file as viewers show it."""
    orientation, own = _orientation(path), _own_order(path, image)
    return np.ascontiguousarray(np.swapaxes(own, 0, 1) if orientation >= 5 else own)


def turned_as_file(path: Path, image: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return an image (H, W) of an upright photo with the pixels of the photo's file."""
    return np.ascontiguousarray(_own_order(path, image.T if _orientation(path) >= 5 else image))


def _own_order(path: Path, image: NDArray) -> NDArray:
    orientation = _orientation(path)
    return image[:: -1 if orientation in _FROM_BELOW else 1, :: -1 if orientation in _FROM_RIGHT else 1]


def _orientation(path: Path) -> int:
    """Return the orientation of a photo, 1 (upright in the file) to 8; 1 where it has none."""
    value = _photo_tags(path).get(_ORIENTATION)
    return int(value) if isinstance(value, float) and 1 <= value <= 8 else 1


def _photo_tags(path: Path) -> dict[int, Value]:
    """Return the tags of a photo's EXIF data; none where they do not parse."""
    block = _exif_block(read_binary_file(path))
    try:
        return {} if block is None else _tags(block)
    except (struct.error, ValueError):
        return {}


def _exif_block(data: bytes) -> bytes | None:
    """Return the TIFF structure of a JPEG or PNG file, or None."""
    try:
        if data.startswith(b"\xff\xd8"):
            return _from_jpeg(data)
        return _from_png(data) if data.startswith(b"\x89PNG\r\n\x1a\n") else None
    except struct.error:
        return None


def _from_jpeg(data: bytes) -> bytes | None:
    offset = 2
    while data[offset : offset + 1] == b"\xff" and data[offset + 1] != 0xDA:
        (length,) = struct.unpack_from(">H", data, offset + 2)
        body = data[offset + 4 : offset + 2 + length]
        if data[offset + 1] == 0xE1 and body.startswith(b"Exif\0\0"):
            return body[6:]
        offset += 2 + length
    return None


def _from_png(data: bytes) -> bytes | None:
    offset = 8
    while offset + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        if kind in (b"eXIf", b"IEND"):
            return data[offset + 8 : offset + 8 + length] if kind == b"eXIf" else None
        offset += 12 + length
    return None


def _tags(block: bytes) -> dict[int, Value]:
    """Return the tags of the first directory and of the EXIF directory that it names."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(block[:4])
    if order is None:
        raise ValueError("no TIFF structure")
    tags = _directory(block, order, struct.unpack_from(f"{order}I", block, 4)[0])
    further = tags.get(_SUBDIRECTORY)
    return tags | (_directory(block, order, int(further)) if isinstance(further, float) else {})


def _directory(block: bytes, order: str, offset: int) -> dict[int, Value]:
    (count,) = struct.unpack_from(f"{order}H", block, offset)
    tags: dict[int, Value] = {}
    for k in range(min(count, _MOST_ENTRIES)):
        place = offset + 2 + 12 * k
        tag, kind, number = struct.unpack_from(f"{order}HHI", block, place)
        size = _SIZES.get(kind, 0) * number
        where = place + 8 if size <= 4 else struct.unpack_from(f"{order}I", block, place + 8)[0]
        value = _value(block[where : where + size], order, kind) if 0 < size <= len(block) - where else None
        if value is not None:
            tags[tag] = value
    return tags


def _value(data: bytes, order: str, kind: int) -> Value | None:
    """Return a text, or the first number of a field."""
    if kind == 2:
        return data.split(b"\0")[0].decode("latin-1").strip()
    if kind in (5, 10):
        above, below = struct.unpack_from(f"{order}{'ii' if kind == 10 else 'II'}", data)
        return above / below if below else None
    letter = {1: "B", 3: "H", 4: "I", 9: "i"}.get(kind)
    return float(struct.unpack_from(f"{order}{letter}", data)[0]) if letter else None
