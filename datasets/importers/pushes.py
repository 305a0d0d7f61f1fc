"""Import of planar pushes by a robot's finger, with measured forces: those of MLab_EXP, and of the MIT push dataset.

MLab_EXP (robinzhoucmu/MLab_EXP, PushExp/sensor_log; Apache-2.0): text with the number of pushes and, for each, pose of
the object before and after (x y z [mm], quaternion w first), number of force samples, rows (time [s], fx, fy [N]),
number of finger samples, rows (time, x, y, z, quaternion). The object is an aluminium triangle whose frame lies at the
right-angled corner. The sensor turns with the finger, and its readings are left-handed: the force on the object is
R(finger) Rz(-135 deg) (fx, -fy) after subtraction of the first sample. How it was mounted was found from the forces
that quasi-static Coulomb friction asks for in 300 pushes: they differ by 2.9 deg (median; 2.3 to 3.9 in each of the six
files), without the reflection by 40 deg.

MIT push (Yu et al., "More than a million ways to be pushed", IROS 2016): .json or .h5 with `tip_pose` and `object_pose`
(time [s], x, y [m], angle [rad]) and `ft_wrench` (time, fx, fy [N], torque), in one frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ...schemas import Body, Ground, InputDataError, World, did_you_mean
from ...schemas.documents import parse_json
from ...schemas.imports import ImportResult
from ..capture.files import entries_of, require_regular_file
from ..capture.tracks import Track
from ..io.atomic import new_directory
from ..io.cells import shown
from ..io.hdf5_files import hdf5_faults, open_hdf5, require_stored
from ..io.outputs import reads
from ..shapes.interpolation import by_column
from .archives import ENDINGS, unpacked
from .recordings import (
    Recording,
    Units,
    drawn_splits,
    episode_names,
    from_zero,
    read_text,
    track_files,
    write_recordings,
)

Array = NDArray[np.float64]

OBJECT, FINGER = "object", "finger"
MASS_KG, COM_M = 1.518, (0.05, 0.05, 0.0)
"""Mass and centre of MLab's triangle."""
SENSOR_RAD = math.radians(-135.0)
"""Angle by which MLab's force sensor is turned in the finger, with the sign of the force on the object."""
_MOST_ROWS = 10_000_000
_KEYS = {"tip_pose": "time, x, y, angle", "object_pose": "time, x, y, angle", "ft_wrench": "time, fx, fy, torque"}
_TODO = "get PushExp/sensor_log of github.com/robinzhoucmu/MLab_EXP, or the data of mcube.mit.edu/push-dataset."


@dataclass(frozen=True)
class Push:
    """One push in SI units; F samples of the force, K of the finger, T of the object."""

    object_track: Track
    """Poses of the object, at least its first and its last."""
    finger_track: Track
    """Poses of the finger, with the force that it exerts on the object."""


