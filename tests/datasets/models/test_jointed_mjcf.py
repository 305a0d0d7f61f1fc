"""MJCF of jointed bodies: links are where our engine has them, and the file is read back as the same chain."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from cgwm.datasets.models.joints import refuse_joints
from cgwm.datasets.models.mjcf import write_mjcf
from cgwm.datasets.models.model import Model, read_model, write_model
from cgwm.datasets.robots import read_articulation
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.export.mujoco_check import link_deviation
from cgwm.schemas import (
    ArticulationModel,
    BodyModel,
    ContactParameters,
    Ground,
    InputDataError,
    JointModel,
    ModelFile,
    Pose,
    Provenance,
)

NAMES = ("base", "upper", "lower", "tool")
JOINTS = (
    JointModel(name="first", kind="hinge", link="upper", parent="base", position_m=(0.1, 0, 0.02), axis=(0, 1, 0),
               quat_wxyz=(0.8, 0.6, 0, 0), lower=-0.5, upper=0.9, damping=0.01, friction=0.002),
    JointModel(name="second", kind="slide", link="lower", parent="upper", position_m=(0, 0.05, 0), axis=(0.6, 0, 0.8),
               lower=-0.1, armature=0.03),
    JointModel(name="weld", kind="fixed", link="tool", parent="lower", position_m=(0, 0, 0.1),
               quat_wxyz=(0, 0, 1, 0)),
)  # fmt: skip


def model(base: str) -> Model:
    """Return a model of four links, of which one is welded on and one slides."""
    inertia = (2e-5, 3e-5, 4e-5, 1e-6, 0.0, -1e-6)
    bodies = tuple(
        BodyModel(name=name, motion="link", mass_kg=0.1 * (k + 1), inertia_kg_m2=inertia, com_m=(0.01, 0, 0.02),
                  photo_pose=Pose(position_m=(0.3, 0, 0.4)) if k == 0 else Pose())
        for k, name in enumerate(NAMES)
    )  # fmt: skip
    arm = ArticulationModel.model_validate({"name": "arm", "root": "base", "base": base, "joints": JOINTS})
    one = Splats(np.array([[0.0, 0.0, 0.01]]), np.array([0.01]), np.array([0.9]), np.full((1, 3), 0.5))
    file = ModelFile(
        ground=Ground(), bodies=bodies, articulations=(arm,), contact=ContactParameters(),
        provenance=Provenance(capture="c"),
    )  # fmt: skip
    return Model(root=None, file=file, collision=dict.fromkeys(NAMES, one))


@pytest.mark.parametrize("base", ["free", "driven", "fixed"])
def test_links_are_where_our_engine_has_them(base: str) -> None:
    text = write_mjcf(model(base))
    moved_mm, turned_deg = link_deviation(model(base), text, seed=3)
    assert moved_mm < 1e-6 and turned_deg < 1e-4
    other = replace(model(base), file=model(base).file.model_copy(update={"articulations": ()}))
    arm = model(base).file.articulations[0]
    bent = JOINTS[0].model_copy(update={"axis": (0.0, 0.0, 1.0)})
    other = replace(other, file=other.file.model_copy(update={"articulations": (arm.model_copy(
        update={"joints": (bent, *JOINTS[1:])}),)}))  # fmt: skip
    assert link_deviation(other, text, seed=3)[1] > 1.0  # the check sees another axis
    loaded = mujoco.MjModel.from_xml_string(text)
    assert loaded.nexclude == 6 and loaded.nv == 2 + 6 * (base == "free")
    assert loaded.joint("first").damping[0] == 0.01 and loaded.joint("first").frictionloss[0] == 0.002
    np.testing.assert_allclose(loaded.joint("second").range, [-0.1, 1e4])
    assert loaded.body("tool").mass[0] == pytest.approx(0.4)


def test_the_file_is_read_back_as_the_same_chain(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(write_mjcf(model("free")))
    found = read_articulation(tmp_path / "arm.xml")
    assert [link.name for link in found.links] == list(NAMES)
    for joint, wanted in zip(found.joints, JOINTS, strict=True):
        assert (joint.parent, joint.link, joint.kind) == (wanted.parent, wanted.link, wanted.kind)
        np.testing.assert_allclose(joint.position_m, wanted.position_m, atol=1e-9)
        np.testing.assert_allclose(np.abs(joint.quat_wxyz @ wanted.quat_wxyz), 1.0, atol=1e-9)
        if wanted.kind != "fixed":
            np.testing.assert_allclose(joint.axis, wanted.axis, atol=1e-9)
            assert (joint.damping, joint.friction, joint.armature) == (wanted.damping, wanted.friction, wanted.armature)


def test_a_model_is_written_and_read_and_refused_where_joints_are_not_taken(tmp_path: Path) -> None:
    written = write_model(tmp_path / "model", model("fixed"))
    assert read_model(tmp_path / "model").file == written.file
    with pytest.raises(InputDataError, match=r"M: it has jointed bodies \('arm'\), which view does not take yet"):
        refuse_joints(written.file.articulations, "M", "view")


def test_servos_are_position_actuators() -> None:
    plain = model("fixed")
    served = JOINTS[0].model_copy(update={"stiffness": 2.5, "torque_limit": 0.4})
    arm = plain.file.articulations[0].model_copy(update={"joints": (served, *JOINTS[1:])})
    text = write_mjcf(replace(plain, file=plain.file.model_copy(update={"articulations": (arm,)})))
    loaded = mujoco.MjModel.from_xml_string(text)
    assert loaded.nu == 1
    assert loaded.actuator_gainprm[0, 0] == 2.5 and loaded.actuator_biasprm[0, 1] == -2.5
    np.testing.assert_array_equal(loaded.actuator_forcerange[0], [-0.4, 0.4])
    assert mujoco.MjModel.from_xml_string(write_mjcf(plain)).nu == 0
