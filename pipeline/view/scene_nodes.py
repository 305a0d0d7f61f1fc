"""Nodes of a viser scene: splats, balls, cameras and contact marks.

viser's splats are marked experimental. They are used instead of point clouds because they move with their body's frame
without being sent again, are sorted together with the background, and look like those of the renderer.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...datasets.capture.cameras import Camera
from ...datasets.shapes.meshes import Mesh
from ...datasets.shapes.ply import Splats
from ...schemas.articulations import JointModel
from ...schemas.surfaces import Surface
from ..rendering.contact_glyphs import ContactMarks
from .scene_at import BodyShape

_LARGEST_HALF_SIGMA = 200.0
"""Scale of the largest sphere of a group in the unit in which the group is sent: viser sends covariances as
half-precision floats, whose maximum is 65504."""
_POINT_RADIUS = 0.1
"""Radius of a contact point [radii of the largest free body]."""
_SPHERE_RGB = (120, 190, 120)
_JOINT_RGB = {"hinge": (214, 120, 40), "slide": (60, 110, 200)}
_SURFACE_RGB, _SURFACE_OPACITY = (150, 160, 175), 0.45


def add_splats(scene: Any, name: str, splats: Splats) -> Any:
    """Add spherical Gaussians with centres in the frame of the parent node, and return their handle."""
    sigma = np.asarray(splats.scales, np.float64)
    unit = _LARGEST_HALF_SIGMA / float(sigma.max(initial=1e-9))
    return scene.add_gaussian_splats(
        name,
        centers=np.asarray(splats.means, np.float64) * unit,
        covariances=np.eye(3)[None] * (sigma * unit)[:, None, None] ** 2,
        rgbs=as_bytes(np.asarray(splats.colors)),
        opacities=as_bytes(np.asarray(splats.opacities)[:, None]),
        scale=1 / unit,
    )


def add_spheres(scene: Any, name: str, shape: BodyShape) -> Any:
    """Add the collision spheres of a body, and return their handle; None if it has none."""
    if not len(shape.radii_m):
        return None
    return _add_balls(scene, name, shape.centers_m, shape.radii_m, np.array(_SPHERE_RGB, np.uint8))


def add_surface(scene: Any, surface: Surface, mesh: Mesh | None, size_m: float) -> Any:
    """Add a fixed surface, see-through, and return its handle; a half space is a grid of squares of `size_m`."""
    name, place = f"/surfaces/{surface.name}", {"wxyz": surface.pose.quat_wxyz, "position": surface.pose.position_m}
    if surface.half_space is not None:
        return scene.add_grid(name, 20 * size_m, 20 * size_m, cell_size=size_m, **place)
    vertices, faces = _triangles(surface) if mesh is None else (mesh.vertices, mesh.faces)
    return scene.add_mesh_simple(
        name,
        vertices=np.asarray(vertices, np.float32),
        faces=np.asarray(faces, np.uint32),
        color=_SURFACE_RGB,
        opacity=_SURFACE_OPACITY,
        flat_shading=True,
        side="double",
        **place,
    )


def add_joint(scene: Any, name: str, joint: JointModel, size_m: float) -> Any:
    """Add the axis of a joint through the origin of the link that it carries, the parent node; return its handle."""
    axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    ends = np.stack([-0.5 * axis, axis]) * size_m
    return scene.add_arrows(
        name,
        ends[None].astype(np.float32),
        np.array([_JOINT_RGB[joint.kind]], np.uint8),
        shaft_radius=0.03 * size_m,
        head_radius=0.07 * size_m,
        head_length=0.15 * size_m,
    )


def _triangles(surface: Surface) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the corners (V, 3) [m] and triangles (F, 3) of a rectangle, box or cylinder, in its frame."""
    import trimesh  # comes with viser  # pyright: ignore[reportMissingImports]

    if surface.cylinder is not None:
        sizes = {"radius": surface.cylinder.radius_m, "height": 2 * surface.cylinder.half_length_m}
        shape = trimesh.creation.cylinder(**sizes, sections=48)
    else:
        half = surface.box.half_extents_m if surface.box is not None else (*surface.rectangle.half_extents_m, 0.0)  # pyright: ignore[reportOptionalMemberAccess]
        shape = trimesh.creation.box(extents=2 * np.asarray(half))
    return np.asarray(shape.vertices), np.asarray(shape.faces)


def _add_balls(scene: Any, name: str, centers_m: NDArray[Any], radii_m: NDArray[Any], colors: NDArray[np.uint8]) -> Any:
    import trimesh  # comes with viser  # pyright: ignore[reportMissingImports]

    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    return scene.add_batched_meshes_simple(
        name,
        vertices=np.asarray(ball.vertices, np.float32),
        faces=np.asarray(ball.faces, np.uint32),
        batched_wxyzs=np.tile(np.array([1.0, 0, 0, 0]), (len(radii_m), 1)),
        batched_positions=centers_m,
        batched_scales=radii_m,
        batched_colors=linear(colors),
        lod="off",
    )


def add_camera(scene: Any, name: str, camera: Camera, scale_m: float) -> Any:
    """Add a camera `/cameras/<name>` without a picture, drawn as a frustum of length `scale_m` [m]."""
    pose = camera.T_world_cam
    return scene.add_camera_frustum(
        f"/cameras/{name}",
        fov=vertical_angle_rad(camera),
        aspect=camera.width / camera.height,
        scale=scale_m,
        thickness=0.03 * scale_m,
        color=(40, 44, 52),
        format="jpeg",
        jpeg_quality=85,
        wxyz=quat_of(pose[:3, :3]),
        position=pose[:3, 3],
    )


def vertical_angle_rad(camera: Camera) -> float:
    """Return a camera's vertical angle of view [rad]."""
    return 2 * math.atan(0.5 * camera.height / float(camera.K[1, 1]))


def add_marks(scene: Any, count: int, size_m: float) -> list[Any]:
    """Add points and arrows for the maximum number of simultaneous contacts; a constant number avoids flicker."""
    nowhere, colors = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.uint8)
    points = _add_balls(scene, "/contacts/points", nowhere, np.full(count, _POINT_RADIUS * size_m), colors)
    arrows = scene.add_arrows(
        "/contacts/impulses",
        np.stack([nowhere, nowhere], axis=1),
        colors,
        shaft_radius=0.035 * size_m,
        head_radius=0.08 * size_m,
        head_length=0.16 * size_m,
    )
    return [points, arrows]


def place_marks(handles: list[Any], marks: ContactMarks, wanted: bool) -> None:
    """Move the marks of `add_marks` to the contacts of a frame, or hide them if there are none."""
    for handle in handles:
        handle.visible = wanted and len(marks) > 0
    if not handles or not len(marks):
        return
    points, arrows = handles
    # unused marks lie on the last contact
    chosen = np.minimum(np.arange(len(arrows.points)), len(marks) - 1)
    colors = linear(marks.colors[chosen])
    points.batched_positions, points.batched_colors = marks.points_m[chosen].astype(np.float32), colors
    arrows.points, arrows.colors = marks.segments_m[chosen].astype(np.float32), colors


def as_bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Return values in [0, 1] as bytes."""
    return (np.clip(values, 0.0, 1.0) * 255).round().astype(np.uint8)


def linear(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert sRGB values (IEC 61966-2-1) to the linear ones that viser expects for instances and arrows."""
    values = colors / 255.0
    return as_bytes(np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4))


def quat_of(rotation: NDArray[Any]) -> NDArray[np.float64]:
    """Return the quaternion w x y z (4,) of a rotation matrix (3, 3)."""
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
