"""The fused kernel against the torch engine: on a GPU where there is one, and built for the CPU by g++."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply, quat_rotate
from cgwm.pipeline.optimization.forward_mode import batched_jacobian
from cgwm.pipeline.physics import Body, ContactLaw, Rollout, State, World, engine, simulate
from cgwm.pipeline.physics.devices import on_device
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.effects.linear_drag import LinearDrag
from cgwm.pipeline.physics.effects.residual_wrench import AXES, ResidualWrench
from cgwm.pipeline.physics.fused import host, simulate_fused, unsupported
from cgwm.pipeline.physics.fused.host import lacking, simulate_on_host
from cgwm.pipeline.physics.fused.packing import reason_against
from cgwm.pipeline.physics.fused.rollout import roll
from cgwm.pipeline.physics.fused.structure import lanes_for
from cgwm.pipeline.physics.hull import Hull
from cgwm.pipeline.physics.kinematic import Drive
from cgwm.pipeline.physics.pair_laws import laws_in_use
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, GROUND_SHIFT, apply_parameters
from cgwm.pipeline.physics.smooth_distance import plane_contacts
from cgwm.pipeline.runtime import kernel_build
from cgwm.schemas import InputDataError, UsageError
from cgwm.schemas.materials import of_pair, pair_of
from helpers import fused_host, worlds
from helpers.fixed_surfaces import half_space
from helpers.worlds import F64, ball_body, batch, box_body, state_of, times
from torch import Tensor

CUDA = torch.cuda.is_available() and kernel_build.available()
NEEDS_GPU = pytest.mark.skipif(not CUDA, reason="needs a CUDA device and cuda.core")
NEEDS_COMPILER = pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")
POSES = ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")
CONTACTS = ("impulse_n_s", "position_m", "normal", "distance_m")
UPRIGHT = (1.0, 0.0, 0.0, 0.0)

Fused = Callable[..., Rollout]


def world_of(*bodies: Body, step_s: float = 0.002, **more: Any) -> World:
    """Return a world of coarse steps and few sweeps: the two engines have to agree in each."""
    return replace(worlds.world_of(*bodies, step_s=step_s, **more), iterations=4)


def on_cuda(
    world: World, state: State, times_s: Tensor, driven: Any = None, record: bool = False, **more: Any
) -> Rollout:
    """Return the rollout of the GPU."""
    dtype = world.gravity.dtype
    more = {name: on_device(value, "cuda", dtype) for name, value in more.items()}
    driven = {k: on_device(v, "cuda", dtype) for k, v in (driven or {}).items()}
    return simulate_fused(*(on_device(x, "cuda", dtype) for x in (world, state, times_s)), driven, record, **more)


def on_host(*arguments: Any, **more: Any) -> Rollout:
    """Return the rollout of the same source on the CPU."""
    return roll(fused_host.run, *arguments, **more)


@pytest.fixture(params=[pytest.param(on_host, marks=NEEDS_COMPILER), pytest.param(on_cuda, marks=NEEDS_GPU)])
def fused(request: pytest.FixtureRequest) -> Fused:
    return request.param


def cube(side: int = 4, half: float = 0.05, mass: float = 0.4, name: str = "cube") -> Body:
    """Return a cube of side x side x side overlapping spheres, of which the corners touch a plane."""
    spacing = torch.linspace(-1, 1, side, dtype=F64)
    radius = 1.2 * half / side
    centers = torch.cartesian_prod(spacing, spacing, spacing) * (half - radius)
    radii = torch.full((len(centers),), radius, dtype=F64)
    body = box_body((half, half, half), mass)
    chosen = plane_contacts(centers, radii)
    return replace(body, name=name, centers=centers[None], radii=radii[None], on_plane=chosen)


def agree(expected: Rollout, found: Rollout, tolerance: float) -> None:
    def close(name: str, its: Tensor, mine: Tensor) -> None:
        mine = mine.cpu()
        torch.testing.assert_close(
            mine, its.expand_as(mine), rtol=tolerance, atol=tolerance, msg=lambda text: f"{name}: {text}"
        )

    for name in POSES:
        close(name, getattr(expected, name), getattr(found, name))
    assert (expected.contacts is None) == (found.contacts is None)
    if expected.contacts is not None and found.contacts is not None:
        for name in CONTACTS:
            close(f"contact {name}", getattr(expected.contacts, name), getattr(found.contacts, name))
        for name in ("body_a", "body_b", "sliding"):
            assert torch.equal(getattr(found.contacts, name).cpu(), getattr(expected.contacts, name)), name


def same_bits(expected: Rollout, found: Rollout) -> None:
    assert all(torch.equal(getattr(expected, name), getattr(found, name)) for name in POSES)


def tossed(count: int = 3, height: float = 0.08) -> State:
    """Return boxes that tumble onto the ground, each another way."""
    generator = torch.Generator().manual_seed(5)
    state = state_of(((0, 0, height), (1, 0.3, 0.2, 0.1), (0.5, 0.2, -0.3), (3, 5, -2)), count=count)
    noise = torch.randn(count, 1, 3, generator=generator, dtype=F64)
    return replace(state, omega_body_rad_s=state.omega_body_rad_s + noise)


@cache
def tumbling() -> tuple[World, State, Rollout]:
    world, state = world_of(box_body()), tossed()
    return world, state, simulate(world, state, times(0.3), record_contacts=True)


@pytest.mark.parametrize("lanes", [1, *(pytest.param(lanes, marks=pytest.mark.evidence) for lanes in (2, 32)), 8])
def test_a_tumbling_box(fused: Fused, lanes: int) -> None:
    world, state, expected = tumbling()
    assert expected.contacts is not None and expected.contacts.sliding.any() and not expected.contacts.sliding.all()
    agree(expected, fused(world, state, times(0.3), None, True, lanes=lanes), 1e-9)


@pytest.mark.parametrize("lanes", [*(pytest.param(lanes, marks=pytest.mark.evidence) for lanes in (1, 8)), None])
def test_a_cube_of_64_spheres_with_a_shifted_mass(fused: Fused, lanes: int | None) -> None:
    body = replace(cube(), com=batch([0.004, -0.003, 0.006]))
    assert body.on_plane is not None and len(body.on_plane) == 8
    world, state = world_of(body, step_s=0.002), tossed(2)
    agree(
        simulate(world, state, times(0.2), None, True), fused(world, state, times(0.2), None, True, lanes=lanes), 1e-9
    )


def test_many_spheres_on_the_plane(fused: Fused) -> None:
    """More contacts than a thread has room for in registers, and without a choice of those that touch."""
    world, state = world_of(replace(cube(), on_plane=None)), tossed(2)
    agree(simulate(world, state, times(0.15), None, True), fused(world, state, times(0.15), None, True, lanes=2), 1e-9)


def flat_cube(side: int = 3, half: float = 0.05, name: str = "cube") -> Body:
    """Return a cube that other bodies touch by the hull of its spheres."""
    body = cube(side, half, name=name)
    return replace(body, hull=hull_of(body))


def hull_of(body: Body) -> Hull | None:
    return Hull.of(body.centers[0], body.radii[0], plane_contacts(body.centers[0], body.radii[0]))


def test_cubes_that_lie_flat_on_each_other(fused: Fused) -> None:
    """One lands flat on the other, with an overhang; a ball hits the upper one; by hulls, under load."""
    world = world_of(flat_cube(name="low"), flat_cube(2, 0.04, "top"), ball_body(0.02, name="ball"))
    state = state_of(
        ((0, 0, 0.05), UPRIGHT, (0, 0, 0), (0, 0, 0)),
        ((0.02, 0.005, 0.142), (1, 0.01, -0.02, 0.05), (0.1, 0, -0.4), (0, 0, 1)),
        ((-0.05, 0.0, 0.14), UPRIGHT, (1.0, 0, 0), (0, 0, 0)),
        count=2,
    )
    expected = simulate(world, state, times(0.06), None, True)
    assert expected.contacts is not None
    impulse, contacts = expected.contacts.impulse_n_s.abs().amax((0, 1, 3)), expected.contacts
    pairs = torch.stack((contacts.body_a, contacts.body_b), -1)
    for pair in ([0, -1], [0, 1], [1, 2]):
        assert impulse[(pairs == torch.tensor(pair)).all(-1)].max() > 0, pair
    agree(expected, fused(world, state, times(0.06), None, True, lanes=None), 1e-7)


def planks() -> tuple[World, State]:
    """Return a plank that falls across another one and is tilted, so that edges meet: no corner touches a face."""
    low = box_body((0.1, 0.02, 0.02), radius=5e-4)
    low, top = (replace(low, name=name, hull=hull_of(low)) for name in ("low", "top"))
    still, falling = ((0, 0, 0.0199), UPRIGHT, (0, 0, 0), (0, 0, 0)), ((0.2, 0, -0.5), (0, 1, 0))
    return world_of(low, top), state_of(still, ((0.01, 0, 0.0675), (0.7, 0.15, 0, 0.7), *falling), count=2)


def test_edges_that_cross(fused: Fused) -> None:
    """Labels of edges that touched between two frames have the gap and the normal of their impulses."""
    world, state = planks()
    frames = torch.tensor([0.0, 0.03], dtype=F64)
    expected = simulate(world, state, frames, None, True)
    contacts = expected.contacts
    assert contacts is not None
    impulse, touches = contacts.impulse_n_s.norm(dim=-1), contacts.body_b == 1
    assert float(impulse[..., touches][..., :16].max()) == 0 < float(impulse[..., touches][..., 16:].max())
    assert float(contacts.distance_m[impulse > 0].max()) < 0.01 < float(contacts.distance_m[..., touches].max())
    agree(expected, fused(world, state, frames, None, True, lanes=4), 1e-7)


def test_a_plank_that_lies_across_another_one_rests_on_the_four_points_where_their_edges_cross(fused: Fused) -> None:
    world = replace(planks()[0], iterations=10)
    low, top = (((0, 0, z), (1, 0, 0, turn), (0, 0, 0), (0, 0, 0)) for z, turn in ((0.01995, 0), (0.0599, 1)))
    found = on_device(fused(world, state_of(low, top, count=2), times(0.3), None, True, lanes=4), "cpu")
    contacts = found.contacts
    assert contacts is not None
    carried = contacts.impulse_n_s[0, -1][contacts.body_b == 1]
    acts = carried[:, 2].abs() > 1e-6
    torch.testing.assert_close(carried[acts, 2], torch.full((4,), -0.4 * 9.81 * 0.01 / 4, dtype=F64), rtol=1e-3, atol=0)
    places = contacts.position_m[0, -1][contacts.body_b == 1][acts, :2]
    torch.testing.assert_close(places.abs(), torch.full((4, 2), 0.0195, dtype=F64), rtol=0, atol=1e-4)
    assert float(found.velocity_m_s[0, -1].abs().max()) < 1e-5


@pytest.mark.parametrize("lanes", [1, pytest.param(8, marks=pytest.mark.evidence)])
def test_a_box_whose_faces_are_plates(fused: Fused, lanes: int) -> None:
    """Alone, it tumbles; then it lies, under a ball, and slides."""
    plate = worlds.plate_body((0.05, 0.04, 0.03))
    state = tossed(2)
    expected = simulate(world_of(plate), state, times(0.15), None, True)
    assert expected.contacts is not None and expected.contacts.impulse_n_s.abs().amax() > 0
    agree(expected, fused(world_of(plate), state, times(0.15), None, True, lanes=lanes), 1e-8)
    world = world_of(plate, ball_body(0.02, name="ball"))
    state = state_of(
        ((0, 0, 0.03), UPRIGHT, (0.3, 0, 0), (0, 0, 2)), ((0.02, 0.01, 0.082), UPRIGHT, (0, 0, 0), (0, 0, 0)), count=2
    )
    agree(simulate(world, state, times(0.05), None, True), fused(world, state, times(0.05), None, True), 1e-8)


def crowd() -> tuple[World, State, dict[str, Track | Drive]]:
    """Return two free bodies, a pusher that turns, and a fixed ball, all of which touch others within 0.16 s."""
    pusher = replace(ball_body(0.02, name="pusher", copies=3), motion="driven")
    pusher = replace(pusher, centers=batch([[0.0, -0.02, 0.0], [0.0, 0.0, 0.0], [0.0, 0.015, 0.005]]))
    post = replace(ball_body(0.03, name="post"), motion="fixed")
    top = replace(box_body((0.03, 0.03, 0.02), 0.15, 0.004), name="top", com=batch([0.002, 0.0, -0.001]))
    world = world_of(cube(2), top, pusher, post)
    state = state_of(
        ((0, 0, 0.05), UPRIGHT, (0, 0, 0), (0, 0, 0)),
        ((0.01, 0.005, 0.14), (1, 0.1, 0.2, 0.05), (0, 0, -0.5), (2, 1, 3)),
        ((-0.08, 0, 0.04), UPRIGHT, (0, 0, 0), (0, 0, 0)),
        ((0.083, 0.01, 0.03), UPRIGHT, (0, 0, 0), (0, 0, 0)),
        count=2,
    )
    time = np.array([0.0, 0.02, 0.12, 0.2])
    along = np.stack((np.array([-0.08, -0.075, -0.065, -0.09]), 0 * time, 0.04 + 0 * time), -1)
    angles = np.array([0.0, 0.05, 0.4, 0.3])
    quat = np.stack((np.cos(angles / 2), 0 * time, 0 * time, np.sin(angles / 2)), -1)
    return world, state, {"pusher": Track(time, along, quat)}


@cache
def touching() -> tuple[World, State, dict[str, Drive], Rollout]:
    """Return the crowd, one of the batch shifted, until all have touched, and its rollout by the torch engine."""
    world, state, driven = crowd()
    like = state.position_m
    commands = {name: Drive.of([track], like) for name, track in driven.items() if isinstance(track, Track)}
    state.position_m[1, 1, 0] += 0.004
    return world, state, commands, simulate(world, state, times(0.16), commands, True)


@pytest.mark.parametrize("lanes", [*(pytest.param(lanes, marks=pytest.mark.evidence) for lanes in (1, 4)), None])
def test_bodies_that_touch_each_other(fused: Fused, lanes: int | None) -> None:
    world, state, driven, expected = touching()
    assert expected.contacts is not None
    pairs = set(zip(expected.contacts.body_a.tolist(), expected.contacts.body_b.tolist(), strict=True))
    acted = expected.contacts.impulse_n_s.abs().amax((0, 1, 3)) > 0
    touched = {
        (int(a), int(b))
        for a, b, yes in zip(expected.contacts.body_a, expected.contacts.body_b, acted, strict=True)
        if yes
    }
    assert {(0, -1), (0, 1), (0, 2), (0, 3)} <= touched <= pairs
    agree(expected, fused(world, state, times(0.16), driven, True, lanes=lanes), 1e-9)


def test_commands_of_several_lengths(fused: Fused) -> None:
    world, state, driven = crowd()
    track = driven["pusher"]
    assert isinstance(track, Track) and track.quat_wxyz is not None
    short = Track(track.time_s[:2], track.position_m[:2], track.quat_wxyz[:2])
    commands = {"pusher": Drive.of([track, short], state.position_m)}
    frames = times(0.06)  # one command ends before
    agree(simulate(world, state, frames, commands), fused(world, state, frames, commands, lanes=4), 1e-9)


def test_balls_of_coincident_spheres(fused: Fused) -> None:
    """The smooth minimum of equal distances, and the crowding of equal contacts."""
    world = world_of(ball_body(0.04, 0.3, "low", 3), ball_body(0.03, 0.1, "high", 2))
    state = state_of(
        ((0, 0, 0.04), UPRIGHT, (0, 0, 0), (0, 0, 0)), ((0.004, 0, 0.12), UPRIGHT, (0, 0, -0.4), (1, 2, 3))
    )
    agree(simulate(world, state, times(0.1), None, True), fused(world, state, times(0.1), None, True), 1e-9)


def varied(count: int) -> tuple[World, State, Tensor]:
    """Return a world of which everything that may differ between the items of a batch does, and frames that do."""
    generator = torch.Generator().manual_seed(1)

    def about(value: Tensor, spread: float = 0.1) -> Tensor:
        wide = value.expand(count, *value.shape[1:])
        return wide * (1 + spread * torch.rand(wide.shape, generator=generator, dtype=F64))

    body = box_body()
    shift = torch.randn(count, 3, generator=generator, dtype=F64)
    lever = 0.01 * shift
    turned = torch.eye(3, dtype=F64) * lever.square().sum(-1)[:, None, None] - lever[:, :, None] * lever[:, None]
    body = replace(
        body, mass=about(body.mass), inertia=about(body.inertia.diagonal(dim1=-2, dim2=-1)).diag_embed() + turned,
        com=0.003 * shift, centers=about(body.centers), radii=about(body.radii, 1.0),
    )  # fmt: skip
    contact = ContactLaw(about(batch(0.3)), about(batch(0.004)), about(batch(0.3), 5.0))
    world = replace(
        world_of(body), gravity=about(batch([0.5, -0.4, -9.0])), ground_offset=about(batch(0.01)), contact=contact
    )
    frames = torch.stack([times(0.3) * (1 + 0.01 * index) + 0.1 * index for index in range(count)])
    return world, tossed(count), frames


def test_everything_may_differ_in_a_batch(fused: Fused) -> None:
    world, state, frames = varied(3)
    assert (world.contact.damping_ratio > 1).any() and (world.contact.damping_ratio < 1).any()
    agree(simulate(world, state, frames, None, True), fused(world, state, frames, None, True, lanes=4), 1e-9)


def test_a_tilted_ground(fused: Fused) -> None:
    normal = torch.tensor([0.3, -0.2, 0.9], dtype=F64)
    for n, offset in ((normal / normal.norm(), -0.1), (torch.tensor([0.0, 0.0, -1.0], dtype=F64), -0.17)):
        world, state, driven = crowd()
        world = replace(
            world, ground_normal=n, ground_offset=batch(offset), gravity=batch([0.5, 0.0, -9.0 * float(n[2])])
        )
        expected = simulate(world, state, times(0.04), driven, True)
        assert expected.contacts is not None and expected.contacts.impulse_n_s.abs().amax() > 0
        agree(expected, fused(world, state, times(0.04), driven, True), 1e-9)


def test_no_ground_one_frame_and_a_single_fixed_body(fused: Fused) -> None:
    world, state = world_of(box_body(), ground=False), tossed()
    agree(simulate(world, state, times(0.1), None, True), fused(world, state, times(0.1), None, True), 1e-12)
    still = world_of(replace(box_body(), motion="fixed"))
    agree(simulate(still, state, times(0.05)), fused(still, state, times(0.05)), 1e-12)
    drop = world_of(box_body())
    agree(simulate(drop, state, times(0.0), None, True), fused(drop, state, times(0.0), None, True), 1e-12)


def test_a_fast_spin_and_one_sweep(fused: Fused) -> None:
    state = tossed()
    state = replace(state, omega_body_rad_s=state.omega_body_rad_s * 50)
    world = replace(world_of(box_body()), iterations=1)
    agree(simulate(world, state, times(0.05)), fused(world, state, times(0.05)), 1e-9)


def test_single_precision(fused: Fused) -> None:
    """Rounding: over an impact both are as far from double precision, and nearer to each other."""
    world, state = world_of(cube(), step_s=0.002), tossed(4, 0.075)
    exact = simulate(world, state, times(0.1), None, True)
    assert exact.contacts is not None and exact.contacts.impulse_n_s.abs().amax() > 0
    single = [on_device(x, "cpu", torch.float32) for x in (world, state, times(0.1))]
    theirs, ours = simulate(*single), fused(*single, lanes=2)
    for name, scale in zip(POSES, (0.1, 1.0, 1.0, 10.0), strict=True):
        truth, mine, its = (getattr(rollout, name).cpu() for rollout in (exact, ours, theirs))
        assert (mine - its).abs().amax() / scale < 3e-5, name
        assert (mine - truth).abs().amax() < 2 * (its - truth).abs().amax() + 1e-6 * scale, name


def test_single_precision_of_a_fast_spin(fused: Fused) -> None:
    """Beyond the angles of a step for which the kernel's rotation is a series."""
    state = tossed(2, 1.0)
    state = replace(state, omega_body_rad_s=state.omega_body_rad_s * 200)
    single = [on_device(x, "cpu", torch.float32) for x in (world_of(box_body(), step_s=0.002), state, times(0.02))]
    mine, its = fused(*single), simulate(*single)
    assert (mine.omega_body_rad_s * 0.002).norm(dim=-1).amin() > 1
    torch.testing.assert_close(mine.quat_wxyz.cpu(), its.quat_wxyz, rtol=0, atol=1e-4)


