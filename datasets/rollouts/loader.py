"""Reading of datasets: random access to rollouts and to windows of frames, as numpy arrays."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ...schemas import InputDataError, UsageError, did_you_mean
from ...schemas.regular_files import require_regular_file
from ..capture.cameras import Camera
from ..io.hdf5_files import hdf5_faults
from ..io.kinds import refuse_other_kind
from .chunks import image_of
from .rollouts import Node, demo_names, demo_of, open_shard


@dataclass(frozen=True)
class RolloutInfo:
    """Location of a rollout."""

    file: Path
    """Shard or index that contains it."""
    demo: str
    """Name of its group."""
    index: int
    """Global index of the rollout."""
    frames: int
    """Number of frames."""


INDEX = "index.h5"
"""Name of the file of virtual datasets that `cgwm merge` writes."""
MOST_FRAMES = 10_000_000
"""Maximum number of frames of a rollout."""
MOST_OPEN = 64
"""Maximum number of shards that a process keeps open; the one opened first is closed for another. Systems allow about a
thousand files, and each open shard has a cache of decoded chunks."""


def shard_files(path: Path) -> list[Path]:
    """Return the files to read of a dataset directory: the index of a merged one, else its shards, by name.

    A `path` that is a file, a shard or an index, is returned itself.
    """
    if os.path.lexists(path) and not path.is_dir():
        return [require_regular_file(path)]
    refuse_other_kind(path, "dataset")
    if os.path.lexists(path / INDEX):
        return [path / INDEX]
    files = sorted(path.glob("rollouts-*-of-*.h5"))
    if not files:
        raise InputDataError(
            f"{path}: no shard (rollouts-<i>-of-<n>.h5) in it.",
            todo="bring them back, or synthesize the dataset again.",
        )
    return files


def camera_of(group: Node) -> Camera:
    """Read a camera from its group in a rollout, `cameras/<name>`."""
    read = {name: np.asarray(item[()]) for name, item in group.items()}
    return Camera(
        width=int(read["width"]),
        height=int(read["height"]),
        K=read["K"],
        distortion=read["dist"],
        T_world_cam=read["T_world_cam"],
    )


class RolloutReader:
    """Random access to the rollouts of a dataset or of one shard.

    Files are opened when they are first read and the handles stay out of pickles, so that an instance can be sent
    to worker processes (fork or spawn).

    Args:
        path: DATASET, or one of its shards.
        split: Only the rollouts of `mask/<split>`, for example ``train``; None for all.
    """

    def __init__(self, path: Path | str, split: str | None = None):
        self.path = Path(path)
        self._files: dict[tuple[int, Path], Node] = {}
        self._checked: set[tuple[Path, str]] = set()
        self.rollouts: list[RolloutInfo] = []
        for file in shard_files(self.path):
            with open_shard(file) as handle, hdf5_faults(file):
                self.rollouts.extend(_list(handle, file, split))
        self.rollouts.sort(key=lambda info: info.index)

    def __len__(self) -> int:
        return len(self.rollouts)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_files": {}}

    def close(self) -> None:
        """Close the files; they open again when they are read."""
        for (process, _), file in self._files.items():
            if process == os.getpid():
                file.close()
        self._files.clear()

    def group(self, number: int) -> Node:
        """Return the HDF5 group of the rollout at index `number` of this reader."""
        info = self.rollouts[number]
        key = (os.getpid(), info.file)  # a handle that a fork inherits is not safe to use
        if key not in self._files:
            mine = [other for other in self._files if other[0] == key[0]]
            if len(mine) >= MOST_OPEN:
                self._files.pop(mine[0]).close()
            self._files[key] = open_shard(info.file)
        if (info.file, info.demo) not in self._checked:
            demo_of(self._files[key], info.demo)
            self._checked.add((info.file, info.demo))
        return self._files[key]["data"][info.demo]

    def keys(self, number: int = 0) -> list[str]:
        """Return the names of all arrays of a rollout, for example ``obs/view0_image`` or ``bodies/pos``."""
        names: list[str] = []
        self.group(number).visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        return [name for name in names if not name.startswith("next_obs/")]

    def cameras(self, number: int = 0) -> list[str]:
        """Return the names of the cameras of a rollout."""
        group = self.group(number)
        return sorted(group["cameras"]) if "cameras" in group else []

    def camera(self, number: int, name: str) -> Camera:
        """Return a camera of a rollout, with its pose."""
        return camera_of(self.group(number)["cameras"][name])

    def parameters(self, number: int) -> dict[str, float]:
        """Return the physical parameters of a rollout, in the unit that their attribute states."""
        return {name: float(item[()]) for name, item in self.group(number)["parameters"].items()}

    def read(self, number: int, key: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return an array of a rollout, with its first axis (usually frames) restricted to `start:stop`."""
        group = self.group(number)
        try:
            data = group[key]
        except KeyError:
            names = self.keys(number)
            raise UsageError(
                f"rollout {number} has no array '{key}'.{did_you_mean(key, names)}",
                ", ".join(names),
                "name one of these arrays.",
            ) from None
        with hdf5_faults(self.rollouts[number].file):
            if data.attrs.get("encoding") == "jpeg":
                size = int(data.attrs["height"]), int(data.attrs["width"])
                where = f"{self.rollouts[number].file}: {self.rollouts[number].demo}/{key}"
                return np.stack([image_of(row, size, where) for row in data[start:stop]])
            return data[start:stop] if data.ndim else data[()]

    def contacts(self, number: int, frame: int) -> dict[str, np.ndarray]:
        """Return the contacts of one frame: its rows of the arrays of the group `contacts`, except `offsets`."""
        group = self.group(number)["contacts"]
        first, last = group["offsets"][frame : frame + 2]
        return {name: item[first:last] for name, item in group.items() if name != "offsets"}

    def window(
        self, number: int, start: int, length: int, keys: Iterable[str], every: int = 1
    ) -> dict[str, np.ndarray]:
        """Return `length` frames of arrays with a time axis: successive ones, or every `every`-th."""
        frames, stop = self.rollouts[number].frames, start + (length - 1) * every + 1
        if start < 0 or length < 1 or every < 1 or stop > frames:
            raise UsageError(
                f"frames {start} to {stop} of rollout {number}, which has {frames}.",
                f"length and every of 1 or more, and a window within the frames 0 to {frames - 1}.",
                "choose frames inside of the rollout.",
            )
        return {key: self.read(number, key, start, stop)[::every] for key in keys}


