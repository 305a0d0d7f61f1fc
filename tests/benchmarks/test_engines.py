"""The engines of Fall, Push and Tip (benchmarks/tabletop/engines): what every one of them must do by the laws."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from cgwm.datasets.synthetic.dynamics import GRAVITY, matrix_from_quat, rest_pose
from cgwm.datasets.synthetic.objects import make_object, resting_down
from numpy.typing import NDArray

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
NAMES = ("mujoco", "mujoco_default", "drake", "dart", "rapier")
pytestmark = pytest.mark.evidence
BOX = make_object(0)


@pytest.fixture(scope="module")
def engines() -> ModuleType:
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import engine_floor  # noqa: F401
        import tabletop.engines
        import tabletop.materials
        import tabletop.pushes
    finally:
        sys.path.remove(str(BENCHMARKS))
    return tabletop


@pytest.fixture(params=NAMES)
def make(request: pytest.FixtureRequest, engines: ModuleType):
    reason = engines.engines.refusal(request.param, BOX)
    if reason is not None:
        pytest.skip(f"{request.param}: {reason}")
    contact = engines.materials.MATERIALS["wood"]
    return lambda fingertip: engines.engines.ENGINES[request.param].make(BOX, contact, fingertip)


def _at_rest(height: float = 0.0) -> NDArray[np.float64]:
    pose = rest_pose(BOX, resting_down(BOX), 0.3, 0, 0)
    pose[2] += height
    return pose


def test_a_sliding_box_stops_after_v2_over_2_mu_g(make, engines: ModuleType) -> None:
    friction, speed = engines.materials.MATERIALS["wood"].friction, 0.7
    motion = make(False).simulate(_at_rest(), np.array([speed, 0, 0, 0, 0, 0]), 0.0, 0.8)
    slid = np.linalg.norm(motion.qpos[-1, :2] - motion.qpos[0, :2])
    assert slid == pytest.approx(speed**2 / (2 * friction * GRAVITY), rel=0.03)
    assert abs(motion.qpos[-1, 2] - motion.qpos[0, 2]) < 2e-4


def test_friction_is_a_cone_but_for_the_two_engines_that_say_otherwise(engines: ModuleType) -> None:
    """A pyramid along the world's axes: inscribed in MuJoCo's default contacts, circumscribed in DART."""
    import engine_floor

    given = engines.materials.MATERIALS["wood"].friction
    for name, factor in {"mujoco": 1, "mujoco_default": 0.5**0.5, "drake": 1, "dart": 2**0.5, "rapier": 1}.items():
        if engines.engines.refusal(name, BOX) is None:
            assert engine_floor.friction_by_direction(name)[2] == pytest.approx(factor * given, rel=0.03)


def test_impacts_slide_by_coulombs_law_but_for_the_two_engines_that_say_otherwise(engines: ModuleType) -> None:
    """Rapier bounds the friction of an impact by less than the whole normal impulse, DART by more than its friction."""
    import engine_floor

    ranges = {"mujoco": (0.9, 1.01), "drake": (0.97, 1.01), "dart": (1.1, 1.42), "rapier": (0.3, 0.45)}
    for name, (low, high) in ranges.items():
        if engines.engines.refusal(name, BOX) is None:
            assert low < np.median(engine_floor.friction_of_impacts(name, "wood")) < high


def test_the_centre_of_mass_flies_along_its_parabola(make) -> None:
    """Up to the first order in the step, g dt t / 2, by which semi-implicit steps fall lower."""
    velocity, omega = np.array([0.5, 0.2, 1.0]), np.array([3.0, -4.0, 5.0])
    pose, t = _at_rest(3.0), 0.4
    motion = make(False).simulate(pose, np.concatenate((velocity, omega)), 0.0, t)

    def com(row: int) -> NDArray[np.float64]:
        return motion.qpos[row, :3] + matrix_from_quat(motion.qpos[row, 3:7]) @ BOX.com

    start = velocity + matrix_from_quat(pose[3:7]) @ np.cross(omega, BOX.com)
    expected = com(0) + start * t - np.array([0, 0, GRAVITY * t**2 / 2])
    assert np.abs(com(-1) - expected).max() < GRAVITY / 3600 * t / 2 + 5e-5
    assert motion.first_contact is None


def test_a_dropped_box_lands_when_it_must_and_bounces_lower(make) -> None:
    motion = make(False).simulate(_at_rest(0.1), np.zeros(6), 0.0, 0.5)
    assert motion.first_contact == pytest.approx(np.sqrt(2 * 0.1 / GRAVITY), abs=0.003)
    assert motion.qpos[-1, 2] == pytest.approx(_at_rest()[2], abs=5e-4)


def test_a_fingertip_takes_the_box_along(make) -> None:
    from cgwm.datasets.synthetic.dynamics import FINGERTIP_RADIUS, STEPS_PER_S

    half = np.abs(BOX.vertices).max(axis=0)
    times = np.arange(round(0.3 * STEPS_PER_S) + 1) / STEPS_PER_S
    pose = rest_pose(BOX, resting_down(BOX), 0.0, 0, 0)
    edge = (BOX.vertices @ matrix_from_quat(pose[3:7]).T)[:, 0].max()
    path = np.stack((edge + FINGERTIP_RADIUS + 0.01 - 0.2 * times, 0 * times, np.full_like(times, 0.5 * half[2])), 1)
    command = path, np.tile([-0.2, 0.0, 0.0], (len(times), 1))
    motion = make(True).simulate(pose, np.zeros(6), 0.0, 0.3, command)
    assert motion.first_contact == pytest.approx(0.05, abs=0.01)
    assert motion.qpos[-1, 0] < -0.04
    assert motion.qpos[:, 7:10] == pytest.approx(path)


def test_the_tallest_rest_of_a_box_is_on_its_smallest_face(engines: ModuleType) -> None:
    down = engines.pushes.tall_rest(BOX)
    sides = np.ptp(BOX.vertices, axis=0)
    assert np.abs(down).argmax() == sides.argmax()
    assert np.abs(down).max() == pytest.approx(1.0)