def of_parameters(engine: Any, world: World, frames: Tensor, driven: Any = None) -> Callable[[Tensor, int], Tensor]:
    """Return the rollout as a function of 12 numbers of the state, the contact, the ground, and the centre of mass.

    The numbers of the contact are followed by those of each pair of materials.
    """
    names = [replace(GROUND_SHIFT, name=f"{world.bodies[0].name}.com_{axis}_m") for axis in "xyz"]
    of_pairs = [replace(p, name=of_pair(p.name, pair)) for pair in world.pair_laws for p in CONTACT_PARAMETERS]
    named = (*CONTACT_PARAMETERS, GROUND_SHIFT, *names, *of_pairs)

    def function(values: Tensor, repeats: int) -> Tensor:
        state, size = tossed(1, 0.07), len(values)
        others = len(world.bodies) - 1

        def column(first: Tensor, key: str) -> Tensor:
            mine = first[:, None]
            if not others:
                return mine
            base = getattr(crowd()[1], key)[:1, 1:].expand(size, others, -1).contiguous()
            return torch.cat((mine, base), 1)

        quat = quat_multiply(quat_exp(values[:, 3:6]), state.quat_wxyz[:, 0].expand(size, 4).contiguous())
        moved = State(
            column(values[:, :3], "position_m"), column(quat, "quat_wxyz"),
            column(values[:, 6:9], "velocity_m_s"), column(values[:, 9:12], "omega_body_rad_s"),
        )  # fmt: skip
        rollout = engine(apply_parameters(world, named, values[:, 12:]), moved, frames, driven)
        return torch.cat([getattr(rollout, name).flatten(1) for name in POSES], 1)

    return function


