"""Laws of jointed bodies: kinematics and equations of motion of MuJoCo, energy, momentum, servos, limits, friction."""

import math
from collections.abc import Mapping
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from cgwm.pipeline.geometry.rotation import cross, quat_multiply, quat_rotate
from cgwm.pipeline.optimization.forward_mode import batched_jacobian
from cgwm.pipeline.physics import Body, State, World, simulate
from cgwm.pipeline.physics.chains.chain import Chain, Joint
from cgwm.pipeline.physics.chains.dynamics import ChainDynamics, ChainMotion, _Place
from cgwm.pipeline.physics.chains.joint_command import JointCommand
from cgwm.pipeline.physics.chains.parameters import chain_parameters
from cgwm.pipeline.physics.chains.state import joints_of, on_joints, require_chains, with_joints
from cgwm.pipeline.physics.chains.values import with_chain_values
from cgwm.pipeline.physics.devices import on_device
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.fused.tree import _link_columns
from cgwm.schemas import InputDataError, UsageError
from helpers.chains import chained, double_pendulum, drawer, link, still
from helpers.worlds import F64, ball_body, batch, times

POSES = ("position_m", "quat_wxyz", "velocity_m_s", "omega_body_rad_s")


def words(numbers: list[float]) -> str:
    return " ".join(map(repr, numbers))


def tree(base: str, generator: torch.Generator) -> tuple[Chain, list[Body], str]:
    """Return a random tree of five links with a slide and a fixed joint, and the same in MJCF."""

    def numbers(count: int) -> list[float]:
        return torch.randn(count, generator=generator, dtype=F64).tolist()

    parents, kinds = (0, 1, 1, 3), ("hinge", "slide", "fixed", "hinge")
    bodies, joints, xml = [], [], ["" for _ in range(5)]
    for k in range(5):
        mass, com = 0.2 + 0.1 * k, [0.05 * x for x in numbers(3)]
        squares = [0.01 + 0.02 * abs(x) for x in numbers(3)]
        moments = [mass * (squares[1] + squares[2]), mass * (squares[0] + squares[2]), mass * (squares[0] + squares[1])]
        bodies.append(replace(link(f"l{k}", mass, com=tuple(com)), inertia=batch(np.diag(moments))))
        inertial = f'<inertial pos="{words(com)}" mass="{mass!r}" diaginertia="{words(moments)}"/>'
        if k == 0:
            joint = "<freejoint/>" if base == "free" else ""
            xml[0] = f'<body name="l0">{joint}{inertial}'
            continue
        place, axis, quat = [0.1 * x for x in numbers(3)], numbers(3), numbers(4)
        quat = [x / math.hypot(*quat) for x in quat]
        joints.append(
            Joint.of(
                f"j{k}", kinds[k - 1], f"l{k}", f"l{parents[k - 1]}",
                position_m=place, quat_wxyz=quat, axis=axis, armature=0.01 * k,
            )
        )  # fmt: skip
        kind = kinds[k - 1]
        moving = f'<joint name="j{k}" type="{kind}" axis="{words(axis)}" armature="{0.01 * k!r}"/>'
        xml[k] = (
            f'<body name="l{k}" pos="{words(place)}" quat="{words(quat)}">{moving if kind != "fixed" else ""}{inertial}'
        )
    nested = f"{xml[0]}{xml[1]}{xml[2]}</body>{xml[3]}{xml[4]}</body></body></body></body>"
    chain = Chain(name="tree", root="l0", base=base, joints=tuple(joints))
    head = '<mujoco><compiler angle="radian" fusestatic="false"/><option gravity="0.3 -0.7 -9.81"/><worldbody>'
    return chain, bodies, f"{head}{nested}</worldbody></mujoco>"


@pytest.mark.parametrize("base", ["fixed", "free"])
def test_poses_mass_matrix_and_forces_are_those_of_mujoco(base: str) -> None:
    generator = torch.Generator().manual_seed(3)
    chain, bodies, xml = tree(base, generator)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    dynamics = ChainDynamics(chain, bodies)
    for _ in range(5):
        values, speeds = torch.randn(2, 1, 3, generator=generator, dtype=F64)
        position, velocity, spin = torch.randn(3, 1, 3, generator=generator, dtype=F64)
        quat = torch.nn.functional.normalize(torch.randn(1, 4, generator=generator, dtype=F64))
        if base == "fixed":
            position, velocity, spin = (torch.zeros(1, 3, dtype=F64) for _ in range(3))
            quat = batch([1.0, 0.0, 0.0, 0.0])
        else:
            data.qpos[:7], data.qvel[:3] = torch.cat((position, quat), -1)[0], velocity[0]
            data.qvel[3:6] = quat_rotate(quat * torch.tensor([1.0, -1, -1, -1]), spin)[0]  # MuJoCo: body axes
        data.qpos[-3:], data.qvel[-3:] = values[0], speeds[0]
        mujoco.mj_forward(model, data)
        motion = ChainMotion(position, quat, velocity, spin, values, speeds)
        links = dynamics.links(motion)
        for k, moved in enumerate(links):
            body = data.body(f"l{k}")
            np.testing.assert_allclose(moved.com[0], body.xpos, atol=1e-12)
            np.testing.assert_allclose(
                moved.quat_wxyz[0] * torch.sign(moved.quat_wxyz[0, 0] * body.xquat[0]), body.xquat, atol=1e-12
            )
            found = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body.id, found, 0)
            np.testing.assert_allclose(torch.cat((moved.spin, moved.velocity), -1)[0], found, atol=1e-11)
        turn = np.eye(model.nv)  # from our generalised velocity to MuJoCo's
        place = _Place.of(dynamics, motion)
        mass = place.mass_matrix()[0].numpy() + np.diag([0.0] * dynamics.base_size + [0.01, 0.02, 0.04])
        bias = place.bias(motion, batch([0.3, -0.7, -9.81]), None)[0].numpy()
        if base == "free":
            turn[3:6, 3:6] = data.body("l0").xmat.reshape(3, 3).T
        theirs = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, theirs)
        np.testing.assert_allclose(mass, turn.T @ theirs @ turn, atol=1e-12)
        np.testing.assert_allclose(bias, turn.T @ data.qfrc_bias, atol=1e-11)


