"""Import of balls that fall 35 m (briandesilva/discovery-of-physics-from-data): heights at 15 Hz, two drops per ball.

The files contain the height above the ground by time, weights and circumferences. They are converted as follows:

- The position is (0, 0, height), because nothing was measured sideways. A fit sees no motion there, so an estimate of
  the noise from all three coordinates is too small by the square root of 3.
- Each ball is a group. Together, all drops are one body without a mass; differences between the balls are left to
  effect parameters that are shared within a group. The shape is a sphere of their median radius. It touches nothing:
  there is no ground, because the tracks end about 12 m above it.
- A single ball (`only`) has its measured mass and radius.
- The first drop of each ball is in the split "train", the second in "test".
- The measured velocity is a difference of the heights and is omitted.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas import Body, InputDataError, Shape, World
from ...schemas.capture import SphereShape
from ...schemas.imports import ImportResult
from ...schemas.regular_files import read_text_file
from ..io.atomic import new_directory
from ..io.cells import csv_rows, number_of, shown
from ..io.outputs import reads
from .recordings import Recording, Units, require_name, require_only, write_recordings

BALL = "ball"
_OUNCE_KG = 0.028349523125
_COLUMNS = ("ball", "Drop #", "Time (s)", "Height (m)")
_TABLE = "balls.txt"
_TODO = "get the data of github.com/briandesilva/discovery-of-physics-from-data."


@reads("source")
def import_balldrops(
    source: Path | str, out: Path | str, only: str | None = None, overwrite: bool = False
) -> ImportResult:
    """Write the drops as a capture of centroid tracks, with one episode per drop and one group per ball.

    Args:
        source: `ball_drops.csv`, or the directory that contains it and `balls.txt`.
        out: The capture directory to write.
        only: Name of a single ball in the capture, for example "bowling-ball".
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the source is not such data, or the ball does not exist.
        UsageError: If `out` exists, before anything is read.
    """
    source = Path(source)
    path = source / "ball_drops.csv" if source.is_dir() else source
    with new_directory(out, "capture", overwrite) as directory:
        recordings = _drops(path)
        balls = list(dict.fromkeys(str(recording.group) for recording in recordings))
        require_only(f"{path}", "ball", only, balls)
        recordings = [recording for recording in recordings if only in (None, recording.group)]
        body = _body(path.with_name(_TABLE), balls, only)
        splits = {
            split: tuple(r.name for r in recordings if r.name.endswith("-1") == (split == "train"))
            for split in ("train", "test")
        }
        return write_recordings(directory, out, World(), (body,), recordings, splits)


def _drops(path: Path) -> list[Recording]:
    drops: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for line, row in _rows(path):
        name, number, sample = _sample(f"{path}, line {line}", row)
        if (name, number) not in drops:
            require_name(name, f"{path}, line {line}")
        drops.setdefault((name, number), []).append(sample)
    return [_drop(path, name, number, np.array(samples)) for (name, number), samples in drops.items()]


def _rows(path: Path) -> list[tuple[int, dict[str, str]]]:
    """Return the lines below the header, by column, with their numbers."""
    lines = csv_rows(path)
    header = next(lines, (0, []))[1]
    lacking = [column for column in _COLUMNS if column not in header]
    rows = [] if lacking else [(line, dict(zip(header, row, strict=False))) for line, row in lines if row]
    if lacking or not rows:
        what = f"no column '{lacking[0]}'" if lacking else "no rows"
        raise InputDataError(f"{path}: {what}.", f"{', '.join(_COLUMNS)}.", _TODO)
    return rows


def _sample(where: str, row: dict[str, str]) -> tuple[str, str, tuple[float, float]]:
    """Return the ball, the number of the drop, and time [s] and height [m] of a line."""
    try:
        drop = number_of(row["Drop #"])
        if drop != int(drop):
            raise ValueError
        sample = number_of(row["Time (s)"]), number_of(row["Height (m)"])
        return "-".join(row["ball"].lower().split()), f"{drop:.0f}", sample
    except (KeyError, ValueError, OverflowError):
        raise InputDataError(
            f"{where}: no drop number, time and height.", "numbers.", "correct the line, or remove it."
        ) from None


def _drop(path: Path, name: str, number: str, values: NDArray[np.float64]) -> Recording:
    """Return the recording of a drop, of times [s] and heights [m] (T, 2)."""
    position = np.c_[np.zeros((len(values), 2)), values[:, 1]]
    track = Units("m").track(f"{path}: {name}, drop {number}", values[:, 0], position)
    return Recording(name=f"{name}-{number}", tracks={BALL: track}, group=name)


def _body(path: Path, balls: list[str], only: str | None) -> Body:
    """Return the body of all drops: a sphere of the balls' median radius, or the single ball with its mass."""
    table = _table(path)
    known = [table.get(_key(ball), (None, None)) for ball in balls if only in (None, ball)]
    radii = [radius for _, radius in known if radius is not None]
    if not radii:
        raise InputDataError(f"{path}: no circumference of {only or 'any ball'}.", todo=_TODO)
    shape = Shape(sphere=SphereShape(radius_m=float(np.median(radii))))
    return Body(name=BALL, mass_kg=known[0][0] if only else None, shape=shape)


def _table(path: Path) -> dict[str, tuple[float | None, float | None]]:
    """Return mass [kg] and radius [m] by ball; None for a value that was not measured ("??")."""
    lines = read_text_file(path).splitlines()
    table = {}
    for number, line in enumerate(lines, 1):
        words = line.split()
        if number == 1 or not words:
            continue
        try:
            name, weight, circumference = words
            mass = _measured(weight, _OUNCE_KG)
            radius = _measured(circumference, 0.01 / (2 * math.pi))
        except ValueError:
            raise InputDataError(
                f"{path}, line {number}: {shown(line)}.",
                "ball, ounces, centimetres.",
                "correct the line, or remove it.",
            ) from None
        table[_key(name)] = mass, radius
    return table


def _measured(text: str, unit: float) -> float | None:
    """Return a positive number in units; None where it was not measured.

    Raises:
        ValueError: If it is no such number.
    """
    value = None if text == "??" else number_of(text) * unit
    if value is not None and not 0 < value < math.inf:
        raise ValueError
    return value


def _key(name: str) -> str:
    """Return a ball's name in a common spelling, because the two files differ."""
    plain = name.lower().replace("-", "").replace("whiffle", "wiffle")
    return plain.removesuffix("ball") if "wiffle" in plain else plain