def agree_with_derivatives(
    fused: Fused, world: World, first: list[float], frames: Tensor, driven: Any, spread: float
) -> None:
    of_pairs = [0.5, 0.005, 0.2] * len(world.pair_laws)
    inputs = torch.tensor([[*first, 0.3, 0.004, 0.4, 0.001, 0.002, -0.001, 0.003, *of_pairs]], dtype=F64)
    inputs = inputs * (1 + spread * torch.arange(1 if driven else 2, dtype=F64)[:, None])
    value, jacobian = batched_jacobian(of_parameters(simulate, world, frames, driven), inputs)
    shared = partial(fused, lanes=4)
    mine, its = batched_jacobian(of_parameters(shared, world, frames, driven), inputs)
    assert jacobian.abs().amax((0, 1)).min() > 1e-4  # every parameter acts
    torch.testing.assert_close(mine.cpu(), value, rtol=1e-9, atol=1e-9)
    scale = jacobian.abs().amax((0, 1))
    torch.testing.assert_close(its.cpu() / scale, jacobian / scale, rtol=1e-7, atol=1e-7)


def test_derivatives_of_a_toss(fused: Fused) -> None:
    first = [0, 0, 0.06, 0.1, 0.2, 0.1, 0.5, 0.2, -0.3, 3, 5, -2]
    agree_with_derivatives(fused, world_of(box_body()), first, times(0.06), None, 0.02)


