"""Losses and mass of a drawer from the forces that push it, whatever path, shape and contact law the finger has."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from cgwm.datasets import Track
from cgwm.datasets.capture.tracks import Episode
from cgwm.pipeline.phys_geo.tracks.contact_result import ContactEstimate
from cgwm.pipeline.phys_geo.tracks.driven_joints import fit_driven_joints
from cgwm.pipeline.phys_geo.tracks.driven_result import DrivenFit, with_nuisance
from cgwm.pipeline.phys_geo.tracks.force_driven import ForceDriven, Grid, Pushes, Samples, hit_errors, impulse_errors
from cgwm.pipeline.phys_geo.tracks.joint_tracks import parabola_speeds
from cgwm.pipeline.phys_geo.tracks.loss_posterior import posterior
from cgwm.pipeline.physics.chains.chain import Chain, Joint
from cgwm.pipeline.physics.chains.parameters import mass_factor
from cgwm.pipeline.physics.chains.values import with_chain_values
from cgwm.pipeline.physics.parameters import apply_parameters, contact_parameters, gap_parameters
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.chains import chained, link
from helpers.worlds import F64, ball_body, batch, law

MASS, DAMPING, FRICTION, MU = 2.0, 4.0, 3.0, 0.3
NOISE = Noise(1e-4, 1e-3)
RATE = 40.0


def world(mass: float = MASS) -> World:
    """A drawer with an almost flat face across x, on a rail along x, and a finger."""
    rail = Joint.of("rail", "slide", "drawer", "case", axis=(1, 0, 0))
    bodies = (link("case", 0.0), link("drawer", mass, spheres=((50.0, 0.0, 0.0, 50.01),)))
    finger = replace(ball_body(0.01, 0.1), name="finger", motion="driven")
    chain = Chain(name="cabinet", root="case", base="fixed", joints=(rail,))
    made = chained(chain, *bodies, finger, ground=False, contact=law(0.3, 0.004, 1.0))
    return replace(made, gravity=torch.zeros(1, 3, dtype=F64))


def push(seed: int, sliding: float = 0.0, shift_m: float = 0.0) -> Episode:
    """A drawer at a finger on a path of least jerk, which may slide along the face."""
    rng = np.random.default_rng(seed)
    times, length = np.arange(0, 1.2, 1 / RATE), 0.08 + 0.04 * seed
    s = np.clip(times, 0, 1)
    way = length * s**3 * (10 - 15 * s + 6 * s**2)
    speed, acceleration = length * 30 * s**2 * (1 - s) ** 2, length * 60 * s * (1 - s) * (1 - 2 * s)
    pressed = np.where((times > 0) & (times < 1), MASS * acceleration + FRICTION + DAMPING * speed, 0.0)
    assert pressed.min() >= 0
    zero = np.zeros_like(way)
    force = np.stack((pressed, MU * pressed if sliding else zero, zero), 1) + 0.05 * rng.standard_normal((len(way), 3))
    finger = np.stack((way - 0.02 + shift_m, sliding * way - 0.03 * bool(sliding), zero), 1)
    finger += NOISE.position_m * rng.standard_normal(finger.shape)
    drawer = np.stack((way, zero, zero), 1) + NOISE.position_m * rng.standard_normal((len(way), 3))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(way), 1))
    tracks = {
        "case": Track(times, np.zeros((len(way), 3)), quat),
        "drawer": Track(times, drawer, quat),
        "finger": Track(times, finger, quat, force_n=force),
    }
    return Episode(f"{seed}", tracks)


@cache
def fitted(sliding: float = 0.0, shift_m: float = 0.0) -> DrivenFit:
    episodes = [push(seed, sliding, shift_m) for seed in range(2)]
    found = fit_driven_joints(world(1.8), episodes, NOISE, 0.05)
    assert found is not None
    return found


def test_forces_give_back_losses_and_mass() -> None:
    found, std = fitted(), np.sqrt(np.diag(fitted().covariance))
    truth = {"rail.damping": DAMPING, "rail.friction": FRICTION, "cabinet.mass_factor": MASS / 1.8}
    assert [p.name for p in found.parameters] == list(truth)
    off = found.values - np.log(list(truth.values()))
    assert (np.abs(off) < 2.5 * std).all() and (std < [0.15, 0.03, 0.03]).all()
    assert found.record["converged"] and 0.5 < found.record["misfit"] < 1.6


def test_shape_and_path_of_the_finger_do_not_enter() -> None:
    """A finger 0.3 mm off, with noise in its path, along which the face slides."""
    off, still = fitted(sliding=0.8, shift_m=3e-4), fitted()
    assert (np.abs(off.values - still.values) < 0.3 * np.sqrt(np.diag(still.covariance))).all()
    np.testing.assert_allclose(off.covariance, still.covariance, rtol=0.5)


def test_friction_of_the_finger_is_told_by_a_slip_alone() -> None:
    """Noise in the path of a finger that does not slide is no slip."""
    (one,) = fitted().pressed
    assert one.friction is None
    (one,) = fitted(sliding=0.8, shift_m=3e-4).pressed
    assert one.friction is not None
    assert abs(one.friction[0] - np.log(MU)) < 2 * np.sqrt(one.friction[1]) < 0.3
    assert 1.5 < one.rate_m_s2 < 2.5


def test_forces_that_are_not_all_that_drives_a_drawer_are_left_to_the_contact_law() -> None:
    floor = replace(world(), ground_normal=torch.tensor([0.0, 0.0, 1.0], dtype=F64), ground_offset=batch(-0.03))
    assert fit_driven_joints(floor, [push(0)], NOISE, 0.05) is None
    tracks = push(0).tracks
    unmeasured = Episode("0", tracks | {"finger": replace(tracks["finger"], force_n=None)})
    assert fit_driven_joints(world(), [unmeasured], NOISE, 0.05) is None
    chain = replace(world().chains[0], base="free")
    assert fit_driven_joints(replace(world(), chains=(chain,)), [push(0)], NOISE, 0.05) is None


def driven(force_n: float, sense: int) -> ForceDriven:
    """A drawer under a constant force for half a second."""
    times = torch.arange(0, 0.51, 0.05, dtype=F64)[None]
    grid = Grid.of(times, torch.ones_like(times, dtype=torch.bool))
    force = np.tile([force_n, 0.0, 0.0], (20, 1))
    track = Track(np.linspace(0, 1, 20), np.zeros((20, 3)), force_n=force)
    samples, none = Samples.of([track]), torch.zeros(*grid.middle_s.shape, 3, dtype=F64)
    offset = torch.tensor([0.5, 0.0, 0.0], dtype=F64)
    exerted = Pushes(link=1, samples=samples, force_n=none, place_m=none, torque_n_m=none, offset_n=offset)
    senses = torch.full((1, times.shape[1] - 1, 1), float(sense), dtype=F64)
    root = torch.tensor([0.0, 0, 0, 1, 0, 0, 0], dtype=F64)
    return ForceDriven(world=world(), chain=world().chains[0], root=root, grid=grid, pushes=[exerted], sense=senses)


def test_a_constant_force_brings_a_drawer_to_its_speed() -> None:
    """v = (F - f) / d (1 - exp(-d t / m)); without a sense of the motion there is no friction."""
    column = {"rail.damping": batch(DAMPING), "rail.friction": batch(FRICTION), "cabinet.mass_factor": batch(1.5)}
    start, more = [torch.zeros(1, 1, dtype=F64)] * 2, torch.zeros(1, 10, 1, dtype=F64)
    for sense, dry in ((1, FRICTION), (0, 0.0)):
        one, off = driven(4.5, sense), torch.tensor([[0.0, 0.0, 1.0]], dtype=F64)
        moved = one.motion(column, torch.tensor([0]), start, more, off)[0, :, 0].numpy()
        t, rate = np.arange(0, 0.51, 0.05), DAMPING / (1.5 * MASS)
        np.testing.assert_allclose(moved, (5.0 - dry) / DAMPING * (t - (1 - np.exp(-rate * t)) / rate), atol=2e-6)


def test_samples_that_are_means_give_back_the_force() -> None:
    """Of a parabola, whose mean over an interval is higher by its second difference over 24."""
    times = np.arange(0, 1.01, 0.1)
    force = np.stack((times**2 + 0.1**2 / 12, 0 * times, 0 * times), 1)
    samples = Samples.of([Track(times, np.zeros((11, 3)), force_n=force)])
    at = torch.tensor([[0.33, 0.5, 0.64]], dtype=F64)
    found = samples.at(torch.tensor([0]), at, torch.ones(1, dtype=F64))
    np.testing.assert_allclose(found[0, :, 0], at[0] ** 2, atol=1e-12)


def test_impulses_are_less_sure_where_a_force_sets_in_and_where_something_may_have_hit() -> None:
    times = np.arange(0, 1.01, 0.1)
    force = np.where(times[:, None] > 0.45, 2.0, 0.0) * np.array([1.0, 0.0, 0.0])
    track = Track(times, np.zeros((11, 3)), force_n=force)
    found = impulse_errors(track, 0.01, times)
    np.testing.assert_allclose(found[[0, 2, 6, 9]], 0.01)
    np.testing.assert_allclose(found[3:6], np.hypot(0.01, 2 / np.sqrt(12)))
    gap = np.maximum(0.1 - 0.2 * times, 0.0)
    hit = hit_errors(track, 0.01, times, gap)
    assert (hit[:2] == 0).all() and (hit[2:6] > 0).all() and (hit[6:] == 0).all()
    np.testing.assert_allclose(hit[4], 0.2 / 0.1)  # all of its speed within an interval


def test_a_speed_before_a_jump_is_that_before_it() -> None:
    times = np.arange(0, 1, 0.05)
    way = np.maximum(times - 0.5, 0.0)[:, None]
    jumps = np.zeros(19, bool)
    jumps[10] = True
    speeds, _ = parabola_speeds(times, way, np.full_like(way, 1e-3), jumps)
    np.testing.assert_allclose(speeds[:, 0], np.where(times <= 0.5 + 1e-9, 0.0, 1.0), atol=1e-9)
    assert 0.1 < parabola_speeds(times, way, np.full_like(way, 1e-3))[0][10, 0] < 0.9


def test_a_push_on_a_door_acts_by_its_arm() -> None:
    """Without a loss, I a'' = F r as long as the angle is small."""
    hinge = Joint.of("hinge", "hinge", "drawer", "case", axis=(0, 0, 1))
    one = driven(0.01, 0)
    chain = replace(one.chain, joints=(hinge,))
    place = torch.zeros_like(one.pushes[0].place_m) + torch.tensor([0.3, 0.0, 0.0], dtype=F64)
    force = np.tile([0.0, 0.01, 0.0], (20, 1))
    samples = Samples.of([Track(np.linspace(0, 1, 20), np.zeros((20, 3)), force_n=force)])
    exerted = replace(one.pushes[0], place_m=place, samples=samples)
    door = replace(one, world=replace(one.world, chains=(chain,)), chain=chain, pushes=[exerted])
    none = torch.zeros(1, 1, dtype=F64)
    moved = door.motion({}, torch.tensor([0]), [none, none], torch.zeros(1, 10, 1, dtype=F64), none.expand(1, 3))
    body = world().bodies[1]
    inertia = float(body.inertia[0, 2, 2] + body.mass[0] * body.com[0].square().sum())
    t = np.arange(0, 0.51, 0.05)
    np.testing.assert_allclose(moved[0, :, 0], 0.5 * 0.003 / inertia * t**2, rtol=1e-3, atol=1e-9)


def test_intervals_are_those_of_the_curvature_where_data_tell_all() -> None:
    names = fitted().parameters
    best, units = np.array([1.0, 1.0, 0.1]), np.array([DAMPING, FRICTION, 0.0])
    root = np.array([[60.0, 20.0, 5.0], [0.0, 80.0, 10.0], [0.0, 0.0, 50.0]])
    values, covariance = posterior(best, units, root.T @ root, np.zeros(3), names)
    std = np.sqrt(np.diag(np.linalg.inv(root.T @ root)))
    np.testing.assert_allclose(values, [*np.log([DAMPING, FRICTION]), 0.1], atol=0.15 * std.max())
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std, rtol=0.1)


def test_a_sum_of_losses_leaves_each_of_them_open() -> None:
    """Known is friction + 0.1 damping = 3 to a hundredth: the best point says nothing of either."""
    names = fitted().parameters
    row = np.array([0.1, 1.0, 0.0])
    information = np.outer(row, row) / 0.03**2
    for damping in (0.5, 20.0):
        best = np.array([damping, 3.0 - 0.1 * damping, 0.0])
        values, covariance = posterior(best, np.array([1.0, 1.0, 0.0]), information, np.zeros(3), names)
        reach = 1.96 * np.sqrt(np.diag(covariance))
        low, high = np.exp(values - reach), np.exp(values + reach)
        assert low[0] < 1.5 and high[0] > 15 and low[1] < 1.5 and 2.8 < high[1] < 3.6


def test_a_factor_of_all_masses_moves_masses_and_inertias() -> None:
    one = with_chain_values(world(), {mass_factor(world().chains[0]).name: batch(1.5)})
    before, after = (w.bodies[1] for w in (world(), one))
    np.testing.assert_allclose(after.mass, 1.5 * before.mass)
    np.testing.assert_allclose(after.inertia, 1.5 * before.inertia)


def test_a_nuisance_widens_as_if_it_were_fitted_and_eliminated() -> None:
    names = contact_parameters(world())[1:]
    prior = np.diag([p.prior[1] ** -2 for p in names])
    data, slope = np.array([[40.0, 5.0], [5.0, 9.0]]), np.array([0.7, 0.7])
    covariance, values = np.linalg.inv(data + prior), np.log([0.01, 0.5])
    moved = np.outer(slope, slope)
    _, wider = with_nuisance(values, covariance, names, moved)
    joint = np.block(
        [[data + prior, (data @ slope)[:, None]], [(data @ slope)[None], np.array([[slope @ data @ slope + 1]])]]
    )
    np.testing.assert_allclose(wider, np.linalg.inv(joint)[:2, :2], rtol=1e-9)
    np.testing.assert_allclose(with_nuisance(values, covariance, names, 0 * moved)[0], values, rtol=1e-9)
    middle = [p.encode(p.prior[0]) for p in names]
    np.testing.assert_allclose(with_nuisance(values, covariance, names, 1e9 * np.eye(2))[0], middle, atol=1e-6)


def test_what_forces_tell_takes_the_place_of_what_the_motion_says() -> None:
    """And the gap, unknown to tenths of a millimetre, leaves little of a contact that is as deep."""
    fit, names = fitted(), contact_parameters(world())
    usual = [*names, *fit.parameters[:2]]
    narrowed = fit.narrowed([(p, p.prior[0]) for p in usual])
    assert [p.prior[1] for p, _ in narrowed[3:]] == [np.sqrt(v) for v in np.diag(fit.covariance)[:2]]
    values = np.array([np.log(v) for v in (0.3, 0.01, 0.5, 9.0, 9.0)])
    estimate = ContactEstimate(parameters=[p for p, _ in narrowed], values=values, covariance=1e-4 * np.eye(5))
    found = fit.put_in(estimate, usual)
    assert [p.name for p in found.parameters] == [*(p.name for p in usual), "cabinet.mass_factor"]
    np.testing.assert_allclose(found.values[3:], fit.values)
    np.testing.assert_allclose(found.covariance[3:, 3:], fit.covariance)
    assert found.covariance[0, 0] == names[0].prior[1] ** 2  # nothing slides
    depth = fit.pressed[0].rate_m_s2 * 0.01**2
    known = replace(fit.pressed[0], gap_std_m=2e-4)
    assert abs(known.moved_by_gap(0.01) / (2e-4 / (2 * depth)) - 1) < 1e-12
    moved = replace(fit, pressed=[known]).put_in(estimate, usual)
    assert 0.2 < np.sqrt(moved.covariance[1, 1]) < names[1].prior[1]


def test_a_gap_makes_the_finger_larger() -> None:
    (gap,) = gap_parameters(world())
    assert gap.name == "finger.gap_m" and not gap_parameters(replace(world(), chains=()))
    larger = apply_parameters(world(), [gap], torch.tensor([[1e-4], [-2e-4]], dtype=F64))
    np.testing.assert_allclose(larger.bodies[2].radii[:, 0], [0.0101, 0.0098])
