"""Impacts of rigid bodies by their textbook laws, and what segments are cut, filled and combined from."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.geometry.rotation import quat_exp, quat_rotate
from cgwm.pipeline.physics.contact_law import restitution
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.segments import contact_phases as phases_module
from cgwm.pipeline.segments.candidates import Candidate, admissible, base_parameters, variants_of, without_effects
from cgwm.pipeline.segments.center_of_mass import _center_of_mass, _one_body
from cgwm.pipeline.segments.contact_phases import phases_of
from cgwm.pipeline.segments.flights.slow_errors import COMMON_S, LIMITS, _timed_forces
from cgwm.pipeline.segments.impact_law import (
    SLICES,
    Impact,
    _braked,
    _cone,
    after_impact,
    point_velocity,
    rebound_speed,
    within_cone,
)
from cgwm.pipeline.segments.prepare import _cut
from cgwm.pipeline.segments.segments import (
    CONTACT_STEP_S,
    FLIGHT_STEP_NOISE_M,
    FLIGHT_STEP_S,
    _line,
    _windows,
    world_for,
)
from cgwm.pipeline.trajectories.segmentation import Segment, size_of, whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import world_with
from helpers.worlds import F64, ball_body, box_body, law, world_of

MASS, RADIUS_M = 0.2, 0.04
UP = torch.tensor([0.0, 0.0, 1.0], dtype=F64)


def impact(twist: list[float], impulse: float = 0.5, arm: list[float] | None = None, weight: float = 0.0) -> Impact:
    """Return one impact of a ball, or of a body with a given arm and an inertia of its own."""
    found = [0.0, 0.0, -RADIUS_M] if arm is None else arm
    inertia = 0.4 * MASS * RADIUS_M**2 * torch.eye(3, dtype=F64)
    if arm is not None:
        inertia = inertia @ torch.diag(torch.tensor([1.0, 2.0, 3.0], dtype=F64)) + 2e-5
    return Impact(
        before=torch.tensor([twist], dtype=F64),
        impulse=torch.tensor([impulse], dtype=F64),
        place=torch.zeros(1, 3, dtype=F64),
        rotation=torch.eye(3, dtype=F64)[None],
        arm=torch.tensor([found], dtype=F64),
        inertia=inertia[None],
        mass=torch.tensor([MASS], dtype=F64),
        normal=UP,
        weight=torch.tensor([weight], dtype=F64),
        body=ball_body(RADIUS_M, MASS),
    )


def test_an_impulse_changes_the_velocity_of_its_point_by_the_compliance() -> None:
    one = impact([0.0] * 6, arm=[0.01, -0.02, -0.03])
    for push in torch.eye(3, dtype=F64):
        omega = torch.linalg.solve(one.inertia[0], torch.linalg.cross(one.arm[0], push))
        moved = torch.cat([push / MASS, omega])[None]
        torch.testing.assert_close(point_velocity(moved, one.arm)[0], one.compliance[0] @ push)


@pytest.mark.parametrize("zeta", [0.05, 0.3, 0.8])
def test_a_spring_and_damper_give_their_restitution(zeta: float) -> None:
    contact = law(0.3, 0.004, zeta)
    found = rebound_speed(impact([0.3, 0.0, -2.0, 0, 0, 0]), contact, [])
    assert float(found) == pytest.approx(2.0 * float(restitution(torch.tensor(zeta, dtype=F64))), rel=2e-3)
    heavy = rebound_speed(impact([0.0, 0.0, -2.0, 0, 0, 0], weight=9.81), contact, [])
    assert 0.95 * float(found) < float(heavy) < float(found)
    spun = rebound_speed(impact([0.0, 0.0, 0.0, 0.0, 50.0, 0.0], arm=[0.04, 0.0, -0.04]), contact, [])
    assert float(spun) == pytest.approx(50 * 0.04 * float(found) / 2.0, rel=1e-6)  # of the point, not of the centre


def test_a_pull_takes_its_work_from_a_rebound() -> None:
    adhesion = ActiveEffect.of(load_effect("adhesion"), {"F": 2.0})
    contact = law(0.3, 0.002, 0.1)
    plain, pulled = (rebound_speed(impact([0.0, 0.0, -2.0, 0, 0, 0]), contact, some) for some in ([], [adhesion]))
    assert float(pulled) < float(plain)
    slow = rebound_speed(impact([0.0, 0.0, -0.02, 0, 0, 0]), contact, [ActiveEffect.of(adhesion.effect, {"F": 50.0})])
    assert float(slow) == 0.0


def test_a_pull_weighs_on_the_contact_and_does_work_on_the_way_in_and_out() -> None:
    """With F (1 - (h / g)^2)^2 within the gap g the work is 8/15 F g."""
    force, gap, speed = 2.0, 0.002, 0.3
    adhesion = ActiveEffect.of(load_effect("adhesion"), {"F": force, "g": gap})
    contact = law(0.3, 0.002, 0.1)
    found = float(rebound_speed(impact([0.0, 0.0, -speed, 0, 0, 0]), contact, [adhesion]))
    work = 8 / 15 * force * gap / MASS
    heavy = impact([0.0, 0.0, -math.hypot(speed, math.sqrt(2 * work)), 0, 0, 0], weight=force / MASS)
    expected = math.sqrt(float(rebound_speed(heavy, contact, [])) ** 2 - 2 * work)
    assert found == pytest.approx(expected, rel=2e-3)


def test_a_ball_that_grips_keeps_five_sevenths_and_one_that_slides_loses_the_friction() -> None:
    one = impact([1.0, 0.0, -2.0, 0.0, 0.0, 0.0], impulse=0.6)
    gripped = after_impact(one, law(2.0), [])[0]
    assert float(gripped[0]) == pytest.approx(5 / 7, rel=1e-6)
    torch.testing.assert_close(
        point_velocity(gripped[None], one.arm)[0, :2], torch.zeros(2, dtype=F64), atol=1e-9, rtol=0
    )
    assert float(gripped[2]) == pytest.approx(-2.0 + 0.6 / MASS)
    slid = after_impact(one, law(0.05), [])[0]
    assert float(slid[0]) == pytest.approx(1.0 - 0.05 * 0.6 / MASS)
    turned = 0.05 * 0.6 * RADIUS_M / (0.4 * MASS * RADIUS_M**2)
    torch.testing.assert_close(slid[3:], torch.tensor([0.0, turned, 0.0], dtype=F64))
    other = after_impact(impact([0.6, -0.8, -2.0, 0.0, 0.0, 0.0], impulse=0.6), law(0.05), [])[0]
    lost = 0.05 * 0.6 / MASS
    torch.testing.assert_close(other[:2], torch.tensor([0.6, -0.8], dtype=F64) * (1 - lost))


def test_impulses_of_any_body_keep_its_momenta() -> None:
    one = impact([0.7, -0.3, -2.0, 3.0, -1.0, 2.0], arm=[0.01, -0.02, -0.03])
    after = after_impact(one, law(0.2), [])
    push = MASS * (after - one.before)[0, :3]
    assert float(push[2]) == pytest.approx(0.5)
    assert float(push[:2].norm()) <= 0.2 * 0.5 + 1e-9
    spun = one.inertia[0] @ (after - one.before)[0, 3:]
    torch.testing.assert_close(spun, torch.linalg.cross(one.arm[0], push))


def test_friction_stops_the_slip_within_its_cone_and_opposes_it_outside() -> None:
    cone = torch.tensor([[[0.3, 0.1], [0.1, 0.2]]], dtype=F64)
    slip = torch.tensor([[1.0, -0.5]], dtype=F64)
    edge = 2.0 * cone[0] @ torch.tensor([0.6, 0.8], dtype=F64)
    found = within_cone(0.99 * edge[None], slip, cone, torch.tensor([2.0], dtype=F64))
    torch.testing.assert_close(found, 0.99 * edge[None])
    far = within_cone(1.01 * edge[None], slip, cone, torch.tensor([2.0], dtype=F64))
    along = cone[0] @ slip[0]
    torch.testing.assert_close(far[0], -2.0 * cone[0] @ along / along.norm())
    touch: Any = SimpleNamespace(friction=torch.tensor([[0.4]], dtype=F64), anisotropy=None)
    torch.testing.assert_close(_cone(touch)[0], 0.4 * torch.eye(2, dtype=F64))
    touch.anisotropy = torch.tensor([[[0.1, -0.05]]], dtype=F64)
    torch.testing.assert_close(_cone(touch)[0], torch.tensor([[0.5, -0.05], [-0.05, 0.3]], dtype=F64))
    touch.friction = -touch.friction
    torch.testing.assert_close(_cone(touch)[0], torch.tensor([[0.1, -0.05], [-0.05, -0.1]], dtype=F64))


def test_torques_of_rolling_and_spinning_stop_a_turn_and_reverse_none() -> None:
    inertia = 0.4 * MASS * RADIUS_M**2
    one, slice_ = impact([0.0, 0.0, 0.0, 3.0, 4.0, -2.0]), torch.tensor([0.5 / SLICES], dtype=F64)
    for rolling, torsion in ((1e-4, None), (None, 2e-4), (1e-4, 2e-4)):
        sizes = [None if size is None else torch.tensor([size], dtype=F64) for size in (rolling, torsion)]
        touch: Any = SimpleNamespace(rolling_m=sizes[0], torsion_m=sizes[1])
        omega = _braked(one, touch, slice_, one.before)[0, 3:]
        level = 5.0 - (rolling or 0.0) * float(slice_) / inertia
        spin = -2.0 + (torsion or 0.0) * float(slice_) / inertia
        torch.testing.assert_close(omega, torch.tensor([0.6 * level, 0.8 * level, spin], dtype=F64))
    strong = torch.tensor([9.0], dtype=F64)
    stopped = _braked(one, SimpleNamespace(rolling_m=strong, torsion_m=strong), slice_, one.before)  # pyright: ignore
    torch.testing.assert_close(stopped[0, 3:], torch.zeros(3, dtype=F64), atol=1e-12, rtol=0)


def test_lines_are_weighted_least_squares() -> None:
    rng = np.random.default_rng(0)
    t, values = np.sort(rng.uniform(0, 1, (1, 7))), rng.normal(size=(1, 7, 3))
    weight = np.array([[1.0, 0, 1, 1, 0, 1, 1]])
    at, slope = _line(*(torch.as_tensor(x) for x in (t, values, weight)))
    kept = weight[0] > 0
    for axis in range(3):
        wanted = np.polyfit(t[0, kept], values[0, kept, axis], 1)
        assert float(slope[0, axis]) == pytest.approx(wanted[0]) and float(at[0, axis]) == pytest.approx(wanted[1])


TIMES = np.arange(20) / 100


def two_episodes() -> Any:
    rng = np.random.default_rng(0)
    episodes = []
    for name in "ab":
        quat = quat_exp(torch.as_tensor(rng.normal(size=(20, 3)))).numpy()
        episodes.append(Episode(name, {"box": Track(TIMES + 0.2 * (name == "b"), rng.normal(size=(20, 3)), quat)}))
    return whole_episodes(world_of(box_body()), episodes)


def test_windows_of_segments_are_their_frames_and_go_on_at_their_rate() -> None:
    whole = two_episodes()
    found = _windows(whole, [Segment(1, 3, 9), Segment(0, 5, 15)])
    assert found.names == ("b", "a") and found.times_s.shape == (2, 11)
    torch.testing.assert_close(found.position_m[0, :7], whole.position_m[1, 3:10])
    torch.testing.assert_close(found.quat_wxyz[1], whole.quat_wxyz[0, 5:16])
    assert found.seen[0, :, 0].tolist() == [1.0] * 7 + [0.0] * 4 == found.has_orientation[0, :, 0].tolist()
    torch.testing.assert_close(found.times_s[0], whole.times_s[1, 3] + torch.arange(11, dtype=F64) / 100)
    torch.testing.assert_close(found.times_s[1], whole.times_s[0, 5:16])


def test_flights_are_cut_into_equal_pieces_of_six_frames_or_more() -> None:
    whole = two_episodes()
    assert _cut(Segment(0, 1, 18), whole, 0.06) == [Segment(0, 1, 6), Segment(0, 7, 12), Segment(0, 13, 18)]
    assert _cut(Segment(1, 2, 12), whole, 0.01) == [Segment(1, 2, 12)]
    assert _cut(Segment(1, 2, 18), whole, 0.1) == [Segment(1, 2, 9), Segment(1, 10, 18)]


def test_steps_are_as_long_as_the_noise_and_the_contact_allow() -> None:
    world = world_of(box_body(), contact=law(0.3, 0.004), step_s=0.0005)
    flight = world_for("flight", world, FLIGHT_STEP_NOISE_M / 2)
    assert not flight.touching and flight.step_s == pytest.approx(FLIGHT_STEP_S / 2)
    assert world_for("flight", world, 1.0).step_s == FLIGHT_STEP_S
    contact = world_for("contact", world, 1.0)
    assert contact.touching and contact.step_s == pytest.approx(min(CONTACT_STEP_S, 0.002))
    assert world_for("contact", replace(world, step_s=0.05), 1.0).step_s == 0.05


def test_candidates_need_what_was_measured_and_what_the_model_lacks() -> None:
    some = [Candidate(name, load_effect(name)) for name in ("linear_drag", "wind", "com_offset", "rolling_resistance")]
    kept, refused = admissible(world_with("ball"), some, turned=False)
    assert [one.spec for one in kept] == ["linear_drag", "rolling_resistance"]
    assert "has no drag" in refused["wind"] and "measured" in refused["com_offset"]
    dragged = world_with("ball", {"linear_drag": {"c": 0.2}})
    kept, refused = admissible(dragged, some, turned=True)
    assert refused == {"linear_drag": "the model has it"}
    windy = world_with("ball", {"linear_drag": {"c": 0.2}, "wind": {}, "com_offset": {}})
    assert [one.effect.name for one in without_effects(windy, "com_offset").effects] == ["linear_drag", "wind"]
    assert [one.effect.name for one in without_effects(windy, "linear_drag").effects] == ["com_offset"]
    rolling = world_with("ball", {"linear_drag": {"c": 0.2}, "rolling_resistance": {"c_r": 0.01}})
    assert {p.name for p in base_parameters(rolling, "flight")} == {"linear_drag.c"}
    names = {p.name for p in base_parameters(rolling, "contact")}
    assert {"linear_drag.c", "rolling_resistance.c_r", "friction", "ground_shift_m"} <= names
    variants = variants_of(some, torch.zeros(1, dtype=F64))
    assert len({one.active.effect.name for one in variants}) == len(variants) >= 4
    assert sorted({one.place for one in variants}) == [0, 1, 2, 3]


def test_phases_are_those_of_segments_where_frames_are_not_airborne(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = two_episodes()
    seen = whole.seen.clone()
    seen[0, 16:] = 0
    airborne = torch.zeros(2, 20, dtype=torch.bool)
    airborne[1, 7] = True
    contact: Any = SimpleNamespace(items=[Segment(1, 5, 8)])
    monkeypatch.setattr(phases_module, "contact_phases", lambda _: [["impact", "sliding", "rest", "rolling"]])
    first, second = phases_of(("a", "b"), replace(whole, seen=seen), airborne, contact)
    assert first.episode == "a" and first.phase.tolist() == ["flight"] * 16 and len(first.time_s) == 16
    wanted = ["flight"] * 5 + ["impact", "sliding", "flight", "rolling"] + ["flight"] * 11
    assert second.phase.tolist() == wanted and second.airborne.tolist() == airborne[1].tolist()


def test_forces_of_one_interval_of_time_push_all_episodes_alike() -> None:
    count = LIMITS.least_episodes
    times = torch.arange(12, dtype=F64).expand(count, -1) * 0.02
    segments: Any = SimpleNamespace(
        observations=SimpleNamespace(times_s=times, free=(0,)),
        items=[SimpleNamespace(episode=k) for k in range(count)],
        lengths=[12] * count,
        noise=Noise(2e-3, 1e-2),
    )
    found = _timed_forces(segments)
    edges = np.arange(0, float(times[0, -1]), COMMON_S)
    assert found.shape == (count, 12, 6, 3 * len(edges)) and not found[:, :, 3:].any()
    for axis in range(3):
        own = found[0, :, axis].abs().sum(0) > 0
        assert int(own.sum()) >= len(edges) - 1
    # a force of 1 during an interval: no path before it, then a parabola, then a straight line
    path = found[0, :, 0, :].numpy() * 2e-3
    for column in np.flatnonzero(path.any(0)):
        t = times[0].numpy()
        fits = [
            np.allclose(
                path[:, column],
                0.5 * (np.clip(t - e, 0, None) ** 2 - np.clip(t - e - COMMON_S, 0, None) ** 2),
            )
            for e in edges
        ]
        assert sum(fits) == 1
    segments.items = [SimpleNamespace(episode=0)] * count
    assert _timed_forces(segments).shape == (count, 12, 6, 0)


def test_the_centre_of_mass_of_links_is_weighted_by_their_masses() -> None:
    heavy, light = replace(box_body(mass=0.6), name="a"), replace(ball_body(mass=0.2), name="b")
    heavy = replace(heavy, com=torch.tensor([[0.01, 0.02, -0.01]], dtype=F64))
    world = world_of(heavy, light)
    rng = np.random.default_rng(0)
    quat = quat_exp(torch.as_tensor(rng.normal(size=(20, 3)))).numpy()
    tracks = {name: Track(TIMES, rng.normal(size=(20, 3)), quat) for name in "ab"}
    whole = whole_episodes(world, [Episode("e", tracks)])
    seen = whole.seen.clone()
    seen[0, 3, 1] = 0
    whole = replace(whole, seen=seen)
    center, known = _center_of_mass(world, whole, world.bodies)
    own = whole.position_m[0, :, 0] + quat_rotate(torch.as_tensor(quat), heavy.com[0])
    torch.testing.assert_close(center[0], 0.75 * own + 0.25 * whole.position_m[0, :, 1])
    assert known[0].tolist() == [k != 3 for k in range(20)]
    chain: Any = SimpleNamespace(name="arm")
    one = _one_body(world, chain, world.bodies, center, whole)
    far = [
        float((whole.position_m[0, :, k] - center[0]).norm(dim=-1)[seen[0, :, k] > 0].max()) + size_of(world.bodies[k])
        for k in (0, 1)
    ]
    assert one.name == "arm" and float(one.mass[0]) == pytest.approx(0.8)
    assert one.radii.tolist() == [[pytest.approx(max(far))]]
    torch.testing.assert_close(one.inertia[0], 0.4 * 0.8 * max(far) ** 2 * torch.eye(3, dtype=F64))
    assert not one.com.any() and not one.centers.any()
