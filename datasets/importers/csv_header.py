"""The header of a CSV track: which column holds which quantity, in which unit and by which convention."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from ...schemas import InputDataError, UsageError
from ..io.cells import number_of, shown
from .recordings import LENGTHS_M, SI, TIMES_S, Units

AngleUnit = Literal["deg", "rad"]

QUATERNION = ("qw", "qx", "qy", "qz")
EULER = ("roll", "pitch", "yaw")
"""Angles about x, y and z; which turn comes first is the order's to say."""
SPIN = ("wx", "wy", "wz")
FORCE = ("fx", "fy", "fz")
REQUIRED = ("time", "px", "py", "pz")
COLUMNS = ("time", "take", "body", "px", "py", "pz", *QUATERNION, *EULER, *SPIN, *FORCE)
"""Quantities that a column may contain; `take` (which of several in one file), `body`, the orientation (a quaternion,
or three angles with their order), the spin (w, three) and the force that the body exerts (f, three) are optional."""
EULER_ORDERS = ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
"""Orders of the turns, first to last: about fixed axes in small letters, about the body's in capitals."""
_NAMES = {
    "time": ("time", "t", "timestamp", "timestamps", "stamp"),
    "take": ("take", "trial", "episode", "throw", "toss", "shot"),
    "body": ("body", "object", "rigid_body"),
    **{f"p{axis}": (f"p{axis}", axis, f"t{axis}", f"pos_{axis}", f"position_{axis}") for axis in "xyz"},
    **{f"q{part}": (f"q{part}", f"q_{part}", f"quat_{part}", f"orientation_{part}") for part in "wxyz"},
    **{name: (name, f"euler_{axis}") for name, axis in zip(EULER, "xyz", strict=True)},
    **{f"w{axis}": (f"w{axis}", f"omega_{axis}", f"angular_velocity_{axis}", f"spin_{axis}") for axis in "xyz"},
    **{f"f{axis}": (f"f{axis}", f"f{axis}_n", f"force_{axis}", f"force_{axis}_n") for axis in "xyz"},
}
_FRAMES = ("frame", "frames", "frame_number", "frame_index", "frame_id")
"""Names of a column that counts frames, read where the frame rate is given."""
_UNIT = re.compile(r"^(.*?)[ _]*[(\[_ ](m|cm|mm|in|s|ms|us|ns)[)\]]?$")
_SPIN_UNIT = re.compile(r"^(.*?)[ _]*[(\[_ ](rad/s|rad_s|deg/s|deg_s|rpm|rev/min|rev/s|rps)[)\]]?$")
_SPINS_RAD_S = {
    "rad": 1.0,
    "deg": math.pi / 180,
    "rpm": math.pi / 30,
    "rev/min": math.pi / 30,
    "rev/s": 2 * math.pi,
    "rps": 2 * math.pi,
}
"""Units of angular velocities in rad/s, each by its name without `/s`, or with it where that is not its name."""
_ANGLE_UNIT = re.compile(r"^(.*?)[ _]*[(\[_ ](deg|rad)[)\]]?$")


@dataclass(frozen=True)
class Conventions:
    """What the user says about the columns of all files; what stays None is told by the files themselves."""

    columns: Mapping[str, str]
    """Name in the files of any of `COLUMNS`."""
    units: Units = SI
    """Units of lengths and times."""
    frame_rate_hz: float | None = None
    """The column of times counts frames, at so many a second."""
    euler: str | None = None
    """Order of the turns of `EULER`, one of `EULER_ORDERS`."""
    angle_unit: AngleUnit | None = None
    """Unit of `EULER`."""

    def check(self) -> None:
        """Raise UsageError if they contradict each other or cannot be."""
        rate = self.frame_rate_hz
        if rate is not None and not 1e-3 <= rate <= 1e6:
            raise UsageError(f"--frame-rate {rate:g}.", "0.001 to 1000000 frames a second.", "correct it.")
        if rate is not None and self.units.time is not None:
            raise UsageError("--frame-rate with --time-unit.", "one of the two.", "leave one out.")
        self._check_angles()

    def _check_angles(self) -> None:
        """Raise UsageError for an unknown order of turns, or a unit of angles that are not read."""
        order = self.euler
        if order is not None and order not in EULER_ORDERS:
            allowed = "xyz, zyx, ... about fixed axes; XYZ, ZYX, ... about those of the body, first turn first."
            raise UsageError(f"--euler {shown(order)}.", allowed, "roll, pitch, yaw of robots: --euler xyz.")
        if order is None and self.angle_unit is not None:
            raise UsageError("--angle-unit without --euler.", "both, or neither.", "name the order of the turns.")