@pytest.mark.parametrize("inference", [False, True])  # as a fit, in which tensors have no versions
def test_values_are_read_from_poses_and_written_into_them(inference: bool) -> None:
    with torch.inference_mode(inference):
        chain, bodies, _ = tree("free", torch.Generator().manual_seed(5))
        world = chained(chain, *bodies, ground=False)
        given, speeds = {"j1": 2.0, "j2": -0.2, "j4": -3.0}, {"j1": 0.5, "j2": 0.3, "j4": -0.7}
        state = with_joints(world, still(5), given, speeds)
        values, rates = joints_of(world, state, chain)
        np.testing.assert_allclose(values[0], list(given.values()), atol=1e-14)
        np.testing.assert_allclose(rates[0], list(speeds.values()), atol=1e-14)
        around = replace(
            chain, joints=(replace(chain.joints[0], lower=batch(2.5), upper=batch(6.5)), *chain.joints[1:])
        )
        turned = with_joints(replace(world, chains=(around,)), still(5), {"j1": 6.0})
        np.testing.assert_allclose(joints_of(world, turned, around)[0][0, 0], 6.0, atol=1e-14)


def test_a_floating_chain_keeps_its_momentum_and_its_energy() -> None:
    chain, bodies = double_pendulum("free")
    world = chained(chain, *bodies, ground=False, gravity=0.0, step_s=0.002)
    state = with_joints(world, still(3), {"second": 1.0}, {"first": 4.0, "second": -6.0})
    found = rollout(world, state, times(0.4, 10.0))
    mass = torch.cat([body.mass for body in bodies])[:, None]
    com = torch.stack([body.com[0] for body in bodies])
    inertia = torch.stack([body.inertia[0] for body in bodies])
    arm = quat_rotate(found.quat_wxyz, com)
    place, omega = found.position_m + arm, quat_rotate(found.quat_wxyz, found.omega_body_rad_s)
    velocity = found.velocity_m_s + cross(omega, arm)
    linear = (mass * velocity).sum(2)[0]
    own = quat_rotate(found.quat_wxyz, (inertia @ found.omega_body_rad_s[..., None]).squeeze(-1))
    angular = (mass * cross(place, velocity) + own).sum(2)[0]
    energy = 0.5 * (mass * velocity.square()).sum((2, 3)) + 0.5 * (
        found.omega_body_rad_s * (inertia @ found.omega_body_rad_s[..., None]).squeeze(-1)
    ).sum((2, 3))
    assert linear[0].norm() > 0.01
    np.testing.assert_allclose(linear, linear[:1].expand_as(linear), atol=1e-4 * float(linear[0].norm()))
    np.testing.assert_allclose(angular, angular[:1].expand_as(angular), atol=2e-4 * float(angular[0].norm()))
    np.testing.assert_allclose(energy[0], float(energy[0, 0]) * np.ones(5), rtol=2e-4)


def test_drag_takes_the_momentum_of_a_chain_and_a_damped_spin_its_moment() -> None:
    chain, bodies = double_pendulum("free")
    effects = [("linear_drag", {"c": 2.0}), ("wind", {"w_x": 0.5, "w_y": 0.0}), ("spin_damping", {"d": 2.0})]
    acting = tuple(ActiveEffect.of(load_effect(name), values) for name, values in effects)
    world = replace(chained(chain, *bodies, ground=False, gravity=0.0, step_s=0.002), effects=acting)
    state = with_joints(world, still(3), {"second": 1.0}, {"first": 4.0, "second": -6.0})
    found = rollout(world, state, times(0.2, 10.0))
    mass = torch.cat([body.mass for body in bodies])[:, None]
    inertia = torch.stack([body.inertia[0] for body in bodies])
    arm = quat_rotate(found.quat_wxyz, torch.stack([body.com[0] for body in bodies]))
    velocity = found.velocity_m_s + cross(quat_rotate(found.quat_wxyz, found.omega_body_rad_s), arm)
    linear = (mass * velocity).sum(2)[0]
    blown = torch.tensor([0.5, 0.0, 0.0], dtype=F64) * mass.sum()
    left = blown + math.exp(-2.0 * 0.2) * (linear[0] - blown)
    np.testing.assert_allclose(linear[-1], left, atol=1e-4)
    # all links lose their momenta at one rate, so that the moment about the common centre does, too
    middle = (mass * (found.position_m + arm)).sum(2, keepdim=True) / mass.sum()
    own = quat_rotate(found.quat_wxyz, (inertia @ found.omega_body_rad_s[..., None]).squeeze(-1))
    angular = (mass * cross(found.position_m + arm - middle, velocity) + own).sum(2)[0]
    np.testing.assert_allclose(angular[-1], math.exp(-2.0 * 0.2) * angular[0], atol=5e-4 * float(angular[0].norm()))


