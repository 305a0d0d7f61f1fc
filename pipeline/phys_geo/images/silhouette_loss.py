"""The image loss without photos: silhouettes of known shapes against the masks of the videos.

    L = mean over frames of  MASK_WEIGHT * L1(silhouette, mask)

the mask part of `image_loss`, with the same units and coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ...datasets.models import Model
from ...schemas import InputDataError
from ..splats.mesh import Mesh, sample_surface
from ..splats.spheres import Spheres
from .footage import Footage, Video
from .image_loss import Backdrop, ImageLoss, PoseQuality
from .silhouettes import Outline, covered
from .windows import Window, window_of

EDGE = (0.02, 0.98)
"""A pixel is on an edge where a silhouette or a mask covers a share of it between these."""

STEP_PX = 0.4
"""Step of differences by poses: the motion of about so many pixels; smaller ones feel the raster."""


def image_loss(model: Model, footage: Footage, free: Sequence[int], outlines: Mapping[str, Mesh]) -> ImageLoss:
    """Return the loss of an episode's frames: of silhouettes, where the bodies' surfaces are given."""
    return SilhouetteLoss(model, footage, free, outlines) if outlines else ImageLoss(model, footage, free)


class SilhouetteLoss(ImageLoss):
    """The loss of an episode's masks as a function of the bodies' poses.

    Args:
        model: The bodies, in the order of the masks' labels.
        footage: The videos, all with masks.
        free: Indices of the bodies whose poses get derivatives.
        outlines: Surface of each body in its frame. A body that is not free is drawn only if some mask shows it.

    Raises:
        InputDataError: If a video has no masks.
    """

    def __init__(self, model: Model, footage: Footage, free: Sequence[int], outlines: Mapping[str, Mesh]) -> None:
        self.footage, self.free = footage, tuple(free)
        like = footage.videos[0].frames
        self._count = len(model.file.bodies)
        for video in footage.videos:
            if video.covers is None:
                raise InputDataError(
                    f"episode '{footage.episode}': the video of camera '{video.camera}' has no masks, and the model "
                    "has nothing else to be compared with.",
                    f"video_masks/{video.camera}/{footage.episode}/%06d.png.",
                    "add the masks, or a model with the stage sg-gs from photos.",
                )
        self._outlines, self._moving, self.radii, self.centers = [], [], {}, {}
        for index, body in enumerate(model.file.bodies):
            shown = any(bool(v.covers[:, index].any()) for v in footage.videos if v.covers is not None)
            if index not in self.free and (body.motion != "driven" or not shown):
                continue
            mesh = outlines[body.name]
            vertices = torch.as_tensor(mesh.vertices).to(like)
            size = float((vertices.amax(0) - vertices.amin(0)).max())
            surface = torch.as_tensor(sample_surface(mesh, 0.05 * size)).to(like)
            self.centers[index] = surface.mean(0)
            self.radii[index] = float((surface - surface.mean(0)).norm(dim=1).mean())
            self._outlines.append(Outline(index, vertices, mesh.faces, self.radii[index]))
            ones = torch.ones(len(vertices)).to(like)
            self._moving.append((index, Spheres(vertices, 0 * ones, ones, ones[:, None].expand(-1, 3))))
        nothing = torch.zeros(0, 3).to(like)
        self._static = Spheres(nothing, nothing[:, 0], nothing[:, 0], nothing)
        self._reach = torch.zeros(sum(len(spheres) for _, spheres in self._moving)).to(like)
        self._backdrops = [_nothing_behind(video) for video in footage.videos]
        self._step_m = STEP_PX * min(_pixel_m(footage, index, self.radii[index]) for index in self.free)

    @property
    def photometric(self) -> bool:
        """Whether colours are compared."""
        return False

    @property
    def gains(self) -> dict[str, list[float]]:
        """No camera's exposure is known."""
        return {}

    @torch.no_grad()
    def quality(self, instants: Tensor, position_m: Tensor, quat_wxyz: Tensor) -> PoseQuality:
        """Say how well silhouettes agree with the masks: `error` is that of pixels on edges, `blank` without bodies."""
        count, free = len(instants), list(self.free)
        inside, union, error, blank, edges, area = (torch.zeros(count).to(self._static.means) for _ in range(6))
        for number, video in enumerate(self.footage.videos):
            frames = self._frames(number, instants)
            rows = (frames >= 0).nonzero()[:, 0]
            if not len(rows):
                continue
            assert video.covers is not None
            window = window_of(video, frames[rows], self._place(position_m[rows], quat_wxyz[rows]), self._reach, 2)
            mine = self._picture(number, window, position_m[rows], quat_wxyz[rows])[..., 3:][..., free]
            cover = window.cut(video.covers.movedim(1, -1))[..., free]
            on_edge = ((mine > EDGE[0]) & (mine < EDGE[1])) | ((cover > EDGE[0]) & (cover < EDGE[1]))
            error[rows] += (mine - cover).abs().sum((1, 2, 3))
            blank[rows] += cover.sum((1, 2, 3))
            edges[rows] += on_edge.sum((1, 2, 3))
            area[rows] += mine.sum((1, 2, 3))
            whole = (video.covers[window.frames][:, free] > 0.5).sum((1, 2, 3))
            both = ((mine > 0.5) & (cover > 0.5)).sum((1, 2, 3))
            inside[rows] += both
            union[rows] += (mine > 0.5).sum((1, 2, 3)) + whole - both
        return PoseQuality(inside / union, error / edges, blank / edges, area)

    def _picture(self, number: int, window: Window, position_m: Tensor, quat_wxyz: Tensor) -> Tensor:
        video = self.footage.videos[number]
        shares = covered(video, window, self._outlines, self._count, position_m, quat_wxyz, self._step_m)
        return torch.cat([shares.new_zeros(*shares.shape[:3], 3), shares], -1)

    def _color(self, number: int, window: Window, picture: Tensor) -> Tensor:
        return picture[..., :0]

    def _blank(self, number: int, window: Window) -> tuple[Tensor, Tensor]:
        covers = self.footage.videos[number].covers
        assert covers is not None
        mask = -window.cut(covers.movedim(1, -1))
        return mask[..., :0], mask


def _nothing_behind(video: Video) -> Backdrop:
    """Return a backdrop whose colours nobody looks at."""
    count = len(video.frames)
    zero = torch.zeros(1, *video.frames.shape[1:]).to(video.frames)
    unexplained = torch.zeros(count).to(zero)
    plate_of = torch.zeros(count, dtype=torch.int64, device=zero.device)
    return Backdrop(zero, zero[..., 0], plate_of, zero.new_ones(3), unexplained)


def _pixel_m(footage: Footage, index: int, radius_m: float) -> float:
    """Return about how much a pixel is at a body [m]: its radius over that of a disc with the area of its masks."""
    areas = torch.cat([v.covers[:, index].sum((1, 2)) for v in footage.videos if v.covers is not None])
    typical = float(areas[areas > 1.0].median()) if bool((areas > 1.0).any()) else 1.0
    return radius_m / (typical / torch.pi) ** 0.5
