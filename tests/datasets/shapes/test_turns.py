"""Rotations of quaternions against scipy's."""

import numpy as np
import pytest
from cgwm.datasets.shapes.turns import matrix_of, turn_between
from scipy.spatial.transform import Rotation


def test_matrices_and_turns_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 40, 4))
    b[:5] = a[:5]  # no turn
    b[5:10] = -a[5:10]  # the same orientation
    b[10:15] = a[10:15] + 1e-7 * b[10:15]
    first, second = (Rotation.from_quat(quat, scalar_first=True) for quat in (a, b))
    assert matrix_of(a) == pytest.approx(first.as_matrix(), abs=1e-14)
    unit_a, unit_b = (quat / np.linalg.norm(quat, axis=1, keepdims=True) for quat in (a, b))
    assert turn_between(unit_a, unit_b) == pytest.approx((first.inv() * second).as_rotvec(), abs=1e-13)