def test_a_double_pendulum_keeps_its_energy_for_ten_seconds() -> None:
    chain, bodies = double_pendulum()
    world = chained(chain, *bodies, ground=False, step_s=0.001)
    state = with_joints(world, still(3), {"first": -0.3, "second": 1.2})
    found = rollout(world, state, times(10.0, 25.0))
    dynamics = ChainDynamics(chain, bodies)
    count = found.position_m.shape[1]
    frames = State(*(getattr(found, name)[0] for name in POSES))
    values, speeds = joints_of(world, frames, chain)
    zero = torch.zeros(count, 3, dtype=F64)
    turn = frames.quat_wxyz[:, 0]
    energy = dynamics.energy(ChainMotion(zero, turn, zero, zero, values, speeds), world.gravity)
    lowest = -9.81 * (0.3 * 0.05 + 0.2 * 0.15)
    assert float(speeds[:, 1].abs().max()) > 10.0  # it turns over
    np.testing.assert_allclose(energy, float(energy[0]), atol=1e-3 * (float(energy[0]) - lowest))


def test_reflected_inertia_adds_its_kinetic_energy() -> None:
    speeds = torch.tensor([[2.0, -3.0]], dtype=F64)
    zero, turn = torch.zeros(1, 3, dtype=F64), torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=F64)
    motion = ChainMotion(zero, turn, zero, zero, torch.tensor([[0.4, -0.7]], dtype=F64), speeds)
    plain, geared = (float(ChainDynamics(*double_pendulum(armature=size)).energy(motion, zero)) for size in (0.0, 0.01))
    assert geared - plain == pytest.approx(0.5 * 0.01 * (4 + 9), rel=1e-12)


@pytest.mark.parametrize("base", ["fixed", "driven", "free"])
def test_links_that_push_each_other_are_of_one_branch(base: str) -> None:
    """Two fingers on a palm, one behind a part that is welded on; a free palm passes every push on."""
    names = ("one", "one_tip", "part", "two", "two_tip", "nail")
    joints = (
        Joint.of("a", "hinge", "one", "palm"),
        Joint.of("b", "hinge", "one_tip", "one"),
        Joint.of("c", "fixed", "part", "palm"),
        Joint.of("d", "hinge", "two", "part"),
        Joint.of("e", "slide", "two_tip", "two"),
        Joint.of("f", "fixed", "nail", "two_tip"),
    )
    chain = Chain(name="hand", root="palm", base=base, joints=joints)
    found = dict(zip(chain.links, chain.branches, strict=True))
    fingers = [{found[name] for name in names if name.startswith(start)} for start in ("one", ("two", "nail"))]
    if base == "free":
        assert set(found.values()) == {0}
    else:
        assert fingers == [{chain.links.index("one")}, {chain.links.index("two")}]
        assert found["palm"] == found["part"] == 0


def servo(**numbers: float) -> tuple[World, State]:
    """Return one link on a servo that turns about z, without gravity along its motion."""
    bodies = (link("palm", 0.0), link("finger", 0.02))
    joint = Joint.of("knuckle", "hinge", "finger", "palm", **numbers)
    world = chained(Chain(name="hand", root="palm", base="fixed", joints=(joint,)), *bodies, ground=False)
    return world, still(2)


def angles(world: World, state: State, driven: Mapping[str, object], seconds: float, rate: float) -> torch.Tensor:
    """Return the value of the first joint in the frames of a rollout."""
    found = rollout(world, state, times(seconds, rate), driven)
    frames = [getattr(found, name)[0] for name in POSES]
    return joints_of(world, State(*frames), world.chains[0])[0][:, 0]


