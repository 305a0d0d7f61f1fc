"""Errors of impulses: what they do to a motion, how large they are found to be, and what they leave of the data."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.physics import State, simulate
from cgwm.pipeline.segments.impulse_errors import (
    KINDS,
    LIMITS,
    Impacts,
    ImpulseErrors,
    estimated_errors,
    impacts_of,
    projected_with,
)
from cgwm.pipeline.segments.segments import Segments
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.residuals import STATE_SIZE, state_prior
from cgwm.pipeline.trajectories.segmentation import Segment
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.fixed_surfaces import box
from helpers.worlds import F64, ball_body, law, world_of

NOISE = Noise(1e-3, 1e-2)
SHARES = np.array([0.2, 0.05, 0.02, 0.1])


def drop(spin: float = 0.0) -> Segments:
    """A ball that strikes the ground once in 0.12 s, in its true state, exactly measured."""
    world = world_of(ball_body(0.04), contact=law(0.3, 0.001, 0.3), step_s=0.0005)
    times = torch.arange(13, dtype=F64) / 100
    rows = torch.tensor([[0.0, 0.0, 0.14]]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[1.0, 0, -1.5]])
    start = State(*(row[None].to(F64) for row in (*rows, torch.tensor([[0.0, spin, 0.0]]))))
    motion = simulate(world, start, times)
    tracks = {
        world.bodies[0].name: Track(
            times.numpy(), motion.position_m[0, :, 0].numpy(), motion.quat_wxyz[0, :, 0].numpy()
        )
    }
    whole = Observations.of(world, [("one", tracks)], [(-math.inf, math.inf)])
    return Segments.of("contact", world, whole, [Segment(0, 0, 12)], NOISE).with_state(start)


def test_an_impulse_of_its_own_moves_the_body_after_the_impact() -> None:
    segments = drop()
    impacts = impacts_of(segments)
    assert impacts.frame.shape == (1, 1)
    frame = int(impacts.frame[0, 0])
    motion = segments.rollout()
    gained = float(motion.velocity_m_s[0, frame, 0, 2] - motion.velocity_m_s[0, frame - 1, 0, 2])
    beyond = gained  # the change of the velocity in the frame of the impact is the impulse beyond the weight
    after = torch.arange(13 - frame, dtype=F64) / 100
    columns = impacts.columns[0, frame:]
    torch.testing.assert_close(columns[:, 2, 0], beyond * after / NOISE.position_m, rtol=0.02, atol=1e-6)
    assert float(impacts.columns[0, :frame].abs().max()) == 0
    # a solid ball turns by 5/2 of the tangential impulse over its radius, and a torque about the normal turns it alone
    assert float(columns[-1, :3, 3].abs().max()) < 1e-6 < float(columns[-1, 5, 3].abs())
    across = columns[-1, :3, 1].norm() * NOISE.position_m
    turned = columns[-1, 3:, 1].norm() * NOISE.rotation_rad
    assert float(turned * 0.04 / across) == pytest.approx(2.5, rel=1e-3)


def test_bodies_in_flight_or_on_other_bodies_have_no_errors_of_impulses() -> None:
    segments = drop()
    aloft = segments.with_state(
        replace(segments.observations.state, position_m=torch.tensor([[[0.0, 0.0, 9.0]]], dtype=F64))
    )
    assert impacts_of(aloft).columns.shape == (1, 13, 6, 0)
    assert impacts_of(segments.in_world(replace(segments.world, surfaces=(box((0.1, 0.1, 0.1)),)))).frame.shape == (
        1,
        0,
    )


def _synthetic(count: int, seed: int, factor: Any = None) -> tuple[Any, torch.Tensor, torch.Tensor, Impacts]:
    """Segments of linear residuals with two impacts each, whose impulses are drawn as Student's t."""
    rng = np.random.default_rng(seed)
    states = rng.standard_normal((count, 10, 6, STATE_SIZE))
    columns = 100 * rng.standard_normal((count, 10, 6, 2 * len(KINDS)))
    wide = 1 / np.sqrt(rng.chisquare(LIMITS.freedom, (count, 2)) / LIMITS.freedom) if factor is None else factor
    drawn = np.repeat(wide, len(KINDS), 1) * np.tile(SHARES[KINDS.numpy()], 2) * rng.standard_normal((count, 12))
    rows = rng.standard_normal((count, 10, 6)) + np.einsum("btck,bk->btc", columns, drawn)
    segments = SimpleNamespace(dof=torch.full((count,), 60.0 - STATE_SIZE))
    frames = torch.tensor([[2, 5]]).expand(count, 2)
    return segments, torch.as_tensor(rows), torch.as_tensor(states), Impacts(frames, torch.as_tensor(columns))


def test_the_errors_are_those_that_the_impulses_have() -> None:
    found = estimated_errors(*_synthetic(80, 0))
    np.testing.assert_allclose(found.shares, SHARES, rtol=0.25)


def test_one_impact_that_is_wrong_by_far_widens_its_own_errors_alone() -> None:
    factor = np.ones((40, 2))
    usual = estimated_errors(*_synthetic(40, 1, factor))
    factor[7, 1] = 50.0
    found = estimated_errors(*_synthetic(40, 1, factor))
    np.testing.assert_allclose(found.shares, usual.shares, rtol=0.1)
    assert float(found.factor[7, 5]) > 20
    assert float(found.factor[8].max()) < 3
    # in a frame in which another fit has an impact it is as uncertain as the worst of its segment
    assert float(found.factor[7, 3]) == float(found.factor[7, 5])


def test_what_is_left_is_generalised_least_squares() -> None:
    segments, rows, states, impacts = _synthetic(3, 2)
    slopes = torch.as_tensor(np.random.default_rng(3).standard_normal((3, 10, 6, 2)))
    shares = torch.as_tensor(SHARES)
    errors = ImpulseErrors(shares, torch.ones(3, 10, dtype=F64))
    found = projected_with(segments, rows, torch.cat((slopes, states), -1), impacts, errors, 2)
    for k in range(3):
        y, x, p = (part[k].flatten(0, 1).numpy() for part in (rows, states, slopes))
        y, u = y.ravel(), impacts.columns[k].flatten(0, 1).numpy() * np.tile(SHARES[KINDS.numpy()], 2)
        free = x @ np.diag(1 / state_prior(1).numpy()) @ x.T
        covariance = np.eye(60) + u @ u.T + free
        inverse = np.linalg.inv(covariance)
        np.testing.assert_allclose(found.information[k], p.T @ inverse @ p, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(found.score[k], -p.T @ inverse @ y, rtol=1e-4, atol=1e-5)
        assert float(found.chi2[k]) == pytest.approx(y @ inverse @ y, rel=1e-6)
