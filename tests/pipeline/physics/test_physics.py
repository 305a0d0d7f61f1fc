"""The engine against the laws of mechanics."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply, quat_normalize, quat_to_matrix
from cgwm.pipeline.optimization.forward_mode import batched_jacobian
from cgwm.pipeline.physics import State, simulate
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.kinematic import Drive
from cgwm.pipeline.physics.smooth_distance import plane_contacts, smooth_min, union_distance
from cgwm.pipeline.sg_gs.collision.collision_spheres import shape_to_spheres
from cgwm.schemas import BoxShape, InputDataError, Shape
from helpers.worlds import F64, ball_body, batch, box_body, law, state_of, times, world_of

UP = (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("time_s", [0.001, 0.004])
def test_a_box_rests_alike_on_four_spheres_and_on_sixteen(time_s: float) -> None:
    """Also where stiff contacts are so shallow that none of them is deep in itself."""
    rests = []
    for copies in (1, 4):
        body = box_body(mass=0.1)
        body = replace(body, centers=body.centers.repeat(1, copies, 1), radii=body.radii.repeat(1, copies))
        world = world_of(body, contact=law(contact_time_s=time_s))
        rollout = roll_out(world, state_of(((0, 0, 0.03), UP, (0, 0, 0), (0, 0, 0))), times(0.1, 50))
        rests.append(rollout.position_m[0, :, 0])
    torch.testing.assert_close(rests[1], rests[0], atol=1e-9, rtol=0)


def test_friction_stays_inside_its_cone_and_the_labels_obey_newton() -> None:
    world = world_of(box_body(), contact=law(friction=0.4))
    start = state_of(((0, 0, 0.08), (0.9, 0.3, -0.2, 0.1), (0.5, 0.2, -0.5), (2.0, -3.0, 1.0)))
    rollout = roll_out(world, start, times(0.6), record_contacts=True)
    record = rollout.contacts
    assert record is not None
    along = (record.impulse_n_s * record.normal).sum(-1)
    across = (record.impulse_n_s - along[..., None] * record.normal).norm(dim=-1)
    assert float(along.min()) >= 0.0
    assert bool((across <= 0.4 * along + 1e-12).all())
    assert float(along.sum()) > 0.1
    momentum = world.bodies[0].mass * rollout.velocity_m_s[0, :, 0]
    given = record.impulse_n_s[0, 1:].sum(1) + world.bodies[0].mass * world.gravity * 0.01
    torch.testing.assert_close(momentum.diff(dim=0), given, atol=1e-12, rtol=0)


def test_a_driven_body_pushes_a_free_one_and_follows_its_command() -> None:
    tip = replace(ball_body(radius=0.012, name="tip"), motion="driven")
    shape = Shape(box=BoxShape(half_extents_m=(0.04, 0.04, 0.02)))
    spheres, _ = shape_to_spheres(shape, Path(), 128)
    box = replace(box_body(half=(0.04, 0.04, 0.02)), centers=batch(spheres.means), radii=batch(2 * spheres.scales))
    world = world_of(box, tip, step_s=0.002)
    command = Track(np.array([0.0, 1.0]), np.array([[-0.08, 0, 0.02], [0.02, 0, 0.02]]))
    start = state_of(((0, 0, 0.02), UP, (0, 0, 0), (0, 0, 0)), ((-0.08, 0, 0.02), UP, (0, 0, 0), (0, 0, 0)))
    rollout = roll_out(world, start, times(0.6, 20), {"tip": command})
    torch.testing.assert_close(rollout.position_m[0, :, 1, 0], -0.08 + 0.1 * rollout.times_s, atol=1e-12, rtol=0)
    # the tip's surface ends at -0.008 and the box is 0.04 long on that side; the spheres of a face leave dents in it
    assert float(rollout.position_m[0, -1, 0, 0]) == pytest.approx(0.032, abs=0.004)


def test_a_straight_drive_is_one_from_velocities_that_do_not_turn() -> None:
    generator = torch.Generator().manual_seed(0)
    place, velocity = (torch.randn(3, 3, generator=generator, dtype=F64) for _ in range(2))
    quat = quat_normalize(torch.randn(3, 4, generator=generator, dtype=F64))
    times = torch.tensor([[0.0, 0.03], [0.1, 0.2], [0.0, 1.0]], dtype=F64)
    still = torch.zeros(3, 1, 3, dtype=F64)
    wanted = Drive.from_velocities(times, place, quat, velocity[:, None], still)
    for one, other in zip(
        vars(Drive.straight(times, place, quat, velocity)).values(), vars(wanted).values(), strict=True
    ):
        assert one.dtype == other.dtype
        torch.testing.assert_close(one, other, rtol=1e-15, atol=1e-15)


def test_a_velocity_command_is_integrated_and_is_what_the_body_does() -> None:
    tip = replace(ball_body(radius=0.012, name="tip"), motion="driven")
    t = batch([0.0, 0.2, 0.5])
    velocity, omega = batch([[0.1, 0, 0], [0, -0.2, 0]]), batch([[0, 0, 2.0], [0, 3.0, 0]])
    begin, quat = batch([0.3, 0.0, 0.5]), batch([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    command = Drive.from_velocities(t, begin, quat, velocity, omega)
    start = state_of(((0.3, 0, 0.5), tuple(quat[0].tolist()), (0, 0, 0), (0, 0, 0)))
    rollout = simulate(world_of(tip), start, times(0.6, 20), {"tip": command})
    assert rollout.position_m[0, -1, 0].tolist() == pytest.approx([0.32, -0.06, 0.5], abs=1e-12)
    torch.testing.assert_close(rollout.velocity_m_s[0, 2, 0], velocity[0, 0], atol=1e-12, rtol=0)
    assert float(rollout.velocity_m_s[0, -1, 0].norm()) == 0.0  # held still after its last sample
    turned = quat_multiply(quat_exp(0.3 * omega[0, 1]), quat_multiply(quat_exp(0.2 * omega[0, 0]), quat[0]))
    torch.testing.assert_close(rollout.quat_wxyz[0, -1, 0], turned, atol=1e-12, rtol=0)


def test_a_driven_body_without_a_track_is_refused() -> None:
    tip = replace(ball_body(name="tip"), motion="driven")
    with pytest.raises(InputDataError, match="driven body 'tip' has no track in this episode"):
        simulate(world_of(box_body(), tip), state_of(*[((0, 0, 1), UP, (0, 0, 0), (0, 0, 0))] * 2), times(0.1))


@pytest.mark.parametrize(
    "until", [*(pytest.param(until, marks=pytest.mark.evidence) for until in (0.05, 0.10, 0.3)), 0.16]
)
def test_derivatives_of_a_rollout_match_finite_differences(until: float) -> None:
    """Before, at and after the impact, and at rest."""
    base = state_of(((0, 0, 0.06), (0.95, 0.2, 0.1, 0.2), (0.2, 0, -0.2), (0.5, 1.0, 0.0)))

    def end(x: torch.Tensor, repeats: int) -> torch.Tensor:
        contact = replace(law(), friction=x[:, 0].exp(), damping_ratio=x[:, 1].exp(), contact_time_s=x[:, 2].exp())
        n = len(x)
        start = State(
            base.position_m.repeat(n, 1, 1) + torch.stack((0 * x[:, 3], 0 * x[:, 3], x[:, 3]), -1)[:, None],
            base.quat_wxyz.repeat(n, 1, 1),
            base.velocity_m_s.repeat(n, 1, 1),
            base.omega_body_rad_s.repeat(n, 1, 1) + torch.stack((x[:, 4], 0 * x[:, 4], 0 * x[:, 4]), -1)[:, None],
        )
        rollout = simulate(world_of(box_body(), contact=contact, step_s=0.002), start, times(until))
        return torch.cat((rollout.position_m[:, -1, 0], rollout.quat_wxyz[:, -1, 0]), -1)

    x = torch.tensor([[math.log(0.3), math.log(0.35), math.log(0.004), 0.0, 0.0]], dtype=F64)
    value, jacobian = batched_jacobian(end, x)
    step = 1e-8  # contacts can start to count within 1e-7 m of height
    moved = torch.cat([x, *(x + sign * step * torch.eye(5, dtype=F64) for sign in (1, -1))])
    ends = end(moved, 1)
    torch.testing.assert_close(value, ends[:1], atol=1e-13, rtol=0)
    numeric = (ends[1:6] - ends[6:]).T / (2 * step)
    torch.testing.assert_close(jacobian[0], numeric, atol=2e-5, rtol=2e-4)
    weights = torch.randn(value.shape[1], generator=torch.Generator().manual_seed(0), dtype=F64)
    reverse = torch.autograd.functional.jacobian(lambda y: weights @ end(y, 1)[0], x)[0]
    torch.testing.assert_close(weights @ jacobian[0], reverse, atol=1e-8, rtol=1e-8)


def test_rollouts_of_a_batch_do_not_see_each_other() -> None:
    a = state_of(((0, 0, 0.08), (0.9, 0.3, -0.2, 0.1), (0.5, 0.2, -0.5), (2.0, -3.0, 1.0)))
    # one that flies, and one of which more spheres touch at once
    others = (((0, 0, 0.2), UP, (0, 0, 0), (0, 0, 0)), ((0, 0, 0.03), UP, (0.5, 0, 0), (0, 0, 0)))
    joined = State.joined(a, *map(state_of, others))
    alone, together = (simulate(world_of(box_body()), start, times(0.25)).position_m for start in (a, joined))
    torch.testing.assert_close(together[:1], alone, atol=1e-12, rtol=0)


def test_smooth_minimum_keeps_its_bound_and_its_weights_are_its_derivative() -> None:
    generator = torch.Generator().manual_seed(0)
    d = (0.01 * torch.randn(40, 12, generator=generator, dtype=F64)).requires_grad_()
    value, weights = smooth_min(d, 1e-3)
    least = d.amin(-1)
    assert bool((value <= least + 1e-15).all()) and bool((value >= least - 2e-3 / 3 - 1e-15).all())
    torch.testing.assert_close(weights.sum(-1), torch.ones(40, dtype=F64))
    (slope,) = torch.autograd.grad(value.sum(), d)
    torch.testing.assert_close(slope, weights.detach(), atol=1e-9, rtol=0)
    equal, _ = smooth_min(torch.full((1, 9), 0.5, dtype=F64), 1e-3)
    assert float(equal) == pytest.approx(0.5 - 2e-3 / 3 * (1 - 1 / 3), abs=1e-12)


def test_distance_to_one_sphere_is_exact_and_its_normal_points_outwards() -> None:
    points = torch.tensor([[[0.3, 0.4, 0.0], [0.0, 0.0, 0.01]]], dtype=F64)
    distance, normal = union_distance(points, torch.zeros(1, 1, 3, dtype=F64), batch([0.1]), 1e-3)
    torch.testing.assert_close(distance, batch([0.4, -0.09]), atol=1e-12, rtol=0)
    torch.testing.assert_close(normal[0, 0], torch.tensor([0.6, 0.8, 0.0], dtype=F64), atol=1e-12, rtol=0)


def test_initial_states_pass_through_unchanged() -> None:
    body = replace(box_body(), com=batch([0.01, -0.02, 0.005]))
    start = state_of(((0.1, 0.2, 0.9), (0.5, 0.1, -0.7, 0.3), (0.1, 0.5, 1.0), (1.0, 2.0, 3.0)))
    rollout = simulate(world_of(body), start, times(0.02))
    for key in ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s"):
        torch.testing.assert_close(getattr(rollout, key)[:, 0], getattr(start, key), atol=1e-12, rtol=0)
    assert quat_to_matrix(rollout.quat_wxyz).shape == (1, 3, 1, 3, 3)


def test_a_plane_touches_a_box_of_many_spheres_by_its_corners() -> None:
    """The 8 corners have the whole support function; what the other spheres of a side add is nothing."""
    splats, _ = shape_to_spheres(Shape(box=BoxShape(half_extents_m=(0.05, 0.04, 0.03))), Path(), 120)
    centers, radii = torch.as_tensor(splats.means), torch.as_tensor(2 * splats.scales)
    chosen = plane_contacts(centers, radii)
    assert len(chosen) == 8 < len(radii)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)).double())
    reach = centers @ directions.T + radii[:, None]
    assert float((reach.amax(0) - reach[chosen].amax(0)).max()) < 1.5e-4


def test_recording_contacts_changes_no_motion_where_the_ground_sees_fewer_spheres() -> None:
    body = box_body()
    inner = torch.cat([body.centers, 0.5 * body.centers], 1)
    body = replace(body, centers=inner, radii=torch.full((1, 16), 0.001, dtype=F64))
    on_plane = plane_contacts(body.centers[0], body.radii[0])
    assert on_plane.tolist() == list(range(8))
    world = world_of(replace(body, on_plane=on_plane))
    start = state_of(((0, 0, 0.1), (0.9, 0.3, 0.2, 0.1), (0.3, 0.1, -0.5), (2.0, 1.0, -1.0)), count=2)
    plain, recorded, every = (
        simulate(one, start, times(0.25), record_contacts=record)
        for one, record in ((world, False), (world, True), (world_of(body), False))
    )
    torch.testing.assert_close(plain.position_m, recorded.position_m, rtol=0, atol=1e-9)
    torch.testing.assert_close(plain.position_m, every.position_m, rtol=0, atol=1e-9)
    assert recorded.contacts is not None
    assert recorded.contacts.impulse_n_s.shape[2] == 8
