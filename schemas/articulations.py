"""Jointed bodies of a capture and of a model: links in a tree, and their joints."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import FileModel
from .pose import Pose
from .quantities import Position3, Vector3

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=120)]
Base = Literal["free", "driven", "fixed"]
"""How the root link moves."""
Stop = Annotated[float, Field(ge=-1e6, le=1e6)]
Coefficient = Annotated[float, Field(ge=0, le=1e9)]


class Articulation(FileModel):
    """A jointed body of a capture; its links are bodies by the names that they have in the file."""

    name: Name
    urdf: str | None = None
    """A URDF file of the capture's directory; meshes lie beside it."""
    mjcf: str | None = None
    """An MJCF file of the capture's directory."""
    base: Base = "free"
    """How the root link moves; driven: its track is the command; fixed: at `pose`."""
    pose: Pose | None = None
    """Pose T_world_link of the root link of a fixed base."""
    material: Name | None = None
    """Material of its links."""

    @property
    def path(self) -> str:
        """The file."""
        return self.urdf or self.mjcf or ""

    @model_validator(mode="after")
    def _one_file(self) -> Articulation:
        if (self.urdf is None) == (self.mjcf is None):
            raise ValueError("an articulation has exactly one of urdf and mjcf")
        if (self.base == "fixed") != (self.pose is not None):
            raise ValueError('pose is that of the root link of a base = "fixed", and needed there')
        return self


class JointModel(FileModel):
    """A joint of a model."""

    name: Name
    kind: Literal["hinge", "slide", "fixed"]
    link: Name
    """The body that the joint carries; a hinge's axis goes through its origin."""
    parent: Name
    """The body that it is attached to."""
    position_m: Position3 = (0.0, 0.0, 0.0)
    """Origin of the link's frame in the parent's at value 0 [m]."""
    quat_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Its orientation there."""
    axis: Vector3 = (0.0, 0.0, 1.0)
    """Axis in the link's frame."""
    lower: Stop | None = None
    """Smallest value [rad or m]; None for none."""
    upper: Stop | None = None
    """Largest value [rad or m]; None for none."""
    damping: Coefficient = 0.0
    """Viscous damping [N m s/rad or N s/m]."""
    friction: Coefficient = 0.0
    """Dry friction [N m or N]."""
    armature: Coefficient = 0.0
    """Reflected inertia [kg m2 or kg]."""
    stiffness: Coefficient = 0.0
    """Gain of the servo [N m/rad or N/m]; 0: a passive joint."""
    torque_limit: Annotated[float, Field(gt=0, le=1e9)] | None = None
    """Largest torque or force of the servo [N m or N]; None for none."""

    @model_validator(mode="after")
    def _possible(self) -> JointModel:
        if not math.isclose(math.hypot(*self.quat_wxyz), 1.0, abs_tol=1e-3):
            raise ValueError(f"joint '{self.name}': its quaternion has norm {math.hypot(*self.quat_wxyz):.4f}")
        if not math.hypot(*self.axis) > 1e-9:
            raise ValueError(f"joint '{self.name}': its axis is no direction")
        if self.lower is not None and self.upper is not None and self.lower > self.upper:
            raise ValueError(f"joint '{self.name}': lower {self.lower:g} is above upper {self.upper:g}")
        return self


class ArticulationModel(FileModel):
    """A jointed body of a model; its links are bodies whose motion is "link"."""

    name: Name
    root: Name
    """The link that carries the others."""
    base: Base
    """How the root link moves."""
    joints: Annotated[tuple[JointModel, ...], Field(min_length=1)]
    """The joints, parents before children."""

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links, the root first."""
        return (self.root, *(joint.link for joint in self.joints))

    @property
    def servos(self) -> tuple[str, ...]:
        """Names of the joints that have a servo."""
        return tuple(joint.name for joint in self.joints if joint.stiffness > 0)

    @property
    def moving_links(self) -> tuple[str, ...]:
        """Names of the links that the free root or a joint moves."""
        moved = [self.root] if self.base == "free" else []
        for joint in self.joints:
            if joint.kind != "fixed" or joint.parent in moved:
                moved.append(joint.link)
        return tuple(moved)


def require_links(articulations: tuple[ArticulationModel, ...], bodies: dict[str, str]) -> None:
    """Refuse links that are no bodies with motion "link", in two trees, or before their parent.

    Args:
        articulations: The jointed bodies of a model.
        bodies: Motion of each body, by name.

    Raises:
        ValueError: With the name of the first such link.
    """
    owner: dict[str, str] = {}
    for one in articulations:
        seen: set[str] = set()
        for link, parent in zip(one.links, (None, *(joint.parent for joint in one.joints)), strict=True):
            if bodies.get(link) != "link":
                raise ValueError(
                    f"articulation '{one.name}' has the link '{link}', which is no body of motion \"link\""
                )
            if link in owner:
                raise ValueError(f"link '{link}' is carried twice: a loop; joints form a tree")
            if parent is not None and parent not in seen:
                raise ValueError(f"link '{link}' hangs on '{parent}', which is not among the links before it")
            owner[link] = one.name
            seen.add(link)
    lost = next((name for name, motion in bodies.items() if motion == "link" and name not in owner), None)
    if lost is not None:
        raise ValueError(f"body '{lost}' has the motion \"link\", but is a link of no articulation")
