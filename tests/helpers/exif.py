"""EXIF data as cameras write them into photos."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path


def tiff(
    maker: str = "Maker", model: str = "Model", focal_mm: float | None = None, equivalent: int | None = None
) -> bytes:
    """Return a little-endian TIFF structure with the tags of a lens."""
    inner = []
    if focal_mm is not None:
        inner.append((0x920A, 5, 1, struct.pack("<II", round(1000 * focal_mm), 1000)))
    if equivalent is not None:
        inner.append((0xA405, 3, 1, struct.pack("<HH", equivalent, 0)))
    texts = [(0x010F, maker.encode() + b"\0"), (0x0110, model.encode() + b"\0")]
    outer = [(tag, 2, len(text), text) for tag, text in texts]
    first = 8
    second = (
        first + 2 + 12 * (len(outer) + 1) + 4 + sum(len(data) + len(data) % 2 for *_, data in outer if len(data) > 4)
    )
    pointer = (0x8769, 4, 1, struct.pack("<I", second))
    return b"II*\0" + struct.pack("<I", first) + _directory([*outer, pointer], first) + _directory(inner, second)


def _directory(entries: list[tuple[int, int, int, bytes]], place: int) -> bytes:
    head, tail = struct.pack("<H", len(entries)), b""
    behind = place + 2 + 12 * len(entries) + 4
    for tag, kind, count, data in entries:
        if len(data) <= 4:
            head += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0")
        else:
            head += struct.pack("<HHII", tag, kind, count, behind + len(tail))
            tail += data + b"\0" * (len(data) % 2)
    return head + b"\0\0\0\0" + tail


def add_exif(photo: Path, block: bytes) -> None:
    """Put a TIFF structure into a JPEG or PNG file."""
    data = photo.read_bytes()
    if data.startswith(b"\xff\xd8"):
        body = b"Exif\0\0" + block
        photo.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:])
        return
    end = 8 + 25  # the signature and the first chunk, IHDR
    chunk = b"eXIf" + block
    photo.write_bytes(
        data[:end] + struct.pack(">I", len(block)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[end:]
    )