@reads("source")
def import_pushes(
    source: Path | str,
    out: Path | str,
    only: str | None = None,
    n_train: int | None = None,
    n_test: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> ImportResult:
    """Write pushes as a capture: a free object, a driven finger with its force, and one group for each file.

    Shapes, materials and, for MIT push, the mass are not in the files; the user adds them to the manifest.

    Args:
        source: A .txt (MLab), .json or .h5 (MIT) file, a folder of them, a folder of such folders, or a .tar (.gz, .xz)
            of one.
        out: The capture directory to write.
        only: Name of one file without its ending.
        n_train: Number of pushes to fit on; None: 60 %.
        n_test: Number of pushes to test on; None: the others.
        seed: Seed of the permutation within each file.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the source is not such data.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory, _opened(Path(source)) as root:
        files = _chosen(_files(root), only)
        recordings, mlab = [], all(path.suffix.lower() == ".txt" for path in files)
        for path, group in zip(files, episode_names([_group(root, path) for path in files]), strict=True):
            for number, push in enumerate(read_pushes(path)):
                tracks = from_zero({OBJECT: push.object_track, FINGER: push.finger_track})
                recordings.append(Recording(name=f"{group}-{number:02d}", tracks=tracks, group=group))
        thing = Body(name=OBJECT, mass_kg=MASS_KG, com_m=COM_M) if mlab else Body(name=OBJECT)
        splits = drawn_splits(recordings, n_train, n_test, seed)
        bodies = (thing, Body(name=FINGER, motion="driven"))
        result = write_recordings(directory, out, World(ground=Ground()), bodies, recordings, splits)
    said = "the files have no shapes, materials and heights of the ground: add them to capture.toml before a fit."
    if mlab:
        said += (
            " The object has a pose before and one after each push alone, which 'cgwm fit' does not take: "
            "benchmarks/pushes.py fits friction and face_exponent to them."
        )
    return result.model_copy(update={"warnings": (*result.warnings, said)})


def read_pushes(path: Path) -> list[Push]:
    """Read the pushes of one file.

    Raises:
        InputDataError: If it is not such data.
    """
    return _READERS[path.suffix.lower()](path)


@contextmanager
def _opened(source: Path) -> Iterator[Path]:
    """Yield the source, of an archive the folder in it."""
    if not source.name.lower().endswith(ENDINGS):
        yield source
        return
    with unpacked(source, tuple(_READERS)) as folder:
        if not any(folder.iterdir()):
            raise InputDataError(f"{source}: no pushes in it.", f"files that end in {', '.join(_READERS)}.", _TODO)
        yield folder


def _files(source: Path) -> list[Path]:
    """Return the files of a source; of a folder without any, those of its folders: MLab has one for each support."""
    inner = [path for path in entries_of(source) if path.is_dir()] if source.is_dir() else []
    found = [path for folder in inner for path in _readable(entries_of(folder))]
    if not found or _readable(entries_of(source)):
        return track_files(source, tuple(_READERS))
    return [require_regular_file(path) for path in found]


def _readable(files: Iterable[Path]) -> list[Path]:
    return [path for path in files if path.suffix.lower() in _READERS]


def _group(source: Path, file: Path) -> str:
    """Return the name of a file's group: that of the file, after that of the folder within the source."""
    return file.stem if file.parent in (source, source.parent) else f"{file.parent.name}_{file.stem}"


def _chosen(files: list[Path], only: str | None) -> list[Path]:
    readable = _readable(files)
    if not readable:
        raise InputDataError(f"{files[0]}: no pushes by its ending.", f"{', '.join(_READERS)}.", _TODO)
    chosen = [path for path in readable if only in (None, path.stem)]
    if not chosen:
        stems = sorted({path.stem for path in readable})
        raise InputDataError(
            f"--only {only}: no file of this name.",
            f"{', '.join(stems[:8])}.{did_you_mean(only or '', stems)}",
            "name one of these, or leave --only out.",
        )
    return chosen


def _read_text(path: Path) -> list[Push]:
    """Read a file of MLab_EXP."""
    numbers = _Numbers.of(path)
    count = numbers.count("pushes")
    pushes = [_mlab_push(f"{path}: push {k}", numbers) for k in range(count)]
    numbers.require_end()
    if not pushes:
        raise InputDataError(f"{path}: no pushes.", "at least one.", _TODO)
    return pushes


class _Numbers:
    """The numbers of a text, read one after another."""

    def __init__(self, path: Path, values: Array) -> None:
        self._path, self._values, self._at = path, values, 0

    @staticmethod
    def of(path: Path) -> _Numbers:
        values = []
        for number, line in enumerate(read_text(path).splitlines(), 1):
            for cell in line.split():
                try:
                    value = float(cell)
                except ValueError:
                    value = math.nan
                if not math.isfinite(value):
                    raise InputDataError(f"{path}, line {number}: {shown(cell)} is no number.", "numbers alone.", _TODO)
                values.append(value)
        return _Numbers(path, np.array(values, np.float64))

    def count(self, what: str) -> int:
        """Read how many of something follow."""
        value = float(self.rows(1, 1, f"the number of {what}")[0, 0])
        if not (value == int(value) and 0 <= value <= _MOST_ROWS):
            raise InputDataError(
                f"{self._path}: {value:g} as the number of {what}.", f"a whole number up to {_MOST_ROWS}.", _TODO
            )
        return int(value)

    def rows(self, count: int, width: int, what: str) -> Array:
        """Read rows (count, width)."""
        end = self._at + count * width
        if end > len(self._values):
            raise InputDataError(
                f"{self._path}: the file ends within {what}, {len(self._values) - self._at} numbers are left of "
                f"{count * width}.",
                "a complete file.",
                _TODO,
            )
        found = self._values[self._at : end].reshape(count, width)
        self._at = end
        return found

    def require_end(self) -> None:
        left = len(self._values) - self._at
        if left:
            raise InputDataError(f"{self._path}: {left} numbers follow the last push.", "none.", _TODO)


def _mlab_push(where: str, numbers: _Numbers) -> Push:
    poses = numbers.rows(2, 7, f"{where.rpartition(': ')[2]}: the poses of the object")
    force = numbers.rows(numbers.count("force samples"), 3, "forces")
    finger = numbers.rows(numbers.count("finger samples"), 8, "poses of the finger")
    if not len(force):
        raise InputDataError(f"{where}: no force samples.", "at least one.", _TODO)
    units = Units("mm", "s")
    on_object = _turned(finger[:, 4:8], _at_times(finger[:, 0], force) - force[0, 1:])
    track = units.track(f"{where}: finger", finger[:, 0], finger[:, 1:4], finger[:, 4:8], force_n=on_object)
    ends = np.array([finger[0, 0], finger[-1, 0]])
    return Push(units.track(f"{where}: object", ends, poses[:, :3], poses[:, 3:]), track)


def _at_times(time: Array, samples: Array) -> Array:
    """Return forces (K, 2) at times (K,), linear between samples (F, 3)."""
    order = np.argsort(samples[:, 0], kind="stable")
    return by_column(time, samples[order, 0], samples[order, 1:3])


def _turned(quat_wxyz: Array, force: Array) -> Array:
    """Return the force on the object, world frame (K, 3) [N], of readings (K, 2) in the sensor's left-handed axes."""
    angle = 2 * np.arctan2(quat_wxyz[:, 3], quat_wxyz[:, 0]) + SENSOR_RAD
    x, y = force[:, 0], -force[:, 1]
    return np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, 0 * x], 1)


