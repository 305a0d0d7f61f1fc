"""Residuals of rollouts: their derivatives, and those of items of several lengths in one batch."""

import pytest
import torch
from cgwm.pipeline.trajectories import residuals
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.residuals import TrajectoryResiduals
from helpers.diagnosis_data import NOISE, tosses, world_with


@pytest.mark.parametrize("parts", [False, True])
def test_differences_of_smooth_motion_are_its_derivatives_in_items_of_any_length(
    parts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = world_with("cube", {"linear_drag": {"c": 0.3}}, False)
    episodes = tosses(world, 1, count=3, duration_s=0.2)
    observations = Observations.of(world, episodes, [(0.0, 0.2), (0.0, 0.1), (0.0, 0.15)])
    made = [TrajectoryResiduals(world, [], observations, *NOISE, differences=k, smooth=k) for k in (False, True)]
    nothing = torch.zeros(0, dtype=torch.float64), torch.zeros(3, 12, dtype=torch.float64)
    rows, exact = made[0](*nothing, True)
    if parts:  # each length is rolled out alone
        alone = [([k], int(end)) for k, end in enumerate(observations.ends)]
        monkeypatch.setattr(residuals, "length_groups", lambda *_: alone[::-1])
    again, slopes = made[1](*nothing, True)
    assert exact is not None and slopes is not None
    torch.testing.assert_close(again, rows, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(slopes, exact, rtol=1e-4, atol=1e-4 * float(exact.abs().max()))
    for k, end in enumerate(observations.ends.tolist()):
        assert bool(rows[k, :end].any()) and not rows[k, end:].any() and not slopes[k, end:].any()
