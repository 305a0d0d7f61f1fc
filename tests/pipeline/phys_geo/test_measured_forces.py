"""Friction from the measured force of a slow push: the track alone does not tell it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.datasets.capture.tracks import Episode
from cgwm.pipeline.geometry.rotation import quat_conjugate, quat_log, quat_multiply
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.phys_geo.tracks.contact_result import ContactEstimate, PhysicsFit
from cgwm.pipeline.phys_geo.tracks.force_fit import with_forces
from cgwm.pipeline.phys_geo.tracks.measured_forces import force_noise, measured_forces
from cgwm.pipeline.phys_geo.tracks.multiple_shooting import Shooting, ShootingPrior
from cgwm.pipeline.physics import Rollout, World
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.parameters import contact_parameters
from cgwm.pipeline.trajectories.initial_state import estimate_states, warmup_frames
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import FittedParameter, PhysConfig
from helpers.worlds import ball_body, batch, box_body, law, state_of, world_of

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
MASS, G, FRICTION, SPEED, FORCE_STD = 0.4, 9.81, 0.22, 0.05, 0.02
HALF = (0.05, 0.05, 0.01)
GROUND, FINGER = ("aluminium", "wood"), ("aluminium", "steel")
RADIUS = 0.01
FINE, COARSE = Noise(1e-4, 1e-3), Noise(1e-3, 1e-2)
FAST = PhysConfig(population=8, generations=2, iterations=4, step_s=0.002, mass_distribution=False, length_scale=False)


def world() -> World:
    """A box that a finger pushes; its laws are those at the start of a fit, not the true ones."""
    box, side = box_body(HALF, MASS), batch([[0.005 - HALF[0], 0.0, 0.0]])
    centers, radii = torch.cat((box.centers, side), 1), torch.cat((box.radii, batch([0.005])), 1)
    box = replace(box, material="aluminium", centers=centers, radii=radii)
    finger = replace(ball_body(RADIUS, name="finger"), motion="driven", material="steel")
    same = world_of(box, finger, contact=law(0.5, 0.004, 0.4), step_s=0.002)
    return replace(same, ground_material="wood", pair_laws={GROUND: law(0.5), FINGER: law(0.5)})


def pushed(friction: float, sideways_m: float = 0.0) -> tuple[Track, Rollout]:
    """Return the finger's path, along x at constant speed, and the motion of a box of a friction on the ground."""
    times = np.arange(0, 0.61, 1 / 60)
    path = np.stack((-HALF[0] - RADIUS - 0.001 + SPEED * times, np.full_like(times, sideways_m), 0 * times), -1)
    path[:, 2] = HALF[2]
    true = replace(world(), pair_laws={GROUND: law(friction), FINGER: law(0.3)})
    start = state_of(
        ((0, 0, HALF[2] - 1e-4), UPRIGHT, (0, 0, 0), (0, 0, 0)), (tuple(path[0]), UPRIGHT, (0,) * 3, (0,) * 3)
    )
    finger = Track(times, path, np.tile(UPRIGHT, (len(times), 1)))
    return finger, roll_out(true, start, torch.as_tensor(times), {"finger": finger}, bool(sideways_m))


def push(seed: int, sideways_m: float, noise: Noise = FINE) -> Episode:
    """A push along x at constant speed, of a finger at the middle or beside it, with its force.

    The track comes from the engine, the force at the middle from the closed form mu m g while the box moves.
    """
    rng = np.random.default_rng(seed)
    finger, rollout = pushed(FRICTION, sideways_m)
    times = finger.time_s
    position, quat = rollout.position_m[0, :, 0].numpy(), rollout.quat_wxyz[0, :, 0].numpy()
    force = np.zeros_like(position)
    if sideways_m:
        assert rollout.contacts is not None
        each = rollout.contacts.impulse_n_s[0, 1:, rollout.contacts.body_b == 1].sum(1).numpy() * 60
        force[1:-1] = 0.5 * (each[1:] + each[:-1])
        force[-1] = each[-1]
    else:
        force[:, 0] = np.where(position[:, 0] > 2e-4, FRICTION * MASS * G, 0.0)
    force += FORCE_STD * rng.standard_normal(force.shape)
    seen = Track(times, position + noise.position_m * rng.standard_normal(position.shape), quat)
    return Episode(f"{seed}", {"box": seen, "finger": replace(finger, force_n=force)})


def from_priors() -> ContactEstimate:
    """What the motion leaves of the frictions where it does not tell them."""
    parameters = contact_parameters(world())
    return ContactEstimate(
        parameters=parameters,
        values=np.array([p.encode(p.prior[0]) for p in parameters]),
        covariance=np.diag([p.prior[1] ** 2 for p in parameters]),
    )


@cache
def fitted(forces: bool) -> PhysicsFit:
    noise = FINE if forces else COARSE  # with fine tracks, how far the box springs off the finger tells a little
    episodes = [push(0, 0.0, noise), push(1, 0.0, noise)]
    if not forces:
        episodes = [Episode(n, {"box": t["box"], "finger": replace(t["finger"], force_n=None)}) for n, t in episodes]
    return fit_physics(world(), episodes, FAST, noise)


def parameter(found: PhysicsFit, name: str) -> FittedParameter:
    return next(p for p in found.parameters if p.name == name)


