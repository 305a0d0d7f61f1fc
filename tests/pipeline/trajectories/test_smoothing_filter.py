"""The filter of tracks is told from their errors in flight."""

from typing import Any

import numpy as np
import pytest
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.trajectories.innovations import CorrelatedNoise
from cgwm.pipeline.trajectories.segmentation import Segment, whole_episodes
from cgwm.pipeline.trajectories.smoothing_filter import LIMITS, smoothing_filter
from helpers.diagnosis_data import world_with
from scipy.signal import butter, filtfilt, savgol_filter

RATE_HZ, STD_M = 100.0, 3e-4


def falls(smooth: Any) -> list[tuple[str, dict[str, Track]]]:
    """Return falls with white errors, smoothed."""
    rng, times = np.random.default_rng(0), np.arange(40) / RATE_HZ
    path = np.outer(times, (1.0, 0.5, 0.0)) + np.outer(2.0 - 4.9 * times**2, (0.0, 0.0, 1.0))
    errors = STD_M * rng.standard_normal((12, 40, 3))
    return [(f"{k}", {"ball": Track(times, smooth(path + own), None)}) for k, own in enumerate(errors)]


@pytest.mark.parametrize("cutoff_hz", [15.0, 30.0])
def test_a_low_pass_is_found_with_its_cut_off(cutoff_hz: float) -> None:
    low: Any = butter(2, cutoff_hz, fs=RATE_HZ)
    found = of(lambda values: filtfilt(*low, values, axis=0))
    assert found is not None and found.low_pass
    assert found.reach == pytest.approx(LIMITS.cutoff_periods * RATE_HZ / cutoff_hz, rel=0.25)


def test_parabolas_are_found_with_their_window() -> None:
    found = of(lambda values: savgol_filter(values, 9, 2, axis=0))
    assert found is not None and not found.low_pass and found.reach == 4


def test_errors_that_no_filter_made_have_none() -> None:
    assert of(lambda values: values) is None


def of(smooth: Any) -> Any:
    """Return the filter that is found."""
    whole = whole_episodes(world_with("ball"), falls(smooth))
    flights = [Segment(k, 0, 39) for k in range(12)]
    return smoothing_filter(whole, flights, STD_M, CorrelatedNoise(0.9, 0.02, order=1.5))