def test_derivatives_of_a_box_whose_faces_are_plates(fused: Fused) -> None:
    first = [0, 0, 0.0295, 0.001, 0.002, 0.1, 0.5, 0.2, -0.1, 0.3, 0.2, 2]
    plate = world_of(worlds.plate_body((0.05, 0.04, 0.03), exponent=2.0))
    agree_with_derivatives(fused, plate, first, times(0.04), None, 0.02)
    # and those of differences of the kernel itself, which share no formula with it
    inputs = torch.tensor([[*first, 0.3, 0.004, 0.4, 0.001, 0.002, -0.001, 0.003]], dtype=F64)
    along = torch.linspace(-1, 1, inputs.shape[1], dtype=F64) * (inputs.abs() + 0.01)
    places = torch.cat((inputs, inputs + 1e-6 * along, inputs - 1e-6 * along))
    values, jacobian = (x.cpu() for x in batched_jacobian(of_parameters(fused, plate, times(0.04)), places))
    slope = jacobian[0] @ along[0]
    difference = (values[1] - values[2]) / 2e-6
    torch.testing.assert_close(slope / slope.abs().amax(), difference / slope.abs().amax(), rtol=1e-6, atol=1e-6)


@pytest.mark.evidence
def test_derivatives_of_bodies_that_touch(fused: Fused) -> None:
    world, _, driven = crowd()
    first = [0, 0, 0.053, 0.01, 0.02, 0.01, 0.05, 0.02, -0.1, 0.3, 0.5, -0.2]
    agree_with_derivatives(fused, world, first, times(0.03), driven, 0.0)


def of_materials(world: World, **laws: ContactLaw) -> World:
    """Return the world of `crowd` with a steel cube and a steel pusher on wood, and laws by pair of materials."""
    materials = {"cube": "steel", "pusher": "steel", "box": "rubber", "top": "rubber"}
    bodies = tuple(replace(body, material=materials.get(body.name)) for body in world.bodies)
    pair_laws = {pair_of(*name.split("_")): law for name, law in laws.items()}
    return replace(world, bodies=bodies, ground_material="wood", pair_laws=pair_laws)


def test_pairs_of_materials_have_their_own_laws(fused: Fused) -> None:
    world, state, driven, plain = touching()
    laws = {"steel_wood": worlds.law(0.1, 0.006, 0.8), "steel_steel": worlds.law(0.9, 0.003, 0.1),
            "rubber_steel": ContactLaw(batch([0.7, 0.2])[0], batch(0.004), batch([0.2, 1.4])[0])}  # fmt: skip
    world = of_materials(world, **laws)
    assert laws_in_use(world).of_pair == (0, 1, 2, 3, 1, 2, 1)
    expected = simulate(world, state, times(0.1), driven, True)
    assert (expected.position_m - plain.position_m[:, :11]).abs().amax((0, 1, 3))[:2].min() > 1e-4
    agree(expected, fused(world, state, times(0.1), driven, True, lanes=4), 1e-9)


def test_a_pair_with_the_law_of_all_others_changes_no_bit(fused: Fused) -> None:
    world, state, driven = crowd()
    same = of_materials(world, steel_wood=world.contact, rubber_steel=world.contact)
    same_bits(fused(world, state, times(0.06), driven, lanes=4), fused(same, state, times(0.06), driven, lanes=4))
    alone, start = world_of(box_body(), contact=worlds.law(0.6)), tossed()
    listed = replace(of_materials(world_of(box_body())), pair_laws={("rubber", "wood"): worlds.law(0.6)})
    same_bits(fused(alone, start, times(0.2)), fused(listed, start, times(0.2)))


# In the suite: values by these laws, and derivatives of contacts under one law, are tested above.
@pytest.mark.evidence
def test_derivatives_by_the_laws_of_pairs(fused: Fused) -> None:
    world, _, driven = crowd()
    first = [-0.006, 0, 0.053, 0.01, 0.02, 0.01, -0.05, 0.02, -0.1, 0.3, 0.5, -0.2]
    world = of_materials(world, steel_wood=worlds.law(), steel_steel=worlds.law())
    agree_with_derivatives(fused, world, first, times(0.04), driven, 0.0)


