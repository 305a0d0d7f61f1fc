"""Import of plain CSV tracks: a file, or a folder with one file per episode, with columns found by name."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...schemas import InputDataError, did_you_mean
from ...schemas.imports import ImportResult
from ..capture.tracks import Track
from ..io.atomic import new_directory
from ..io.cells import csv_rows, number_of, shown
from ..io.outputs import reads
from .csv_header import COLUMNS, EULER, FORCE, QUATERNION, SPIN, AngleUnit, Conventions, Header, is_number, read_header
from .recordings import SI, Units, read_text, require_name, track_files, write_tracks

Array = NDArray[np.float64]

_DECIMAL_COMMA = re.compile(r"^[+-]?\d*,\d+([eE][+-]?\d+)?$")


@reads("source")
def import_csv(
    source: Path | str,
    out: Path | str,
    columns: Mapping[str, str] | None = None,
    units: Units = SI,
    body: str = "body",
    up: Literal["z", "y"] = "z",
    spin_frame: Literal["world", "body"] | None = None,
    n_train: int | None = None,
    n_test: int | None = None,
    seed: int = 0,
    frame_rate_hz: float | None = None,
    euler: str | None = None,
    angle_unit: AngleUnit | None = None,
    overwrite: bool = False,
) -> ImportResult:
    """Write CSV tracks as a capture; the user adds shape, mass and ground to its manifest.

    The first line names the columns, separated by commas, semicolons or tabs. Several spellings are recognised
    (time, t, timestamp; px, x, tx, pos_x; qw, quat_w, ...), and names may end in their unit: `x_mm`, `Time (ms)`.
    Comments (#) may stand before it, and where no comma separates the columns, one may separate the decimals.
    Lines without a position are gaps. Each file's times begin at zero. Blanks in names of bodies
    become '-', which is said.

    Args:
        source: A file, or a folder of .csv files, each an episode.
        out: The capture directory to write.
        columns: Name in the file of any of `COLUMNS` that is not recognised.
        units: Units of the numbers, if the column names do not contain them.
        body: Name of the body, if there is no column for it.
        up: Axis that points up; gravity is set opposite to it, and the coordinates are kept.
        spin_frame: Frame of measured angular velocities; where orientations are measured too,
            they are read only if it is named, and without orientations the frame is the world's.
        n_train: Number of episodes to fit on; None: 60 %.
        n_test: Number of episodes to test on; None: the others.
        seed: Seed of the permutation.
        frame_rate_hz: The column of times, or one called frame, counts frames, at so many a second; without such a
            column the lines of each body do.
        euler: Order in which the angles of the columns roll, pitch, yaw (about x, y, z) turn, first to last: about
            fixed axes in small letters, about those of the body in capitals. None: such columns are not read.
        angle_unit: Unit of these angles, if the column names do not contain it.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If a file is not such a track, or its numbers cannot be seconds and metres.
        UsageError: If `out` exists, before anything is read, or two options contradict each other.
    """
    stated = Conventions(columns or {}, units, frame_rate_hz, euler, angle_unit)
    stated.check()
    with new_directory(out, "capture", overwrite) as directory:
        _require_quantities(columns or {})
        files = track_files(Path(source), (".csv",))
        left_out: Counter[str] = Counter()
        renamed: dict[str, str] = {}
        takes = [one for path in files for one in _takes(path, stated, body, left_out, renamed, spin_frame)]
        stems = [stem for stem, _ in takes]
        result = write_tracks(directory, out, stems, (own for _, own in takes), up, (n_train, n_test, seed))
    said = (*_left_out_warnings(left_out, len(files), euler), *_renamed_warnings(renamed))
    return result.model_copy(update={"warnings": (*result.warnings, *said)})


def _require_quantities(columns: Mapping[str, str]) -> None:
    """Refuse columns named for what no column can be."""
    for name in columns:
        if name not in COLUMNS:
            raise InputDataError(
                f"--columns: '{name}' is nothing that a column can be.",
                f"{', '.join(COLUMNS)}.{did_you_mean(name, COLUMNS)}",
                "correct it, or leave it out.",
            )


def _left_out_warnings(left_out: Counter[str], files: int, euler: str | None) -> tuple[str, ...]:
    """Return one warning that names the columns that were not read, by how many of the files have them."""
    if not left_out:
        return ()
    places = {name: "" if count == files else f" (in {count} of {files} files)" for name, count in left_out.items()}
    named = ", ".join(f"{shown(name)}{place}" for name, place in places.items())
    angles = "" if euler else "; or roll, pitch, yaw with the order of their turns, such as --euler xyz"
    return (
        f"columns that were not read: {named}. Read are time, take, body, px, py, pz, qw, qx, qy, qz{angles}; "
        "wx, wy, wz (rad/s, or wx_rpm, wx_deg_s; beside orientations with --spin-frame), fx, fy, fz (N).",
    )


def _renamed_warnings(renamed: Mapping[str, str]) -> tuple[str, ...]:
    """Return one warning that names the bodies that are called otherwise than in the files."""
    named = ", ".join(f"{shown(name)} is '{legal}'" for name, legal in renamed.items() if legal != name)
    return (f"blanks in names of bodies became '-': {named}.",) if named else ()


def _takes(
    path: Path,
    stated: Conventions,
    body: str,
    left_out: Counter[str],
    renamed: dict[str, str],
    spin_frame: Literal["world", "body"] | None,
) -> list[tuple[str, dict[str, Track]]]:
    """Return the takes of a file, each with what it is called and its tracks by body.

    Columns that are not read are counted, and what bodies are called is noted.
    """
    text, separator = _without_comments(read_text(path))
    rows = csv_rows(path, text, separator)
    names = next((row for _, row in rows if any(cell.strip() for cell in row)), [])
    header = replace(_with_told_spin(read_header(path, names, stated), spin_frame), decimal_comma=separator != ",")
    left_out.update(name.strip() for k, name in enumerate(names) if k not in header.index.values())
    by_take = _samples(path, header, len(names), rows, body, renamed)
    if not by_take:
        raise InputDataError(f"{path}: no samples.", todo="add at least 2, or remove the file.")
    found = []
    for take, by_body in by_take.items():
        called = f"{path}: {take}: " if len(by_take) > 1 else f"{path}: "
        tables = {name: np.array(values) for name, values in by_body.items()}
        _require_one_take(path, header, tables)
        tracks = {name: _track(f"{called}{name}", header, table, stated) for name, table in tables.items()}
        if spin_frame == "world":
            tracks = {name: _with_body_spin(track) for name, track in tracks.items()}
        found.append((f"{path.stem}-{take}" if len(by_take) > 1 else path.stem, tracks))
    return found


def _require_one_take(path: Path, header: Header, tables: Mapping[str, Array]) -> None:
    """Refuse times that begin anew several times: several takes, one after the other."""
    if "time" not in header.index:
        return
    for table in tables.values():
        time = table[:, header.quantities.index("time")]
        starts = np.flatnonzero(np.diff(time) < 0) + 1
        late = time[starts] - time[0] > 0.2 * np.ptp(time)
        if len(starts) and not late.any() and np.diff(starts, prepend=0, append=len(time)).min() > 3:
            raise InputDataError(
                f"{path}: the times begin anew {len(starts)} times, as of {len(starts) + 1} takes in one file.",
                "one file for each take, or a column with the number of the take.",
                "name the column that holds it, such as --columns take=NAME, or write each take into its own file.",
            )


def _with_told_spin(header: Header, spin_frame: Literal["world", "body"] | None) -> Header:
    """Return a header without the columns of spin where nothing says along which axes they are."""
    if spin_frame is not None or not {QUATERNION[0], EULER[0]} & set(header.index):
        return header
    return replace(header, index={key: k for key, k in header.index.items() if key not in SPIN})


def _track(where: str, header: Header, table: Array, stated: Conventions) -> Track:
    """Return the track of a body from its numbers, a line for each sample."""
    parts = _Parts.of(header, table, stated)
    return header.units.track(where, parts.time, parts.position, parts.quat, parts.omega, parts.force)


def _without_comments(text: str) -> tuple[str, str]:
    """Return a text with its first lines blank where they are comments (#), and what separates its columns.

    The last of them names the columns where the line after it holds as many numbers.
    """
    lines = text.split("\n")
    count = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), 0)
    separator = max(",;\t", key=lines[count].count)
    if count:
        names = lines[count - 1].lstrip().lstrip("#").strip()
        named = _are_names_of(names.split(separator), lines[count].split(separator))
        lines[:count] = [""] * (count - 1) + [names if named else ""]
    return "\n".join(lines), separator


def _are_names_of(names: Sequence[str], cells: Sequence[str]) -> bool:
    """Return whether cells are as many numbers as there are names."""
    numbers = all(is_number(cell.strip()) or _DECIMAL_COMMA.match(cell.strip()) for cell in cells)
    return numbers and len(names) == len(cells)


@dataclass(frozen=True)
class _Parts:
    """The numbers of a body's samples, in the units of the file."""

    time: Array
    """Times, shape (T,)."""
    position: Array
    """Positions, shape (T, 3)."""
    quat: Array | None
    """Orientations, shape (T, 4)."""
    omega: Array | None
    """Angular velocities, shape (T, 3)."""
    force: Array | None
    """Forces that the body exerts [N], shape (T, 3); NaN where they were not measured."""

    @staticmethod
    def of(header: Header, table: Array, stated: Conventions) -> _Parts:
        """Divide a table whose columns are those quantities of the header that are numbers, in their order."""
        column = dict(zip(header.quantities, table.T, strict=True))

        def columns(keys: tuple[str, ...]) -> Array | None:
            return np.stack([column[key] for key in keys], 1) if keys[0] in column else None

        time = column.get("time", np.arange(len(table), dtype=float))
        quat, angles = columns(QUATERNION), columns(EULER)
        if quat is None and angles is not None and stated.euler is not None:
            quat = _quaternions(angles, stated.euler, header.angle_unit == "deg")
        position = np.stack([column[key] for key in ("px", "py", "pz")], 1)
        spin = columns(SPIN)
        omega = None if spin is None else header.spin_rad_s * spin
        return _Parts(time / (stated.frame_rate_hz or 1.0), position, quat, omega, columns(FORCE))


def _quaternions(angles: Array, order: str, degrees: bool) -> Array:
    """Return orientations (T, 4), w first, of angles (T, 3) about x, y and z; NaN where one of them is.

    Args:
        angles: Angles of `EULER`.
        order: Axes of the turns, first to last: fixed ones in small letters, those of the body in capitals.
        degrees: Whether they are in degrees, else in radians.
    """
    known = np.isfinite(angles).all(1)
    turns = angles[known][:, ["xyz".index(axis) for axis in order.lower()]]
    quat = np.full((len(angles), 4), np.nan)
    quat[known] = Rotation.from_euler(order, turns, degrees=degrees).as_quat(scalar_first=True)
    return quat


def _with_body_spin(track: Track) -> Track:
    """Return the track with its angular velocities, given along the world's axes, along those of the body.

    Without orientations they stay as they are, which is what a track file then holds.
    """
    if track.quat_wxyz is None or track.omega_body_rad_s is None:
        return track
    turned = Rotation.from_quat(track.quat_wxyz, scalar_first=True).inv().apply(track.omega_body_rad_s)
    return replace(track, omega_body_rad_s=turned)


def _samples(
    path: Path,
    header: Header,
    width: int,
    rows: Iterable[tuple[int, list[str]]],
    body: str,
    renamed: dict[str, str],
) -> dict[str, dict[str, list[list[float]]]]:
    """Return the numbers of the lines by take and body, as the header orders them; every line has `width` cells."""
    wanted = header.quantities
    by_take: dict[str, dict[str, list[list[float]]]] = {}
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != width:
            raise InputDataError(
                f"{path}, line {line}: {len(row)} values under {width} columns.", todo="correct the line."
            )
        by_body = by_take.setdefault(row[header.index["take"]].strip() if "take" in header.index else "", {})
        if "body" in header.index:
            name = _body_name(row[header.index["body"]].strip(), renamed, f"{path}, line {line}")
        else:
            name = body if body in by_body else require_name(body, "--body")
        by_body.setdefault(name, []).append([_number(path, line, row, header, key) for key in wanted])
    return by_take


def _body_name(name: str, renamed: dict[str, str], where: str) -> str:
    """Return what a body of a file is called in the capture, blanks replaced, and note it by its name there."""
    if name not in renamed:
        legal = require_name("-".join(name.split(" ")), where)
        twin = next((other for other, given in renamed.items() if given == legal), None)
        if twin is not None:
            raise InputDataError(
                f"{where}: {shown(name)} and {shown(twin)} would both be called '{legal}'.",
                "names that differ by more than blanks.",
                "change one of them there.",
            )
        renamed[name] = legal
    return renamed[name]


def _number(path: Path, line: int, row: list[str], header: Header, key: str) -> float:
    cell = row[header.index[key]].strip()
    try:
        plain = cell.replace(",", ".") if header.decimal_comma and _DECIMAL_COMMA.match(cell) else cell
        number = number_of(plain) if cell or key == "time" else math.nan
        if math.isinf(number):
            raise ValueError
    except ValueError:
        fault = f"{shown(cell)} is no number" if cell else "the time is missing"
        raise InputDataError(
            f"{path}, line {line}: {key}: {fault}.",
            "numbers; empty or nan where nothing was seen.",
            "correct the line, or remove it.",
        ) from None
    return number
