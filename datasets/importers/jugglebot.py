"""Import of the throws of Jugglebot (Project-DeepBlue-Juggling/Jugglebot): a machine throws a ball, 300 Hz, centroids.

A session is an export of the capture system (.json, millimetres) or an .npz of it (metres). In each track the machine
holds and throws the ball, which flies, hits the floor once and rolls away. It is converted as follows:

- An episode begins when the ball has left the machine, which is its time zero, and ends (`end_s`) before the ball hits
  the floor. The later samples stay in the track; increase `end_s` to include them.
- Both times are found in the data: the part around the top of the flight with the acceleration of a thrown ball is
  fitted by a quartic in time and extended until the measurement deviates from it.
- There is no ground, because the height of the floor differs between sessions and is known only from the bounces.
- Sessions are groups, and each is split separately.
"""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import Body, InputDataError, Shape, World
from ...schemas.capture import SphereShape
from ...schemas.documents import parse_json
from ...schemas.imports import ImportResult
from ...schemas.regular_files import read_text_file
from ..capture.files import entries_of
from ..capture.tracks import Track
from ..io.arrays import read_npz
from ..io.atomic import new_directory
from ..io.outputs import reads
from .recordings import Recording, drawn_splits, episode_names, require_only, write_recordings

Array = NDArray[np.float64]

BALL = "ball"
RADIUS_M = 0.035
GRAVITY_M_S2 = 9.81

_HALF_WINDOW_S, _TOLERANCE_M_S2 = 0.05, 2.0
"""Half width of the window of a quadratic fit whose acceleration distinguishes flight from other motion."""
_WINDOW_STEPS = 10
"""Fewest samples of this window, which is longer where they come at a lower rate."""
_LEAVES_M, _MARGIN_S = 0.0015, 0.0165
"""Deviation of the measurement from the fit that ends flight (the noise is 0.4 mm), and time [s] removed before it."""
_SHORTEST_S = 0.3
_LONGEST_THROW_M = 50.0
"""Spread of positions above which a message names it: a wrong unit is likely."""
_TODO = "get the recordings of github.com/Project-DeepBlue-Juggling/Jugglebot."


