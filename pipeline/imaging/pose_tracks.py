"""Pose tracks from videos: render, compare, correct, frame by frame.

The first frame starts from the bodies' silhouettes (masks, or what differs from the background) triangulated over the
cameras, in many orientations. Each further frame starts from constant velocity; where the result explains the picture
worse than the frames before did (an impact, a wrong turn), more orientations are tried.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ...datasets.progress import progress
from ...schemas import NotConvergedError
from ..physics.rotation import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_normalize, quat_to_matrix
from .footage import Video
from .image_loss import ImageLoss, PoseQuality

ROTATIONS = 72
"""Orientations that a search scores: about 35 degrees apart, within what the refinement bridges."""
NEARBY_DEG = (20.0, 40.0)
"""Turns from the expected orientation that a search also scores, about fourteen axes each."""
KEPT = 5
"""Best orientations of a search that are refined."""
ALARM = 1.25
"""A search follows when the colour error on the body exceeds the median of the frames so far by this factor."""
ALARM_IOU = 0.8
MIN_FOUND = 0.5
"""With less than this share of the frames found, the tracking has failed."""
MIN_SILHOUETTE_PX = 6.0
CORRELATED_PX = 5.0
"""Errors of shape, shading and colour are shared by squares of about so many pixels. Chosen on one built-in scene,
where it makes the standard deviations about as large as the errors against the true poses."""
DIFFERENCE_FLOOR = 0.08
"""Without masks a pixel shows a body if it differs from the background by this, and by 4 times the median."""


@dataclass(frozen=True)
class PoseTrack:
    """Poses of all bodies at the instants of an episode's footage (I), in the world's order of bodies (nb).

    position_m (I, nb, 3), quat_wxyz (I, nb, 4); curvature (I, 6 nf, 6 nf) of the image loss by the free bodies' poses;
    covariance (I, 6 nf, 6 nf) [m2, rad2], from the scatter of the pixels; loss (I,); quality; found (I,).
    """

    position_m: Tensor
    quat_wxyz: Tensor
    curvature: Tensor
    covariance: Tensor
    loss: Tensor
    quality: PoseQuality
    found: Tensor
    searches: int


class PoseTracker:
    """Tracks the free bodies of one episode.

    Args:
        coarse: The loss on small pictures, for searching.
        fine: The loss on larger ones, for the last steps.
        position_m: Poses of all bodies at the instants; those of driven bodies count, shape (I, nb, 3).
        quat_wxyz: Shape (I, nb, 4).
    """

    def __init__(self, coarse: ImageLoss, fine: ImageLoss, position_m: Tensor, quat_wxyz: Tensor) -> None:
        self._coarse, self._fine = coarse, fine
        like = coarse.footage.videos[0].frames
        self._position, self._quat = position_m.to(like).clone(), quat_wxyz.to(like).clone()
        self._times = coarse.footage.times_s
        self._globe = rotation_grid(ROTATIONS).to(like)
        self._found: list[int] = []
        self._errors: list[float] = []
        self._searches = 0

    def run(self) -> PoseTrack:
        """Track all instants.

        Raises:
            NotConvergedError: If the body is found in fewer than half of them.
        """
        count = len(self._times)
        for instant in progress(range(count), f"{self._coarse.footage.episode}: poses from images", count):
            self._instant(instant)
        instants = torch.arange(count)
        model = self._fine.expand(instants, self._position, self._quat)
        quality = self._fine.quality(instants, self._position, self._quat)
        found = quality.found
        if float(found.float().mean()) < MIN_FOUND:
            raise NotConvergedError(self._failure(quality), todo=_TODO)
        return PoseTrack(
            self._position.double(),
            self._quat.double(),
            model.curvature.double(),
            self._covariance(model.curvature, quality).double(),
            model.value,
            quality,
            found,
            self._searches,
        )

    def _instant(self, instant: int) -> None:
        """Find the poses of one instant and keep them."""
        expected = self._expected(instant)
        located = [self._located(instant, index) for index in self._coarse.free]
        if expected is None:
            position, quat = self._position[instant].clone(), self._quat[instant].clone()
            for index, place in zip(self._coarse.free, located, strict=True):
                if place is None:
                    return  # not in view yet
                position[index] = place
            expected = position, quat
            pose = self._search(instant, expected, located)
        else:
            pose = self._refine(self._coarse, instant, expected[0][None], expected[1][None], 4, COARSE_BLUR)
            if self._alarmed(instant, pose):
                other = self._search(instant, expected, located)
                pose = other if float(other[2]) < float(pose[2]) else pose
        pose = self._refine(self._fine, instant, pose[0], pose[1], 3, FINE_BLUR)
        self._position[instant], self._quat[instant] = pose[0][0], pose[1][0]
        quality = self._coarse.quality(torch.tensor([instant]), pose[0], pose[1])
        if bool(quality.found[0]):
            self._found.append(instant)
            self._errors.append(float(quality.error[0]))

    def _alarmed(self, instant: int, pose: tuple[Tensor, Tensor, Tensor]) -> bool:
        quality = self._coarse.quality(torch.tensor([instant]), pose[0], pose[1])
        error, iou = float(quality.error[0]), float(quality.iou[0])
        usual = float(np.median(self._errors))
        return not bool(quality.found[0]) or error > ALARM * usual or iou < ALARM_IOU

    def _expected(self, instant: int) -> tuple[Tensor, Tensor] | None:
        """Return poses (nb) by constant velocity from the last two found instants, or None before the first."""
        if not self._found:
            return None
        position, quat = self._position[instant].clone(), self._quat[instant].clone()
        last = self._found[-1]
        for index in self._coarse.free:
            position[index], quat[index] = self._position[last, index], self._quat[last, index]
            if len(self._found) > 1:
                before = self._found[-2]
                ratio = float((self._times[instant] - self._times[last]) / (self._times[last] - self._times[before]))
                shift = self._position[last, index] - self._position[before, index]
                turn = quat_log(quat_multiply(quat_conjugate(self._quat[before, index]), self._quat[last, index]))
                position[index] = position[index] + ratio * shift
                quat[index] = quat_multiply(quat[index], quat_exp(ratio * turn))
        return position, quat

    def _search(
        self, instant: int, expected: tuple[Tensor, Tensor], located: list[Tensor | None]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Try many orientations of each free body in turn about its expected and its located place."""
        self._searches += 1
        position, quat = expected[0].clone(), expected[1].clone()
        best: tuple[Tensor, Tensor, Tensor] | None = None
        for index, place in zip(self._coarse.free, located, strict=True):
            turns = torch.cat([_nearby(quat[index]), self._globe])
            center = self._coarse.centers[index]
            middle = place if place is not None else position[index] + quat_to_matrix(quat[index]) @ center
            positions = position.repeat(len(turns), 1, 1)
            quats = quat.repeat(len(turns), 1, 1)
            quats[:, index] = turns
            positions[:, index] = middle - quat_to_matrix(turns) @ center
            values = self._coarse.values(torch.full((len(turns),), instant), positions, quats)
            order = values.argsort(stable=True)[:KEPT]
            few = self._refine(self._coarse, instant, positions[order], quats[order], 3, COARSE_BLUR)
            order = few[2].argsort(stable=True)[:2]
            few = self._refine(self._coarse, instant, few[0][order], few[1][order], 5, COARSE_BLUR)
            first = few[2].argmin()
            best = few[0][first : first + 1], few[1][first : first + 1], few[2][first : first + 1]
            position, quat = best[0][0], best[1][0]
        assert best is not None
        return best

    def _refine(
        self, loss: ImageLoss, instant: int, position: Tensor, quat: Tensor, iterations: int, blur: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Levenberg-Marquardt on the image loss from several starts at once; return poses and losses (K,)."""
        instants = torch.full((len(position),), instant)
        model = loss.expand(instants, position, quat, blur)
        damping = torch.full_like(model.value, 1e-2)
        for _ in range(iterations):
            diagonal = model.curvature.diagonal(dim1=1, dim2=2)
            system = model.curvature + torch.diag_embed(damping[:, None] * diagonal + 1e-9)
            step = -torch.linalg.solve(system.double(), model.slope.double()).to(position)
            step = step * (STEP_LIMIT / (step.abs() / self._scale(loss, step)).amax(1)).clamp_max(1.0)[:, None]
            moved = loss.moved(position, quat, step)
            trial = loss.expand(instants, *moved, blur)
            better = trial.value < model.value
            small = (step.abs() / self._scale(loss, step)).amax(1) < SMALL_STEP
            position = torch.where(better[:, None, None], moved[0], position)
            quat = torch.where(better[:, None, None], quat_normalize(moved[1]), quat)
            model = type(model)(
                torch.where(better, trial.value, model.value),
                torch.where(better[:, None], trial.slope, model.slope),
                torch.where(better[:, None, None], trial.curvature, model.curvature),
            )
            damping = torch.where(better, damping / 5, damping * 10)
            if bool(small.all()):
                break
        return position, quat, model.value

    def _scale(self, loss: ImageLoss, like: Tensor) -> Tensor:
        """Return what a step of one radius is in each coordinate: metres, and radians."""
        return torch.cat([like.new_tensor([loss.radii[index]] * 3 + [1.0] * 3) for index in loss.free])

    def _located(self, instant: int, index: int) -> Tensor | None:
        """Return the middle of a body (world) from its silhouettes, or None where too little of it is seen."""
        rays, distances = [], []
        for number, video in enumerate(self._coarse.footage.videos):
            frame = int(self._coarse.footage.frame_at[number, instant])
            if frame < 0:
                continue
            cover = self._silhouette(number, frame, index)
            area = float(cover.sum())
            if area < MIN_SILHOUETTE_PX:
                continue
            rays.append(_ray(video, frame, cover))
            # a disc of the body's mean radius would cover as many pixels at this distance
            distances.append(self._coarse.radii[index] * float(video.K[0, 0]) * math.sqrt(math.pi / area))
        if not rays:
            return None
        origins, directions = (torch.stack(column) for column in zip(*rays, strict=True))
        if len(rays) == 1:
            return origins[0] + distances[0] * directions[0]
        across = torch.eye(3).to(directions) - directions[:, :, None] * directions[:, None]
        return torch.linalg.solve(across.sum(0), (across @ origins[:, :, None]).sum(0)[:, 0])

    def _silhouette(self, number: int, frame: int, index: int) -> Tensor:
        """Return where a body is seen (H, W): its mask, or the largest region that differs from the background."""
        video = self._coarse.footage.videos[number]
        if video.covers is not None:
            return video.covers[frame, index]
        difference = cv2.blur(self._coarse.difference(number, frame).cpu().numpy(), (3, 3))
        threshold = max(DIFFERENCE_FLOOR, 4 * float(np.median(difference)))
        _, regions, table, _ = cv2.connectedComponentsWithStats((difference > threshold).astype(np.uint8))
        if len(table) < 2:
            return torch.zeros_like(video.frames[frame, ..., 0])
        largest = 1 + int(table[1:, cv2.CC_STAT_AREA].argmax())
        return torch.as_tensor((regions == largest).astype(np.float32)).to(video.frames)

    def _covariance(self, curvature: Tensor, quality: PoseQuality) -> Tensor:
        """Return covariances (I, 6 nf, 6 nf) of poses whose pixels err by a Laplace law, each on its own.

        Derived: -log p = pixels * loss / b with b the mean absolute error on the body, so the information is
        pixels * curvature / b, if pixels erred independently; see `CORRELATED_PX`.
        """
        footage = self._fine.footage
        pixels = torch.zeros(len(footage.times_s)).to(curvature)
        for row, video in zip(footage.frame_at, footage.videos, strict=True):
            pixels += torch.as_tensor(row >= 0).to(pixels) * (video.size[0] * video.size[1])
        scale = quality.error.nan_to_num(1.0).clamp_min(1e-3) * CORRELATED_PX**2 / pixels
        return scale[:, None, None] * torch.linalg.pinv(curvature.double(), hermitian=True).to(curvature)

    def _failure(self, quality: PoseQuality) -> str:
        found = int(quality.found.sum())
        text = f"{self._fine.footage.episode}: the body was found in {found} of {len(self._times)} instants"
        if bool(quality.iou.isfinite().any()):
            return f"{text}; median mask IoU {float(quality.iou.nanmedian()):.2f} (at least 0.50 is needed)."
        error, blank = float(quality.error.nanmedian()), float(quality.blank.nanmedian())
        return (
            f"{text}; median colour error on it {error:.3f}, of the background alone {blank:.3f} (0.7 times is needed)."
        )


STEP_LIMIT = 0.5
"""Longest step of the refinement, in radii of the body and radians."""
SMALL_STEP = 1e-3
"""The refinement ends with a step below this, in the same units."""
COARSE_BLUR, FINE_BLUR = 4, 2
"""Residuals are averaged over this many pixels: while searching, and in the last steps."""
_TODO = (
    "check that the videos show the body of the model, that their cameras are calibrated in the capture's frame, and "
    "add video_masks/; or fit from tracks: --supervise tracks."
)


def rotation_grid(count: int) -> Tensor:
    """Return evenly spread rotations, quaternions wxyz (count, 4).

    Source: super-Fibonacci spirals (M. Alexa, CVPR 2022).
    """
    phi, psi = math.sqrt(2.0), 1.533751168755204288118041
    s = torch.arange(count, dtype=torch.float64) + 0.5
    near, far = (s / count).sqrt(), (1 - s / count).sqrt()
    alpha, beta = 2 * math.pi * s / phi, 2 * math.pi * s / psi
    return torch.stack([near * alpha.sin(), near * alpha.cos(), far * beta.sin(), far * beta.cos()], -1)


def _nearby(quat_wxyz: Tensor) -> Tensor:
    """Return a rotation and its neighbours, shape (1 + 14 * angles, 4)."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3) / math.sqrt(3)
    axes = torch.cat([torch.eye(3), -torch.eye(3), corners]).to(quat_wxyz)
    turns = torch.cat([math.radians(angle) * axes for angle in NEARBY_DEG])
    return quat_multiply(quat_wxyz[None], quat_exp(torch.cat([torch.zeros(1, 3).to(turns), turns])))


def _ray(video: Video, frame: int, cover: Tensor) -> tuple[Tensor, Tensor]:
    """Return origin and unit direction (world) of the ray through the middle of a silhouette (H, W)."""
    rows = torch.arange(cover.shape[0]).to(cover) + 0.5
    columns = torch.arange(cover.shape[1]).to(cover) + 0.5
    area = cover.sum()
    pixel = torch.stack(
        [(cover.sum(0) * columns).sum() / area, (cover.sum(1) * rows).sum() / area, torch.ones(()).to(cover)]
    )
    viewmat = video.viewmats[frame]
    rotation = viewmat[:3, :3]
    direction = rotation.T @ torch.linalg.solve(video.K, pixel)
    return -rotation.T @ viewmat[:3, 3], direction / direction.norm()
