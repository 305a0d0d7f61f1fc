"""Import of plain CSV tracks: a file, or a folder with one file per episode, with columns found by name."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
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
from .recordings import SI, Units, read_text, require_name, track_files, write_tracks

Array = NDArray[np.float64]

COLUMNS = ("time", "body", "px", "py", "pz", "qw", "qx", "qy", "qz", "wx", "wy", "wz", "fx", "fy", "fz")
"""Quantities that a column may contain; `body`, the orientation (q, four), the spin (w, three) and the force that the
body exerts (f, three) are optional."""
_REQUIRED = ("time", "px", "py", "pz")
_QUATERNION = ("qw", "qx", "qy", "qz")
_SPIN = ("wx", "wy", "wz")
_FORCE = ("fx", "fy", "fz")
_NAMES = {
    "time": ("time", "t", "timestamp", "timestamps", "stamp"),
    "body": ("body", "object", "rigid_body"),
    **{f"p{axis}": (f"p{axis}", axis, f"t{axis}", f"pos_{axis}", f"position_{axis}") for axis in "xyz"},
    **{f"q{part}": (f"q{part}", f"q_{part}", f"quat_{part}", f"orientation_{part}") for part in "wxyz"},
    **{
        f"w{axis}": (f"w{axis}", f"w{axis}_rad", f"omega_{axis}", f"omega_{axis}_rad", f"angular_velocity_{axis}")
        for axis in "xyz"
    },
    **{f"f{axis}": (f"f{axis}", f"f{axis}_n", f"force_{axis}", f"force_{axis}_n") for axis in "xyz"},
}
_UNIT = re.compile(r"^(.*?)[ _]*[(\[_ ](m|cm|mm|in|s|ms|us|ns)[)\]]?$")
_DECIMAL_COMMA = re.compile(r"^[+-]?\d*,\d+([eE][+-]?\d+)?$")
_LENGTHS, _TIMES = ("m", "cm", "mm", "in"), ("s", "ms", "us", "ns")


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
    overwrite: bool = False,
) -> ImportResult:
    """Write CSV tracks as a capture; the user adds shape, mass and ground to its manifest.

    The first line names the columns, separated by commas, semicolons or tabs. Several spellings are recognised
    (time, t, timestamp; px, x, tx, pos_x; qw, quat_w, ...), and names may end in their unit: `x_mm`, `Time (ms)`.
    Comments (#) may stand before it, and where no comma separates the columns, one may separate the decimals.
    Lines without a position are gaps. Each file's times begin at zero.

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
        overwrite: Replace `out`.

    Raises:
        InputDataError: If a file is not such a track, or its numbers cannot be seconds and metres.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        for name in columns or {}:
            if name not in COLUMNS:
                raise InputDataError(
                    f"--columns: '{name}' is nothing that a column can be.",
                    f"{', '.join(COLUMNS)}.{did_you_mean(name, COLUMNS)}",
                    "correct it, or leave it out.",
                )
        files = track_files(Path(source), (".csv",))
        left_out: Counter[str] = Counter()
        tracks = (_tracks(path, columns or {}, units, body, left_out, spin_frame) for path in files)
        result = write_tracks(directory, out, [path.stem for path in files], tracks, up, (n_train, n_test, seed))
    return result.model_copy(update={"warnings": (*result.warnings, *_left_out_warnings(left_out, len(files)))})


@dataclass(frozen=True)
class _Header:
    """The header of a file."""

    index: dict[str, int]
    """Index of each column by the quantity in it."""
    units: Units
    """Units from the column names."""
    decimal_comma: bool = False
    """Whether a comma may separate the decimals, where it does not separate the columns."""


def _left_out_warnings(left_out: Counter[str], files: int) -> tuple[str, ...]:
    """Return one warning that names the columns that were not read, by how many of the files have them."""
    if not left_out:
        return ()
    places = {name: "" if count == files else f" (in {count} of {files} files)" for name, count in left_out.items()}
    named = ", ".join(f"{shown(name)}{place}" for name, place in places.items())
    return (
        f"columns that were not read: {named}. Read are time, body, px, py, pz, qw, qx, qy, qz and "
        "wx, wy, wz (rad/s; beside orientations with --spin-frame), fx, fy, fz (N).",
    )


def _tracks(
    path: Path,
    columns: Mapping[str, str],
    units: Units,
    body: str,
    left_out: Counter[str],
    spin_frame: Literal["world", "body"] | None,
) -> dict[str, Track]:
    """Return the tracks of a file, and count its columns that are not read in `left_out`."""
    text, separator = _without_comments(read_text(path))
    rows = csv_rows(path, text, separator)
    names = next((row for _, row in rows if any(cell.strip() for cell in row)), [])
    header = replace(_header(path, names, columns, units), decimal_comma=separator != ",")
    if spin_frame is None and _QUATERNION[0] in header.index:  # nothing says along which axes
        header = replace(header, index={key: k for key, k in header.index.items() if key not in _SPIN})
    left_out.update(name.strip() for k, name in enumerate(names) if k not in header.index.values())
    by_body = _samples(path, header, len(names), rows, body)
    if not by_body:
        raise InputDataError(f"{path}: no samples.", todo="add at least 2, or remove the file.")
    tracks = {}
    for name, values in by_body.items():
        parts = _Parts.of(header, np.array(values))
        where = f"{path}: {name}"
        track = header.units.track(where, parts.time, parts.position, parts.quat, parts.omega, parts.force)
        tracks[name] = _with_body_spin(track) if spin_frame == "world" else track
    return tracks


def _without_comments(text: str) -> tuple[str, str]:
    """Return a text with its first lines blank where they are comments (#), and what separates its columns.

    The last of them names the columns where the line after it holds as many numbers.
    """
    lines = text.split("\n")
    count = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), 0)
    separator = max(",;\t", key=lines[count].count)
    if count:
        names = lines[count - 1].lstrip().lstrip("#").strip()
        cells = lines[count].split(separator)
        numbers = all(_is_number(cell.strip()) or _DECIMAL_COMMA.match(cell.strip()) for cell in cells)
        named = numbers and len(names.split(separator)) == len(cells)
        lines[:count] = [""] * (count - 1) + [names if named else ""]
    return "\n".join(lines), separator


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
    def of(header: _Header, table: Array) -> _Parts:
        """Divide a table whose columns are in the order of `COLUMNS`, without those that the file lacks."""
        found: dict[str, Array | None] = {}
        place = 4
        for name, group in (("quat", _QUATERNION), ("omega", _SPIN), ("force", _FORCE)):
            width = len(group) if group[0] in header.index else 0
            found[name] = table[:, place : place + width] if width else None
            place += width
        return _Parts(table[:, 0], table[:, 1:4], **found)


