"""Positions whose level axes are mirrored or exchanged contradict what the ground does to the turns."""

from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.consistency import check_consistency
from cgwm.schemas import InputDataError
from scipy.spatial.transform import Rotation

RADIUS_M, RATE_HZ = 0.03, 150.0
MANIFEST = """format = "cgwm-capture/1"
[world]
gravity_m_s2 = [0.0, 0.0, -9.81]
ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }
[[bodies]]
name = "ball"
mass_kg = 0.1
shape = { sphere = { radius_m = 0.03 } }
[splits]
train = []
"""


def bounced(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A throw with one impact that sticks: times, positions and orientations."""
    down, across = np.array([0, 0, -RADIUS_M]), np.array([1.0, 1.0, 0.0])
    v, w = np.append(1.5 * rng.normal(size=2), 0.0), 5 * rng.normal(size=3)
    start = np.append(rng.normal(size=2), 0.4)
    hit_s = np.sqrt(2 * (0.4 - RADIUS_M) / 9.81)
    slip = (v + np.cross(w, down)) * across
    after_v, after_w = v - slip / 3.5, w + np.cross(down, -slip / 3.5) / (0.4 * RADIUS_M**2)
    t = np.arange(0, 0.55, 1 / RATE_HZ)
    late = np.maximum(t - hit_s, 0)[:, None]
    early = np.minimum(t, hit_s)[:, None]
    up = np.where(t < hit_s, 0.4 - 4.905 * t**2, RADIUS_M + 1.9 * late[:, 0] - 4.905 * late[:, 0] ** 2)
    place = start + early * v + late * after_v
    place[:, 2] = up
    turn = Rotation.from_rotvec(late * after_w) * Rotation.from_rotvec(early * w)
    quat = (turn * Rotation.from_rotvec(rng.normal(size=3))).as_quat()[:, [3, 0, 1, 2]]
    return t, place + 3e-4 * rng.normal(size=place.shape), quat


def rolled(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A ball that rolls without slip."""
    v = np.append(rng.normal(size=2), 0.0)
    t = np.arange(0, 0.5, 1 / RATE_HZ)
    place = np.array([0, 0, RADIUS_M]) + t[:, None] * v
    quat = Rotation.from_rotvec(t[:, None] * np.cross([0, 0, 1], v) / RADIUS_M).as_quat()[:, [3, 0, 1, 2]]
    return t, place + 3e-4 * rng.normal(size=place.shape), quat


def capture_of(root: Path, motion, exchange: np.ndarray) -> Path:
    rng = np.random.default_rng(5)
    (root / "tracks").mkdir(parents=True)
    (root / "capture.toml").write_text(MANIFEST)
    for k in range(8):
        t, place, quat = motion(rng)
        rows = np.column_stack((t, place @ exchange.T, quat))
        lines = [f"{row[0]:.5f},ball," + ",".join(f"{value:.6f}" for value in row[1:]) for row in rows]
        (root / "tracks" / f"{k}.csv").write_text("\n".join(["time_s,body,px_m,py_m,pz_m,qw,qx,qy,qz", *lines]) + "\n")
    return root


@pytest.mark.parametrize("motion", [bounced, rolled])
@pytest.mark.parametrize(
    ("exchange", "said"),
    [
        (((1, 0, 0), (0, -1, 0), (0, 0, 1)), "the positions' y axis is mirrored against the turns"),
        (((-1, 0, 0), (0, 1, 0), (0, 0, 1)), "the positions' x axis is mirrored against the turns"),
        (((0, 1, 0), (1, 0, 0), (0, 0, 1)), "the positions' axes x and y are exchanged against the turns"),
        (((0, -1, 0), (1, 0, 0), (0, 0, 1)), "turned by 90 degrees against each other"),
        (((1, 0, 0), (0, 1, 0), (0, 0, 1)), None),
    ],
)
def test_exchanged_level_axes_are_refused_with_the_remedy(tmp_path: Path, motion, exchange, said) -> None:
    root = capture_of(tmp_path / "c", motion, np.array(exchange, float))
    if said is None:
        assert check_consistency(Capture.open(root)) == []
        return
    with pytest.raises(InputDataError) as error:
        Capture.open(root)
    assert said in str(error.value) and "contradicts what it does to its turns" in str(error.value)
    # what the remedy says undoes it
    undone = {
        "y axis": np.diag([1.0, -1, 1]), "x axis": np.diag([-1.0, 1, 1]),
        "axes x and y": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]),
        "90 degrees": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    }  # fmt: skip
    remedy = next(matrix for words, matrix in undone.items() if words in said)
    assert np.allclose(remedy @ np.array(exchange, float), np.eye(3))
    words = {"y axis": "multiply py_m by -1", "x axis": "multiply px_m by -1", "axes x and y": "exchange px_m and py_m",
             "90 degrees": "write py_m as px_m and -px_m as py_m"}  # fmt: skip
    assert next(text for key, text in words.items() if key in said) in str(error.value)


def test_an_episode_that_shows_the_frame_as_written_rules_an_exchange_out(tmp_path: Path) -> None:
    mirror = np.diag([1.0, -1.0, 1.0])
    root = capture_of(tmp_path / "c", bounced, mirror)
    right = capture_of(tmp_path / "d", rolled, np.eye(3))
    (root / "tracks" / "0.csv").write_text((right / "tracks" / "0.csv").read_text())
    assert check_consistency(Capture.open(root)) == []


def test_one_episode_alone_shows_no_exchange(tmp_path: Path) -> None:
    root = capture_of(tmp_path / "c", rolled, np.diag([1.0, -1.0, 1.0]))
    for k in range(1, 8):
        (root / "tracks" / f"{k}.csv").unlink()
    assert check_consistency(Capture.open(root)) == []
