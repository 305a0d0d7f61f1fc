"""Flat faces on the ground: the pressure and the friction of a plate."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.pipeline.physics import World, world_of_model
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.impulse_solver import _share, _share_by_area
from cgwm.schemas import InputDataError
from helpers.quasi_static_plate import Push
from helpers.small_model import small_model
from helpers.worlds import F64, ball_body, batch, box_body, law, plate_body, state_of, times, world_of

G = 9.81
UP = (1.0, 0.0, 0.0, 0.0)
HALF, RADIUS, FINGER_M, FRICTION, TAU = 0.05, 5e-4, 0.005, 0.3, 0.003
STROKE_M, SPEED_M_S = 0.02, 0.02


def of_finger(points: int, exponent: float) -> World:
    """A square plate, without points carried by its corners alone, and a finger without friction."""
    box = plate_body((HALF, HALF, 0.01), points=max(points, 1), radius=RADIUS, exponent=exponent)
    box = replace(box, material="plate", patch=box.patch if points else None)
    finger = replace(ball_body(FINGER_M, name="finger"), motion="driven", material="finger")
    world = world_of(box, finger, contact=law(FRICTION, TAU, 0.7), step_s=0.001)
    return replace(world, pair_laws={("finger", "plate"): law(1e-6, TAU, 0.7)})


def turn_of_plate(offset_m: float, points: int, exponent: float = 0.0) -> float:
    """Return by how much the engine's plate turns [rad] as a finger pushes it beside its middle."""
    end = 0.1 + STROKE_M / SPEED_M_S
    first = -HALF - FINGER_M
    path = np.array([[first, offset_m, FINGER_M], [first, offset_m, FINGER_M], [first + STROKE_M, offset_m, FINGER_M]])
    track = Track(np.array([0, 0.1, end]), path, np.tile(UP, (3, 1)))
    resting = ((0, 0, 0.01 - G * TAU**2), UP, (0, 0, 0), (0, 0, 0))
    start = state_of(resting, (tuple(path[0]), UP, (0,) * 3, (0,) * 3))
    rollout = roll_out(of_finger(points, exponent), start, torch.tensor([0, end], dtype=F64), {"finger": track})
    w, _, _, z = rollout.quat_wxyz[0, -1, 0].tolist()
    return 2 * math.atan2(z, w)


def pushed(offset_m: float, exponent: float = 0.0) -> Push:
    """Return the same push for the reference."""
    return Push(
        half_m=HALF,
        flat_m=HALF - RADIUS,
        finger_m=FINGER_M,
        offset_m=offset_m,
        stroke_m=STROKE_M,
        friction=FRICTION,
        exponent=exponent,
    )


@pytest.mark.parametrize("offset_m", [0.012, pytest.param(0.03, marks=pytest.mark.evidence)])
def test_a_plate_pushed_beside_its_middle_turns_as_a_finely_meshed_one(offset_m: float) -> None:
    expected = pushed(offset_m).turn_of_mesh()
    assert abs(turn_of_plate(offset_m, 12) / expected - 1) < 0.01
    assert abs(turn_of_plate(offset_m, 0) / expected - 1) > 0.3  # four corners resist the turn twice as much
    # the ellipsoid through the same largest force and torque is no plate: beside the middle it resists more
    assert 0.7 < pushed(offset_m).turn_of_ellipsoid() / expected < 0.95


# In the suite: the torque of a plate and what an exponent does to the load are tested below.
@pytest.mark.evidence
@pytest.mark.parametrize("exponent", [2.0, pytest.param(4.0, marks=pytest.mark.evidence)])
def test_a_plate_that_presses_more_at_its_rim_turns_less(exponent: float) -> None:
    expected = pushed(0.012, exponent).turn_of_mesh()
    assert abs(turn_of_plate(0.012, 48, exponent) / expected - 1) < 0.01
    assert abs(expected / pushed(0.012).turn_of_mesh()) < 0.85


def test_points_have_the_area_and_the_second_moments_of_the_faces() -> None:
    half = torch.tensor([0.05, 0.04, 0.03], dtype=F64)
    body = plate_body((0.05, 0.04, 0.03))
    patch = body.patch
    assert patch is not None
    points, flat = patch.centers(body.centers)[0], half - RADIUS
    torch.testing.assert_close(patch.radii(body.radii)[0], torch.full((len(points),), RADIUS, dtype=F64))
    for axis in range(3):
        for sign in (-1.0, 1.0):
            on = (sign * points[:, axis] - flat[axis]).abs() < 1e-9
            others = [k for k in range(3) if k != axis]
            area = patch.areas[on]
            assert int(on.sum()) >= 12
            assert abs(float(area.sum() / (flat[others].prod() / (flat[0] * flat[1]))) - 1) < 1e-9
            mean = (area[:, None] * points[on][:, others]).sum(0) / area.sum()
            spread = (area[:, None] * points[on][:, others].square()).sum(0) / area.sum()
            torch.testing.assert_close(mean, 0 * mean, atol=1e-12, rtol=0)
            torch.testing.assert_close(spread, flat[others].square() / 3)