def _read_json(path: Path) -> list[Push]:
    data = parse_json(read_text(path), path)
    if not isinstance(data, dict):
        raise InputDataError(f"{path}: no table of keys.", ", ".join(_KEYS) + ".", _TODO)
    return [_mit_push(path, data, lambda value: np.array(value, np.float64))]


def _read_hdf5(path: Path) -> list[Push]:
    with open_hdf5(path) as file, hdf5_faults(path):
        for key in _KEYS:
            item = file.get(key)
            if isinstance(item, h5py.Dataset):
                require_stored(item, f"{path}: {key}")
        return [_mit_push(path, file, lambda item: np.asarray(item[()], np.float64))]


def _mit_push(path: Path, data: Mapping[str, Any], load: Callable[[Any], Array]) -> Push:
    tip, thing, wrench = (_table(path, data, key, load) for key in _KEYS)
    units = Units("m", "s")
    force = np.pad(_at_times(tip[:, 0], wrench[:, :3]), ((0, 0), (0, 1)))
    finger = units.track(f"{path}: tip_pose", tip[:, 0], *_planar(tip), force_n=force)
    return Push(units.track(f"{path}: object_pose", thing[:, 0], *_planar(thing)), finger)


def _table(path: Path, data: Mapping[str, Any], key: str, load: Callable[[Any], Array]) -> Array:
    """Return the distinct rows (T, 4) of a key, by time."""
    if key not in data:
        raise InputDataError(f"{path}: no '{key}'.", ", ".join(_KEYS) + ".", _TODO)
    try:
        rows = load(data[key])
    except (TypeError, ValueError):
        rows = np.zeros((0, 0))
    if rows.ndim != 2 or rows.shape[1] != 4 or not len(rows) or len(rows) > _MOST_ROWS or not np.isfinite(rows).all():
        raise InputDataError(f"{path}: '{key}' is {rows.shape}.", f"rows of four finite numbers: {_KEYS[key]}.", _TODO)
    return rows[np.unique(rows[:, 0], return_index=True)[1]]


def _planar(rows: Array) -> tuple[Array, Array]:
    """Return positions (T, 3) and quaternions (T, 4) of planar poses (T, 4)."""
    zero, half = 0 * rows[:, 0], 0.5 * rows[:, 3]
    return np.stack([rows[:, 1], rows[:, 2], zero], 1), np.stack([np.cos(half), zero, zero, np.sin(half)], 1)


_READERS: dict[str, Callable[[Path], list[Push]]] = {
    ".txt": _read_text, ".json": _read_json, ".h5": _read_hdf5, ".hdf5": _read_hdf5,
}  # fmt: skip
