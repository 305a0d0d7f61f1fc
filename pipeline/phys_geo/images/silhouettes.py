"""Silhouettes of bodies of known shape: what each covers of every pixel, from triangles, and its slope by the poses.

A capture with a known shape and masks of the videos needs no photos: where the body is can be seen from its outline.
Outlines of spheres would not do: how far a layer of them reaches beyond their centres depends on how many lie behind
each other along a ray, which made the outline of a block up to 8 % too large or too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from torch import Tensor

from ...datasets.capture import Capture
from ...datasets.models import Model
from ...schemas import BodyModel, InputDataError
from ..physics.rotation import quat_exp, quat_multiply, quat_to_matrix
from ..splats.directions import fibonacci_directions
from ..splats.mesh import Mesh
from ..splats.shapes import shape_mesh
from .footage import Video
from .windows import Window

SUPERSAMPLED = 8
"""Pixels are cut into so many squared: a silhouette's edge is then accurate to a hundredth of a pixel on average."""
_SHIFT = 6
_BALL_POINTS = 60
_CONVEX = 1e-6
"""A body whose volume differs by less than this share from its hull's is convex."""
NEAREST_M = 1e-3
"""A triangle with a corner nearer to the eye than this is not drawn."""


@dataclass(frozen=True)
class Outline:
    """A body's surface in its frame: vertices (V, 3) [m], faces (F, 3); its index in the model and its radius [m]."""

    index: int
    vertices: Tensor
    faces: NDArray[np.int64]
    radius_m: float

    @cached_property
    def corners(self) -> NDArray[np.int64] | None:
        """Vertices of a convex body's hull: their hull in a picture is its silhouette. None where it is not convex."""
        points = self.vertices.detach().cpu().numpy().astype(np.float64)
        hull = ConvexHull(points)
        sides = points[self.faces]
        volume = abs(float(np.linalg.det(sides).sum())) / 6
        return hull.vertices.astype(np.int64) if abs(volume - hull.volume) < _CONVEX * hull.volume else None


def body_outlines(model: Model, capture: Capture, episodes: Sequence[str]) -> tuple[dict[str, Mesh], list[str]]:
    """Return the surfaces of the bodies where only masks can be compared, and a warning that says so.

    A model with a background, and visual spheres of every free body, can be compared with whole pictures: then there
    are none. In any other, colours are not compared with half a scene.

    Args:
        model: The model.
        capture: The capture: shapes are files of it.
        episodes: Those to be fitted.

    Raises:
        InputDataError: If a video has no masks.
    """
    lacking = [b.name for b in model.file.bodies if b.motion == "free" and b.name not in model.body_splats]
    if model.scene is not None and not lacking:
        return {}, []
    what = f"no visual spheres of the free body '{lacking[0]}'" if model.scene is not None else "no background"
    for episode in episodes:
        for camera in capture.videos(episode):
            if not (capture.root / "video_masks" / camera / episode).is_dir():
                raise InputDataError(
                    f"the model has {what}, and the video of camera '{camera}' in episode '{episode}' has no masks: "
                    "neither colours nor outlines can be compared.",
                    "a model with the stage sg-gs from photos, or masks of every video.",
                    f"run 'cgwm fit CAPTURE --stage all' on photos, or add video_masks/{camera}/{episode}/%06d.png.",
                )
    meshes = {body.name: _surface(model, capture, body) for body in model.file.bodies}
    text = f"photometric part left out: the model has {what}; the fit rests on the masks of the videos alone."
    return meshes, [text]


def _surface(model: Model, capture: Capture, body: BodyModel) -> Mesh:
    """Return a body's surface: its shape's, or that of the spheres that collide."""
    if body.shape is not None and body.shape.splats is None:
        return shape_mesh(body.shape, capture.root)
    spheres = model.collision[body.name]
    ball = fibonacci_directions(_BALL_POINTS)
    faces = ConvexHull(ball).simplices.astype(np.int64)
    radii = body.radius_factor * np.asarray(spheres.scales, np.float64)
    vertices = np.asarray(spheres.means, np.float64)[:, None] + radii[:, None, None] * ball
    first = len(ball) * np.arange(len(radii))[:, None, None]
    return Mesh(vertices.reshape(-1, 3), (first + faces).reshape(-1, 3))


def covered(
    video: Video,
    window: Window,
    outlines: Sequence[Outline],
    count: int,
    position_m: Tensor,
    quat_wxyz: Tensor,
    step_m: float,
) -> Tensor:
    """Return which share of each pixel of a window each of `count` bodies covers, shape (S, h, w, count).

    Where bodies overlap, the one whose middle is nearer to the camera hides the other. Differentiable in the poses
    by differences.

    Args:
        video: Its cameras.
        window: The rectangles.
        outlines: The bodies that are drawn.
        count: Number of all bodies.
        position_m: Their poses, shape (S, nb, 3).
        quat_wxyz: Shape (S, nb, 4).
        step_m: Step of the differences, to both sides; below a third of a pixel the raster shows in them.
    """
    drawn = (video, window, tuple(outlines), count)
    return _Covered.apply(position_m, quat_wxyz, drawn, step_m)  # pyright: ignore[reportReturnType]


