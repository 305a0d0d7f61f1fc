"""Photos as the fit sees them: undistorted, reduced, with soft masks and pinhole cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.cameras import Camera
from ...datasets.capture import Capture
from ...datasets.progress import progress
from .hull import Silhouette
from .volume import Array

_FINE_SIZE = 800


@dataclass(frozen=True, eq=False)
class View:
    """One photo.

    Attributes:
        name: Path relative to images/.
        image: sRGB values in [0, 1], shape (H, W, 3).
        cover: Share of each pixel that each body covers, in [0, 1], shape (bodies, H, W); None without a mask.
        K: Camera matrix at this size [px], shape (3, 3).
        viewmat: T_cam_world, shape (4, 4).
        camera: The camera at the photo's own size, without distortion.
        labels: Mask at the photo's own size, without distortion, or None.
        grey: Grey values in [0, 1], longer side at most 800 px, on the CPU, shape (h, w).
    """

    name: str
    image: Tensor
    cover: Tensor | None
    K: Tensor
    viewmat: Tensor
    camera: Camera
    labels: NDArray[np.uint8] | None
    grey: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height [px]."""
        return self.image.shape[1], self.image.shape[0]

    def silhouette(self, body: int) -> Silhouette | None:
        """Return the mask of a body (its place in the manifest), at the photo's own size."""
        if self.labels is None:
            return None
        return Silhouette(self.labels == body + 1, self.camera.K, self.camera.T_cam_world)

    def crop(self, left: int, top: int, width: int, height: int) -> View:
        """Return a window of the view [px]; its camera's principal point is moved."""
        K = self.K.clone()
        K[0, 2] -= left
        K[1, 2] -= top
        rows, columns = slice(top, top + height), slice(left, left + width)
        cover = None if self.cover is None else self.cover[:, rows, columns]
        return View(self.name, self.image[rows, columns], cover, K, self.viewmat, self.camera, self.labels, self.grey)


def load_views(capture: Capture, names: Sequence[str], image_size: int, device: torch.device) -> list[View]:
    """Read photos and masks, take the distortion out, and reduce them to a longer side of `image_size` [px]."""
    bodies = len(capture.manifest.bodies)
    views = []
    for name in progress(names, "reading photos"):
        image, camera = capture.photo_camera(name).undistorted(capture.photo(name))
        mask = capture.photo_mask(name)
        labels = None if mask is None else capture.photo_camera(name).undistorted(mask, labels=True)[0]
        scale = min(1.0, image_size / max(camera.width, camera.height))
        width, height = round(scale * camera.width), round(scale * camera.height)
        small = camera.resized(width, height)
        cover = None if labels is None else _cover(labels, bodies, width, height)
        views.append(
            View(
                name,
                _tensor(_reduced(image.astype(np.float32) / 255, width, height), device),
                None if cover is None else _tensor(cover, device),
                _tensor(small.K, device),
                _tensor(small.T_cam_world, device),
                camera,
                labels,
                _grey(image),
            )
        )
    return views


def with_labels(view: View, labels: NDArray[np.uint8], bodies: int) -> View:
    """Return a view with other labels (h, w), of any size of the same shape; they are brought to the photo's own."""
    width, height = view.camera.width, view.camera.height
    if labels.shape != (height, width):
        own = np.zeros((height, width), np.uint8)
        for k in range(bodies):
            share = (labels == k + 1).astype(np.float32)
            own[cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5] = k + 1
        labels = own
    return replace(view, labels=labels, cover=_tensor(_cover(labels, bodies, *view.size), view.image.device))


def _grey(image: NDArray[np.uint8]) -> Tensor:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    scale = min(1.0, _FINE_SIZE / max(grey.shape))
    return torch.from_numpy(_reduced(grey, round(scale * grey.shape[1]), round(scale * grey.shape[0])))


def _cover(labels: NDArray[np.uint8], bodies: int, width: int, height: int) -> NDArray[np.float32]:
    shares = [_reduced((labels == k + 1).astype(np.float32), width, height) for k in range(bodies)]
    return np.stack(shares) if shares else np.zeros((0, height, width), np.float32)


def _reduced(image: Array, width: int, height: int) -> Array:
    if (image.shape[1], image.shape[0]) == (width, height):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _tensor(array: NDArray, device: torch.device) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)
