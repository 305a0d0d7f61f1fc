"""Silhouettes of bodies of known shape: covered share of each pixel, from triangles, with derivatives by the poses.

A capture with a known shape and masks of the videos needs no photos: the silhouette identifies the pose. Silhouettes of
spheres are not accurate enough: the reach of a layer of spheres beyond their centres depends on their number along a
ray, which made the silhouette of a block up to 8 % too large or too small.
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

from ....datasets.capture.capture import Capture
from ....datasets.models.model import Model
from ....datasets.shapes.meshes import Mesh
from ....schemas import BodyModel, InputDataError
from ...geometry.directions import fibonacci_directions
from ...geometry.primitives import shape_mesh
from ...geometry.rotation import quat_exp, quat_multiply, quat_to_matrix
from .crops import Window
from .video_frames import Video

SUPERSAMPLED = 8
"""Number of cells along a side of a pixel; the edge of a silhouette is then accurate to 0.01 px on average."""
_SHIFT = 6
"""Fractional bits of coordinates in OpenCV's polygon filling."""
_BALL_POINTS = 60
"""Number of vertices of a sphere's surface."""
_CONVEX = 1e-6
"""Maximum relative difference of the volumes of a convex body and of its hull."""
NEAREST_M = 1e-3
"""Minimum depth of the corners of a triangle that is drawn [m]."""


@dataclass(frozen=True)
class Outline:
    """Surface of a body in its frame."""

    index: int
    """Index of the body in the model."""
    vertices: Tensor
    """Vertices [m], shape (V, 3)."""
    faces: NDArray[np.int64]
    """Vertices of each triangle, shape (F, 3)."""
    radius_m: float
    """Mean distance of the surface from its centroid [m]."""

    @cached_property
    def corners(self) -> NDArray[np.int64] | None:
        """Vertices of a convex body's hull, whose projected hull is the silhouette; None if it is not convex."""
        points = self.vertices.detach().cpu().numpy().astype(np.float64)
        hull = ConvexHull(points)
        sides = points[self.faces]
        volume = abs(float(np.linalg.det(sides).sum())) / 6
        return hull.vertices.astype(np.int64) if abs(volume - hull.volume) < _CONVEX * hull.volume else None


def body_outlines(model: Model, capture: Capture, episodes: Sequence[str]) -> tuple[dict[str, Mesh], list[str]]:
    """Return the surfaces of the bodies and a warning if only masks can be compared; otherwise nothing.

    A model with a background and visual spheres of every free body can be compared with whole images. With any other
    model no colours are compared.

    Args:
        model: The model.
        capture: The capture, with the files of shapes.
        episodes: Names of the episodes to fit.

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
    text = f"photometric part left out: the model has {what}; the fit uses the masks of the videos alone."
    return meshes, [text]


def _surface(model: Model, capture: Capture, body: BodyModel) -> Mesh:
    """Return the surface of a body, from its shape or from its collision spheres."""
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
    """Return the share of each pixel of a window that each of `count` bodies covers, shape (S, h, w, count).

    Where bodies overlap, the one whose centroid is nearer to the camera hides the other. Differentiable in the poses
    by differences.

    Args:
        video: The video, for its cameras.
        window: The rectangles.
        outlines: The bodies that are drawn.
        count: Number of all bodies.
        position_m: Body frame origins [m], world, shape (S, nb, 3).
        quat_wxyz: Orientations, shape (S, nb, 4).
        step_m: Step of the central differences [m]; below a third of a pixel the raster shows in them.
    """
    drawn = (video, window, tuple(outlines), count)
    return _Covered.apply(position_m, quat_wxyz, drawn, step_m)  # pyright: ignore[reportReturnType]


_Drawn = tuple[Video, Window, tuple[Outline, ...], int]
"""Video, window, drawn bodies and number of all bodies."""


class _Covered(torch.autograd.Function):
    """Function of `covered`, with derivatives from central differences by each pose."""

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
                # a rotation about a body axis moves q along q (0, axis) / 2 per radian; these are orthogonal
                tangent = quat_multiply(quat[:, index], torch.cat([axis.new_zeros(1), axis])[None])
                by_quat[:, index] += 2 * (spin / (2 * turn))[:, None] * tangent
        return by_position, by_quat, None, None


def _pictures(
    position_m: Tensor, quat_wxyz: Tensor, video: Video, window: Window, outlines: tuple[Outline, ...], count: int
) -> Tensor:
    """Return the covered share of each pixel, without derivatives; see `covered`."""
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
    """Draw the part of a body in front of the camera, with vertices at pixels (V, 2)."""
    limit = 1 << (30 - _SHIFT)
    # OpenCV has the centres of pixels at integers
    scaled = np.round(np.clip((SUPERSAMPLED * pixels - 0.5) * (1 << _SHIFT), -limit, limit)).astype(np.int32)
    corners = outline.corners
    if corners is not None and bool((depth[corners] > NEAREST_M).all()):
        cv2.fillConvexPoly(labels, cv2.convexHull(scaled[corners]), value, shift=_SHIFT)
        return
    for triangle in scaled[outline.faces[(depth[outline.faces] > NEAREST_M).all(1)]]:
        cv2.fillConvexPoly(labels, triangle, value, shift=_SHIFT)


def _shares(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the share of each pixel (h, w) that is inside, from a finer raster.

    OpenCV fills half a cell of that raster too much all around; eroded by one cell, it is half a cell too little. The
    mean of the two is used.
    """
    wide = inside.view(np.uint8)
    narrow = cv2.erode(wide, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), borderValue=1)
    size = (inside.shape[1] // SUPERSAMPLED, inside.shape[0] // SUPERSAMPLED)
    # the mean of blocks; 64 cells of 0, 1 or 2 add up exactly
    means = cv2.resize(cv2.add(wide, narrow).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return (0.5 * means).astype(np.float32)
