"""Labelled images of a moving model: colour, depth and instance masks, from one pass of the renderer.

The depth of a pixel is the expected depth of the one surface that its mask names, so that no depths float between an
object and what is behind it.

What never moves (the background and fixed bodies) is rendered once a camera. In each frame only the tiles that the
moving bodies can reach are rendered again, with everything in them: outside, nothing of a body contributes, so the
result is that of rendering the whole picture.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..datasets.cameras import Camera
from ..datasets.models import Model
from ..datasets.rollouts import CHUNK_FRAMES, FrameBlock
from .physics.rotation import quat_to_matrix
from .splats.relighting import Relighting
from .splats.render import MIN_ALPHA, render
from .splats.spheres import Spheres

TILE = 8
"""Crops begin and end on multiples of the renderer's tile [px], so that its tiles are those of the whole picture."""
SOLID_ALPHA = 0.5
"""A pixel shows a surface (and gets a depth and a label) where the spheres let less than half of the light through."""


@dataclass(frozen=True)
class _Spheres:
    """Spheres to render, float32; `features` are colour and a one-hot label (background, body 1, ...)."""

    means: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True)
class _Moving:
    body: int
    spheres: _Spheres
    relighting: Relighting | None

    def placed(self, position_m: Tensor, quat_wxyz: Tensor) -> _Spheres:
        spheres = _placed(self.spheres, position_m, quat_wxyz)
        if self.relighting is None:
            return spheres
        features = spheres.features.clone()
        features[:, :3] = (features[:, :3] * self.relighting.factors(quat_wxyz)[:, None]).clamp(0, 1)
        return replace(spheres, features=features)


@dataclass
class _View:
    """A camera; what never moves, as it sees it; and its picture of that.

    features (H, W, F) as :func:`_render` makes them, alpha (H, W).
    """

    static: _Spheres
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    features: Tensor
    alpha: Tensor


class LabelRenderer:
    """Renders the labels of a model for a set of cameras without distortion.

    Args:
        model: A model with visual spheres.
        cameras: The cameras by name.
        device: Where to render.
    """

    def __init__(self, model: Model, cameras: Mapping[str, Camera], device: str = "cpu"):
        self._device = device
        self._labels = 1 + len(model.file.bodies)
        fixed, self._moving = [], []
        self._scene = None if model.scene is None else Spheres.from_numpy(model.scene, device=device)
        for index, body in enumerate(model.file.bodies):
            if body.name not in model.body_splats:
                continue
            spheres = self._labelled(Spheres.from_numpy(model.body_splats[body.name], device=device), index + 1)
            if body.motion == "fixed":
                pose = body.photo_pose
                fixed.append(_placed(spheres, self._float(pose.position_m), self._float(pose.quat_wxyz)))
            else:
                light, normals = model.file.light, model.body_splats[body.name].normals
                relighting = None
                if light is not None and normals is not None:
                    relighting = Relighting.of(light, body, self._float(normals))
                self._moving.append(_Moving(index, spheres, relighting))
        nothing = torch.zeros(0, 3, device=device)
        empty = _Spheres(nothing, nothing[:, 0], nothing[:, 0], torch.zeros(0, 3 + self._labels, device=device))
        self._fixed = _joined([*fixed, empty])
        self._views = {name: self._view(camera) for name, camera in cameras.items()}

    @torch.no_grad()
    def blocks(self, position_m: np.ndarray, quat_wxyz: np.ndarray) -> Iterator[FrameBlock]:
        """Render a rollout, a chunk of frames of one camera at a time.

        Args:
            position_m: Body frame origins [m], world, shape (T, B, 3).
            quat_wxyz: T_world_body, shape (T, B, 4).
        """
        count = len(position_m)
        for start in range(0, count, CHUNK_FRAMES):
            frames = range(start, min(start + CHUNK_FRAMES, count))
            placed = [self._place(position_m[frame], quat_wxyz[frame]) for frame in frames]
            for name, view in self._views.items():
                pictures = [self._frame(view, spheres) for spheres in placed]
                image, depth, mask = (np.stack(parts) for parts in zip(*pictures, strict=True))
                yield FrameBlock(name, start, image, depth, mask)

    def _labelled(self, spheres: Spheres, label: int) -> _Spheres:
        one_hot = torch.zeros(len(spheres), self._labels, device=self._device)
        one_hot[:, label] = 1.0
        features = torch.cat([spheres.colors, one_hot], 1)
        return _Spheres(spheres.means, spheres.scales, spheres.opacities, features)

    def _float(self, values: object) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self._device)

    def _view(self, camera: Camera) -> _View:
        viewmat, K = self._float(camera.T_cam_world), self._float(camera.K)
        size = (camera.width, camera.height)
        static = self._fixed
        if self._scene is not None:
            seen = self._scene.seen_from(self._float(camera.center))
            static = _joined([self._labelled(seen, 0), static])
        with torch.no_grad():
            picture = _render(static, viewmat, K, *size)
        return _View(static, viewmat, K, *size, *picture)

    def _place(self, position_m: np.ndarray, quat_wxyz: np.ndarray) -> _Spheres:
        moved = [
            part.placed(self._float(position_m[part.body]), self._float(quat_wxyz[part.body])) for part in self._moving
        ]
        return _joined([*moved, _cut(self._fixed, slice(0, 0))])

    def _frame(self, view: _View, moving: _Spheres) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        features, alpha = view.features, view.alpha
        box = _reach(moving, view)
        if box is not None:
            left, top, right, bottom = box
            K = view.K.clone()
            K[0, 2] -= left
            K[1, 2] -= top
            everything = _joined([moving, view.static])
            crop = _render(everything, view.viewmat, K, right - left, bottom - top)
            features, alpha = features.clone(), alpha.clone()
            for whole, part in zip((features, alpha), crop, strict=True):
                whole[top:bottom, left:right] = part
        solid = alpha > SOLID_ALPHA
        color, weight, weighted_depth = features.split([3, self._labels, self._labels], dim=-1)
        # Of equal weights the first counts, and a solid pixel has a weight above 0.
        most, surface = weight.max(-1)
        label = torch.where(solid, surface, 0)
        image = (color.clamp(0, 1) * 255).round()
        nearest = weighted_depth.gather(-1, surface[..., None])[..., 0]
        depth = torch.where(solid, nearest / most.clamp_min(1e-6), 0.0)
        return (
            image.to(torch.uint8).cpu().numpy(),
            depth.to(torch.float32).cpu().numpy(),
            label.to(torch.uint8).cpu().numpy(),
        )


