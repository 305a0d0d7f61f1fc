"""Predicted motions against the frames of videos: PSNR of the frame and of the object, and SSIM of the frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from ..datasets.cameras import Camera, pose_count
from ..datasets.capture import Capture
from ..datasets.models import Model
from ..schemas import Exposure
from .labels import LabelRenderer
from .prediction import MODEL, EpisodePrediction, Motion
from .splats.losses import ssim_map

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MIN_MEAN_SQUARE = 1e-10
"""Equal pictures have 100 dB, not infinitely many."""


@dataclass(frozen=True, eq=False)
class VideoComparison:
    """One camera's frames of an episode after the warm-up, beside what each method predicts.

    Attributes:
        camera: Name of the video camera.
        time_s: Times of the frames [s], shape (F,).
        psnr_db: By method, over the whole frame, shape (F,).
        psnr_object_db: By method, over the union of the predicted and the true object mask, shape (F,); NaN where
            neither has a pixel.
        ssim: By method, structural similarity of the whole frame, shape (F,).
        true_masks: Whether the true mask was known; without it the union is the predicted mask alone.
        real: The frames without distortion, uint8 RGB, shape (F, H, W, 3); None where frames are not kept.
        predicted: The model's, same shape, or None.
    """

    camera: str
    time_s: Array
    psnr_db: dict[str, Array]
    psnr_object_db: dict[str, Array]
    ssim: dict[str, Array]
    true_masks: bool
    real: Image | None = None
    predicted: Image | None = None


@dataclass(frozen=True, eq=False)
class _Footage:
    """Frames of a video without distortion: images (F, H, W, 3); objects (F, H, W) or None; valid (H, W)."""

    time_s: Array
    images: Image
    objects: NDArray[np.bool_] | None
    valid: NDArray[np.bool_]
    cameras: list[Camera]


@dataclass
class VideoErrors:
    """Compares predictions with the videos of a capture; renderers are kept from one episode to the next.

    Attributes:
        model: A model with a scene and visual spheres.
        capture: With calibrated cameras.
        device: Where to render.
        keep_frames: Keep the frames of the model's prediction beside the real ones.
        every: Look at every so manyth frame after the warm-up.
    """

    model: Model
    capture: Capture
    device: str = "cpu"
    keep_frames: bool = False
    every: int = 1
    _renderers: dict[bytes, LabelRenderer] = field(default_factory=dict)

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
        shown: Image | None = None
        for method, motion in prediction.motions.items():
            pictures, labels = self._render(footage, camera, motion, at)
            exposed = expose(pictures, exposure)
            psnr[method], object_psnr[method] = self._ratios(footage, exposed, labels)
            ssim[method] = self._similarities(footage, exposed)
            if method == MODEL and self.keep_frames:
                shown = (exposed * 255).round().astype(np.uint8)
        real = footage.images if self.keep_frames else None
        known = footage.objects is not None
        return VideoComparison(camera, footage.time_s, psnr, object_psnr, ssim, known, real, shown)

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
            labels = [k + 1 for k, name in enumerate(capture.body_names) if name in prediction.bodies]
            plain = [view.undistorted(masks[k], labels=True)[0] for view, k in zip(views, chosen, strict=True)]
            objects = np.isin(np.stack(plain), labels)
        inside = views[0].undistorted(np.full(frames.shape[1:3], 255, np.uint8))[0] == 255
        return _Footage(times[chosen], images, objects, inside, [view.undistorted(frames[0])[1] for view in views])

    def _render(
        self, footage: _Footage, name: str, motion: Motion, at: NDArray[np.int64]
    ) -> tuple[Image, NDArray[np.bool_]]:
        """Return pictures (F, H, W, 3) and the masks (F, H, W) of the free bodies."""
        free = [k + 1 for k, body in enumerate(self.model.file.bodies) if body.motion == "free"]
        pictures, masks = np.empty_like(footage.images), np.zeros(footage.images.shape[:3], bool)
        # what stays (a frozen body) is rendered once
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
            pictures[same], masks[same] = block.image[0], np.isin(block.mask[0], free)
        return pictures, masks

    def _renderer(self, name: str, camera: Camera) -> LabelRenderer:
        key = camera.T_world_cam.tobytes() + camera.K.tobytes() + bytes(f"{camera.width}x{camera.height}", "ascii")
        if key not in self._renderers:
            if len(self._renderers) > 16:  # a camera that moves needs a new one for every frame
                self._renderers.clear()
            self._renderers[key] = LabelRenderer(self.model, {name: camera}, self.device)
        return self._renderers[key]

    @staticmethod
    def _ratios(footage: _Footage, exposed: NDArray[np.float32], labels: NDArray[np.bool_]) -> tuple[Array, Array]:
        union = labels if footage.objects is None else labels | footage.objects
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


def usable_cameras(capture: Capture, episode: str) -> tuple[list[str], list[str]]:
    """Return the video cameras of an episode that are calibrated, and those that are not."""
    known = capture.cameras.videos if capture.cameras is not None else {}
    names = capture.videos(episode)
    calibrated = [name for name in names if name in known or f"{name}/{episode}" in known]
    return calibrated, [name for name in names if name not in calibrated]


def video_view(capture: Capture, camera: str, episode: str, frame: int, size: tuple[int, int]) -> Camera:
    """Return the camera of a video frame at the size (width, height) [px] of the frame."""
    known = capture.cameras.videos if capture.cameras is not None else {}
    entry = known.get(f"{camera}/{episode}") or known.get(camera)
    moving = entry is not None and pose_count(entry) > 1
    view = capture.video_camera(camera, episode, frame if moving else None)
    return view if (view.width, view.height) == tuple(size) else view.resized(*size)


def expose(pictures: Image, exposure: Exposure) -> NDArray[np.float32]:
    """Return what a camera makes of the model's colours: gain * colour + offset, values in [0, 1]."""
    gain, offset = (np.asarray(values, np.float32) for values in (exposure.gain_rgb, exposure.offset_rgb))
    return np.clip(pictures.astype(np.float32) / 255 * gain + offset, 0.0, 1.0).astype(np.float32)


def renderable(model: Model) -> bool:
    """Return whether a model's pictures can be compared with frames: it has a scene and spheres of every free body."""
    seen = all(body.name in model.body_splats for body in model.file.bodies if body.motion == "free")
    return seen and model.scene is not None


def _decibel(square: NDArray[np.float32]) -> float:
    return float(-10 * np.log10(max(float(square.mean()), MIN_MEAN_SQUARE))) if square.size else float("nan")
