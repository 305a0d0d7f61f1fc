"""The fused kernel against the torch engine on fixed surfaces: rollouts, labels and derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.pipeline.optimization.forward_mode import batched_jacobian
from cgwm.pipeline.physics import Body, ContactLaw, Rollout, State, World, simulate
from cgwm.pipeline.physics.devices import on_device
from cgwm.pipeline.physics.effects.effect import ActiveEffect
from cgwm.pipeline.physics.effects.registry import load_effect
from cgwm.pipeline.physics.fused import simulate_fused
from cgwm.pipeline.physics.fused.rollout import roll
from cgwm.pipeline.runtime import kernel_build
from helpers import fixed_surfaces as fixed
from helpers import fused_host, worlds
from helpers.worlds import F64, ball_body, batch, box_body, state_of, times
from torch import Tensor

CUDA = torch.cuda.is_available() and kernel_build.available()
POSES = ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")
Fused = Callable[..., Rollout]


def on_cuda(world: World, state: State, times_s: Tensor, record: bool = False, lanes: int | None = None) -> Rollout:
    there = (on_device(x, "cuda", world.gravity.dtype) for x in (world, state, times_s))
    return simulate_fused(*there, {}, record, lanes)


def on_host(world: World, state: State, times_s: Tensor, record: bool = False, lanes: int | None = None) -> Rollout:
    return roll(fused_host.run, world, state, times_s, {}, record, lanes)


NEEDS_COMPILER = pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")
NEEDS_GPU = pytest.mark.skipif(not CUDA, reason="needs a CUDA device and cuda.core")


@pytest.fixture(params=[pytest.param(on_host, marks=NEEDS_COMPILER), pytest.param(on_cuda, marks=NEEDS_GPU)])
def fused(request: pytest.FixtureRequest) -> Fused:
    return request.param


def dented(count: int = 7, cell: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Return a height field of rounded dents."""
    x, y = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    height = 0.02 * np.sin(1.3 * x) * np.cos(1.1 * y)
    vertices = np.stack((cell * (x - count / 2), cell * (y - count / 2), height), -1).reshape(-1, 3)
    at = np.arange(count * count).reshape(count, count)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    return vertices, np.concatenate((np.stack((a, b, c), 1), np.stack((a, c, d), 1)))


def lumps() -> Body:
    """Return a body of eight spheres of several sizes about a shifted centre of mass."""
    body = box_body((0.03, 0.025, 0.02), radius=0.008)
    radii = body.radii + torch.linspace(0, 0.004, 8, dtype=F64)
    return replace(body, radii=radii, com=batch([0.002, -0.001, 0.003]))


def scene(surfaces: tuple[Any, ...], *bodies: Body, ground: bool = False) -> World:
    return replace(worlds.world_of(*(bodies or (lumps(),)), ground=ground, step_s=0.002), surfaces=surfaces)


SHAPES = (
    fixed.half_space(position=(0, 0, -0.01), quat=fixed.turn((1, 2, 0), 8)),
    fixed.box((0.04, 0.03, 0.05), position=(0.02, 0.01, -0.04), quat=fixed.turn((1, 1, 3), 50)),
    fixed.cylinder(0.03, 0.1, position=(-0.05, 0.02, -0.02), quat=fixed.turn((1, 0.2, 0), 80)),
    fixed.box((0.05, 0.05, 0), "sheet", position=(0, -0.07, -0.02), quat=fixed.turn((1, 0, 0), 20)),
)
MESHES = (
    fixed.mesh_surface(*dented(), solid=True, position=(0, 0, -0.03), quat=fixed.turn((0, 1, 0), 5)),
    fixed.mesh_surface(*fixed.box_mesh((0.03, 0.02, 0.04), 2), solid=True, name="solid", position=(0.07, 0, 0)),
    fixed.mesh_surface(*fixed.groove(0.3, 5, 0.04), name="groove", position=(0, 0.09, -0.02)),
)


def tossed(count: int, height: float = 0.07) -> State:
    generator = torch.Generator().manual_seed(7)
    state = state_of(((0, 0.01, height), (1, 0.3, 0.2, 0.1), (0.2, -0.1, -0.5), (3, 5, -2)), count=count)

    def noise(scale: float) -> Tensor:
        return scale * torch.randn(count, 1, 3, generator=generator, dtype=F64)

    return replace(
        state,
        position_m=state.position_m + noise(0.02) * torch.tensor([1.0, 1.0, 0.1], dtype=F64),
        velocity_m_s=state.velocity_m_s + noise(0.3),
    )


