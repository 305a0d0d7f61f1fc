"""Geometry of contacts: tangents, slots of spheres, relative spin, depth, and states that are not finite."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from cgwm.pipeline.geometry.directions import fibonacci_directions
from cgwm.pipeline.geometry.rotation import quat_to_matrix
from cgwm.pipeline.physics import simulate
from cgwm.pipeline.physics.body import Body
from cgwm.pipeline.physics.checks import overlaps
from cgwm.pipeline.physics.contact_detection import Placed, _gap_along, all_body_points
from cgwm.pipeline.physics.edge_contact import Crossings, Edges, best_normal
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.hull import OVERHANG_M, Hull, _over_flat, hull_distance, parallel_face
from cgwm.pipeline.physics.impulse_solver import tangent_axes
from cgwm.pipeline.physics.rollout import require_finite
from cgwm.pipeline.physics.rollout_cost import rollout_part, rollout_seconds
from cgwm.pipeline.physics.smooth_distance import blended, plane_contacts, smooth_min
from cgwm.schemas import NotConvergedError
from helpers.worlds import F64, ball_body, batch, box_body, law, state_of, times, world_of

UP = (1.0, 0.0, 0.0, 0.0)


def test_tangents_are_a_right_handed_frame_on_both_hemispheres() -> None:
    normal = torch.randn(200, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    normal = torch.cat([normal, torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)])
    normal = normal / normal.norm(dim=-1, keepdim=True)
    axes = tangent_axes(normal)
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3, dtype=F64).expand_as(axes), atol=1e-12, rtol=0)
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(len(axes), dtype=F64), atol=1e-12, rtol=0)
    torch.testing.assert_close(axes[:, 0], normal)


def _at(body: Body, place: tuple[float, float, float]) -> Placed:
    zero = torch.zeros(1, 3, dtype=F64)
    eye = torch.eye(3, dtype=F64)[None]
    return Placed(body=body, reference=torch.tensor([place], dtype=F64), rotation=eye, velocity=zero, omega=zero)


def test_slots_of_two_bodies_are_their_spheres_in_order() -> None:
    one, two = ball_body(0.04, name="one"), ball_body(0.03, name="two", copies=2)
    points = all_body_points(_at(one, (0, 0, 0)), _at(two, (0.1, 0, 0)))
    assert points.slot.tolist() == [[0, 1, 2]]
    torch.testing.assert_close(points.gap, torch.full((1, 3), 0.03, dtype=F64), atol=1e-3, rtol=0)


@pytest.mark.parametrize(("omega", "slows"), [((4.0, 4.0), False), ((4.0, -4.0), True)])
def test_torsional_friction_between_bodies_acts_on_their_relative_spin(omega: tuple[float, float], slows: bool) -> None:
    """Two balls pressed together along x: spinning alike they feel nothing, against each other they slow down."""
    world = world_of(
        ball_body(0.04, name="one"), ball_body(0.04, name="two"), contact=law(0.0), ground=False, gravity=0.0
    )
    world = replace(world, effects=(ActiveEffect.of(load_effect("torsional_friction"), {"c_t": 4e-3}),))
    start = state_of(
        ((-0.0399, 0, 0), UP, (0.3, 0, 0), (omega[0], 0, 0)), ((0.0399, 0, 0), UP, (-0.3, 0, 0), (omega[1], 0, 0))
    )
    after = simulate(world, start, times(0.02)).omega_body_rad_s[0, -1, :, 0]
    change = after - torch.tensor(omega, dtype=F64)
    if slows:
        assert float(change[0]) < -0.1 and float(change[0]) == pytest.approx(-float(change[1]), rel=1e-6)
    else:
        torch.testing.assert_close(change, torch.zeros(2, dtype=F64), atol=1e-9, rtol=0)


@pytest.mark.parametrize(("height", "depth"), [(0.05, 0.0), (0.033, 0.007)])
def test_depth_in_the_ground_is_that_of_the_lowest_point(height: float, depth: float) -> None:
    (found,) = overlaps(world_of(ball_body(0.04)), state_of(((0, 0, height), UP, (0, 0, 0), (0, 0, 0))))
    assert float(found.depth_m) == pytest.approx(depth, abs=1e-12)
    assert float(found.size_m) == pytest.approx(0.04)


def test_a_state_that_is_not_finite_is_told_with_its_environment_and_frames_behind_the_end_do_not_count() -> None:
    world = world_of(ball_body(0.04))
    start = state_of(((0, 0, 0.5), UP, (0, 0, 0), (0, 0, 0)), count=2)
    rolled = simulate(world, start, times(0.05))
    position = rolled.position_m.clone()
    position[1, 3, 0, 2] = math.nan
    broken = replace(rolled, position_m=position)
    require_finite(broken, world, start, frames=(6, 3))
    with pytest.raises(NotConvergedError, match="second"):
        require_finite(broken, world, start, names=("first", "second"), frames=(6, 4))


def test_more_bodies_cost_more() -> None:
    one = rollout_seconds(world_of(ball_body(0.04)), 10, 1.0)
    two = rollout_seconds(world_of(ball_body(0.04), ball_body(0.04, name="two")), 10, 1.0)
    assert 0 < one < two and rollout_seconds(world_of(ball_body(0.04)), 20, 1.0) == pytest.approx(2 * one, rel=0.2)


def test_work_grows_with_contacts_and_kept_frames() -> None:
    ball, box = world_of(ball_body(0.04)), world_of(box_body())
    alone = rollout_seconds(world_of(box_body(), ground=False), 10, 1.0)
    assert alone < rollout_seconds(ball, 10, 1.0) < rollout_seconds(box, 10, 1.0)
    two = world_of(ball_body(0.04), ball_body(0.04, name="two"))
    parts = [rollout_part("search", world, (1.0, 0.5), 6, 4, 100).memory_bytes for world in (ball, two)]
    assert parts[1] == 2 * parts[0] == 2 * 4 * 100 * 13 * 8
    few, nothing = (rollout_part("search", ball, spans, 1, 4, 100) for spans in ((1.0, 0.5), ()))
    assert few.memory_bytes == 2 * 100 * 13 * 8  # no more are kept than there are
    assert nothing.seconds == nothing.memory_bytes == 0 and "rollouts of up to 0 s" in nothing.what


def test_the_distance_to_a_hull_is_that_to_its_support_function() -> None:
    """max over n of n . p - h(n): no direction is above it, and outside its own normal reaches it."""
    generator = torch.Generator().manual_seed(0)
    centers = 0.03 * torch.randn(40, 3, generator=generator, dtype=F64)
    radii = 0.02 * torch.rand(40, generator=generator, dtype=F64) + 0.001
    hull = Hull.of(centers, radii, plane_contacts(centers, radii))
    assert hull is not None
    points = 0.1 * torch.randn(1, 500, 3, generator=generator, dtype=F64)
    distance, normal = hull_distance(points, hull, centers[None], radii[None])
    chosen = hull.supports

    def over(n: torch.Tensor) -> torch.Tensor:
        return (n * points[0]).sum(-1) - (n @ centers[chosen].T + radii[chosen]).amax(-1)

    torch.testing.assert_close(over(normal[0]), distance[0], atol=1e-12, rtol=0)
    for direction in torch.as_tensor(fibonacci_directions(300)):
        assert bool((over(direction.expand(500, 3)) <= distance[0] + 1e-12).all())


def test_two_boxes_part_best_along_the_normal_of_a_face_or_of_two_edges() -> None:
    """Where they overlap, no direction parts them better; the gap along it is that of their support functions."""
    generator = torch.Generator().manual_seed(0)
    box = box_body((0.05, 0.03, 0.02), radius=0.002)
    centers, radii = box.centers[0], box.radii[0]
    hull = Hull.of(centers, radii, plane_contacts(centers, radii))
    assert hull is not None and len(hull.ridges) == 12
    turn = quat_to_matrix(torch.nn.functional.normalize(torch.randn(60, 4, generator=generator, dtype=F64), dim=-1))
    place = 0.05 * torch.randn(60, 1, 3, generator=generator, dtype=F64)
    other = centers @ turn.transpose(1, 2) + place

    def gap(n: torch.Tensor) -> torch.Tensor:
        return (other @ n[..., None]).squeeze(-1).amin(-1) - (n @ centers.T).amax(-1) - 2 * 0.002

    here = Edges.of(hull, centers.expand(60, -1, -1), radii[None], torch.eye(3, dtype=F64).expand(60, 3, 3))
    there = Edges.of(hull, other, radii[None], turn)
    found = Crossings.of(here.across(2), there.across(1))
    faces = torch.cat((hull.faces[:, :3].expand(60, -1, -1), -hull.faces[:, :3] @ turn.transpose(1, 2)), 1)
    heights = torch.stack([gap(faces[:, k]) for k in range(faces.shape[1])], 1)
    height, face = heights.max(1)
    most, normal = best_normal(found, height, faces[torch.arange(60), face])
    torch.testing.assert_close(gap(normal), most, rtol=0, atol=1e-12)
    deep = most < 0
    assert 5 < int((deep & (most > height)).sum()) < int(deep.sum())
    for direction in torch.as_tensor(fibonacci_directions(2000)):
        assert bool((gap(direction.expand(60, 3)) <= most + 1e-12)[deep].all())


def test_a_large_sphere_that_protrudes_from_a_face_has_no_edges() -> None:
    """Its cones to the corners are none: a normal of two of them would part bodies that overlap."""
    box = box_body((0.05, 0.03, 0.02), radius=0.0005)
    centers = torch.cat((box.centers[0], torch.tensor([[0.038, 0.018, 0.008]], dtype=F64)))
    radii = torch.cat((box.radii[0], torch.tensor([0.0128], dtype=F64)))
    hull = Hull.of(centers, radii, plane_contacts(centers, radii))
    assert hull is not None and len(hull.supports) == 9
    assert int(hull.edges.max()) == 8 and len(hull.ridges) and int(hull.ridges.max()) < 8


def test_spheres_in_one_plane_have_no_hull() -> None:
    centers = batch([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [1.0, 1.0, 0]])[0]
    assert Hull.of(centers, torch.full((4,), 0.1, dtype=F64), torch.arange(4)) is None


def test_the_normal_between_opposite_spheres_is_a_unit_vector() -> None:
    offset = torch.tensor([[[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]], dtype=torch.float64)
    radii = torch.full((1, 2), 0.05, dtype=torch.float64)
    distance, normal = blended(offset, radii, partial(smooth_min, width=0.01))
    assert normal.tolist() == [[0.0, 0.0, 1.0]] and 0.03 < float(distance) <= 0.05


def test_bodies_surfaces_and_the_ground_are_named() -> None:
    world = world_of(box_body(), ball_body(0.04, name="ball"))
    assert [world.named(k) for k in (-1, 0, 1)] == ["the ground", "body 'box'", "body 'ball'"]


def test_the_gap_along_a_normal_is_that_between_the_spheres_that_reach_farthest() -> None:
    along = torch.tensor([[1.0, 0.0, 0.0]], dtype=F64)
    left, right = (
        SimpleNamespace(centers=lambda x=x: batch(x), radii=lambda r=r: batch(r))
        for x, r in (([[0.0, 0, 0], [0.1, 0, 0]], [0.3, 0.05]), ([[1.0, 0, 0], [0.9, 5.0, 0]], [0.2, 0.05]))
    )
    assert float(_gap_along(left, right, along)) == pytest.approx(0.8 - 0.3)  # pyright: ignore[reportArgumentType]


def test_depth_is_measured_from_where_the_ground_lies() -> None:
    world = replace(world_of(ball_body(0.04)), ground_offset=batch(0.5))
    (found,) = overlaps(world, state_of(((0, 0, 0.533), UP, (0, 0, 0), (0, 0, 0))))
    assert float(found.depth_m) == pytest.approx(0.007, abs=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_foot_lies_on_a_face_up_to_the_overhang_beyond_each_of_its_sides(axis: int) -> None:
    half = torch.tensor((0.05, 0.04, 0.03), dtype=F64)
    body = box_body(tuple(half.tolist()))
    hull = Hull.of(body.centers[0], body.radii[0], plane_contacts(body.centers[0], body.radii[0]))
    assert hull is not None
    turned = torch.eye(3, dtype=F64)[axis][None]
    flat, others = parallel_face(hull, turned), [k for k in range(3) if k != axis]
    corner = body.centers[0].abs().amax(0)
    for side, sign in ((side, sign) for side in others for sign in (-1.0, 1.0)):
        points = torch.zeros(2, 3, dtype=F64)
        points[:, axis] = half[axis] + 0.01
        points[:, side] = sign * (corner[side] + OVERHANG_M * torch.tensor([0.9, 1.2], dtype=F64))
        points[:, next(k for k in others if k != side)] = 0.3 * corner[side]
        assert _over_flat(points[None], hull, flat).tolist() == [[True, False]]
