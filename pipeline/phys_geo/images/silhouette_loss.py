"""Image loss without photos: silhouettes of known shapes against the masks of the videos.

    L = mean over frames of  MASK_WEIGHT * L1(silhouette, mask)

This is the mask part of `image_loss`, with the same units and coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ....datasets.models.model import Model
from ....datasets.shapes.meshes import Mesh
from ....schemas import InputDataError
from ...geometry.mesh import sample_surface
from ...geometry.spheres import Spheres
from .backdrop import Backdrop
from .crops import Window, window_of
from .image_loss import ImageLoss, Posed, PoseQuality
from .silhouettes import Outline, covered
from .video_frames import Footage, Video

EDGE = (0.02, 0.98)
"""Range of the covered share of a pixel on an edge of a silhouette or a mask."""

STEP_PX = 0.4
"""Step of the differences by poses, as a motion in the image [px]; with smaller ones the raster shows."""


def image_loss(model: Model, footage: Footage, free: Sequence[int], outlines: Mapping[str, Mesh]) -> ImageLoss:
    """Return the loss of an episode's frames, of silhouettes if the bodies' surfaces are given."""
    return SilhouetteLoss(model, footage, free, outlines) if outlines else ImageLoss(model, footage, free)


class SilhouetteLoss(ImageLoss):
    """Loss of an episode's masks as a function of the bodies' poses.

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
        self._covers = [_required_covers(video, footage.episode) for video in footage.videos]
        self._outlines, self._moving, self.radii, self.centers = [], [], {}, {}
        for index, body in enumerate(model.file.bodies):
            shown = any(bool(covers[:, index].any()) for covers in self._covers)
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
        """Return no exposures, as colours are not compared."""
        return {}

    @torch.no_grad()
    def quality(self, instants: Tensor, position_m: Tensor, quat_wxyz: Tensor) -> PoseQuality:
        """Return the agreement of silhouettes with masks; `error` and `blank` are relative to the pixels on edges."""
        count, free = len(instants), list(self.free)
        inside, union, error, blank, edges, area = (torch.zeros(count).to(self._static.means) for _ in range(6))
        for number, video in enumerate(self.footage.videos):
            frames = self._frames(number, instants)
            rows = (frames >= 0).nonzero()[:, 0]
            if not len(rows):
                continue
            covers = self._covers[number]
            posed = self._place(position_m[rows], quat_wxyz[rows])
            window = window_of(video, frames[rows], posed.means, self._reach, 2)
            mine = self._picture(number, window, posed)[..., 3:][..., free]
            cover = window.cut(covers.movedim(1, -1))[..., free]
            on_edge = ((mine > EDGE[0]) & (mine < EDGE[1])) | ((cover > EDGE[0]) & (cover < EDGE[1]))
            error[rows] += (mine - cover).abs().sum((1, 2, 3))
            blank[rows] += cover.sum((1, 2, 3))
            edges[rows] += on_edge.sum((1, 2, 3))
            area[rows] += mine.sum((1, 2, 3))
            whole = (covers[window.frames][:, free] > 0.5).sum((1, 2, 3))
            both = ((mine > 0.5) & (cover > 0.5)).sum((1, 2, 3))
            inside[rows] += both
            union[rows] += (mine > 0.5).sum((1, 2, 3)) + whole - both
        return PoseQuality(inside / union, error / edges, blank / edges, area)

    def _picture(self, number: int, window: Window, posed: Posed) -> Tensor:
        video, poses = self.footage.videos[number], (posed.position_m, posed.quat_wxyz)
        shares = covered(video, window, self._outlines, self._count, *poses, self._step_m)
        return torch.cat([shares.new_zeros(*shares.shape[:3], 3), shares], -1)

    def _color(self, number: int, window: Window, picture: Tensor) -> Tensor:
        return picture[..., :0]

    def _blank(self, number: int, window: Window) -> tuple[Tensor, Tensor]:
        mask = -window.cut(self._covers[number].movedim(1, -1))
        return mask[..., :0], mask


def _required_covers(video: Video, episode: str) -> Tensor:
    """Return the share of each pixel that each body covers (T, bodies, H, W); refuse a video without masks."""
    if video.covers is None:
        raise InputDataError(
            f"episode '{episode}': the video of camera '{video.camera}' has no masks, and the model "
            "has nothing else to be compared with.",
            f"video_masks/{video.camera}/{episode}/%06d.png.",
            "add the masks, or a model with the stage sg-gs from photos.",
        )
    return video.covers


def _nothing_behind(video: Video) -> Backdrop:
    """Return a backdrop without content, as colours are not compared."""
    count = len(video.frames)
    zero = torch.zeros(1, *video.frames.shape[1:]).to(video.frames)
    unexplained = torch.zeros(count).to(zero)
    plate_of = torch.zeros(count, dtype=torch.int64, device=zero.device)
    return Backdrop(plates=zero, depths=zero[..., 0], plate_of=plate_of, gain=zero.new_ones(3), unexplained=unexplained)


def _pixel_m(footage: Footage, index: int, radius_m: float) -> float:
    """Return the approximate size of a pixel at a body [m]: its radius over that of a disc with its masks' area."""
    areas = torch.cat([v.covers[:, index].sum((1, 2)) for v in footage.videos if v.covers is not None])
    typical = float(areas[areas > 1.0].median()) if bool((areas > 1.0).any()) else 1.0
    return radius_m / (typical / torch.pi) ** 0.5
