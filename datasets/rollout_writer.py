"""Writing of rollouts: chunks of images are compressed in many threads, and one thread puts them into the file.

HDF5 does one thing at a time, so that it gets chunks that are ready (`write_direct_chunk`). They are written in the
order in which they were given, whatever thread was first, so that equal content gives equal bytes.
"""

from __future__ import annotations

import errno
import json
import os
import queue
import threading
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np

from ..schemas import ROLLOUTS_FORMAT, NotEnoughSpaceError
from .cameras import Camera
from .chunks import CHUNK_FRAMES, JPEG_QUALITY, Compression, chunked, encoded, jpeg_of, require_zstd
from .described import new_dataset, new_group, put, write_number, write_text
from .guarded_file import GuardedFile
from .processors import processors
from .rollout_tables import link_next_observations, write_tables
from .rollouts import CONVENTION, VALID_EVERY, FrameBlock, Node, RolloutLabels, amodal_dtype

MOST_WAITING_BYTES = 512 << 20
"""Images that may wait, before they are compressed, for the threads and for the file: more make the caller wait."""
MOST_WAITING = 256
"""Rollouts and chunks that may wait."""

_IMAGES = {
    "image": ("1", "row, column, RGB", "(T, H, W, 3)", "Rendered colour, 0 to 255."),
    "depth": ("m", "row, column", "(T, H, W)", "Depth along the optical axis of what the mask names; 0 = no surface."),
    "mask": ("1", "row, column", "(T, H, W)", "Visible instance: 0 = background, k = the k-th body."),
    "amodal": (
        "1",
        "row, column; bit k - 1 of a pixel belongs to the k-th body",
        "(T, H, W)",
        "Amodal masks as bits: (pixel >> (k - 1)) & 1 is 1 where the k-th body would be seen if it were alone, hidden "
        "or not.",
    ),
}
_JPEG = (
    "1",
    "bytes of a JPEG file, filled up with zeros",
    "(T, longest)",
    "Rendered colour, lossy: decode each row with any JPEG reader (cv2.imdecode), to height x width, RGB.",
)


@dataclass(frozen=True)
class _Chunk:
    """A block on its way: what it is, and its images as they will stand in the file, by name."""

    camera: str
    start: int
    count: int
    size: int
    visible_px: np.ndarray
    amodal_px: np.ndarray
    images: Future[dict[str, Any]]


@dataclass(frozen=True)
class _End:
    """No more images of this rollout."""