def test_derivatives_of_cubes_that_lie_on_each_other(fused: Fused) -> None:
    world, _, driven = crowd()
    low, top, *others = world.bodies
    world = replace(world, bodies=(replace(flat_cube(2), name=low.name), replace(top, hull=hull_of(top)), *others))
    first = [0, 0, 0.053, 0.01, 0.02, 0.01, 0.05, 0.02, -0.1, 0.3, 0.5, -0.2]
    agree_with_derivatives(fused, world, first, times(0.03), driven, 0.0)


@pytest.mark.evidence
def test_derivatives_of_edges_that_cross(fused: Fused) -> None:
    """A plank falls askew on an edge of the cube, beyond which its corners are."""
    world, state, driven = crowd()
    low, top, *others = world.bodies
    plank = replace(box_body((0.07, 0.012, 0.012), 0.15), name=top.name)
    world = replace(world, bodies=(replace(flat_cube(2), name=low.name), replace(plank, hull=hull_of(plank)), *others))
    contacts = simulate(world, state, times(0.03), driven, True).contacts
    assert contacts is not None
    assert contacts.impulse_n_s[0][:, (contacts.body_a == 0) & (contacts.body_b == 1)][:, 16:].abs().max() > 0
    first = [0, 0, 0.053, 0.01, 0.02, 0.01, 0.05, 0.02, -0.1, 0.3, 0.5, -0.2]
    agree_with_derivatives(fused, world, first, times(0.03), driven, 0.0)


def active(name: str, **values: float | list[float]) -> ActiveEffect:
    return ActiveEffect.of(load_effect(name), {k: torch.as_tensor(v, dtype=F64) for k, v in values.items()})


def every_effect() -> tuple[ActiveEffect, ...]:
    """Return every effect that the kernel has, one by which the items of a batch differ, and some of the world's."""
    return (
        active("linear_drag", c=[0.4, 0.1]), active("quadratic_drag", k=0.7), active("magnus_lift", s=0.2),
        active("spin_lift", q_x=[0.3, -0.5], q_y=[-0.2, 0.1], q_z=[0.4, 0.4]),
        active("spin_damping", d=0.8), active("constant_force", f_x=0.3, f_y=-0.2, f_z=0.5), active("buoyancy", b=0.6),
        active("wind", w_x=1.0, w_y=-2.0), active("ground_magnet", A=4.0, l=0.1), active("gravity_scale", s=0.05),
        active("gravity_tilt", tilt_x=0.05, tilt_y=0.1), active("com_offset", d_x=0.003, d_y=-0.002),
        active("inertia_shape", s_xx=0.1, s_xy=0.05), active("ground_magnet", A=3.0, l=0.02), residual_wrench(4.0),
    )  # fmt: skip


def residual_wrench(size: float | Tensor) -> ActiveEffect:
    """Return a constant acceleration of that size, and angular ones up to five times as large."""
    shares = dict(zip(AXES, (0.3, -0.5, 1.0, -2.0, 5.0, 3.0), strict=True))
    return ActiveEffect.of(ResidualWrench(), {k: torch.as_tensor(v * size, dtype=F64) for k, v in shares.items()})


def flight() -> tuple[World, State]:
    """Return a box and a ball that fall and touch the ground, 0.1 s after their start."""
    world = world_of(replace(box_body(), com=batch([0.003, 0.001, -0.002])), ball_body())
    state = state_of(
        ((0, 0, 0.2), (1, 0.3, 0.2, 0.1), (2, 1, -0.9), (3, 5, -2)),
        ((1, 0, 0.1), UPRIGHT, (1, -1, -0.2), (9, 2, 3)),
        count=2,
    )
    return world, state


@pytest.mark.parametrize("ground", [pytest.param("level", marks=pytest.mark.evidence), "tilted", "none"])
def test_effects(fused: Fused, ground: str) -> None:
    world, state = flight()
    effects = every_effect()
    if ground == "tilted":
        turn = quat_exp(torch.tensor([0.1, -0.2, 0.0], dtype=F64))
        world = replace(world, ground_normal=quat_rotate(turn, torch.tensor([0.0, 0, 1], dtype=F64)))
    if ground == "none":
        world = replace(world, ground_normal=None, ground_offset=None)
        effects = tuple(e for e in effects if e.effect.name != "ground_magnet")
        assert len(effects) == len(every_effect()) - 2
    acting = replace(world, effects=effects)
    expected = simulate(acting, state, times(0.14), None, True)
    agree(expected, fused(acting, state, times(0.14), None, True), 1e-9)
    # each of them acts: rows of a batch leave out one each
    others, rows = [], len(effects)
    for number, one in enumerate(effects):
        kept = 1.0 - torch.eye(rows, dtype=F64)[number]
        values = {name: value[:1] * kept for name, value in one.values.items()}
        constants = {constant.name: one.values[constant.name] for constant in one.effect.constants}
        others.append(ActiveEffect(one.effect, values | constants))
    first = State(*(getattr(state, name)[:1].repeat(rows, *[1] * (getattr(state, name).ndim - 1)) for name in POSES))
    without = simulate(replace(world, effects=tuple(others)), first, times(0.1)).position_m
    changed = (without - expected.position_m[:1, : without.shape[1]]).abs().amax((1, 2, 3))
    assert changed.min() > 1e-6, [one.effect.name for one, by in zip(effects, changed, strict=True) if by < 1e-6]


@pytest.mark.parametrize("lanes", [pytest.param(1, marks=pytest.mark.evidence), 4])
def test_the_pull_of_the_ground_on_one_body(fused: Fused, lanes: int) -> None:
    """Its lowest sphere is one of several threads'."""
    world = replace(world_of(cube(), step_s=0.002), effects=(active("ground_magnet", A=30.0, l=0.02),))
    agree(simulate(world, tossed(2), times(0.2)), fused(world, tossed(2), times(0.2), lanes=lanes), 1e-9)


def zeros(name: str, values: Tensor) -> dict[str, Tensor]:
    """Return neutral values of an effect's parameters, for as many items."""
    return {parameter.name: 0.0 * values[:, 0] for parameter in load_effect(name).parameters}


