"""Friction from the measured force of a slow push: the track alone does not tell it."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets import Track
from cgwm.datasets.capture.tracks import Episode
from cgwm.pipeline.geometry.rotation import quat_conjugate, quat_log, quat_multiply
from cgwm.pipeline.optimization.problem import Point
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.phys_geo.tracks.contact_result import ContactEstimate, FitRecord, PhysicsFit, physics_fit
from cgwm.pipeline.phys_geo.tracks.force_fit import _bent, _excess, _mixed, _told, with_forces
from cgwm.pipeline.phys_geo.tracks.force_residuals import ForceResiduals
from cgwm.pipeline.phys_geo.tracks.loss_start import loss_start
from cgwm.pipeline.phys_geo.tracks.measured_forces import MeasuredForce, force_noise, measured_forces
from cgwm.pipeline.phys_geo.tracks.multiple_shooting import Shooting, ShootingPrior
from cgwm.pipeline.physics import Rollout, World
from cgwm.pipeline.physics.chains.parameters import chain_parameters
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.parameters import Parameter, contact_parameters
from cgwm.pipeline.trajectories.initial_state import estimate_states, warmup_frames
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import FittedParameter, PhysConfig
from helpers.chains import drawer
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


def test_long_intervals_average_short_ones() -> None:
    times = np.arange(0, 1.001, 0.01)
    force = np.where(times[:, None] > 0.5, 2.0, 0.0) * np.array([1.0, 0.0, 0.0])
    track = Track(times, np.zeros((len(times), 3)), np.tile(UPRIGHT, (len(times), 1)), force_n=force)
    short = MeasuredForce.of(Episode("one", {}), 0, 0, track, 0.0, 0.1)
    long = short.slow()
    assert len(short.force_n) == 99 and len(long.force_n) == 9  # of ten short ones each, the last nine left out
    np.testing.assert_allclose(long.edges_s, 0.005 + 0.1 * np.arange(10), atol=1e-12)
    np.testing.assert_allclose(long.force_n[:, 0], [0, 0, 0, 0, 0, *[2.0] * 4], atol=1e-12)
    assert abs(long.std_n - 0.1 / np.sqrt(10)) < 1e-12
    np.testing.assert_allclose(long.spread_n[[0, 3, 6, 8]], long.std_n)
    np.testing.assert_allclose(long.spread_n[[4, 5]], np.hypot(2.0, long.std_n))  # when it sets in
    assert long.slow() is long


def loss(name: str) -> Parameter:
    return Parameter(name=name, unit="1", bounds=(1e-4, 100.0), logarithmic=True, reveals="motion", prior=(0.15, 1.5))


class SumOfLosses:
    """Residuals of forces that are a sum of friction and damping at given speeds, with one hit of another law."""

    start_size = 0
    forces = (None,)

    def __init__(self, damping: float, friction: float) -> None:
        self.speeds = torch.linspace(0.25, 0.05, 9, dtype=torch.float64)
        self.measured = friction + damping * self.speeds
        self.measured[1] += 40.0

    def of(self, episode: int, values: torch.Tensor, starts: torch.Tensor) -> torch.Tensor:
        del episode, starts
        damping, friction = values.exp().unbind(1)
        force = friction[:, None] + damping[:, None] * self.speeds
        return torch.nn.functional.pad(((force - self.measured) / 0.05)[..., None], (0, 2))


@pytest.mark.parametrize(("damping", "friction"), [(8.0, 2.0), (0.02, 3.0), (12.0, 1e-4)])
def test_losses_begin_at_what_the_forces_ask_for(damping: float, friction: float) -> None:
    names = [loss("rail.damping"), loss("rail.friction")]
    known = ContactEstimate(parameters=names, values=np.log([0.15, 0.15]), covariance=np.diag([1.5**2, 1.5**2]))
    residuals: Any = SumOfLosses(damping, friction)
    found = loss_start(residuals, known, 4.0)
    assert found is not None
    np.testing.assert_allclose(np.exp(found), [damping, friction], rtol=0.01, atol=0.01)
    assert loss_start(residuals, replace(known, covariance=np.diag([0.25, 0.25])), 4.0) is None


def test_minima_that_are_both_probable_widen_the_interval() -> None:
    def mode(value: float, std: float, share: float) -> tuple[Point, np.ndarray, float]:
        return Point(values=batch([value])), np.array([[std**2]]), share

    assert _mixed([mode(1.0, 0.1, 1.0)]) == 0.1**2
    np.testing.assert_allclose(_mixed([mode(1.0, 0.1, 1.0), mode(3.0, 0.1, 1.0)]), 0.1**2 + 2.0)


def test_estimates_by_long_and_by_short_intervals_may_differ_by_chance_alone() -> None:
    slow: Any = SimpleNamespace(values=np.array([0.0, 0.0, 0.0]), covariance=np.diag([1.0, 1.0, 1.0]))
    fast: Any = SimpleNamespace(values=np.array([1.0, 3.0, 0.5]), covariance=np.diag([0.25, 0.25, 1.0]))
    np.testing.assert_allclose(_excess(slow, fast), [0.0, 9 - 3.84 * 0.75, 0.0])


def test_what_the_model_leaves_unexplained_is_relative_to_the_forces() -> None:
    force = np.array([[0.0, 0, 0], [2.0, 0, 0], [0, 4.0, 0], [0, 0, 2.0]])
    measured = SimpleNamespace(force_n=force, std_n=0.01, spread_n=np.array([0.01, 0.1, 0.1, 0.1]))
    residuals: Any = SimpleNamespace(forces=[[measured]])
    off = torch.tensor([[9.0, 0, 0], [5.0, 0, 0], [0, 10.0, 0], [0, 0, 20.0]], dtype=torch.float64)
    assert (
        abs(ForceResiduals.unexplained(residuals, [off]) - 0.5) < 1e-12
    )  # 1 N of 2 N; what does not touch is left out


def told(**changes: Any) -> dict[str, Any]:
    usual = {"used": True, "unexplained": 0.01, "apart": [], "misfit": 1.0, "described": True, "information_over": 1.0}
    return usual | {"converged": True} | changes


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (told(), None),
        (told(used=False, unexplained=1.02), "the measured forces are not used: the model's differ from them by 102 %"),
        (
            told(through_law=True),
            "the measured forces are not all that drives these jointed bodies, or their root is free",
        ),
        (told(apart=["contact_time_s"]), "on short and on long intervals ask for different values of contact_time_s"),
        (told(misfit=9.0, described=False, information_over=90.0), "by 3 times their noise on short intervals"),
        (told(information_over=9.0), "intervals are 3 times as wide as the noise alone would make them"),
    ],
)
def test_forces_that_contradict_the_model_are_said(record: dict[str, Any], sentence: str | None) -> None:
    fitted = physics_fit(world(), from_priors(), FINE, FitRecord(
        episodes=9, search_episodes=9, noise_estimated=FINE, forces=record))  # fmt: skip
    said = [text for text in fitted.warnings if "forces" in text]
    assert [sentence in text for text in said] == [True] if sentence else not said


@pytest.mark.evidence
def test_forces_on_the_sensor_instead_of_by_the_finger_are_not_used() -> None:
    one = push(0, 0.0)
    finger = one.tracks["finger"]
    assert finger.force_n is not None
    turned = Episode("0", {"box": one.tracks["box"], "finger": replace(finger, force_n=-finger.force_n)})
    prior, seen = from_priors(), Observations.of(world(), [turned], [(-1.0, 1.0)])
    forces = measured_forces(world(), [turned], seen, FORCE_STD)
    found, record = with_forces(world(), prior, forces, seen, 1e-12 * torch.eye(12, dtype=torch.float64)[None])
    assert not record["used"] and record["unexplained"] > 0.9 and found is prior


def test_starts_of_a_drawer_vary_along_its_rail_alone() -> None:
    """Six numbers of its pose and six of its speed are measured, of which the rail admits one each."""
    cabinet, start, _ = drawer(0.0)
    index = cabinet.body_names.index("box")
    seen: Any = SimpleNamespace(select=lambda rows: SimpleNamespace(state=start), free=[index])
    generator = torch.Generator().manual_seed(0)
    mixed = torch.randn(12, 12, generator=generator, dtype=torch.float64)
    covariance = 1e-6 * mixed @ mixed.T
    force: Any = SimpleNamespace(row=0)
    root = ForceResiduals(cabinet, [], [force], seen, covariance[None]).roots[0]
    assert root.shape == (12, 2)
    along = [0, 6]  # place and speed along x
    np.testing.assert_allclose((root @ root.T)[along][:, along], covariance[along][:, along], rtol=1e-4)


def pushed_drawer(speed_m_s: float, name: str) -> Episode:
    """A drawer of the engine, which a finger hits at a speed after 0.1 s, with the finger's force."""
    rng, (cabinet, start, _) = np.random.default_rng(0), drawer(0.0)
    times = np.arange(0, 0.501, 0.01)
    path = np.stack((0.09 + speed_m_s * (0.1 - times), 0 * times, 0 * times), -1)
    start.position_m[:, :, 2] = 0.0  # where the cabinet stands in a fit
    upright = np.tile(UPRIGHT, (len(times), 1))
    finger = Track(times, path, upright)
    free = replace(cabinet, ground_normal=None, ground_offset=None, step_s=0.002)
    motion = roll_out(free, start, torch.as_tensor(times), {"finger": finger}, True)
    assert motion.contacts is not None
    each = motion.contacts.impulse_n_s[0, 1:, motion.contacts.body_b == 2].sum(1).numpy() * 100
    force = np.concatenate((0.5 * (each[1:] + each[:-1]), each[-1:]))  # of the intervals about the frames
    force = np.concatenate((each[:1], force)) + 0.05 * rng.standard_normal((len(times), 3))
    box = motion.position_m[0, :, 1].numpy() + 2e-4 * rng.standard_normal((len(times), 3))
    case = Track(times, motion.position_m[0, :, 0].numpy(), upright)
    return Episode(name, {"case": case, "box": Track(times, box, upright), "finger": replace(finger, force_n=force)})


