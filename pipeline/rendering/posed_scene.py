"""The spheres of a model with the label of the body that each belongs to, placed for the frames of a motion."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from ..datasets.cameras import Camera
from ..datasets.models import Model
from ..schemas import BodyModel, Light
from .physics.rotation import quat_to_matrix
from .splats.relighting import Relighting
from .splats.spheres import Spheres


@dataclass(frozen=True)
class Labelled:
    """Spheres to render, float32.

    means (N, 3) or (n, N, 3) where they differ by view [m], world; scales (N,) [m]; opacities (N,); colors (N, 3) or
    (n, N, 3); labels (N,): 0 the background, k the k-th body.
    """

    means: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    labels: Tensor

    def __len__(self) -> int:
        return self.scales.shape[0]

    def rows(self, kept: Tensor | slice) -> Labelled:
        """Return some of the spheres."""
        return Labelled(
            self.means[..., kept, :], self.scales[kept], self.opacities[kept], self.colors[..., kept, :],
            self.labels[kept],
        )  # fmt: skip

    def view(self, number: int) -> Labelled:
        """Return the spheres of one view."""
        return Labelled(self.means[number], self.scales, self.opacities, self.colors[number], self.labels)

    def repeated(self, times: int) -> Labelled:
        """Return the views one after the other, so many times."""
        means, colors = (values.repeat(times, 1, 1) for values in (self.means, self.colors))
        return Labelled(means, self.scales, self.opacities, colors, self.labels)

    @staticmethod
    def joined(parts: list[Labelled]) -> Labelled:
        """Return all spheres of several sets, in their order; sets of one view serve all n."""
        views = max((part.means.shape[0] for part in parts if part.means.dim() == 3), default=0)
        if views:
            parts = [part._of_views(views) for part in parts]
        columns = {"means": -2, "scales": 0, "opacities": 0, "colors": -2, "labels": 0}
        names = [field.name for field in fields(Labelled)]
        return Labelled(*(torch.cat([getattr(part, name) for part in parts], columns[name]) for name in names))

    def _of_views(self, views: int) -> Labelled:
        means, colors = (
            values if values.dim() == 3 else values.expand(views, -1, -1) for values in (self.means, self.colors)
        )
        return Labelled(means, self.scales, self.opacities, colors, self.labels)


@dataclass(frozen=True)
class _Moving:
    body: int
    spheres: Labelled
    normals: Tensor | None
    relighting: Relighting | None

    def placed(self, position_m: Tensor, quat_wxyz: Tensor) -> Labelled:
        """Return the spheres at poses (n, 3) and (n, 4)."""
        rotations = quat_to_matrix(quat_wxyz)
        means = self.spheres.means @ rotations.transpose(1, 2) + position_m[:, None]
        colors = self.spheres.colors.expand(len(means), -1, -1)
        if self.relighting is not None:
            colors = (colors * self.relighting.turned(rotations)[..., None]).clamp(0, 1)
        return Labelled(means, self.spheres.scales, self.spheres.opacities, colors, self.spheres.labels)


class LabelledModel:
    """What of a model moves, what stands still, and where.

    Args:
        model: A model with visual spheres.
        device: Where to render.
    """

    def __init__(self, model: Model, device: str = "cpu") -> None:
        self.device = device
        self.bodies = len(model.file.bodies)
        self._scene = None if model.scene is None else Spheres.from_numpy(model.scene, device=device)
        nothing = torch.zeros(0, 3, device=device)
        labels = torch.zeros(0, dtype=torch.int64, device=device)
        self.none = Labelled(nothing, nothing[:, 0], nothing[:, 0], nothing, labels)
        self.fixed: list[tuple[int, Labelled]] = []
        self.moving: list[_Moving] = []
        for index, body in enumerate(model.file.bodies):
            if body.name not in model.body_splats:
                continue
            splats = model.body_splats[body.name]
            spheres = self._labelled(Spheres.from_numpy(splats, device=device), index + 1)
            normals = None if splats.normals is None else self.tensor(splats.normals)
            if body.motion == "fixed":
                self.fixed.append((index, self._standing(spheres, body)))
            else:
                self.moving.append(_Moving(index, spheres, normals, None))
        self._bodies = model.file.bodies
        self.set_light(model.file.light)

    def set_light(self, light: Light | None) -> None:
        """Shade what moves in this light; None: in that of the photos, whatever its pose."""
        self.moving = [
            replace(
                part,
                relighting=None
                if light is None or part.normals is None
                else Relighting.of(light, self._bodies[part.body], part.normals),
            )
            for part in self.moving
        ]

    def tensor(self, values: object) -> Tensor:
        """Return numbers as float32 on the device."""
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)

    def still(self, camera: Camera) -> Labelled:
        """Return what never moves, in the colours that a camera sees."""
        parts = [self.none, *(spheres for _, spheres in self.fixed)]
        if self._scene is not None:
            parts.insert(0, self._labelled(self._scene.seen_from(self.tensor(camera.center)), 0))
        return Labelled.joined(parts)

    def placed(self, position_m: np.ndarray, quat_wxyz: np.ndarray) -> list[tuple[int, Labelled]]:
        """Return what moves, by body, at poses (n, B, 3) and (n, B, 4) of all bodies."""
        positions, quats = self.tensor(position_m), self.tensor(quat_wxyz)
        return [(part.body, part.placed(positions[:, part.body], quats[:, part.body])) for part in self.moving]

    @property
    def moving_count(self) -> int:
        """Spheres that move."""
        return sum(len(part.spheres) for part in self.moving)

    def _labelled(self, spheres: Spheres, label: int) -> Labelled:
        labels = torch.full((len(spheres),), label, dtype=torch.int64, device=self.device)
        return Labelled(spheres.means, spheres.scales, spheres.opacities, spheres.colors, labels)

    def _standing(self, spheres: Labelled, body: BodyModel) -> Labelled:
        rotation = quat_to_matrix(self.tensor(body.photo_pose.quat_wxyz))
        means = spheres.means @ rotation.T + self.tensor(body.photo_pose.position_m)
        return Labelled(means, spheres.scales, spheres.opacities, spheres.colors, spheres.labels)
