"""What must not be refused: legitimate captures that are unlike the usual ones, and all valid inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .captures import write_toss_capture
from .edits import FIT, Edit, Row, field, nothing, tracks
from .subjects import IMPROVE, SUBJECTS

VALIDATE = ("validate", "capture")
G = 9.81


def rows() -> Iterator[Row]:
    """Yield the table: valid inputs with all commands that are quick, and captures of its own."""
    for subject in SUBJECTS.values():
        for command in subject.commands:
            if command.weight >= 0.3 and subject.name not in ("custom effect", "dataset without images"):
                name = f"{subject.name}: {' '.join(command.words[:4])}"
                yield Row(name, subject.kind, subject.name, nothing, command.words)
    yield Row("tracks: improve", "captures", "tracks", nothing, IMPROVE.words)
    for name, build in CAPTURES.items():
        yield Row(f"{name}: validate", "captures", "nothing", build, VALIDATE)
        if name not in NO_FIT:
            yield Row(f"{name}: fit", "captures", "nothing", build, FIT)
    for name, edit in EDITS:
        yield Row(f"{name}: validate", "captures", "tosses", edit, VALIDATE)


def flights(
    acceleration: Callable[[np.ndarray], np.ndarray],
    speed: float,
    rate_hz: float = 100.0,
    length_s: float = 0.6,
    noise: float = 3e-4,
    count: int = 6,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times and positions of flights under an acceleration that depends on the velocity, by small steps."""
    rng, found, axis = np.random.default_rng(7), [], np.array(up)
    times = np.arange(round(length_s * rate_hz)) / rate_hz
    for _ in range(count):
        side = np.cross(axis, rng.standard_normal(3))
        velocity = speed * (0.7 * side / np.linalg.norm(side) + 0.7 * axis)
        position, rows = 2.0 * axis + 0.1 * rng.standard_normal(3), []
        for _ in times:
            rows.append(position.copy())
            for _ in range(10):
                velocity = velocity + acceleration(velocity) / rate_hz / 10
                position = position + velocity / rate_hz / 10
        found.append((times, np.array(rows) + noise * rng.standard_normal((len(times), 3))))
    return found


def flying(
    mass_kg: float,
    radius_m: float,
    drag: float,
    gravity: float = G,
    lift: float = 0.0,
    ground: bool = False,
    constant: bool = False,
    **motion: float,
) -> Edit:
    """Return an edit that writes a capture of a ball in flight: drag [1/m] quadratic, lift [m/s2] against gravity."""

    def build(root: Path) -> None:
        def acceleration(v: np.ndarray) -> np.ndarray:
            return np.array([0.0, 0.0, lift - gravity]) - drag * np.linalg.norm(v) * v

        made = flights(acceleration, **{"speed": 3.0, **motion})
        quats = [np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)) if constant else None for t, _ in made]
        _write(root, made, quats, f"{{ sphere = {{ radius_m = {radius_m} }} }}", mass_kg, (0.0, 0.0, -gravity), ground)

    return build


def _write(
    root: Path, made: list, quats: list, shape: str, mass_kg: float, gravity: Sequence[float], ground: bool
) -> None:
    from cgwm.datasets.capture.tracks import Track, write_tracks

    folder = root / "capture" / "tracks"
    folder.mkdir(parents=True)
    names = [f"{k:03d}" for k in range(len(made))]
    plane = "ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }\n" if ground else ""
    (root / "capture" / "capture.toml").write_text(
        f'format = "cgwm-capture/1"\n[world]\ngravity_m_s2 = {list(gravity)}\n{plane}[[bodies]]\nname = "ball"\n'
        f"mass_kg = {mass_kg}\nshape = {shape}\n[splits]\ntrain = {names[:-2]}\ntest = {names[-2:]}\n".replace("'", '"')
    )
    for name, (time, position), quat in zip(names, made, quats, strict=True):
        write_tracks(folder / f"{name}.csv", {"ball": Track(time, position, quat)})


def turned(rotation: Rotation) -> Edit:
    """Return an edit that turns the usual tosses with gravity and ground: another world frame."""

    def build(root: Path) -> None:
        write_toss_capture(root)
        matrix = rotation.as_matrix()
        normal, down = matrix @ [0.0, 0.0, 1.0], matrix @ [0.0, 0.0, -G]
        listed = [repr([float(x) for x in vector]) for vector in (normal, down)]
        field("capture/capture.toml", "world ground", f"{{ normal = {listed[0]}, offset_m = 0.0 }}")(root)
        field("capture/capture.toml", "world gravity_m_s2", listed[1])(root)

        def change(columns: dict[str, np.ndarray]) -> None:
            position = np.stack([columns[key] for key in ("px_m", "py_m", "pz_m")], 1) @ matrix.T
            quat = np.stack([columns[key] for key in ("qx", "qy", "qz", "qw")], 1)
            quat = (rotation * Rotation.from_quat(quat)).as_quat()
            for k, key in enumerate(("px_m", "py_m", "pz_m")):
                columns[key] = position[:, k]
            for k, key in enumerate(("qx", "qy", "qz", "qw")):
                columns[key] = quat[:, k]

        tracks(change)(root)

    return build


