"""Import of the elbow tosses of dair_pll (DAIRLab/dair_pll, BSD-3): two links with a free hinge, and their URDF.

A toss is a tensor (T, 15) of float64: quaternion of the first link with w first, its position [m], angle of the hinge
[rad], angular velocity [rad/s] of the first link, its velocity [m/s], and the hinge's rate [rad/s]. Frames are 0.0068 s
apart. In the published tosses the angular velocity agrees with differences of the quaternions in the link's own axes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas import Articulation, Ground, InputDataError, World
from ...schemas.imports import ImportResult
from ..capture.tracks import Track
from ..io.atomic import new_directory
from ..io.outputs import reads
from ..robots import JointOfRobot, read_articulation
from ..shapes.turns import matrix_of, quat_of_matrix
from .archives import unpacked
from .recordings import Recording, drawn_splits, write_recordings
from .tensors import read_tensor

Array = NDArray[np.float64]

STEP_S = 0.0068
"""Time between frames [s]."""
NAME = "elbow"
"""Name of the jointed body, and of its file in the capture."""
_COLUMNS = 15
_TODO = "get assets/contactnets_elbow of github.com/DAIRLab/dair_pll."


@reads("source")
def import_elbow(
    source: Path | str,
    out: Path | str,
    n_train: int | None = None,
    n_test: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> ImportResult:
    """Write tosses of an elbow as a capture with one jointed body, one episode per toss, named by its number.

    The manifest's [[articulations]] names the URDF, which is copied; tracks have a row for each link.

    Args:
        source: A folder or a .tar (.gz, .xz) with <number>.pt files and one URDF.
        out: The capture directory to write.
        n_train: Number of tosses to fit on; None: 60 %.
        n_test: Number of tosses to test on; None: the others.
        seed: Seed of the permutation.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the source is not such data.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory, unpacked(Path(source), (".pt", ".urdf")) as folder:
        urdf = _only_urdf(Path(source), folder)
        joint = _only_hinge(urdf)
        files = sorted(folder.rglob("*.pt"), key=_number)
        if not files:
            raise InputDataError(f"{source}: no tosses.", "<number>.pt files.", _TODO)
        recordings = [Recording(name=f"{_number(file):03d}", tracks=_tracks(file, joint)) for file in files]
        splits = drawn_splits(recordings, n_train, n_test, seed)
        (directory / f"{NAME}.urdf").write_bytes(urdf.read_bytes())
        world, elbow = World(ground=Ground()), Articulation(name=NAME, urdf=f"{NAME}.urdf")
        return write_recordings(directory, out, world, (), recordings, splits, articulations=(elbow,))


def _only_urdf(source: Path, folder: Path) -> Path:
    found = sorted({path for path in folder.rglob("*.urdf") if path.is_file()})
    if len(found) != 1:
        listed = ", ".join(path.name for path in found) or "none"
        raise InputDataError(f"{source}: URDF files: {listed}.", "one, which has the elbow's links and hinge.", _TODO)
    return found[0]


def _only_hinge(urdf: Path) -> JointOfRobot:
    found = read_articulation(urdf)
    for link in found.links:
        if any(part.mesh is not None for part in link.geometry):
            raise InputDataError(
                f"{urdf.name}: link '{link.name}' is a mesh.", "boxes, as in the published file.", _TODO
            )
    joints = found.joints
    if len(joints) != 1 or joints[0].kind != "hinge":
        listed = ", ".join(f"{joint.name} ({joint.kind})" for joint in joints)
        raise InputDataError(f"{urdf.name}: its joints are {listed}.", "two links and one hinge.", _TODO)
    return joints[0]


def _number(file: Path) -> int:
    if not file.stem.isdecimal():
        raise InputDataError(f"{file.name}: the name is no toss number.", "<number>.pt.", _TODO)
    return int(file.stem)


def _tracks(file: Path, hinge: JointOfRobot) -> dict[str, Track]:
    """Return the tracks of both links of a toss."""
    rows = read_tensor(file, _COLUMNS)
    if len(rows) < 2 or not np.isfinite(rows).all():
        raise InputDataError(
            f"{file.name}: {len(rows)} frames, or numbers that are not finite.",
            "2 or more, finite.",
            "take the original file.",
        )
    norms = np.linalg.norm(rows[:, :4], axis=1)
    if (np.abs(norms - 1) > 1e-3).any():
        raise InputDataError(
            f"{file.name}: a quaternion has norm {norms[np.abs(norms - 1).argmax()]:.4f}.",
            "norm 1.",
            "take the original file.",
        )
    time, quat, position = np.arange(len(rows), dtype=np.float64) * STEP_S, rows[:, :4] / norms[:, None], rows[:, 4:7]
    turns = matrix_of(quat)
    place = position + turns @ hinge.position_m
    own = np.stack([_about(hinge, angle) for angle in rows[:, 7]])
    second = np.stack(
        [quat_of_matrix(turn @ matrix_of(hinge.quat_wxyz) @ by) for turn, by in zip(turns, own, strict=True)]
    )
    return {
        hinge.parent: Track(time_s=time, position_m=position, quat_wxyz=quat),
        hinge.link: Track(time_s=time, position_m=place, quat_wxyz=second),
    }


def _about(hinge: JointOfRobot, angle: float) -> Array:
    """Return the rotation (3, 3) about the axis of a hinge by an angle [rad]."""
    axis = hinge.axis / np.linalg.norm(hinge.axis)
    return matrix_of(np.array([np.cos(0.5 * angle), *(np.sin(0.5 * angle) * axis)]))
