"""A model as OpenUSD with physics: bodies, collision spheres, meshes, joints and drives, surfaces and materials.

Source: UsdPhysics of OpenUSD (openusd.org, "Rigid Body Physics in USD"). Metres, kilograms, z up. Angles of joints, and
so gains and damping of their drives, are in degrees. Bodies are at their poses in the photos, joints at 0.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import ArticulationModel, BodyModel, ContactParameters, InputDataError, JointModel, UsageError
from ...schemas.distinct import first_repeated
from ...schemas.surfaces import CylinderShape, Surface
from ..models.model import Model
from ..shapes.turns import quat_of_matrix, quat_of_normal, quat_product
from .bop_models import ObjectModel
from .robot_parts import link_poses

Array = NDArray[np.float64]

CREATOR = "cgwm"
PLANE_M = 10.0
"""Half the sides at which a ground and half spaces are drawn [m]; what collides has no edge."""
SHEET_M = 0.001
"""Half the thickness of the box that stands for a rectangle [m]."""


def require_usd() -> None:
    """Refuse to go on without usd-core.

    Raises:
        UsageError: If usd-core is not installed.
    """
    try:
        importlib.import_module("pxr.UsdPhysics")
    except ImportError:
        raise UsageError("--to usd needs usd-core, which is not installed.", todo="pip install 'cgwm[usd]'.") from None


def usd_text(
    model: Model, meshes: Mapping[str, ObjectModel], restitution: Mapping[str, float]
) -> tuple[str, dict[str, int | float | str]]:
    """Return a stage as text (.usda), and the number of bodies, joints and surfaces.

    Args:
        model: A model with fitted physics.
        meshes: Surface of each body that has spheres, by name.
        restitution: Restitution of each contact law [1], by name of its material: "" is that of all other pairs.

    Raises:
        UsageError: If usd-core is not installed.
        InputDataError: If two names of bodies or surfaces become the same name of a prim.
    """
    require_usd()
    stage = importlib.import_module("pxr.Usd").Stage.CreateInMemory()
    counts = _Writer(stage, model, meshes, restitution).write()
    stage.GetRootLayer().documentation = f"Written by {CREATOR}, of {model.file.provenance.capture}."
    return stage.GetRootLayer().ExportToString(), counts


def prim_name(name: str) -> str:
    """Return a name as a prim may have it: letters, digits and underscores, no digit first.

    >>> prim_name("2nd-link.a"), prim_name("cube")
    ('_2nd_link_a', 'cube')
    """
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"_{plain}" if plain[:1].isdigit() else plain


class _Writer:
    """Writes one model into an empty stage."""

    def __init__(
        self, stage: Any, model: Model, meshes: Mapping[str, ObjectModel], restitution: Mapping[str, float]
    ) -> None:
        self.gf, self.geom, self.physics, self.shade = (
            importlib.import_module(f"pxr.{name}") for name in ("Gf", "UsdGeom", "UsdPhysics", "UsdShade")
        )
        self.stage, self.model, self.meshes, self.restitution = stage, model, meshes, restitution
        self.paths = self._paths()

    def _paths(self) -> dict[str, str]:
        """Return the path of each body and surface, by name."""
        file = self.model.file
        names = [body.name for body in file.bodies] + [surface.name for surface in file.surfaces]
        names += ["ground"] if file.ground is not None else []
        prims = [prim_name(name) for name in names]
        twice = first_repeated(prims)
        if twice is not None:
            raise InputDataError(
                f"{self.model.place}: two things would be the prim '{twice}'.",
                "names of bodies and surfaces that differ in letters and digits, and none is 'ground'.",
                "rename one in the capture.",
            )
        return {name: f"/World/{prim}" for name, prim in zip(names, prims, strict=True)}

    def write(self) -> dict[str, int | float | str]:
        """Write everything, and return the counts."""
        file, geom = self.model.file, self.geom
        geom.SetStageUpAxis(self.stage, geom.Tokens.z)
        geom.SetStageMetersPerUnit(self.stage, 1.0)
        self.physics.SetStageKilogramsPerUnit(self.stage, 1.0)
        world = geom.Xform.Define(self.stage, "/World").GetPrim()
        self.stage.SetDefaultPrim(world)
        world.SetCustomDataByKey("creator", CREATOR)
        scene = self.physics.Scene.Define(self.stage, "/World/physics")
        gravity = np.asarray(file.gravity_m_s2)
        size = float(np.linalg.norm(gravity))
        scene.CreateGravityDirectionAttr(self._vec3f(gravity / size if size else np.array([0, 0, -1.0])))
        scene.CreateGravityMagnitudeAttr(size)
        self._materials()
        for body in file.bodies:
            self._body(body)
        for surface in file.surfaces:
            self._surface(surface)
        self._ground()
        joints = sum(self._jointed(one) for one in file.articulations)
        return {"bodies": len(file.bodies), "joints": joints, "surfaces": len(file.surfaces)}

    def _materials(self) -> None:
        """Add a material for each material of the model, whose law is that with itself, and one for all others."""
        file = self.model.file
        assert file.contact is not None  # the stage export refuses models without fitted physics
        laws: dict[str, ContactParameters] = {"": file.contact}
        laws |= {pair.materials[0]: pair for pair in file.pairs if pair.materials[0] == pair.materials[1]}
        for name, law in laws.items():
            material = self.shade.Material.Define(self.stage, self._material_path(name))
            found = self.physics.MaterialAPI.Apply(material.GetPrim())
            found.CreateStaticFrictionAttr(law.friction)
            found.CreateDynamicFrictionAttr(law.friction)
            found.CreateRestitutionAttr(self.restitution[name])

    def _material_path(self, name: str) -> str:
        own = any(pair.materials == (name, name) for pair in self.model.file.pairs)
        return f"/World/materials/{prim_name(name) if own else 'contact'}"

    def _body(self, body: BodyModel) -> None:
        xform = self.geom.Xform.Define(self.stage, self.paths[body.name])
        prim = xform.GetPrim()
        self._place(xform, *self._pose(body))
        roots = {one.root for one in self.model.file.articulations if one.base == "fixed"}
        if body.motion != "fixed" and body.name not in roots:
            rigid = self.physics.RigidBodyAPI.Apply(prim)
            if body.motion == "driven":
                rigid.CreateKinematicEnabledAttr(True)
            self._mass(prim, body)
        elif body.name in roots:
            self.physics.RigidBodyAPI.Apply(prim)
            self._mass(prim, body)
        self._shape(body)

    def _pose(self, body: BodyModel) -> tuple[Array, Array]:
        """Return position and quaternion of a body: of a link with all joints at 0."""
        for one in self.model.file.articulations:
            if body.name in one.links:
                return link_poses(self.model, one)[body.name]
        return np.asarray(body.photo_pose.position_m, float), np.asarray(body.photo_pose.quat_wxyz, float)

    def _mass(self, prim: Any, body: BodyModel) -> None:
        xx, yy, zz, xy, xz, yz = body.inertia_kg_m2
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1
        mass = self.physics.MassAPI.Apply(prim)
        mass.CreateMassAttr(body.mass_kg)
        mass.CreateCenterOfMassAttr(self._vec3f(body.com_m))
        mass.CreateDiagonalInertiaAttr(self._vec3f(moments))
        mass.CreatePrincipalAxesAttr(self._quatf(quat_of_matrix(axes)))

    def _shape(self, body: BodyModel) -> None:
        path, spheres = self.paths[body.name], self.model.collision.get(body.name)
        mesh = self.meshes.get(body.name)
        if mesh is not None:
            self._mesh(f"{path}/visual", mesh.vertices, mesh.faces, np.asarray(mesh.colors, float) / 255)
        if spheres is None:
            return
        radii = np.asarray(spheres.scales, float) * body.radius_factor
        for k, (center, radius) in enumerate(zip(np.asarray(spheres.means, float), radii, strict=True)):
            sphere = self.geom.Sphere.Define(self.stage, f"{path}/collision/sphere_{k}")
            sphere.CreateRadiusAttr(float(radius))
            sphere.CreateExtentAttr([self._vec3f([-radius] * 3), self._vec3f([radius] * 3)])
            sphere.AddTranslateOp().Set(self.gf.Vec3d(*map(float, center)))
            sphere.CreatePurposeAttr(self.geom.Tokens.guide)  # the mesh is what is seen
            self._collides(sphere.GetPrim(), body.material)

    def _collides(self, prim: Any, material: str | None) -> Any:
        self.physics.CollisionAPI.Apply(prim)
        binding = self.shade.MaterialBindingAPI.Apply(prim)
        found = self.shade.Material.Get(self.stage, self._material_path(material or ""))
        binding.Bind(found, self.shade.Tokens.weakerThanDescendants, "physics")
        return prim

    def _mesh(self, path: str, vertices: Array, faces: NDArray[Any], colors: Array | None) -> Any:
        mesh = self.geom.Mesh.Define(self.stage, path)
        mesh.CreatePointsAttr([self._vec3f(point) for point in vertices])
        mesh.CreateFaceVertexCountsAttr([3] * len(faces))
        mesh.CreateFaceVertexIndicesAttr([int(k) for k in np.asarray(faces).ravel()])
        mesh.CreateSubdivisionSchemeAttr(self.geom.Tokens.none)
        low, high = np.asarray(vertices).min(0), np.asarray(vertices).max(0)
        mesh.CreateExtentAttr([self._vec3f(low), self._vec3f(high)])
        if colors is not None:
            mesh.CreateDisplayColorPrimvar(self.geom.Tokens.vertex).Set([self._vec3f(color) for color in colors])
        return mesh.GetPrim()

    def _surface(self, surface: Surface) -> None:
        path, found = self.paths[surface.name], self.model.surface_meshes.get(surface.name)
        place, quat = np.asarray(surface.pose.position_m, float), np.asarray(surface.pose.quat_wxyz, float)
        if found is not None:
            prim = self._mesh(path, found.vertices, found.faces, None)
            self.physics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr(self.physics.Tokens.none)
        elif surface.half_space is not None:
            prim = self._plane(path)
        elif surface.cylinder is not None:
            prim = self._cylinder(path, surface.cylinder)
        else:
            half = surface.box.half_extents_m if surface.box is not None else (*self._sheet(surface), SHEET_M)
            shape = self.geom.Cube.Define(self.stage, path)
            shape.CreateSizeAttr(2.0)
            prim = shape.GetPrim()
            self._place(self.geom.Xformable(prim), place, quat, half)
        if surface.box is None and surface.rectangle is None:
            self._place(self.geom.Xformable(prim), place, quat)
        self._collides(prim, surface.material)

    def _cylinder(self, path: str, cylinder: CylinderShape) -> Any:
        shape = self.geom.Cylinder.Define(self.stage, path)
        shape.CreateAxisAttr(self.geom.Tokens.z)
        shape.CreateRadiusAttr(cylinder.radius_m)
        shape.CreateHeightAttr(2 * cylinder.half_length_m)
        return shape.GetPrim()

    @staticmethod
    def _sheet(surface: Surface) -> tuple[float, float]:
        assert surface.rectangle is not None  # the last of the shapes
        return surface.rectangle.half_extents_m

    def _ground(self) -> None:
        ground = self.model.file.ground
        if ground is None:
            return
        normal = np.asarray(ground.normal, float)
        prim = self._plane(self.paths["ground"])
        self._place(self.geom.Xformable(prim), normal * ground.offset_m, quat_of_normal(normal))
        self._collides(prim, ground.material)

    def _plane(self, path: str) -> Any:
        plane = self.geom.Plane.Define(self.stage, path)
        plane.CreateAxisAttr(self.geom.Tokens.z)
        plane.CreateWidthAttr(2 * PLANE_M)
        plane.CreateLengthAttr(2 * PLANE_M)
        return plane.GetPrim()

    # Joints

    def _jointed(self, one: ArticulationModel) -> int:
        """Add the joints of a jointed body; return their number."""
        root = self.stage.GetPrimAtPath(self.paths[one.root])
        self.physics.ArticulationRootAPI.Apply(root)
        if one.base == "fixed":
            self._hold(one.root)
        elif one.base == "driven":
            self.physics.RigidBodyAPI(root).CreateKinematicEnabledAttr(True)
        for joint in one.joints:
            self._joint(joint)
        for k, first in enumerate(one.links):
            others = [self.paths[name] for name in one.links[k + 1 :]]
            if others:  # links of one jointed body do not touch each other
                pairs = self.physics.FilteredPairsAPI.Apply(self.stage.GetPrimAtPath(self.paths[first]))
                pairs.CreateFilteredPairsRel().SetTargets(others)
        return len(one.joints)

    def _hold(self, root: str) -> None:
        """Fix a body to the world at its place."""
        fixed = self.physics.FixedJoint.Define(self.stage, f"{self.paths[root]}/in_world")
        place, quat = self._pose(self.model.body(root))
        fixed.CreateBody1Rel().SetTargets([self.paths[root]])
        fixed.CreateLocalPos0Attr(self._vec3f(place))
        fixed.CreateLocalRot0Attr(self._quatf(quat))

    def _joint(self, joint: JointModel) -> None:
        path = f"{self.paths[joint.link]}/{prim_name(joint.name)}_joint"
        kinds = {"hinge": "RevoluteJoint", "slide": "PrismaticJoint", "fixed": "FixedJoint"}
        made = getattr(self.physics, kinds[joint.kind]).Define(self.stage, path)
        made.CreateBody0Rel().SetTargets([self.paths[joint.parent]])
        made.CreateBody1Rel().SetTargets([self.paths[joint.link]])
        # the x axis of both local frames is the joint's axis
        turn = _turn_x_to(np.asarray(joint.axis, float)) if joint.kind != "fixed" else np.array([1.0, 0, 0, 0])
        made.CreateLocalPos0Attr(self._vec3f(joint.position_m))
        made.CreateLocalRot0Attr(self._quatf(quat_product(np.asarray(joint.quat_wxyz, float), turn)))
        made.CreateLocalPos1Attr(self._vec3f((0, 0, 0)))
        made.CreateLocalRot1Attr(self._quatf(turn))
        if joint.kind == "fixed":
            return
        made.CreateAxisAttr(self.physics.Tokens.x)
        self._limits_and_drive(made, joint)

    def _limits_and_drive(self, made: Any, joint: JointModel) -> None:
        unit = np.degrees(1.0) if joint.kind == "hinge" else 1.0
        if joint.lower is not None:
            made.CreateLowerLimitAttr(float(joint.lower * unit))
        if joint.upper is not None:
            made.CreateUpperLimitAttr(float(joint.upper * unit))
        if joint.damping or joint.stiffness:
            self._drive(made, joint, unit)

    def _drive(self, made: Any, joint: JointModel, unit: float) -> None:
        """Add the damping and the servo of a joint, whose positions have this unit [rad, m]."""
        drive = self.physics.DriveAPI.Apply(made.GetPrim(), "angular" if joint.kind == "hinge" else "linear")
        drive.CreateTypeAttr(self.physics.Tokens.force)
        drive.CreateStiffnessAttr(float(joint.stiffness / unit))
        drive.CreateDampingAttr(float(joint.damping / unit))
        if joint.torque_limit is not None:
            drive.CreateMaxForceAttr(float(joint.torque_limit))

    # Values

    def _place(self, xform: Any, place: Array, quat: Array, scale: tuple[float, float, float] | None = None) -> None:
        xform.AddTranslateOp().Set(self.gf.Vec3d(*map(float, place)))
        double = self.geom.XformOp.PrecisionDouble
        w, x, y, z = map(float, quat / np.linalg.norm(quat))
        xform.AddOrientOp(double).Set(self.gf.Quatd(w, self.gf.Vec3d(x, y, z)))
        if scale is not None:
            xform.AddScaleOp().Set(self._vec3f(scale))

    def _vec3f(self, values: Any) -> Any:
        return self.gf.Vec3f(*(float(x) for x in values))

    def _quatf(self, quat: Array) -> Any:
        w, x, y, z = map(float, quat / np.linalg.norm(quat))
        return self.gf.Quatf(w, self.gf.Vec3f(x, y, z))


def _turn_x_to(axis: Array) -> Array:
    """Return the quaternion (4,) of the shortest turn that takes x to an axis."""
    x, y, z = axis / np.linalg.norm(axis)
    if x < -1 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0])
    quat = np.array([1 + x, 0.0, -z, y])
    return quat / np.linalg.norm(quat)
