"""Coordinates in which slow errors are fitted, and the odds of a force that repeats."""

import numpy as np
import pytest
from cgwm.pipeline.segments.flights.repeated_forces import RepeatedForce
from cgwm.pipeline.segments.flights.restricted_likelihood import LEAST_WHITE, Components
from cgwm.pipeline.segments.flights.variance_components import _coded  # pyright: ignore[reportPrivateUsage]
from cgwm.pipeline.trajectories.innovations import CorrelatedNoise


@pytest.mark.parametrize("share", [0.2, 0.7])
def test_coordinates_of_noise_give_it_back(share: float) -> None:
    """But for the white noise that every process has beside it, which keeps its covariance regular."""
    noise = CorrelatedNoise(share=share, time_s=0.012, size=1.1, slow=0.8, slow_time_s=0.3, sway=2.5, order=1.5)
    more = [np.log(noise.slow), np.log(noise.slow_time_s), np.log(noise.sway)]
    found = Components.of(np.array([*_coded(noise), *more]), ("slow", "sway"), noise.order).noise(noise.level)
    for name, value in noise._asdict().items():
        assert getattr(found, name) == pytest.approx(value, rel=2 * LEAST_WHITE), name


def test_noise_without_slow_parts_has_none() -> None:
    found = Components.of(np.log([0.8, 0.6, 0.012]), (), 1.5).noise(())
    white, fast = 0.64 + LEAST_WHITE * 0.36, 0.36
    assert found == CorrelatedNoise(
        share=pytest.approx(fast / (white + fast)), time_s=pytest.approx(0.012),
        size=pytest.approx(np.sqrt(white + fast)), slow=0.0, slow_time_s=pytest.approx(1.0), order=1.5,
    )  # fmt: skip
    assert Components.of(np.log([0.8, 0.6, 0.012, 2.0]), ("sway",), 0.5).noise((0, 1, 2))[3:7] == (
        0.0,
        1.0,
        2.0,
        (0, 1, 2),
    )


@pytest.mark.parametrize("gains", [(40.0,), (-9.0, 4.0, 5.0), (-9.0, -10.0, -11.0)])
def test_what_one_episode_or_no_gain_shows_is_no_repeated_force(gains: tuple[float, ...]) -> None:
    assert RepeatedForce(coordinate="x", frame="world", gains=gains).p_value == 1.0


def test_the_best_of_several_laws_has_their_odds() -> None:
    """Student's t of 4, 5, 6: 5 / (1 / sqrt 3) = 8.66 with 2 degrees of freedom, p = 0.00654."""
    one = RepeatedForce(coordinate="x", frame="world", gains=(4.0, 5.0, 6.0))
    assert one.p_value == pytest.approx(0.00654, rel=1e-3)
    three = RepeatedForce(coordinate="x", frame="world", gains=(4.0, 5.0, 6.0), tried=3)
    assert three.p_value == pytest.approx(3 * one.p_value)