def test_a_servo_follows_a_step_as_the_position_actuator_of_mujoco_does() -> None:
    world, state = servo(stiffness=0.3, damping=0.01, armature=0.001)
    found = angles(world, state, {"hand": JointCommand.hold_still(batch([0.5]))}, 0.3, 100.0)
    moment = 0.001 + float(world.bodies[1].inertia[0, 2, 2]) + 0.02 * 0.05**2
    xml = f"""<mujoco><option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/><worldbody><body>
        <joint name="j" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="{moment} {moment} {moment}"/>
        </body></worldbody><actuator><position joint="j" kp="0.3" kv="0.01"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5
    theirs = [0.0]
    for _ in range(30):
        mujoco.mj_step(model, data, 10)
        theirs.append(float(data.qpos[0]))
    assert max(theirs) > 0.55  # it overshoots
    np.testing.assert_allclose(found, theirs, atol=0.02 * 0.5)


def test_a_servo_pushes_with_its_limit_and_a_joint_stops_at_its_own() -> None:
    free, state = servo(stiffness=50.0, armature=0.01, torque_limit=0.1, upper=0.4)
    found = angles(free, state, {"hand": JointCommand.hold_still(batch([2.0]))}, 0.6, 100.0)
    moment = 0.01 + float(free.bodies[1].inertia[0, 2, 2]) + 0.02 * 0.05**2
    reach = 0.5 * 0.1 / moment * torch.arange(5, dtype=F64).square() * 1e-4
    np.testing.assert_allclose(found[:5], reach, rtol=1e-9, atol=1e-12)
    assert float(found.max()) < 0.41 and abs(float(found[-1]) - 0.4) < 0.002


def test_dry_friction_holds_below_its_bound_and_brakes_above() -> None:
    speed = {"knuckle": 1.0}
    world, state = servo(friction=0.002)
    moment = float(world.bodies[1].inertia[0, 2, 2]) + 0.02 * 0.05**2
    found = angles(world, with_joints(world, state, {}, speed), {}, 0.1, 100.0)
    stop = moment / 0.002
    moved = torch.tensor([t - 0.5 * t**2 / stop if t < stop else 0.5 * stop for t in np.arange(11) / 100])
    assert 0.01 < stop < 0.08
    np.testing.assert_allclose(found, moved, atol=1e-4)
    held = replace(world, gravity=batch([0.0, -0.15, 0.0]))  # 0.00015 N m at the joint
    assert float(angles(held, state, {}, 0.2, 20.0).abs().max()) < 1e-9


def test_two_yielding_fingers_squeeze_a_ball_with_gain_times_deflection() -> None:
    names = ("left", "right")
    spheres = ((0.1, 0.0, 0.0, 0.01),)
    bodies = [link("palm", 0.0), *(link(name, 0.02, com=(0.05, 0, 0), spheres=spheres) for name in names)]
    joints = [
        Joint.of(
            f"{name}_joint", "hinge", name, "palm", position_m=(0, y, 0), stiffness=2.0, damping=0.05, armature=1e-3
        )
        for name, y in zip(names, (0.04, -0.04), strict=True)
    ]
    chain = Chain(name="hand", root="palm", base="fixed", joints=tuple(joints))
    ball = replace(ball_body(0.0295, 0.05), name="ball")
    world = chained(chain, *bodies, ball, ground=False, gravity=0.0, step_s=0.002)
    state = still(4)
    state.position_m[:, 3, 0] = 0.1
    state = with_joints(world, state, {})
    target = {"hand": JointCommand.hold_still(batch([-0.2, 0.2]))}
    found = rollout(world, state, times(0.6, 20.0), target, record_contacts=True)
    last = State(*(getattr(found, k)[:, -1] for k in POSES))
    values = joints_of(world, last, chain)[0][0]
    record = found.contacts
    assert record is not None
    forces = record.impulse_n_s[0, -1].norm(dim=-1) / 0.05
    for row, value, wanted in ((1, values[0], -0.2), (2, values[1], 0.2)):
        force = float(forces[(record.body_a == row) | (record.body_b == row)].sum())
        normal_arm = 0.1 * math.cos(float(value))  # the contact's normal is along y
        assert force > 2.0
        assert abs(force * normal_arm - 2.0 * abs(wanted - float(value))) < 0.01 * force * normal_arm
    assert float(last.velocity_m_s[0, 3].norm()) < 1e-3


def test_two_fingers_press_each_other_with_gain_times_deflection() -> None:
    """The guard of one finger touches the other finger, and no ball that lies within it."""
    bodies = [link("palm", 0.0), *(link(name, 0.02, com=(0.05, 0, 0)) for name in ("left", "right"))]
    spheres = ((0.1, 0.0, 0.0, 0.02),)
    bodies += [link("tip", 0.0, spheres=spheres), link("guard", 0.0, spheres=spheres)]
    joints = [
        Joint.of(
            f"{name}_joint", "hinge", name, "palm", position_m=(0, y, 0), stiffness=2.0, damping=0.05, armature=1e-3
        )
        for name, y in (("left", 0.025), ("right", -0.025))
    ]
    joints += [Joint.of("t", "fixed", "tip", "left"), Joint.of("g", "fixed", "guard", "right")]
    chain = Chain(
        name="hand", root="palm", base="fixed", joints=tuple(joints), touching=(("tip", "guard"),), within=("guard",)
    )
    ball = replace(ball_body(0.01, 0.05), name="ball")
    world = chained(chain, *bodies, ball, ground=False, gravity=0.0, step_s=0.002)
    state = still(6)
    state.position_m[:, 5] = torch.tensor([0.1, -0.04, 0.0])
    state = with_joints(world, state, {})
    target = {"hand": JointCommand.hold_still(batch([-0.3, 0.2]))}
    found = rollout(world, state, times(0.6, 20.0), target, record_contacts=True)
    values = joints_of(world, State(*(getattr(found, k)[:, -1] for k in POSES)), chain)[0][0]
    record = found.contacts
    assert record is not None
    force = record.impulse_n_s[0, -1].sum(0) / 0.05
    angle = [float(value) for value in values]
    tip = [np.array([0.1 * math.cos(a), y + 0.1 * math.sin(a)]) for a, y in zip(angle, (0.025, -0.025), strict=True)]
    x, y = (tip[0] + tip[1]) / 2
    for value, wanted, root in zip(angle, (-0.3, 0.2), (0.025, -0.025), strict=True):
        moment = abs(x * float(force[1]) - (y - root) * float(force[0]))
        assert moment > 0.05
        assert moment == pytest.approx(2.0 * abs(wanted - value), rel=0.01)
    assert float(found.velocity_m_s[0, -1, 5].norm()) == 0.0


def test_a_driven_root_carries_its_links_and_their_inertia_acts_on_the_joints() -> None:
    from cgwm.pipeline.physics.kinematic import Drive

    bodies = [link("cart", 0.0), link("pole", 0.3)]
    chain = Chain(
        name="c", root="cart", base="driven", joints=(Joint.of("pin", "hinge", "pole", "cart", axis=(0, 1, 0)),)
    )
    world = chained(chain, *bodies, ground=False, gravity=0.0, step_s=0.001)
    state = with_joints(world, still(2), {"pin": math.pi / 2})  # the pole hangs along -z
    samples = torch.linspace(0, 0.1, 101, dtype=F64)[None]
    speed = torch.zeros(1, 100, 3, dtype=F64)
    speed[..., 0] = 2.0 * samples[:, 1:]  # the cart accelerates at 2 m/s2
    drive = Drive.from_velocities(samples, state.position_m[:, 0], state.quat_wxyz[:, 0], speed, 0 * speed)
    found = rollout(world, state, times(0.05, 100.0), {"cart": drive})
    frames = [getattr(found, k)[0] for k in POSES]
    values, _ = joints_of(world, State(*frames), chain)
    moment = float(bodies[1].inertia[0, 1, 1]) + 0.3 * 0.05**2
    rate = 0.3 * 0.05 * 2.0 / moment  # the pole lags behind
    wanted = math.pi / 2 + 0.5 * rate * torch.arange(6, dtype=F64).square() * 1e-4
    np.testing.assert_allclose(values[:, 0], wanted, atol=0.05 * float(wanted[-1] - wanted[0]))


def test_derivatives_are_those_of_differences() -> None:
    chain, bodies = double_pendulum(stiffness=0.5, damping=0.02, armature=1e-4, friction=0.001, lower=-0.2)
    bodies[2] = replace(bodies[2], centers=batch([[0.1, 0.0, 0.0]]), radii=batch([0.01]))
    base = chained(chain, *bodies, step_s=0.002)
    base = replace(base, ground_offset=batch(-0.02))

    def moved(x: torch.Tensor, _: int = 1) -> torch.Tensor:
        count = x.shape[0]
        joints = tuple(replace(j, stiffness=0.5 + x[:, 0], armature=1e-4 + 1e-3 * x[:, 1]) for j in chain.joints)
        world = replace(base, chains=(replace(chain, joints=joints),))
        world = world.with_body(2, mass=0.2 + x[:, 2])
        state = with_joints(world, still(3, count), {"second": 0.3 + x[:, 3]}, {"first": x[:, 4]})
        knots = JointCommand.targets(batch([0.0, 0.01, 0.03]), x[:, 5:11].unflatten(1, (3, 2)), "cubic")
        return simulate(world, state, times(0.02, 100.0), {"arm": knots}).position_m[:, -1, 2]

    point = torch.tensor([[0.1, 0.2, 0.05, 0.1, 0.3, 0.1, 0.2, 0.3, -0.1, 0.2, 0.4]], dtype=F64)
    exact = batched_jacobian(moved, point)[1][0]
    step = 1e-6
    shifts = step * torch.eye(point.shape[1], dtype=F64)
    with torch.no_grad():
        differences = (moved(point + shifts) - moved(point - shifts)).T / (2 * step)
    np.testing.assert_allclose(exact, differences, atol=1e-6 * float(differences.abs().max()))
    assert float(differences.abs().amin()) >= 0 and float(differences.abs().max()) > 1e-3


def test_commands_go_through_their_knots_and_speeds_are_integrated() -> None:
    knots, values = batch([0.0, 0.5, 1.5]), batch([[0.0], [1.0], [0.5]])
    when = torch.tensor([0.0, 0.25, 0.5, 1.0, 1.5, 2.0], dtype=F64)

    def at(command: JointCommand) -> list[float]:
        return [float(command.at(t[None])[0, 0]) for t in when]

    assert at(JointCommand.targets(knots, values, "zero")) == [0.0, 0.0, 1.0, 1.0, 0.5, 0.5]
    assert at(JointCommand.targets(knots, values, "linear")) == pytest.approx([0.0, 0.5, 1.0, 0.75, 0.5, 0.5])
    cubic = at(JointCommand.targets(knots, values, "cubic"))
    assert cubic[::2] == pytest.approx([0.0, 1.0, 0.5]) and cubic[5] == 0.5
    parabola = JointCommand.targets(knots, knots[..., None] ** 2, "cubic")  # a parabola's inner slope is exact
    assert float(parabola.at(batch(0.5) + 1e-6)[0, 0] - 0.25) / 1e-6 == pytest.approx(1.0, abs=1e-5)
    linear = at(JointCommand.speeds(knots, values, batch([0.2]), "linear"))
    assert linear == pytest.approx([0.2, 0.2 + 0.0625, 0.45, 0.45 + 0.4375, 1.2, 1.2])
    with pytest.raises(UsageError, match="zero, linear, cubic"):
        JointCommand.targets(knots, values, "spline")


def test_what_cannot_be_a_chain_is_refused() -> None:
    chain, bodies = double_pendulum()
    world = chained(chain, *bodies, ground=False)
    loop = replace(chain, joints=(*chain.joints, replace(chain.joints[1], name="third", parent="base")))
    with pytest.raises(InputDataError, match="'lower' is carried by two joints: a loop"):
        require_chains(replace(world, chains=(loop,)))
    with pytest.raises(InputDataError, match="several joints are called 'first'"):
        twice = replace(chain, joints=(chain.joints[0], replace(chain.joints[1], name="first")))
        require_chains(replace(world, chains=(twice,)))
    with pytest.raises(InputDataError, match="moves links without mass"):
        require_chains(world.with_body(2, mass=batch(0.0)))
    with pytest.raises(InputDataError, match="is a link of no chain"):
        require_chains(replace(world, chains=()))
    with pytest.raises(InputDataError, match="its limits are 1 and 0"):
        Joint.of("a", "hinge", "b", "c", lower=1.0, upper=0.0)
    with pytest.raises(UsageError, match="there is no moving joint 'elbow'"):
        with_joints(world, still(3), {"elbow": 1.0})
    apart = with_joints(world, still(3), {})
    apart.position_m[0, 2, 1] += 0.01
    with pytest.raises(InputDataError, match="link 'lower' is 10 mm and 0 rad off its joint 'second'"):
        simulate(world, apart, times(0.01))
    with pytest.raises(InputDataError, match="there is no link 'hand'"):
        require_chains(replace(world, chains=(replace(chain, within=("hand",)),)))
    with pytest.raises(InputDataError, match="'upper' and 'lower' cannot touch each other: a joint"):
        require_chains(replace(world, chains=(replace(chain, touching=(("upper", "lower"),)),)))
    servoed = replace(chain, joints=(replace(chain.joints[0], stiffness=batch(1.0)), chain.joints[1]))
    with pytest.raises(InputDataError, match="have servos and no command"):
        simulate(replace(world, chains=(servoed,)), with_joints(world, still(3), {}), times(0.01))
    turned = with_joints(world, still(3), {})
    turned.quat_wxyz[0, 2] = batch([math.cos(0.05), math.sin(0.05), 0.0, 0.0])[0]  # about x; the hinge turns about y
    with pytest.raises(InputDataError, match=r"link 'lower' is 0 mm and 0.1 rad off its joint 'second'"):
        simulate(world, turned, times(0.01))


def test_links_off_their_joints_are_put_on_them_and_others_stay() -> None:
    chain, bodies = double_pendulum("free")
    world = chained(chain, *bodies)
    free = State(*(x.clone() for x in still(3).tensors))
    free.velocity_m_s[:, 0] = torch.tensor([0.1, -0.2, 0.3])
    free.omega_body_rad_s[:, 0] = torch.tensor([1.0, 2.0, -0.5])
    given = with_joints(world, free, {"first": 0.4, "second": -1.2}, {"first": 2.0, "second": -0.7})
    for kept, found in zip(given.tensors, on_joints(world, given).tensors, strict=True):
        np.testing.assert_allclose(found, kept, atol=1e-14)
    moved = State(*(x.clone() for x in given.tensors))
    moved.position_m[:, 2] += 0.01
    moved.velocity_m_s[:, 1] -= 0.2
    for kept, found in zip(given.tensors, on_joints(world, moved).tensors, strict=True):
        np.testing.assert_allclose(found, kept, atol=1e-14)  # hinges admit neither
    turned = State(*(x.clone() for x in given.tensors))
    turned.omega_body_rad_s[:, 2] += torch.tensor([0.0, 0.3, 0.0])  # about its axis
    values, speeds = joints_of(world, on_joints(world, turned), chain)
    np.testing.assert_allclose(values[0], [0.4, -1.2], atol=1e-12)
    np.testing.assert_allclose(speeds[0], [2.0, -0.4], atol=1e-12)


def test_parameters_of_a_chain_keep_its_mass_and_scale_what_they_name() -> None:
    chain, bodies = double_pendulum("free", damping=0.02)
    world = chained(chain, *bodies)
    parameters = {p.name: p for p in chain_parameters(world)}
    assert list(parameters) == [
        "first.damping", "first.friction", "second.damping", "second.friction", "upper.mass_factor",
        "lower.mass_factor", "arm.inertia_factor",
    ]  # fmt: skip
    assert parameters["first.damping"].prior[0] == 0.02  # what is given is the median
    values = {"lower.mass_factor": batch([2.0, 1.0])[0], "arm.inertia_factor": batch([1.0, 3.0])[0]}
    values |= {"second.friction": batch([0.1, 0.2])[0]}
    found = with_chain_values(world, values)
    before, after = (torch.stack([b.mass.expand(2) for b in w.bodies]) for w in (world, found))
    np.testing.assert_allclose(after.sum(0), before.sum(0), rtol=1e-14)
    np.testing.assert_allclose((after / before)[2] / (after / before)[0], [2.0, 1.0], rtol=1e-14)
    radius = [b.inertia.diagonal(dim1=-2, dim2=-1).sum(-1) / b.mass for b in (world.bodies[2], found.bodies[2])]
    np.testing.assert_allclose(radius[1] / radius[0], [1.0, 3.0], rtol=1e-14)
    np.testing.assert_allclose(found.chains[0].joints[1].friction, [0.1, 0.2])
    assert found.chains[0].joints[0].friction is world.chains[0].joints[0].friction


def test_only_a_free_base_needs_no_joint_that_moves() -> None:
    """A rigid pair that floats moves as one; behind a fixed root nothing would."""
    joint = Joint.of("weld", "fixed", "upper", "base", position_m=(0.1, 0, 0))
    require_chains(chained(Chain(name="pair", root="base", base="free", joints=(joint,)), link("base"), link("upper")))
    alone = chained(Chain(name="pair", root="base", base="free", joints=()), link("base"))
    welded = chained(Chain(name="pair", root="base", base="fixed", joints=(joint,)), link("base"), link("upper"))
    for world in (alone, welded):
        with pytest.raises(InputDataError, match="none of its joints moves"):
            require_chains(world)


@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_losses_of_joints_start_at_a_share_of_what_gravity_does_there(kind: str) -> None:
    """Of a hinge: m g r and its pendulum's frequency sqrt(g / r); of a slide: m g and a fall by r."""
    body = link("arm", 0.3)
    joint = Joint.of("joint", kind, "arm", "base", axis=(0, 1, 0))
    chain = Chain(name="one", root="base", base="fixed", joints=(joint,))
    found = {p.name: p for p in chain_parameters(chained(chain, link("base", 0.0), body))}
    mass, com2 = 0.3, float(body.com.square().sum())
    arm = math.sqrt(com2 + float(body.inertia[0].diagonal().sum()) / 2 / mass)
    weight = mass * 9.81 * (arm if kind == "hinge" else 1.0)
    rate = math.sqrt(9.81 / arm) if kind == "hinge" else math.sqrt(9.81 * arm)
    friction, damping = found["joint.friction"], found["joint.damping"]
    assert friction.unit == ("N m" if kind == "hinge" else "N")
    assert damping.unit == ("N m s/rad" if kind == "hinge" else "N s/m")
    assert friction.bounds[1] == pytest.approx(10 * weight, rel=1e-3)
    assert damping.bounds[1] == pytest.approx(10 * weight / rate, rel=1e-3)