@dataclass(frozen=True)
class Header:
    """The header of a file."""

    index: dict[str, int]
    """Index of each column by the quantity in it."""
    units: Units
    """Units, from the column names or stated."""
    angle_unit: AngleUnit | None = None
    """Unit of the angles of `EULER`, if they are read."""
    spin_rad_s: float = 1.0
    """Unit of the angular velocities of `SPIN` [rad/s]."""
    decimal_comma: bool = False
    """Whether a comma may separate the decimals, where it does not separate the columns."""

    @property
    def quantities(self) -> list[str]:
        """Quantities that are numbers, in the order of `COLUMNS`."""
        return [name for name in COLUMNS if name in self.index and name not in ("body", "take")]


def read_header(path: Path, found: list[str], stated: Conventions) -> Header:
    """Return the header of a file.

    Args:
        path: The file, for messages.
        found: Its first line, cell by cell.
        stated: What the user says.

    Raises:
        InputDataError: If it names no columns, lacks a quantity, or its units are unknown or contradict each other.
    """
    names = [name.strip() for name in found]
    _require_names(path, names)
    index = {key: k for key in COLUMNS if (k := _place(path, names, key, stated)) is not None}
    if stated.euler is None or QUATERNION[0] in index:  # nothing says in which order they turn, or they are not needed
        index = {key: k for key, k in index.items() if key not in EULER}
    _require_columns(path, names, index, stated)
    angles = _angle_unit(path, [names[index[key]] for key in EULER if key in index], stated.angle_unit)
    spin = _spin_unit(path, [names[index[key]] for key in SPIN if key in index])
    return Header(index, _units(path, names, index, stated), angles, spin)


def _require_names(path: Path, names: list[str]) -> None:
    """Refuse a first line that names nothing: an empty one, or one of numbers."""
    if not any(names):
        raise InputDataError(
            f"{path}: empty, without a first line that names the columns.",
            f"a header line with {', '.join(REQUIRED)}, and a line for each sample.",
            "export the recording again, or remove the file.",
        )
    if all(map(is_number, names)):
        raise InputDataError(
            f"{path}: the first line holds numbers, so that nothing says what the {len(names)} columns are.",
            "a first line with the names of the columns, such as time,px,py,pz,qw,qx,qy,qz.",
            f"put such a line first, for example: sed -i '1i time,px,py,pz' '{path}'",
        )


def is_number(text: str) -> bool:
    """Return whether a cell holds a number."""
    try:
        number_of(text)
    except ValueError:
        return False
    return True


def _require_columns(path: Path, names: list[str], index: Mapping[str, int], stated: Conventions) -> None:
    """Check that time and position have columns, and either all or none of orientation, spin and force."""
    required = REQUIRED if stated.frame_rate_hz is None else REQUIRED[1:]
    lacking, group = _lacking(required, index, stated)
    if lacking:
        rate = " Without times: --frame-rate HZ." if lacking[0] == "time" else ""
        raise InputDataError(
            f"{path}: no column for '{lacking[0]}' among {', '.join(names) or 'none'}.",
            f"a header line with {', '.join(required)}, and all of {', '.join(group)} or none.",
            f"name it: --columns {lacking[0]}=NAME.{rate}",
        )


def _lacking(
    required: Sequence[str], index: Mapping[str, int], stated: Conventions
) -> tuple[list[str], tuple[str, ...]]:
    """Return the quantities that have no column, and the group of which a file has all or none; none lack: empty."""
    if lacking := [key for key in required if key not in index]:
        return lacking, QUATERNION
    if stated.euler is not None and not {QUATERNION[0], *EULER} & set(index):
        return list(EULER), EULER
    for group in (QUATERNION, EULER, SPIN, FORCE):
        lacking = [key for key in group if key not in index]
        if 0 < len(lacking) < len(group):
            return lacking, group
    return [], QUATERNION


def _units(path: Path, names: list[str], index: Mapping[str, int], stated: Conventions) -> Units:
    """Return the units of the options and of the column names, which must not contradict each other."""
    units = stated.units
    for kind, legal, keys in (("length", LENGTHS_M, REQUIRED[1:]), ("time", TIMES_S, REQUIRED[:1])):
        held = [names[index[key]] for key in keys if key in index]
        by_name = {name: unit for name in held if (unit := _plain(name)[1]) in legal}
        if by_name and kind == "time" and stated.frame_rate_hz is not None:
            raise InputDataError(
                f"{path}: {shown(held[0])} names a unit of time, and --frame-rate says that it counts frames.",
                "one of the two.",
                "leave --frame-rate out, or name the column of the frames: --columns time=NAME.",
            )
        units = replace(units, **{kind: _one_unit(path, kind, held, by_name, getattr(units, kind))})
    return units


