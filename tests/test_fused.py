"""The fused kernel against the torch engine: on a GPU where there is one, and built for the CPU by g++."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import fused_host
import numpy as np
import pytest
import torch
from cgwm.datasets.tracks import Track
from cgwm.pipeline import nvrtc
from cgwm.pipeline.estimation.forward import batched_jacobian
from cgwm.pipeline.physics import Body, ContactLaw, Rollout, State, World, simulate
from cgwm.pipeline.physics.distance import plane_contacts
from cgwm.pipeline.physics.driven import Drive
from cgwm.pipeline.physics.fused import simulate_fused, unsupported
from cgwm.pipeline.physics.fused.rollout import roll
from cgwm.pipeline.physics.fused.structure import lanes_for
from cgwm.pipeline.physics.motion import Inertia, advance, finish, start
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, GROUND_SHIFT, apply_parameters
from cgwm.pipeline.physics.rotation import cross, quat_exp, quat_multiply, quat_rotate, quat_to_matrix
from cgwm.schemas import InputDataError, UsageError
from torch import Tensor
from worlds import F64, ball_body, batch, box_body, state_of, times, world_of

CUDA = torch.cuda.is_available() and nvrtc.available()
NEEDS_GPU = pytest.mark.skipif(not CUDA, reason="needs a CUDA device and cuda.core")
NEEDS_COMPILER = pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")
POSES = ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")
CONTACTS = ("impulse_n_s", "position_m", "normal", "distance_m")
UPRIGHT = (1.0, 0.0, 0.0, 0.0)

Fused = Callable[..., Rollout]


def on(device: str, dtype: torch.dtype, value: Any) -> Any:
    """Return a world, a state, a command or a tensor on a device, in a precision."""
    if isinstance(value, Tensor):
        return value.to(device, dtype) if value.is_floating_point() else value.to(device)
    if isinstance(value, World):
        value = replace(value, bodies=tuple(on(device, dtype, body) for body in value.bodies))
    if isinstance(value, World | Body | State | Drive | ContactLaw):
        fields = {name: getattr(value, name) for name in value.__dataclass_fields__}
        moved = {k: on(device, dtype, v) for k, v in fields.items() if isinstance(v, Tensor | ContactLaw)}
        return replace(value, **moved)
    return {k: on(device, dtype, v) for k, v in value.items()} if isinstance(value, dict) else value


def on_cuda(
    world: World, state: State, times_s: Tensor, driven: Any = None, record: bool = False, **more: Any
) -> Rollout:
    """Return the rollout of the GPU."""
    dtype = world.gravity.dtype
    more = {name: on("cuda", dtype, value) for name, value in more.items()}
    driven = {k: on("cuda", dtype, v) for k, v in (driven or {}).items()}
    return simulate_fused(*(on("cuda", dtype, x) for x in (world, state, times_s)), driven, record, **more)


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


def tossed(count: int = 3, height: float = 0.08) -> State:
    """Return boxes that tumble onto the ground, each another way."""
    generator = torch.Generator().manual_seed(5)
    state = state_of(((0, 0, height), (1, 0.3, 0.2, 0.1), (0.5, 0.2, -0.3), (3, 5, -2)), count=count)
    noise = torch.randn(count, 1, 3, generator=generator, dtype=F64)
    return replace(state, omega_body_rad_s=state.omega_body_rad_s + noise)


@pytest.mark.parametrize("lanes", [1, 2, 8, 32])
def test_a_tumbling_box(fused: Fused, lanes: int) -> None:
    world, state = world_of(box_body()), tossed()
    expected = simulate(world, state, times(0.3), record_contacts=True)
    assert expected.contacts is not None and expected.contacts.sliding.any() and not expected.contacts.sliding.all()
    agree(expected, fused(world, state, times(0.3), None, True, lanes=lanes), 1e-9)


@pytest.mark.parametrize("lanes", [1, 8, None])
def test_a_cube_of_64_spheres_with_a_shifted_mass(fused: Fused, lanes: int | None) -> None:
    body = replace(cube(), com=batch([0.004, -0.003, 0.006]))
    assert body.on_plane is not None and len(body.on_plane) == 8
    world, state = world_of(body, step_s=0.002), tossed(2)
    agree(
        simulate(world, state, times(0.3), None, True), fused(world, state, times(0.3), None, True, lanes=lanes), 1e-9
    )


def test_many_spheres_on_the_plane(fused: Fused) -> None:
    """More contacts than a thread has room for in registers, and without a choice of those that touch."""
    world, state = world_of(replace(cube(), on_plane=None)), tossed(2)
    agree(simulate(world, state, times(0.2), None, True), fused(world, state, times(0.2), None, True, lanes=2), 1e-9)


def crowd() -> tuple[World, State, dict[str, Track | Drive]]:
    """Return two free bodies, a pusher that turns, and a fixed ball, all of which touch others within 0.16 s."""
    pusher = replace(ball_body(0.02, name="pusher", copies=3), motion="driven")
    pusher = replace(pusher, centers=batch([[0.0, -0.02, 0.0], [0.0, 0.0, 0.0], [0.0, 0.015, 0.005]]))
    post = replace(ball_body(0.03, name="post"), motion="fixed")
    top = replace(box_body((0.03, 0.03, 0.02), 0.15, 0.004), name="top", com=batch([0.002, 0.0, -0.001]))
    world = world_of(cube(3), top, pusher, post)
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


@pytest.mark.parametrize("lanes", [1, 4, None])
def test_bodies_that_touch_each_other(fused: Fused, lanes: int | None) -> None:
    world, state, driven = crowd()
    like = state.position_m
    driven = {name: Drive.of([track], like) for name, track in driven.items() if isinstance(track, Track)}
    state.position_m[1, 1, 0] += 0.004
    expected = simulate(world, state, times(0.16), driven, True)
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
    short = Track(track.time_s[1:3], track.position_m[1:3], track.quat_wxyz[1:3])
    commands = {"pusher": Drive.of([track, short], state.position_m)}
    agree(simulate(world, state, times(0.2), commands), fused(world, state, times(0.2), commands, lanes=4), 1e-9)


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
    for n in (normal / normal.norm(), torch.tensor([0.0, 0.0, -1.0], dtype=F64)):
        world, state, driven = crowd()
        world = replace(
            world, ground_normal=n, ground_offset=batch(-0.1), gravity=batch([0.5, 0.0, -9.0 * float(n[2])])
        )
        agree(simulate(world, state, times(0.15), driven, True), fused(world, state, times(0.15), driven, True), 1e-9)


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
    world = replace(world_of(box_body()), sweeps=1)
    agree(simulate(world, state, times(0.05)), fused(world, state, times(0.05)), 1e-9)


def test_single_precision(fused: Fused) -> None:
    """Rounding: over an impact both are as far from double precision, and nearer to each other."""
    world, state = world_of(cube(), step_s=0.002), tossed(4, 0.075)
    exact = simulate(world, state, times(0.1), None, True)
    assert exact.contacts is not None and exact.contacts.impulse_n_s.abs().amax() > 0
    single = [on("cpu", torch.float32, x) for x in (world, state, times(0.1))]
    theirs, ours = simulate(*single), fused(*single, lanes=2)
    for name, scale in zip(POSES, (0.1, 1.0, 1.0, 10.0), strict=True):
        truth, mine, its = (getattr(rollout, name).cpu() for rollout in (exact, ours, theirs))
        assert (mine - its).abs().amax() / scale < 3e-5, name
        assert (mine - truth).abs().amax() < 2 * (its - truth).abs().amax() + 1e-6 * scale, name


def test_single_precision_of_a_fast_spin(fused: Fused) -> None:
    """Beyond the angles of a step for which the kernel's rotation is a series."""
    state = tossed(2, 1.0)
    state = replace(state, omega_body_rad_s=state.omega_body_rad_s * 200)
    single = [on("cpu", torch.float32, x) for x in (world_of(box_body(), step_s=0.002), state, times(0.02))]
    mine, its = fused(*single), simulate(*single)
    assert (mine.omega_body_rad_s * 0.002).norm(dim=-1).amin() > 1
    torch.testing.assert_close(mine.quat_wxyz.cpu(), its.quat_wxyz, rtol=0, atol=1e-4)


