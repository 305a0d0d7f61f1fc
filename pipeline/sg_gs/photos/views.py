"""Photos prepared for the fit: undistorted, reduced, with soft masks, geometry maps and pinhole cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.cameras import Camera
from ....datasets.capture.capture import Capture
from ....datasets.capture.geometry_maps import GeometryMaps
from ....datasets.io.progress import progress
from ....schemas import InputDataError, Viewpoint
from ...geometry.solid_grid import Array
from ...geometry.spheres import Spheres
from ...rendering.render import RenderOutput, render
from .silhouette import Silhouette

COVERED, SURELY_COVERED = 0.5, 0.95
"""Cover by a mask from which on a pixel counts as the body's, and as its inside, where no edge blends colours."""
_FINE_SIZE = 800
_MARGIN_PX = 6


@dataclass(frozen=True, eq=False)
class View:
    """One prepared photo."""

    name: str
    """Path relative to images/."""
    image: Tensor
    """sRGB values in [0, 1], shape (H, W, 3)."""
    cover: Tensor | None
    """Share of each pixel that each body covers, in [0, 1], shape (bodies, H, W); None without a mask."""
    K: Tensor
    """Camera matrix at this size [px], shape (3, 3)."""
    viewmat: Tensor
    """T_cam_world, shape (4, 4)."""
    camera: Camera
    """Camera at the original size, without distortion."""
    labels: NDArray[np.uint8] | None
    """Mask at the original size, without distortion, or None."""
    grey: Tensor
    """Grey values in [0, 1], longer side at most 800 px, on the CPU, shape (h, w)."""
    depth: Tensor | None = None
    """Depth along the optical axis [m], 0 where unknown, shape (H, W); None without a map."""
    normals: Tensor | None = None
    """Outward unit normals, camera axes, zero where unknown, shape (H, W, 3); None without a map."""
    features: Tensor | None = None
    """Feature map, each channel scaled to [0, 1] over all photos, shape (H, W, F); None without one."""
    depth_map: NDArray[np.float32] | None = None
    """Depth at the original size, without distortion [m], shape (h, w), or None."""
    seen: Tensor | None = None
    """Whether the photo shows each pixel, shape (H, W); without distortion its edge is curved, and black beyond. None
    where it shows all."""

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height [px]."""
        return self.image.shape[1], self.image.shape[0]

    def rays(self, columns: NDArray[np.intp], rows: NDArray[np.intp]) -> Array:
        """Return unit vectors (n, 3), world frame, from the camera through the centres of pixels (n,)."""
        K, T = self.K.double().cpu().numpy(), self.viewmat.double().cpu().numpy()
        local = [(columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(rows))]
        along = np.stack(local, 1)
        return along / np.linalg.norm(along, axis=1, keepdims=True) @ T[:3, :3]

    def silhouette(self, body: int) -> Silhouette | None:
        """Return the mask of a body (index in the manifest) at the original size, or None without a mask."""
        if self.labels is None:
            return None
        return Silhouette(self.labels == body + 1, self.camera.K, self.camera.T_cam_world, self.depth_map)

    def crop(self, left: int, top: int, width: int, height: int) -> View:
        """Return a window of the view [px], with the principal point of its camera moved."""
        K = self.K.clone()
        K[0, 2] -= left
        K[1, 2] -= top
        rows, columns = slice(top, top + height), slice(left, left + width)
        maps = {
            name: None if value is None else value[rows, columns]
            for name, value in (
                ("depth", self.depth),
                ("normals", self.normals),
                ("features", self.features),
                ("seen", self.seen),
            )
        }
        cover = None if self.cover is None else self.cover[:, rows, columns]
        return replace(self, image=self.image[rows, columns], cover=cover, K=K, **maps)

    def completed(self, picture: Tensor) -> Tensor:
        """Return the photo (H, W, 3), with a picture (H, W, 3) of the view where the photo shows nothing."""
        return self.image if self.seen is None else torch.where(self.seen[..., None], self.image, picture)

    def weighted(self, weight: Tensor) -> Tensor:
        """Return weights of pixels (H, W) with 0 where the photo shows nothing."""
        return weight if self.seen is None else weight * self.seen


def load_views(capture: Capture, names: Sequence[str], image_size: int, device: torch.device) -> list[View]:
    """Read photos, masks and maps, undistort them, and reduce them to a longer side of `image_size` [px]."""
    bodies = len(capture.manifest.bodies)
    views = []
    for name in progress(names, "reading photos"):
        original = capture.photo_camera(name)
        image, camera = original.undistorted(capture.photo(name))
        mask = capture.photo_mask(name)
        labels = None if mask is None else original.undistorted(mask, labels=True)[0]
        scale = min(1.0, image_size / max(camera.width, camera.height))
        width, height = round(scale * camera.width), round(scale * camera.height)
        small = camera.resized(width, height)
        cover = None if labels is None else _cover(labels, bodies, width, height)
        maps = _undistorted_maps(capture.photo_maps(name), original)
        depth, normals, features = _reduced_maps(maps, width, height)
        views.append(
            View(
                name=name,
                image=_tensor(_reduced(image.astype(np.float32) / 255, width, height), device),
                cover=None if cover is None else _tensor(cover, device),
                K=_tensor(small.K, device),
                viewmat=_tensor(small.T_cam_world, device),
                camera=camera,
                labels=labels,
                grey=_grey(image),
                depth=None if depth is None else _tensor(depth, device),
                normals=None if normals is None else _tensor(normals, device),
                features=None if features is None else _tensor(features, device),
                depth_map=maps.depth_m,
                seen=_seen(original, width, height, device),
            )
        )
    return _with_features_scaled(views)


def render_view(spheres: Spheres, view: View, background: Tensor | None = None) -> RenderOutput:
    """Render spheres (world frame) from the camera of a view."""
    width, height = view.size
    spheres = spheres.seen_from(camera_center(view.viewmat))
    return render(
        spheres.means,
        spheres.scales,
        spheres.opacities,
        spheres.colors,
        view.viewmat[None],
        view.K[None],
        width,
        height,
        background,
    )


def as_bytes(picture: Tensor) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) with values in about [0, 1] as uint8 on the CPU."""
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def camera_center(viewmat: Tensor) -> Tensor:
    """Return the centre of a camera, world frame, from T_cam_world (4, 4)."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def body_windows(views: Sequence[View], body: int) -> list[View]:
    """Return windows of the views around the mask of a body; views without it are omitted."""
    windows = []
    for view in views:
        if view.cover is None or not bool((view.cover[body] > COVERED).any()):
            continue
        rows, columns = (view.cover[body] > COVERED).nonzero(as_tuple=True)
        width, height = view.size
        left, top = max(int(columns.min()) - _MARGIN_PX, 0), max(int(rows.min()) - _MARGIN_PX, 0)
        right, bottom = min(int(columns.max()) + _MARGIN_PX, width - 1), min(int(rows.max()) + _MARGIN_PX, height - 1)
        windows.append(view.crop(left, top, right - left + 1, bottom - top + 1))
    return windows


def focus_of(views: Sequence[View]) -> Array:
    """Return the point nearest to the optical axes [m], world frame, shape (3,)."""
    axes = np.stack([view.camera.T_world_cam[:3, 2] for view in views])
    across = np.eye(3) - np.einsum("ni,nj->nij", axes, axes)
    centers = np.stack([view.camera.center for view in views])
    return np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centers), rcond=None)[0]


def middle_view(views: Sequence[View]) -> Viewpoint:
    """Return the place of the photo that is nearest to all others; its target is as far as the point all look at."""
    centers = np.stack([view.camera.center for view in views])
    apart = np.linalg.norm(centers[:, None] - centers, axis=2).sum(1)
    pose = views[int(apart.argmin())].camera.T_world_cam
    eye, forward = pose[:3, 3], pose[:3, 2]
    depth = float((focus_of(views) - eye) @ forward)
    target = eye + (depth if depth > 0 else 1.0) * forward
    return Viewpoint(eye_m=tuple(eye.tolist()), target_m=tuple(target.tolist()), up=tuple((-pose[:3, 1]).tolist()))


def spread_of(views: Sequence[View]) -> float:
    """Return 1.1 times the largest distance of a camera from the mean of the cameras, a scale of the scene [m]."""
    centers = np.stack([view.camera.center for view in views])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())


def _undistorted_maps(maps: GeometryMaps, camera: Camera) -> GeometryMaps:
    """Undistort the maps without mixing unknown depths and normals into known ones."""

    def straight(values: NDArray[np.float32] | None, nearest: bool) -> NDArray[np.float32] | None:
        if values is None:
            return None
        at_size = camera.resized(values.shape[1], values.shape[0])
        if values.ndim == 2:
            return at_size.undistorted(values, nearest)[0]
        # OpenCV takes at most four channels at once.
        channels = [values[..., k] for k in range(values.shape[2])]
        return np.stack([at_size.undistorted(np.ascontiguousarray(one), nearest)[0] for one in channels], -1)

    return GeometryMaps(straight(maps.depth_m, True), straight(maps.normals_cam, True), straight(maps.features, False))


def _reduced_maps(maps: GeometryMaps, width: int, height: int) -> list[NDArray[np.float32] | None]:
    """Return depth, normals and features at the fit's size.

    Depth and normals are those of the middle pixel: a mean across a border would lie on neither side of it.
    """
    size = (width, height)
    nearest = [
        None if values is None else np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST), np.float32)
        for values in (maps.depth_m, maps.normals_cam)
    ]
    features = None
    if maps.features is not None:
        channels = [maps.features[..., k] for k in range(maps.features.shape[2])]
        smaller = width < maps.features.shape[1]
        how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        resized = [cv2.resize(np.ascontiguousarray(one), size, interpolation=how) for one in channels]
        features = np.asarray(np.stack(resized, -1), np.float32)
    return [*nearest, features]


def _with_features_scaled(views: list[View]) -> list[View]:
    """Scale each channel of the feature maps to [0, 1] by its range over all photos.

    Raises:
        InputDataError: If the photos' features have different numbers of channels.
    """
    maps = {view.name: view.features for view in views if view.features is not None}
    if not maps:
        return views
    widths = {name: value.shape[-1] for name, value in maps.items()}
    if len(set(widths.values())) > 1:
        name, other = sorted(widths, key=lambda name: widths[name])[:: len(widths) - 1][:2]
        raise InputDataError(
            f"features/: {widths[name]} channels for {name}, {widths[other]} for {other}.",
            "the same number for all.",
            todo="compute the features again with one network for all images.",
        )
    low = torch.stack([value.amin((0, 1)) for value in maps.values()]).amin(0)
    high = torch.stack([value.amax((0, 1)) for value in maps.values()]).amax(0)
    span = (high - low).clamp_min(1e-12)
    return [replace(v, features=None if v.features is None else (v.features - low) / span) for v in views]


def with_labels(view: View, labels: NDArray[np.uint8], bodies: int) -> View:
    """Return a view with other labels (h, w) of the same aspect ratio, resized to the original size of the photo."""
    width, height = view.camera.width, view.camera.height
    if labels.shape != (height, width):
        own = np.zeros((height, width), np.uint8)
        for k in range(bodies):
            share = (labels == k + 1).astype(np.float32)
            own[cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5] = k + 1
        labels = own
    return replace(view, labels=labels, cover=_tensor(_cover(labels, bodies, *view.size), view.image.device))


def _seen(original: Camera, width: int, height: int, device: torch.device) -> Tensor | None:
    """Return which pixels of the undistorted and reduced photo (height, width) its own pixels fill; None for all."""
    if not np.any(original.distortion):
        return None
    shown = original.undistorted(np.full((original.height, original.width), 255, np.uint8))[0]
    whole = _reduced((shown == 255).astype(np.float32), width, height) > 0.999
    return None if whole.all() else torch.as_tensor(whole, device=device)


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