class RolloutDataset:
    """Windows of frames, as a map-style dataset: `torch.utils.data.DataLoader` takes it as it is, with workers or not.

    An item is a dictionary of numpy arrays: the windows of `keys`, and for each camera named in them `<camera>_K`
    (3, 3) and `<camera>_T_world_cam` (4, 4); `rollout` (global index) and `start` (first frame).

    Args:
        path: DATASET or a shard.
        length: Frames in a window.
        stride: Frames from one window's start to the next; default: windows do not overlap.
        keys: Arrays with a time axis; `{camera}` in a name stands for each of `cameras`. Default: the bodies' poses
            and every camera's image.
        split: ``train``, ``valid`` or all.
        cameras: Names of the cameras to read; default: all of the first rollout.
        every: Frames of the recording from one frame of a window to the next.

    Raises:
        UsageError: If the dataset has no such key, camera or split, or a number is not positive.
    """

    def __init__(
        self,
        path: Path | str,
        length: int = 8,
        stride: int | None = None,
        keys: Iterable[str] | None = None,
        split: str | None = None,
        cameras: Iterable[str] | None = None,
        every: int = 1,
    ):
        span, step = (length - 1) * every + 1, stride or length * every
        if min(length, every, step) < 1:
            raise UsageError(
                f"length {length}, stride {stride}, every {every}.", "1 or more.", "pass positive numbers."
            )
        self.reader = RolloutReader(path, split)
        self.length, self.every = length, every
        self.windows = [
            (number, start)
            for number, info in enumerate(self.reader.rollouts)
            for start in range(0, info.frames - span + 1, step)
        ]
        self.cameras, self.keys = self._chosen(cameras, keys)
        self.reader.close()

    def _chosen(self, cameras: Iterable[str] | None, keys: Iterable[str] | None) -> tuple[list[str], list[str]]:
        """Return the cameras to read and the names of the arrays."""
        there = self.reader.cameras() if len(self.reader) else []
        names = there if cameras is None else list(cameras)
        _require_cameras(names, there)
        wanted = ["bodies/pos", "bodies/quat_wxyz", "obs/{camera}_image"] if keys is None else keys
        every = [name for key in wanted for name in _of_cameras(key, names)]
        for key in every if len(self.reader) else []:  # before workers start
            self.reader.read(0, key, 0, 1)
            _require_frames(key, str(self.reader.group(0)[key].attrs["shape_meaning"]))
        shown = [name for name in there if any(key.startswith(f"obs/{name}_") for key in every)]
        return shown, every

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> dict[str, Any]:
        number, start = self.windows[index]
        item: dict[str, Any] = self.reader.window(number, start, self.length, self.keys, self.every)
        for name in self.cameras:
            for field in ("K", "T_world_cam"):
                item[f"{name}_{field}"] = self.reader.read(number, f"cameras/{name}/{field}")
        item["rollout"] = np.int64(self.reader.rollouts[number].index)
        item["start"] = np.int64(start)
        return item


def _of_cameras(key: str, cameras: Sequence[str]) -> list[str]:
    """Return the arrays that a key names: for "{camera}" one of each camera."""
    return [key.replace("{camera}", name) for name in cameras] if "{camera}" in key else [key]


def _list(handle: Node, file: Path, split: str | None) -> Iterable[RolloutInfo]:
    names = demo_names(handle)
    if split is not None:
        splits = list(handle["mask"])
        if split not in splits:
            raise UsageError(f"{file} has no split '{split}'.", ", ".join(splits), "name one of these splits.")
        members = {name.decode() for name in handle["mask"][split][()]}
        names = [name for name in names if name in members]
    for name in names:
        demo = handle["data"][name]
        frames = int(demo.attrs["num_samples"])
        if not 0 <= frames <= MOST_FRAMES:
            raise InputDataError(
                f"{file}: data/{name}: num_samples is {frames}.", f"0 to {MOST_FRAMES}.", "write the dataset again."
            )
        yield RolloutInfo(file, name, int(demo.attrs["episode_index"]), frames)


def _require_cameras(names: Iterable[str], there: Sequence[str]) -> None:
    for name in set(names) - set(there):
        raise UsageError(
            f"no camera '{name}'.{did_you_mean(name, there)}",
            ", ".join(there) or "none.",
            "name one of these cameras.",
        )


def _require_frames(key: str, axes: str) -> None:
    """Refuse an array without an axis of time."""
    if not axes.startswith("(T,"):
        raise UsageError(
            f"'{key}' has the axes {axes}, so it has no windows of frames.",
            "arrays whose first axis is the time.",
            "read it by itself: dataset.reader.read(...), or dataset.reader.contacts(...).",
        )
