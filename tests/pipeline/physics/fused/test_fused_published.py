"""The paper's contact law in the fused kernel: its formulas, and the torch engine's numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache, partial

import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.optimization.forward_mode import batched_jacobian
from cgwm.pipeline.physics import PaperLaw, Rollout, State, World, engine, simulate
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.fused import host
from cgwm.pipeline.physics.fused.host import simulate_on_host
from cgwm.pipeline.physics.fused.packing import reason_against
from cgwm.pipeline.physics.parameters import apply_parameters, contact_parameters
from cgwm.schemas import UsageError
from helpers import fused_host
from helpers.fixed_surfaces import half_space
from helpers.worlds import F64, ball_body, batch, box_body, state_of, times, world_of
from torch import Tensor

from .test_fused import NEEDS_COMPILER, NEEDS_GPU, UPRIGHT, Fused, agree, cube, fused, on_cuda, on_host, tossed

__all__ = ("fused",)
MASS, MU, TIME, RATIO = 0.4, 0.4, 0.01, 0.6


def law(mass: float = MASS) -> PaperLaw:
    return PaperLaw.of_body(batch(MU), batch(TIME), batch(RATIO), mass, 9.81 * mass)


@cache
def tumbling() -> tuple[World, State]:
    """Return cubes of 27 spheres that tumble onto the ground; all spheres count."""
    body = replace(cube(3, mass=MASS), on_plane=None, com=batch([0.004, -0.003, 0.006]))
    return world_of(body, contact=law(), step_s=0.002), tossed(3, 0.06)


@cache
def pushed() -> tuple[World, State, dict[str, Track]]:
    """Return a cube on a slope that a driven ball pushes into another one, whose spheres lie within each other."""
    low, top = (replace(cube(2, half, name=name), on_plane=None) for half, name in ((0.04, "cube"), (0.02, "other")))
    finger = replace(ball_body(0.02, name="finger"), motion="driven")
    slope = torch.tensor([0.1, -0.2, 1.0], dtype=F64)
    world = world_of(low, top, finger, contact=law(), step_s=0.002)
    world = replace(world, ground_normal=slope / slope.norm())
    at = state_of(
        ((0, 0, 0.05), UPRIGHT, (0, 0, 0), (0, 0, 0)),
        ((0.065, 0.01, 0.03), (1, 0.1, 0, 0.3), (-0.2, 0, 0), (0, 0, 2)),
        ((-0.07, 0.005, 0.05), UPRIGHT, (0, 0, 0), (0, 0, 0)),
        count=2,
    )
    at.position_m[1, 0, 0] += 0.3  # nothing touches there, while lanes beside have contacts
    way = torch.tensor([[-0.07, 0.005, 0.05], [0.02, 0.01, 0.05]], dtype=F64)
    command = Track(time_s=[0.0, 0.1], position_m=way.numpy(), quat_wxyz=torch.tensor([UPRIGHT] * 2).numpy())  # pyright: ignore[reportArgumentType]
    return world, at, {"finger": command}


def after_one_step(gap: float, velocity: tuple[float, float, float], step_s: float = 0.002) -> tuple[World, State]:
    """Return a ball without gravity, with a gap to the ground, for one step."""
    world = world_of(ball_body(0.03, mass=MASS), contact=law(), gravity=0.0, step_s=step_s)
    return world, state_of(((0, 0, 0.03 + gap), UPRIGHT, velocity, (0, 0, 0)))


@pytest.mark.parametrize(
    ("gap", "velocity"),
    [(-0.001, (0.0, 0.0, 0.1)), (-0.0005, (0.3, 0.1, -0.2)), (0.0002, (0.5, -0.2, -0.2)), (0.0002, (0.5, -0.2, -0.05))],
)
def test_one_step_is_that_of_the_formula(fused: Fused, gap: float, velocity: tuple[float, float, float]) -> None:
    """Against the published rows, written out for one sphere, whose impulse passes its centre of mass by its radius."""
    world, state = after_one_step(gap, velocity)
    found = fused(world, state, times(0.002, 500.0), None, False, lanes=1)
    h, stiffness, damping = 0.002, MASS / (16 * TIME**2), 2 * RATIO * MASS / (16 * TIME)
    delta, sharp = 0.005, 100 * 16 / (9.81 * MASS)
    far = gap + 0.5671432904097838 * delta
    inside = 1 / (1 + math.exp(-far / delta))
    distance, impulse = inside * far - (1 - inside) * delta, [0.0, 0.0, 0.0]
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)) if min(gap, gap + h * velocity[2]) < 0 else ():
        along = velocity[2] - MU * (x * velocity[0] + y * velocity[1])
        force = -stiffness * (h * along + distance) - damping * along
        size = h * (force if sharp * force > 20 else math.log1p(math.exp(sharp * force)) / sharp)
        impulse = [impulse[0] - MU * x * size, impulse[1] - MU * y * size, impulse[2] + size]
    expected = [v + j / MASS for v, j in zip(velocity, impulse, strict=True)]
    assert found.velocity_m_s[0, -1, 0].tolist() == pytest.approx(expected, abs=1e-9)
    # positions follow the velocities at the end
    moved = (found.position_m[0, -1, 0] - found.position_m[0, 0, 0]).tolist()
    assert moved == pytest.approx([h * v for v in expected], abs=1e-12)


@pytest.mark.parametrize("lanes", [8, pytest.param(32, marks=pytest.mark.evidence)])
def test_a_tumbling_cube_of_many_spheres(fused: Fused, lanes: int) -> None:
    world, state = tumbling()
    expected = simulate(world, state, times(0.15))
    assert bool((expected.velocity_m_s[:, -1, 0, 2] > -0.3 - 0.15 * 9.81 + 0.5).all())  # the ground stopped them
    agree(expected, fused(world, state, times(0.15), None, False, lanes=lanes), 1e-9)


@pytest.mark.parametrize("lanes", [4, pytest.param(1, marks=pytest.mark.evidence)])
def test_bodies_that_touch_on_a_slope_by_the_published_distance(fused: Fused, lanes: int) -> None:
    world, state, driven = pushed()
    expected = simulate(world, state, times(0.1), driven)
    free = simulate(replace(world, touching=False), state, times(0.1), driven)
    moved = (expected.position_m - free.position_m)[0, -1].norm(dim=-1)
    assert bool((moved[:2] > 0.002).all()) and float(moved[2]) == 0.0
    agree(expected, fused(world, state, times(0.1), driven, False, lanes=lanes), 1e-9)


@pytest.mark.parametrize(
    "kernel",
    [
        pytest.param(simulate_on_host, marks=NEEDS_COMPILER),
        pytest.param(on_cuda, marks=NEEDS_GPU),
        pytest.param(partial(on_host, lanes=4), marks=[NEEDS_COMPILER, pytest.mark.evidence]),
    ],
)
def test_derivatives_are_those_of_torch_and_of_differences(kernel: Fused) -> None:
    world, state, driven = pushed()
    parameters = contact_parameters(world)
    point = batch([MU, TIME, RATIO])

    def ends(run: Fused, values: Tensor, repeats: int = 1) -> Tensor:
        start = State(*(part[:1].repeat(repeats, 1, 1) for part in state.tensors))
        found: Rollout = run(apply_parameters(world, parameters, values), start, times(0.06), driven)
        return torch.cat((found.position_m[:, -1], found.quat_wxyz[:, -1]), -1).flatten(1)

    expected, found = (batched_jacobian(partial(ends, run), point)[1].cpu() for run in (simulate, kernel))
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-9)
    assert float(found.abs().amax((0, 1)).min()) > 1e-4
    change = 1e-6 * torch.diag(point[0])
    up, down = ends(simulate, torch.cat((point + change, point - change)), 6).view(2, 3, -1)
    torch.testing.assert_close(found[0].T, (up - down) / (2e-6 * point.T), rtol=1e-4, atol=1e-5)


@NEEDS_COMPILER
@pytest.mark.evidence
def test_vectors_of_rollouts_have_the_bits_of_each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host, "width", fused_host.PRODUCT_WIDTH)
    world, _ = tumbling()
    state = tossed(40, 0.06)
    together = simulate_on_host(world, state, times(0.15))
    for item in (0, 17, 39):
        alone = simulate_on_host(world, State(*(part[item : item + 1] for part in state.tensors)), times(0.15))
        assert torch.equal(alone.position_m[0], together.position_m[item])
        assert torch.equal(alone.omega_body_rad_s[0], together.omega_body_rad_s[item])


def test_a_rollout_does_not_depend_on_the_others_of_its_batch() -> None:
    """An item has the contacts that it has alone, though torch gives all items as many as the item with most."""
    world, state = tumbling()
    together = simulate(world, state, times(0.1))
    alone = simulate(world, State(*(part[1:2] for part in state.tensors)), times(0.1))
    torch.testing.assert_close(alone.position_m[0], together.position_m[1], rtol=0, atol=1e-14)


def test_what_the_kernel_lacks_of_it_is_said_and_taken_by_torch() -> None:
    world, state = tumbling()
    assert reason_against(world) is None
    drag = ActiveEffect.of(load_effect("linear_drag"))
    assert "with the effect 'linear_drag'" in (reason_against(replace(world, effects=(drag,))) or "")
    assert "beside fixed surfaces" in (reason_against(replace(world, surfaces=(half_space(),))) or "")
    rows = PaperLaw.of_rows(batch(0.3), batch(1e4), batch(10.0))
    two = world_of(box_body(), ball_body(name="ball"), contact=rows)
    assert "with a sharpness of their distance alone" in (reason_against(two) or "")
    with pytest.raises(UsageError, match="no contact record of the law 'published'"):
        simulate_on_host(world, state, times(0.1), None, True)
    assert engine.rollout(world, state, times(0.02), None, True).contacts is not None
