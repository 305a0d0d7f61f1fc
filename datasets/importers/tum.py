"""Import of trajectories in the format of the TUM RGB-D benchmark: `timestamp tx ty tz qx qy qz qw` a line."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np

from ...schemas import InputDataError
from ...schemas.imports import ImportResult
from ..capture.tracks import Track
from ..io.atomic import new_directory
from ..io.cells import number_of, shown
from ..io.outputs import reads
from .recordings import SI, Units, read_text, require_name, track_files, write_tracks


@reads("source")
def import_tum(
    source: Path | str,
    out: Path | str,
    units: Units = SI,
    body: str = "body",
    up: Literal["z", "y"] = "z",
    n_train: int | None = None,
    n_test: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> ImportResult:
    """Write trajectories as a capture. Shape, mass and ground are for you to add to its manifest.

    Seconds, metres and unit quaternions with w last, as the format says; lines with # are comments. Each file's times
    begin at zero. A trajectory of a camera is no pose of a body: what is imported must be T_world_body.

    Args:
        source: A file, or a folder of .txt and .tum files, each an episode.
        out: The capture directory to write.
        units: Where the numbers are others than metres and seconds.
        body: Name of the body.
        up: Which axis points up; gravity is set against it, numbers stay.
        n_train: Number of episodes to fit on; None: 60 %.
        n_test: Number of episodes to test on; None: the others.
        seed: Of the permutation.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If a file is no such trajectory, or its numbers cannot be seconds and metres.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        require_name(body, "--body")
        files = track_files(Path(source), (".txt", ".tum"))
        tracks = ({body: _track(path, units)} for path in files)
        return write_tracks(directory, out, [path.stem for path in files], tracks, up, (n_train, n_test, seed))


def _track(path: Path, units: Units) -> Track:
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            values = [number_of(word) for word in words]
        except ValueError:
            values = []
        if len(values) != 8 or any(map(math.isinf, values)):
            raise InputDataError(
                f"{path}, line {number}: {shown(line)}.",
                "8 numbers: timestamp tx ty tz qx qy qz qw.",
                "correct the line, or remove it.",
            )
        rows.append(values)
    table = np.array(rows).reshape(-1, 8)
    return units.track(str(path), table[:, 0], table[:, 1:4], table[:, [7, 4, 5, 6]])