def of_parameters(engine: Any, world: World, frames: Tensor, driven: Any = None) -> Callable[[Tensor, int], Tensor]:
    """Return the rollout as a function of 12 numbers of the state, the contact, the ground, and the centre of mass."""
    names = [replace(GROUND_SHIFT, name=f"{world.bodies[0].name}.com_{axis}_m") for axis in "xyz"]
    named = (*CONTACT_PARAMETERS, GROUND_SHIFT, *names)

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
    inputs = torch.tensor([[*first, 0.3, 0.004, 0.4, 0.001, 0.002, -0.001, 0.003]], dtype=F64)
    inputs = inputs * (1 + spread * torch.arange(1 if driven else 2, dtype=F64)[:, None])
    value, jacobian = batched_jacobian(of_parameters(simulate, world, frames, driven), inputs)
    mine, its = batched_jacobian(of_parameters(fused, world, frames, driven), inputs)
    assert jacobian.abs().amax((0, 1)).min() > 1e-4  # every parameter acts
    torch.testing.assert_close(mine.cpu(), value, rtol=1e-9, atol=1e-9)
    scale = jacobian.abs().amax((0, 1))
    torch.testing.assert_close(its.cpu() / scale, jacobian / scale, rtol=1e-7, atol=1e-7)


def test_derivatives_of_a_toss(fused: Fused) -> None:
    first = [0, 0, 0.065, 0.1, 0.2, 0.1, 0.5, 0.2, -0.3, 3, 5, -2]
    agree_with_derivatives(fused, world_of(box_body()), first, times(0.2), None, 0.02)


