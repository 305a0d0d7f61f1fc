"""URDF and MJCF: what is read, and what is refused."""

import math
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from cgwm.datasets.robots import read_articulation
from cgwm.datasets.robots.mjcf import control_of, servos_of
from cgwm.pipeline.physics.chains.articulated import Servo, chain_of
from cgwm.pipeline.sg_gs.collision.link_spheres import link_mesh, link_spheres
from cgwm.schemas import InputDataError, UsageError

ARM = """<robot name="arm">
  <link name="foot"/>
  <link name="upper">
    <inertial><origin xyz="0.1 0 0" rpy="0.3 0 0.2"/><mass value="0.5"/>
      <inertia ixx="0.002" iyy="0.003" izz="0.004" ixy="0.0001" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.1 0 0" rpy="0 0 0.4"/><geometry><box size="0.2 0.04 0.04"/></geometry></collision>
  </link>
  <link name="tip">
    <inertial><mass value="0.1"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.03"/></geometry></collision>
  </link>
  <link name="slider">
    <inertial><mass value="0.2"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><cylinder radius="0.03" length="0.1"/></geometry></collision>
  </link>
  <joint name="weld" type="fixed"><parent link="upper"/><child link="tip"/>
    <origin xyz="0.2 0 0.01" rpy="0 0.5 0"/></joint>
  <joint name="shoulder" type="revolute"><parent link="foot"/><child link="upper"/>
    <origin xyz="0 0 0.3" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/><limit lower="-1" upper="2" effort="3" velocity="1"/>
    <dynamics damping="0.05" friction="0.01"/></joint>
  <joint name="rail" type="prismatic"><parent link="tip"/><child link="slider"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 0 1"/><limit lower="0" upper="0.2" effort="5" velocity="1"/></joint>
</robot>"""


def written(folder: Path, text: str, name: str = "arm.urdf") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_urdf_has_the_mass_matrix_and_poses_that_mujoco_reads(tmp_path: Path) -> None:
    from cgwm.pipeline.physics.chains.dynamics import ChainDynamics, ChainMotion, _Place

    path = written(tmp_path, ARM)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = 0.7, 0.05
    mujoco.mj_forward(model, data)
    theirs = np.zeros((2, 2))
    mujoco.mj_fullM(model, data, theirs)
    whole = read_articulation(path)
    assert [joint.name for joint in whole.joints] == ["shoulder", "weld", "rail"]
    assert whole.joints[0].torque_limit == 3.0 and whole.joints[0].friction == 0.01 and whole.joints[2].upper == 0.2
    for found in (whole, whole.welded()):
        empty = {link.name: (np.zeros((0, 3)), np.zeros(0)) for link in found.links}
        chain, bodies = chain_of(found, empty, "fixed")
        dynamics = ChainDynamics(chain, bodies)
        zero = torch.zeros(1, 3, dtype=torch.float64)
        values = torch.tensor([[0.7, 0.05]], dtype=torch.float64)
        motion = ChainMotion(zero, torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64), zero, zero, values, 0 * values)
        mass = _Place.of(dynamics, motion).mass_matrix()[0]
        np.testing.assert_allclose(mass, theirs, atol=1e-9)
        slider = dynamics.links(motion)[-1]
        np.testing.assert_allclose(slider.com[0], data.body("slider").xpos, atol=1e-9)


