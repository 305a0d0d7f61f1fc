"""What contacts a world can have, whose law each has, and what faces, walls and published rows are made of."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.pipeline.physics import simulate
from cgwm.pipeline.physics.body import Body
from cgwm.pipeline.physics.contact_detection import slot_count
from cgwm.pipeline.physics.contact_law import Touch
from cgwm.pipeline.physics.fused.packing import _hull_rows, _hulls, pack
from cgwm.pipeline.physics.fused.structure import MOTION_COLUMNS
from cgwm.pipeline.physics.hull import _thickness
from cgwm.pipeline.physics.model_world import _with_only_law
from cgwm.pipeline.physics.paper_law import PaperLaw, clamped, creep_speed, paper_impulses, rest_penetration
from cgwm.pipeline.physics.patch import LEAST_CARRIED, _carried
from cgwm.pipeline.physics.rollout_cost import _CALL_S, rollout_seconds
from cgwm.pipeline.physics.smooth_distance import log_sum_exp_distance
from cgwm.pipeline.physics.surfaces.thin_walls import _after_fall, _half_thickness, _way_through, walls
from cgwm.pipeline.physics.world import pair_of
from helpers import fixed_surfaces as fixed
from helpers.worlds import F64, ball_body, batch, box_body, law, plate_body, state_of, times, world_of
from scipy.spatial.transform import Rotation

AT_REST = ((0, 0, 5.0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0))


@pytest.mark.parametrize("surfaces", [(), (fixed.half_space(), fixed.box((0.1, 0.1, 0.1)), fixed.cylinder(0.1, 0.1))])
def test_a_record_has_as_many_places_as_pairs_can_have_contacts(surfaces: tuple) -> None:
    bodies = (
        plate_body((0.05, 0.04, 0.01)),
        ball_body(0.02, copies=3),
        box_body(),
        replace(ball_body(name="b"), motion="fixed"),
    )
    world = replace(world_of(*(replace(body, name=f"n{k}") for k, body in enumerate(bodies))), surfaces=surfaces)
    record = simulate(world, state_of(*[AT_REST] * 4), times(0.002, 1000.0), {}, record_contacts=True).contacts
    assert record is not None
    counts = [slot_count(world, pair) for pair in world.pairs]
    assert record.impulse_n_s.shape[2] == sum(counts) == len(record.body_a)
    owners = [pair for pair, count in zip(world.pairs, counts, strict=True) for _ in range(count)]
    assert record.body_a.tolist() == [a for a, _ in owners] and record.body_b.tolist() == [b for _, b in owners]
    # a ball touches the ground in one sphere each; without edges two bodies touch by their spheres alone
    assert slot_count(world, (1, -1)) == 3
    spheres = [body.radii.shape[-1] for body in bodies]
    assert slot_count(world, (1, 3)) == spheres[1] + spheres[3]


def test_a_law_belongs_to_two_materials_in_either_order() -> None:
    ice, wood = law(0.02), law(0.5)
    bodies = (
        replace(ball_body(name="one"), material="ice"),
        replace(ball_body(name="two"), material="wood"),
        ball_body(name="three"),
    )
    table = fixed.half_space()
    world = replace(
        world_of(*bodies), ground_material="ice",
        pair_laws={pair_of("wood", "ice"): ice, pair_of("wood", "wood"): wood},
        surfaces=(replace(table, material="wood"), fixed.box((1, 1, 1))),
    )  # fmt: skip
    assert [world.material_of(k) for k in (0, 1, 2, -1, -2, -3)] == ["ice", "wood", None, "ice", "wood", None]
    assert world.law_of(0, 1) is world.law_of(1, 0) is world.law_of(1, -1) is world.law_of(0, -2) is ice
    assert world.law_of(1, -2) is wood and world.law_between("wood", "wood") is wood
    for other in (2, -3):
        assert world.law_of(0, other) is world.law_of(other, 1) is world.contact
    assert world.law_of(0, -1) is world.contact and world.pair_between("ice", "ice") is None
    assert world.pair_between(None, "wood") is world.pair_between("wood", None) is None
    assert world.laws == (world.contact, ice, wood)
    assert _with_only_law(world) is world  # several laws are used
    alone = _with_only_law(replace(world, bodies=bodies[:1], ground_material="wood", surfaces=()))
    assert alone.contact is ice and alone.pair_laws == {}
    plain = replace(world, bodies=bodies[2:], surfaces=())
    assert _with_only_law(plain) is plain


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.5])
def test_points_of_a_face_share_its_area_by_their_distance_from_its_middle(exponent: float) -> None:
    rng = np.random.default_rng(0)
    places, areas = torch.as_tensor(rng.normal(size=(9, 3))), torch.as_tensor(rng.uniform(1, 2, 9))
    places[0] = (areas[1:, None] * places[1:]).sum(0) / areas[1:].sum()  # in the middle
    found = _carried(places, areas, exponent)
    assert float(found.sum()) == pytest.approx(float(areas.sum()))
    torch.testing.assert_close(_carried(3 * places + 7, areas, exponent), found)
    torch.testing.assert_close(_carried(places, 5 * areas, exponent), 5 * found)
    middle = (areas[:, None] * places).sum(0) / areas.sum()
    away = (places - middle).norm(dim=-1)
    share = found / areas
    wanted = (away / away.max()) ** exponent
    wanted = wanted.clamp_min(LEAST_CARRIED) if exponent else torch.ones_like(away)
    torch.testing.assert_close(share / share.max(), wanted)


def test_the_thickness_of_points_is_that_across_their_plane() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.normal(size=(20, 2)), np.zeros(20)])
    turn = Rotation.from_rotvec([0.3, 0.5, -0.2])
    assert _thickness(turn.apply(flat) + 3.0) < 1e-12
    thick = flat + np.outer(np.tile([1.0, -1.0], 10), [0.0, 0.0, 1e-3])
    plain = thick - thick.mean(0)
    normal = np.linalg.svd(plain)[2][-1]
    assert _thickness(turn.apply(thick) - 2.0) == pytest.approx(np.linalg.norm(plain @ normal))


def test_a_wall_is_as_thick_as_a_ray_is_long_in_it() -> None:
    vertices, faces = fixed.box_mesh((0.05, 0.04, 0.01), 3)
    corners = tuple(np.asarray(vertices, float)[np.asarray(faces)].transpose(1, 0, 2))
    for axis, half in enumerate((0.05, 0.04, 0.01)):
        for sign in (1, -1):
            start, way = np.array([0.003, 0.002, 0.001]), np.zeros(3)
            start[axis], way[axis] = sign * half, -sign
            assert _way_through(start, way, corners, 0.02) == pytest.approx(2 * half)
            assert _way_through(start, -way, corners, 0.02) == math.inf  # out of the box
    aside = np.array([0.0, 0.06, 0.6]) / np.linalg.norm([0.06, 0.6])
    found = _way_through(np.array([0.001, 0.002, -0.01]), aside, corners, 0.02)
    assert found == pytest.approx(0.02 / aside[2])
    solid, open_one = (fixed.mesh_surface(vertices, faces, solid=solid) for solid in (True, False))
    assert _half_thickness(open_one, 0.02) == 0.0 and _half_thickness(solid, 0.5) == pytest.approx(0.01)
    assert solid.mesh is not None
    assert _half_thickness(solid, 1e-6) == pytest.approx(min(0.01, solid.mesh.cell_m))
    assert _half_thickness(fixed.box((0.3, 0.2, 0.004)), 1.0) == pytest.approx(0.004)
    assert _half_thickness(fixed.cylinder(0.3, 0.02), 1.0) == pytest.approx(0.02)


def test_a_body_hits_a_wall_with_the_energy_of_its_fall_to_the_lowest_point() -> None:
    turn = fixed.turn((1, 0, 0), 30)
    boards = (fixed.box((0.3, 0.2, 0.01), position=(0.5, -0.4, 0.3), quat=turn),)
    world = replace(world_of(box_body(), ball_body(0.01), ground=False), surfaces=boards)
    wall = next(one for one in walls(world) if one.body == "ball")
    state = state_of(AT_REST, ((0, 0, 2.0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0)))
    lowest = 0.3 - (0.2 * math.sin(math.radians(30)) + 0.01 * math.cos(math.radians(30)))
    for speed in (0.0, 3.0):
        found = _after_fall(world, state, wall, torch.tensor([speed], dtype=F64))
        assert float(found) == pytest.approx(math.sqrt(speed**2 + 2 * 9.81 * (2.0 - lowest)))
    below = state_of(AT_REST, ((0, 0, -2.0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0)))
    assert float(_after_fall(world, below, wall, torch.tensor([3.0], dtype=F64))) == pytest.approx(3.0)
    shown = fixed.mesh_surface(*fixed.box_mesh((0.3, 0.2, 0.01)), position=(0.5, -0.4, 0.3), quat=turn)
    other = replace(wall, surface=shown)
    assert float(_after_fall(world, state, other, torch.tensor([0.0], dtype=F64))) == pytest.approx(
        math.sqrt(2 * 9.81 * (2.0 - lowest)), rel=1e-6
    )


def published(gap: float, velocity: tuple[float, float, float], step_s: float, law: PaperLaw) -> torch.Tensor:
    """Return the impulse of one point of the published rows, along normal and tangents."""
    one = torch.tensor([[0.01]], dtype=F64)
    touch = Touch(
        ground=True, position=torch.zeros(1, 1, 3, dtype=F64), normal=torch.tensor([[[0.0, 0.0, 1.0]]], dtype=F64),
        gap=torch.tensor([[gap]], dtype=F64), velocity=torch.tensor([[velocity]], dtype=F64),
        spin_rad_s=torch.zeros(1, 3, dtype=F64), step_s=torch.tensor([[step_s]], dtype=F64),
        friction=law.friction.expand(1, 1), contact_time_s=one, damping_ratio=one,
    )  # fmt: skip
    axes = torch.tensor([[[[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]]], dtype=F64)
    return paper_impulses(law, touch, axes)[0, 0]


def test_published_rows_carry_a_body_at_rest_and_let_it_creep_at_the_derived_speed() -> None:
    """Impulses of a step are those of gravity in it: along the normal at rest, along a slope while a body creeps."""
    mass, gravity, h, friction, slope = 0.3, 9.81, 0.002, 0.4, 0.05
    stiffness, damping = 4000.0, 12.0
    rows = PaperLaw.of_rows(batch(friction), batch(stiffness), batch(damping))
    assert float(rows.stiffness_n_m) == pytest.approx(stiffness) and float(rows.damping_n_s_m) == pytest.approx(damping)
    count = rows.directions
    depth = rest_penetration(mass, gravity, count, (stiffness, damping), h)
    at_rest = published(depth, (0.0, 0.0, -gravity * h), h, rows)
    assert float(at_rest[0]) == pytest.approx(mass * gravity * h) and float(at_rest[1:].abs().max()) < 1e-12
    creep = creep_speed(slope, friction, mass, count, (stiffness, damping), h, gravity)
    pull = gravity * h * math.sin(slope)
    sliding = published(depth - 0.02, (creep + pull, 0.0, 0.0), h, rows)  # so deep that all rows carry load
    assert float(sliding[1]) == pytest.approx(-mass * pull) and abs(float(sliding[2])) < 1e-12


def test_the_published_clamp_is_the_distance_outside_and_its_depth_inside() -> None:
    distance = torch.linspace(-0.5, 0.5, 201, dtype=F64)
    found = clamped(distance, 0.01, 200.0)
    weight = 1 / (1 + torch.exp(-200.0 * distance))
    torch.testing.assert_close(found, weight * distance + (1 - weight) * -0.01)
    assert float(found[0]) == pytest.approx(-0.01) and float(found[-1]) == pytest.approx(0.5)


def test_rows_of_a_hull_begin_after_those_of_the_body_before() -> None:
    bodies = [replace(plate_body((0.05, 0.04, 0.01 + 0.01 * k)), name=f"p{k}") for k in range(3)]
    world = world_of(*bodies)
    first = sum(body.radii.shape[-1] for body in bodies)
    rows = [sum(part.shape[1] for part in _hull_rows(body)) for body in bodies]
    assert min(rows) > 40
    assert [row for row, *_ in _hulls(world)] == [first, first + rows[0], first + rows[0] + rows[1]]


def test_one_free_body_above_the_ground_goes_into_vectors_and_carries_its_motion() -> None:
    def structure(*bodies: Body, **more: object):
        world = replace(world_of(*bodies), **more)
        state = state_of(*[((k, 0, 1.0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0)) for k in range(len(bodies))])
        return pack(world, state, times(0.1), {}, False).structure

    one = structure(ball_body())
    assert one.widens
    assert not structure(ball_body(), ball_body(name="other")).widens
    assert not replace(one, lanes=2).widens and not replace(one, record=True).widens
    # the time, the motion, an impulse of three numbers, and whether it begins
    assert one.carried_width == 1 + MOTION_COLUMNS + 3 + 1
    assert structure(box_body()).carried_width == 1 + MOTION_COLUMNS + 3 * 8 + 1
    assert replace(structure(box_body()), lanes=4).carried_width == 1 + MOTION_COLUMNS + 3 * 2 + 1


def test_rollouts_together_save_their_calls_and_no_more() -> None:
    world = world_of(ball_body(), step_s=0.01)
    each, together = rollout_seconds(world, 50, 2.0), rollout_seconds(world, 50, 2.0, at_once=50)
    assert each - together == pytest.approx(200 * 49 * _CALL_S, rel=1e-9)
    assert rollout_seconds(world, 100, 2.0, at_once=100) - together == pytest.approx(together - 200 * _CALL_S, rel=1e-9)


def test_the_smooth_minimum_of_the_paper_is_over_the_last_dimension() -> None:
    distances = np.random.default_rng(1).uniform(0.0, 0.1, (2, 3, 4))
    found, weights = log_sum_exp_distance(torch.from_numpy(distances), 200.0)
    expected = -np.log(np.exp(-200.0 * distances).sum(-1)) / 200.0
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)
    np.testing.assert_allclose(weights.numpy(), np.exp(-200.0 * (distances - expected[..., None])), rtol=1e-10)
