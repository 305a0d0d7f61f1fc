"""A tilt that all episodes have is named where it exceeds what levels of each episode's own do by chance."""

import pytest
from cgwm.pipeline.diagnose.flight.levelling import common_tilt_p
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with


@pytest.mark.parametrize(("tilt_rad", "exceeds"), [(0.004, False), (0.02, True)])
def test_a_tilt_counts_beside_the_levels_of_episodes(tilt_rad: float, exceeds: bool) -> None:
    noise, world = Noise(1e-4, 1e-3), world_with("ball")
    tilted = world_with("ball", {"gravity_tilt": {"tilt_x": tilt_rad}})
    prepared = prepare(world, tosses(tilted, 3, 4, 0.4, 60.0, noise, (0.9, 1.2)), noise)
    assert prepared.flight is not None
    # the tracks alone tell both: an acceleration of 0.04 m/s2 to 0.005
    assert (common_tilt_p(prepared.flight, world, prepared.groups, 1.0) < 1e-4) == exceeds