def test_a_repeated_command_has_the_rows_of_the_batch() -> None:
    values = torch.tensor([[[0.0], [1.0]], [[0.5], [0.2]]], dtype=F64)
    command = JointCommand.targets(torch.tensor([[0.0, 1.0], [0.0, 2.0]], dtype=F64), values)
    again = command.repeat(3)
    assert again.coefficients.shape == (6, *command.coefficients.shape[1:])
    assert torch.equal(again.coefficients[2:4], command.coefficients)
    shared = JointCommand.targets(torch.tensor([[0.0, 1.0]], dtype=F64), values[:1])
    assert shared.repeat(3).coefficients.shape == shared.coefficients.shape


def test_pieces_of_a_cubic_command_end_where_the_next_begins_and_follow_a_parabola() -> None:
    knots = torch.tensor([[0.0, 0.3, 0.5, 1.1, 1.4]], dtype=F64)
    values = torch.stack([knots.square() - knots, knots.sin()], -1)
    pieces = JointCommand.targets(knots, values, "cubic").coefficients
    step = knots.diff(dim=1)[..., None]
    powers = torch.stack([step**k for k in range(5)], -1)
    rates = torch.stack([k * step ** max(k - 1, 0) for k in range(5)], -1)
    torch.testing.assert_close((pieces[:, :-1] * powers).sum(-1), values[:, 1:])
    torch.testing.assert_close((pieces[:, :-2] * rates[:, :-1]).sum(-1), pieces[:, 1:-1, :, 1])
    inner = pieces[0, 1:3, 0]  # the first and the last piece have one-sided slopes
    expected = torch.stack([2 * knots[0, 1:3] - 1, torch.ones(2, dtype=F64), torch.zeros(2, dtype=F64)], -1)
    torch.testing.assert_close(inner[:, 1:4], expected)


