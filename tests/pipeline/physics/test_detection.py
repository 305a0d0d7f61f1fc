"""Which spheres touch: the broad phase leaves out nothing that would have had an impulse."""

import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cgwm.pipeline.geometry.rotation import quat_to_matrix
from cgwm.pipeline.physics import State, simulate
from cgwm.pipeline.physics.contact_detection import PAIR_SMOOTHING_M, Placed, body_points, near_body
from cgwm.pipeline.physics.smooth_distance import union_distance
from cgwm.pipeline.sg_gs.collision.collision_spheres import shape_to_spheres
from cgwm.schemas import BoxShape, Shape
from helpers.worlds import F64, ball_body, batch, box_body, state_of, times, world_of

UP = (1.0, 0.0, 0.0, 0.0)


def cube(count: int, name: str = "cube"):
    spheres, _ = shape_to_spheres(Shape(box=BoxShape(half_extents_m=(0.05, 0.05, 0.05))), Path(), count)
    return replace(
        box_body((0.05, 0.05, 0.05)), name=name, centers=batch(spheres.means), radii=batch(2 * spheres.scales)
    )


def placed(body, count: int, seed: int, spread: float) -> Placed:
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(count, 4, generator=generator, dtype=F64)
    where = spread * torch.randn(count, 3, generator=generator, dtype=F64)
    motion = torch.randn(2, count, 3, generator=generator, dtype=F64)
    return Placed(
        body=body,
        reference=where,
        rotation=quat_to_matrix(quat / quat.norm(dim=-1, keepdim=True)),
        velocity=motion[0],
        omega=motion[1],
    )


def test_all_that_touches_is_found_both_ways_with_the_smooth_distance_of_all_spheres() -> None:
    a, b = placed(cube(60), 40, 0, 0.05), placed(cube(50, "other"), 40, 1, 0.05)
    step = torch.full((40,), 0.001, dtype=F64)
    points = body_points(a, b, step)
    assert points is not None
    count = b.body.radii.shape[-1]
    onto_a, normal_a = union_distance(b.centers(), a.centers(), a.radii().expand(40, -1), PAIR_SMOOTHING_M)
    onto_b, normal_b = union_distance(a.centers(), b.centers(), b.radii().expand(40, -1), PAIR_SMOOTHING_M)
    full = torch.cat((onto_a - b.radii(), onto_b - a.radii()), 1)
    normals = torch.cat((-normal_a, normal_b), 1)
    kept = torch.zeros_like(full, dtype=torch.bool).scatter(1, points.slot, True)
    assert bool(kept[full < 0].all()) and int((full < 0).sum()) > 100
    assert float(kept.to(F64).mean()) < 0.75
    torch.testing.assert_close(points.gap, full.gather(1, points.slot), atol=1e-12, rtol=0)
    index = points.slot[..., None].expand(-1, -1, 3)
    torch.testing.assert_close(points.normal, normals.gather(1, index), atol=1e-9, rtol=0)
    assert bool((points.slot[:, 0] < count).all()) and int(points.slot.max()) >= count


@pytest.mark.parametrize("spinning", [False, True])
def test_bodies_are_near_where_speed_and_spin_may_bring_them_within_a_step(spinning: bool) -> None:
    body, other = box_body((0.05, 0.05, 0.05)), ball_body(0.02)
    turn, step = torch.eye(3, dtype=F64)[None], torch.tensor([0.01], dtype=F64)
    still = torch.zeros(1, 3, dtype=F64)
    reach = float((body.centers[0].norm(dim=-1) + body.radii[0]).max()) + 0.02
    way = torch.tensor([[1.0, 0.0, 0.0]], dtype=F64)
    moving = (still, 20.0 * way) if spinning else (-2.0 * way, still)
    least = reach + (0.01 * 20.0 * (reach - 0.02) if spinning else 0.02)
    for away, near in ((least - 1e-3, True), (least + 1e-3 + PAIR_SMOOTHING_M, False)):
        first = Placed(body, away * way, turn, *moving)
        second = Placed(other, still, turn, still, still)
        assert bool(near_body(first, second, step)) == near == bool(near_body(second, first, step))
        assert not bool(near_body(Placed(body, away * way, turn, still, still), second, step))


# In the suite: a measurement of time.
@pytest.mark.evidence
def test_bodies_that_are_far_apart_cost_nothing_and_near_ones_little() -> None:
    """500 spheres over 500: a resting cube on a cube, against the same with the upper one out of reach."""
    worlds = world_of(cube(500, "low"), cube(500, "high"))
    spent = []
    for height in (0.1501, 1.0):
        start = state_of(((0, 0, 0.05), UP, (0, 0, 0), (0, 0, 0)), ((0, 0, height), UP, (0, 0, 0), (0, 0, 0)))
        begun = time.process_time()
        simulate(worlds, start, times(0.05))
        spent.append(time.process_time() - begun)
    assert spent[0] < 12 * spent[1] + 1.0


@pytest.mark.parametrize("first", [pytest.param(0, marks=pytest.mark.evidence), 1])
def test_a_plate_rests_on_a_ball_bigger_than_itself_and_on_two_small_ones(first: int) -> None:
    """Contacts are sought both ways: a large sphere meets the plate at several of its spheres."""
    plate = replace(cube(8, "plate"), centers=0.3 * cube(8).centers)
    ball = replace(ball_body(0.4, 1.0), motion="fixed")
    bodies = (plate, ball) if first == 0 else (ball, plate)
    rows = [((0, 0, 0.4 + 0.03), UP, (0, 0, 0), (0, 0, 0)), ((0, 0, 0), UP, (0, 0, 0), (0, 0, 0))]
    world = world_of(*bodies, ground=False, step_s=0.002)
    rollout = simulate(world, state_of(*(rows if first == 0 else rows[::-1])), times(0.4, 5))
    end = rollout.position_m[0, -1, first]
    assert float(end[:2].norm()) < 1e-3 and 0.40 < float(end[2]) < 0.44
    assert float(rollout.velocity_m_s[0, -1, first].norm()) < 1e-3


# In the suite: rollouts of a batch do not see each other in test_physics.py.
@pytest.mark.evidence
def test_items_that_do_not_touch_change_nothing_for_those_that_do() -> None:
    """Most of a batch in flight: the few that touch are picked out, and move as they would alone."""
    touching = state_of(((0, 0, 0.08), (0.9, 0.3, -0.2, 0.1), (0.5, 0.2, -0.5), (2.0, -3.0, 1.0)))
    flying = state_of(((0, 0, 9.0), UP, (0, 0, 0), (0, 0, 0)), count=9)
    both = State(*(torch.cat((getattr(flying, k), getattr(touching, k))) for k in vars(flying)))
    world = world_of(box_body())
    alone = simulate(world, touching, times(0.3), record_contacts=True)
    among = simulate(world, both, times(0.3), record_contacts=True)
    torch.testing.assert_close(among.position_m[9:], alone.position_m, atol=1e-13, rtol=0)
    assert alone.contacts is not None and among.contacts is not None
    torch.testing.assert_close(among.contacts.impulse_n_s[9:], alone.contacts.impulse_n_s, atol=1e-13, rtol=0)
    assert float(among.contacts.impulse_n_s[:9].abs().max()) == 0.0