def hidden(index: int) -> Edit:
    """Return an edit that writes a capture of the benchmark of `diagnose`: an effect that no model has."""

    def build(root: Path) -> None:
        from cgwm.datasets.synthetic.hidden_effects import make_capture

        make_capture(root / "capture", benchmark()[index], root / "truth.json")

    return build


def benchmark() -> list:
    """Return the captures of the benchmark, of all kinds: usual, rough, odd."""
    from cgwm.datasets.synthetic.hidden_effects import cases, odd_cases, rough_cases

    made = [*cases("development"), *rough_cases("development"), *odd_cases("development")]
    return sorted(made, key=lambda case: case.name)


def _rest(root: Path) -> None:
    """Write a ball that lies still, as a first try of a tracker does."""
    time = np.arange(100) / 100
    made = [
        (time, np.tile([0.1 * k, 0.0, 0.03], (100, 1)) + 1e-4 * np.random.default_rng(k).standard_normal((100, 3)))
        for k in range(4)
    ]
    _write(root, made, [None] * 4, "{ sphere = { radius_m = 0.03 } }", 0.1, (0.0, 0.0, -G), True)


def engine(gravity: float = G, ramp_deg: float = 0.0, size: float = 1.0, mass_kg: float = 1.0, **how: float) -> Edit:
    """Return an edit that writes tosses made by the engine: on a ramp, on the moon, of a bead, of a heavy body."""
    return lambda root: write_toss_capture(root, gravity=gravity, ramp_deg=ramp_deg, size=size, mass_kg=mass_kg, **how)


CAPTURES: dict[str, Edit] = {
    "z points down": turned(Rotation.from_euler("x", 180, degrees=True)),
    "y points up": turned(Rotation.from_euler("x", -90, degrees=True)),
    "a world turned anyhow": turned(Rotation.from_euler("xyz", [35, -50, 110], degrees=True)),
    "a ramp of 40 degrees": engine(ramp_deg=40.0),
    "the moon": engine(gravity=1.62, length_s=1.2),
    "Jupiter": engine(gravity=24.8),
    "a bead of 10 mm": engine(size=0.1, mass_kg=0.002),
    "a body of 20 kg": engine(mass_kg=20.0),
    "a body of 2 m": engine(size=20.0, mass_kg=60.0, length_s=1.5),
    "a balloon": flying(0.004, 0.14, 1.0, lift=0.8 * G, length_s=2.0, speed=2.0),
    "a table-tennis ball in strong drag": flying(0.0027, 0.02, 0.12, speed=12.0),
    "a ball written with a constant orientation": flying(0.06, 0.033, 0.01, constant=True),
    "a ball of lead": flying(5.0, 0.048, 0.0),
    "buoyancy in water": flying(0.2, 0.04, 1.2, lift=0.6 * G, speed=1.0),
    "1 kHz for 2 min": flying(0.06, 0.033, 0.0, gravity=1e-9, rate_hz=1000.0, length_s=120.0, speed=0.001, count=4),
    "a ball at rest": _rest,
    **{f"benchmark of diagnose {k}": hidden(k) for k in range(0, 24)},
}
NO_FIT = ("1 kHz for 2 min", "a ball at rest", *(f"benchmark of diagnose {k}" for k in range(24) if k % 6))
"""Captures whose fit takes long, or cannot be for a reason of its own."""


def _without_ground(root: Path) -> None:
    path = root / "capture" / "capture.toml"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("ground")) + "\n")


def _gap(columns: dict[str, np.ndarray]) -> None:
    keep = np.r_[0:15, 25 : len(columns["time_s"])]
    for key in columns:
        columns[key] = columns[key][keep]


EDITS: tuple[tuple[str, Edit], ...] = (
    ("no ground", _without_ground),
    ("an absolute clock", tracks(lambda columns: columns.update(time_s=columns["time_s"] + 1.7e9))),
    ("a mass of 1 g", field("capture/capture.toml", "bodies 0 mass_kg", "0.001")),
    ("a gap of 0.1 s", tracks(_gap)),
    ("far from the origin", tracks(lambda columns: columns.update(px_m=columns["px_m"] + 120.0))),
    ("a driven body", field("capture/capture.toml", "bodies 0 motion", '"driven"')),
)
