"""Flat faces on the ground: the pressure and the friction of a plate."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.pipeline.physics import World
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.impulse_solver import _share, _share_by_area
from cgwm.schemas import InputDataError
from helpers.small_model import small_model
from helpers.worlds import F64, ball_body, batch, box_body, law, plate_body, state_of, times, world_of
from numpy.typing import NDArray

Array = NDArray[np.float64]

G = 9.81
UP = (1.0, 0.0, 0.0, 0.0)
HALF, RADIUS, FINGER_M, FRICTION, TAU = 0.05, 5e-4, 0.005, 0.3, 0.003
STROKE_M, SPEED_M_S = 0.02, 0.02


def of_finger(points: int) -> World:
    """A square plate, without points carried by its corners alone, and a finger without friction."""
    box = plate_body((HALF, HALF, 0.01), points=max(points, 1), radius=RADIUS)
    box = replace(box, material="plate", patch=box.patch if points else None)
    finger = replace(ball_body(FINGER_M, name="finger"), motion="driven", material="finger")
    world = world_of(box, finger, contact=law(FRICTION, TAU, 0.7), step_s=0.001)
    return replace(world, pair_laws={("finger", "plate"): law(1e-6, TAU, 0.7)})


def turn_of_plate(offset_m: float, points: int) -> float:
    """Return by how much the engine's plate turns [rad] as a finger pushes it beside its middle."""
    end = 0.1 + STROKE_M / SPEED_M_S
    first = -HALF - FINGER_M
    path = np.array([[first, offset_m, FINGER_M], [first, offset_m, FINGER_M], [first + STROKE_M, offset_m, FINGER_M]])
    track = Track(np.array([0, 0.1, end]), path, np.tile(UP, (3, 1)))
    resting = ((0, 0, 0.01 - G * TAU**2), UP, (0, 0, 0), (0, 0, 0))
    start = state_of(resting, (tuple(path[0]), UP, (0,) * 3, (0,) * 3))
    rollout = roll_out(of_finger(points), start, torch.tensor([0, end], dtype=F64), {"finger": track})
    w, _, _, z = rollout.quat_wxyz[0, -1, 0].tolist()
    return 2 * math.atan2(z, w)


def slowest(points: Array, pressure: Array, arm: Array, found: Array) -> tuple[Array, Array]:
    """Return the twist (vx, vy, w) of a plate whose point `arm` moves at 1 along x, and its friction force.

    Coulomb friction at every point, quasi-static: the twist takes the least power of all that have this speed. Newton's
    method from `found`.
    """
    x, y = points.T
    across = np.stack([0 * x, arm[1] - y], 1), np.stack([1 + 0 * x, x], 1)
    to_point = np.stack(across, 1)

    def slip(twist: Array) -> Array:
        return to_point @ twist + np.array([1.0, 0.0])

    def power(twist: Array) -> float:
        return float(pressure @ np.linalg.norm(slip(twist), axis=1))

    for _ in range(50):
        u = slip(found)
        size = np.sqrt((u**2).sum(1) + 1e-12)
        e = u / size[:, None]
        slope = np.einsum("p,pc,pck->k", pressure, e, to_point)
        bent = (np.eye(2) - e[:, :, None] * e[:, None]) * (pressure / size)[:, None, None]
        move = -np.linalg.solve(np.einsum("pck,pcd,pdl->kl", to_point, bent, to_point), slope)
        k = 1.0
        while power(found + k * move) > power(found) and k > 1e-6:
            k /= 2
        found = found + k * move
        if np.abs(move).max() < 1e-8:
            break
    return found, pressure @ (slip(found) / np.linalg.norm(slip(found), axis=1)[:, None])


def turn_of_mesh(offset_m: float) -> float:
    """Return the turn [rad] of a finely meshed plate, integrated with the second order.

    Its pressure is even but for the moment of the finger's height, which makes it linear.
    """
    half, cells, steps = HALF - RADIUS, 40, 100
    ticks = (np.arange(cells) + 0.5) / cells * 2 * half - half
    points = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), -1).reshape(-1, 2)
    pose, force, found, last = np.zeros(3), np.array([FRICTION, 0.0]), np.array([0.0, 5.0]), None
    for k in range(steps):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        touched = np.array([-HALF - FINGER_M + STROKE_M * k / steps, offset_m]) + FINGER_M * np.array([c, s])
        arm = np.array([[c, s], [-s, c]]) @ (touched - pose[:2])
        tilt = FINGER_M * math.hypot(*force) * points[:, 0] / (half**2 / 3)
        found, friction = slowest(points, (1 + tilt) / len(points), arm, found)
        force = FRICTION * friction
        speed = STROKE_M / steps * c
        vx, vy, w = speed * (1 + found[1] * arm[1]), speed * found[0], speed * found[1]
        move = np.array([c * vx - s * vy, s * vx + c * vy, w])
        pose = pose + (move if last is None else 1.5 * move - 0.5 * last)
        last = move
    return float(pose[2])


@pytest.mark.parametrize("offset_m", [0.012, pytest.param(0.03, marks=pytest.mark.evidence)])
def test_a_plate_pushed_beside_its_middle_turns_as_a_finely_meshed_one(offset_m: float) -> None:
    expected = turn_of_mesh(offset_m)
    assert abs(turn_of_plate(offset_m, 12) / expected - 1) < 0.01
    assert abs(turn_of_plate(offset_m, 0) / expected - 1) > 0.3  # four corners resist the turn twice as much


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
    return World.from_model(replace(plain, file=plain.file.model_copy(update={"bodies": bodies})))


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
