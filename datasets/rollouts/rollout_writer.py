"""Writing of rollouts: many threads compress chunks of images, and one thread writes them to the file.

HDF5 is single-threaded, so it receives compressed chunks (`write_direct_chunk`). They are written in the order in which
they were given, whichever thread finished first, so that equal content gives equal bytes.
"""

from __future__ import annotations

import errno
import json
import os
import queue
import threading
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np

from ...schemas import ROLLOUTS_FORMAT, NotEnoughSpaceError
from ..io.processors import processors
from .chunks import Compression, encoded, jpeg_of, require_zstd, zstd_module
from .guarded_file import GuardedFile
from .rollout_demo import Chunk, Demo, chunk_frames_of
from .rollouts import CONVENTION, VALID_EVERY, FrameBlock, Node, RolloutLabels

MOST_WAITING_BYTES = 512 << 20
"""Images that may wait, before they are compressed, for the threads and for the file: more make the caller wait."""
MOST_WAITING = 256
"""Rollouts and chunks that may wait."""


@dataclass(frozen=True)
class _End:
    """No more images of this rollout."""


class RolloutWriter:
    """Writes rollouts into one HDF5 file, one after the other, in memory that does not grow with them.

    The path is written directly: pass the temporary path of :func:`datasets.io.atomic.new_file` or `new_directory`.

    Args:
        path: The file to write.
        seed: Root seed.
        config_json: The resolved settings.
        creator: Program and version.
        compression: Compression of images, depth and masks. jpeg: images in JPEG, lossy, the others in zstd.
        threads: Number of threads that compress, by default the number of processors. It does not change the bytes.
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
            zstd_module()
        self._compression: Compression = compression
        self._path = path
        self._attributes = {
            "format": ROLLOUTS_FORMAT,
            "format_version": 1,
            "creator": creator,
            "seed": seed,
            "config_json": config_json,
            "convention": CONVENTION,
            "filters": "zstd, jpeg" if compression == "jpeg" else compression,
        }
        self._guarded = GuardedFile(path)
        self._indices: list[int] = []
        self.total = 0
        self._error: BaseException | None = None
        self._room = _Room(MOST_WAITING_BYTES)
        self._queue: queue.Queue[RolloutLabels | Chunk | _End | None] = queue.Queue(MOST_WAITING)
        self._pool = ThreadPoolExecutor(threads or processors(), "cgwm-compress")
        self._thread = threading.Thread(target=self._work, name="cgwm-write", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self._drop(error)
        try:
            self._queue.put(None)
            self._thread.join()
        except BaseException as interrupt:
            self._drop(interrupt)
            self._queue.put(None)
            self._thread.join()
            raise
        finally:
            self._pool.shutdown(cancel_futures=True)
            self._guarded.close()
        if kind is None:
            self._check()

    def _drop(self, error: BaseException) -> None:
        """Stop writing and discard everything that still waits."""
        self._error = self._error or error
        self._room.open()

    def write(self, labels: RolloutLabels, frames: Iterable[FrameBlock] = ()) -> None:
        """Write one rollout; `frames` may be a generator, and is consumed block by block.

        It returns before everything is on disk. Errors of writing are raised by the next call, or at the end of the
        `with` block.

        Raises:
            NotEnoughSpaceError: If the disk is full.
            ValueError: If the blocks of the previous rollout did not contain all of its frames.
        """
        self._check()
        self._queue.put(labels)
        chunk_frames = chunk_frames_of(len(labels.time_s))
        for block in frames:
            size = sum(image.nbytes for image in block.images.values())
            self._room.take(size)
            self._check()
            images = self._pool.submit(_encoded_images, block, self._compression, chunk_frames)
            chunk = Chunk(
                camera=block.camera,
                start=block.start,
                count=len(block.image),
                size=size,
                visible_px=block.visible_px,
                amodal_px=block.amodal_px,
                images=images,
            )
            self._queue.put(chunk)
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
        """Run all calls of HDF5, from opening the file to closing it.

        This happens in a thread because Python interrupts only the main one: HDF5 cannot close a file after an
        interrupted call, and the process would crash at its end.
        """
        item = self._queue.get()
        try:
            with h5py.File(self._guarded, "w") as file:
                file.attrs.update(self._attributes)
                data: Node = file.create_group("data")
                env = {"env_name": "cgwm", "env_type": 2, "type": 2, "env_kwargs": {}}
                data.attrs["env_args"] = json.dumps(env)
                self._write_all(data, item)
                item = None
                if self._error is None:
                    self._finish(file, data)
        except BaseException as error:  # another thread raises it
            self._drop(error)
            while item is not None:
                item = self._queue.get()
        self._error = self._error or self._guarded.error

    def _write_all(self, data: Node, item: RolloutLabels | Chunk | _End | None) -> None:
        """Write the items of the queue until its end; after an error, discard them."""
        demo: Demo | None = None
        while item is not None:
            try:
                if self._error is not None:
                    continue
                if isinstance(item, RolloutLabels):
                    demo = Demo(data, item, self._compression)
                    continue
                assert demo is not None  # labels come first
                if isinstance(item, Chunk):
                    demo.write(item)
                else:
                    demo.finish()
                    self._indices.append(demo.labels.episode_index)
                    self.total += len(demo.labels.time_s)
                if self._guarded.error is not None:
                    raise self._guarded.error
            except BaseException as error:  # another thread raises it
                self._drop(error)
            finally:
                if isinstance(item, Chunk):
                    self._room.give(item.size)
                item = self._queue.get()

    def _finish(self, file: Node, data: Node) -> None:
        data.attrs["total"] = self.total
        splits = {"train": [], "valid": []}
        for index in sorted(self._indices):
            splits["valid" if index % VALID_EVERY == VALID_EVERY - 1 else "train"].append(f"demo_{index}")
        group = file.create_group("mask")
        for split, names in splits.items():
            width = max((len(name) for name in names), default=1)
            group.create_dataset(split, data=np.array(names, dtype=f"S{width}"))


def _encoded_images(block: FrameBlock, compression: Compression, chunk_frames: int) -> dict[str, Any]:
    """Return the images of a block as they are stored in the file; with jpeg the colours as a list of files, "jpeg"."""
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
    """A budget of bytes that can be taken and given back; it always admits at least one taker."""

    def __init__(self, size: int) -> None:
        self._free, self._size = size, size
        self._changed = threading.Condition()
        self._open = False

    def take(self, size: int) -> None:
        """Wait until the budget allows it, and take."""
        with self._changed:
            self._changed.wait_for(lambda: self._open or self._free >= min(size, self._size))
            self._free -= size

    def give(self, size: int) -> None:
        """Give back bytes."""
        with self._changed:
            self._free += size
            self._changed.notify_all()

    def open(self) -> None:
        """Admit all takers, because nothing is written any more."""
        with self._changed:
            self._open = True
            self._changed.notify_all()
