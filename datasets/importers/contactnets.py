"""Import of the cube tosses of ContactNets (DAIRLab/contact-nets): the published .pt files, or one .npz of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import Body, BoxShape, CaptureManifest, Ground, InputDataError, Shape, World
from ...schemas.imports import ImportResult
from ..capture.files import entries_of
from ..capture.manifest import write_manifest
from ..capture.tracks import Track, tracks_csv
from ..io.arrays import read_npz
from ..io.atomic import new_directory
from ..io.outputs import reads
from ..io.progress import note, progress
from .tensors import read_tensor

Array = NDArray[np.float64]

HALF_WIDTH_M = 0.0524
"""Half the cube's edge [m]; positions and velocities in the .pt files are divided by it."""
RATE_HZ = 148.0
"""Rate of the tracking [Hz]."""
MASS_KG = 0.37
INERTIA_KG_M2 = 0.00081
BODY = "cube"

_COLUMNS = 19
_POSITION, _QUATERNION, _VELOCITY, _OMEGA = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)
_NPZ_FIELDS = ("offsets", "pos", "quat_wxyz", "vel", "omega_body", "toss_index", "rate_hz", "half_width_m")


@dataclass(frozen=True)
class _Tosses:
    """Tosses of a cube, in SI units."""

    tracks: dict[int, Track]
    """Tracks of the cube by number of the toss."""
    half_width_m: float
    """Half the edge of the cube [m]."""


