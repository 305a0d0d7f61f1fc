"""Spheres of a model with the label of their body, posed for the frames of a motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...datasets.capture.cameras import Camera
from ...datasets.models.model import Model
from ...schemas import BodyModel, Light
from ..geometry.rotation import quat_to_matrix
from ..geometry.spheres import Spheres
from ..geometry.spherical_harmonics import harmonics
from .edge_light import EdgeLight, Edges
from .relighting import Relighting


@dataclass(frozen=True)
class Gloss:
    """Colours of a body's spheres that depend on the direction of view."""

    harmonics: Tensor
    """Coefficients from degree 1 on, body frame, shape (N, K, 3)."""
    rotations: Tensor
    """R_world_body of the views, shape (n, 3, 3), or of one, shape (3, 3)."""
    brightness: Tensor
    """Factor of the light on each sphere, shape (n, N, 1), or (N, 1); ones without a light."""

    def view(self, number: int) -> Gloss:
        """Return the gloss of one view."""
        return Gloss(self.harmonics, self.rotations[number], self.brightness[number])

    def added(self, colors: Tensor, means: Tensor, eye: Tensor) -> Tensor:
        """Return colours (..., N, 3) as a camera at `eye` (3,) [m] sees them, given the centres (..., N, 3)."""
        degree = round((self.harmonics.shape[1] + 1) ** 0.5) - 1
        ways = torch.nn.functional.normalize((means - eye) @ self.rotations, dim=-1)  # in axes of the body
        basis = harmonics(ways, degree)[..., 1:]
        more = torch.einsum("...nk,nkc->...nc", basis, self.harmonics)
        return (colors + self.brightness * more).clamp(0, 1)


@dataclass(frozen=True)
class Labelled:
    """Spheres to render, float32."""

    means: Tensor
    """Centres, world frame [m], shape (N, 3), or (n, N, 3) where they differ by view."""
    scales: Tensor
    """Standard deviations [m], shape (N,)."""
    opacities: Tensor
    """Peak alphas in [0, 1], shape (N,)."""
    colors: Tensor
    """Colours in [0, 1], shape (N, 3), or (n, N, 3) where they differ by view."""
    labels: Tensor
    """Label of each sphere: 0 for the background, k for the k-th body, shape (N,)."""
    gloss: Gloss | None = None
    """How the colours of a body depend on the direction of view; None where they do not, or are as a camera sees."""
    edges: EdgeLight | None = None
    """Light on the spheres at the edges of a body; None without a light, or where the colours are as a camera sees."""

    def seen_from(self, eyes: Tensor) -> Labelled:
        """Return the spheres in the colours that cameras at `eyes` (m, 3) [m] see, one set of views after the other."""
        if self.gloss is None and self.edges is None:
            return self if len(eyes) == 1 else self.repeated(len(eyes))
        plain = replace(self, gloss=None, edges=None)
        whole = plain.repeated(len(eyes)) if self.means.dim() == 3 else plain
        return replace(whole, colors=torch.cat([self._colors_from(eye) for eye in eyes]))

    def _colors_from(self, eye: Tensor) -> Tensor:
        colors = self.colors if self.edges is None else self.edges.seen(self.colors, self.means, eye)
        return colors if self.gloss is None else self.gloss.added(colors, self.means, eye)

    def __len__(self) -> int:
        return self.scales.shape[0]

    def rows(self, kept: Tensor | slice) -> Labelled:
        """Return the spheres at some rows."""
        return Labelled(
            means=self.means[..., kept, :],
            scales=self.scales[kept],
            opacities=self.opacities[kept],
            colors=self.colors[..., kept, :],
            labels=self.labels[kept],
        )

    def view(self, number: int) -> Labelled:
        """Return the spheres of one view."""
        return Labelled(
            means=self.means[number],
            scales=self.scales,
            opacities=self.opacities,
            colors=self.colors[number],
            labels=self.labels,
            gloss=None if self.gloss is None else self.gloss.view(number),
            edges=None if self.edges is None else self.edges.view(number),
        )

    def repeated(self, times: int) -> Labelled:
        """Return the spheres with their views repeated `times` times, one sequence after the other."""
        means, colors = (values.repeat(times, 1, 1) for values in (self.means, self.colors))
        return Labelled(means=means, scales=self.scales, opacities=self.opacities, colors=colors, labels=self.labels)

    @staticmethod
    def joined(parts: list[Labelled]) -> Labelled:
        """Concatenate the spheres of several sets without gloss, in order; sets with one view serve for all n."""
        views = max((part.means.shape[0] for part in parts if part.means.dim() == 3), default=0)
        if views:
            parts = [part._of_views(views) for part in parts]
        return Labelled(
            means=torch.cat([part.means for part in parts], -2),
            scales=torch.cat([part.scales for part in parts]),
            opacities=torch.cat([part.opacities for part in parts]),
            colors=torch.cat([part.colors for part in parts], -2),
            labels=torch.cat([part.labels for part in parts]),
        )

    def _of_views(self, views: int) -> Labelled:
        means, colors = (
            values if values.dim() == 3 else values.expand(views, -1, -1) for values in (self.means, self.colors)
        )
        return Labelled(means=means, scales=self.scales, opacities=self.opacities, colors=colors, labels=self.labels)