def _one_unit(path: Path, kind: str, held: list[str], by_name: Mapping[str, str], stated: str | None) -> str | None:
    """Return the unit of the columns `held`, which the names of some say, or the user; None where nothing does."""
    silent = [name for name in held if name not in by_name]
    if by_name and silent and stated is None:
        raise InputDataError(
            f"{path}: '{next(iter(by_name))}' names its unit, and {' and '.join(map(shown, silent))} none.",
            f"a unit in all of {', '.join(held)}, or in none.",
            f"rename the columns, or state it for all: --{kind}-unit {next(iter(by_name.values()))}.",
        )
    named = set(by_name.values()) | ({stated} - {None})
    if len(named) > 1:
        raise InputDataError(
            f"{path}: units of {kind} that differ: {', '.join(sorted(map(str, named)))}.",
            "one unit for all columns.",
            "convert the columns to one unit, and name it in the first line.",
        )
    return next(iter(named), None)


def _angle_unit(path: Path, names: list[str], stated: AngleUnit | None) -> AngleUnit | None:
    """Return the unit of the angles in the columns `names`, which their names or the user say."""
    if not names:
        return None
    named = {found[2] for name in names if (found := _ANGLE_UNIT.match(name.lower()))} | ({stated} - {None})
    if len(named) != 1:
        unknown = f"{path}: nothing says in which unit {', '.join(map(shown, names))} are."
        differ = f"{path}: units of angles that differ: {', '.join(sorted(map(str, named)))}."
        raise InputDataError(differ if named else unknown, "deg or rad, for all three.", "add --angle-unit deg or rad.")
    return "deg" if named == {"deg"} else "rad"


def _spin_unit(path: Path, names: list[str]) -> float:
    """Return the unit [rad/s] of the angular velocities in the columns `names`, which these may say."""
    found = [match[2] if (match := _SPIN_UNIT.match(name.strip().lower())) else "rad/s" for name in names]
    plain = {re.sub("^(rad|deg)[/_]s$", r"\1", unit) for unit in found}
    if len(plain) > 1:
        raise InputDataError(
            f"{path}: units of angular velocity that differ: {', '.join(sorted(plain))}.",
            "one unit for all three.",
            "convert the columns to one unit, and name it in the first line.",
        )
    return _SPINS_RAD_S[plain.pop()] if plain else 1.0


def _place(path: Path, names: list[str], key: str, stated: Conventions) -> int | None:
    """Return the index of the column with the quantity `key`, or None."""
    if key in stated.columns:
        return _stated_place(path, names, key, stated.columns[key])
    hits = [k for k, name in enumerate(names) if _quantity(name, key) in _NAMES[key]]
    if key == "time" and stated.frame_rate_hz is not None:
        hits = _frame_counts(names) or hits
    if len(hits) > 1:
        raise InputDataError(
            f"{path}: '{names[hits[0]]}' and '{names[hits[1]]}' may both be '{key}'.",
            "one.",
            f"choose: --columns {key}=NAME.",
        )
    return hits[0] if hits else None


def _frame_counts(names: list[str]) -> list[int]:
    """Return the indices of the columns that count frames by their names."""
    return [k for k, name in enumerate(names) if _plain(name)[0] in _FRAMES]


def _stated_place(path: Path, names: list[str], key: str, name: str) -> int:
    """Return the index of the column that the user names for the quantity `key`."""
    if name not in names:
        raise InputDataError(
            f"{path}: no column '{name}' (--columns {key}={name}).",
            f"{', '.join(names)}.",
            f"choose one of these: --columns {key}=NAME.",
        )
    return names.index(name)


def _quantity(name: str, key: str) -> str:
    """Return a column's name in lower case without the unit that a quantity `key` may have."""
    units = _ANGLE_UNIT if key in EULER else _SPIN_UNIT if key in SPIN else None
    found = units.match(name.strip().lower()) if units else None
    return _plain(found[1] if found else name)[0]


def _plain(name: str) -> tuple[str, str]:
    """Return a column's name in lower case without its unit, and the unit or an empty string."""
    name = name.strip().lower()
    found = _UNIT.match(name)
    return (found[1].strip(" _").replace(" ", "_"), found[2]) if found else (name.replace(" ", "_"), "")