def moves_alike(expected: Rollout, found: Rollout, tolerance: float = 1e-9) -> None:
    for name in POSES:
        mine, its = getattr(found, name).cpu(), getattr(expected, name)
        torch.testing.assert_close(mine, its, rtol=tolerance, atol=tolerance, msg=lambda text, n=name: f"{n}: {text}")


def agree(expected: Rollout, found: Rollout, tolerance: float = 1e-9) -> None:
    moves_alike(expected, found, tolerance)
    mine, its = found.contacts, expected.contacts
    assert mine is not None and its is not None
    assert torch.equal(mine.body_b, its.body_b) and torch.equal(mine.sliding.cpu(), its.sliding)
    for name in ("impulse_n_s", "position_m", "normal", "distance_m"):
        values = getattr(mine, name).cpu()
        torch.testing.assert_close(
            values, getattr(its, name), rtol=tolerance, atol=tolerance, msg=lambda text, n=name: f"{n}: {text}"
        )


def touched(record: Any) -> set[int]:
    acted = (record.impulse_n_s.norm(dim=-1) > 0).flatten(0, 1).any(0)
    return {int(b) for b, yes in zip(record.body_b, acted, strict=True) if yes}


@pytest.mark.parametrize(
    ("surfaces", "lanes"),
    [
        pytest.param(SHAPES, 8, id="shapes-8", marks=pytest.mark.evidence),
        pytest.param(MESHES, 1, id="meshes-1"),
        pytest.param(SHAPES, 1, id="shapes-1", marks=pytest.mark.evidence),
        pytest.param(MESHES, 8, id="meshes-8", marks=pytest.mark.evidence),
    ],
)
def test_a_body_on_surfaces(fused: Fused, surfaces: tuple[Any, ...], lanes: int) -> None:
    world, state, time = scene(surfaces), tossed(6), times(0.15, 20)
    with torch.no_grad():
        expected = simulate(world, state, time, record_contacts=True)
        assert touched(expected.contacts) == {-2 - k for k in range(len(surfaces))}
        agree(expected, fused(world, state, time, True, lanes))


EFFECTS = {
    "stribeck_friction": {"d": 0.3, "v_s": 0.2},
    "viscous_friction": {"c_v": 0.8},
    "rolling_resistance": {"c_r": 3e-3},
    "torsional_friction": {"c_t": 4e-3},
    "velocity_restitution": {"r": 0.4},
}


def with_effects(world: World, names: tuple[str, ...]) -> World:
    made = (ActiveEffect.of(load_effect(name), {k: batch(v) for k, v in EFFECTS[name].items()}) for name in names)
    return replace(world, effects=tuple(made))


@pytest.mark.parametrize(
    ("surfaces", "names", "lanes"),
    [
        pytest.param(SHAPES, tuple(EFFECTS), 8, id="shapes-8", marks=pytest.mark.evidence),
        pytest.param(MESHES, tuple(EFFECTS), 1, id="meshes-1", marks=pytest.mark.evidence),
        *(pytest.param(SHAPES, (one,), 1, id=one, marks=pytest.mark.evidence) for one in EFFECTS),
    ],
)
def test_effects_of_contact_with_surfaces(fused: Fused, surfaces: Any, names: tuple[str, ...], lanes: int) -> None:
    """Several pairs touch at once, beside a tilted ground: each has its own resistance to turning."""
    plain, state, time = scene(surfaces, ground=True), tossed(6), times(0.15, 20)
    plain = replace(plain, ground_offset=batch(-0.03))
    with torch.no_grad():
        world = with_effects(plain, names)
        expected = simulate(world, state, time)
        moves_alike(expected, fused(world, state, time, False, lanes))
        assert (simulate(plain, state, time).position_m - expected.position_m).abs().max() > 1e-5


