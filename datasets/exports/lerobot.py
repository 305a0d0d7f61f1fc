"""A dataset as a LeRobot v3 dataset: parquet tables, H.264 videos, statistics.

Source of the layout: lerobot 0.4, `datasets/lerobot_dataset.py` (codebase version v3.0). Videos are lossy; the HDF5
file stays the master. Data for which LeRobot has no field (cameras, parameters, the source of an episode) are in
`meta/cgwm.json`.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import UsageError
from ..io.atomic import new_directory
from ..io.progress import progress
from ..rollouts.rollouts import CONVENTION
from . import lerobot_video
from .lerobot_files import (
    FILES_PER_CHUNK,
    FilePlaces,
    require_packages,
    write_frames,
    write_json,
    write_rows,
    write_tasks,
)
from .lerobot_stats import PictureStats, Stats, together, vector_stats
from .lerobot_video import EpisodeVideos
from .selection import Selection

VERSION = "v3.0"
MAX_TABLE_BYTES = 100 << 20
STATE_PARTS = ("px_m py_m pz_m", "qw qx qy qz", "vx_m_s vy_m_s vz_m_s", "wx_rad_s wy_rad_s wz_rad_s")
_COUNTERS = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64"}
_COUNTERS |= {"task_index": "int64"}


def write_lerobot(path: Path, chosen: Selection, task: str | None = None, overwrite: bool = False) -> dict[str, Any]:
    """Write a LeRobot v3 dataset; episode k is the k-th rollout of the selection.

    Features: `observation.state` (for each body: position, quaternion w x y z and velocity in the world's axes, angular
    velocity in the body's), `action`, `observation.images.<camera>`.

    Args:
        path: The directory to write.
        chosen: The dataset, its rollouts, cameras and frames.
        task: Description of the task; the default names the bodies.
        overwrite: Replace what exists.

    Raises:
        InputDataError: If pyarrow or av is not installed.
        UsageError: If an image side is odd, which H.264 does not support.
    """
    require_packages()
    sizes = {name: chosen.camera(0, name, 0) for name in chosen.cameras}
    for name, camera in sizes.items():
        if camera.width % 2 or camera.height % 2:
            raise UsageError(
                f"camera {name} takes {camera.width}x{camera.height} px.",
                "even sides, for the video's colours are stored by blocks of 2x2 px.",
                "synthesize with an even width and height.",
            )
    with new_directory(path, "LeRobot dataset", overwrite) as folder:
        writer = _Writer(folder, chosen, task or f"Predict the motion of {', '.join(chosen.bodies())}.")
        for number in progress(range(len(chosen)), "episodes", len(chosen), "episode"):
            writer.episode(number)
        writer.finish()
    facts = {"episodes": len(chosen), "frames": writer.frames, "fps": float(writer.rate)}
    return {**facts, "video": f"{lerobot_video.CODEC} {lerobot_video.PIXEL_FORMAT} crf {lerobot_video.QUALITY_CRF}"}


class _Writer:
    """Writer of a LeRobot dataset, with the state of the episodes written so far."""

    def __init__(self, folder: Path, chosen: Selection, task: str):
        self.folder, self.chosen, self.task = folder, chosen, task
        self.rate = Fraction(chosen.frame_rate_hz()).limit_denominator(1001)
        self.features = _features(chosen, float(self.rate))
        self.videos = {}
        for name in chosen.cameras:
            height, width, _ = self.features[_image_key(name)]["shape"]
            self.videos[name] = EpisodeVideos(folder, _image_key(name), self.rate, (width, height))
        self.frames = 0
        self.rows: list[dict[str, Any]] = []
        self.stats: list[dict[str, Stats]] = []
        self.sources: list[dict[str, Any]] = []
        self.table = FilePlaces()
        self.waiting: list[dict[str, np.ndarray]] = []

    def episode(self, number: int) -> None:
        """Write the rollout at an index of the selection as the next episode."""
        count = len(self.chosen.frames(number))
        columns = self._columns(number, count)
        stats = {name: vector_stats(values.reshape(count, -1)) for name, values in columns.items()}
        row: dict[str, Any] = {"episode_index": len(self.rows), "tasks": [self.task], "length": count}
        row |= self.table.columns("data")
        row |= {"dataset_from_index": self.frames, "dataset_to_index": self.frames + count}
        for name in self.videos:
            place, stats[_image_key(name)] = self._film(number, name, count)
            row |= place
        row |= {f"stats/{key}/{name}": value for key, found in stats.items() for name, value in found.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self.rows.append(row)
        self.stats.append(stats)
        self.sources.append(self._source(number))
        self.frames += count
        self.waiting.append(columns)
        if sum(values.nbytes for part in self.waiting for values in part.values()) > MAX_TABLE_BYTES:
            self._flush()

    def _columns(self, number: int, count: int) -> dict[str, np.ndarray]:
        """Return the columns of a rollout's table."""
        reader, every = self.chosen.reader, self.chosen.every
        return {
            "observation.state": reader.read(number, "obs/object")[::every].astype(np.float32),
            "action": reader.read(number, "actions")[::every].astype(np.float32),
            "timestamp": (np.arange(count) / float(self.rate)).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, len(self.rows)),
            "index": self.frames + np.arange(count),
            "task_index": np.zeros(count, np.int64),
        }

    def _film(self, number: int, camera: str, count: int) -> tuple[dict[str, Any], Stats]:
        """Add a rollout to the video of a camera; return where it stands there, and the statistics of its pictures."""
        video, pictures = self.videos[camera], PictureStats(count)
        video.begin()
        for picture in self.chosen.pictures(number, camera, labels=False):
            video.add(picture.image)
            pictures.add(picture.image)
        return video.end(), pictures.stats()

    def finish(self) -> None:
        """Write the tables, the statistics and `info.json`."""
        self._flush()
        for video in self.videos.values():
            video.close()
        meta = self.folder / "meta"
        write_rows(meta / "episodes" / "chunk-000" / "file-000.parquet", self.rows)
        write_tasks(meta / "tasks.parquet", [self.task])
        write_json(meta / "stats.json", together(self.stats))
        write_json(meta / "info.json", self._info())
        about = {"convention": CONVENTION, "cameras": list(self.chosen.cameras), "episodes": self.sources}
        write_json(meta / "cgwm.json", about)

    def _flush(self) -> None:
        if self.waiting:
            columns = {name: np.concatenate([part[name] for part in self.waiting]) for name in self.waiting[0]}
            write_frames(self.folder / "data" / self.table.name(".parquet"), columns, self.features)
            self.table.advance()
            self.waiting = []

    def _source(self, number: int) -> dict[str, Any]:
        """Return the data for which LeRobot has no field: source, parameters and cameras of an episode."""
        reader = self.chosen.reader
        cameras = {}
        for name in self.chosen.cameras:
            there = f"cameras/{name}"
            cameras[name] = {key: reader.read(number, f"{there}/{key}") for key in ("K", "dist", "T_world_cam")}
        info = reader.rollouts[number]
        source = {"rollout": info.index, "shard": info.file.name, "splits": self._splits(number)}
        return {**source, "parameters": reader.parameters(number), "cameras": cameras}

    def _splits(self, number: int) -> list[str]:
        info = self.chosen.reader.rollouts[number]
        members = self.chosen.reader.group(number).file["mask"]
        return [name for name in members if info.demo.encode() in members[name][()]]

    def _info(self) -> dict[str, Any]:
        count = len(self.rows)
        return {
            "codebase_version": VERSION,
            "robot_type": "cgwm",
            "total_episodes": count,
            "total_frames": self.frames,
            "total_tasks": 1,
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": MAX_TABLE_BYTES >> 20,
            "video_files_size_in_mb": lerobot_video.MAX_FILE_BYTES >> 20,
            "fps": int(self.rate) if self.rate.denominator == 1 else float(self.rate),
            "splits": {"train": f"0:{count}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": self.features,
        }


def _image_key(camera: str) -> str:
    return f"observation.images.{camera}"


def _features(chosen: Selection, rate_hz: float) -> dict[str, dict[str, Any]]:
    names = [f"{body}.{name}" for body in chosen.bodies() for part in STATE_PARTS for name in part.split()]
    actions = chosen.reader.read(0, "actions", 0, 1).shape[1]
    features: dict[str, dict[str, Any]] = {
        "observation.state": {"dtype": "float32", "shape": [len(names)], "names": names},
        "action": {"dtype": "float32", "shape": [actions], "names": [f"command_{k}" for k in range(actions)]},
    }
    for name in chosen.cameras:
        camera = chosen.camera(0, name, 0)
        video = {"video.height": camera.height, "video.width": camera.width, "video.codec": lerobot_video.CODEC}
        video |= {"video.pix_fmt": lerobot_video.PIXEL_FORMAT, "video.is_depth_map": False, "video.fps": rate_hz}
        video |= {"video.channels": 3, "has_audio": False}
        shape = [camera.height, camera.width, 3]
        names = ["height", "width", "channels"]
        features[_image_key(name)] = {"dtype": "video", "shape": shape, "names": names, "info": video}
    return features | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _COUNTERS.items()}
