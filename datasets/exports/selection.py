"""Selection of the rollouts, cameras and frames of a dataset to export, with chunk-wise reading of their images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError, UsageError, did_you_mean
from ...schemas.printable import typed_path
from ..capture.cameras import Camera
from ..rollouts.dataset import missing_count, read_manifest
from ..rollouts.loader import RolloutReader

READ_FRAMES = 8
"""Number of frames read at a time: a chunk, which is decoded as a whole."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One frame of one camera."""

    frame: int
    """Index of the frame in the rollout."""
    image: NDArray[np.uint8]
    """Colour image, uint8 RGB, shape (H, W, 3)."""
    depth_m: NDArray[np.float32]
    """Depth along the optical axis [m], float32, 0 = no surface, shape (H, W)."""
    mask: NDArray[np.uint8]
    """Visible instances, uint8: 0 background, k the k-th body, shape (H, W)."""
    amodal: NDArray[np.bool_] | None
    """Amodal masks, bool, shape (B, H, W); None if the dataset has none."""


class Selection:
    """Rollouts, cameras and frames of a dataset.

    Args:
        path: DATASET.
        split: Only the rollouts of `mask/<split>`; by default all.
        cameras: Names of the cameras; by default all.
        every: Step between exported frames, beginning with the first.

    Raises:
        InputDataError: If `path` is not a dataset, or has no images.
        UsageError: If there is no such split or camera.
    """

    def __init__(self, path: Path, split: str | None = None, cameras: tuple[str, ...] | None = None, every: int = 1):
        self.path = path
        self.manifest = read_manifest(path)
        self.reader = RolloutReader(path, split)
        if len(self.reader) == 0:
            raise InputDataError(
                f"{path}: no rollout{f' in the split {split!r}' if split else ''}.",
                todo="leave --split out, or name another." if split else "synthesize it again.",
            )
        if every < 1:
            raise UsageError(f"--every {every}: no step from frame to frame.", "1 or more.", "pass a positive number.")
        self.every = every
        there = self.reader.cameras()
        _require_cameras(path, there, cameras or ())
        self.cameras = tuple(cameras or there)

    def __len__(self) -> int:
        return len(self.reader)

    @property
    def notes(self) -> list[str]:
        """Return notes on what the dataset itself lacks."""
        lacking = missing_count(self.manifest)
        return [f"the dataset lacks {lacking} of {self.manifest.shard_count} shards"] if lacking else []

    def frames(self, number: int) -> range:
        """Return the exported frames of the rollout at index `number`."""
        return range(0, self.reader.rollouts[number].frames, self.every)

    def frame_rate_hz(self, number: int = 0) -> float:
        """Return the exported frames per second.

        Raises:
            InputDataError: If they are not evenly spaced.
        """
        steps = np.diff(self.reader.read(number, "time"))
        step = float(np.median(steps))
        if np.abs(steps - step).max() > 1e-6 * max(1.0, step):
            raise InputDataError(
                f"{self.path}: the frames of rollout {number} are not evenly spaced in time.",
                "one frame rate in a rollout, which the format needs.",
                f"'cgwm validate {typed_path(self.path)}' shows more; synthesize it again.",
            )
        return 1 / (step * self.every)

    def bodies(self, number: int = 0) -> list[str]:
        """Return the names of the bodies; body k has the value k + 1 in the masks."""
        return [name.decode() for name in self.reader.read(number, "bodies/names")]

    def camera(self, number: int, name: str, frame: int) -> Camera:
        """Return a camera at a frame."""
        there = f"cameras/{name}"
        pose = self.reader.read(number, f"{there}/T_world_cam")
        return Camera(
            width=int(self.reader.read(number, f"{there}/width")),
            height=int(self.reader.read(number, f"{there}/height")),
            K=self.reader.read(number, f"{there}/K"),
            distortion=self.reader.read(number, f"{there}/dist"),
            T_world_cam=pose if pose.ndim == 2 else pose[frame],
        )

    def pictures(self, number: int, camera: str, labels: bool = True) -> Iterator[Picture]:
        """Yield the exported frames of a camera, reading a chunk at a time.

        Args:
            number: Index of the rollout in `reader`.
            camera: The camera.
            labels: Whether to read depth and masks; otherwise they are empty.
        """
        keys = [f"obs/{camera}_image"] + ([f"obs/{camera}_depth", f"obs/{camera}_mask"] if labels else [])
        frames, last = self.frames(number), self.reader.rollouts[number].frames
        for start in range(0, last, READ_FRAMES):
            wanted = [frame for frame in range(start, min(start + READ_FRAMES, last)) if frame in frames]
            if not wanted:
                continue
            block = self.reader.window(number, start, min(READ_FRAMES, last - start), keys)
            amodal = self._amodal(number, camera, start, min(start + READ_FRAMES, last)) if labels else None
            for frame in wanted:
                seen = [block[key][frame - start] for key in keys]
                yield _picture(frame, seen, None if amodal is None else amodal[frame - start])

    def _amodal(self, number: int, camera: str, start: int, stop: int) -> NDArray[np.bool_] | None:
        """Return the amodal masks of a chunk, shape (n, B, H, W); bit k of a pixel belongs to body k."""
        key = f"obs/{camera}_amodal"
        if key not in self.reader.group(number):
            return None
        bits = self.reader.read(number, key, start, stop)
        return np.stack([(bits >> body) & 1 for body in range(len(self.bodies(number)))], axis=1).astype(bool)


def _require_cameras(path: Path, there: Sequence[str], wanted: Sequence[str]) -> None:
    """Refuse a dataset without images, and cameras that it does not have."""
    if not there:
        raise InputDataError(
            f"{path}: this dataset has states and no images.",
            "a dataset whose model has visual spheres.",
            "fit the model to photos, and synthesize again.",
        )
    for name in wanted:
        if name not in there:
            raise UsageError(
                f"{path} has no camera '{name}'.{did_you_mean(name, there)}",
                ", ".join(there),
                "name one of these with --cameras.",
            )


def _picture(frame: int, seen: Sequence[NDArray[Any]], amodal: NDArray[np.bool_] | None) -> Picture:
    """Return a frame with its image, and depth and mask where these were read, too."""
    image, *others = seen
    depth, mask = others or (np.zeros((0, 0), np.float32), np.zeros((0, 0), np.uint8))
    return Picture(frame=frame, image=image, depth_m=depth, mask=mask, amodal=amodal)