def test_derivatives_of_bodies_that_touch(fused: Fused) -> None:
    world, _, driven = crowd()
    first = [0, 0, 0.053, 0.01, 0.02, 0.01, 0.05, 0.02, -0.1, 0.3, 0.5, -0.2]
    agree_with_derivatives(fused, world, first, times(0.08), driven, 0.0)


def coefficients() -> dict[str, Tensor]:
    """Return every wrench of two bodies, of which the second takes other values."""
    given = {
        "linear_drag": [0.4, 0.1], "quadratic_drag": [0.7, 0.2], "magnus": [0.02, -0.01], "spin_damping": [0.8, 0.3],
        "acceleration": [[0.3, -0.2, 0.5], [0.0, 0.1, 0.0]], "wind": [[1.0, -2.0], [0.5, 0.5]], "magnet": [4.0, 1.0],
        "magnet_range": [0.3, 0.2],
    }  # fmt: skip
    return {name: batch(value) for name, value in given.items()}


def flown(world: World, state: State, times_s: Tensor, wrenches: dict[str, Tensor]) -> list[Tensor]:
    """Return the last frame of bodies in flight (B, bodies, 13), written down anew from the formulas."""
    h, steps = torch.full((1,), world.step_s, dtype=F64), round(float(times_s[-1]) / world.step_s)
    rows = []
    for index, body in enumerate(world.bodies):
        inertia = Inertia.of(body)
        w = {name: value[:, index] for name, value in wrenches.items()}
        motion = start(body, *(getattr(state, name)[:, index] for name in POSES))
        wind = torch.cat((w["wind"], torch.zeros_like(w["wind"][:, :1])), -1)
        for _ in range(steps):
            rotation = quat_to_matrix(motion.quat_wxyz)
            omega = (rotation @ inertia.inverse @ rotation.transpose(-1, -2) @ motion.spin[..., None]).squeeze(-1)
            u = motion.velocity - wind
            drag = w["linear_drag"] + w["quadratic_drag"] * u.norm(dim=-1)
            acceleration = world.gravity + w["acceleration"] - drag[:, None] * u
            acceleration = acceleration + w["magnus"][:, None] * cross(omega, motion.velocity)
            assert world.ground_offset is not None and world.ground_normal is not None
            height = motion.com @ world.ground_normal - world.ground_offset
            pull = w["magnet"] * torch.exp(-height / w["magnet_range"])
            velocity = motion.velocity + h * (acceleration - pull[:, None] * world.ground_normal)
            spin = motion.spin * (1 - h * w["spin_damping"])[:, None]
            motion = advance(inertia, motion, velocity, spin, h)
        rows.append(finish(body, inertia, motion))
    return [torch.stack([row[k] for row in rows], 1) for k in range(4)]


def flight() -> tuple[World, State]:
    world = world_of(replace(box_body(), com=batch([0.003, 0.001, -0.002])), ball_body())
    state = state_of(
        ((0, 0, 1), (1, 0.3, 0.2, 0.1), (2, 1, 0.5), (3, 5, -2)), ((1, 0, 1.2), UPRIGHT, (1, -1, 0.1), (9, 2, 3))
    )
    return world, state


