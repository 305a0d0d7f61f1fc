"""The fused kernel against the torch engine for worlds with chains: values and forward derivatives."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.pipeline.optimization.forward_mode import batched_jacobian
from cgwm.pipeline.physics import Body, Rollout, State, World, simulate
from cgwm.pipeline.physics.chains.chain import Chain, Joint
from cgwm.pipeline.physics.chains.joint_command import JointCommand
from cgwm.pipeline.physics.chains.state import with_joints
from cgwm.pipeline.physics.devices import on_device
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.fused import simulate_fused, structure
from cgwm.pipeline.physics.fused.launch import require_room
from cgwm.pipeline.physics.fused.packing import pack, reason_against
from cgwm.pipeline.physics.fused.rollout import roll
from cgwm.pipeline.physics.fused.structure import SHARED_BYTES, Structure, lanes_for
from cgwm.pipeline.physics.hull import Hull
from cgwm.pipeline.physics.kinematic import Drive
from cgwm.pipeline.runtime import kernel_build
from cgwm.schemas import UsageError
from helpers import fixed_surfaces, fused_host
from helpers.chains import chained, double_pendulum, drawer, link, still
from helpers.worlds import F64, ball_body, batch, box_body, plate_body, times

CUDA = torch.cuda.is_available() and kernel_build.available()
NEEDS_GPU = pytest.mark.skipif(not CUDA, reason="needs a CUDA device and cuda.core")
NEEDS_COMPILER = pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")
POSES = ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")

Fused = Callable[..., Rollout]
Case = tuple[World, State, dict[str, Any]]


def on_cuda(
    world: World, state: State, times_s: torch.Tensor, driven: Any, record: bool = False, **more: Any
) -> Rollout:
    driven = {k: on_device(v, "cuda") for k, v in driven.items()}
    return simulate_fused(*(on_device(x, "cuda") for x in (world, state, times_s)), driven, record, **more)


def on_host(*arguments: Any, **more: Any) -> Rollout:
    return roll(fused_host.run, *arguments, **more)


@pytest.fixture(params=[pytest.param(on_host, marks=NEEDS_COMPILER), pytest.param(on_cuda, marks=NEEDS_GPU)])
def fused(request: pytest.FixtureRequest) -> Fused:
    return request.param


def hand(base: str) -> Case:
    """Return two fingers of two joints on a palm that squeeze a ball of many spheres, on the ground or carried.

    One joint has dry friction and one a limit that it reaches; one finger ends in a slide, and a tip and a further part
    without mass are welded on. On a driven palm, a guard on one finger touches the tip of the other one.
    """
    spheres = ((0.05, 0.0, 0.0, 0.012), (0.08, 0.0, 0.0, 0.012))
    names = ("left", "left_tip", "right", "right_tip", "nail", "part")
    bodies: list[Body] = [link("palm", 0.4 if base == "free" else 0.0, spheres=((0.0, 0.0, -0.02, 0.02),))]
    bodies += [link(name, 0.02, com=(0.04, 0, 0), spheres=spheres) for name in names[:4]]
    bodies += [link("nail", 0.02, com=(0.04, 0, 0), spheres=spheres[:1]), link("part", 0.0, spheres=spheres[1:])]
    guard = [link("guard", 0.0, spheres=((0.05, 0.058, 0.03, 0.03),))] if base == "driven" else []
    same: dict[str, Any] = {"damping": 0.02, "armature": 1e-3, "torque_limit": 0.4}
    joints = (
        Joint.of("l1", "hinge", "left", "palm", position_m=(0, 0.05, 0), stiffness=2.0, friction=0.01, **same),
        Joint.of("l2", "slide", "left_tip", "left", position_m=(0.08, 0, 0), axis=(1, 0, 0), stiffness=50.0, **same),
        Joint.of("r1", "hinge", "right", "palm", position_m=(0, -0.05, 0), stiffness=2.0, lower=-0.1, **same),
        Joint.of("r2", "hinge", "right_tip", "right", position_m=(0.08, 0, 0), stiffness=2.0, upper=0.15, **same),
        Joint.of("r3", "fixed", "nail", "right_tip", position_m=(0.02, 0.0, 0.0), quat_wxyz=(0.9, 0.1, 0.2, 0.3)),
        Joint.of("r4", "fixed", "part", "right_tip", position_m=(-0.07, 0.005, 0.0)),
    )
    welded = tuple(Joint.of("r5", "fixed", body.name, "right_tip") for body in guard)
    chain = Chain(
        name="hand", root="palm", base=base, joints=(*joints, *welded),
        touching=tuple(("left_tip", body.name) for body in guard), within=tuple(body.name for body in guard),
    )  # fmt: skip
    turns = torch.linspace(0, 5.5, 8, dtype=F64)
    centers = 0.02 * torch.stack((turns.cos(), turns.sin(), 0.2 * turns.sin()), -1)
    ball = replace(ball_body(0.012, 0.1), centers=centers[None], radii=torch.full((1, 8), 0.012, dtype=F64))
    world = chained(chain, *bodies, *guard, ball, step_s=0.004)
    world = replace(world, ground_offset=batch(-0.04))
    state = still(len(world.bodies))
    state.position_m[:, -1] = torch.tensor([0.1, 0.0, -0.002])
    state.velocity_m_s[:, -1, 1] = 0.1
    state = with_joints(world, state, {"l1": -0.05, "r2": 0.1}, {"r1": 0.3})
    values = torch.tensor([[0.0, 0.0, 0.0, 0.0], [-0.4, 0.01, 0.4, 0.3], [-0.5, -0.01, 0.3, 0.2]], dtype=F64)
    commands: dict[str, Any] = {"hand": JointCommand.targets(batch([0.0, 0.06, 0.1]), values[None], "cubic")}
    if base == "driven":
        samples = torch.linspace(0, 0.2, 5, dtype=F64)[None]
        speed = torch.tensor([[0.0, 0.1, 0.2], [0.1, 0.0, 0.3], [0.0, 0.0, 0.1], [0.0, 0.0, 0.0]], dtype=F64)[None]
        place = (state.position_m[:, 0], state.quat_wxyz[:, 0])
        commands["palm"] = Drive.from_velocities(samples, *place, speed, 2 * speed)
    return world, state, commands


@pytest.mark.parametrize("base", [pytest.param("fixed", marks=pytest.mark.evidence), "driven", "free"])
def test_poses_and_contacts_are_those_of_the_torch_engine(fused: Fused, base: str) -> None:
    world, state, commands = hand(base)
    when = times(0.08, 50.0)
    expected = simulate(world, state, when, commands, record_contacts=True)
    found = fused(world, state, when, commands, True, lanes=1 if base == "free" else None)
    assert expected.contacts is not None and found.contacts is not None
    acted = expected.contacts.impulse_n_s.norm(dim=-1).sum((0, 1)) > 0
    assert len(set(expected.contacts.body_a[acted].tolist())) >= 3  # fingers, ball and ground are in contact
    names = world.body_names
    pairs = {(names[a], names[max(b, 0)]) for a, b in zip(
        expected.contacts.body_a[acted].tolist(), expected.contacts.body_b[acted].tolist(), strict=True)}  # fmt: skip
    assert (("left_tip", "guard") in pairs) == (base == "driven")
    for name in POSES:
        np.testing.assert_allclose(getattr(found, name).cpu(), getattr(expected, name), atol=1e-9, err_msg=name)
    np.testing.assert_allclose(found.contacts.impulse_n_s.cpu(), expected.contacts.impulse_n_s, atol=1e-9)


@pytest.mark.evidence
def test_a_drawer_on_a_shelf_is_pushed_along_its_rail(fused: Fused) -> None:
    world, state, commands = drawer(0.1)
    when = times(0.3, 10.0)
    expected = simulate(world, state, when, commands, record_contacts=True)
    found = fused(world, state, when, commands, True)
    assert expected.contacts is not None and found.contacts is not None
    for name in POSES:
        np.testing.assert_allclose(getattr(found, name).cpu(), getattr(expected, name), atol=1e-9, err_msg=name)
    np.testing.assert_allclose(found.contacts.impulse_n_s.cpu(), expected.contacts.impulse_n_s, atol=1e-9)


def test_derivatives_are_those_of_the_torch_engine(fused: Fused) -> None:
    world, state, commands = hand("free")
    chain = world.chains[0]
    when = times(0.016, 125.0)

    def moved(run: Callable[..., Rollout]) -> Callable[[torch.Tensor, int], torch.Tensor]:
        def final(x: torch.Tensor, _: int) -> torch.Tensor:
            joints = [
                replace(j, stiffness=j.stiffness + x[:, 0], armature=j.armature + 1e-3 * x[:, 1]) for j in chain.joints
            ]
            joints[0] = replace(joints[0], friction=joints[0].friction + 0.01 * x[:, 2])
            changed = replace(world, chains=(replace(chain, joints=tuple(joints)),)).with_body(
                1, mass=0.02 + 0.01 * x[:, 3]
            )
            start = with_joints(changed, state, {"l1": -0.05 + x[:, 4]}, {"r1": 0.3 + x[:, 5]})
            command = commands["hand"]
            shifted = JointCommand(command.times_s, command.coefficients + x[:, 6, None, None, None])
            found = run(changed, start, when, {"hand": shifted})
            return torch.cat([getattr(found, name)[:, -1].flatten(1) for name in POSES], -1)

        return final

    point = torch.zeros(1, 7, dtype=F64)
    value, jacobian = batched_jacobian(moved(simulate), point)
    found, derivative = batched_jacobian(moved(partial(fused, lanes=8)), point)
    np.testing.assert_allclose(found.cpu(), value, atol=1e-10)
    assert (jacobian.abs().amax((0, 1)) > 1e-6).all()
    np.testing.assert_allclose(derivative.cpu(), jacobian, atol=1e-8 * float(jacobian.abs().max()))


def test_effects_act_on_links(fused: Fused) -> None:
    """Values and derivatives by the numbers of the effects; what the kernel lacks is left to the torch engine."""
    chain, bodies = double_pendulum("free", damping=0.01)
    world = chained(chain, *bodies, ground=False, step_s=0.005)
    state = with_joints(world, still(3), {"second": 1.0}, {"first": 4.0, "second": -6.0})
    names = ("linear_drag", "quadratic_drag", "magnus_lift", "spin_damping", "buoyancy", "wind")
    effects = [load_effect(name) for name in names]
    keys = [(effect.name, parameter.name) for effect in effects for parameter in effect.parameters]

    def moved(run: Callable[..., Rollout]) -> Callable[[torch.Tensor, int], torch.Tensor]:
        def final(x: torch.Tensor, _: int) -> torch.Tensor:
            given = dict(zip(keys, (0.5 + x).unbind(-1), strict=True))
            acting = tuple(
                ActiveEffect.of(effect, {p.name: given[effect.name, p.name] for p in effect.parameters})
                for effect in effects
            )
            found = run(replace(world, effects=acting), state, times(0.03, 100.0), {})
            return torch.cat([getattr(found, name)[:, -1].flatten(1) for name in POSES], -1)

        return final

    point = torch.zeros(1, len(keys), dtype=F64)
    value, jacobian = batched_jacobian(moved(simulate), point)
    found, derivative = batched_jacobian(moved(fused), point)
    np.testing.assert_allclose(found.cpu(), value, atol=1e-12)
    assert (jacobian.abs().amax((0, 1)) > 1e-6).all()
    np.testing.assert_allclose(derivative.cpu(), jacobian, atol=1e-9 * float(jacobian.abs().max()))
    magnet = ActiveEffect.of(load_effect("ground_magnet"), {"A": batch(1.0)})
    assert "'ground_magnet' for free bodies only" in str(reason_against(replace(world, effects=(magnet,))))


def test_links_without_mass_have_a_diagonal_admittance(fused: Fused) -> None:
    world, state, commands = hand("fixed")
    bodies = tuple(
        replace(b, mass=0 * b.mass, inertia=0 * b.inertia) if b.motion == "link" else b for b in world.bodies
    )
    world = replace(world, bodies=bodies)
    when = times(0.04, 50.0)
    expected, found = (run(world, state, when, commands) for run in (simulate, fused))
    for name in POSES:
        np.testing.assert_allclose(getattr(found, name).cpu(), getattr(expected, name), atol=1e-9, err_msg=name)


@pytest.mark.evidence
def test_two_chains_touch_each_other(fused: Fused) -> None:
    arms = []
    bodies: list[Body] = []
    for side in (0, 1):
        chain, links = double_pendulum("free" if side else "fixed", damping=0.01, armature=1e-4)
        new = {body.name: f"{body.name}{side}" for body in links}
        joints = tuple(replace(j, name=f"{j.name}{side}", link=new[j.link], parent=new[j.parent]) for j in chain.joints)
        arms.append(replace(chain, name=f"arm{side}", root=new["base"], joints=joints))
        shape = {"centers": batch([[0.05, 0.0, 0.0], [0.1, 0.0, 0.0]]), "radii": batch([0.02, 0.02])}
        bodies += [replace(body, name=new[body.name], **shape) for body in links]
    world = chained(tuple(arms), *bodies, step_s=0.002)
    world = replace(world, ground_offset=batch(-0.25))
    state = still(6)
    state.position_m[:, 3] = torch.tensor([0.03, 0.0, -0.07])
    state = with_joints(world, state, {"second0": 0.8, "second1": 0.5})
    when = times(0.2, 20.0)
    expected, found = (run(world, state, when, {}, True) for run in (simulate, fused))
    assert expected.contacts is not None
    acted = expected.contacts.impulse_n_s.norm(dim=-1).sum((0, 1)) > 0
    assert bool((acted & (expected.contacts.body_b >= 0)).any()) and bool(
        (acted & (expected.contacts.body_b < 0)).any()
    )
    for name in POSES:
        np.testing.assert_allclose(getattr(found, name).cpu(), getattr(expected, name), atol=1e-8, err_msg=name)


def long_chain(links: int) -> Structure:
    """Return the structure of a chain of hinges, one below the other."""
    names = [f"l{k}" for k in range(links)]
    bodies = [link("base", 0.0), *(link(name, 0.02) for name in names)]
    joints = [Joint.of(f"j{k}", "hinge", name, ["base", *names][k]) for k, name in enumerate(names)]
    world = chained(Chain(name="arm", root="base", base="fixed", joints=tuple(joints)), *bodies)
    return pack(world, still(links + 1), times(0.01), {}, False).structure


def boxed(body: Body, half: tuple[float, float, float]) -> Body:
    """Return a body with the hull of a box about its centre of mass."""
    shape = box_body(half)
    centers = shape.centers + body.com[:, None]
    return replace(body, centers=centers, radii=shape.radii, hull=Hull.of(centers[0], shape.radii[0], torch.arange(8)))


def hulled_hand() -> Case:
    """Return the hand on a driven palm, with boxes for links, and a plate on ground and box, which it squeezes."""
    world, state, commands = hand("driven")
    palm, left, left_tip, right, right_tip, *rest, _ = world.bodies
    links = [boxed(body, (0.03, 0.008, 0.012)) for body in (left, left_tip, right, right_tip)]
    plate = plate_body((0.03, 0.025, 0.02), 0.1, points=1)
    shelf = fixed_surfaces.box((0.05, 0.05, 0.01), position=(0.15, 0.0, -0.0502))
    bodies = (boxed(palm, (0.01, 0.04, 0.02)), *links, *rest[:-1], boxed(rest[-1], (0.01, 0.01, 0.03)), plate)
    world = replace(world, bodies=bodies, surfaces=(shelf,))
    state.position_m[:, -1] = torch.tensor([0.1, 0.0, -0.021])
    return world, state, commands


@pytest.mark.evidence
@pytest.mark.parametrize("lanes", [32, 96])
def test_hulls_of_links_touch_in_a_block_of_threads(fused: Fused, lanes: int) -> None:
    """Also what the ground and a fixed surface do to them, by areas, and what labels say of it."""
    world, state, commands = hulled_hand()
    when = times(0.04, 100.0)
    expected = simulate(world, state, when, commands, record_contacts=True)
    found = fused(world, state, when, commands, True, lanes=lanes)
    assert expected.contacts is not None and found.contacts is not None
    acted = expected.contacts.impulse_n_s.norm(dim=-1).sum((0, 1)) > 0
    pairs = zip(expected.contacts.body_a[acted].tolist(), expected.contacts.body_b[acted].tolist(), strict=True)
    assert {(8, -1), (8, -2), (5, 8), (8, 0), (2, 8)} <= set(pairs)  # ground, surface, two links and the palm
    for name in POSES:
        np.testing.assert_allclose(getattr(found, name).cpu(), getattr(expected, name), atol=1e-9, err_msg=name)
    for name in ("impulse_n_s", "distance_m", "normal", "position_m"):
        mine, theirs = getattr(found.contacts, name).cpu(), getattr(expected.contacts, name)
        np.testing.assert_allclose(mine, theirs, atol=1e-9, err_msg=name)


@pytest.mark.evidence
def test_derivatives_of_hulls_of_links_in_a_block_of_threads(fused: Fused) -> None:
    world, state, commands = hulled_hand()

    def moved(run: Callable[..., Rollout]) -> Callable[[torch.Tensor, int], torch.Tensor]:
        def final(x: torch.Tensor, _: int) -> torch.Tensor:
            changed = world.with_body(len(world.bodies) - 1, mass=world.bodies[-1].mass + 0.01 * x[:, 0])
            start = with_joints(changed, state, {"l1": -0.05 + x[:, 1]}, {"r1": 0.3 + x[:, 2]})
            found = run(changed, start, times(0.016, 125.0), commands)
            return torch.cat([getattr(found, name)[:, -1].flatten(1) for name in POSES], -1)

        return final

    point = torch.zeros(1, 3, dtype=F64)
    value, jacobian = batched_jacobian(moved(simulate), point)
    found, derivative = batched_jacobian(moved(partial(fused, lanes=64)), point)
    np.testing.assert_allclose(found.cpu(), value, atol=1e-10)
    assert (jacobian.abs().amax((0, 1)) > 1e-6).all()
    np.testing.assert_allclose(derivative.cpu(), jacobian, atol=1e-8 * float(jacobian.abs().max()))


@pytest.mark.evidence
def test_contacts_without_room_are_counted_and_refused(fused: Fused, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structure, "CROWDS", (6,))
    world, state, commands = hulled_hand()
    with pytest.raises(UsageError, match=r"(?s)more contacts at once than 6.* in 1 of 1 rollouts.*--device cpu"):
        fused(world, state, times(0.04, 100.0), commands, lanes=32)


def test_a_block_has_room_for_as_many_contacts_as_its_memory_holds() -> None:
    world, state, commands = hulled_hand()
    hand = replace(pack(world, state, times(0.01), commands, False).structure, pairs=((1, 2, 144),) * 90)
    most = 227 << 10
    some, few = (replace(hand, lanes=32, crowd=crowd).block_bytes for crowd in (256, 128))
    rooms = ((8, most), (256, most), (256, some), (256, few), (256, 8 << 10))
    found = [hand.on_lanes(lanes, room) for lanes, room in rooms]
    assert [each.crowd for each in found] == [256, 256, 256, 128, 0]
    assert [each.threads for each in found[:2]] == [32, 256] and 32 <= found[2].threads < 256 > found[3].threads
    with pytest.raises(UsageError, match=r"(?s)may have 12960 contacts at once.*--device cpu"):
        require_room(found[4])


def door() -> Case:
    """Return a leaf with the hull of a box on a hinge with losses, which touches nothing."""
    hinge = Joint.of("hinge", "hinge", "leaf", "frame", axis=(0, 1, 0), damping=1e-3, friction=1e-3)
    leaf = boxed(link("leaf", 0.2, com=(0.1, 0, 0)), (0.1, 0.05, 0.01))
    world = chained(
        Chain(name="door", root="frame", base="fixed", joints=(hinge,)), link("frame", 0.0), leaf, ground=False
    )
    return world, with_joints(world, still(2), {"hinge": 0.2}, {"hinge": 1.0}), {}


def test_hulls_that_touch_nothing_have_room_for_a_contact() -> None:
    """Kernels of a GPU have no empty arrays."""
    world, state, _ = door()
    alone = pack(world, state, times(0.01), {}, False).structure
    assert alone.hulled and alone.contacts == 0 and alone.on_lanes(32).crowd == 1


@NEEDS_GPU
def test_hulls_that_touch_nothing_swing_on_a_gpu() -> None:
    world, state, _ = door()
    when = times(0.4, 20.0)
    expected, found = simulate(world, state, when), on_cuda(world, state, when, {}, lanes=32)
    for name in POSES:
        np.testing.assert_allclose(getattr(found, name).cpu(), getattr(expected, name), atol=1e-9, err_msg=name)


def test_environments_of_a_block_are_as_many_as_its_memory_holds() -> None:
    short, middle, endless = (long_chain(links) for links in (3, 10, 150))
    assert [short.on_lanes(lanes).lanes for lanes in (1, 4, 32)] == [1, 4, 32]
    assert [middle.on_lanes(lanes).lanes for lanes in (1, 4, 32)] == [1, 8, 32]
    assert middle.on_lanes(4).block_bytes <= SHARED_BYTES < 8 * middle.on_lanes(4).shared_bytes
    assert endless.on_lanes(32).lanes == 1 and not endless.on_lanes(32).shared


def test_a_hand_of_160_spheres_and_two_objects_of_250_stay_in_the_kernel() -> None:
    names = [f"f{k}" for k in range(16)]
    row = tuple((0.001 * k, 0.0, 0.0, 0.01) for k in range(10))
    bodies = [link("palm", 0.0), *(link(name, spheres=row) for name in names)]
    joints = tuple(
        Joint.of(f"j{k}", "hinge", name, "palm" if k % 4 == 0 else names[k - 1]) for k, name in enumerate(names)
    )
    objects = [replace(ball_body(0.01, name=name, copies=250)) for name in ("one", "two")]
    world = chained(Chain(name="hand", root="palm", base="fixed", joints=joints), *bodies, *objects)
    assert reason_against(world) is None


@pytest.mark.parametrize("kind", ["fixed", "hinge", "slide"])
def test_a_row_of_the_table_is_as_wide_as_the_kernel_reads(kind: str) -> None:
    """Also of a chain of which no joint moves."""
    joints = (Joint.of("a", kind, "one", "base"), Joint.of("b", "fixed", "two", "one"))
    chain = Chain(name="arm", root="base", base="driven", joints=joints)
    world = chained(chain, link("base", 0.0), link("one", 0.1), link("two", 0.1), ball_body(0.02))
    path = Drive.from_velocities(
        batch([0.0, 0.1]), torch.zeros(1, 3, dtype=F64), batch([1.0, 0.0, 0.0, 0.0]), torch.zeros(1, 1, 3, dtype=F64),
        torch.zeros(1, 1, 3, dtype=F64),
    )  # fmt: skip
    packed = pack(world, still(4), times(0.01), {"base": path}, False)
    assert packed.table.shape[-1] == packed.structure.table_width


SIZES = {
    "of 4 threads": {"lanes": 4},
    "of a warp": {"lanes": 32},
    "with derivatives": {"lanes": 32, "dual": True},
    "of float32": {"lanes": 32, "single": True},
}


@pytest.mark.parametrize(
    ("name", "environment", "block"),
    [
        ("three links", [4286, 13470, 26214, 7098], [34587, 13769, 26513, 7397]),
        ("ten links", [10863, 19791, 38751, 10311], [87868, 20755, 39715, 11275]),
        ("hand with hulls", [24714, 25122, 46314, 14074], [25408, 25816, 47008, 14768]),
    ],
)
def test_environments_take_no_more_memory_than_when_it_was_last_counted(
    name: str, environment: list[int], block: list[int]
) -> None:
    """The bounds hold by `check_memory` of the host kernel; larger ones would leave room for fewer environments."""
    if name == "hand with hulls":
        world, state, commands = hulled_hand()
        one = replace(pack(world, state, times(0.1), commands, False).structure, crowd=64)
    else:
        one = long_chain(3 if name == "three links" else 10)
    every = [replace(one, **change) for change in SIZES.values()]
    assert [each.shared_bytes for each in every] == environment
    assert [each.block_bytes for each in every] == block


def test_threads_carry_motion_impulses_and_joints_and_list_their_contacts() -> None:
    arm, (world, state, commands) = long_chain(3), hulled_hand()
    hand = replace(pack(world, state, times(0.1), commands, False).structure, lanes=32, crowd=64)
    assert arm.carried_width == 1 + 4 * 13 + 3 + 1 + 5 * 3  # four bodies, one contact, three joints
    assert hand.carried_width == 1 + len(world.bodies) * 13 + 4 * 64 + 1 + 5 * sum(len(c.moving) for c in world.chains)
    assert (replace(arm, lanes=4).carried_rows, hand.carried_rows) == (4, 1)
    many = replace(arm, pairs=((1, -1, 33),), lanes=4)
    assert (many.slots, many.contact_bytes, replace(many, single=True).contact_bytes) == (9, 16 * 8 * 9, 16 * 4 * 9)
    assert not long_chain(3)._long_lists() and set(long_chain(9)._long_lists()) >= {"is_free_of", "sphere_count_of"}
    assert {len(values) for values in long_chain(9)._long_lists().values()} == {10}


@pytest.mark.parametrize(
    ("contacts", "environments", "links", "lanes"),
    [
        (0, 1, 0, 1), (8, 1, 0, 8), (9, 1, 0, 16), (100, 1, 0, 32), (8, 10**6, 0, 2), (40, 10**6, 0, 16),
        (40, 1, 8, 32), (40, 10**6, 8, 4), (40, 10**6, 40, 8), (2, 10**6, 2, 1), (2, 1, 3, 2),
    ],
)  # fmt: skip
def test_environments_share_threads_by_their_contacts_and_number(
    contacts: int, environments: int, links: int, lanes: int
) -> None:
    assert lanes_for(contacts, environments, single=False, dual=False, paired=False, links=links) == lanes
