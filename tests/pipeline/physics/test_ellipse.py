"""Friction that depends on the direction, against mechanics, against MuJoCo, and its derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.pipeline.physics import Body, Rollout, State, simulate
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.physics.friction_ellipse import FLATTEST, Ellipse
from cgwm.pipeline.physics.impulse_solver import in_disc
from helpers.worlds import F64, batch, box_body, law, state_of, times, world_of
from scipy.integrate import solve_ivp

MU, G = 0.3, 9.81
UP = (1.0, 0.0, 0.0, 0.0)


def grain(a: float | torch.Tensor, b: float | torch.Tensor) -> ActiveEffect:
    return ActiveEffect.of(load_effect("anisotropic_friction"), {"a": a, "b": b}, batch(0.0))


def matrix(a: float, b: float, mu: float = MU) -> np.ndarray:
    return np.array([[mu + a, b], [b, mu - a]])


def slid(
    body: Body, effects: tuple[ActiveEffect, ...], velocities: Sequence[tuple[float, float]], duration: float
) -> Rollout:
    """Roll out a slide for each velocity, all in one batch, in the kernel where a compiler is (`test_fused.py`)."""
    lowest = float((body.radii - body.centers[..., 2]).amax())
    at = (0.0, 0.0, lowest - G * 0.004**2)
    state = State.joined(*(state_of((at, UP, (*velocity, 0.0), (0.0, 0.0, 0.0))) for velocity in velocities))
    return roll_out(replace(world_of(body, contact=law(MU)), effects=effects), state, times(duration))


def expected(M: np.ndarray, velocity: tuple[float, float], at: np.ndarray) -> np.ndarray:
    """Return the path (T, 2) of a point with dv/dt = -g M^2 v / |M v|."""

    def rate(_: float, x: np.ndarray) -> np.ndarray:
        v = x[2:]
        return np.concatenate((v, -G * M @ M @ v / np.linalg.norm(M @ v)))

    start = np.array([0.0, 0.0, *velocity])
    return solve_ivp(rate, (0.0, at[-1]), start, t_eval=at, rtol=1e-9, atol=1e-12).y[:2].T


HEADINGS = [(math.cos(angle), math.sin(angle)) for angle in (0.3, 1.2, -1.9)]


def test_the_nearest_vector_is_in_the_ellipse_along_its_normal() -> None:
    torch.manual_seed(0)
    count = 2000
    anisotropy = torch.randn(count, 2, dtype=F64)
    ellipse = Ellipse.of(torch.rand(count, dtype=F64), 0.4 * anisotropy)
    wanted = torch.randn(count, 2, dtype=F64) * torch.logspace(-2, 3, count, dtype=F64)[:, None]
    limit = torch.rand(count, dtype=F64)
    mean, (even, mixed) = ellipse.mean, ellipse.grain.unbind(-1)
    M = torch.stack((torch.stack((mean + even, mixed), -1), torch.stack((mixed, mean - even), -1)), -2)
    frictions = torch.linalg.eigvalsh(M)
    assert bool((frictions[:, 0] > 0.999 * FLATTEST * frictions[:, 1]).all())
    found = ellipse.nearest(wanted, limit)
    size = torch.linalg.solve(M, found).norm(dim=-1) / limit
    inside = torch.linalg.solve(M, wanted).norm(dim=-1) <= limit
    assert bool(inside.any()) and bool((~inside).any())
    torch.testing.assert_close(found[inside], wanted[inside], rtol=1e-9, atol=1e-12)
    assert bool((size <= 1 + 1e-9).all()) and bool((size[~inside] > 1 - 1e-9).all())
    taken, normal = (wanted - found)[~inside], torch.linalg.solve(M @ M, found)[~inside]
    cosine = (taken * normal).sum(-1) / (taken.norm(dim=-1) * normal.norm(dim=-1))
    assert bool((cosine > 1 - 1e-6).all())
    assert torch.allclose(ellipse.along(found)[~inside], (found.norm(dim=-1) / limit)[~inside], rtol=1e-9)
    assert not bool(ellipse.nearest(wanted, torch.zeros_like(limit)).any())


def test_without_a_grain_it_is_the_disc() -> None:
    wanted = torch.randn(500, 2, dtype=F64)
    limit = torch.rand(500, dtype=F64)
    round_one = Ellipse.of(torch.full_like(limit, MU), torch.zeros(1, 2, dtype=F64))
    torch.testing.assert_close(round_one.nearest(wanted, limit), in_disc(wanted, MU * limit), rtol=1e-12, atol=1e-15)
    body = box_body(half=(0.05, 0.04, 0.03))
    start = state_of(((0, 0, 0.06), (1, 0.2, 0.1, 0.3), (0.8, 0.3, 0.0), (2.0, 3.0, 1.0)))
    with_it, without = (
        roll_out(replace(world_of(body), effects=effects), start, times(0.3)) for effects in ((grain(0, 0),), ())
    )
    torch.testing.assert_close(with_it.position_m, without.position_m, rtol=0, atol=1e-9)


def test_an_oblique_slide_is_curved() -> None:
    """A flat box follows dv/dt = -g M^2 v / |M v|, which at first pushes it across by g |2 (A t) across t|."""
    slides = [(heading, values) for heading in HEADINGS for values in ((0.1, 0.0), (-0.1, 0.08))]
    a, b = torch.tensor([values for _, values in slides], dtype=F64).T
    at = times(0.15).numpy()
    rollout = slid(box_body(half=(0.05, 0.05, 0.002)), (grain(a, b),), [heading for heading, _ in slides], 0.15)
    for path, (heading, values) in zip(rollout.position_m[:, :, 0, :2].numpy(), slides, strict=True):
        assert np.abs(path - expected(matrix(*values), heading, at)).max() < 5e-5, (heading, values)
        straight = expected(MU * np.eye(2), heading, at)
        assert np.abs(path - straight).max() > 5e-3, (heading, values)


def test_a_slide_ends_at_rest_without_a_gain_of_energy() -> None:
    rollout = slid(box_body(half=(0.05, 0.05, 0.002)), (grain(0.12, 0.1),), [(0.3, 0.25)], 0.4)
    speed = rollout.velocity_m_s[0, :, 0].norm(dim=-1)
    assert bool((speed[1:] < speed[:-1] + 1e-5).all())
    assert float(speed[-1]) < 1e-6


def test_a_tumbling_box_gains_no_energy() -> None:
    body = box_body()
    start = state_of(((0, 0, 0.08), (1, 0.3, 0.2, 0.5), (1.5, -0.8, 0.0), (6.0, -4.0, 9.0)))
    world = replace(world_of(body, contact=law(MU)), effects=(grain(0.2, -0.1),))
    rollout = roll_out(world, start, times(0.6))
    omega, velocity = rollout.omega_body_rad_s[0, :, 0], rollout.velocity_m_s[0, :, 0]
    mass = float(body.mass)
    energy = 0.5 * mass * velocity.square().sum(-1) + mass * G * rollout.position_m[0, :, 0, 2]
    energy = energy + 0.5 * (omega.square() * body.inertia[0].diagonal()).sum(-1)
    # what a contact stores while it is pressed in comes back: as much as without the effect
    assert bool((energy[1:] - torch.cummin(energy, 0).values[:-1] < 0.03 * energy[0]).all())
    assert float(energy[-1]) < 0.5 * float(energy[0])


def test_a_slope_holds_along_the_rough_way_alone() -> None:
    """tan(15 deg) = 0.268 lies between mu - a = 0.2 and mu + a = 0.4."""
    angle = math.radians(15)
    body = box_body(half=(0.05, 0.05, 0.002))
    gravity = [[G * math.sin(angle), 0.0, -G * math.cos(angle)], [0.0, G * math.sin(angle), -G * math.cos(angle)]]
    world = world_of(body, contact=law(MU))
    world = replace(world, gravity=torch.tensor(gravity, dtype=F64), effects=(grain(0.1, 0.0),))
    start = state_of(((0, 0, 0.002 - G * 0.004**2), UP, (0, 0, 0), (0, 0, 0)), count=2)
    rollout = roll_out(world, start, times(0.2), None, True)
    assert rollout.contacts is not None
    slope = G * (math.sin(angle) - 0.2 * math.cos(angle))
    for axis, moved in ((0, False), (1, True)):
        end = float(rollout.position_m[axis, -1, 0, axis])
        assert end == pytest.approx(0.5 * slope * 0.04 if moved else 0.0, rel=0.02, abs=1e-6)
        pressed = rollout.contacts.impulse_n_s[axis, -1, :, 2] > 1e-6
        assert bool(rollout.contacts.sliding[axis, -1][pressed].all()) == moved


# In the suite: the derivatives of this effect agree with differences in test_effects.py.
@pytest.mark.evidence
def test_derivatives_agree_with_differences() -> None:
    start = state_of(((0, 0, 0.0295), UP, (0.7, 0.4, 0.0), (0.0, 0.0, 2.0)))

    def end(values: torch.Tensor) -> torch.Tensor:
        """Return the ends (B, 3) for numbers (B, 3)."""
        world = replace(world_of(box_body()), effects=(grain(values[:, 0], values[:, 1]),))
        world = replace(world, contact=replace(world.contact, friction=values[:, 2]))
        return simulate(world, start, times(0.02)).position_m[:, -1, 0]

    values = torch.tensor([(0.1, -0.05, MU), (0.0, 0.0, MU), (0.3, 0.2, MU)], dtype=F64)
    found = torch.autograd.functional.jacobian(lambda x: end(x).sum(0), values).transpose(0, 1)
    sides = end(torch.cat([values + sign * 1e-6 * axis for sign in (1, -1) for axis in torch.eye(3, dtype=F64)]))
    ahead, behind = sides.unflatten(0, (2, 3, 3))
    torch.testing.assert_close(found, (ahead - behind).permute(1, 2, 0) / 2e-6, rtol=1e-4, atol=1e-7)
    assert float(found[[0, 2], :2].abs().amax(1).min()) > 1e-4


def test_mujocos_elliptic_cone_says_the_same() -> None:
    """But for the time ahead, 2 / rate, at which MuJoCo looks at the slip, which is why it is fast here."""
    mujoco = pytest.importorskip("mujoco")
    M, at = matrix(-0.15, 0.0), times(0.15)
    velocities = [(1.2 * x, 1.2 * y) for x, y in HEADINGS]
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    # its first tangent on a level plane is the world's y
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="2e-4" integrator="RK4" cone="elliptic"/><worldbody>
        <geom name="g" type="plane" size="9 9 1" contype="0" conaffinity="0"/><body>{joints}
        <geom name="p" type="sphere" size="0.05" mass="0.4" contype="0" conaffinity="0"/></body></worldbody><contact>
        <pair geom1="p" geom2="g" condim="3" friction="{M[1, 1]} {M[0, 0]} 0.005 0.0001 0.0001" solref="0.004 1"
        solreffriction="0.001 1" solimp="0.95 0.99 0.001"/></contact></mujoco>"""
    )
    theirs = np.empty((len(velocities), len(at), 2))
    for velocity, path in zip(velocities, theirs, strict=True):
        data = mujoco.MjData(model)
        data.qpos[2] = 0.05
        mujoco.mj_step(model, data, 1000)
        data.qpos[:2], data.qvel[:2] = 0.0, velocity
        path[0] = data.qpos[:2]
        for frame in range(1, len(at)):
            mujoco.mj_step(model, data, 50)
            path[frame] = data.qpos[:2]
    # without a grain as well
    a = torch.tensor([-0.15] * len(HEADINGS) + [0.0] * len(HEADINGS), dtype=F64)
    body = box_body(half=(0.05, 0.05, 0.002))
    ours = slid(body, (grain(a, 0 * a),), 2 * velocities, 0.15).position_m[:, :, 0, :2].numpy()
    apart, without = np.abs(ours.reshape(2, *theirs.shape) - theirs).max((2, 3))
    assert (apart < 0.003).all() and (apart < 0.25 * without).all(), (apart, without)
