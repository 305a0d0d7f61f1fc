"""The published contact law: what its formulas say, defects included."""

import math
from dataclasses import replace

import pytest
import torch
from cgwm.pipeline.physics import PaperLaw, simulate
from cgwm.pipeline.physics.paper_law import clamped, creep_speed, rest_penetration, stable_step
from cgwm.pipeline.physics.smooth_distance import log_sum_exp_distance
from helpers.worlds import F64, ball_body, batch, box_body, state_of, times, world_of

UP = (1.0, 0.0, 0.0, 0.0)
MASS, STIFFNESS, DAMPING, MU, STEP = 0.4, 2000.0, 10.0, 0.5, 0.0005


def law(**changes: object) -> PaperLaw:
    return replace(PaperLaw.of_rows(batch(MU), batch(STIFFNESS), batch(DAMPING)), **changes)


def test_it_rests_at_the_depth_of_its_formula() -> None:
    world = world_of(box_body(mass=MASS, radius=1e-6), contact=law(), step_s=STEP)
    rollout = simulate(world, state_of(((0, 0, 0.03), UP, (0, 0, 0), (0, 0, 0))), times(0.3, 10.0))
    expected = rest_penetration(MASS, 9.81, rows=4 * 4, law=(STIFFNESS, DAMPING), step_s=STEP)
    assert float(rollout.position_m[0, -1, 0, 2]) - 0.03 == pytest.approx(expected, rel=1e-3)


# In the suite: its impulses are tested below.
@pytest.mark.evidence
def test_it_creeps_down_a_slope_that_friction_would_hold_by_its_formula() -> None:
    """On a slope of half the friction angle, and of less height than would unload the upper corners."""
    slope = math.atan(0.1)
    world = world_of(box_body(half=(0.05, 0.05, 0.002), mass=MASS, radius=1e-6), contact=law(), step_s=STEP)
    world = replace(world, gravity=9.81 * batch([math.sin(slope), 0.0, -math.cos(slope)]))
    rollout = simulate(world, state_of(((0, 0, 0.0015), UP, (0, 0, 0), (0, 0, 0))), times(0.5, 100.0))
    speed = float(rollout.velocity_m_s[0, -1, 0, 0])
    expected = creep_speed(slope, MU, MASS, 4 * 4, (STIFFNESS, DAMPING), STEP, 9.81)
    assert speed == pytest.approx(expected, rel=0.02)
    assert speed > STEP * 9.81 * math.sin(slope) * (1 / MU**2 - 1)


def test_it_is_stable_below_its_bound_and_not_above() -> None:
    """A ball is one contact of four rows; the bound is that of a contact that persists."""
    bound = float(stable_step(law(), batch(MASS), 4)[0])
    ends = []
    for share in (0.95, 1.05):
        world = world_of(ball_body(mass=MASS), contact=law(), gravity=0.0, step_s=share * bound)
        world = replace(world, gravity=batch([0.0, 0.0, -1000.0]))  # heavy enough never to leave the ground
        depth = rest_penetration(MASS, 1000.0, 4, (STIFFNESS, DAMPING), share * bound)
        step = share * bound * torch.arange(401, dtype=F64)
        begin = state_of(((0, 0, 0.04 + depth + 1e-6), UP, (0, 0, 0), (0, 0, 0)))
        if share > 1:
            with pytest.raises(Exception, match="beyond the bound"):
                simulate(world, begin, step)
            continue
        ends.append(float(simulate(world, begin, step).velocity_m_s[0, -1, 0, 2].abs()))
    assert ends[0] < 1e-6


def test_its_impulses_stay_in_the_pyramid_and_soften_to_the_maximum() -> None:
    start = state_of(((0, 0, 0.05), (0.95, 0.2, 0.1, 0.2), (0.5, 0, -0.5), (0.5, 1.0, 0.0)))
    rollout = simulate(world_of(box_body(), contact=law(), step_s=STEP), start, times(0.3), record_contacts=True)
    record = rollout.contacts
    assert record is not None
    along = (record.impulse_n_s * record.normal).sum(-1)
    across = (record.impulse_n_s - along[..., None] * record.normal).norm(dim=-1)
    assert float(along.min()) >= 0.0 and float(along.sum()) > 0.1
    assert bool((across <= MU * along + 1e-12).all())
    soft = simulate(world_of(box_body(), contact=law(softplus_per_n=1e4), step_s=STEP), start, times(0.1))
    torch.testing.assert_close(soft.position_m, rollout.position_m[:, :11], atol=1e-4, rtol=0)


