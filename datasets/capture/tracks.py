"""Reading and writing of measured poses, `tracks/<episode>.csv`: one row per time and body."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas import QUATERNION_NORM_TOLERANCE, InputDataError, did_you_mean
from ...schemas.distinct import first_repeated
from ..io.atomic import new_file, replaced_file
from ..io.cells import LARGEST, MOST_SHOWN, csv_rows, number_of, shown

Array = NDArray[np.float64]

_POSITION = ("px_m", "py_m", "pz_m")
_QUATERNION = ("qw", "qx", "qy", "qz")
_VELOCITY = ("vx_m_s", "vy_m_s", "vz_m_s")
_OMEGA = ("wx_rad_s", "wy_rad_s", "wz_rad_s")
_FORCE = ("force_x_n", "force_y_n", "force_z_n")
_TORQUE = ("torque_x_n_m", "torque_y_n_m", "torque_z_n_m")
_REQUIRED = ("time_s", "body", *_POSITION)
_OPTIONAL_GROUPS = {
    "quat_wxyz": _QUATERNION,
    "velocity_m_s": _VELOCITY,
    "omega_body_rad_s": _OMEGA,
    "force_n": _FORCE,
    "torque_n_m": _TORQUE,
}
COLUMNS = (*_REQUIRED, *(column for columns in _OPTIONAL_GROUPS.values() for column in columns))
"""The columns of a track file, in the order in which they are written."""
SHORTEST_STEP_S = 1e-9
"""Smallest difference of two times [s]; velocities from smaller ones would overflow."""


@dataclass(frozen=True, eq=False)
class Track:
    """The measured motion of one body in one episode, in the world frame, sorted by time."""

    time_s: Array
    """Times [s], shape (T,), strictly increasing."""
    position_m: Array
    """Position of the body frame's origin [m], world frame, shape (T, 3)."""
    quat_wxyz: Array | None = None
    """Orientation (body to world), unit quaternions, shape (T, 4); None for a centroid."""
    velocity_m_s: Array | None = None
    """Velocity of the body frame's origin [m/s], world frame, shape (T, 3), or None."""
    omega_body_rad_s: Array | None = None
    """Angular velocity [rad/s], BODY frame, shape (T, 3), or None; of a centroid along the axes of the world."""
    force_n: Array | None = None
    """Force that the body exerts on what it touches [N], world frame, shape (T, 3), or None; of driven bodies only."""
    torque_n_m: Array | None = None
    """Torque that it exerts about its frame's origin [N m], world axes, shape (T, 3), or None."""

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def turns(self) -> bool:
        """Whether the orientation was measured and is not the same in all samples."""
        return self.quat_wxyz is not None and bool(np.ptp(self.quat_wxyz, axis=0).any())

    def window(self, start_s: float | None = None, end_s: float | None = None) -> Track:
        """Return the samples with start_s <= time <= end_s [s]; None leaves that side open."""
        keep = np.ones(len(self), bool)
        if start_s is not None:
            keep &= self.time_s >= start_s
        if end_s is not None:
            keep &= self.time_s <= end_s
        optional = {name: getattr(self, name) for name in _OPTIONAL_GROUPS}
        kept = {name: None if value is None else value[keep] for name, value in optional.items()}
        return Track(self.time_s[keep], self.position_m[keep], **kept)


class Episode(NamedTuple):
    """The tracks of one recorded motion."""

    name: str
    """Name of the episode."""
    tracks: dict[str, Track]
    """Tracks by body."""


def read_tracks(path: Path | str, bodies: Iterable[str]) -> tuple[dict[str, Track], int]:
    """Read and check one episode's track file.

    Args:
        path: The CSV file.
        bodies: Names of the capture's bodies.

    Returns:
        The tracks by body, in the order of first appearance, and the number of quaternions that were normalised
        because their norm differed from 1 by more than rounding (1e-6) but within the tolerance (1e-3).

    Raises:
        InputDataError: With line and column, for an unknown column or body, a value that is missing or not
            finite, a quaternion that is not of unit norm, times that do not increase, or a single sample.
    """
    path, legal = Path(path), list(bodies)
    rows = csv_rows(path)
    header = [cell.strip() for cell in next(rows, (0, []))[1]]
    _check_header(path, header)
    by_body = _by_body(path, header, rows, legal)
    if not by_body:
        raise InputDataError(f"{path}: no samples.", todo="add at least 2, or remove the file.")
    tracks, normalised = {}, 0
    for name, numbered in by_body.items():
        tracks[name], count = _track(path, name, header, numbered)
        normalised += count
    return tracks, normalised