def test_derivatives_of_effects(fused: Fused) -> None:
    world, state = flight()
    names = [
        ("linear_drag", "c"), ("quadratic_drag", "k"), ("magnus_lift", "s"), ("spin_damping", "d"),
        ("constant_force", "f_x"), ("buoyancy", "b"), ("wind", "w_x"), ("ground_magnet", "A"), ("com_offset", "d_x"),
        ("gravity_tilt", "tilt_x"), ("spin_lift", "q_y"),
    ]  # fmt: skip
    inputs = batch([0.4, 0.7, 0.2, 0.8, 0.3, 0.6, 1.0, 4.0, 0.003, 0.05, 0.4, 2.0])
    first = State(*(getattr(state, name)[:1] for name in POSES))

    def function(engine: Any) -> Callable[[Tensor, int], Tensor]:
        def rolled(values: Tensor, repeats: int) -> Tensor:
            effects = tuple(
                ActiveEffect.of(load_effect(name), zeros(name, values) | {key: values[:, k]}, values)
                for k, (name, key) in enumerate(names)
            )
            effects = (*effects, residual_wrench(values[:, -1]))
            rollout = engine(replace(world, effects=effects), first, times(0.1))
            return torch.cat([getattr(rollout, name)[:, -1].flatten(1) for name in POSES], 1)

        return rolled

    value, jacobian = batched_jacobian(function(simulate), inputs)
    found, its = batched_jacobian(function(fused), inputs)
    torch.testing.assert_close(found.cpu(), value, rtol=1e-9, atol=1e-9)
    scale = jacobian.abs().amax((0, 1))
    assert scale.min() > 1e-5
    torch.testing.assert_close(its.cpu() / scale, jacobian / scale, rtol=1e-7, atol=1e-7)


SURFACE_VALUES: dict[str, dict[str, float]] = {
    "stribeck_friction": {"d": 0.3, "v_s": 0.2},
    "anisotropic_friction": {"a": 0.1, "b": -0.08},
    "friction_patch": {"c_11": 0.1, "c_22": 0.2, "c_32": -0.1, "c_13": 0.15, "p": 0.1},
    "viscous_friction": {"c_v": 0.8},
    "rolling_resistance": {"c_r": 3e-3},
    "torsional_friction": {"c_t": 4e-3},
    "velocity_restitution": {"r": 0.4},
    "adhesion": {"F": 3.0, "g": 2e-3},
}


def sliding(world: World) -> State:
    """Return one body that slides on an edge and spins, and one that falls."""
    rows = (
        ((-0.05, 0.04, 0.045), (1, 0.1, 0.05, 0.3), (0.8, -0.3, -0.1), (1, 4, 6)),
        ((0.02, 0.0, 0.12), (1, 0.3, 0.2, 0.1), (-0.5, 0.6, -0.9), (3, -5, 2)),
    )
    return State.joined(*(state_of(row) for row in rows))


@pytest.mark.parametrize(
    ("name", "lanes"),
    [
        *(pytest.param(name, 1, marks=pytest.mark.evidence) for name in SURFACE_VALUES),
        pytest.param("all", 1, marks=pytest.mark.evidence),
        ("all", 4),
    ],
)
def test_effects_of_the_contact_of_one_body(fused: Fused, name: str, lanes: int) -> None:
    plain = world_of(cube(side=2, half=0.04))
    names = list(SURFACE_VALUES) if name == "all" else [name]
    world = replace(plain, effects=tuple(active(one, **SURFACE_VALUES[one]) for one in names))
    record = name == "all"
    expected = simulate(world, sliding(world), times(0.15), None, record)
    agree(expected, fused(world, sliding(world), times(0.15), None, record, lanes=lanes), 1e-9)
    without = simulate(plain, sliding(world), times(0.15))
    assert (without.position_m - expected.position_m).abs().max() > 1e-5


def test_effects_of_the_contact_of_a_rolling_ball(fused: Fused) -> None:
    names = ("rolling_resistance", "torsional_friction", "viscous_friction", "velocity_restitution")
    law = ContactLaw(batch(0.4), batch(0.004), batch(1.2))
    world = replace(world_of(ball_body()), contact=law)
    world = replace(world, effects=tuple(active(one, **SURFACE_VALUES[one]) for one in names))
    radius = float(world.bodies[0].radii.max())
    state = state_of(((0, 0, radius + 0.01), UPRIGHT, (0.6, 0.2, 0.0), (0.0, 15.0, 8.0)))
    agree(simulate(world, state, times(0.25)), fused(world, state, times(0.25)), 1e-9)


def test_derivatives_of_effects_of_the_contact(fused: Fused) -> None:
    world = world_of(cube(side=2, half=0.04))
    pairs = [(name, key) for name, values in SURFACE_VALUES.items() for key in values if key not in ("v_s", "p", "g")]
    inputs = torch.tensor([[SURFACE_VALUES[name][key] for name, key in pairs]], dtype=F64)
    first = sliding(world).at([0])

    def function(engine: Any) -> Callable[[Tensor, int], Tensor]:
        def rolled(values: Tensor, repeats: int) -> Tensor:
            effects = []
            for name, numbers in SURFACE_VALUES.items():
                own = {p.name: 0.0 * values[:, 0] for p in load_effect(name).parameters}
                own |= {key: values[:, k] for k, (one, key) in enumerate(pairs) if one == name}
                own |= {key: 0.0 * values[:, 0] + v for key, v in numbers.items() if key in ("v_s", "p", "g")}
                effects.append(ActiveEffect.of(load_effect(name), own, values))
            rollout = engine(replace(world, effects=tuple(effects)), first, times(0.05))
            return torch.cat([getattr(rollout, name)[:, -1].flatten(1) for name in POSES], 1)

        return rolled

    value, jacobian = batched_jacobian(function(simulate), inputs)
    found, its = batched_jacobian(function(fused), inputs)
    torch.testing.assert_close(found.cpu(), value, rtol=1e-9, atol=1e-9)
    scale = jacobian.abs().amax((0, 1)).clamp_min(1e-9)
    torch.testing.assert_close(its.cpu() / scale, jacobian / scale, rtol=1e-6, atol=1e-6)


@NEEDS_COMPILER
def test_refusals() -> None:
    world, state = world_of(box_body()), tossed(1)
    assert "'cpu'" in (unsupported(world) or "")
    with pytest.raises(UsageError, match=r"cannot take this world.*'cpu'.*\nNext: use simulate"):
        simulate_fused(world, state, times(0.1))
    with pytest.raises(UsageError, match="no reverse derivatives"):
        on_host(world, replace(state, position_m=state.position_m.requires_grad_()), times(0.1))
    with pytest.raises(UsageError, match=r"several kinds: torch.float32 on cpu, torch.float64 on cpu"):
        on_host(on_device(world, "cpu", torch.float32), tossed(1), times(0.1))
    with pytest.raises(InputDataError, match="body 'box': mass"):
        on_host(world.with_body(0, mass=-world.bodies[0].mass), state, times(0.1))
    with pytest.raises(InputDataError, match="position_m of body 'box' is not finite"):
        on_host(world, replace(state, position_m=state.position_m * torch.nan), times(0.1))
    with pytest.raises(UsageError, match="'ground_magnet' needs a ground"):
        magnet = replace(world_of(box_body(), ground=False), effects=(active("ground_magnet", A=1.0),))
        on_host(magnet, state, times(0.1))
    with torch.no_grad():
        assert not on_host(world, state, times(0.01)).position_m.requires_grad
    with pytest.raises(InputDataError, match="the driven body 'pusher' has no track"):
        on_host(*crowd()[:2], times(0.1))
    body = world.bodies[0]

    def recorded(com: Tensor, repeats: int) -> Tensor:
        return on_host(world.with_body(0, com=com), state, times(0.1), None, True).position_m.flatten(1)

    with pytest.raises(UsageError, match="no derivatives of the contact record"):
        batched_jacobian(recorded, body.com)