@dataclass(frozen=True)
class _Moving:
    """Spheres of a moving body."""

    body: int
    """Index of the body."""
    spheres: Labelled
    """Spheres in the body frame."""
    normals: Tensor | None
    """Unit normals of the spheres, body frame, shape (N, 3); None where they are unknown."""
    relighting: Relighting | None
    """Relighting of the spheres; None to keep the colours of the photos."""
    harmonics: Tensor | None = None
    """Harmonics of the colours from degree 1 on, body frame, shape (N, K, 3); None for colours equal from all sides."""
    edges: Edges | None = None
    """Spheres at the body's edges; None where no light was set or normals are unknown."""

    def placed(self, position_m: Tensor, quat_wxyz: Tensor) -> Labelled:
        """Return the spheres at positions (n, 3) [m] and orientations (n, 4)."""
        rotations = quat_to_matrix(quat_wxyz)
        means = self.spheres.means @ rotations.transpose(1, 2) + position_m[:, None]
        colors = self.spheres.colors.expand(len(means), -1, -1)
        brightness, edges = torch.ones_like(colors[..., :1]), None
        if self.relighting is not None:
            brightness = self.relighting.turned(rotations)[..., None]
            colors = (colors * brightness).clamp(0, 1)
            edges = None if self.edges is None else self.edges.placed(self.relighting, rotations)
        return Labelled(
            means=means,
            scales=self.spheres.scales,
            opacities=self.spheres.opacities,
            colors=colors,
            labels=self.spheres.labels,
            gloss=None if self.harmonics is None else Gloss(self.harmonics, rotations, brightness),
            edges=edges,
        )

    def lit(self, light: Light | None, body: BodyModel) -> _Moving:
        """Return the spheres under a light, or in the colours of the photos."""
        if light is None or self.normals is None:
            return replace(self, relighting=None)
        edges = self.edges or Edges.of(self.spheres.means, self.spheres.scales, self.normals)
        return replace(self, relighting=Relighting.of(light, body, self.normals), edges=edges)


class LabelledModel:
    """Spheres of a model, separated into moving ones, fixed bodies and the background.

    Args:
        model: A model with visual spheres.
        device: Device on which to render.
    """

    def __init__(self, model: Model, device: str = "cpu") -> None:
        self.device = device
        self.bodies = len(model.file.bodies)
        self._scene = None if model.scene is None else Spheres.from_numpy(model.scene, device=device)
        nothing = torch.zeros(0, 3, device=device)
        labels = torch.zeros(0, dtype=torch.int64, device=device)
        self.none = Labelled(
            means=nothing, scales=nothing[:, 0], opacities=nothing[:, 0], colors=nothing, labels=labels
        )
        self.fixed: list[tuple[int, Labelled]] = []
        self.moving: list[_Moving] = []
        for index, body in enumerate(model.file.bodies):
            if body.name not in model.body_splats:
                continue
            splats = model.body_splats[body.name]
            glossy = Spheres.from_numpy(splats, device=device)
            spheres = self._labelled(glossy, index + 1)
            normals = None if splats.normals is None else self.tensor(splats.normals)
            if body.motion == "fixed":
                self.fixed.append((index, self._fixed(spheres, body, glossy.harmonics)))
            else:
                self.moving.append(_Moving(index, spheres, normals, None, glossy.harmonics))
        self._bodies = model.file.bodies
        self.set_light(model.file.light)

    def set_light(self, light: Light | None) -> None:
        """Set the light that shades moving bodies; None keeps the colours of the photos in every pose."""
        self.moving = [part.lit(light, self._bodies[part.body]) for part in self.moving]

    def tensor(self, values: object) -> Tensor:
        """Return values as a float32 tensor on the device."""
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)

    def still(self, camera: Camera) -> Labelled:
        """Return the background and the fixed bodies, in the colours that a camera sees."""
        eye = self.tensor(camera.center)
        parts = [self.none, *(spheres.seen_from(eye[None]) for _, spheres in self.fixed)]
        if self._scene is not None:
            parts.insert(0, self._labelled(self._scene.seen_from(eye), 0))
        return Labelled.joined(parts)

    def placed(self, position_m: np.ndarray, quat_wxyz: np.ndarray) -> list[tuple[int, Labelled]]:
        """Return the moving spheres by body, given positions (n, B, 3) [m] and quaternions (n, B, 4) of all bodies."""
        positions, quats = self.tensor(position_m), self.tensor(quat_wxyz)
        return [(part.body, part.placed(positions[:, part.body], quats[:, part.body])) for part in self.moving]

    @property
    def moving_count(self) -> int:
        """Number of moving spheres."""
        return sum(len(part.spheres) for part in self.moving)

    def _labelled(self, spheres: Spheres, label: int) -> Labelled:
        labels = torch.full((len(spheres),), label, dtype=torch.int64, device=self.device)
        return Labelled(
            means=spheres.means,
            scales=spheres.scales,
            opacities=spheres.opacities,
            colors=spheres.colors,
            labels=labels,
        )

    def _fixed(self, spheres: Labelled, body: BodyModel, higher: Tensor | None) -> Labelled:
        rotation = quat_to_matrix(self.tensor(body.photo_pose.quat_wxyz))
        means = spheres.means @ rotation.T + self.tensor(body.photo_pose.position_m)
        gloss = None if higher is None else Gloss(higher, rotation, torch.ones_like(spheres.colors[:, :1]))
        return replace(spheres, means=means, gloss=gloss)
