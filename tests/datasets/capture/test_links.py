"""Jointed bodies of a capture: links become bodies, and files that cannot be a chain are refused in one message."""

from pathlib import Path

import pytest
from cgwm.datasets import Capture
from cgwm.datasets.capture.links import articulation_models, articulations_of
from cgwm.schemas import InputDataError, ModelFile, Provenance, parse
from cgwm.schemas.model import BodyModel
from helpers.elbow import URDF

INERTIAL = '<inertial><mass value="0.4"/><inertia ixx="0.0002" iyy="0.0004" izz="0.0004"/></inertial>'
MANIFEST = """format = "cgwm-capture/1"
[[articulations]]
name = "arm"
urdf = "arm.urdf"
"""


def capture(root: Path, urdf: str = URDF, manifest: str = MANIFEST) -> Capture:
    root.mkdir(exist_ok=True)
    (root / "arm.urdf").write_text(urdf)
    (root / "capture.toml").write_text(manifest)
    return Capture.open(root)


def test_links_are_bodies_with_the_masses_of_the_file(tmp_path: Path) -> None:
    opened = capture(tmp_path)
    assert [(body.name, body.motion, body.mass_kg) for body in opened.manifest.bodies] == [
        ("upper", "link", 0.4),
        ("lower", "link", 0.3),
    ]
    assert opened.body("lower").com_m == (0.035, 0.0, 0.0)
    (found,) = articulation_models(opened.manifest, articulations_of(tmp_path, opened.manifest))
    assert (found.root, found.base, found.links, found.moving_links) == (
        "upper", "free", ("upper", "lower"), ("upper", "lower"),
    )  # fmt: skip
    joint = found.joints[0]
    assert (joint.kind, joint.position_m, joint.axis, joint.lower) == ("hinge", (-0.035, 0.06, 0.0), (0, 1, 0), None)


def test_a_root_that_stands_needs_no_mass_and_is_not_tracked(tmp_path: Path) -> None:
    head, inertial, tail = URDF.partition(INERTIAL)
    assert inertial
    light = head + tail
    fixed = MANIFEST + 'base = "fixed"\npose = { position_m = [0.0, 0.0, 0.5] }\n'
    opened = capture(tmp_path, light, fixed)
    (found,) = articulation_models(opened.manifest, articulations_of(tmp_path, opened.manifest))
    assert found.moving_links == ("lower",)
    pose = opened.body("upper").photo_pose
    assert pose is not None and pose.position_m == (0.0, 0.0, 0.5)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<mass value="0.3"/>', '<mass value="0"/>', "link 'lower' moves and has no mass"),
        ('<collision><origin xyz="0.035 0 0"/>', '<visual><origin xyz="0.035 0 0"/>', None),
        ('type="continuous"', 'type="fixed"', "none of its joints moves"),
        ('type="continuous"', 'type="floating"', "floating"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><mimic joint="other"/>', "mimic"),
        ('<child link="lower"/>', '<child link="hand"/>', "names the link 'hand'"),
        (INERTIAL, INERTIAL.replace('iyy="0.0004"', 'iyy="0.04"'), "no body has this inertia"),
    ],
)  # fmt: skip
def test_files_that_are_no_chain_are_refused(tmp_path: Path, old: str, new: str, message: str | None) -> None:
    assert old in URDF
    urdf = URDF.replace(old, new)
    if message is None:  # a link that is seen and not touched
        head, tail = urdf.rsplit("</collision>", 1)
        urdf, message = f"{head}</visual>{tail}", "link 'lower' has no collision geometry"
    with pytest.raises(InputDataError, match=message):
        capture(tmp_path, urdf)


def test_a_fixed_root_link_without_collision_geometry_is_refused(tmp_path: Path) -> None:
    mjcf = """<mujoco><worldbody><body name="case"><inertial mass="5" pos="0 0 0" diaginertia="0.1 0.1 0.1"/>
      <body name="drawer"><joint name="rail" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.05 0.02 0.02" mass="0.3"/></body></body></worldbody></mujoco>"""
    (tmp_path / "arm.xml").write_text(mjcf)
    manifest = MANIFEST.replace('urdf = "arm.urdf"', 'mjcf = "arm.xml"\nbase = "fixed"\npose = {}')
    with pytest.raises(InputDataError, match="link 'case' has no collision geometry"):
        capture(tmp_path, manifest=manifest)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('base = "fixed"\n', "pose is that of the root link"),
        ('mjcf = "a.xml"\n', "exactly one of urdf and mjcf"),
        ('material = "steel"\n', "articulation 'arm' names the material 'steel'"),
        ('[[bodies]]\nname = "lower"\n', "the link 'lower' of .* has the name of another body"),
        ('[[bodies]]\nname = "a"\nmotion = "link"\n', "body 'a': links are not listed"),
        ('[[articulations]]\nname = "arm"\nurdf = "b.urdf"\n', "two .* have the name 'arm'"),
        ('[[articulations]]\nname = "b"\nurdf = "../b.urdf"\n', "lies outside the capture"),
        ('[[articulations]]\nname = "b"\nurdf = "b.urdf"\n', "'b.urdf': no such file"),
    ],
)
def test_manifests_that_contradict_themselves_are_refused(tmp_path: Path, more: str, message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        capture(tmp_path, manifest=MANIFEST + more)


def test_a_servo_has_no_commands_in_a_capture(tmp_path: Path) -> None:
    mjcf = """<mujoco><worldbody><body name="upper"><freejoint/><geom type="box" size="0.05 0.02 0.02" mass="0.4"/>
      <body name="lower" pos="0 0.06 0"><joint name="hinge" axis="0 1 0" range="-1 1"/>
      <geom type="box" size="0.05 0.02 0.02" mass="0.3"/></body></body></worldbody>
      <actuator><position joint="hinge" kp="1"/></actuator></mujoco>"""
    (tmp_path / "arm.xml").write_text(mjcf)
    with pytest.raises(InputDataError, match="joint 'hinge' has a servo, and a capture has no commands of joints"):
        capture(tmp_path, manifest=MANIFEST.replace('urdf = "arm.urdf"', 'mjcf = "arm.xml"'))


def test_models_with_links_of_no_tree_are_refused(tmp_path: Path) -> None:
    opened = capture(tmp_path)
    (arm,) = articulation_models(opened.manifest, articulations_of(tmp_path, opened.manifest))
    bodies = [
        BodyModel(name=body.name, motion="link", mass_kg=1, inertia_kg_m2=(1, 1, 1, 0, 0, 0), com_m=(0, 0, 0))
        for body in opened.manifest.bodies
    ]
    good = ModelFile(bodies=tuple(bodies), articulations=(arm,), provenance=Provenance(capture="c"))
    assert good.tracked == ["upper", "lower"] and good.commanded == []
    assert parse(good.model_dump(mode="json"), ModelFile, "model.json") == good
    for change, message in (
        ({"articulations": []}, "is a link of no articulation"),
        ({"bodies": [bodies[0].model_dump(mode="json")]}, "has the link 'lower', which is no body"),
    ):
        with pytest.raises(InputDataError, match=message):
            parse(good.model_dump(mode="json") | change, ModelFile, "model.json")
