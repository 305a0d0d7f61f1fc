"""Which six numbers are the inertia of a body: of every set of points, and of no other matrix."""

import numpy as np
import pytest
from cgwm.pipeline.physics.inertia import inertia_elements, symmetric
from cgwm.schemas.capture import physical_inertia


def _six(matrix: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in (*np.diag(matrix), matrix[0, 1], matrix[0, 2], matrix[1, 2]))


def _turned(moments: list[float], seed: int) -> tuple[float, ...]:
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return _six(q @ np.diag(moments) @ q.T)


@pytest.mark.parametrize("seed", range(12))
def test_a_body_has_it_in_every_orientation(seed: int) -> None:
    points = np.random.default_rng(seed).standard_normal((4, 3)) * [1, 0.3, 0.05]
    cloud = 1e-4 * sum(p @ p * np.eye(3) - np.outer(p, p) for p in points)
    assert physical_inertia(_six(cloud)) == _six(cloud)
    plate = _turned([1.0, 1.5, 2.5], seed)
    assert physical_inertia(plate) == plate, "a thin plate: one moment is the sum of the others"


@pytest.mark.parametrize("seed", range(12))
def test_a_moment_above_the_sum_of_the_others_is_refused_in_every_orientation(seed: int) -> None:
    with pytest.raises(ValueError, match="one moment is larger"):
        physical_inertia(_turned([1.0, 1.5, 2.7], seed))
    with pytest.raises(ValueError, match="positive definite"):
        physical_inertia(_turned([1.0, 1.2, -0.1], seed))


def test_elements_of_a_symmetric_matrix_and_back() -> None:
    six = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    assert inertia_elements(symmetric(six)) == six
