"""Image loss: real frames against renders of the background and the bodies at given poses.

    L = mean over frames of  L1(gain * render, frame)  +  MASK_WEIGHT * L1(visible body, mask)

Both terms cover the whole image. The static scene is rendered once for each camera pose, with colours and depths: the
plate. For each frame only the moving bodies are rendered, in a window around them, over the plate; the rest of the sum
is a constant of the window. A pixel shows the plate where it is nearer than the bodies by more than the roughness of
its spheres. Appearance and geometry are constants here: poses get a gradient from the renderer, {c, s} none (contact
model notes, section 7).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ....datasets.models.model import Model
from ....datasets.shapes.ply import Splats
from ....schemas import InputDataError
from ...geometry.rotation import quat_exp, quat_multiply, quat_to_matrix
from ...geometry.spheres import Spheres
from ...rendering.render import MIN_ALPHA, render
from .backdrop import backdrop_of
from .crops import Window, window_of
from .video_frames import Footage, Video

MASK_WEIGHT = 1.0
"""Weight of the silhouettes: a wrong pixel of a mask costs as much as black in place of white (choice of cgwm)."""
DIFFERENCE_M = 5e-4
"""Step of the differences for the curvature [m], a small part of a pixel."""
HUBER = 0.1
"""Residual below which the tracking loss is quadratic; least squares converges where the L1 norm creeps."""
MIN_IOU = 0.5
"""Minimum intersection over union of silhouettes and masks for a pose to count as found."""
MAX_ERROR_RATIO = 0.7
"""Maximum ratio of the colour error on the body to that of the background alone for a pose without masks to count as
found."""
MIN_AREA_PX = 12.0
"""Minimum drawn area of the bodies for a pose to count as found [px]."""
OCCLUDER_RADII = 0.5
"""Depth difference above which the static scene hides a body, as a share of the body's radius: a ground of spheres is
rough, and must not hide the rim of a body on it."""
_MAX_RENDERS = 128
"""Maximum number of renders in one batch."""


@dataclass(frozen=True)
class PoseModel:
    """Second-order model of the Huber loss at poses (K), in D = 6 nf coordinates of the nf free bodies.

    Coordinates of each free body: translation [m] in the world frame, and rotation vector [rad] in the body frame.
    """

    value: Tensor
    """Loss, shape (K,)."""
    slope: Tensor
    """Gradient, shape (K, D)."""
    curvature: Tensor
    """Curvature, shape (K, D, D)."""


@dataclass(frozen=True, eq=False)
class Posed:
    """Poses (S) of all bodies (nb), and where they put the spheres that move (N)."""

    position_m: Tensor
    """Body frame origins [m], world, shape (S, nb, 3)."""
    quat_wxyz: Tensor
    """Orientations, shape (S, nb, 4)."""
    means: Tensor
    """Centres of the spheres [m], world, shape (S, N, 3)."""


@dataclass(frozen=True, eq=False)
class PoseQuality:
    """Agreement of renders at poses (K) with the frames where the bodies are drawn."""

    iou: Tensor
    """Intersection over union of the free bodies' silhouettes and the masks, NaN without masks, shape (K,)."""
    error: Tensor
    """Mean absolute colour error on the bodies, shape (K,)."""
    blank: Tensor
    """Mean absolute colour error of the background alone in the same pixels, shape (K,)."""
    area: Tensor
    """Drawn area [px], 0 where no camera sees the bodies, shape (K,)."""

    @property
    def found(self) -> Tensor:
        """Whether poses explain the frames: by the overlap with masks, or by colours without masks, shape (K,)."""
        agrees = torch.where(self.iou.isnan(), self.error < MAX_ERROR_RATIO * self.blank, self.iou >= MIN_IOU)
        return agrees & (self.area > MIN_AREA_PX)