def _with_body_spin(track: Track) -> Track:
    """Return the track with its angular velocities, given along the world's axes, along those of the body.

    Without orientations they stay as they are, which is what a track file then holds.
    """
    if track.quat_wxyz is None or track.omega_body_rad_s is None:
        return track
    turned = Rotation.from_quat(track.quat_wxyz, scalar_first=True).inv().apply(track.omega_body_rad_s)
    return replace(track, omega_body_rad_s=turned)


def _samples(
    path: Path, header: _Header, width: int, rows: Iterable[tuple[int, list[str]]], body: str
) -> dict[str, list[list[float]]]:
    """Return the numbers of the lines by body, in the order of `COLUMNS`; every line has `width` cells."""
    wanted = [name for name in COLUMNS if name in header.index and name != "body"]
    by_body: dict[str, list[list[float]]] = {}
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != width:
            raise InputDataError(
                f"{path}, line {line}: {len(row)} values under {width} columns.", todo="correct the line."
            )
        name = row[header.index["body"]].strip() if "body" in header.index else body
        if name not in by_body:
            require_name(name, f"{path}, line {line}" if "body" in header.index else "--body")
        by_body.setdefault(name, []).append([_number(path, line, row, header, key) for key in wanted])
    return by_body


def _header(path: Path, found: list[str], columns: Mapping[str, str], units: Units) -> _Header:
    names = [name.strip() for name in found]
    if not any(names):
        raise InputDataError(
            f"{path}: empty, without a first line that names the columns.",
            f"a header line with {', '.join(_REQUIRED)}, and a line for each sample.",
            "export the recording again, or remove the file.",
        )
    if all(map(_is_number, names)):
        raise InputDataError(
            f"{path}: the first line holds numbers, so that nothing says what the {len(names)} columns are.",
            "a first line with the names of the columns, such as time,px,py,pz,qw,qx,qy,qz.",
            f"put such a line first, for example: sed -i '1i time,px,py,pz' '{path}'",
        )
    index = {key: k for key in COLUMNS if (k := _place(path, names, key, columns)) is not None}
    _require_columns(path, names, index)
    return _Header(index, _units(path, names, index, units))


