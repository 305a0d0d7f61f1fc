"""Writing of one rollout into its file: images chunk by chunk, and summaries at the end."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..capture.cameras import Camera
from .array_table import ARRAYS, JPEG
from .chunks import CHUNK_FRAMES, JPEG_QUALITY, Compression, chunked
from .described import new_dataset, new_group, put, put_entry, write_number, write_text
from .rollout_tables import link_next_observations, write_tables
from .rollouts import Node, RolloutLabels, amodal_dtype


@dataclass(frozen=True)
class Chunk:
    """A block of images that waits for compression and writing."""

    camera: str
    """Name of the camera."""
    start: int
    """First frame."""
    count: int
    """Number of frames."""
    size: int
    """Size of the uncompressed images [bytes]."""
    visible_px: np.ndarray
    """Visible pixels of each body, shape (count, B)."""
    amodal_px: np.ndarray
    """Pixels of each body including occluded ones, shape (count, B)."""
    images: Future[dict[str, Any]]
    """The images as they are stored in the file, by name."""


def chunk_frames_of(frames: int) -> int:
    """Return the number of frames in a chunk of a rollout with `frames` frames."""
    return min(CHUNK_FRAMES, frames)


class Demo:
    """One rollout while it is written.

    Args:
        data: The group of all rollouts.
        labels: Everything except its images; it is written at once.
        compression: Compression of its images.
    """

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
            properties = chunked(self._compression, dtype, (chunk_frames_of(count), *shape))
            texts = ARRAYS[f"obs/{{camera}}_{key}"].texts({"camera": name})
            made[key] = new_dataset(self._obs, f"{name}_{key}", dtype, (count, *shape), properties, *texts)
        return made

    def write(self, chunk: Chunk) -> None:
        """Write the images of a chunk."""
        stop = chunk.start + chunk.count
        for key, data in chunk.images.result().items():
            if key == "jpeg":
                self._jpegs[chunk.camera].update(zip(range(chunk.start, stop), data, strict=True))
                continue
            made = self._images[chunk.camera][key]
            made.write_direct_chunk((chunk.start, *(0 for _ in made.shape[1:])), data)
        self._counts[chunk.camera][:, chunk.start : stop] = chunk.visible_px, chunk.amodal_px

    def finish(self) -> None:
        """Write the arrays that need all frames.

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
        for name, values in {"visible_px": visible, "amodal_px": whole, "visible_fraction": fraction}.items():
            put(bodies, f"bodies/{name}", values)

    def _write_jpegs(self, name: str, camera: Camera) -> None:
        files = [data for _, data in sorted(self._jpegs[name].items())]
        rows = np.zeros((len(files), max(map(len, files))), np.uint8)
        for row, data in zip(rows, files, strict=True):
            row[: len(data)] = data
        # not in chunks: a frame is read without its neighbours
        made = put_entry(self._obs, JPEG, rows, in_chunks=False, words={"camera": name})
        write_text(made, b"encoding", "jpeg")
        for key, value in {"quality": JPEG_QUALITY, "height": camera.height, "width": camera.width}.items():
            write_number(made, key, np.int64(value))