def test_an_exponent_moves_the_load_to_the_rim_and_keeps_its_sum() -> None:
    """With the exponent 2 the second moment of a square grows by <r^4> / <r^2>^2 = (2/5 + 2/9) / (2/3)^2."""
    even, more = (plate_body((0.05, 0.05, 0.03), points=192, exponent=g) for g in (0.0, 2.0))
    assert even.patch is not None and more.patch is not None
    points = even.patch.centers(even.centers)[0]
    low = (points[:, 2] + 0.0295).abs() < 1e-9
    away = points[low, :2].square().sum(-1)
    first, second = even.patch.areas[low], more.patch.areas[low]
    torch.testing.assert_close(second.sum(), first.sum())
    torch.testing.assert_close(second @ points[low, :2], torch.zeros(2, dtype=F64), atol=1e-12, rtol=0)
    grown = float((second @ away) / (first @ away))
    assert abs(grown / 1.4 - 1) < 2e-3
    torch.testing.assert_close(second / first, away * (first.sum() / (first @ away)), rtol=1e-9, atol=1e-9)


def test_a_spinning_plate_stops_after_the_torque_of_a_plate() -> None:
    """Angular deceleration mu g r / k2: r the mean distance from the middle of a square, k2 = I / m."""
    mean = HALF - RADIUS
    mean *= (math.sqrt(2) + math.asinh(1)) / 3
    rate = 8.0
    box = plate_body((HALF, HALF, 0.01), points=48)
    start = state_of(((0, 0, 0.01 - G * TAU**2), UP, (0, 0, 0), (0, 0, rate)))
    rollout = roll_out(world_of(box, contact=law(FRICTION, TAU, 0.7)), start, times(0.1, 100))
    slowed = rate - float(rollout.omega_body_rad_s[0, -1, 0, 2])
    expected = FRICTION * G * mean / float(box.inertia[0, 2, 2] / box.mass) * 0.1
    assert expected < rate and abs(slowed / expected - 1) < 0.01


def test_a_translated_plate_slides_as_any_other_body() -> None:
    start = state_of(((0, 0, 0.01 - G * TAU**2), UP, (0.4, 0, 0), (0, 0, 0)))
    rollout = roll_out(world_of(plate_body((HALF, HALF, 0.01)), contact=law(FRICTION, TAU, 0.7)), start, times(0.3, 10))
    assert abs(float(rollout.position_m[0, -1, 0, 0]) / (0.4**2 / (2 * FRICTION * G)) - 1) < 0.005


def test_plates_and_boxes_of_plates_rest() -> None:
    """On level ground, and on a slope: no drift above 0.01 mm, and as deep as a mass on a spring."""
    for half in ((HALF, HALF, 0.01), (0.05, 0.04, 0.03), (0.02, 0.02, 0.06)):
        for slope in (0.0, 0.2):
            world = world_of(plate_body(half), contact=law(FRICTION, 0.005, 0.7), step_s=0.0025)
            gravity = batch([G * math.sin(slope), 0.0, -G * math.cos(slope)])
            start = state_of(((0, 0, half[2]), UP, (0, 0, 0), (0, 0, 0)))
            rollout = roll_out(replace(world, gravity=gravity), start, times(3.0, 2))
            place = rollout.position_m[0, 2:, 0]
            assert float((place - place[0]).norm(dim=-1).max()) < 1e-5
            assert 0.5 < float(half[2] - place[-1, 2]) / (G * math.cos(slope) * 0.005**2) < 1.5


def test_a_tumbling_box_of_plates_gains_no_energy_and_comes_to_rest() -> None:
    box = plate_body((0.05, 0.04, 0.03))
    start = state_of(((0, 0, 0.12), (1, 0.3, 0.2, 0.1), (0.5, 0.2, -0.3), (3, 5, -2)))
    rollout = roll_out(world_of(box, contact=law(FRICTION, 0.004, 0.3)), start, times(2.0, 100))
    omega = rollout.omega_body_rad_s[0, :, 0]
    motion = 0.2 * rollout.velocity_m_s[0, :, 0].square().sum(-1) + 0.5 * (omega.square() @ box.inertia[0].diagonal())
    energy = motion + 0.4 * G * rollout.position_m[0, :, 0, 2]
    assert float(energy.max()) < float(energy[0]) + 1e-9
    assert float(motion[-10:].max()) < 1e-8


def test_corners_of_a_square_share_as_they_do_without_areas() -> None:
    box = box_body((HALF, HALF, 0.03))
    corners = box.centers[0][box.centers[0, :, 2] < 0]
    inverse = torch.linalg.cholesky(torch.linalg.inv(box.inertia[0]))
    normal = torch.tensor([0, 0, 1.0], dtype=F64).expand(4, 3)
    rows = torch.cat((normal / box.mass.sqrt(), torch.linalg.cross(corners, normal) @ inverse), -1)[None]
    mass, weight = 1 / rows.square().sum(-1), torch.full((1, 4), 0.25, dtype=F64)
    torch.testing.assert_close(_share_by_area(rows, mass, weight), _share(rows, mass, 4 * weight), rtol=1e-7, atol=0)


def asking(**update: object) -> World:
    """Return the world of the small model's cube with points on its faces."""
    plain = small_model()
    bodies = tuple(body.model_copy(update={"face_points": 12} | update) for body in plain.file.bodies)
    return world_of_model(replace(plain, file=plain.file.model_copy(update={"bodies": bodies})))


def test_a_model_asks_for_points_on_flat_faces() -> None:
    patch = asking(convex=True).bodies[0].patch
    assert patch is not None and len(patch.areas) == 6 * 24


def test_points_without_a_flat_face_are_refused() -> None:
    with pytest.raises(InputDataError) as error:
        asking(convex=False)
    assert str(error.value) == (
        "body 'cube' has face_points = 12 and a shape that does not fill its convex hull.\n"
        "Allowed: face_points of convex bodies with flat faces.\n"
        "Next: leave face_points out, or give the body a shape with flat faces."
    )