def test_the_force_of_a_slow_push_tells_the_friction_of_the_ground() -> None:
    """From the priors alone, which is what the motion leaves of the frictions."""
    one = push(0, 0.0)
    prior = from_priors()
    assert [p.name for p in prior.parameters][::3] == ["friction[aluminium,wood]", "friction[aluminium,steel]"]
    seen = Observations.of(world(), [one], [(-1.0, 1.0)])
    forces = measured_forces(world(), [one], seen, FORCE_STD)
    assert [force.std_n for force in forces] == [FORCE_STD]
    found, record = with_forces(world(), prior, forces, seen, 1e-12 * torch.eye(12, dtype=torch.float64)[None])
    error = np.sqrt(found.covariance[0, 0])
    assert abs(found.values[0] - np.log(FRICTION)) < min(0.01, 1.96 * error)
    assert error < 0.01 and np.sqrt(found.covariance[3, 3]) > 0.3  # the finger's own friction hardly shows
    assert record["converged"] and record["misfit"] < 1.5


@pytest.mark.evidence
@pytest.mark.parametrize("sideways_m", [(0.0, 0.0), (0.012, -0.02)])
@pytest.mark.parametrize("noise", [FINE, COARSE])
def test_intervals_from_forces_hold_the_truth(noise: Noise, sideways_m: tuple[float, float]) -> None:
    """Of 20 fits of two pushes at least 16: starts have the errors of their first frames."""
    held = 0
    for seed in range(20):
        episodes = [push(2 * seed + k, aside, noise) for k, aside in enumerate(sideways_m)]
        seen = Observations.of(world(), episodes, [(-1.0, 1.0)] * 2)
        seen, solution = estimate_states(world(), seen, warmup_frames(world(), seen, 0.1), noise)
        forces = measured_forces(world(), episodes, seen, FORCE_STD)
        found, _ = with_forces(world(), from_priors(), forces, seen, solution.state_cov)
        held += abs(found.values[0] - np.log(FRICTION)) < 1.96 * np.sqrt(found.covariance[0, 0])
    print(f"noise {noise.position_m:g} m, beside the middle {sideways_m}: {held} of 20")
    assert held >= 16


@pytest.mark.evidence
def test_a_fit_with_forces_finds_the_friction_of_the_ground() -> None:
    found = fitted(True)
    friction = parameter(found, "friction[aluminium,wood]")
    assert friction.state == "fitted" and friction.interval_95 is not None
    assert abs(friction.estimate / FRICTION - 1) < 0.01
    assert friction.interval_95[0] < FRICTION < friction.interval_95[1]
    assert found.pairs[GROUND].friction == friction.estimate
    assert found.record.forces is not None and found.record.forces["converged"]


def test_the_motion_of_a_slow_push_does_not_tell_the_friction_of_the_ground() -> None:
    """How far the box springs off the finger does, by a tenth of a millimetre in the frame after the impact.

    Of two pushes, the information of all frames on the logarithm of the friction, with all else known, is less than a
    tenth of that of its prior where the noise is 1 mm, and several times as much where it is 0.1 mm.
    """
    high, low = (pushed(FRICTION * factor)[1] for factor in (1.05, 1 / 1.05))
    moved = (high.position_m - low.position_m)[0, :, 0] / (2 * np.log(1.05))
    turned = quat_log(quat_multiply(quat_conjugate(low.quat_wxyz), high.quat_wxyz))[0, :, 0] / (2 * np.log(1.05))
    prior = 1 / contact_parameters(world())[0].prior[1] ** 2
    coarse, fine = (
        2 * float((moved / noise.position_m).square().sum() + (turned / noise.rotation_rad).square().sum())
        for noise in (COARSE, FINE)
    )
    assert coarse < 0.1 * prior and fine > 2 * prior


@pytest.mark.evidence
def test_without_forces_the_interval_holds_the_friction_and_is_wide() -> None:
    found = fitted(False)
    interval = parameter(found, "friction[aluminium,wood]").interval_95
    assert interval is not None and interval[0] < FRICTION < interval[1]
    assert interval[1] > 2.5 * interval[0]  # with forces the two differ by a hundredth
    assert found.record.forces is None


def test_multiple_shooting_sees_no_friction_in_a_slow_push() -> None:
    """States that follow the noise leave the finger, which costs more, and claim to see how a box slides by itself."""
    episodes, parameters = [push(0, 0.0, COARSE)], contact_parameters(world())
    prior, whole = ShootingPrior.of(parameters), Observations.of(world(), episodes, [(-1.0, 1.0)])
    costs, shares = [], []
    for known in (whole, None):
        problem = Shooting.of(world(), parameters, episodes, [(-1.0, 1.0)], COARSE, prior, whole=known)
        found = problem.fit([prior.mean], 2, 1)[0]
        costs.append(found.cost)
        shares.append(float((found.covariance[0, 0] / found.scale).sqrt() / prior.std[0]))
    assert shares[0] > 0.95 and shares[1] < 0.85
    assert costs[0] < costs[1]


@pytest.mark.evidence
def test_without_forces_the_friction_is_called_not_observable() -> None:
    assert parameter(fitted(False), "friction[aluminium,wood]").state == "not_observable"


def test_noise_of_forces_is_that_of_their_second_differences() -> None:
    rng = np.random.default_rng(0)
    slow = np.linspace(0, 3, 4000)[:, None] * np.array([1.0, 0.5, -2.0])
    assert abs(force_noise(slow + 0.05 * rng.standard_normal(slow.shape)) / 0.05 - 1) < 0.1
