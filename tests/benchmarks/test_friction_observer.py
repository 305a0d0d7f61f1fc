"""The observer of friction: what it finds by how much it sees and does not know."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))  # as `python benchmarks/friction_observer.py` has it
try:
    import friction_observer
finally:
    sys.path.remove(str(BENCHMARKS))

NOTHING = (np.zeros((4, 0)), np.zeros(0))


def test_the_error_is_that_of_the_noise() -> None:
    slope = np.array([1.0, 2.0, 0.0, -1.0])
    tried = np.log(friction_observer.FACTORS)[:, None] * slope
    noise = 0.05**2 * np.eye(4)
    error = friction_observer.medians(tried, noise, *NOTHING, seed=1)
    assert abs(error - 0.6745 * 0.05 / np.sqrt(6)) < 0.002  # a normal error of 0.05 / |slope|


def test_what_is_not_known_takes_what_it_explains() -> None:
    slope = np.array([1.0, 1.0, 0.0, 0.0])
    tried = np.log(friction_observer.FACTORS)[:, None] * slope
    noise, start = 0.02**2 * np.eye(4), np.array([[1.0], [0.0], [0.0], [0.0]])
    known = friction_observer.medians(tried, noise, *NOTHING, seed=1)
    half = friction_observer.medians(tried, noise, start, np.array([10.0]), seed=1)
    none = friction_observer.medians(tried, noise, slope[:, None], np.array([10.0]), seed=1)
    assert 1.2 < half / known < 1.6 and none > 10 * known


def test_poses_apart_and_their_errors() -> None:
    turned = Rotation.from_rotvec([[0.0, 0.0, 0.1], [0.2, 0.0, 0.0]])
    gaps = friction_observer.apart((np.ones((2, 3)), turned), (np.zeros((2, 3)), Rotation.identity(2)))
    assert np.allclose(gaps.reshape(2, 6), [[1, 1, 1, 0, 0, 0.1], [1, 1, 1, 0.2, 0, 0]])
    errors = friction_observer.covariance(np.array([0.0, 0.15]))
    (white, _), (slow, turn) = friction_observer.WHITE, friction_observer.SLOW
    assert np.isclose(errors[0, 0], white**2 + slow**2) and np.isclose(errors[0, 6], slow**2 * np.exp(-0.5))
    assert np.isclose(errors[3, 9], turn**2 * np.exp(-0.5)) and errors[0, 1] == errors[0, 3] == 0