def test_what_the_kernel_does_not_have() -> None:
    world = world_of(box_body())
    measured = replace(world, effects=(active("clock_scale", s=0.01), active("frame_tilt", tilt_x=0.1)))
    assert reason_against(world) is None and reason_against(measured) is None
    two, slope = world_of(box_body(), ball_body()), torch.tensor([0.6, 0.0, 0.8], dtype=F64)
    for name in SURFACE_VALUES:
        effects = (active("linear_drag", c=0.1), active(name))
        assert reason_against(replace(world, effects=effects)) is None
        reason = reason_against(replace(two, effects=effects))
        assert reason == f"the kernel has '{name}' for one body only, on a ground or fixed surfaces"
        track = replace(world, surfaces=(half_space(),), effects=effects)
        upon = reason_against(track) == f"the kernel has '{name}' for one body on the ground only"
        assert upon == (name in ("anisotropic_friction", "friction_patch", "adhesion"))
        assert "takes one" in (reason_against(replace(world, effects=(*effects, active(name)))) or "")
    tilted = replace(world, ground_normal=slope, effects=(active("anisotropic_friction"),))
    assert "upright ground" in (reason_against(tilted) or "")

    class Other(LinearDrag):
        name = "other"

    assert "'other'" in (reason_against(replace(world, effects=(ActiveEffect.of(Other()),))) or "")
    flying = replace(world, touching=False, effects=(active("adhesion", F=1.0),))
    assert "do not touch anything" in (reason_against(flying) or "")
    assert "its bodies may have 16392 contacts" in (reason_against(crowded(8188)) or "")


def crowded(count: int) -> World:
    """Return two balls of so many spheres each, and 8 contacts more."""
    one, two = ball_body(copies=count), ball_body(copies=count, name="two")
    chosen = torch.arange(8)
    return world_of(replace(one, on_plane=chosen), replace(two, on_plane=chosen))


def test_the_torch_engine_is_taken_on_a_cpu_without_a_compiler(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_build, "compiler", lambda: None)
    monkeypatch.setattr(engine, "compiler", lambda: None)
    world, state = world_of(box_body()), tossed(1)
    with caplog.at_level("INFO", "cgwm"):
        agree(
            simulate(world, state, times(0.05), None, True),
            engine.rollout(world, state, times(0.05), None, True),
            0.0,
        )
    assert not caplog.records


@NEEDS_COMPILER
def test_the_kernel_is_taken_on_a_cpu_with_a_compiler(caplog: pytest.LogCaptureFixture) -> None:
    world, state = world_of(box_body()), tossed(3)
    engine._note.cache_clear()
    with caplog.at_level("INFO", "cgwm"), fused_host.built_as_for_users():
        found = engine.rollout(world, state, times(0.2), None, True)
        same_bits(found, simulate_on_host(world, state, times(0.2), None, True))
        agree(simulate(world, state, times(0.2), None, True), found, 1e-9)
        assert not caplog.records
        twice = replace(world, effects=(active("adhesion"), active("adhesion")))
        same_bits(simulate(twice, state, times(0.05)), engine.rollout(twice, state, times(0.05)))
    assert [record.getMessage() for record in caplog.records] == [
        "rollouts run in the torch engine, not in the fused kernel: the kernel takes one adhesion, and it has several"
    ]


@NEEDS_COMPILER
def test_threads_change_no_bit_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host, "width", fused_host.PRODUCT_WIDTH)
    world, state = world_of(box_body()), tossed(100)
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(simulate_on_host(world, state, times(0.1)))
    finally:
        torch.set_num_threads(before)
    same_bits(*found)


def unlike(count: int) -> tuple[World, State]:
    """Return boxes that begin in the air and on the ground, each second one without any effect of its contact."""
    mine = (torch.arange(count) % 2).to(F64)
    effects = [active("ground_magnet", A=4.0, l=0.1), active("linear_drag", c=mine.tolist())]
    for name, values in SURFACE_VALUES.items():
        constants = {"v_s", "p", "g"}
        effects.append(active(name, **{k: v if k in constants else (v * mine).tolist() for k, v in values.items()}))
    world = replace(world_of(cube(side=2, half=0.04)), effects=tuple(effects))
    state = tossed(count)
    height = torch.linspace(0.0, 0.2, count, dtype=F64)[torch.arange(count) * 5 % count]
    return world, replace(state, position_m=state.position_m + torch.stack((0 * height, height, height), -1)[:, None])


