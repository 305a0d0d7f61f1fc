"""Pose tracks from videos: render, compare, correct, and choose among several histories.

A single image often has several poses that explain it about equally (a box turned around, a body seen from one side
only), and a tracker that follows one of them from the first frame may follow a wrong one. Several are followed instead:

1. At a few instants, spread over the episode, all orientations are tried (`pose_search`).
2. Forwards, then backwards in time, each pose is extrapolated to the next instant at constant velocity and corrected;
   the best few distinct ones are kept.
3. Viterbi's algorithm chooses the history with the best agreement of images at plausible rotations between them.
4. Its poses are corrected on the large images.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ....datasets.io.progress import progress
from ....schemas import NotConvergedError
from ...geometry.rotation import geodesic_angle, quat_exp, quat_multiply, quat_turn
from ...trajectories.track_noise import Noise
from .image_loss import ImageLoss, PoseQuality
from .pose_descent import Poses, descended
from .pose_search import distinct, located, search

KEYFRAMES = 5
"""Number of instants at which all orientations are tried first."""
BEAM = 4
"""Maximum number of poses that are followed."""
ALARM = 1.25
"""Ratio of the colour error at the best pose to the median of earlier instants above which all orientations are tried
again, as after an impact."""
ALARM_IOU = 0.8
"""Overlap of the best pose with the masks below which all orientations are tried again."""
MIN_FOUND = 0.5
"""Minimum share of the instants in which the bodies must be found."""
MAX_SPREAD = 2.0
"""Ratio of the standard deviation of a place to the median over the instants above which the body counts as not found
there: tracks have one noise, and where a second camera sees little of the body the first one tells no depth."""
CORRELATED_PX = 5.0
"""Side of the squares over which errors of shape, shading and colour are correlated [px]. Chosen on one built-in scene,
where it makes the standard deviations about as large as the errors of the poses."""
CORRELATED_COARSE_PX = 1.5
"""Side of these squares in the small images [px]."""
TURN_STD_RAD_S = 10.0
"""Standard deviation of the angular speed in the choice among histories; it excludes half a turn between two frames."""
CARRY_ITERATIONS, POLISH_ITERATIONS = 4, 4
"""Maximum number of steps in correcting an extrapolated pose, and in the final correction."""
COARSE_BLUR, FINE_BLUR = 4, 2
"""Side of the squares over which residuals are averaged, in the search and in the final correction [px]."""


@dataclass(frozen=True, kw_only=True)
class PoseTrack:
    """Poses of all bodies at the instants of an episode's footage (I), in the world's order of bodies (nb)."""

    position_m: Tensor
    """Body frame origins [m], world, shape (I, nb, 3)."""
    quat_wxyz: Tensor
    """Orientations, shape (I, nb, 4)."""
    curvature: Tensor
    """Curvature of the image loss by the free bodies' poses, shape (I, 6 nf, 6 nf)."""
    covariance: Tensor
    """Covariance of the free bodies' poses from the scatter of the pixels [m2, rad2], shape (I, 6 nf, 6 nf)."""
    loss: Tensor
    """Image loss, shape (I,)."""
    quality: PoseQuality
    """Agreement of the poses with the frames."""
    found: Tensor
    """Whether the bodies were found, shape (I,)."""
    searches: int
    """Number of instants at which all orientations were tried."""
    rival_nats: float
    """Log-likelihood ratio of the history to the best one with another first orientation; infinite without one."""

    @property
    def variance(self) -> Tensor:
        """Variances of the free bodies' poses where they were found: shift [m2], rotation [rad2], (F, nf, 2, 3)."""
        return self.covariance[self.found].diagonal(dim1=1, dim2=2).unflatten(1, (-1, 2, 3))


def pose_noise(tracks: Sequence[PoseTrack]) -> Noise:
    """Return the noise of found poses by axis (position [m], rotation [rad]).

    The variance is the median over the instants of all tracks, averaged over axes and free bodies.
    """
    std = torch.cat([track.variance for track in tracks]).median(0).values.mean((0, 2)).sqrt()
    return Noise(float(std[0]), float(std[1]))


def well_placed(covariance: Tensor, found: Tensor) -> Tensor:
    """Return whether the places of all free bodies are about as certain as in most instants, shape (I,).

    Args:
        covariance: Covariances of the free bodies' poses, as in `PoseTrack`.
        found: Whether the bodies were found, shape (I,).
    """
    places = covariance.diagonal(dim1=1, dim2=2).unflatten(1, (-1, 2, 3))[:, :, 0].sum(-1).sqrt()
    return (places <= MAX_SPREAD * places[found].median(0).values).all(1)


def track_state(track: PoseTrack) -> dict[str, object]:
    """Return a track in the form of a checkpoint."""
    quality = {name: getattr(track.quality, name) for name in track.quality.__dataclass_fields__}
    rest = {name: getattr(track, name) for name in track.__dataclass_fields__ if name != "quality"}
    # JSON has no infinity
    return rest | {"quality": quality, "rival_nats": None if math.isinf(track.rival_nats) else track.rival_nats}