@reads("source")
def import_contactnets(
    source: Path | str,
    out: Path | str,
    n_train: int = 50,
    n_test: int = 100,
    seed: int = 0,
    overwrite: bool = False,
) -> ImportResult:
    """Write the tosses as a capture with tracks, one episode per toss, named by its number.

    The tosses, sorted by number, are permuted with `numpy.random.default_rng(seed)`; the first `n_train` are the
    split "train", the next `n_test` are "test". If there are fewer than both together, the first third is "train" and
    the rest is "test".

    Args:
        source: A directory of <number>.pt files, or the .npz, or a directory that contains one of the two.
        out: The capture directory to write.
        n_train: Number of tosses to fit on.
        n_test: Number of tosses to test on.
        seed: Seed of the permutation.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the source is not such data.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        tosses = _read(Path(source))
        names = [f"{number:03d}" for number in sorted(tosses.tracks)]
        if len(names) < n_train + n_test:
            note(f"only {len(names)} tosses, {n_train + n_test} were asked for: a third is 'train', the rest 'test'")
        manifest = _manifest(tosses.half_width_m, _splits(names, n_train, n_test, seed))
        write_manifest(directory / "capture.toml", manifest)
        (directory / "tracks").mkdir()
        for number, track in progress(sorted(tosses.tracks.items()), "tosses", unit="toss"):
            (directory / "tracks" / f"{number:03d}.csv").write_text(tracks_csv({BODY: track}), encoding="utf-8")
    return ImportResult(
        capture=str(out),
        episodes=len(tosses.tracks),
        samples=sum(len(track) for track in tosses.tracks.values()),
        splits={name: len(episodes) for name, episodes in manifest.splits.items()},
    )


def _manifest(half_width_m: float, splits: dict[str, tuple[str, ...]]) -> CaptureManifest:
    cube = Body(
        name=BODY,
        mass_kg=MASS_KG,
        inertia_kg_m2=(INERTIA_KG_M2, INERTIA_KG_M2, INERTIA_KG_M2),
        com_m=(0.0, 0.0, 0.0),
        shape=Shape(box=BoxShape(half_extents_m=(half_width_m, half_width_m, half_width_m))),
    )
    return CaptureManifest(format="cgwm-capture/1", world=World(ground=Ground()), bodies=(cube,), splits=splits)


def _splits(names: list[str], n_train: int, n_test: int, seed: int) -> dict[str, tuple[str, ...]]:
    order = [names[k] for k in np.random.default_rng(seed).permutation(len(names))]
    if len(order) < n_train + n_test:
        n_train, n_test = len(order) // 3, len(order) - len(order) // 3
    return {"train": tuple(order[:n_train]), "test": tuple(order[n_train : n_train + n_test])}


def _read(source: Path) -> _Tosses:
    """Find the data: the .pt files in `source`, else an .npz, else the .pt files in `source/tosses`."""
    if source.suffix == ".npz" and not source.is_dir():
        return _read_npz(source)
    for folder in (source, source / "tosses") if source.is_dir() else ():
        files, archives = (_ending(folder, suffix) for suffix in (".pt", ".npz"))
        if files:
            return _read_pt(files)
        if len(archives) == 1:
            return _read_npz(archives[0])
    what = "no such file or directory" if not source.exists() else "no ContactNets tosses"
    raise InputDataError(
        f"{source}: {what}.",
        "a directory of <number>.pt files, or the .npz with " + ", ".join(_NPZ_FIELDS) + ".",
        "get contact-nets' data/tosses_processed from github.com/DAIRLab/contact-nets.",
    )


def _ending(folder: Path, suffix: str) -> list[Path]:
    return [path for path in entries_of(folder) if path.suffix == suffix]


def _read_pt(files: list[Path]) -> _Tosses:
    tracks: dict[int, Track] = {}
    for file in progress(files, "reading", unit="toss"):
        if not file.stem.isdecimal():
            raise InputDataError(
                f"{file}: the name is no toss number.", "<number>.pt.", "name the files by the numbers of the tosses."
            )
        rows = read_tensor(file, _COLUMNS, batched=True)
        rows[:, _POSITION] *= HALF_WIDTH_M
        rows[:, _VELOCITY] *= HALF_WIDTH_M
        tracks[int(file.stem)] = _track(str(file), rows, RATE_HZ)
    return _Tosses(tracks, HALF_WIDTH_M)


def _read_npz(path: Path) -> _Tosses:
    data = read_npz(path, _NPZ_FIELDS)
    _require_fields(path, data)
    offsets, numbers = data["offsets"].astype(np.int64), data["toss_index"].astype(np.int64)
    if len(offsets) != len(numbers) + 1 or offsets[0] != 0 or offsets[-1] != len(data["pos"]):
        raise InputDataError(
            f"{path}: {len(numbers)} toss numbers, {len(offsets)} offsets, {len(data['pos'])} rows.",
            "one offset more than tosses, from 0 to the number of rows.",
            "take the original file.",
        )
    tracks: dict[int, Track] = {}
    for number, start, stop in zip(numbers, offsets[:-1], offsets[1:], strict=True):
        rows = np.concatenate([data[name][start:stop] for name in ("pos", "quat_wxyz", "vel", "omega_body")], axis=1)
        tracks[int(number)] = _track(f"{path}: toss {number}", rows, float(data["rate_hz"]))
    return _Tosses(tracks, float(data["half_width_m"]))


def _require_fields(path: Path, data: Mapping[str, NDArray[Any]]) -> None:
    """Refuse arrays of a wrong type or shape, and sizes that are not positive."""
    for name, dimensions in (("offsets", 1), ("toss_index", 1), ("rate_hz", 0), ("half_width_m", 0), ("pos", 2)):
        if data[name].ndim != dimensions or data[name].dtype.kind not in "iuf":
            raise InputDataError(
                f"{path}: '{name}' is {data[name].dtype} {data[name].shape}.",
                f"numbers with {dimensions} axes.",
                "take the original file.",
            )
    _require_rows(path, data)
    if not (data["rate_hz"] > 0 and data["half_width_m"] > 0):
        raise InputDataError(
            f"{path}: rate_hz {data['rate_hz']}, half_width_m {data['half_width_m']}.",
            "both > 0.",
            "take the original file.",
        )


def _require_rows(path: Path, data: Mapping[str, NDArray[Any]]) -> None:
    """Refuse poses and velocities of different numbers of rows, or of wrong widths."""
    for name, width in (("pos", 3), ("quat_wxyz", 4), ("vel", 3), ("omega_body", 3)):
        if data[name].shape != (len(data["pos"]), width):
            raise InputDataError(
                f"{path}: '{name}' has the shape {data[name].shape}.", f"(rows, {width}).", "take the original file."
            )


def _track(where: str, rows: Array, rate_hz: float) -> Track:
    """Return the track of rows (T, >= 13) in SI units: position, quaternion, velocity, angular velocity, ..."""
    rows = np.asarray(rows, np.float64)
    if len(rows) < 2 or not np.isfinite(rows).all():
        raise InputDataError(
            f"{where}: {len(rows)} samples, {np.count_nonzero(~np.isfinite(rows))} values not finite.",
            "2 samples or more, all finite.",
            "remove this toss, or take the original.",
        )
    return Track(
        time_s=np.arange(len(rows)) / rate_hz,
        position_m=rows[:, _POSITION],
        quat_wxyz=rows[:, _QUATERNION],
        velocity_m_s=rows[:, _VELOCITY],
        omega_body_rad_s=rows[:, _OMEGA],
    )