def test_a_ball_rolls_down_a_groove_with_resistance(fused: Fused) -> None:
    """Two surfaces carry it: each brakes by the part of the spin across its normal, and the other by that about it."""
    surfaces = tuple(
        fixed.half_space(name, quat=fixed.turn((side, 0.04, 0), 45)) for name, side in (("a", 1), ("b", -1))
    )
    world = with_effects(scene(surfaces, ball_body(0.02)), tuple(EFFECTS))
    state = state_of(((0.0, 0.0, 0.0285), (1.0, 0, 0, 0), (0.3, 0.1, 0.0), (0.0, 20.0, 5.0)), count=2)
    with torch.no_grad():
        expected = simulate(world, state, times(0.2, 20), record_contacts=True)
        assert touched(expected.contacts) == {-2, -3}
        agree(expected, fused(world, state, times(0.2, 20), True))


def test_two_bodies_a_tilted_ground_and_surfaces(fused: Fused) -> None:
    """The kernel computes in a frame of its own, in which the ground is level; each material has its law."""
    surfaces = (SHAPES[1], replace(MESHES[2], material="ice"), replace(SHAPES[0], material="rubber"))
    bodies = (replace(lumps(), material="wood"), replace(ball_body(0.02), material="wood"))
    world = scene(surfaces, *bodies, ground=True)
    laws = {("ice", "wood"): worlds.law(0.05, 0.006), ("rubber", "wood"): worlds.law(0.9, 0.01, 0.8)}
    world = replace(world, pair_laws=laws)
    normal = torch.tensor([0.1, -0.2, 1.0], dtype=F64)
    world = replace(world, ground_normal=normal / normal.norm(), ground_offset=batch(-0.02))
    one = tossed(4)
    rest = (one.position_m + torch.tensor([0.01, 0.06, 0.0], dtype=F64), one.quat_wxyz, 0.5 * one.velocity_m_s)
    state = State(*(torch.cat(x, 1) for x in zip(one.tensors, (*rest, one.omega_body_rad_s), strict=True)))
    with torch.no_grad():
        expected = simulate(world, state, times(0.1, 20), record_contacts=True)
        assert touched(expected.contacts) == {1, -1, -2, -3, -4}
        agree(expected, fused(world, state, times(0.1, 20), True))


@pytest.mark.parametrize(
    "surfaces",
    [pytest.param(SHAPES[:2], id="shapes", marks=pytest.mark.evidence), pytest.param(MESHES[:1], id="meshes")],
)
def test_derivatives_by_state_law_and_place_of_a_surface(fused: Fused, surfaces: tuple[Any, ...]) -> None:
    world, time = scene(surfaces), torch.tensor([0.0, 0.05], dtype=F64)
    start = tossed(1, 0.035)

    def function(run: Any) -> Callable[[Tensor, int], Tensor]:
        def rolled(values: Tensor, repeats: int) -> Tensor:
            law = ContactLaw(values[:, 0], values[:, 1], values[:, 2])
            moved = replace(surfaces[-1], position=surfaces[-1].position + values[:, 3:6])
            state = replace(
                start,
                position_m=start.position_m + values[:, None, 6:9],
                velocity_m_s=start.velocity_m_s + values[:, None, 9:12],
                omega_body_rad_s=start.omega_body_rad_s + values[:, None, 12:15],
                quat_wxyz=start.quat_wxyz.expand(len(values), 1, 4),
            )
            rollout = run(replace(world, contact=law, surfaces=(*surfaces[:-1], moved)), state, time)
            return torch.cat([getattr(rollout, name)[:, -1].flatten(1) for name in POSES], 1)

        return rolled

    inputs = torch.tensor([[0.3, 0.006, 0.4, *[0.0] * 12]], dtype=F64)
    value, jacobian = batched_jacobian(function(simulate), inputs)
    found, its = batched_jacobian(function(fused), inputs)
    torch.testing.assert_close(found.cpu(), value, rtol=1e-9, atol=1e-9)
    scale = jacobian.abs().amax((0, 1)).clamp_min(1e-3)
    torch.testing.assert_close(its.cpu() / scale, jacobian / scale, rtol=1e-6, atol=1e-6)
    assert (jacobian.abs().amax((0, 1)) > 1e-4).all()
    step = 1e-7 * torch.eye(15, dtype=F64)
    with torch.no_grad():
        up, down = (function(fused)(inputs + side * step, 15).cpu() for side in (1, -1))
    differences = ((up - down) / 2e-7).T[None]
    torch.testing.assert_close(differences / scale, jacobian / scale, rtol=1e-4, atol=1e-4)
