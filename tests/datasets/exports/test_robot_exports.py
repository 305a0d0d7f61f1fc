"""URDF and USD of models: opened again by MuJoCo and by usd-core, with masses, joints, surfaces and shapes."""

import importlib.util
import math
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest
from cgwm.datasets.exports.robot_parts import roll_pitch_yaw
from cgwm.datasets.exports.urdf import urdf_of
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.robots import read_articulation
from cgwm.pipeline.export import export
from cgwm.pipeline.export.sdf_check import sdf_deviation
from cgwm.pipeline.export.urdf_check import open_urdf, urdf_deviation
from cgwm.schemas import InputDataError, JointModel, UsageError
from helpers.jointed_model import HEIGHT_M, RADIUS, jointed_model
from helpers.small_model import MASS, small_model
from helpers.tray import in_tray
from scipy.spatial.transform import Rotation

needs_usd = pytest.mark.skipif(
    importlib.util.find_spec("pxr") is None, reason="usd-core is not installed: pip install 'cgwm[usd]'"
)
LIMITS = (-0.5, 1.0)
SLIDE = JointModel(
    name="rail", kind="slide", link="lower", parent="upper", position_m=(0.1, 0, 0.02), quat_wxyz=(0.8, 0, 0.6, 0),
    axis=(0.6, 0, 0.8), lower=-0.02, upper=0.05, damping=3.0, stiffness=40.0, torque_limit=2.0,
)  # fmt: skip


def with_joint(model: Model, joint: JointModel) -> Model:
    entry = model.file.articulations[0].model_copy(update={"joints": (joint,)})
    return replace(model, file=model.file.model_copy(update={"articulations": (entry,)}))


def made(path: Path, model: Model, form: str) -> Path:
    write_model(path / "model", model)
    out = path / ("out.usda" if form == "usd" else "out")
    result = export(path / "model", form, out)  # pyright: ignore[reportArgumentType]
    assert result.facts["deviation_of_links_mm"] < 1e-3
    assert result.facts["deviation_of_links_deg"] < 1e-3
    return out


def test_the_angles_of_a_rotation_give_it_back() -> None:
    rng = np.random.default_rng(0)
    turns = [Rotation.from_quat(rng.normal(size=4)).as_matrix() for _ in range(20)]
    turns += [Rotation.from_euler("xyz", (0.3, sign * math.pi / 2, 0.0)).as_matrix() for sign in (-1, 1)]
    for turn in turns:
        again = Rotation.from_euler("xyz", roll_pitch_yaw(turn)).as_matrix()
        np.testing.assert_allclose(again, turn, atol=1e-12)


def test_a_urdf_of_joints_is_read_back_by_two_readers(tmp_path: Path) -> None:
    model = jointed_model("fixed", LIMITS, cube=True)
    out = made(tmp_path, model, "urdf")
    assert sorted(path.name for path in out.glob("*.urdf")) == ["arm.urdf", "cube.urdf", "scene.urdf"]
    loaded = open_urdf(out / "arm.urdf")
    assert loaded.body("lower").mass[0] == pytest.approx(0.3)
    np.testing.assert_allclose(loaded.body("lower").ipos, [0.05, 0, 0])
    np.testing.assert_allclose(np.sort(loaded.body("lower").inertia), [1e-5, 2e-4, 2e-4])
    np.testing.assert_allclose(loaded.joint("elbow").range, LIMITS)
    assert loaded.joint("elbow").damping[0] == pytest.approx(1e-4)
    assert loaded.geom_size[0, 0] == pytest.approx(model.body("upper").radius_factor * RADIUS)
    data = mujoco.MjData(loaded)
    mujoco.mj_kinematics(loaded, data)
    np.testing.assert_allclose(data.body("upper").xpos, [0, 0, HEIGHT_M])
    found = read_articulation(out / "arm.urdf", bare_links=True)
    assert [joint.name for joint in found.joints] == ["upper_in_world", "elbow"]
    cube = open_urdf(out / "cube.urdf")
    assert cube.ngeom == 27
    bent = with_joint(model, model.file.articulations[0].joints[0].model_copy(update={"axis": (0, 0, 1)}))
    assert urdf_deviation(bent, out, 0)[1] > 1.0  # the check sees another axis
    assert (out / "meshes" / "cube.obj").read_text().startswith("v ")