@reads("source")
def import_jugglebot(
    source: Path | str,
    out: Path | str,
    only: str | None = None,
    n_train: int | None = None,
    n_test: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> ImportResult:
    """Write the throws as a capture of centroid tracks, with one episode per throw and one group per session.

    Args:
        source: A session's .json or .npz, or a directory of them; if both exist, the .npz is read.
        out: The capture directory to write.
        only: The name of one session.
        n_train: Number of throws to fit on; None: 60 %.
        n_test: Number of throws to test on; None: the others.
        seed: Seed of the permutation within each session.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the source is not such data, or a track has no flight.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        sessions = _sessions(Path(source), only)
        recordings = []
        for path, session in zip(sessions, episode_names([path.stem for path in sessions]), strict=True):
            throws = _read_npz(path) if path.suffix == ".npz" else _read_json(path)
            for number, (time, position) in enumerate(throws):
                where = f"{path}: throw {number}"
                recordings.append(_throw(where, f"{session}-{number:02d}", session, time, position))
        splits = drawn_splits(recordings, n_train, n_test, seed)
        ball = Body(name=BALL, shape=Shape(sphere=SphereShape(radius_m=RADIUS_M)))
        return write_recordings(directory, out, World(), (ball,), recordings, splits)


def flight(time: Array, position: Array) -> tuple[int, int]:
    """Return the first and the last sample of the free flight around the highest point.

    Args:
        time: Times [s], shape (T,).
        position: Positions [m], z up, shape (T, 3).

    Raises:
        ValueError: If the flight around the highest point takes less than 0.3 s.
    """
    first, last = _extended_by_fit(time, position, *_around_top(time, position))
    margin = max(2, round(_MARGIN_S / float(np.median(np.diff(time)))))
    first, last = first + margin, last - margin
    if last <= first or time[last] - time[first] < _SHORTEST_S:
        raise ValueError(f"the flight takes less than {_SHORTEST_S:g} s")
    return first, last


def _around_top(time: Array, position: Array) -> tuple[int, int]:
    """Return the first and the last sample around the highest point with the acceleration of a thrown ball."""
    top = int(np.argmax(position[:, 2]))
    near_top = (k for k in range(top, len(time)) if time[k] < time[top] + 0.1)
    first = next((k for k in near_top if _falls_freely(time, position, k)), -1)
    if first < 0:
        raise ValueError("nothing flies at the highest point")
    return _last_in_flight(time, position, first, -1), _last_in_flight(time, position, first, 1)


def _last_in_flight(time: Array, position: Array, k: int, step: int) -> int:
    """Return the last sample that falls freely, as all do from sample k on, in steps of 1 or -1."""
    while 0 <= k + step < len(time) and _falls_freely(time, position, k + step):
        k += step
    return k


def _falls_freely(time: Array, position: Array, k: int) -> bool:
    """Return whether the acceleration near sample k is that of gravity."""
    half_s = max(_HALF_WINDOW_S, (_WINDOW_STEPS + 1) / 2 * float(np.median(np.diff(time))))
    near = np.abs(time - time[k]) < half_s
    if np.count_nonzero(near) < _WINDOW_STEPS:
        return False
    acceleration = 2 * np.polyfit(time[near] - time[k], position[near], 2)[0]
    return float(np.hypot(np.hypot(*acceleration[:2]), acceleration[2] + GRAVITY_M_S2)) < _TOLERANCE_M_S2


def _extended_by_fit(time: Array, position: Array, first: int, last: int) -> tuple[int, int]:
    """Return the range of samples (first, last), extended until the measurement deviates from a quartic in time."""
    middle = time[(first + last) // 2]
    fit = np.polyfit(time[first : last + 1] - middle, position[first : last + 1], 4)
    powers = (time - middle)[:, None] ** np.arange(4, -1, -1)
    on = np.linalg.norm(position - powers @ fit, axis=1) < _LEAVES_M
    while first > 1 and on[first - 2 : first].any():  # one sample off alone is noise
        first -= 1
    while last < len(time) - 2 and on[last + 1 : last + 3].any():
        last += 1
    return first, last


def _throw(where: str, name: str, session: str, time: Array, position: Array) -> Recording:
    seen = np.isfinite(position).all(1)
    time, position = time[seen], position[seen]
    try:
        if len(time) < 20 or (np.diff(time) <= 0).any():
            raise ValueError(f"{len(time)} samples, or times that do not increase")
        first, last = flight(time, position)
    except ValueError as error:
        spread = float(np.ptp(position, axis=0).max(initial=0.0)) if len(position) else 0.0
        wide = f" Its positions spread over {spread:.4g} m." if spread > _LONGEST_THROW_M else ""
        allowed = "a ball that is thrown and falls, z up, in metres (.npz) or millimetres (.json)."
        raise InputDataError(f"{where}: {error}.{wide}", allowed, _TODO) from None
    track = Track(time[first:] - time[first], position[first:])
    return Recording(name=name, tracks={BALL: track}, group=session, end_s=round(float(time[last] - time[first]), 6))


def _sessions(source: Path, only: str | None) -> list[Path]:
    folder = sorted(entries_of(source), key=lambda path: path.suffix) if source.is_dir() else [source]
    files = [path for path in folder if path.suffix in (".json", ".npz")]
    by_name = {path.stem: path for path in files if os.path.lexists(path)}  # .npz comes last and stays
    if not by_name:
        what = "no sessions of Jugglebot" if source.exists() else "no such file or directory"
        raise InputDataError(f"{source}: {what}.", "a session's .json or .npz, or a directory of them.", _TODO)
    require_only(f"{source}", "session", only, sorted(by_name))
    return [path for name, path in sorted(by_name.items()) if only in (None, name)]


def _read_npz(path: Path) -> list[tuple[Array, Array]]:
    """Return times [s] and positions [m] of the throws."""
    found = read_npz(path, ("offsets", "txyz"))
    numbers = all(array.dtype.kind in "iuf" for array in found.values())
    offsets, rows = (found["offsets"], found["txyz"]) if numbers else (np.zeros(0), np.zeros((0, 0)))
    offsets, rows = offsets.astype(np.int64), rows.astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 4 or not _cuts(offsets, len(rows)):
        raise InputDataError(
            f"{path}: 'txyz' has the shape {rows.shape}, 'offsets' {offsets.shape}.",
            "(rows, 4), and offsets that grow from 0 to the number of rows.",
            _TODO,
        )
    return [(rows[a:b, 0], rows[a:b, 1:]) for a, b in pairwise(offsets.tolist())]


def _cuts(offsets: NDArray[np.int64], count: int) -> bool:
    """Return whether offsets grow from 0 to a number of rows."""
    grows = offsets.ndim == 1 and len(offsets) > 1 and (np.diff(offsets) > 0).all()
    return bool(grows) and offsets[0] == 0 and offsets[-1] == count


def _read_json(path: Path) -> list[tuple[Array, Array]]:
    """Return times [s] and positions [m] of the throws in an export, whose positions are in millimetres."""
    try:
        data: Any = parse_json(read_text_file(path), path)
        rate = float(data["Timebase"]["Frequency"])
        throws = [_motion_of_marker(marker["Parts"], rate) for marker in data["Markers"]]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else "its entries have another form"
        raise InputDataError(
            f"{path}: not an export of Qualisys' tracks: {reason}.",
            "Timebase.Frequency, and Markers with Parts of Range.Start and Values in mm.",
            _TODO,
        ) from None
    if not throws:
        raise InputDataError(f"{path}: no markers.", todo=_TODO)
    return throws


def _motion_of_marker(parts: Any, rate_hz: float) -> tuple[Array, Array]:
    """Return times [s] and positions [m] of a marker, in whose parts positions are in millimetres."""
    times, positions = [], []
    for part in parts:
        values = np.array([row[:3] for row in part["Values"]], np.float64).reshape(-1, 3)
        times.append((part["Range"]["Start"] + np.arange(len(values))) / rate_hz)
        positions.append(1e-3 * values)
    return np.concatenate(times), np.concatenate(positions)
