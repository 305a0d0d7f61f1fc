"""Compression of image chunks in the formats of HDF5's filters, outside HDF5, which works in one thread.

Each function here may run in many threads at once: zstd, zlib and OpenCV release the interpreter lock.
"""

from __future__ import annotations

import importlib
import threading
import zlib
from functools import cache
from typing import Any, Literal

import cv2
import h5py
import numpy as np

from ...schemas import InputDataError
from ..capture.images import encoded_image

Compression = Literal["zstd", "gzip", "none", "jpeg"]

CHUNK_FRAMES = 8
"""Number of frames in a chunk of images: the best measured compromise of size, writing and random reading (zstd-1)."""
ZSTD_FILTER = 32015
"""HDF5's registered number of the zstd filter, which hdf5plugin provides."""
ZSTD_LEVEL, GZIP_LEVEL = 1, 4
JPEG_QUALITY = 95
"""Of JPEG images, colours at half the resolution: errors of about 1.5 grey levels on average."""

_of_thread = threading.local()


@cache
def chunked(compression: Compression, dtype: np.dtype[Any], chunk: tuple[int, ...]) -> Any:
    """Return the creation properties of a dataset of chunks as :func:`encoded` makes them; jpeg is zstd here.

    Numbers of several bytes are shuffled first: the first bytes of all, then the second ones. For depth this reduces
    the size by a quarter to a third and doubles the time.

    Raises:
        InputDataError: If zstd is requested and hdf5plugin is not installed.
    """
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    properties.set_chunk(chunk)
    if compression == "none":
        return properties
    if dtype.itemsize > 1:
        properties.set_shuffle()
    if compression == "gzip":
        properties.set_deflate(GZIP_LEVEL)
        return properties
    require_zstd(f"writing with compression {compression}")
    properties.set_filter(ZSTD_FILTER, h5py.h5z.FLAG_MANDATORY, (ZSTD_LEVEL,))
    return properties


def require_zstd(what: str) -> None:
    """Check that HDF5 has the zstd filter.

    Raises:
        InputDataError: If it has not, with what needs it.
    """
    try:
        import hdf5plugin  # noqa: F401  (registers the filter when it is imported)
    except ImportError:
        pass
    if not h5py.h5z.filter_avail(ZSTD_FILTER):
        raise InputDataError(
            f"{what} needs the HDF5 filter zstd, which is not installed here.",
            "files written with --compression gzip or none need no plugin.",
            "pip install hdf5plugin",
        )


def encoded(frames: np.ndarray, compression: Compression, chunk_frames: int) -> bytes | memoryview:
    """Return a chunk as it is stored in the file.

    Each thread keeps its working memory for its next chunk, because the system maps and clears new memory of this size
    each time, for which threads wait for each other.

    Args:
        frames: The frames of the chunk, C-contiguous, shape (n, H, W, ...) with n <= chunk_frames.
        compression: Compression of the dataset.
        chunk_frames: Frames in a chunk; missing ones are filled with zeros, as HDF5 does at the end of a dataset.
    """
    raw = np.ascontiguousarray(frames).reshape(-1).view(np.uint8)
    size = chunk_frames * (raw.size // len(frames))
    if raw.size < size:
        whole = np.empty(size, np.uint8) if compression == "none" else _scratch("whole", size)
        whole[: raw.size] = raw
        whole[raw.size :] = 0
        raw = whole
    if compression == "none":
        return raw.data
    if frames.itemsize > 1:
        raw = _shuffled(raw, frames.itemsize)
    if compression == "gzip":
        return zlib.compress(raw.data, GZIP_LEVEL)
    compressor = _compressor()
    return compressor.compress(raw.data, mode=compressor.FLUSH_FRAME)


def _shuffled(raw: np.ndarray, itemsize: int) -> np.ndarray:
    """Return the first bytes of all numbers, then the second ones and so on, in memory that the thread reuses."""
    planes = _scratch("planes", raw.size).reshape(itemsize, -1)
    rows = max(row for row in range(1, 65) if planes.shape[1] % row == 0)  # OpenCV wants a picture; its rows are free
    cv2.split(raw.reshape(rows, -1, itemsize), [plane.reshape(rows, -1) for plane in planes])
    return planes.reshape(-1)


def _scratch(name: str, size: int) -> np.ndarray:
    """Return working memory of this thread, with its last content."""
    kept: dict[str, np.ndarray] = _of_thread.__dict__
    if name not in kept or kept[name].size < size:
        kept[name] = np.empty(size, np.uint8)
    return kept[name][:size]


def _compressor() -> Any:
    """Return this thread's compressor. It gets a frame as a whole, and so writes the size that HDF5's filter needs."""
    if not hasattr(_of_thread, "compressor"):
        _of_thread.compressor = zstd_module().ZstdCompressor(ZSTD_LEVEL)
    return _of_thread.compressor


def zstd_module() -> Any:
    """Return the standard library's module `compression.zstd`, before Python 3.14 by its backport.

    Raises:
        InputDataError: If it is not there.
    """
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise InputDataError(
        "writing with zstd needs the package backports.zstd, which is not installed here.",
        "--set synthesize.compression=gzip or none need no package.",
        "pip install backports.zstd",
    )


def jpeg_of(image: np.ndarray) -> np.ndarray:
    """Return an image, uint8 RGB (H, W, 3), as the bytes of a JPEG file, uint8 (n,)."""
    return encoded_image(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])


def jpeg_size(data: np.ndarray) -> tuple[int, int] | None:
    """Return height and width [px] in the header of a JPEG file, uint8 (n,), or None if it has none."""
    content = data.tobytes()
    place = 2 if content[:2] == b"\xff\xd8" else len(content)
    while place + 9 <= len(content) and content[place] == 0xFF:
        marker, length = content[place + 1], int.from_bytes(content[place + 2 : place + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a frame header (SOF)
            height, width = content[place + 5 : place + 7], content[place + 7 : place + 9]
            return int.from_bytes(height, "big"), int.from_bytes(width, "big")
        place += 2 + length
    return None


def image_of(data: np.ndarray, size: tuple[int, int] | None = None, where: str = "the dataset") -> np.ndarray:
    """Return the image, uint8 RGB (H, W, 3), of a JPEG file, uint8 (n,); bytes after its end do not count.

    Args:
        data: The bytes of the file.
        size: Height and width [px] that it has to have; None: any.
        where: Its place, for messages.

    Raises:
        InputDataError: If it is none, or of another size.
    """
    found = jpeg_size(data)
    if size is not None and size != found:
        text = f"{where}: an image is no JPEG of {size[1]} x {size[0]} px, as its attributes say."
        raise InputDataError(text, todo="run 'cgwm validate'.")
    image = None if found is None else cv2.imdecode(np.ascontiguousarray(data), cv2.IMREAD_COLOR)
    if image is None:
        raise InputDataError(f"{where}: an image is no JPEG: the file is damaged.", todo="run 'cgwm validate'.")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