@pytest.mark.parametrize("base", ["free", "fixed"])
def test_slides_and_one_sided_limits_are_in_the_urdf(tmp_path: Path, base: str) -> None:
    out = made(tmp_path, with_joint(jointed_model(base), SLIDE), "urdf")
    loaded = open_urdf(out / "arm.urdf")
    np.testing.assert_allclose(loaded.joint("rail").range, [-0.02, 0.05])
    open_ended = with_joint(jointed_model(base), SLIDE.model_copy(update={"upper": None}))
    text = urdf_of(open_ended, "arm", {}).find(".//joint[@name='rail']/limit")
    assert text is not None and text.attrib["upper"] == "10000" and text.attrib["effort"] == "2"


def test_fixed_surfaces_are_a_scene(tmp_path: Path) -> None:
    out = made(tmp_path, in_tray(), "urdf")
    loaded = open_urdf(out / "scene.urdf")
    assert loaded.ngeom == 5 and loaded.nv == 0
    assert {path.name for path in out.glob("*.urdf")} == {"cube.urdf", "other.urdf", "scene.urdf"}


@pytest.mark.parametrize("base", ["free", "driven", "fixed"])
def test_an_sdf_has_bodies_joints_and_materials(tmp_path: Path, base: str) -> None:
    model = with_joint(jointed_model(base, cube=True), SLIDE.model_copy(update={"name": "lower", "upper": None}))
    path = made(tmp_path, model, "sdf") / "world.sdf"
    root = ET.parse(path).getroot()
    assert root.findtext("world/gravity") == "0 0 -9.81"
    assert root.findtext("world/model[@name='cube']/pose") == "0.3 0 0.05 0 0 0"
    assert float(root.findtext("world/model[@name='cube']/link/inertial/mass", "")) == MASS
    assert len(root.findall("world/model[@name='cube']/link/collision/geometry/sphere")) == 27
    assert root.findtext("world/model[@name='arm']/link/collision/surface/friction/ode/mu") == "0.4"
    slide = root.find("world/model/joint[@name='lower_joint']")  # a link has the name 'lower'
    assert slide is not None and slide.get("type") == "prismatic"
    limit = {one.tag: one.text for one in slide.findall("axis/limit/*")}
    assert limit == {"lower": "-0.02", "effort": "2"}
    held = root.find("world/model/joint[@name='upper_in_world']")
    assert (held is not None) == (base == "fixed")
    assert (root.find("world/model/link[@name='upper']/kinematic") is not None) == (base == "driven")
    bent = with_joint(model, SLIDE.model_copy(update={"name": "lower", "axis": (0, 0, 1)}))
    assert sdf_deviation(bent, root, 0)[0] > 1.0  # the check sees another axis
    assert (path.parent / "meshes" / "cube.obj").is_file()


def test_fixed_surfaces_and_hinges_are_in_the_sdf(tmp_path: Path) -> None:
    still = ET.parse(made(tmp_path / "tray", in_tray(), "sdf") / "world.sdf").getroot().findall("world/model[static]")
    assert [one.get("name") for one in still] == ["floor", "left", "right", "front", "back"]
    made(tmp_path / "arm", jointed_model("free", LIMITS), "sdf")


