"""Evaluation on held-out photos: figures, and a contact sheet of photo, render and error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry.spheres import Spheres
from ..rendering.contact_sheets import SHEET_BYTES, compared, small_png
from ..rendering.image_metrics import psnr, ssim_map
from .photos.camera_refinement import find_motion, moved
from .photos.photo_exposure import Exposures, least_squares_gain
from .photos.views import COVERED, View, as_bytes, camera_center, render_view


@dataclass(frozen=True)
class HeldOut:
    """Quality of the fit on held-out photos."""

    figures: dict[str, Any]
    """Means over the photos, for fit.json: `psnr_db` and `ssim` of the whole picture, with the exposure that is
    expected of a photo; `psnr_object_db` and `mask_iou` where masks show a body; `psnr_right_half_db` of the right half
    of each picture; and `psnr_right_half_corrected_db` of the same with the exposure of the photo (and its pose, where
    poses were refined) estimated on its left half, which excludes differences between photos that are no error of the
    scene."""
    sheet: bytes | None
    """Contact sheet, PNG, or None without photos."""


@torch.no_grad()
def look(
    views: Sequence[View],
    bodies: list[Spheres],
    scene: Spheres | None,
    spread: float,
    *,
    poses: bool,
    exposures: Exposures | None = None,
) -> HeldOut:
    """Compare held-out photos with renders of the spheres.

    Args:
        views: The photos.
        bodies: Visual spheres of the bodies, world frame.
        scene: The background, or None.
        spread: Size of the cameras' arrangement [m].
        poses: Whether the cameras of the fitted photos were refined.
        exposures: Gains of the fitted photos, if they were learned.
    """
    everything = Spheres.joined([*bodies, *([] if scene is None else [scene])])
    label = torch.zeros(len(everything), 1, device=everything.means.device)
    label[: sum(len(part) for part in bodies)] = 1.0
    whole, similar, inside, overlap, halves = [], [], [], [], []
    pictures: list[NDArray[np.uint8]] = []
    for view in views:
        seen = everything.seen_from(camera_center(view.viewmat))
        colored = Spheres(seen.means, seen.scales, seen.opacities, torch.cat([seen.colors, label], 1))
        features = render_view(colored, view).features[0]
        plain = features[..., :3] if exposures is None else features[..., :3] * exposures.expected(view.name)
        picture = plain.clamp(0, 1)
        pictures.append(as_bytes(picture))
        whole.append(psnr(picture, view.image, view.seen))
        similar.append(_ssim(picture, view))
        if view.cover is not None and bodies:
            true, mine = view.cover.sum(0) > COVERED, features[..., 3] > COVERED
            if true.any():
                inside.append(psnr(picture, view.image, true if view.seen is None else true & view.seen))
                overlap.append(float((true & mine).sum() / (true | mine).sum()))
        shown = _corrected(everything, view, plain, spread, poses)
        right = _half(view, left=False) > 0
        halves.append((psnr(picture, view.image, right), psnr(shown, view.image, right)))
    sheet = None
    if pictures:
        sheet = small_png(compared([as_bytes(view.image) for view in views], pictures), SHEET_BYTES)
    figures = {
        "photos": [view.name for view in views],
        "psnr_db": _mean(whole),
        "ssim": _mean(similar),
        "psnr_object_db": _mean(inside),
        "mask_iou": _mean(overlap),
        "psnr_db_by_photo": [round(value, 3) for value in whole],
        "psnr_right_half_db": _mean([before for before, _ in halves]),
        "psnr_right_half_corrected_db": _mean([after for _, after in halves]),
    }
    return HeldOut(figures, sheet)


def _corrected(spheres: Spheres, view: View, picture: Tensor, spread: float, poses: bool) -> Tensor:
    """Return the render of a photo with its exposure (and its pose), both estimated on its left half.

    `picture` (H, W, 3) is the render from the given pose.
    """
    left = _half(view, left=True)
    if poses:
        with torch.enable_grad():
            view = moved(view, find_motion(spheres, view, left, spread))
        picture = render_view(spheres, view).features[0]
    return (picture * least_squares_gain(picture, view.image, left)).clamp(0, 1)


def _half(view: View, *, left: bool) -> Tensor:
    """Return the weights (H, W) of the left or the right half of a photo: 1 where it shows something."""
    half = torch.zeros_like(view.image[..., 0])
    middle = half.shape[1] // 2
    half[:, :middle] = float(left)
    half[:, middle:] = float(not left)
    return view.weighted(half)


def _ssim(picture: Tensor, view: View) -> float:
    """Return the mean structural similarity of a render (H, W, 3) to what a photo shows."""
    similar = ssim_map(picture, view.completed(picture))
    return float((similar if view.seen is None else similar[view.seen]).mean())


def _mean(values: list[float]) -> float | None:
    return round(float(np.mean(values)), 4) if values else None