@pytest.mark.evidence  # in the suite: `test_losses_begin_at_what_the_forces_ask_for`
def test_forces_tell_losses_in_a_joint_that_the_motion_leaves_open_over_decades() -> None:
    """A damping of 8 N s/m and a friction of 2 N, from 0.15 and 0.15; each push begins with a hit."""
    cabinet = replace(drawer(0.0)[0], ground_normal=None, ground_offset=None, step_s=0.002)
    episodes = [pushed_drawer(0.2, "fast"), pushed_drawer(0.05, "slow")]
    names = [*contact_parameters(cabinet), *chain_parameters(cabinet)]
    known = ContactEstimate(
        parameters=names,
        values=np.array([np.log(0.15) if p.name.startswith("rail") else p.encode(p.prior[0]) for p in names]),
        covariance=np.diag([p.prior[1] ** 2 for p in names]),
    )
    seen = Observations.of(cabinet, episodes, [(-1.0, 1.0)] * 2)
    forces = measured_forces(cabinet, episodes, seen, 0.05)
    start_cov = 1e-8 * torch.eye(12, dtype=torch.float64).repeat(2, 1, 1)
    found, record = with_forces(cabinet, known, forces, seen, start_cov)
    of = {p.name: (z, s) for p, z, s in zip(names, found.values, np.sqrt(np.diag(found.covariance)), strict=True)}
    for name, true in (("rail.damping", 8.0), ("rail.friction", 2.0)):
        value, error = of[name]
        assert abs(value - np.log(true)) < 2.5 * error and error < 0.05
    assert record["used"] and record["converged"]