def test_an_mjcf_file_has_its_servos_anchors_and_several_joints_of_a_body(tmp_path: Path) -> None:
    from cgwm.pipeline.physics.chains.dynamics import ChainDynamics, ChainMotion, _Place

    text = """<mujoco><compiler angle="radian"/><worldbody><body name="a" pos="0 0 1">
      <joint name="x" axis="1 0 0" pos="0.02 0 0.1" range="-1 1" damping="0.1" armature="0.01"/>
      <joint name="y" type="slide" axis="0 1 0" range="-0.1 0.1"/>
      <geom type="box" size="0.05 0.03 0.02" mass="0.4" pos="0.01 0 0"/>
      <body name="b" pos="0.1 0.02 0" quat="0.9 0.1 0.3 0.2">
        <joint name="z" axis="0 0 1" pos="0.01 0.02 0.03" range="-2 2"/>
        <geom type="capsule" size="0.02 0.05" mass="0.2"/></body></body></worldbody>
      <actuator><position joint="z" kp="2" kv="0.3" forcerange="-1 1"/></actuator></mujoco>"""
    found = read_articulation(written(tmp_path, text, "arm.xml"))
    joint = {one.name: one for one in found.joints}
    assert joint["z"].stiffness == 2.0 and joint["z"].damping == pytest.approx(0.3) and joint["z"].torque_limit == 1.0
    assert joint["x"].armature == 0.01 and joint["y"].kind == "slide"
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0.3, 0.05, -0.8], [1.0, 0.2, -2.0]
    mujoco.mj_forward(model, data)
    theirs = np.zeros((3, 3))
    mujoco.mj_fullM(model, data, theirs)
    spheres = link_spheres(found, 40)
    chain, bodies = chain_of(found, spheres, "fixed")
    assert sum(body.radii.shape[-1] for body in bodies) <= 40
    dynamics = ChainDynamics(chain, bodies)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    values, speeds = (torch.tensor(x, dtype=torch.float64)[None] for x in (data.qpos, data.qvel))
    motion = ChainMotion(zero, torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64), zero, zero, values, speeds)
    place = _Place.of(dynamics, motion)
    mass = place.mass_matrix()[0] + torch.diag(torch.tensor([0.01, 0.0, 0.0], dtype=torch.float64))
    np.testing.assert_allclose(mass, theirs, atol=1e-10)
    gravity = torch.tensor([[0.0, 0.0, -9.81]], dtype=torch.float64)
    np.testing.assert_allclose(place.bias(motion, gravity, None)[0], data.qfrc_bias, atol=1e-10)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="prismatic"', 'type="floating"', "joint 'rail' has the type 'floating'"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><mimic joint="shoulder"/>', "joint 'rail' mimics another joint"),
        ('<limit lower="-1" upper="2" effort="3" velocity="1"/>', "", "joint 'shoulder' is revolute and has no limits"),
        (
            '<child link="slider"/>',
            '<child link="tip"/>',
            "link 'tip' is carried by the joints 'weld' and 'rail': a loop",
        ),
        (
            '<collision><geometry><sphere radius="0.03"/></geometry></collision>',
            "",
            "link 'tip' has no collision geometry",
        ),
        ('name="rail"', 'name="weld"', "several joints are called 'weld'"),
        ('link name="slider"', 'link name="tip"', "several links are called 'tip'"),
        ('value="0.5"', 'value="heavy"', "link 'upper', mass: 'heavy'"),
        (
            '<parent link="foot"/>',
            '<parent link="hand"/>',
            "joint 'shoulder' names the link 'hand', which is not there",
        ),
        ('<sphere radius="0.03"/>', '<mesh filename="big.obj"/>', "its numbers look like millimetres"),
        ("<robot", "<sdf", "it is not XML"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "joint 'rail' has an axis of length 0"),
        ('lower="-1" upper="2"', 'lower="2" upper="-1"', "joint 'shoulder' has the limits 2 to -1"),
        (
            '<link name="foot"/>',
            '<link name="foot"/><xacro:finger side="l"/>',
            "it is a xacro file: it has <xacro:finger>",
        ),
    ],
)
def test_what_a_chain_cannot_be_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in ARM
    corners = "v 0 0 0\nv 90 0 0\nv 0 90 0\nv 0 0 90\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "big.obj").write_text(corners)
    with pytest.raises(InputDataError, match=re.escape(message)):
        read_articulation(written(tmp_path, ARM.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("joint", "more", "message"),
    [
        ('stiffness="0.1"', "", "joint 'z' has a spring"),
        ('ref="10"', "", "joint 'z' is not 0 where the file draws it"),
        ("", '<tendon><fixed name="t" stiffness="3"><joint joint="z" coef="1"/></fixed></tendon>', "tendon 't' has a"),
        (
            "",
            '<tendon><fixed name="t"><joint joint="z" coef="1"/></fixed></tendon>'
            '<actuator><motor name="pull" tendon="t"/></actuator>',
            "actuator 'pull' does not act on a joint",
        ),
        (
            "",
            '<actuator><intvelocity name="v" joint="z" kp="2" actrange="-1 1"/></actuator>',
            "actuator 'v' has dynamics",
        ),
        ("", '<actuator><position jointinparent="z" kp="2"/></actuator>', "actuator number 0 does not act on a joint"),
        ("", 2 * '<actuator><position joint="z" kp="2"/></actuator>', "joint 'z' has 2 servos"),
        (
            "",
            '<actuator><position name="p" joint="z" kp="2" forcerange="-1 0"/></actuator>',
            "'p' pulls in one direction",
        ),
    ],
)
def test_what_pulls_otherwise_than_a_servo_is_refused(tmp_path: Path, joint: str, more: str, message: str) -> None:
    text = f"""<mujoco><worldbody><body><geom size="0.1"/><body><joint name="z" {joint}/><geom size="0.1"/></body>
      </body></worldbody>{more}</mujoco>"""
    with pytest.raises(InputDataError, match=re.escape(message)):
        read_articulation(written(tmp_path, text, "arm.xml"))


SERVED = """<mujoco><compiler angle="radian"/><worldbody><geom name="floor" type="plane" size="1 1 1"/>
  <body name="base"><geom size="0.1"/>
    <body name="link"><joint name="z" range="-2 2" damping="0.1"/><geom type="%s" size="0.03 0.02 0.01"/></body></body>
  </worldbody><actuator>%s</actuator></mujoco>"""


@pytest.mark.parametrize(
    ("actuators", "gain", "damping", "force", "targets"),
    [
        ('<position joint="z" kp="2" kv="0.3" gear="3" forcerange="-1 1"/>', 18.0, 2.8, 3.0, (-math.inf, math.inf)),
        (
            '<position joint="z" gear="0" ctrlrange="0 1"/><position joint="z" kp="2" ctrlrange="-0.5 1"/>',
            2.0, 0.1, math.inf, (-0.5, 1.0),
        ),
        (
            '<general joint="z" biastype="affine" gainprm="4" biasprm="1 -2 -0.3" ctrlrange="-1 1"/>',
            2.0, 0.4, math.inf, (-1.5, 2.5),
        ),
        ('<position joint="z" kp="2" gear="-1" ctrlrange="-0.5 1"/>', 2.0, 0.1, math.inf, (-1.0, 0.5)),
    ],
)  # fmt: skip
def test_a_servo_pulls_as_in_mujoco_from_its_control_to_rest(
    tmp_path: Path, actuators: str, gain: float, damping: float, force: float, targets: tuple[float, float]
) -> None:
    path = written(tmp_path, SERVED % ("ellipsoid", actuators), "arm.xml")
    found = read_articulation(path)
    joint = next(one for one in found.joints if one.name == "z")
    assert (joint.stiffness, joint.damping, joint.torque_limit) == pytest.approx((gain, damping, force))
    assert (joint.lowest_target, joint.highest_target) == pytest.approx(targets) and found.outside == ("floor",)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    servo = servos_of(model, 0)[0]
    factor, offset = control_of(model, servo)
    data.qpos[0] = 0.3
    for target, torque in ((0.3, 0.0), (0.35, 0.05 * gain)):
        data.ctrl[servo] = factor * target + offset
        mujoco.mj_forward(model, data)
        assert data.qfrc_actuator[0] == pytest.approx(torque, abs=1e-12)


def test_a_plane_on_a_link_is_refused(tmp_path: Path) -> None:
    text = SERVED.replace('<geom size="0.1"/>', '<geom type="plane" size="1 1 1"/>') % ("sphere", "")
    with pytest.raises(InputDataError, match="body 'base' has a plane"):
        read_articulation(written(tmp_path, text, "arm.xml"))


def test_an_ellipsoid_reaches_as_far_as_its_axes(tmp_path: Path) -> None:
    found = read_articulation(written(tmp_path, SERVED % ("ellipsoid", ""), "arm.xml"))
    np.testing.assert_allclose(np.ptp(link_mesh(found.links[1]).vertices, axis=0), (0.06, 0.04, 0.02), rtol=0.02)


def test_includes_are_found_from_the_file_that_names_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robot" / "parts").mkdir(parents=True)
    written(
        tmp_path, "<mujoco><worldbody><body><joint/><geom size='0.1'/></body></worldbody></mujoco>", "robot/parts/b"
    )
    written(tmp_path, '<mujoco><include file="b"/></mujoco>', "robot/parts/a")
    written(tmp_path, '<mujoco><include file="parts/a"/></mujoco>', "robot/arm.xml")
    monkeypatch.chdir(tmp_path)
    assert len(read_articulation("robot/arm.xml").joints) == 1


def test_spheres_need_a_closed_mesh(tmp_path: Path) -> None:
    (tmp_path / "open.obj").write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\n")
    text = ARM.replace('<sphere radius="0.03"/>', '<mesh filename="open.obj"/>', 1)
    with pytest.raises(InputDataError, match="link 'tip': the mesh is not closed: 3 of 6 edges"):
        link_spheres(read_articulation(written(tmp_path, text)), 60)


def test_servos_are_given_by_joint_name_and_need_limits(tmp_path: Path) -> None:
    found = read_articulation(written(tmp_path, ARM.replace('"revolute"', '"continuous"')))
    empty = {link.name: (np.zeros((0, 3)), np.zeros(0)) for link in found.links}
    chain, _ = chain_of(found, empty, "fixed", {"rail": Servo(stiffness=5.0, armature=0.1)})
    assert chain.numbers("stiffness")[0].tolist() == [0.0, 5.0] and chain.numbers("damping")[0, 0] == 0.05
    with pytest.raises(InputDataError, match="joint 'shoulder' has a servo and no limits"):
        chain_of(found, empty, "fixed", Servo(stiffness=5.0))
    with pytest.raises(UsageError, match=re.escape("there is no moving joint 'elbow'")):
        chain_of(found, empty, "fixed", {"elbow": Servo(stiffness=5.0)})
    with pytest.raises(InputDataError, match="5 spheres for 3 links"):
        link_spheres(found, 5)


# In the suite: spheres inside shapes are tested in test_collision.py, those of links in the MJCF file below.
@pytest.mark.evidence
def test_equal_links_get_equal_spheres_inside_their_geometry(tmp_path: Path) -> None:
    found = read_articulation(written(tmp_path, ARM))
    spheres = link_spheres(found, 24)
    centers, radii = spheres["tip"]
    np.testing.assert_allclose(centers, 0.0)
    assert radii.tolist() == [0.03] and len(spheres["foot"][1]) == 0
    upper = found.links[1].geometry[0]
    centers, radii = spheres["upper"]
    inside = np.abs((centers - upper.position_m) @ upper.rotation) + radii[:, None]
    assert (inside <= np.array(upper.size_m) + 1e-6).all()