@pytest.mark.parametrize(("shift", "turn"), [(1.5e-5, 0.0), (0.0, 1.5e-4)])
def test_a_link_off_its_joint_by_more_than_rounding_is_refused(shift: float, turn: float) -> None:
    chain, bodies = double_pendulum()
    world = chained(chain, *bodies)
    state = with_joints(world, still(3), {"first": 0.2})
    joints_of(world, state, chain)
    state.position_m[:, 1] += torch.tensor([shift, 0.0, 0.0], dtype=F64)
    axis = chain.joints[0].axis[0].roll(1)  # across the hinge
    half = torch.cat([torch.ones(1, dtype=F64), 0.5 * turn * axis])
    state.quat_wxyz[:, 1] = quat_multiply(state.quat_wxyz[:, 1], half)
    with pytest.raises(InputDataError, match="off its joint 'first'"):
        joints_of(world, state, chain)


def test_joints_go_with_a_state_to_another_device_or_type_and_to_no_other_chain() -> None:
    chain, bodies = double_pendulum()
    world = chained(chain, *bodies)
    state = with_joints(world, still(3), {"first": 0.2, "second": -0.3}, {"first": 0.1})
    single, there = on_device(world, "cpu", torch.float32), on_device(state, "cpu", torch.float32)
    values, speeds = joints_of(single, there, single.chains[0])
    assert values.tolist() == [torch.tensor([0.2, -0.3]).tolist()]  # from poses, they are off by rounding
    assert speeds.tolist() == [torch.tensor([0.1, 0.0]).tolist()]
    moved = replace(chain.joints[1], position=chain.joints[1].position + 1e-4)
    other = replace(chain, joints=(chain.joints[0], moved))
    with pytest.raises(InputDataError, match="off its joint"):
        joints_of(replace(single, chains=(on_device(other, "cpu", torch.float32),)), there, other)
    there.position_m[:, 2] += 1e-4
    with pytest.raises(InputDataError, match="off its joint"):
        joints_of(single, there, single.chains[0])