class OneSpeed:
    """Residuals of forces at one speed, which show a sum of friction and damping alone; the start changes nothing."""

    start_size = 1
    forces = (None,)
    unexplained = staticmethod(lambda residuals: 0.0)
    repeats = staticmethod(lambda residuals, most: 1.0)

    def of(self, episode: int, values: torch.Tensor, starts: torch.Tensor) -> torch.Tensor:
        del episode, starts
        damping, friction = values.exp().unbind(1)
        off = ((friction + 0.04 * damping - 2.32) / 0.05)[:, None, None]
        return torch.nn.functional.pad(off.expand(-1, 80, 1), (0, 2))

    def derivatives(self, episode: int, values: torch.Tensor, start: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        steps = 1e-5 * torch.eye(2, dtype=torch.float64)
        every = self.of(episode, torch.cat((values[None], values + steps)), start)
        return every[0], torch.nn.functional.pad(((every[1:] - every[0]) / 1e-5).movedim(0, -1), (0, 1))


def test_a_friction_is_as_open_as_the_damping_that_may_take_its_place() -> None:
    """8 N s/m and 2 N have the same force as almost no damping and 2.32 N, of which the prior takes the latter."""
    known = ContactEstimate(
        parameters=[loss("rail.damping"), loss("rail.friction")],
        values=np.log([0.15, 0.15]),
        covariance=np.diag([1.5**2, 1.5**2]),
    )
    residuals: Any = OneSpeed()
    start = Point(values=torch.log(batch([0.15, 2.0])), states=(torch.zeros(2, 1, dtype=torch.float64),))
    found = _told(residuals, known, [start])
    plain = np.sqrt(found.covariance[1, 1])
    wider = np.sqrt(found.covariance[1, 1] + _bent(found)[1])
    assert np.sqrt(found.covariance[0, 0]) > 1.3 and _bent(found)[0] == 0.0
    off = abs(found.values[1] - np.log(2.32))
    assert off < 0.01 and plain < 0.01
    held = 2.32 - 0.04 * np.exp(found.values[0] + 1.96 * np.sqrt(found.covariance[0, 0]))  # at the end of its interval
    np.testing.assert_allclose(wider, (found.values[1] - np.log(held)) / 1.96, rtol=0.05)
