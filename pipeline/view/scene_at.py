"""The scene at one moment of a motion: shapes and poses of the bodies, and contact marks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.models.model import Model
from ...datasets.shapes.ply import Splats
from ..geometry.spheres import Spheres
from ..rendering.contact_glyphs import ContactMarks, arrow_scale, contact_marks
from ..rendering.relighting import Relighting
from ..synthesize.plan import up_direction
from .motions import Motion

Array = NDArray[np.float64]

LONGEST_ARROW = 2.5
"""Length of the arrow of a motion's largest impulse [radii of the largest free body]."""
_UNKNOWN_RADIUS_M = 0.1
"""Size of the marks if no free body has a shape [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyShape:
    """Visual and collision spheres of a body, in its body frame."""

    name: str
    """Name of the body."""
    splats: Splats | None
    """Visual spheres; None without them."""
    centers_m: Array
    """Centres of the collision spheres [m], shape (N, 3); N = 0 without them."""
    radii_m: Array
    """Radii of the collision spheres [m], shape (N,)."""
    _relighting: Relighting | None = None
    """Change of the light on the splats as the body turns; None if their colours do not change."""

    def colors_at(self, quat_wxyz: Array) -> Array:
        """Return the colours of the splats (M, 3) for an orientation (4,), in the light of the model."""
        if self.splats is None:
            return np.zeros((0, 3))
        colors = np.asarray(self.splats.colors, np.float64)
        if self._relighting is not None:
            factors = self._relighting.factors(torch.as_tensor(quat_wxyz, dtype=torch.float64))
            colors = colors * factors.numpy()[:, None]
        return np.clip(colors, 0.0, 1.0)

    @property
    def relit(self) -> bool:
        """Whether the colours change as the body turns."""
        return self._relighting is not None


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneAt:
    """Poses of B bodies and contact marks at one moment of a motion."""

    time_s: float
    """Time of the frame [s]."""
    position_m: Array
    """Body frame origins [m], world frame, shape (B, 3)."""
    quat_wxyz: Array
    """Orientations T_world_body, shape (B, 4)."""
    marks: ContactMarks
    """Points and arrows of the contacts."""
    largest_impulse_n_s: float
    """Largest impulse of a contact at this moment [N s]; 0 without contacts."""
    joints: Mapping[str, float] = field(default_factory=dict)
    """Values of the joints that move [rad or m], by name."""


def shapes_of(model: Model) -> list[BodyShape]:
    """Return the shapes of the bodies of a model, in its order."""
    shapes = []
    for body in model.file.bodies:
        splats, colliding = model.body_splats.get(body.name), model.collision.get(body.name)
        relighting = None
        if model.file.light is not None and splats is not None and splats.normals is not None:
            normals = torch.as_tensor(np.asarray(splats.normals, np.float64))
            relighting = Relighting.of(model.file.light, body, normals)
        centers = np.zeros((0, 3)) if colliding is None else np.asarray(colliding.means, np.float64)
        radii = np.zeros(0) if colliding is None else np.asarray(colliding.scales, np.float64) * body.radius_factor
        shapes.append(
            BodyShape(name=body.name, splats=splats, centers_m=centers, radii_m=radii, _relighting=relighting)
        )
    return shapes


def background_from(model: Model, eye_m: Array) -> Splats | None:
    """Return the background with the colours seen from `eye_m` (3,), world frame; None without a background."""
    if model.scene is None:
        return None
    return Spheres.from_numpy(model.scene).seen_from(torch.as_tensor(eye_m, dtype=torch.float32)).to_numpy()


def radius_m(model: Model, shapes: list[BodyShape]) -> float:
    """Return the radius of the largest free body [m], which sets the size of the marks."""
    free = set(model.file.tracked)
    reaches = []
    for shape in (shape for shape in shapes if shape.name in free):
        centers = shape.centers_m if shape.splats is None else np.asarray(shape.splats.means, np.float64)
        reaches += [float(np.linalg.norm(centers - centers.mean(0), axis=1).max())] if len(centers) else []
        reaches += [float(shape.radii_m.max())] if len(shape.radii_m) else []
    return max(reaches, default=0.0) or _UNKNOWN_RADIUS_M


def scene_at(motion: Motion, frame: int, size_m: float) -> SceneAt:
    """Return the scene at a frame; the motion's largest impulse has an arrow of `LONGEST_ARROW` times `size_m` [m]."""
    scale = arrow_scale(motion.largest_impulse_n_s, LONGEST_ARROW * size_m)
    contacts = motion.contacts[frame]
    sizes = np.linalg.norm(contacts["impulse_world"], axis=-1)
    return SceneAt(
        time_s=float(motion.times_s[frame]),
        position_m=motion.position_m[frame],
        quat_wxyz=motion.quat_wxyz[frame],
        marks=contact_marks(contacts, scale),
        largest_impulse_n_s=float(sizes.max(initial=0.0)),
        joints={name: float(values[frame]) for name, values in motion.joints.items()},
    )


def viewpoint(model: Model, motion: Motion, size_m: float) -> tuple[Array, Array, Array]:
    """Return the initial eye point [m], target [m] and up direction, each (3,), world frame.

    The eye point is between the cameras and slightly farther away than they are, or, without cameras, above the motion.
    What does not move is seen as in the photo in the middle of all: other sides may be in no photo.
    """
    first = model.file.first_view
    if first is not None and len(motion.times_s) == 1 and not motion.cameras:
        return np.array(first.eye_m), np.array(first.target_m), np.array(first.up)
    up = up_direction(model.file)
    moving = [k for k, body in enumerate(model.file.bodies) if body.name in model.file.tracked] or slice(None)
    paths = motion.position_m[:, moving].reshape(-1, 3)
    if not len(paths):
        paths = np.zeros((1, 3)) if model.scene is None else np.median(model.scene.means, 0, keepdims=True)
    target = 0.5 * (paths.min(0) + paths.max(0))
    if motion.cameras:
        middle = np.mean([camera.center for camera in motion.cameras.values()], axis=0)
        return target + 1.2 * (middle - target), target, up
    across = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    away = 0.6 * up - across / np.linalg.norm(across)
    reach = max(5.0 * size_m, 1.5 * float(np.ptp(paths, axis=0).max()))
    return target + reach * away, target, up
