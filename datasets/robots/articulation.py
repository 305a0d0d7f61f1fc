"""Links and joints of an articulated body, as a robot's file describes them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.distinct import first_repeated
from ..shapes.meshes import Mesh
from ..shapes.turns import matrix_of, quat_of_matrix, quat_product

Array = NDArray[np.float64]
LARGEST_M = 20.0
"""Extent of a link [m] beyond which its mesh is taken for one in millimetres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GeometryOfLink:
    """A solid that is fixed to a link: a box, a ball, an ellipsoid, a cylinder, a capsule or a mesh."""

    kind: str
    """"box", "sphere", "ellipsoid", "cylinder", "capsule" or "mesh"."""
    size_m: tuple[float, ...]
    """Half extents of a box or ellipsoid; radius of a ball; radius and half length along z of a cylinder or capsule; ()
    of a mesh.
    """
    rotation: Array
    """Orientation in the link's frame, shape (3, 3)."""
    position_m: Array
    """Origin in the link's frame [m], shape (3,)."""
    mesh: Mesh | None = None
    """The mesh, scaled [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LinkOfRobot:
    """A link: its mass, and what collides."""

    name: str
    """Name of the link."""
    mass_kg: float
    """Mass [kg]."""
    com_m: Array
    """Centre of mass in the link's frame [m], shape (3,)."""
    inertia_kg_m2: Array
    """Inertia about the centre of mass, axes of the link's frame, shape (3, 3)."""
    geometry: tuple[GeometryOfLink, ...]
    """What collides; empty for a link that nothing touches."""

    def require_geometry(self, path: Path, todo: str) -> None:
        """Check that the link has collision geometry.

        Args:
            path: The file of the robot.
            todo: What to do next where it has none.

        Raises:
            InputDataError: If it has none.
        """
        if not self.geometry:
            raise InputDataError(
                f"{path}: link '{self.name}' has no collision geometry, so nothing could touch it.",
                "a box, sphere, cylinder or mesh: <collision> of a URDF, a <geom> of an MJCF that collides.",
                todo,
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class JointOfRobot:
    """A joint between two links."""

    name: str
    """Name of the joint."""
    kind: str
    """"hinge", "slide" or "fixed"."""
    parent: str
    """Name of the link that carries the other."""
    link: str
    """Name of the link that the joint carries; a hinge's axis goes through its origin."""
    position_m: Array
    """Origin of the link's frame in the parent's at value 0 [m], shape (3,)."""
    quat_wxyz: Array
    """Its orientation there, shape (4,)."""
    axis: Array
    """Axis in the link's frame, shape (3,)."""
    lower: float = -math.inf
    """Smallest value [rad or m]."""
    upper: float = math.inf
    """Largest value [rad or m]."""
    stiffness: float = 0.0
    """Servo gain [N m/rad or N/m]."""
    damping: float = 0.0
    """Viscous damping [N m s/rad or N s/m]."""
    armature: float = 0.0
    """Reflected inertia [kg m2 or kg]."""
    friction: float = 0.0
    """Dry friction [N m or N]."""
    torque_limit: float = math.inf
    """Largest torque or force of the servo [N m or N]."""
    lowest_target: float = -math.inf
    """Smallest target that the servo takes [rad or m]."""
    highest_target: float = math.inf
    """Largest target that it takes [rad or m]."""

    def require_possible(self, path: Path) -> None:
        """Check that the joint of a file has an axis, and limits in their order.

        Raises:
            InputDataError: If it has not.
        """
        if not np.linalg.norm(self.axis) > 0:
            raise InputDataError(
                f"{path}: joint '{self.name}' has an axis of length 0.", "a direction.", "give it one, such as 0 0 1."
            )
        if self.lower > self.upper:
            raise InputDataError(
                f"{path}: joint '{self.name}' has the limits {self.lower:g} to {self.upper:g}.",
                "a lower limit that is not above the upper one.",
                "exchange them.",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Articulation:
    """A tree of links, the root first, and its joints, parents before children."""

    name: str
    """Name of the robot."""
    path: Path
    """The file it was read from."""
    links: tuple[LinkOfRobot, ...]
    """The links in the order of the joints, the root first."""
    joints: tuple[JointOfRobot, ...]
    """The joint of each link but the root."""
    outside: tuple[str, ...] = ()
    """Names of what collides in the file and belongs to no link, as a floor."""

    @staticmethod
    def tree(name: str, path: Path, links: dict[str, LinkOfRobot], joints: list[JointOfRobot]) -> Articulation:
        """Order links and joints from the root on.

        Raises:
            InputDataError: If they are not one tree.
        """
        carrier = _carriers(path, links, joints)
        order, placed = _from_root(_root(path, [link for link in links if link not in carrier]), joints)
        _require_all(path, links, order)
        _require_own_names(path, [joint.name for joint in placed])
        for joint in placed:
            joint.require_possible(path)
        return Articulation(name=name, path=path, links=tuple(links[link] for link in order), joints=tuple(placed))

    def require_limits(self) -> None:
        """Check that each moving joint has limits, which a servo's command needs.

        Raises:
            InputDataError: If one has none.
        """
        for joint in self.joints:
            if joint.kind != "fixed" and not (math.isfinite(joint.lower) and math.isfinite(joint.upper)):
                raise InputDataError(
                    f"{self.path}: joint '{joint.name}' has a servo and no limits.",
                    "<limit lower=... upper=.../>, or range=... in MJCF.",
                    "give it limits.",
                )

    def require_geometry(self) -> None:
        """Check that each link with mass below a joint that moves has collision geometry.

        Raises:
            InputDataError: If one has none.
        """
        for link in self.links:
            if link.mass_kg > 0:
                link.require_geometry(self.path, "add one, or ask for links without it by bare_links=True.")

    def require_metres(self) -> None:
        """Check that no mesh is far too large, as one in millimetres is.

        Raises:
            InputDataError: If one is.
        """
        for link in self.links:
            for part in link.geometry:
                if part.mesh is not None and float(np.ptp(part.mesh.vertices, axis=0).max()) > LARGEST_M:
                    size = float(np.ptp(part.mesh.vertices, axis=0).max())
                    raise InputDataError(
                        f"{self.path}: the mesh of link '{link.name}' is {size:.3g} m long; its numbers look like "
                        "millimetres.",
                        f"meshes in metres, up to {LARGEST_M:g} m.",
                        'give the mesh scale="0.001 0.001 0.001".',
                    )

    def welded(self) -> Articulation:
        """Return the articulation with links behind fixed joints made part of the links that carry them."""
        links = {link.name: link for link in self.links}
        home: dict[str, tuple[str, Array, Array]] = {self.links[0].name: (self.links[0].name, np.eye(3), np.zeros(3))}
        joints = []
        for joint in self.joints:
            carrier, turn, shift = home[joint.parent]
            turned, moved = turn @ matrix_of(joint.quat_wxyz), shift + turn @ joint.position_m
            if joint.kind == "fixed":
                links[carrier] = _merged(links[carrier], links.pop(joint.link), turned, moved)
                home[joint.link] = (carrier, turned, moved)
                continue
            home[joint.link] = (joint.link, np.eye(3), np.zeros(3))
            quat = quat_product(quat_of_matrix(turn), joint.quat_wxyz)
            joints.append(replace(joint, parent=carrier, position_m=moved, quat_wxyz=quat))
        return replace(Articulation.tree(self.name, self.path, links, joints), outside=self.outside)


def _merged(carrier: LinkOfRobot, link: LinkOfRobot, turn: Array, shift: Array) -> LinkOfRobot:
    """Return a link and another one that is fixed to it at a place, as one."""
    mass = carrier.mass_kg + link.mass_kg
    com = shift + turn @ link.com_m
    centre = (carrier.mass_kg * carrier.com_m + link.mass_kg * com) / mass if mass > 0 else carrier.com_m
    inertia = carrier.inertia_kg_m2 + turn @ link.inertia_kg_m2 @ turn.T
    for weight, place in ((carrier.mass_kg, carrier.com_m), (link.mass_kg, com)):
        arm = place - centre
        inertia = inertia + weight * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    parts = [replace(p, rotation=turn @ p.rotation, position_m=shift + turn @ p.position_m) for p in link.geometry]
    return replace(carrier, mass_kg=mass, com_m=centre, inertia_kg_m2=inertia, geometry=(*carrier.geometry, *parts))


def _carriers(path: Path, links: dict[str, LinkOfRobot], joints: list[JointOfRobot]) -> dict[str, JointOfRobot]:
    """Return the joint above each link that has one.

    Raises:
        InputDataError: If a joint names no link, or a link has several joints above it.
    """
    above: dict[str, JointOfRobot] = {}
    for joint in joints:
        for end in (joint.parent, joint.link):
            if end not in links:
                raise InputDataError(
                    f"{path}: joint '{joint.name}' names the link '{end}', which is not there.",
                    ", ".join(links) + ".",
                    "correct the name in the joint, or add the link.",
                )
        if joint.link in above:
            raise InputDataError(
                f"{path}: link '{joint.link}' is carried by the joints '{above[joint.link].name}' and "
                f"'{joint.name}': a loop.",
                "a tree: one joint above each link.",
                "leave out the joint that closes the loop.",
            )
        above[joint.link] = joint
    return above


def _root(path: Path, roots: list[str]) -> str:
    """Return the only link that no joint carries.

    Raises:
        InputDataError: If there is none, or several.
    """
    if len(roots) != 1:
        found = "no link is the root: the joints are a ring" if not roots else f"several roots: {', '.join(roots)}"
        raise InputDataError(f"{path}: {found}.", "one tree of links.", "join the links, or leave out the others.")
    return roots[0]


def _from_root(root: str, joints: Sequence[JointOfRobot]) -> tuple[list[str], list[JointOfRobot]]:
    """Return the links that a root carries, itself first, and the joints in the order of the others."""
    order, placed = [root], []
    for link in order:
        below = [joint for joint in joints if joint.parent == link]
        placed += below
        order += [joint.link for joint in below]
    return order, placed


def _require_own_names(path: Path, names: list[str]) -> None:
    """Check that no two joints have one name.

    Raises:
        InputDataError: If two have.
    """
    twice = first_repeated(names)
    if twice is not None:
        raise InputDataError(
            f"{path}: several joints are called '{twice}'.", "a name of its own for each joint.", "rename one of them."
        )


def _require_all(path: Path, links: Iterable[str], reached: Sequence[str]) -> None:
    """Refuse links that cannot be reached from the root."""
    lost = next((link for link in links if link not in reached), None)
    if lost is not None:
        raise InputDataError(
            f"{path}: link '{lost}' hangs in a ring of joints.",
            "one tree of links.",
            "leave out the joint that closes the ring.",
        )
