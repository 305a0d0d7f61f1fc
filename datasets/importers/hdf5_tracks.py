"""Import of poses from HDF5, where every group with times and positions is an episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError, did_you_mean
from ...schemas.imports import ImportResult
from ..capture.tracks import Track
from ..io.atomic import new_directory
from ..io.hdf5_files import hdf5_faults, open_hdf5, own_objects, require_stored
from ..io.outputs import reads
from .recordings import SI, Units, require_name, track_files, write_tracks

Array = NDArray[np.float64]

SETS = ("time", "position", "quat_wxyz", "quat_xyzw")
"""Quantities that a dataset may contain; at most one of the two orientations."""
_NAMES = {
    "time": ("time", "time_s", "t", "timestamp", "timestamps"),
    "position": ("position", "position_m", "positions", "pos", "translation", "p"),
    "quat_wxyz": ("quat_wxyz", "quaternion_wxyz"),
    "quat_xyzw": ("quat_xyzw", "quaternion_xyzw"),
}
MOST_ROWS = 10_000_000
"""Maximum number of samples of an episode: nearly three hours at 1 kHz."""
_WIDTHS = {"time": (), "position": (3,), "quat_wxyz": (4,), "quat_xyzw": (4,)}


@reads("source")
def import_hdf5(
    source: Path | str,
    out: Path | str,
    columns: Mapping[str, str] | None = None,
    units: Units = SI,
    body: str = "body",
    up: Literal["z", "y"] = "z",
    n_train: int | None = None,
    n_test: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> ImportResult:
    """Write poses as a capture; the user adds shape, mass and ground to its manifest.

    An episode is a group with a dataset of times (T,), one of positions (T, 3), and optionally one of quaternions
    (T, 4), whose name must contain their order. Each episode's times begin at zero.

    Args:
        source: A file, or a folder of .h5 and .hdf5 files.
        out: The capture directory to write.
        columns: Name in a group (or path, such as `obs/pos`) of any of `SETS` that has another name.
        units: Units of the numbers, if other than metres and seconds.
        body: Name of the body.
        up: Axis that points up; gravity is set opposite to it, and the coordinates are kept.
        n_train: Number of episodes to fit on; None: 60 %.
        n_test: Number of episodes to test on; None: the others.
        seed: Seed of the permutation.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If a file has no such groups, or its numbers cannot be seconds and metres.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        _require_sets(columns or {})
        require_name(body, "--body")
        files = track_files(Path(source), (".h5", ".hdf5"))
        found = [(path, name, track) for path in files for name, track in _episodes(path, columns or {}, units)]
        several = len(files) > 1
        stems = [f"{path.stem}-{name}" if several else name for path, name, _ in found]
        tracks = ({body: track} for _, _, track in found)
        return write_tracks(directory, out, stems, tracks, up, (n_train, n_test, seed))


def _require_sets(columns: Mapping[str, str]) -> None:
    """Refuse names given for what no set can be."""
    for name in columns:
        if name not in SETS:
            raise InputDataError(
                f"--columns: '{name}' is nothing that a set can be.",
                f"{', '.join(SETS)}.{did_you_mean(name, SETS)}",
                "correct the name before the =.",
            )


def _episodes(path: Path, columns: Mapping[str, str], units: Units) -> list[tuple[str, Track]]:
    tracks: list[tuple[str, Track]] = []
    seen: list[str] = []
    with open_hdf5(path) as file, hdf5_faults(path):
        groups: list[h5py.Group] = [file]
        for name, item in own_objects(file, f"{path}: "):
            groups.append(item) if isinstance(item, h5py.Group) else seen.append(name)
        for group in groups:
            if (track := _track(path, group, columns, units)) is not None:
                tracks.append((str(group.name).strip("/").replace("/", "-") or path.stem, track))
    if not tracks:
        raise _no_tracks(path, seen)
    return tracks


def _no_tracks(path: Path, seen: Sequence[str]) -> InputDataError:
    """Return the error of a file without tracks, in which these sets were seen."""
    shown = ", ".join(seen[:8]) + (", ..." if len(seen) > 8 else "")
    return InputDataError(
        f"{path}: no group with times and positions; there are {shown or 'no sets'}.",
        "groups with 'time' (T,), 'position' (T, 3) and, where measured, 'quat_wxyz' or 'quat_xyzw' (T, 4).",
        "name them: --columns time=NAME,position=NAME,quat_wxyz=NAME.",
    )


def _track(path: Path, group: h5py.Group, columns: Mapping[str, str], units: Units) -> Track | None:
    """Return the track of a group; None of one without times or positions."""
    found = {key: _found(group, key, columns) for key in SETS}
    if found["time"] is None or found["position"] is None:
        return None
    sets = {key: None if item is None else _numbers(path, item, key) for key, item in found.items()}
    assert sets["time"] is not None and sets["position"] is not None  # looked at above
    where = f"{path}: {group.name}"
    quat = _orientation(where, group, sets["quat_wxyz"], sets["quat_xyzw"])
    return units.track(where, sets["time"], sets["position"], quat)


def _found(group: h5py.Group, key: str, columns: Mapping[str, str]) -> h5py.Dataset | None:
    """Return the dataset with the quantity `key`, or None."""
    for name in (columns[key],) if key in columns else _NAMES[key]:
        item = group.get(name)
        if isinstance(item, h5py.Dataset):
            return item
    return None


def _numbers(path: Path, item: h5py.Dataset, key: str) -> Array:
    """Return the numbers of a dataset, after a look at what it declares."""
    where, width = f"{path}: {item.name}", _WIDTHS[key]
    wanted = "(T, " + ", ".join(map(str, width)) + ")" if width else "(T,)"
    if item.dtype.kind not in "fiu" or item.shape is None or item.ndim != 1 + len(width) or item.shape[1:] != width:
        raise InputDataError(
            f"{where} has the shape {item.shape} and the type {item.dtype}.",
            f"numbers, {wanted}.",
            "name the right set with --columns, or write it in this form.",
        )
    if len(item) > MOST_ROWS:
        raise InputDataError(f"{where} declares {len(item)} rows.", f"up to {MOST_ROWS} rows.", "split the recording.")
    require_stored(item, where)
    return np.asarray(item, np.float64)


def _orientation(where: str, group: h5py.Group, wxyz: Array | None, xyzw: Array | None) -> Array | None:
    if wxyz is not None and xyzw is not None:
        raise InputDataError(
            f"{where}: quaternions in both orders.", "one set of them.", "name the one to use with --columns."
        )
    unsaid = [name for name in ("quat", "quaternion", "orientation", "rotation") if name in group]
    if wxyz is None and xyzw is None and unsaid:
        raise InputDataError(
            f"{where}: '{unsaid[0]}' does not say whether w comes first.",
            "quat_wxyz or quat_xyzw.",
            f"add --columns quat_wxyz={unsaid[0]} or quat_xyzw={unsaid[0]}.",
        )
    return wxyz if xyzw is None else xyzw[:, [3, 0, 1, 2]]