def _by_body(
    path: Path, header: list[str], rows: Iterable[tuple[int, list[str]]], legal: list[str]
) -> dict[str, list[tuple[int, list[str]]]]:
    """Return the lines of each body with their numbers; each has as many cells as the header."""
    by_body: dict[str, list[tuple[int, list[str]]]] = {}
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise InputDataError(
                f"{path}, line {line}: {len(row)} values under {len(header)} columns.", todo="correct the line."
            )
        name = row[header.index("body")].strip()
        if name not in by_body:
            _require_body(name, legal, f"{path}, line {line}")
        by_body.setdefault(name, []).append((line, row))
    return by_body


def _require_body(name: str, legal: list[str], where: str) -> None:
    if name not in legal:
        allowed = ", ".join(legal) + "." + did_you_mean(name, legal) if legal else "no body: [[bodies]] is empty."
        raise InputDataError(f"{where}: unknown body {shown(name)}.", allowed, "correct it, or add it to capture.toml.")


def write_tracks(path: Path | str, tracks: dict[str, Track], overwrite: bool = False) -> None:
    """Write the tracks of an episode atomically; reading them back gives exactly the same numbers."""
    with replaced_file(path) if overwrite else new_file(path, "track file") as temporary:
        temporary.write_text(tracks_csv(tracks), encoding="utf-8")


def tracks_csv(tracks: dict[str, Track]) -> str:
    """Return the text of a track file, sorted by time.

    Columns that no track has are omitted; a track that lacks columns of another one leaves them empty.
    """
    groups = _measured_groups(tracks.values())
    rows: list[tuple[float, int, list[str]]] = []
    for order, (body, track) in enumerate(tracks.items()):
        for k in range(len(track)):
            rows.append((float(track.time_s[k]), order, _row(body, track, k, groups)))
    rows.sort(key=lambda entry: entry[:2])
    header = [*_REQUIRED, *(column for columns in groups.values() for column in columns)]
    return "".join(",".join(row) + "\n" for row in [header, *(row for _, _, row in rows)])


def _measured_groups(tracks: Iterable[Track]) -> dict[str, Sequence[str]]:
    """Return the optional groups of columns that some track has."""
    every = list(tracks)
    there = {name for name in _OPTIONAL_GROUPS for track in every if getattr(track, name) is not None}
    return {name: columns for name, columns in _OPTIONAL_GROUPS.items() if name in there}