def stored_track(state: Mapping[str, Any]) -> PoseTrack:
    """Return the track of a checkpoint."""
    rival = math.inf if state["rival_nats"] is None else state["rival_nats"]
    return PoseTrack(**{**state, "quality": PoseQuality(**state["quality"]), "rival_nats": rival})


@dataclass(frozen=True)
class _Followed:
    """Poses (K) at an instant, with the pose before each."""

    instant: int
    """The instant."""
    poses: Poses
    """Poses at the instant."""
    before: Poses | None
    """Most likely pose before each of them; None at the first instant."""
    before_instant: int
    """Instant of the poses before."""


class PoseTracker:
    """Tracker of the free bodies of one episode.

    Args:
        coarse: Loss on small images, for the search.
        fine: Loss on larger images, for the final correction.
        position_m: Body frame origins at the instants [m], world; used for driven bodies, shape (I, nb, 3).
        quat_wxyz: Orientations at the instants, shape (I, nb, 4).
    """

    def __init__(self, coarse: ImageLoss, fine: ImageLoss, position_m: Tensor, quat_wxyz: Tensor) -> None:
        self._coarse, self._fine = coarse, fine
        like = coarse.footage.videos[0].frames
        self._position, self._quat = position_m.to(like).clone(), quat_wxyz.to(like).clone()
        self._times = coarse.footage.times_s
        self._errors: list[float] = []
        self._searches = 0

    def run(self) -> PoseTrack:
        """Track all instants.

        Raises:
            NotConvergedError: If the bodies are found in fewer than half of them.
        """
        count, name = len(self._times), self._coarse.footage.episode
        visible = [k for k in range(count) if all(located(self._coarse, k, i) is not None for i in self._coarse.free)]
        pools = self._searched(visible)
        rival = math.inf
        if pools:
            for order in (visible, visible[::-1]):
                self._follow(progress(order, f"{name}: poses from images", len(order)), pools)
            rival = self._choose(visible, pools)
        instants = torch.arange(count)
        chosen = torch.tensor(visible, dtype=torch.int64)
        if len(chosen):
            poses = descended(
                self._fine, chosen, self._position[chosen], self._quat[chosen], POLISH_ITERATIONS, FINE_BLUR
            )
            self._position[chosen], self._quat[chosen] = poses.position_m, poses.quat_wxyz
        model = self._fine.expand(instants, self._position, self._quat)
        quality = self._fine.quality(instants, self._position, self._quat)
        seen = torch.zeros(count, dtype=torch.bool)
        seen[chosen] = True
        found = quality.found & seen.to(quality.found.device)
        if float(found.float().mean()) < MIN_FOUND:
            raise NotConvergedError(self._failure(quality, found), todo=_TODO)
        covariance = self._covariance(model.curvature, quality).double().cpu()
        found = found.cpu() & well_placed(covariance, found.cpu())
        return PoseTrack(
            position_m=self._position.double().cpu(),
            quat_wxyz=self._quat.double().cpu(),
            curvature=model.curvature.double().cpu(),
            covariance=covariance,
            loss=model.value.cpu(),
            quality=PoseQuality(*(getattr(quality, name).cpu() for name in quality.__dataclass_fields__)),
            found=found,
            searches=self._searches,
            rival_nats=rival,
        )

    def _searched(self, visible: list[int]) -> dict[int, Poses]:
        """Try all orientations at a few instants."""
        places = np.linspace(0, len(visible) - 1, min(KEYFRAMES, len(visible))).round().astype(int)
        return {
            visible[k]: self._search(visible[k], self._position[visible[k]], self._quat[visible[k]]) for k in places
        }

    def _search(self, instant: int, position_m: Tensor, quat_wxyz: Tensor) -> Poses:
        """Try all orientations at one instant."""
        self._searches += 1
        return search(self._coarse, instant, position_m, quat_wxyz, COARSE_BLUR)

    def _follow(self, order: Iterable[int], pools: dict[int, Poses]) -> None:
        """Extrapolate and correct poses from instant to instant in the given order, and add them to the pools."""
        last: _Followed | None = None
        for instant in order:
            here = pools.get(instant)
            corrected: Poses | None = None
            if last is not None:
                position, quat = self._expected(last, instant)
                at = torch.full((len(position),), instant)
                corrected = descended(self._coarse, at, position, quat, CARRY_ITERATIONS, COARSE_BLUR)
                every = corrected if here is None else Poses.joined([corrected, here])
                best = every.at(every.value.argsort(stable=True)[:1])
                if self._alarmed(instant, best):
                    fresh = self._search(instant, best.position_m[0], best.quat_wxyz[0])
                    here = fresh if here is None else Poses.joined([here, fresh])
            every = Poses.joined([part for part in (corrected, here) if part is not None])
            pools[instant] = distinct(self._coarse, every, BEAM)
            last = self._linked(instant, pools[instant], last)

    def _linked(self, instant: int, poses: Poses, last: _Followed | None) -> _Followed:
        """Return poses with the most likely one before each of them."""
        if last is None:
            return _Followed(instant, poses, None, instant)
        turns = self._turn_cost(last.poses, poses, last.instant, instant)
        return _Followed(instant, poses, last.poses.at(turns.argmin(0)), last.instant)

    def _expected(self, last: _Followed, instant: int) -> tuple[Tensor, Tensor]:
        """Return poses (K, nb, ...) extrapolated to another instant, at constant velocity of the free bodies."""
        position = self._position[instant].repeat(len(last.poses), 1, 1)
        quat = self._quat[instant].repeat(len(last.poses), 1, 1)
        for index in self._coarse.free:
            position[:, index], quat[:, index] = last.poses.position_m[:, index], last.poses.quat_wxyz[:, index]
            if last.before is not None:
                step = self._times[last.instant] - self._times[last.before_instant]
                ratio = float((self._times[instant] - self._times[last.instant]) / step)
                shift = position[:, index] - last.before.position_m[:, index]
                turn = quat_turn(last.before.quat_wxyz[:, index], quat[:, index])
                position[:, index] = position[:, index] + ratio * shift
                quat[:, index] = quat_multiply(quat[:, index], quat_exp(ratio * turn))
        return position, quat

    def _alarmed(self, instant: int, best: Poses) -> bool:
        """Return whether the best pose explains the image worse than earlier images were explained."""
        quality = self._coarse.quality(torch.tensor([instant]), best.position_m, best.quat_wxyz)
        error, iou, found = float(quality.error[0]), float(quality.iou[0]), bool(quality.found[0])
        usual = float(np.median(self._errors)) if self._errors else error
        if found:
            self._errors.append(error)
        return not found or error > ALARM * usual or iou < ALARM_IOU

    def _turn_cost(self, before: Poses, after: Poses, first: int, second: int) -> Tensor:
        """Return the negative log-likelihood of the rotations from poses (K) to poses (L), shape (K, L) [nats]."""
        scale = TURN_STD_RAD_S * abs(float(self._times[second] - self._times[first]))
        free = list(self._coarse.free)
        angle = geodesic_angle(before.quat_wxyz[:, None, free], after.quat_wxyz[None, :, free])
        return 0.5 * (angle / scale).square().sum(-1)

    def _choose(self, visible: list[int], pools: dict[int, Poses]) -> float:
        """Choose the most likely history; return its margin over the best one with another first pose [nats]."""
        usual = float(np.median(self._errors)) if self._errors else 0.05
        pixels = sum(v.size[0] * v.size[1] for v in self._coarse.footage.videos)
        unit = pixels / (max(usual, 1e-3) * CORRELATED_COARSE_PX**2)
        best = [unit * pools[k].value.double() for k in visible]
        back: list[Tensor] = []
        total = best[-1]
        for place in range(
            len(visible) - 2, -1, -1
        ):  # backwards, so that the totals at the end belong to the first poses
            first, second = visible[place], visible[place + 1]
            turned = self._turn_cost(pools[first], pools[second], first, second).double()
            ahead = turned + total[None]
            back.append(ahead.argmin(1))
            total = best[place] + ahead.amin(1)
        row = int(total.argmin())
        rival = float(total.sort().values[1] - total.min()) if len(total) > 1 else math.inf
        for place, instant in enumerate(visible):
            self._position[instant], self._quat[instant] = (
                pools[instant].position_m[row],
                pools[instant].quat_wxyz[row],
            )
            if place < len(visible) - 1:
                row = int(back[len(visible) - 2 - place][row])
        return rival

    def _covariance(self, curvature: Tensor, quality: PoseQuality) -> Tensor:
        """Return covariances (I, 6 nf, 6 nf) of poses for independent Laplace errors of the pixels.

        Derived: -log p = pixels * loss / b with b the mean absolute error on the body, so the information is
        pixels * curvature / b for independent pixels; see `CORRELATED_PX` for correlated ones.
        """
        footage = self._fine.footage
        pixels = torch.zeros(len(footage.times_s)).to(curvature)
        for row, video in zip(footage.frame_at, footage.videos, strict=True):
            pixels += torch.as_tensor(row >= 0).to(pixels) * (video.size[0] * video.size[1])
        scale = quality.error.nan_to_num(1.0).clamp_min(1e-3) * CORRELATED_PX**2 / pixels
        return scale[:, None, None] * torch.linalg.pinv(curvature.double(), hermitian=True).to(curvature)

    def _failure(self, quality: PoseQuality, found: Tensor) -> str:
        """Return the message of a tracking that failed."""
        count = int(found.sum())
        text = f"{self._fine.footage.episode}: the body was found in {count} of {len(self._times)} instants"
        if bool(quality.iou.isfinite().any()):
            return f"{text}; median mask IoU {float(quality.iou.nanmedian()):.2f} (at least 0.50 is needed)."
        error, blank = float(quality.error.nanmedian()), float(quality.blank.nanmedian())
        return (
            f"{text}; median colour error on it {error:.3f}, of the background alone {blank:.3f} (0.7 times is needed)."
        )


_TODO = (
    "check that the videos show the body of the model, that their cameras are calibrated in the capture's frame, and "
    "add video_masks/; or fit from tracks: --supervise tracks."
)
"""Advice for a tracking that failed."""