_Drawn = tuple[Video, Window, tuple[Outline, ...], int]


class _Covered(torch.autograd.Function):
    """`covered`, with derivatives from differences to both sides of each pose."""

    @staticmethod
    def forward(ctx: Any, position_m: Tensor, quat_wxyz: Tensor, drawn: _Drawn, step_m: float) -> Tensor:
        ctx.save_for_backward(position_m, quat_wxyz)
        ctx.drawn, ctx.step_m = drawn, step_m
        return _pictures(position_m, quat_wxyz, *drawn)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        position, quat = ctx.saved_tensors
        (slope,) = grad_outputs
        by_position, by_quat = torch.zeros_like(position), torch.zeros_like(quat)

        def value(position_m: Tensor, quat_wxyz: Tensor) -> Tensor:
            return (slope * _pictures(position_m, quat_wxyz, *ctx.drawn)).sum((1, 2, 3))

        outlines: tuple[Outline, ...] = ctx.drawn[2]
        for outline in outlines:
            index, turn = outline.index, ctx.step_m / outline.radius_m
            for axis in torch.eye(3).to(position):
                ends = []
                for sign in (1.0, -1.0):
                    moved, turned = position.clone(), quat.clone()
                    moved[:, index] += sign * ctx.step_m * axis
                    turned[:, index] = quat_multiply(quat[:, index], quat_exp(sign * turn * axis)[None])
                    ends.append((value(moved, quat), value(position, turned)))
                shift, spin = (a - b for a, b in zip(*ends, strict=True))
                by_position[:, index] += (shift / (2 * ctx.step_m))[:, None] * axis
                # a turn about a body axis moves q along q (0, axis) / 2 for each radian; these are orthogonal
                tangent = quat_multiply(quat[:, index], torch.cat([axis.new_zeros(1), axis])[None])
                by_quat[:, index] += 2 * (spin / (2 * turn))[:, None] * tangent
        return by_position, by_quat, None, None


def _pictures(
    position_m: Tensor, quat_wxyz: Tensor, video: Video, window: Window, outlines: tuple[Outline, ...], count: int
) -> Tensor:
    like = video.frames
    views = video.viewmats[window.frames]
    projected = []
    for outline in outlines:
        rotation = quat_to_matrix(quat_wxyz[:, outline.index].to(like))
        points = outline.vertices.to(like) @ rotation.transpose(1, 2) + position_m[:, outline.index, None].to(like)
        local = points @ views[:, :3, :3].transpose(1, 2) + views[:, None, :3, 3]
        pixels = local[..., :2] / local[..., 2:].clamp_min(NEAREST_M) * video.K.diagonal()[:2] + video.K[:2, 2]
        pixels = pixels - window.corners[:, None].to(like)
        projected.append((pixels.cpu().numpy(), local[..., 2].cpu().numpy()))
    result = np.zeros((len(window.frames), window.size[1], window.size[0], count), np.float32)
    for shot in range(len(result)):
        order = sorted(range(len(outlines)), key=lambda k: -float(projected[k][1][shot].mean()))
        labels = np.zeros((SUPERSAMPLED * window.size[1], SUPERSAMPLED * window.size[0]), np.uint8)
        for k in order:
            _fill(labels, projected[k][0][shot], projected[k][1][shot], outlines[k], k + 1)
        for k, outline in enumerate(outlines):
            result[shot, ..., outline.index] = _shares(labels == k + 1)
    return torch.as_tensor(result).to(like)


def _fill(labels: NDArray[np.uint8], pixels: NDArray[Any], depth: NDArray[Any], outline: Outline, value: int) -> None:
    """Draw what of a body lies in front of the camera, its vertices at pixels (V, 2)."""
    limit = 1 << (30 - _SHIFT)
    # centres of pixels are at whole numbers in OpenCV
    scaled = np.round(np.clip((SUPERSAMPLED * pixels - 0.5) * (1 << _SHIFT), -limit, limit)).astype(np.int32)
    corners = outline.corners
    if corners is not None and bool((depth[corners] > NEAREST_M).all()):
        cv2.fillConvexPoly(labels, cv2.convexHull(scaled[corners]), value, shift=_SHIFT)
        return
    for triangle in scaled[outline.faces[(depth[outline.faces] > NEAREST_M).all(1)]]:
        cv2.fillConvexPoly(labels, triangle, value, shift=_SHIFT)


def _shares(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the share of each pixel (h, w) that is inside, from a finer raster.

    OpenCV fills half a pixel of that raster too much all around; a pixel less is half a pixel too little.
    """
    wide = inside.view(np.uint8)
    narrow = cv2.erode(wide, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), borderValue=1)
    size = (inside.shape[1] // SUPERSAMPLED, inside.shape[0] // SUPERSAMPLED)
    # the mean of blocks; 64 cells of 0, 1 or 2 add up exactly
    means = cv2.resize(cv2.add(wide, narrow).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return (0.5 * means).astype(np.float32)