def _row(body: str, track: Track, k: int, groups: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the cells of a sample, empty ones for columns of other tracks."""
    row = [_text(track.time_s[k]), body, *map(_text, track.position_m[k])]
    for name, columns in groups.items():
        values = getattr(track, name)
        row += [""] * len(columns) if values is None else map(_text, values[k])
    return row


def _text(value: float) -> str:
    return repr(float(value))


def _check_header(path: Path, header: list[str]) -> None:
    allowed = ", ".join(COLUMNS)
    todo = "correct the header; values are in SI units (m, s, rad, N)."
    if not header:
        raise InputDataError(
            f"{path}: the file is empty.", f"a header line of {allowed}.", "write it again, or remove its episode."
        )
    for column in header:
        if column not in COLUMNS:
            raise InputDataError(
                f"{path}, line 1: unknown column {shown(column)}.", f"{allowed}." + did_you_mean(column, COLUMNS), todo
            )
    twice = first_repeated(header)
    if twice is not None:
        raise InputDataError(f"{path}, line 1: the column '{twice}' stands twice.", todo="remove one.")
    lacking = _lacking(header)
    if lacking is not None:
        raise InputDataError(f"{path}, line 1: no column '{lacking}'.", f"{allowed}.", todo)


def _lacking(header: list[str]) -> str | None:
    """Return the first column that is required and not there, or of which others of its group are; None without one."""
    for group in (_REQUIRED, *_OPTIONAL_GROUPS.values()):
        lacking = [column for column in group if column not in header]
        if lacking and (group is _REQUIRED or len(lacking) < len(group)):
            return lacking[0]
    return None


def _track(path: Path, body: str, header: list[str], rows: list[tuple[int, list[str]]]) -> tuple[Track, int]:
    lines = [line for line, _ in rows]
    time_s = _columns(path, body, header, rows, ("time_s",))[:, 0]
    position_m = _columns(path, body, header, rows, _POSITION)
    _check_times(path, body, time_s, lines)
    found = {name: _optional(path, body, header, rows, group) for name, group in _OPTIONAL_GROUPS.items()}
    quat_wxyz, normalised = found["quat_wxyz"], 0
    if quat_wxyz is not None:
        quat_wxyz, normalised = _unit(path, body, quat_wxyz, lines)
    track = Track(
        time_s=time_s,
        position_m=position_m,
        quat_wxyz=quat_wxyz,
        **{name: values for name, values in found.items() if name != "quat_wxyz"},
    )
    if len(track) < 2:
        raise InputDataError(
            f"{path}, line {lines[0]}: body '{body}' has 1 sample.", "at least 2.", "add samples, or remove it."
        )
    return track, normalised


def _columns(
    path: Path, body: str, header: list[str], rows: list[tuple[int, list[str]]], names: Sequence[str]
) -> Array:
    indices = [header.index(name) for name in names]
    values = np.empty((len(rows), len(names)))
    for k, (line, row) in enumerate(rows):
        for j, index in enumerate(indices):
            values[k, j] = value = _float_of(row[index])
            if not abs(value) <= LARGEST:
                raise _wrong_number(f"{path}, line {line}: body '{body}', column '{names[j]}'", row[index])
    return values


def _float_of(text: str) -> float:
    """Return the number that a cell holds; NaN of one that holds none."""
    try:
        return number_of(text)
    except ValueError:
        return math.nan


def _wrong_number(where: str, text: str) -> InputDataError:
    """Return the error of a cell that holds no number, or one that is not finite or too large."""
    try:
        value = number_of(text)
    except ValueError:
        fault = f"{shown(text)} is no number" if text.strip() else "the value is missing"
        todo = "correct the value, or leave out the whole line where nothing was measured."
        return InputDataError(f"{where}: {fault}.", "finite numbers.", todo)
    if not math.isfinite(value):
        return InputDataError(
            f"{where} is {text.strip()[:MOST_SHOWN]}.",
            "finite numbers; gaps are allowed.",
            "leave out the whole line where nothing was measured.",
        )
    return InputDataError(f"{where} is {value:g}.", f"numbers up to {LARGEST:g}, in SI units.", "correct the value.")


def _optional(
    path: Path, body: str, header: list[str], rows: list[tuple[int, list[str]]], names: Sequence[str]
) -> Array | None:
    if names[0] not in header:
        return None
    indices = [header.index(name) for name in names]
    if not any(row[index].strip() for _, row in rows for index in indices):
        return None
    return _columns(path, body, header, rows, names)


def _check_times(path: Path, body: str, time_s: Array, lines: list[int]) -> None:
    bad = np.flatnonzero(np.diff(time_s) < SHORTEST_STEP_S)
    if len(bad) == 0:
        return
    k = int(bad[0]) + 1
    before, now = time_s[k - 1], time_s[k]
    fault = f"comes after {before:.6g} s (line {lines[k - 1]})"
    if now >= before:
        fault = "stands twice" if now == before else f"is {now - before:.2g} s after that of line {lines[k - 1]}"
    raise InputDataError(
        f"{path}, line {lines[k]}: body '{body}': time {now:.6g} s {fault}.",
        "for each body, times that increase from line to line.",
        "sort the lines and remove duplicates.",
    )


def _unit(path: Path, body: str, quat_wxyz: Array, lines: list[int]) -> tuple[Array, int]:
    norm = np.linalg.norm(quat_wxyz, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE)
    if len(bad):
        k = int(bad[0])
        raise InputDataError(
            f"{path}, line {lines[k]}: body '{body}': the quaternion has norm {norm[k]:.4f} "
            f"({len(bad)} of {len(norm)} rows are off).",
            f"norm 1 within {QUATERNION_NORM_TOLERANCE:g}, order qw, qx, qy, qz.",
            "normalise the quaternions where they are made.",
        )
    # What is unit already stays as it is, so that writing and reading a track changes no bit of it.
    norm[np.abs(norm - 1.0) < 1e-12] = 1.0
    return quat_wxyz / norm[:, None], int(np.count_nonzero(np.abs(norm - 1.0) > 1e-6))
