"""`truth.json`: the true values of a synthetic scene. Calibration and fitting never read it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from ...schemas import CamerasFile, FileModel, read_json

TRUTH_FORMAT = "cgwm-truth/1"
TRUTH_FILE = "truth.json"
TRUTH_MESH = "truth_mesh.obj"

Vector3 = tuple[float, float, float]


class TrueContact(FileModel):
    """The true contact law: MuJoCo's, with one time constant, damping ratio and impedance at every depth."""

    friction: float
    """Friction coefficient between object and ground [1]."""
    friction_fingertip: float | None = None
    """The same between object and fingertip [1]; null where there is none."""
    natural_time_s: float
    """Inverse of the natural angular frequency of a contact [s]."""
    damping_ratio: float
    """Damping ratio of a contact [1]."""
    impedance: float
    """MuJoCo's constraint impedance [1]."""
    timestep_s: float
    """Step of the simulation [s]."""


class TrueObject(FileModel):
    """The true object."""

    family: str
    mesh: str = TRUTH_MESH
    """Its surface, body frame, metres; a file in the same folder."""
    mass_kg: float
    com_m: Vector3
    """Centre of mass, body frame [m]."""
    inertia_kg_m2: tuple[float, float, float, float, float, float]
    """xx yy zz xy xz yz about the centre of mass, body axes [kg m2]."""


class TrueMotion(FileModel):
    """The true motion of the object in one episode, at the times of its track."""

    first_contact_s: float | None
    """First contact with the ground (fall) or the fingertip (push) [s]."""
    time_s: tuple[float, ...]
    position_m: tuple[Vector3, ...]
    """Of the body frame's origin, world frame [m]."""
    quat_wxyz: tuple[tuple[float, float, float, float], ...]
    velocity_m_s: tuple[Vector3, ...]
    """Of the body frame's origin, world frame [m/s]."""
    omega_body_rad_s: tuple[Vector3, ...]
    """Angular velocity, body frame [rad/s]."""


class TruthFile(FileModel):
    """`truth.json`."""

    format: Literal["cgwm-truth/1"] = TRUTH_FORMAT
    scene: str
    seed: int
    object: TrueObject
    contact: TrueContact
    cameras: CamerasFile
    """The true cameras of photos and videos."""
    gain_rgb: dict[str, Vector3]
    """Exposure gain by channel, for the camera of the photos ('photos') and each video camera."""
    episodes: dict[str, TrueMotion]


def read_truth(capture: Path) -> TruthFile:
    """Read the truth of a synthetic capture, given the directory of the capture.

    Raises:
        InputDataError: If the file is missing or invalid.
    """
    return read_json(Path(capture) / TRUTH_FILE, TruthFile)