class RolloutWriter:
    """Writes rollouts into one HDF5 file, one after the other, in memory that does not grow with them.

    The path is written to directly: give the temporary path of :func:`datasets.atomic.new_file` or `new_directory`.

    Args:
        path: The file to write.
        seed: Root seed.
        config_json: The resolved settings.
        creator: Program and version.
        compression: Of images, depth and masks. jpeg: images in JPEG, lossy, the others in zstd.
        threads: That compress; as many as there are processors where left out. They change no byte.
    """

    def __init__(
        self,
        path: Path,
        seed: int,
        config_json: str,
        creator: str,
        compression: Compression = "zstd",
        threads: int | None = None,
    ):
        if compression in ("zstd", "jpeg"):
            require_zstd(f"writing with compression {compression}")  # before there is a file
        self._compression: Compression = compression
        self._path = path
        self._guarded = GuardedFile(path)
        self._file = h5py.File(self._guarded, "w")
        self._file.attrs.update(
            format=ROLLOUTS_FORMAT,
            format_version=1,
            creator=creator,
            seed=seed,
            config_json=config_json,
            convention=CONVENTION,
            filters="zstd, jpeg" if compression == "jpeg" else compression,
        )
        self._data: Node = self._file.create_group("data")
        env = {"env_name": "cgwm", "env_type": 2, "type": 2, "env_kwargs": {}}
        self._data.attrs["env_args"] = json.dumps(env)
        self._indices: list[int] = []
        self.total = 0
        self._error: BaseException | None = None
        self._room = _Room(MOST_WAITING_BYTES)
        self._queue: queue.Queue[RolloutLabels | _Chunk | _End | None] = queue.Queue(MOST_WAITING)
        self._pool = ThreadPoolExecutor(threads or processors(), "cgwm-compress")
        self._thread = threading.Thread(target=self._work, name="cgwm-write", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._error = self._error or error  # what still waits is dropped
            self._room.open()
        self._queue.put(None)
        self._thread.join()
        self._pool.shutdown(cancel_futures=True)
        try:
            if self._error is None:
                self._finish()
        except BaseException as fault:
            self._error = fault
        finally:
            self._file.close()
            self._guarded.close()
        self._error = self._error or self._guarded.error
        if kind is None:
            self._check()

    def write(self, labels: RolloutLabels, frames: Iterable[FrameBlock] = ()) -> None:
        """Write one rollout; `frames` may be a generator, and is consumed block by block.

        It returns before all is on the disk. What goes wrong there is raised by the next call, or at the end of the
        `with` block.

        Raises:
            NotEnoughSpaceError: If the disk is full.
            ValueError: If the blocks of the rollout before were not all of its frames.
        """
        self._check()
        self._queue.put(labels)
        chunk_frames = _chunk_frames(len(labels.time_s))
        for block in frames:
            size = sum(image.nbytes for image in block.images.values())
            self._room.take(size)
            self._check()
            images = self._pool.submit(_encoded_images, block, self._compression, chunk_frames)
            counts = (block.visible_px, block.amodal_px)
            self._queue.put(_Chunk(block.camera, block.start, len(block.image), size, *counts, images))
        self._queue.put(_End())

    def _check(self) -> None:
        error = self._error
        if error is None:
            return
        if isinstance(error, OSError) and (error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)):
            raise NotEnoughSpaceError(
                f"{self._path.parent}: after {len(self._indices)} rollouts the disk, or what may be used of it, is "
                f"full: {os.strerror(error.errno)}.",
                todo="free some, write to another disk, or make fewer rollouts; --set synthesize.compression=jpeg is "
                "smaller.",
            ) from error
        raise error

    def _work(self) -> None:
        """Take things from the queue until the end, and write them as long as nothing goes wrong."""
        demo: _Demo | None = None
        while (item := self._queue.get()) is not None:
            try:
                if self._error is not None:
                    continue
                if isinstance(item, RolloutLabels):
                    demo = _Demo(self._data, item, self._compression)
                    continue
                assert demo is not None  # labels come first
                if isinstance(item, _Chunk):
                    demo.write(item)
                else:
                    demo.finish()
                    self._indices.append(demo.labels.episode_index)
                    self.total += len(demo.labels.time_s)
                if self._guarded.error is not None:
                    raise self._guarded.error
            except BaseException as error:  # another thread raises it
                self._error = self._error or error
                self._room.open()
            finally:
                if isinstance(item, _Chunk):
                    self._room.give(item.size)

    def _finish(self) -> None:
        self._data.attrs["total"] = self.total
        splits = {"train": [], "valid": []}
        for index in sorted(self._indices):
            splits["valid" if index % VALID_EVERY == VALID_EVERY - 1 else "train"].append(f"demo_{index}")
        group = self._file.create_group("mask")
        for split, names in splits.items():
            width = max((len(name) for name in names), default=1)
            group.create_dataset(split, data=np.array(names, dtype=f"S{width}"))


