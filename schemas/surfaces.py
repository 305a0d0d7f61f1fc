"""Fixed surfaces of a capture or a model: their shapes and poses."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import FileModel
from .pose import Pose
from .quantities import Length

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=120)]


class HalfSpaceShape(FileModel):
    """All that is below a plane without edges: z <= 0 of the surface's frame."""


class RectangleShape(FileModel):
    """A sheet without thickness in the plane z = 0 of its frame, touched from both sides, with edges."""

    half_extents_m: tuple[Length, Length]
    """Half its sides along x and y [m]."""


class SurfaceBoxShape(FileModel):
    """A solid box, centred at the origin of its frame and aligned with its axes."""

    half_extents_m: tuple[Length, Length, Length]


class CylinderShape(FileModel):
    """A solid cylinder about the z axis of its frame, centred at its origin."""

    radius_m: Length
    half_length_m: Length


class SurfaceMeshShape(FileModel):
    """Triangles in a file beside the manifest (.obj or .stl), in metres."""

    path: str
    inside: Literal["closed", "none", "behind"] | None = None
    """closed: the mesh bounds a solid, and must be closed; none: it is a sheet that is touched from both sides; behind:
    everything behind its triangles is solid, as below a height field. Left out: closed where the mesh is."""


class HeightFieldShape(FileModel):
    """Heights on a grid, between which the surface runs in two triangles a cell; everything below is solid.

    The grid is centred at the origin of its frame. The first row of the file is at the highest y, as in a picture.
    """

    path: str
    """A grey .png of 8 or 16 bits, or a .npy with two dimensions."""
    size_m: tuple[Length, Length]
    """Lengths of the grid along x and y [m]."""
    height_m: Length = 1.0
    """Height of white, black being 0 [m]; of a .npy, the factor by which its numbers become metres."""


class Surface(FileModel):
    """A surface that does not move and that bodies touch: exactly one of the six shapes, at a pose."""

    name: Name
    pose: Pose = Pose()
    """T_world_surface."""
    material: Name | None = None
    """Material, by which its pairs with bodies have their contact law."""
    half_space: HalfSpaceShape | None = None
    rectangle: RectangleShape | None = None
    box: SurfaceBoxShape | None = None
    cylinder: CylinderShape | None = None
    mesh: SurfaceMeshShape | None = None
    height_field: HeightFieldShape | None = None

    @model_validator(mode="after")
    def _one(self) -> Surface:
        kinds = ("half_space", "rectangle", "box", "cylinder", "mesh", "height_field")
        given = [name for name in kinds if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a surface is exactly one of {', '.join(kinds)}; found {given or 'none'}")
        return self