def test_priors_of_a_chain_scale_with_its_weight_and_factors_are_as_free_upwards_as_downwards() -> None:
    chain, bodies = double_pendulum("free")
    light = {p.name: p for p in chain_parameters(chained(chain, *bodies))}
    heavier = [replace(body, mass=3 * body.mass, inertia=3 * body.inertia) for body in bodies]
    heavy = {p.name: p for p in chain_parameters(chained(chain, *heavier))}
    for name in ("first.friction", "second.damping"):
        assert heavy[name].prior[0] == pytest.approx(3 * light[name].prior[0], rel=1e-9)
        assert light[name].bounds[0] < light[name].prior[0] < light[name].bounds[1]
    for name in ("lower.mass_factor", "arm.inertia_factor"):
        assert light[name].prior[0] == 1.0 and light[name].bounds[0] * light[name].bounds[1] == pytest.approx(1.0)


def test_frames_and_axes_of_joints_need_not_have_unit_length() -> None:
    joint = Joint.of("j", "hinge", "link", "base", quat_wxyz=(3.0, 0, 4.0, 0), axis=(0, 0, 2.0))
    torch.testing.assert_close(joint.quat_wxyz, torch.tensor([[0.6, 0, 0.8, 0]]).to(joint.quat_wxyz))
    torch.testing.assert_close(joint.axis, torch.tensor([[0, 0, 1.0]]).to(joint.axis))