@pytest.mark.parametrize("tilted", [False, True])
def test_wrenches_in_flight(fused: Fused, tilted: bool) -> None:
    world, state = flight()
    if tilted:
        turn = quat_exp(torch.tensor([0.4, -0.3, 0.0], dtype=F64))
        world = replace(world, ground_normal=quat_rotate(turn, torch.tensor([0.0, 0, 1], dtype=F64)))
    found = fused(world, state, times(0.2), wrenches=coefficients())
    without = fused(world, state, times(0.2))
    for name, expected in zip(POSES, flown(world, state, times(0.2), coefficients()), strict=True):
        torch.testing.assert_close(getattr(found, name)[:, -1].cpu(), expected, rtol=1e-11, atol=1e-11)
        assert (getattr(without, name)[:, -1].cpu() - expected).abs().max() > 1e-3


def test_derivatives_of_wrenches(fused: Fused) -> None:
    world, state = flight()
    given = coefficients()
    inputs = torch.cat([value.flatten(1) for value in given.values()], 1)

    def function(engine: Any) -> Callable[[Tensor, int], Tensor]:
        def rolled(values: Tensor, repeats: int) -> Tensor:
            parts = values.split([value.numel() for value in given.values()], 1)
            shaped = {k: part.unflatten(1, v.shape[1:]) for (k, v), part in zip(given.items(), parts, strict=True)}
            return torch.cat([x.flatten(1) for x in engine(shaped)], 1)

        return rolled

    def mine(shaped: dict[str, Tensor]) -> list[Tensor]:
        rollout = fused(world, state, times(0.1), wrenches=shaped)
        return [getattr(rollout, name)[:, -1] for name in POSES]

    value, jacobian = batched_jacobian(function(lambda shaped: flown(world, state, times(0.1), shaped)), inputs)
    found, its = batched_jacobian(function(mine), inputs)
    torch.testing.assert_close(found.cpu(), value, rtol=1e-11, atol=1e-11)
    assert jacobian.abs().amax((0, 1)).min() > 1e-5
    torch.testing.assert_close(its.cpu(), jacobian, rtol=1e-9, atol=1e-11)


@NEEDS_COMPILER
def test_refusals() -> None:
    world, state = world_of(box_body()), tossed(1)
    assert "'cpu'" in (unsupported(world) or "")
    with pytest.raises(UsageError, match=r"cannot take this world.*'cpu'.*\nNext: use simulate"):
        simulate_fused(world, state, times(0.1))
    with pytest.raises(UsageError, match="no reverse derivatives"):
        on_host(world, replace(state, position_m=state.position_m.requires_grad_()), times(0.1))
    with pytest.raises(UsageError, match=r"several kinds: torch.float32 on cpu, torch.float64 on cpu"):
        on_host(on("cpu", torch.float32, world), tossed(1), times(0.1))
    with torch.no_grad():
        assert not on_host(world, state, times(0.01)).position_m.requires_grad
    with pytest.raises(InputDataError, match="the driven body 'pusher' has no track"):
        on_host(*crowd()[:2], times(0.1))
    with pytest.raises(UsageError, match=r"no wrench 'linear_drga'. Did you mean 'linear_drag'"):
        on_host(world, tossed(1), times(0.1), wrenches={"linear_drga": batch([1.0])})
    with pytest.raises(UsageError, match=r"the wrench 'wind' has the shape \(1, 1\).\nAllowed: \(B, 1, 2\)"):
        on_host(world, tossed(1), times(0.1), wrenches={"wind": batch([1.0])})
    body = world.bodies[0]

    def recorded(com: Tensor, repeats: int) -> Tensor:
        return on_host(world.with_body(0, com=com), state, times(0.1), None, True).position_m.flatten(1)

    with pytest.raises(UsageError, match="no derivatives of the contact record"):
        batched_jacobian(recorded, body.com)


@NEEDS_GPU
def test_refusals_on_cuda() -> None:
    world = on("cuda", F64, world_of(box_body()))
    assert unsupported(world) is None
    assert "several types" in (unsupported(replace(world, gravity=world.gravity.float())) or "")
    half = on("cuda", torch.float16, world_of(box_body()))
    assert "float16" not in (unsupported(half) or "") and "neither float32 nor float64" in (unsupported(half) or "")


def test_threads_of_an_environment() -> None:
    assert lanes_for(8, 4096, single=True, dual=False, paired=False) == 8
    assert lanes_for(8, 65_536, single=True, dual=False, paired=False) == 1
    assert lanes_for(64, 65_536, single=True, dual=False, paired=False) == 8
    assert lanes_for(8, 10**6, single=False, dual=True, paired=False) == 8
    assert lanes_for(500, 1, single=True, dual=False, paired=True) == 32
    assert lanes_for(0, 1, single=True, dual=False, paired=False) == 1