@NEEDS_COMPILER
@pytest.mark.skipif(fused_host.PRODUCT_WIDTH() == 0, reason="needs vectors of four numbers")
@pytest.mark.parametrize("case", ["numbers", "effects"])
def test_vectors_of_rollouts_change_no_bit_on_the_cpu(monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    world, state, frames = varied(21) if case == "numbers" else (*unlike(21), times(0.15))
    sorts = []
    monkeypatch.setattr(host, "width", fused_host.PRODUCT_WIDTH)
    monkeypatch.setattr(host, "_order", lambda table: sorts.append(len(table)) or torch.randperm(len(table)).int())
    found = simulate_on_host(world, state, frames)
    assert sorts == [21]
    monkeypatch.setattr(host, "width", lambda: 0)
    same_bits(simulate_on_host(world, state, frames), found)
    assert found.velocity_m_s.isfinite().all()


def test_what_is_worth_a_program_of_vectors() -> None:
    assert host._worth_vectors(8, 16, 1) and not host._worth_vectors(8, 15, 10**6)
    assert host._worth_vectors(0, 100, 1000) and not host._worth_vectors(0, 100, 999)


@NEEDS_COMPILER
def test_flight_alone_is_for_the_kernel_too() -> None:
    world = replace(world_of(box_body()), touching=False, effects=(active("linear_drag", c=0.3),))
    agree(simulate(world, tossed(5), times(0.5)), simulate_on_host(world, tossed(5), times(0.5)), 1e-12)


@pytest.mark.parametrize("tilt", [0.0, pytest.param(0.2, marks=pytest.mark.evidence)])
def test_pulls_of_a_ground_that_is_not_touched(fused: Fused, tilt: float) -> None:
    """Several of them, on bodies whose contacts do not count: in pieces of flight every range is tried at once."""
    pulls = tuple(active("ground_magnet", A=a, l=reach) for a, reach in (([1.0, 5.0], 0.01), (2.0, 0.05), (0.0, 0.1)))
    normal = quat_rotate(quat_exp(torch.tensor([tilt, 0.0, 0.0], dtype=F64)), torch.tensor([0.0, 0, 1], dtype=F64))
    world = replace(world_of(cube(), ball_body()), touching=False, effects=pulls, ground_normal=normal)
    state = flight()[1]
    expected = simulate(world, state, times(0.3))
    agree(expected, fused(world, state, times(0.3)), 1e-9)
    free = simulate(replace(world, effects=()), state, times(0.3))
    assert (free.position_m - expected.position_m).abs().amax((0, 1, 3)).min() > 1e-3


def test_a_compiler_that_fails_leaves_the_torch_engine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "g++"
    broken.write_text("#!/bin/sh\necho 'no room left' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setattr(kernel_build, "compiler", lambda: str(broken))
    monkeypatch.setattr(kernel_build, "host_unavailable", kernel_build.host_unavailable.__wrapped__)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert lacking(world_of(box_body())) == f"the C++ compiler {broken} failed: no room left"


@NEEDS_COMPILER
def test_a_kernel_is_built_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = 'extern "C" int answer() { return 42; }'
    assert kernel_build.host_library(source).answer() == 42
    kept = list((tmp_path / "cgwm" / "kernels").iterdir())
    assert [path.suffix for path in kept] == [".so"]
    monkeypatch.setattr(kernel_build.subprocess, "run", None)
    assert kernel_build.host_library(source).answer() == 42
    (tmp_path / "cgwm" / "kernels").chmod(0o777)
    with pytest.raises(TypeError):  # what others may have written is not loaded
        kernel_build.host_library(source)


@NEEDS_GPU
def test_a_kernel_for_the_gpu_is_built_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = 'extern "C" __global__ void answer(double *to, int k) { to[0] = k; }'
    core, to = kernel_build._core(), torch.zeros(1, dtype=F64, device="cuda")
    for k in (41, 42):
        kernel_build.launch(kernel_build.compiled(source, "answer", 0), to.device, 1, 1, (to,), np.int32(k))
        assert to.item() == k
        assert [path.suffix for path in (tmp_path / "cgwm" / "kernels").iterdir()] == [".cubin"]
        monkeypatch.setattr(core, "Program", None)


def test_which_derivatives_want_the_torch_engine() -> None:
    world, state, driven = crowd()
    commands = {name: Drive.of([track], state.position_m) for name, track in driven.items() if isinstance(track, Track)}
    assert engine.lacking_derivatives(world, state, times(0.1), commands, True) is None
    for number, change in enumerate(("com", "effect", "law", "drive")):
        wanted = batch([0.1, 0.0, 0.0]).requires_grad_()
        value = wanted[:, 0]
        other, given = world, commands
        if change == "com":
            other = world.with_body(0, com=wanted)
        elif change == "effect":
            other = replace(world, effects=(ActiveEffect.of(load_effect("linear_drag"), {"c": value}),))
        elif change == "law":
            other = replace(world, contact=replace(world.contact, friction=value))
        else:
            given = {"pusher": replace(commands["pusher"], position_m=commands["pusher"].position_m + value)}
        arguments = (other, state, times(0.1), given, False)
        assert engine.lacking_derivatives(*arguments) == "derivatives in reverse are asked for", number
        with torch.no_grad():
            assert engine.lacking_derivatives(*arguments) is None

    def rolled(com: Tensor, repeats: int) -> Tensor:
        changed = world.with_body(0, com=com)
        assert engine.lacking_derivatives(changed, state, times(0.1), commands, False) is None
        reason = engine.lacking_derivatives(changed, state, times(0.1), commands, True)
        assert reason == "derivatives of the contact record are asked for"
        return com

    batched_jacobian(rolled, world.bodies[0].com)


@NEEDS_GPU
def test_the_kernel_is_taken_on_cuda(caplog: pytest.LogCaptureFixture) -> None:
    world, state, frames = (on_device(x, "cuda", F64) for x in (world_of(box_body()), tossed(1), times(0.1)))
    with caplog.at_level("INFO", "cgwm"):
        found = engine.rollout(world, state, frames)
        assert torch.equal(found.position_m, simulate_fused(world, state, frames).position_m)
        assert not caplog.records
        both = (active("rolling_resistance"), active("rolling_resistance"))
        rolling = on_device(replace(world_of(box_body()), effects=both), "cuda", F64)
        for _ in range(2):
            agree(simulate(world_of(box_body()), tossed(1), times(0.1)), engine.rollout(rolling, state, frames), 1e-9)
        assert [record.getMessage() for record in caplog.records] == [
            "rollouts run in the torch engine, not in the fused kernel: "
            "the kernel takes one rolling_resistance, and it has several"
        ]


@NEEDS_GPU
def test_rollouts_are_taken_to_the_gpu_and_brought_back() -> None:
    world, state, driven = crowd()
    away = replace(world, rolls_on="cuda")
    expected = simulate(world, state, times(0.2), driven, True)
    found = engine.rollout(away, state, times(0.2), driven, True)
    assert found.position_m.device.type == "cpu" and not torch.equal(found.position_m, expected.position_m)
    agree(expected, found, 1e-9)
    some = engine.rollout(away, state, times(0.2), driven, bodies=(2, 0))
    assert torch.equal(some.position_m, found.position_m[:, :, (2, 0)])
    assert torch.equal(some.omega_body_rad_s, found.omega_body_rad_s[:, :, (2, 0)])

    def ends(z: Tensor, repeats: int, on: World) -> Tensor:
        changed = apply_parameters(on, CONTACT_PARAMETERS, z.exp())
        return engine.rollout(changed, tossed(repeats), times(0.1)).position_m[:, -1].flatten(1)

    start = torch.tensor([[0.3, 0.005, 0.4]], dtype=F64).log()
    here, there = (
        batched_jacobian(lambda z, n, on=on: ends(z, n, on), start)
        for on in (world_of(box_body()), replace(world_of(box_body()), rolls_on="cuda"))
    )
    assert torch.allclose(here[1], there[1], rtol=1e-6, atol=1e-9)


@NEEDS_GPU
def test_refusals_on_cuda() -> None:
    world = on_device(world_of(box_body()), "cuda", F64)
    assert unsupported(world) is None
    assert "several types" in (unsupported(replace(world, gravity=world.gravity.float())) or "")
    half = on_device(world_of(box_body()), "cuda", torch.float16)
    assert "float16" not in (unsupported(half) or "") and "neither float32 nor float64" in (unsupported(half) or "")


def test_threads_of_an_environment() -> None:
    assert lanes_for(8, 4096, single=True, dual=False, paired=False) == 8
    assert lanes_for(8, 65_536, single=True, dual=False, paired=False) == 4
    assert lanes_for(64, 65_536, single=True, dual=False, paired=False) == 8
    assert lanes_for(8, 10**6, single=False, dual=True, paired=False) == 8
    assert lanes_for(500, 1, single=True, dual=False, paired=True) == 32
    assert lanes_for(0, 1, single=True, dual=False, paired=False) == 1
    hands = [lanes_for(1245, count, single=True, dual=False, paired=True, links=17) for count in (1, 4096, 10**6)]
    assert hands == [32, 8, 8]
    assert [lanes_for(40, count, single=True, dual=False, paired=True, links=3) for count in (128, 10**6)] == [32, 1]