@needs_usd
def test_a_stage_has_masses_spheres_joints_drives_and_materials(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade  # pyright: ignore[reportMissingImports]

    model = jointed_model("fixed", LIMITS, cube=True)
    joint = model.file.articulations[0].joints[0]
    model = with_joint(model, joint.model_copy(update={"stiffness": 2.0, "damping": 0.1, "torque_limit": 0.5}))
    stage = Usd.Stage.Open(str(made(tmp_path, model, "usd")))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    scene = UsdPhysics.Scene.Get(stage, "/World/physics")
    assert scene.GetGravityMagnitudeAttr().Get() == pytest.approx(9.81)
    cube = stage.GetPrimAtPath("/World/cube")
    assert cube.HasAPI(UsdPhysics.RigidBodyAPI)
    assert UsdPhysics.MassAPI(cube).GetMassAttr().Get() == pytest.approx(MASS)
    spheres = [p for p in stage.Traverse() if p.GetTypeName() == "Sphere" and p.HasAPI(UsdPhysics.CollisionAPI)]
    assert len(spheres) == 27 + 4
    law, _ = UsdShade.MaterialBindingAPI(spheres[0]).ComputeBoundMaterial("physics")
    assert UsdPhysics.MaterialAPI(law.GetPrim()).GetDynamicFrictionAttr().Get() == pytest.approx(0.4)
    hinge = UsdPhysics.RevoluteJoint.Get(stage, "/World/lower/elbow_joint")
    limits = [hinge.GetLowerLimitAttr().Get(), hinge.GetUpperLimitAttr().Get()]
    np.testing.assert_allclose(limits, np.degrees(LIMITS), rtol=1e-6)
    drive = UsdPhysics.DriveAPI(hinge.GetPrim(), "angular")
    assert drive.GetStiffnessAttr().Get() == pytest.approx(2.0 * math.pi / 180)
    assert drive.GetMaxForceAttr().Get() == 0.5
    assert stage.GetPrimAtPath("/World/upper").HasAPI(UsdPhysics.ArticulationRootAPI)
    pairs = UsdPhysics.FilteredPairsAPI(stage.GetPrimAtPath("/World/upper")).GetFilteredPairsRel().GetTargets()
    assert [str(path) for path in pairs] == ["/World/lower"]
    inertia = UsdPhysics.MassAPI(stage.GetPrimAtPath("/World/lower")).GetDiagonalInertiaAttr().Get()
    np.testing.assert_allclose(np.sort(inertia), [1e-5, 2e-4, 2e-4], rtol=1e-5)
    place = UsdGeom.Xformable(stage.GetPrimAtPath("/World/lower")).ComputeLocalToWorldTransform(0)
    np.testing.assert_allclose(place.ExtractTranslation(), [0.1, 0, HEIGHT_M], atol=1e-9)


@needs_usd
@pytest.mark.parametrize("base", ["free", "driven", "fixed"])
def test_slides_of_every_base_are_in_the_stage(tmp_path: Path, base: str) -> None:
    made(tmp_path, with_joint(jointed_model(base), SLIDE), "usd")


@needs_usd
def test_surfaces_and_driven_bodies_are_in_the_stage(tmp_path: Path) -> None:
    from pxr import Usd, UsdPhysics  # pyright: ignore[reportMissingImports]

    stage = Usd.Stage.Open(str(made(tmp_path / "tray", in_tray(), "usd")))
    walls = [p for p in stage.Traverse() if p.GetTypeName() == "Cube"]
    assert len(walls) == 5 and all(p.HasAPI(UsdPhysics.CollisionAPI) for p in walls)
    stage = Usd.Stage.Open(str(made(tmp_path / "push", small_model(driven=True), "usd")))
    tip = UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath("/World/tip"))
    assert tip.GetKinematicEnabledAttr().Get()
    assert stage.GetPrimAtPath("/World/ground").GetTypeName() == "Plane"


def test_equal_names_and_other_suffixes_are_refused(tmp_path: Path) -> None:
    model = small_model(visible=False)
    named = model.file.bodies[0].model_copy(update={"name": "scene"})
    file = model.file.model_copy(update={"bodies": (named,), "parameters": model.file.parameters[:2]})
    write_model(tmp_path / "model", replace(model, file=file, collision={"scene": model.collision["cube"]}))
    with pytest.raises(InputDataError, match=r"two things would be scene.urdf"):
        export(tmp_path / "model", "urdf", tmp_path / "out")
    named = model.file.bodies[0].model_copy(update={"name": "ground"})
    file = model.file.model_copy(update={"bodies": (named,), "parameters": model.file.parameters[:2]})
    write_model(tmp_path / "ground", replace(model, file=file, collision={"ground": model.collision["cube"]}))
    with pytest.raises(InputDataError, match=r"two things would be the model 'ground'"):
        export(tmp_path / "ground", "sdf", tmp_path / "out")
    with pytest.raises(UsageError, match=r"(?s)--to usd writes one file.*a name that ends in .usda"):
        export(tmp_path / "model", "usd", tmp_path / "out.usd")
    assert not (tmp_path / "out").exists()


def test_without_usd_core_the_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    write_model(tmp_path / "model", small_model(visible=False))
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.delitem(sys.modules, "pxr.UsdPhysics", raising=False)
    with pytest.raises(UsageError, match=r"(?s)needs usd-core, which is not installed.*pip install 'cgwm\[usd\]'"):
        export(tmp_path / "model", "usd", tmp_path / "out.usda")