def _render(spheres: _Spheres, viewmat: Tensor, K: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return colour, weight of each label, weight times depth of each label (H, W, 3 + 2 labels), and alpha (H, W)."""
    depth = spheres.means @ viewmat[2, :3] + viewmat[2, 3]
    features = torch.cat([spheres.features, spheres.features[:, 3:] * depth[:, None]], 1)
    if len(spheres) == 0:
        return features.new_zeros(height, width, features.shape[1]), features.new_zeros(height, width)
    picture = render(
        spheres.means,
        spheres.scales,
        spheres.opacities,
        features,
        viewmat[None],
        K[None],
        width,
        height,
        tile_size=TILE,
    )
    return picture.features[0], picture.alpha[0]


def _placed(spheres: _Spheres, position_m: Tensor, quat_wxyz: Tensor) -> _Spheres:
    means = spheres.means @ quat_to_matrix(quat_wxyz).T + position_m
    return _Spheres(means, spheres.scales, spheres.opacities, spheres.features)


def _joined(parts: list[_Spheres]) -> _Spheres:
    fields = ("means", "scales", "opacities", "features")
    return _Spheres(*(torch.cat([getattr(part, field) for part in parts]) for field in fields))


def _cut(spheres: _Spheres, rows: slice) -> _Spheres:
    return _Spheres(spheres.means[rows], spheres.scales[rows], spheres.opacities[rows], spheres.features[rows])


def _reach(spheres: _Spheres, view: _View) -> tuple[int, int, int, int] | None:
    """Return the box (left, top, right, bottom) [px], on tile borders, outside which no sphere reaches MIN_ALPHA.

    Derived: the rays that pass a centre (x, z) within r lie, in the plane of x and z, within asin(r / |(x, z)|) of
    its direction; so for y. A sphere around the camera reaches everywhere.
    """
    if len(spheres) == 0:
        return None
    local = spheres.means @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    reach = spheres.scales * (2 * (spheres.opacities / MIN_ALPHA).clamp_min(1.0).log()).sqrt()
    depth = local[:, 2]
    drawn = (spheres.opacities > MIN_ALPHA) & (depth > -reach)
    if not bool(drawn.any()):
        return None
    local, reach, depth = local[drawn], reach[drawn], depth[drawn]
    if bool((depth <= reach).any()):
        return 0, 0, view.width, view.height
    limits = []
    for axis, size in ((0, view.width), (1, view.height)):
        middle = torch.atan2(local[:, axis], depth)
        half = torch.asin((reach / torch.hypot(local[:, axis], depth)).clamp_max(1.0))
        ends = torch.tan(torch.stack([middle - half, middle + half])) * view.K[axis, axis] + view.K[axis, 2]
        low, high = float(ends[0].min()) - 1, float(ends[1].max()) + 1  # a pixel against rounding
        if high <= 0 or low >= size:
            return None
        low = max(0, math.floor(low / TILE) * TILE)
        limits.append((low, min(size, math.ceil(high / TILE) * TILE)))
    (left, right), (top, bottom) = limits
    return left, top, right, bottom