class ImageLoss:
    """Loss of an episode's frames as a function of the bodies' poses.

    Args:
        model: A model with visual spheres and a background.
        footage: The videos.
        free: Indices of the bodies whose poses get derivatives.
        min_alpha: As in :func:`render`; 0 makes the loss smooth (and slow).
    """

    def __init__(self, model: Model, footage: Footage, free: Sequence[int], min_alpha: float = MIN_ALPHA) -> None:
        scene = _required_scene(model, free)
        self.footage, self.free, self._min_alpha, self._step_m = footage, tuple(free), min_alpha, DIFFERENCE_M
        like = footage.videos[0].frames
        self._count = len(model.file.bodies)
        self._moving: list[tuple[int, Spheres]] = []
        static = []
        for index, body in enumerate(model.file.bodies):
            if body.name not in model.body_splats:
                continue
            spheres = Spheres.from_numpy(model.body_splats[body.name], like.dtype, like.device)
            if body.motion == "fixed":
                pose = body.photo_pose
                rotation = quat_to_matrix(torch.as_tensor(pose.quat_wxyz).to(like))
                means = spheres.means @ rotation.T + torch.as_tensor(pose.position_m).to(like)
                static.append(Spheres(means, spheres.scales, spheres.opacities, spheres.colors))
            else:
                self._moving.append((index, spheres))
        static.append(Spheres.from_numpy(scene, like.dtype, like.device))
        self._static = Spheres.joined(static)
        moving = Spheres.joined([spheres for _, spheres in self._moving])
        label = torch.cat([torch.full((len(spheres),), index) for index, spheres in self._moving])
        one_hot = torch.nn.functional.one_hot(label, self._count).to(moving.colors)
        self._features = torch.cat([moving.colors, one_hot], 1)
        self._scales, self._opacities = moving.scales, moving.opacities
        self._reach = _reach(moving, min_alpha or MIN_ALPHA)
        self.radii = {index: _radius(spheres) for index, spheres in self._moving}
        self._roughness = OCCLUDER_RADII * max(self.radii.values())
        self.centers = {index: spheres.means.mean(0) for index, spheres in self._moving}
        self._backdrops = [backdrop_of(self._static, video, min_alpha) for video in footage.videos]

    @property
    def photometric(self) -> bool:
        """Whether colours are compared."""
        return True

    @property
    def gains(self) -> dict[str, list[float]]:
        """Exposure of each camera against the model's colours, by channel."""
        return {v.camera: b.gain.tolist() for v, b in zip(self.footage.videos, self._backdrops, strict=True)}

    def values(self, instants: Tensor, position_m: Tensor, quat_wxyz: Tensor) -> Tensor:
        """Return the loss at poses, averaged over the cameras with a frame at the instant.

        Args:
            instants: Instant of the footage of each pose, shape (K,).
            position_m: Body frame origins [m], world, shape (K, nb, 3).
            quat_wxyz: Shape (K, nb, 4).

        Returns:
            The loss, 0 where no camera has a frame at the instant, shape (K,).
        """
        with torch.no_grad():
            return self.parts(instants, position_m, quat_wxyz).sum(-1)

    def parts(self, instants: Tensor, position_m: Tensor, quat_wxyz: Tensor) -> Tensor:
        """Return the parts of the loss, photometric and weighted mask, shape (K, 2), differentiable in the poses."""
        total = torch.zeros(len(instants), 2).to(self._static.means)
        shots = torch.zeros(len(instants)).to(total)
        for number, video in enumerate(self.footage.videos):
            frames = self._frames(number, instants)
            for rows in _filmed(frames, _MAX_RENDERS):
                posed = self._place(position_m[rows], quat_wxyz[rows])
                window = window_of(video, frames[rows], posed.means, self._reach)
                color, mask = self._residuals(number, window, posed)
                photometric = color.abs().sum((1, 2, 3)) / 3 + self._outside(number, window)
                silhouette = mask.abs().sum((1, 2, 3)) + _mask_outside(video, window)
                pixels = video.size[0] * video.size[1]
                pair = torch.stack([photometric, MASK_WEIGHT * silhouette], -1) / pixels
                total = total.index_add(0, rows.to(total.device), pair)
                shots[rows] += 1
        return total / shots.clamp_min(1)[:, None]

    def gradient(self, instants: Tensor, position_m: Tensor, quat_wxyz: Tensor) -> tuple[Tensor, Tensor]:
        """Return values (K,) and exact gradients (K, 6 nf) by the poses, in the coordinates of `PoseModel`."""
        values, slopes = [], []
        for rows in torch.arange(len(instants)).split(_MAX_RENDERS // 4):
            change = torch.zeros(len(rows), 6 * len(self.free)).to(self._static.means).requires_grad_()
            moved = self.moved(position_m[rows], quat_wxyz[rows], change)
            value = self.parts(instants[rows], *moved).sum(-1)
            (slope,) = torch.autograd.grad(value.sum(), change)
            values.append(value.detach())
            slopes.append(slope)
        return torch.cat(values), torch.cat(slopes)

    @torch.no_grad()
    def expand(self, instants: Tensor, position_m: Tensor, quat_wxyz: Tensor, blur: int = 1) -> PoseModel:
        """Return the Huber loss at poses, minus that of the background, with gradient and curvature by differences.

        The curvature is that of re-weighted least squares, J^T diag(1 / max(|r|, HUBER)) J. Averaging residuals over
        half-overlapping squares of `blur` pixels widens the basin to about as many pixels.
        """
        count, size = len(instants), 6 * len(self.free)
        like = self._static.means
        value, slope = torch.zeros(count).to(like), torch.zeros(count, size).to(like)
        curvature, shots = torch.zeros(count, size, size).to(like), torch.zeros(count).to(like)
        steps = torch.cat(
            [like.new_tensor([self._step_m] * 3 + [self._step_m / self.radii[index]] * 3) for index in self.free]
        )
        for number in range(len(self.footage.videos)):
            frames = self._frames(number, instants)
            for rows in _filmed(frames, max(1, _MAX_RENDERS // (size + 1))):
                pair = self._shot_model(number, frames[rows], position_m[rows], quat_wxyz[rows], steps, blur)
                for target, part in zip((value, slope, curvature), pair, strict=True):
                    target.index_add_(0, rows.to(target.device), part)
                shots[rows] += 1
        shots = shots.clamp_min(1)
        return PoseModel(value / shots, slope / shots[:, None], curvature / shots[:, None, None])

    @torch.no_grad()
    def quality(self, instants: Tensor, position_m: Tensor, quat_wxyz: Tensor) -> PoseQuality:
        """Return the agreement of renders at poses with the frames where the bodies are drawn."""
        count, free = len(instants), list(self.free)
        inside, union, error, blank, area = (torch.zeros(count).to(self._static.means) for _ in range(5))
        for number, video in enumerate(self.footage.videos):
            frames = self._frames(number, instants)
            for rows in _filmed(frames, _MAX_RENDERS):
                posed = self._place(position_m[rows], quat_wxyz[rows])
                window = window_of(video, frames[rows], posed.means, self._reach)
                picture = self._picture(number, window, posed)
                shown = picture[..., 3:][..., free]
                body = shown.sum(-1)
                error[rows] += (self._color(number, window, picture).abs().mean(-1) * body).sum((1, 2))
                blank[rows] += (self._blank(number, window)[0].abs().mean(-1) * body).sum((1, 2))
                area[rows] += body.sum((1, 2))
                if video.covers is not None:
                    mine, cover = shown > 0.5, window.cut(video.covers.movedim(1, -1))[..., free] > 0.5
                    whole = (video.covers[window.frames][:, free] > 0.5).sum((1, 2, 3))
                    both = (mine & cover).sum((1, 2, 3))
                    inside[rows] += both
                    union[rows] += mine.sum((1, 2, 3)) + whole - both
        return PoseQuality(inside / union, error / area, blank / area, area)

    def difference(self, number: int, frame: int) -> Tensor:
        """Return the difference of a frame from the scene behind the bodies, averaged over channels (H, W).

        The scene is the model's background and, if the camera does not move, the median of all frames. A pixel must
        differ from both, because renders of textured ground are wrong at every edge.
        """
        drop, video = self._backdrops[number], self.footage.videos[number]
        difference = (drop.gain * drop.plates[drop.plate_of[frame]] - video.frames[frame]).abs().mean(-1)
        if len(drop.plates) > 1:
            return difference
        usual = (video.frames.median(0).values - video.frames[frame]).abs().mean(-1)
        return difference.minimum(usual)

    def _frames(self, number: int, instants: Tensor) -> Tensor:
        """Return the frames of a video at instants (K,), -1 where there is none, on the CPU."""
        return torch.as_tensor(self.footage.frame_at[number])[instants.cpu()]

    def moved(self, position_m: Tensor, quat_wxyz: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
        """Return poses of all bodies with those of the free ones changed by (K, 6 nf)."""
        position, quat = list(position_m.to(change).unbind(1)), list(quat_wxyz.to(change).unbind(1))
        for column, index in enumerate(self.free):
            shift, turn = change[:, 6 * column : 6 * column + 6].split(3, -1)
            position[index] = position[index] + shift
            quat[index] = quat_multiply(quat[index], quat_exp(turn))
        return torch.stack(position, 1), torch.stack(quat, 1)

    def _shot_model(
        self, number: int, frames: Tensor, position_m: Tensor, quat_wxyz: Tensor, steps: Tensor, blur: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return loss (K,), gradient (K, D) and curvature (K, D, D) of one camera's frames at poses."""
        video, size = self.footage.videos[number], len(steps)
        count = len(frames)
        changes = torch.cat([torch.zeros(1, size).to(steps), torch.diag(steps)]).repeat_interleave(count, 0)
        posed = self._place(*self.moved(position_m.repeat(size + 1, 1, 1), quat_wxyz.repeat(size + 1, 1, 1), changes))
        window = window_of(video, frames, posed.means[:count], self._reach, margin=2)  # of the poses, unchanged
        shown = _rows(*self._residuals(number, window.repeat(size + 1), posed), blur).view(size + 1, count, -1)
        blank = _rows(*self._blank(number, window), blur)
        residual = shown[0]
        jacobian = (shown[1:] - residual) / steps[:, None, None]
        pixels = video.size[0] * video.size[1] / max(1, blur // 2) ** 2
        weight = 1 / residual.abs().clamp_min(HUBER) / pixels
        slope = torch.einsum("dkm,km->kd", jacobian, weight * residual)
        curvature = torch.einsum("dkm,km,ekm->kde", jacobian, weight, jacobian)
        return (_huber(residual) - _huber(blank)).sum(-1) / pixels, slope, curvature

    def _residuals(self, number: int, window: Window, posed: Posed) -> tuple[Tensor, Tensor]:
        """Return colour (S, h, w, 3) and mask (S, h, w, nb, or 0 without masks) residuals in the window."""
        video = self.footage.videos[number]
        picture = self._picture(number, window, posed)
        color = self._color(number, window, picture)
        if video.covers is None:
            return color, picture[..., :0]
        return color, picture[..., 3:] - window.cut(video.covers.movedim(1, -1))

    def _outside(self, number: int, window: Window) -> Tensor:
        """Return the photometric sum outside the window (S,)."""
        drop = self._backdrops[number]
        return drop.unexplained[window.frames] - self._blank(number, window)[0].abs().sum((1, 2, 3)) / 3

    def _color(self, number: int, window: Window, picture: Tensor) -> Tensor:
        """Return the colour residuals of a rendered window (S, h, w, 3)."""
        exposed = (self._backdrops[number].gain * picture[..., :3]).clamp(0, 1)
        return exposed - window.cut(self.footage.videos[number].frames)

    def _blank(self, number: int, window: Window) -> tuple[Tensor, Tensor]:
        """Return the residuals of the background alone in the window, as :meth:`_residuals` does."""
        video, drop = self.footage.videos[number], self._backdrops[number]
        behind = (drop.gain * window.cut(drop.plates, drop.plate_of[window.frames])).clamp(0, 1)
        color = behind - window.cut(video.frames)
        return color, color[..., :0] if video.covers is None else -window.cut(video.covers.movedim(1, -1))

    def _place(self, position_m: Tensor, quat_wxyz: Tensor) -> Posed:
        """Return poses with the moving spheres' centres."""
        like = self._static.means
        parts = []
        for index, spheres in self._moving:
            rotation = quat_to_matrix(quat_wxyz[:, index].to(like))
            parts.append(spheres.means @ rotation.transpose(1, 2) + position_m[:, index, None].to(like))
        return Posed(position_m, quat_wxyz, torch.cat(parts, 1))

    def _picture(self, number: int, window: Window, posed: Posed) -> Tensor:
        """Return colours and visible bodies in the window, shape (S, h, w, 3 + nb)."""
        video, drop = self.footage.videos[number], self._backdrops[number]
        means = posed.means
        K = video.K.repeat(len(means), 1, 1)
        K[:, :2, 2] -= window.corners.to(K)
        spheres = (means, self._scales, self._opacities, self._features)
        shown = render(*spheres, video.viewmats[window.frames], K, *window.size, min_alpha=self._min_alpha)
        plate_of = drop.plate_of[window.frames]
        near = window.cut(drop.depths[..., None], plate_of)[..., 0] + self._roughness < shown.depth.detach()
        seen = (~near).to(means)[..., None]
        behind = window.cut(drop.plates, plate_of) * (1 - seen * shown.alpha[..., None])
        return seen * shown.features + torch.nn.functional.pad(behind, (0, self._count))


def _filmed(frames: Tensor, most: int) -> Iterator[Tensor]:
    """Yield the indices of poses (K,) with a frame of the camera, in batches of at most `most`."""
    rows = (frames >= 0).nonzero()[:, 0]
    if len(rows):
        yield from rows.split(most)


def _rows(color: Tensor, mask: Tensor, blur: int) -> Tensor:
    """Return colour and mask residuals (S, h, w, F) as rows (S, m): weighted, averaged over squares of `blur`."""
    residuals = torch.cat([color / 3, MASK_WEIGHT * mask], -1)
    if blur > 1:
        pictures = residuals.movedim(-1, 1)
        residuals = torch.nn.functional.avg_pool2d(pictures, blur, max(1, blur // 2), blur // 2, ceil_mode=True)
    return residuals.flatten(1)


def _huber(residual: Tensor) -> Tensor:
    """Return the Huber loss of each residual, with slope 1 above `HUBER`."""
    size = residual.abs()
    return torch.where(size < HUBER, 0.5 * size.square() / HUBER, size - 0.5 * HUBER)


def _mask_outside(video: Video, window: Window) -> Tensor:
    """Return the sum of the masks outside the window (S,)."""
    if video.covers is None:
        return torch.zeros(len(window.frames)).to(video.frames)
    inside = window.cut(video.covers.movedim(1, -1)).sum((1, 2, 3))
    return video.covers[window.frames].sum((1, 2, 3)) - inside


def _reach(spheres: Spheres, min_alpha: float) -> Tensor:
    """Return the distance from its centre at which a sphere's alpha falls to `min_alpha` [m], shape (N,)."""
    return spheres.scales * (2 * (spheres.opacities / min_alpha).clamp_min(1.0).log()).sqrt()


def _radius(spheres: Spheres) -> float:
    """Return the mean distance of a body's spheres from their centroid [m]."""
    return float((spheres.means - spheres.means.mean(0)).norm(dim=1).mean().clamp_min(1e-4))


def _required_scene(model: Model, free: Sequence[int]) -> Splats:
    """Return the model's background; refuse a model without it, or without visual spheres of a free body."""
    todo = "run 'cgwm fit CAPTURE --stage sg-gs' on photos with masks, then pass the model with --from."
    if model.scene is None:
        raise InputDataError(
            "the model has no background, so its renders cannot be compared with video frames.",
            "a model with the stage sg-gs from photos.",
            todo,
        )
    for index in free:
        name = model.file.bodies[index].name
        if name not in model.body_splats:
            raise InputDataError(
                f"the model has no visual spheres of the free body '{name}'.", "spheres from photos with masks.", todo
            )
    return model.scene
