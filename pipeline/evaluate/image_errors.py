"""Image errors of predicted motions: PSNR of the frame and of the object, SSIM of the frame, and silhouettes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.capture.cameras import Camera
from ...datasets.capture.capture import Capture
from ...datasets.models.model import Model
from ...schemas import Exposure
from ..rendering.image_metrics import ssim_map
from ..rendering.label_renderer import LabelRenderer
from ..rendering.motion_blur import exposed_for, poses_at
from ..rendering.video_view import expose, video_view
from .prediction import MODEL, EpisodePrediction, Motion
from .silhouette_errors import SilhouetteErrors, silhouette_errors

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MIN_MEAN_SQUARE = 1e-10
"""Minimum mean square error, which limits the PSNR of equal pictures to 100 dB."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VideoComparison:
    """Comparison of the F frames of one episode and camera after the warm-up with the predictions of each method."""

    camera: str
    """Name of the video camera."""
    time_s: Array
    """Times of the frames [s], shape (F,)."""
    psnr_db: dict[str, Array]
    """PSNR of the whole frame by method [dB], shape (F,)."""
    psnr_object_db: dict[str, Array]
    """PSNR over the union of the predicted and the true object mask by method [dB], shape (F,); NaN where both are
    empty."""
    ssim: dict[str, Array]
    """Structural similarity of the whole frame by method [1], shape (F,)."""
    silhouettes: dict[str, SilhouetteErrors]
    """Errors of the silhouettes by method; empty without true masks."""
    cameras: Sequence[Camera]
    """Camera of each frame, without distortion."""
    true_masks: bool
    """Whether the true mask is known; without it the union is the predicted mask alone."""
    real: Image | None = None
    """Frames without distortion, uint8 RGB, shape (F, H, W, 3); None if frames are not kept."""
    predicted: Image | None = None
    """Frames predicted by the model, same shape, or None."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Footage:
    """F frames of a video without distortion."""

    time_s: Array
    """Times of the frames [s], shape (F,)."""
    images: Image
    """Frames, uint8 RGB, shape (F, H, W, 3)."""
    objects: NDArray[np.uint8] | None
    """True masks: 0, or k for the k-th free body, counted from 1, shape (F, H, W); or None."""
    valid: NDArray[np.bool_]
    """Pixels that the original frames cover, shape (H, W)."""
    cameras: list[Camera]
    """Camera of each frame."""


@dataclass(kw_only=True)
class VideoErrors:
    """Comparison of predictions with the videos of a capture; renderers are reused between episodes."""

    model: Model
    """A model with a scene and visual spheres."""
    capture: Capture
    """A capture with calibrated cameras."""
    device: str = "cpu"
    """Device of the renderer."""
    keep_frames: bool = False
    """Whether to keep the frames predicted by the model and the real ones."""
    every: int = 1
    """Stride of the compared frames after the warm-up."""
    _renderers: dict[bytes, LabelRenderer] = field(default_factory=dict)
    """Renderers by camera."""

    def compare(self, prediction: EpisodePrediction, camera: str) -> VideoComparison | None:
        """Return the comparison of one episode and camera, or None if no frame follows the warm-up."""
        footage = self._footage(prediction, camera)
        if footage is None:
            return None
        at = np.abs(prediction.grid_s[:, None] - footage.time_s).argmin(0)
        exposure = self.model.file.exposures.get(camera, Exposure())
        psnr: dict[str, Array] = {}
        object_psnr: dict[str, Array] = {}
        ssim: dict[str, Array] = {}
        silhouettes: dict[str, SilhouetteErrors] = {}
        kept: Image | None = None
        for method, motion in prediction.motions.items():
            shown, labels = self._render(footage, camera, motion, at)
            exposed = expose(self._blurred(footage, camera, motion, prediction.grid_s, shown), exposure)
            psnr[method], object_psnr[method] = self._ratios(footage, exposed, labels > 0)
            ssim[method] = self._similarities(footage, exposed)
            if footage.objects is not None:
                silhouettes[method] = silhouette_errors(footage.objects, labels, footage.valid, len(prediction.bodies))
            if method == MODEL and self.keep_frames:
                kept = (exposed * 255).round().astype(np.uint8)
        real = footage.images if self.keep_frames else None
        known = footage.objects is not None
        return VideoComparison(
            camera=camera,
            time_s=footage.time_s,
            psnr_db=psnr,
            psnr_object_db=object_psnr,
            ssim=ssim,
            silhouettes=silhouettes,
            cameras=footage.cameras,
            true_masks=known,
            real=real,
            predicted=kept,
        )

    def _footage(self, prediction: EpisodePrediction, camera: str) -> _Footage | None:
        capture, episode = self.capture, prediction.episode
        times = capture.frame_times(camera, episode)
        chosen = np.flatnonzero((times > prediction.warmup_end_s + 1e-9) & (times <= prediction.grid_s[-1] + 1e-6))
        chosen = chosen[:: self.every]
        if len(chosen) == 0:
            return None
        frames, numbers = capture.video_frames(camera, episode), capture.frame_numbers(camera, episode)
        masks = capture.video_masks(camera, episode)
        views = [video_view(capture, camera, episode, int(numbers[k]), frames.shape[2:0:-1]) for k in chosen]
        images = np.stack([view.undistorted(frames[k])[0] for view, k in zip(views, chosen, strict=True)])
        objects = None
        if masks is not None:
            plain = [view.undistorted(masks[k], labels=True)[0] for view, k in zip(views, chosen, strict=True)]
            objects = _numbered(np.stack(plain), [capture.body_names.index(name) + 1 for name in prediction.bodies])
        inside = views[0].undistorted(np.full(frames.shape[1:3], 255, np.uint8))[0] == 255
        return _Footage(
            time_s=times[chosen],
            images=images,
            objects=objects,
            valid=inside,
            cameras=[view.undistorted(frames[0])[1] for view in views],
        )

    def _render(self, footage: _Footage, name: str, motion: Motion, at: NDArray[np.int64]) -> tuple[Image, Image]:
        """Return rendered pictures (F, H, W, 3) and numbered masks (F, H, W) of the free bodies."""
        free = [k + 1 for k, body in enumerate(self.model.file.bodies) if body.motion == "free"]
        pictures, masks = np.empty_like(footage.images), np.zeros(footage.images.shape[:3], np.uint8)
        # Repeated poses (a frozen body) are rendered once.
        poses = np.concatenate((motion.position_m[at], motion.quat_wxyz[at]), -1).reshape(len(at), -1)
        views = np.stack([camera.T_world_cam.ravel() for camera in footage.cameras])
        keys, first, place = np.unique(
            np.concatenate((views, poses), 1), axis=0, return_index=True, return_inverse=True
        )
        for key in range(len(keys)):
            frame = int(first[key])
            renderer = self._renderer(name, footage.cameras[frame])
            rows = slice(at[frame], at[frame] + 1)
            block = next(iter(renderer.blocks(motion.position_m[rows], motion.quat_wxyz[rows])))
            same = place.ravel() == key
            pictures[same], masks[same] = block.image[0], _numbered(block.mask[0], free)
        return pictures, masks

    def _blurred(
        self, footage: _Footage, name: str, motion: Motion, grid_s: Array, shown: Image
    ) -> NDArray[np.float32]:
        """Return pictures (F, H, W, 3) of the bodies over the exposures of the camera, 0 to 255."""

        def draw(rows: NDArray[np.intp], position_m: Array, quat_wxyz: Array) -> Image:
            cameras = [footage.cameras[k] for k in rows]
            some = replace(footage, images=footage.images[rows], cameras=cameras)
            return self._render(some, name, Motion(position_m, quat_wxyz), np.arange(len(rows)))[0]

        duration_s = self.model.file.exposures.get(name, Exposure()).duration_s
        poses = partial(poses_at, grid_s, motion.position_m, motion.quat_wxyz)
        return exposed_for(duration_s, draw, shown, poses, footage.time_s)

    def _renderer(self, name: str, camera: Camera) -> LabelRenderer:
        key = camera.T_world_cam.tobytes() + camera.K.tobytes() + bytes(f"{camera.width}x{camera.height}", "ascii")
        if key not in self._renderers:
            if len(self._renderers) > 16:  # a moving camera needs a new renderer for every frame
                self._renderers.clear()
            self._renderers[key] = LabelRenderer(self.model, {name: camera}, self.device)
        return self._renderers[key]

    @staticmethod
    def _ratios(footage: _Footage, exposed: NDArray[np.float32], labels: NDArray[np.bool_]) -> tuple[Array, Array]:
        union = labels if footage.objects is None else labels | (footage.objects > 0)
        whole, objects = np.empty(len(exposed)), np.empty(len(exposed))
        for k, picture in enumerate(exposed):
            square = np.square(picture - footage.images[k].astype(np.float32) / 255).mean(-1)
            whole[k] = _decibel(square[footage.valid])
            objects[k] = _decibel(square[union[k] & footage.valid])
        return whole, objects

    @staticmethod
    def _similarities(footage: _Footage, exposed: NDArray[np.float32]) -> Array:
        similar = np.empty(len(exposed))
        for k, picture in enumerate(exposed):
            real = torch.from_numpy(footage.images[k].astype(np.float32) / 255)
            similar[k] = float(ssim_map(torch.from_numpy(picture), real).numpy()[footage.valid].mean())
        return similar


def _numbered(labels: NDArray[np.integer], bodies: Sequence[int]) -> Image:
    """Return k + 1 where the label is that of the k-th of some bodies, 0 elsewhere."""
    numbers = np.zeros(labels.shape, np.uint8)
    for k, label in enumerate(bodies, 1):
        numbers[labels == label] = k
    return numbers


def _decibel(square: NDArray[np.float32]) -> float:
    return float(-10 * np.log10(max(float(square.mean()), MIN_MEAN_SQUARE))) if square.size else float("nan")
