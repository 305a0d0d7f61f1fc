"""Losses of a fit of spheres to photos: pictures, silhouettes and geometry maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from ...geometry.spheres import Spheres
from ...rendering.image_metrics import photometric
from ..photos.photo_exposure import Exposures
from ..photos.views import SURELY_COVERED, View, render_view

if TYPE_CHECKING:
    from ..photos.camera_refinement import Motions

Loss = Callable[[Spheres, View, torch.Generator], tuple[Tensor, Tensor]]
"""Function that returns the loss of one view [1] and the mean square error of the compared picture or silhouette,
which is not differentiated; the generator supplies random numbers."""

DEPTH_WEIGHT, NORMAL_WEIGHT, FEATURE_WEIGHT = 1.0, 0.02, 0.1
"""Weights of the geometry maps relative to the silhouette; depth is in units of the body size."""
_OUTLYING = 0.05
"""Scale of large depth errors, in units of the body size."""
_NORMAL_WINDOW = 5


def geometry_loss(body: int, size_m: float, radius_factor: float) -> Loss:
    """Return the loss of a body's geometry: silhouette, and depth, normals and features where the photos have them.

    The colours of the spheres are their features (N, F) where a view has a feature map, and are not used elsewhere.

    Args:
        body: Index of the body in the manifest.
        size_m: Size of the body [m], the unit of depth errors.
        radius_factor: Collision radius in units of the scale; depth is that of the collision surface.
    """

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        cover = cover_of(view)
        mine, free = cover[body], view.weighted(1 - (cover.sum(0) - cover[body]))
        front = _front(spheres, view, radius_factor)
        output = render_view(replace(spheres, colors=torch.cat([spheres.colors, front[:, None]], 1)), view)
        off = (output.alpha[0] - mine) * free
        value = off.abs().mean()
        sure = (mine > 0.95) & (output.alpha[0].detach() > 0.5)
        depth = output.features[0, ..., -1] / output.alpha[0].clamp_min(0.5)
        if view.depth is not None:
            value = value + DEPTH_WEIGHT * depth_error(depth, view.depth, sure, size_m)
        if view.normals is not None:
            known = sure & (view.normals.square().sum(-1) > 0)
            facing = (normals_of(depth, view.K) * view.normals).sum(-1)
            value = value + NORMAL_WEIGHT * ((1 - facing) * known).mean()
        if view.features is not None:
            apart = (output.features[0, ..., :-1] - view.features).abs().mean(-1)
            value = value + FEATURE_WEIGHT * (apart * (mine > 0.95)).mean()
        return value, off.detach().square().mean()

    return loss


def depth_error(depth: Tensor, target: Tensor, chosen: Tensor, unit: Tensor | float) -> Tensor:
    """Return the mean over all pixels (H, W) of the chosen depth errors, in units of `unit` [m].

    Large errors enter logarithmically: they are outliers, or another surface that is visible at a border.
    """
    error = _OUTLYING * ((depth - target).abs() / (unit * _OUTLYING)).log1p()
    return (error * (chosen & (target > 0))).mean()


def normals_of(depth: Tensor, K: Tensor) -> Tensor:
    """Return the unit normals (H, W, 3), camera axes, of a surface at a depth [m] (H, W), towards the camera.

    The depth of spheres varies from pixel to pixel, so it is smoothed over windows of 5 x 5 first.
    """
    smooth = functional.avg_pool2d(depth[None, None], _NORMAL_WINDOW, 1, _NORMAL_WINDOW // 2, count_include_pad=False)
    height, width = depth.shape
    v, u = torch.meshgrid(
        torch.arange(height, device=depth.device) + 0.5, torch.arange(width, device=depth.device) + 0.5, indexing="ij"
    )
    rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)])
    points = functional.pad((rays * smooth[0])[None], (1, 1, 1, 1), mode="replicate")[0]
    down = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    right = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    return functional.normalize(torch.linalg.cross(down, right, dim=0), dim=0).permute(1, 2, 0)


def _front(spheres: Spheres, view: View, radius_factor: float) -> Tensor:
    """Return the depth of the point of each sphere that is nearest to the camera [m], shape (N,)."""
    return spheres.means @ view.viewmat[2, :3] + view.viewmat[2, 3] - radius_factor * spheres.scales


def body_loss(body: int, exposures: Exposures) -> Loss:
    """Return the loss of a body's appearance in front of a random background, which constrains alpha."""

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        background = torch.rand(3, generator=generator).to(view.image)
        output = render_view(spheres, view)
        cover = cover_of(view)
        mine = cover[body][..., None]
        exposures.follow(view, output.features[0].detach(), cover[body] > SURELY_COVERED)
        picture = exposures.gain(view) * output.features[0] + (1 - output.alpha[0])[..., None] * background
        others = 1 - view.weighted(1 - (cover.sum(0) - cover[body]))[..., None]
        # Pixels at the border mix body and background; the colour of the body in them is unknown.
        target = torch.where(mine > 0.95, view.image, mine * picture.detach() + (1 - mine) * background)
        sure = (1 - others[..., 0]) * ((mine[..., 0] > 0.95) | (mine[..., 0] < 0.05))
        edge = ((output.alpha[0] - mine[..., 0]).abs() * (1 - others[..., 0])).mean()
        wrong = ((picture - target).detach().square().mean(-1) * sure).sum() / sure.sum().clamp_min(1.0)
        return photometric(picture, target, sure) + 0.5 * edge, wrong

    return loss


def behind(bodies: Spheres | None, spheres: Spheres) -> Spheres:
    """Return the spheres of the bodies (if any) and of the background as one set."""
    return spheres if bodies is None else Spheres.joined([bodies, spheres])


def scene_loss(bodies: Spheres | None, exposures: Exposures, motions: Motions | None = None) -> Loss:
    """Return the loss of the background with the bodies fixed in it; depth enters where it is known.

    Args:
        bodies: Visual spheres of the bodies, world frame, or None. Without them, pixels inside the masks of bodies
            are ignored.
        exposures: Gains of the photos, learned at the same time.
        motions: Motions of the cameras, if they are learned at the same time.
    """

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        view = view if motions is None else motions.moved(view)
        output = render_view(behind(bodies, spheres), view)
        exposures.follow(view, output.features[0].detach(), view.weighted((output.alpha[0].detach() > 0.5).float()))
        picture = exposures.gain(view) * output.features[0]
        photo = view.completed(picture.detach())
        value = photometric(picture, photo, None if bodies is not None else scene_weight(view))
        if motions is not None:
            value = value + motions.prior(view)
        if view.depth is not None:
            seen = output.alpha[0].detach() > 0.5
            value = value + DEPTH_WEIGHT * depth_error(output.depth[0], view.depth, seen, view.depth.clamp_min(1e-6))
        return value, (picture - photo).detach().square().mean()

    return loss


def scene_weight(view: View) -> Tensor:
    """Return the share of the background in each pixel, shape (H, W); 1 without a mask."""
    return torch.ones_like(view.image[..., 0]) if view.cover is None else 1 - view.cover.sum(0)


def cover_of(view: View) -> Tensor:
    """Return the share of each pixel that each body covers, shape (bodies, H, W), for a view with a mask."""
    if view.cover is None:
        raise ValueError(f"{view.name} has no mask")
    return view.cover