class _Demo:
    """One rollout while it is written."""

    def __init__(self, data: Node, labels: RolloutLabels, compression: Compression) -> None:
        self.labels = labels
        self._group = new_group(data, f"demo_{labels.episode_index}")
        self._obs: Node = write_tables(self._group, labels)
        self._compression: Compression = compression
        count, bodies = len(labels.time_s), len(labels.bodies)
        cameras = labels.cameras or {}
        self._counts = {name: np.full((2, count, bodies), -1, np.int32) for name in cameras}
        self._jpegs: dict[str, dict[int, np.ndarray]] = {name: {} for name in cameras}
        self._images = {name: self._datasets(name, camera, count, bodies) for name, camera in cameras.items()}

    def _datasets(self, name: str, camera: Camera, count: int, bodies: int) -> dict[str, Any]:
        size = (camera.height, camera.width)
        kinds = {
            "image": (np.dtype(np.uint8), (*size, 3)),
            "depth": (np.dtype(np.float32), size),
            "mask": (np.dtype(np.uint8), size),
            "amodal": (amodal_dtype(bodies), size),
        }
        if self._compression == "jpeg":
            del kinds["image"]
        made: dict[str, Any] = {}
        for key, (dtype, shape) in kinds.items():
            properties = chunked(self._compression, dtype, (_chunk_frames(count), *shape))
            unit, order, axes, text = _IMAGES[key]
            texts = (unit, f"image of camera {name}", order, axes, text)
            made[key] = new_dataset(self._obs, f"{name}_{key}", dtype, (count, *shape), properties, *texts)
        return made

    def write(self, chunk: _Chunk) -> None:
        """Put a chunk's images in their place."""
        stop = chunk.start + chunk.count
        for key, data in chunk.images.result().items():
            if key == "jpeg":
                self._jpegs[chunk.camera].update(zip(range(chunk.start, stop), data, strict=True))
                continue
            made = self._images[chunk.camera][key]
            made.write_direct_chunk((chunk.start, *(0 for _ in made.shape[1:])), data)
        self._counts[chunk.camera][:, chunk.start : stop] = chunk.visible_px, chunk.amodal_px

    def finish(self) -> None:
        """Write what needs all frames.

        Raises:
            ValueError: If some frames were not written.
        """
        for name, counts in self._counts.items():
            lacking = int((counts[0, :, 0] < 0).sum())
            if lacking:
                raise ValueError(f"camera {name}: {lacking} of {counts.shape[1]} frames were not written")
        if self._counts:
            self._write_visibility()
        if self._compression == "jpeg":
            for name, camera in (self.labels.cameras or {}).items():
                self._write_jpegs(name, camera)
        link_next_observations(self._group, self._obs)

    def _write_visibility(self) -> None:
        bodies = self._group["bodies"]
        counts = np.stack([self._counts[name] for name in sorted(self._counts)], axis=2)
        visible, whole = counts
        fraction = np.where(whole > 0, visible / np.maximum(whole, 1), 0.0)
        axes, cameras = "(T, camera, body)", "cameras in the order of their names"
        texts = {
            "visible_px": (visible, "px", f"Pixels of the body in the mask; {cameras}."),
            "amodal_px": (whole, "px", f"Pixels of the body in the image, hidden ones too; {cameras}."),
            "visible_fraction": (
                fraction,
                "1",
                f"visible_px over amodal_px: how much of what is in the image is not hidden, 0 where nothing is; "
                f"{cameras}.",
            ),
        }
        for name, (values, unit, text) in texts.items():
            put(bodies, name, values, unit, "image", "-", axes, text)

    def _write_jpegs(self, name: str, camera: Camera) -> None:
        files = [data for _, data in sorted(self._jpegs[name].items())]
        rows = np.zeros((len(files), max(map(len, files))), np.uint8)
        for row, data in zip(rows, files, strict=True):
            row[: len(data)] = data
        unit, order, axes, text = _JPEG
        # not in chunks: a frame is read without its neighbours
        made = put(
            self._obs, f"{name}_image", rows, unit, f"image of camera {name}", order, axes, text, in_chunks=False
        )
        write_text(made, b"encoding", "jpeg")
        for key, value in {"quality": JPEG_QUALITY, "height": camera.height, "width": camera.width}.items():
            write_number(made, key, np.int64(value))


def _chunk_frames(frames: int) -> int:
    return min(CHUNK_FRAMES, frames)


def _encoded_images(block: FrameBlock, compression: Compression, chunk_frames: int) -> dict[str, Any]:
    """Return the images of a block as they stand in the file; with jpeg the colours as a list of files, "jpeg"."""
    if block.ready is not None:
        block.ready()
    data: dict[str, Any] = {}
    for key, frames in block.images.items():
        if key == "image" and compression == "jpeg":
            data["jpeg"] = [jpeg_of(frame) for frame in frames]
        else:
            data[key] = encoded(frames, compression, chunk_frames)
    return data


class _Room:
    """Bytes that may be taken until they are given back; one taker at least gets in."""

    def __init__(self, size: int) -> None:
        self._free, self._size = size, size
        self._changed = threading.Condition()
        self._open = False

    def take(self, size: int) -> None:
        """Wait until there is room."""
        with self._changed:
            self._changed.wait_for(lambda: self._open or self._free >= min(size, self._size))
            self._free -= size

    def give(self, size: int) -> None:
        """Give back what was taken."""
        with self._changed:
            self._free += size
            self._changed.notify_all()

    def open(self) -> None:
        """Let everybody in: nothing is written any more."""
        with self._changed:
            self._open = True
            self._changed.notify_all()