def _is_number(text: str) -> bool:
    try:
        number_of(text)
    except ValueError:
        return False
    return True


def _require_columns(path: Path, names: list[str], index: Mapping[str, int]) -> None:
    """Check that time and position have columns, and either all or none of the orientation and of the spin."""
    lacking = [key for key in _REQUIRED if key not in index]
    group = _QUATERNION
    for some in (_QUATERNION, _SPIN, _FORCE):
        if not lacking and any(key in index for key in some):
            group, lacking = some, [key for key in some if key not in index]
    if lacking:
        raise InputDataError(
            f"{path}: no column for '{lacking[0]}' among {', '.join(names) or 'none'}.",
            f"a header line with {', '.join(_REQUIRED)}, and all of {', '.join(group)} or none.",
            f"name it: --columns {lacking[0]}=NAME.",
        )


def _units(path: Path, names: list[str], index: Mapping[str, int], units: Units) -> Units:
    """Return the units of the options and of the column names, which must not contradict each other."""
    for kind, legal, keys in (("length", _LENGTHS, _REQUIRED[1:]), ("time", _TIMES, _REQUIRED[:1])):
        by_name = {names[index[key]]: unit for key in keys if (unit := _plain(names[index[key]])[1]) in legal}
        silent = [names[index[key]] for key in keys if names[index[key]] not in by_name]
        if by_name and silent and getattr(units, kind) is None:
            raise InputDataError(
                f"{path}: '{next(iter(by_name))}' names its unit, and {' and '.join(map(shown, silent))} none.",
                f"a unit in all of {', '.join(names[index[key]] for key in keys)}, or in none.",
                f"rename the columns, or state it for all: --{kind}-unit {next(iter(by_name.values()))}.",
            )
        named = set(by_name.values())
        named |= {getattr(units, kind)} - {None}
        if len(named) > 1:
            raise InputDataError(
                f"{path}: units of {kind} that differ: {', '.join(sorted(named))}.",
                "one unit for all columns.",
                "convert the columns to one unit, and name it in the first line.",
            )
        units = replace(units, **{kind: next(iter(named), None)})
    return units


def _place(path: Path, names: list[str], key: str, columns: Mapping[str, str]) -> int | None:
    """Return the index of the column with the quantity `key`, or None."""
    if key in columns:
        if columns[key] not in names:
            raise InputDataError(
                f"{path}: no column '{columns[key]}' (--columns {key}={columns[key]}).",
                f"{', '.join(names)}.",
                f"choose one of these: --columns {key}=NAME.",
            )
        return names.index(columns[key])
    hits = [k for k, name in enumerate(names) if _plain(name)[0] in _NAMES[key]]
    if len(hits) > 1:
        raise InputDataError(
            f"{path}: '{names[hits[0]]}' and '{names[hits[1]]}' may both be '{key}'.",
            "one.",
            f"choose: --columns {key}=NAME.",
        )
    return hits[0] if hits else None


def _plain(name: str) -> tuple[str, str]:
    """Return a column's name in lower case without its unit, and the unit or an empty string."""
    name = name.strip().lower()
    found = _UNIT.match(name)
    return (found[1].strip(" _").replace(" ", "_"), found[2]) if found else (name.replace(" ", "_"), "")


def _number(path: Path, line: int, row: list[str], header: _Header, key: str) -> float:
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