def test_a_drawer_is_pushed_by_its_losses_and_what_it_cannot_yield_to_does_not_act() -> None:
    world, state, commands = drawer(0.0)
    found = simulate(world, state, torch.tensor([0.0, 0.088, 0.1], dtype=F64), commands, record_contacts=True)
    box, pushed = world.body_names.index("box"), world.body_names.index("finger")
    np.testing.assert_allclose(found.velocity_m_s[0, -1, box], [-0.2, 0.0, 0.0], atol=1e-3)
    assert found.contacts is not None
    acting = found.contacts.impulse_n_s[0, -1].norm(dim=-1) > 0
    bodies = {*found.contacts.body_a[acting].tolist(), *found.contacts.body_b[acting].tolist()}
    assert bodies == {box, pushed}  # the ground bears what the rail does
    force = found.contacts.impulse_n_s[0, -1][acting].sum(0) / 0.012
    np.testing.assert_allclose(force.abs().amax(), 2.0 + 8.0 * 0.2, rtol=0.02)  # along the normal: dry and viscous
    assert [p.name for p in chain_parameters(world)] == ["rail.damping", "rail.friction"]  # a slide turns nothing


def test_the_inertia_of_a_drive_adds_to_the_mass_of_its_joint_alone() -> None:
    still, values = torch.zeros(1, 3, dtype=F64), torch.tensor([[0.3, -0.7]], dtype=F64)
    motion = ChainMotion(still, batch([1.0, 0.0, 0.0, 0.0]), still, still, values, 0 * values)
    plain, geared = (
        ChainDynamics(chain, tuple(bodies)).balance(motion, batch([0.0, 0.0, -9.81]))
        for chain, bodies in (double_pendulum(), double_pendulum(armature=0.05))
    )
    torch.testing.assert_close(geared.mass - plain.mass, 0.05 * torch.eye(2, dtype=F64)[None])
    torch.testing.assert_close(geared.bias, plain.bias)


def test_kernels_take_the_inertia_of_a_link_with_its_products_in_order() -> None:
    chain, bodies = double_pendulum()
    full = batch([[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]])
    row = _link_columns(chained(chain, *bodies[:2], replace(bodies[2], inertia=full)), chain)[0]
    mass_inertia_com = row[-10:]
    torch.testing.assert_close(mass_inertia_com[1:7], batch([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])[0])
