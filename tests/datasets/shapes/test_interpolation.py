"""Linear interpolation of several columns."""

import numpy as np
from cgwm.datasets.shapes.interpolation import by_column


def test_each_column_is_linear_between_its_knots_and_beyond_them_holds_on_or_is_what_was_asked_for() -> None:
    knots, values = np.array([0.0, 1.0, 3.0]), np.array([[0.0, 5.0], [2.0, 5.0], [6.0, 1.0]])
    at = np.array([[0.5, 2.0], [-1.0, 4.0]])
    inside = [[[1.0, 5.0], [4.0, 3.0]]]
    assert np.array_equal(by_column(at, knots, values), [*inside, [[0.0, 5.0], [6.0, 1.0]]])
    assert np.array_equal(by_column(at, knots, values, outside=0.0), [*inside, [[0.0, 0.0], [0.0, 0.0]]])
    assert np.array_equal(by_column(2.0, knots, values), [4.0, 3.0])