def test_a_natural_time_and_a_damping_ratio_state_its_stiffness_and_damping() -> None:
    stated = PaperLaw.of_body(batch(MU), batch(0.02), batch(0.7), MASS, 9.81 * MASS)
    same = PaperLaw.of_rows(batch(MU), stated.stiffness_n_m, stated.damping_n_s_m)
    assert float(stated.stiffness_n_m) == pytest.approx(MASS / (16 * 0.02**2))
    assert float(same.stiffness_n_m) == pytest.approx(float(stated.stiffness_n_m))
    assert float(same.damping_n_s_m) == pytest.approx(2 * 0.7 * MASS / (16 * 0.02))


def test_as_published_a_box_on_four_corners_sinks_by_g_tau_squared() -> None:
    """16 rows of K = m / (16 tau^2); with the clamp's offset taken off and its slope of 1, to second order in depth."""
    time, depth = 0.005, 9.81 * 0.005**2
    published = PaperLaw.of_body(batch(MU), batch(time), batch(1.0), MASS, 9.81 * MASS)
    world = world_of(box_body(mass=MASS, radius=1e-6), contact=published, step_s=STEP)
    rollout = simulate(world, state_of(((0, 0, 0.03), UP, (0, 0, 0), (0, 0, 0))), times(0.2, 10.0))
    lift = STEP * 9.81 * (STEP + 2 * time)  # g h^2 + D g h / K
    assert float(rollout.position_m[0, -1, 0, 2]) - 0.03 == pytest.approx(lift - depth, abs=0.1 * depth)


def test_its_distance_lies_within_its_bounds() -> None:
    generator = torch.Generator().manual_seed(0)
    distances = 0.01 * torch.randn(50, 10, generator=generator, dtype=F64)
    value, weights = log_sum_exp_distance(distances, 1000.0)
    least = distances.amin(-1)
    assert bool((value <= least + 1e-15).all()) and bool((value >= least - math.log(10) / 1000.0).all())
    torch.testing.assert_close(weights.sum(-1), torch.ones(50, dtype=F64))
    equal, _ = log_sum_exp_distance(torch.zeros(1, 10, dtype=F64), 100.0)
    assert float(equal) == pytest.approx(-0.0230, abs=1e-4)  # the inflation of contact model notes, section 5.1


def test_its_clamp_is_off_by_the_known_offset() -> None:
    """With gamma delta = 1 the clamped distance vanishes at W(1) delta, has slope 1 there, and -delta/2 at 0."""
    zero = 0.567143290 * 0.02
    distance = torch.tensor([zero, 0.0, -1.0], dtype=F64, requires_grad=True)
    value = clamped(distance, 0.02, 50.0)
    assert value.tolist() == pytest.approx([0.0, -0.01, -0.02], abs=1e-9)
    (slope,) = torch.autograd.grad(value[0], distance)
    assert float(slope[0]) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.evidence
def test_bodies_meet_at_the_published_distance() -> None:
    """A ball over two coincident ones feels the inflation log(2)/beta, and rests that much higher."""
    beta = 200.0
    fixed = replace(ball_body(0.05, copies=2, name="below"), motion="fixed")
    heights = []
    for sharpness in (None, beta):
        world = world_of(ball_body(mass=MASS), fixed, contact=law(sharpness_per_m=sharpness), ground=False, step_s=STEP)
        start = state_of(((0, 0, 0.0895), UP, (0, 0, 0), (0, 0, 0)), ((0, 0, 0), UP, (0, 0, 0), (0, 0, 0)))
        heights.append(float(simulate(world, start, times(1.0, 1.0)).position_m[0, -1, 0, 2]))
    # both ways: only the ball's centre over the pair is inflated, so the shift is between half of it and all
    assert 0.5 * math.log(2) / beta < heights[1] - heights[0] <= 1.05 * math.log(2) / beta
