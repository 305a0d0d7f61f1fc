"""A swing of a pendulum that touches nothing gives back the losses in its joint and its inertia."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.datasets.capture.tracks import Episode
from cgwm.pipeline.phys_geo.tracks import joint_fit
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.physics.chains.parameters import chain_parameters
from cgwm.pipeline.physics.chains.state import with_joints
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.parameters import apply_parameters
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import PhysConfig
from helpers.chains import chained, double_pendulum, still
from helpers.worlds import F64, times

TRUTH = {"first.damping": 0.004, "first.friction": 0.006, "arm.inertia_factor": 1.3}
START = ({"first": 1.2}, {"first": -2.0})


def swung(duration_s: float) -> tuple[World, dict[str, Track]]:
    """Return a pendulum and tracks of its swing, 20 frames a second."""
    chain, bodies = double_pendulum()
    chain, bodies = replace(chain, joints=chain.joints[:1]), bodies[:2]
    world = chained(chain, *bodies, ground=False, step_s=0.002)
    names = chain_parameters(world)
    true = apply_parameters(world, names, torch.tensor([[TRUTH[p.name] for p in names]], dtype=F64))
    grid, rng = times(duration_s, 20.0), np.random.default_rng(0)
    seen = rollout(true, with_joints(true, still(2), *START), grid)
    shift = 1e-4 * rng.standard_normal((2, len(grid), 3))
    return world, {
        body.name: Track(grid.numpy(), seen.position_m[0, :, k].numpy() + shift[k], seen.quat_wxyz[0, :, k].numpy())
        for k, body in enumerate(bodies)
    }


def test_a_swing_of_few_frames_is_fitted_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """An eighth of five frames is none."""
    monkeypatch.setattr(joint_fit, "ITERATIONS", 1)
    monkeypatch.setattr(joint_fit, "SHARES", (0.125, 1.0))
    world, tracks = swung(0.2)
    parameters = chain_parameters(world)
    values, covariance = joint_fit.fit_joints(
        world, [Episode("0", tracks)], [(0.0, 0.2)], parameters, Noise(1e-4, 1e-3)
    )
    assert np.isfinite(values).all() and (covariance.diagonal() > 0).all()


def test_a_swing_gives_back_losses_and_inertia(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_fit, "SHARES", (0.25, 1.0))  # it is short
    world, tracks = swung(0.5)
    found = fit_physics(world, [("0", tracks)], PhysConfig(step_s=0.002), noise=(1e-4, 1e-3))
    fitted = {p.name: p for p in found.parameters}
    for name, value in TRUTH.items():
        assert abs(fitted[name].estimate / value - 1) < 0.02, name
        assert fitted[name].state == "fitted"
    assert all(fitted[name].state == "not_observable" for name in ("friction", "contact_time_s", "damping_ratio"))
    assert "nothing touches anything" in found.warnings[0]
