"""What a fit of spheres to photos compares: pictures, silhouettes, and geometry maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from .exposures import Exposures
from .spheres import Spheres
from .views import View, render_view

if TYPE_CHECKING:
    from .poses import Motions

Loss = Callable[[Spheres, View, torch.Generator], tuple[Tensor, Tensor]]
"""The loss of one view [1], given a generator for whatever is random in it, and the mean square error of what was
compared (the picture, or the silhouette), which has no derivative."""

DSSIM_WEIGHT = 0.2
"""Share of D-SSIM in the photometric loss, as in 3D Gaussian splatting (arXiv 2308.04079, equation 7)."""
DEPTH_WEIGHT, NORMAL_WEIGHT, FEATURE_WEIGHT = 1.0, 0.02, 0.1
"""Of the geometry maps beside the silhouette; depth in units of the body's size."""
_OUTLYING = 0.05
"""A depth error of this, in units of the body's size, is large."""
_SSIM_WINDOW = 7
_NORMAL_WINDOW = 5


def photometric(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return (1 - w) L1 + w (1 - SSIM) / 2 of two pictures (H, W, 3), weighted by pixel (H, W) where asked."""
    absolute = (image - target).abs().mean(-1)
    similar = 0.5 * (1 - ssim_map(image, target))
    both = (1 - DSSIM_WEIGHT) * absolute + DSSIM_WEIGHT * similar
    return both.mean() if weight is None else (both * weight).sum() / weight.sum().clamp_min(1.0)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return the structural similarity at each pixel (H, W), over windows of 7 x 7 (Wang et al. 2004)."""

    def mean(values: Tensor) -> Tensor:
        return functional.avg_pool2d(values, _SSIM_WINDOW, 1, _SSIM_WINDOW // 2, count_include_pad=False)

    a, b = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_a, mean_b, aa, bb, ab = mean(torch.stack([a, b, a * a, b * b, a * b])).unbind(0)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * (ab - mean_a * mean_b) + c2) / (aa - mean_a**2 + bb - mean_b**2 + c2)
    return (luminance * structure).mean(0)


@torch.no_grad()
def psnr(image: Tensor, target: Tensor, chosen: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio [dB] of values in [0, 1], over chosen pixels (H, W) or all."""
    square = (image - target).square().mean(-1)
    return psnr_of(square.mean() if chosen is None else square[chosen].mean())


def psnr_of(mean_square: Tensor) -> float:
    """Return the peak signal-to-noise ratio [dB] that a mean square error of values in [0, 1] has."""
    return float(-10 * torch.log10(mean_square.clamp_min(1e-10)))


def geometry_loss(body: int, size_m: float, radius_factor: float) -> Loss:
    """Return the loss of stage I's geometry: silhouette, and depth, normals and features where the photos have them.

    The spheres' colours are their features (N, F) where a view has a feature map, and are not looked at elsewhere.

    Args:
        body: The body's place in the manifest.
        size_m: The body's size [m], the unit of depth errors.
        radius_factor: Collision radius in units of the scale: depth is that of the surface that collides.
    """

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        cover = cover_of(view)
        mine, free = cover[body], 1 - (cover.sum(0) - cover[body])
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
    """Return the mean over all pixels (H, W) of the chosen depth errors in a unit [m].

    Large errors count by their logarithm: they are outliers, or another surface that shows at a border.
    """
    error = _OUTLYING * ((depth - target).abs() / (unit * _OUTLYING)).log1p()
    return (error * (chosen & (target > 0))).mean()


def normals_of(depth: Tensor, K: Tensor) -> Tensor:
    """Return the unit normals (H, W, 3), camera axes, of a surface at a depth [m] (H, W), towards the camera.

    The depth of spheres is rough from pixel to pixel, so that it is smoothed over windows of 5 x 5 first.
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
    """Return the depth of each sphere's point that is nearest to the camera [m], (N,)."""
    return spheres.means @ view.viewmat[2, :3] + view.viewmat[2, 3] - radius_factor * spheres.scales


def body_loss(body: int, exposures: Exposures) -> Loss:
    """Return the loss of a body's appearance before a random background, which alpha has to hide or to show."""

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        background = torch.rand(3, generator=generator).to(view.image)
        output = render_view(spheres, view)
        cover = cover_of(view)
        mine = cover[body][..., None]
        exposures.follow(view, output.features[0].detach(), cover[body] > 0.95)
        picture = exposures.gain(view) * output.features[0] + (1 - output.alpha[0])[..., None] * background
        others = (cover.sum(0) - cover[body])[..., None]
        # Mixed pixels of the border show both; what the body's share of them looks like is not known.
        target = torch.where(mine > 0.95, view.image, mine * picture.detach() + (1 - mine) * background)
        sure = (1 - others[..., 0]) * ((mine[..., 0] > 0.95) | (mine[..., 0] < 0.05))
        edge = ((output.alpha[0] - mine[..., 0]).abs() * (1 - others[..., 0])).mean()
        wrong = ((picture - target).detach().square().mean(-1) * sure).sum() / sure.sum().clamp_min(1.0)
        return photometric(picture, target, sure) + 0.5 * edge, wrong

    return loss


def behind(bodies: Spheres | None, spheres: Spheres) -> Spheres:
    """Return the bodies, if there are any, and the spheres of the background behind them."""
    return spheres if bodies is None else Spheres.joined([bodies, spheres])


def scene_loss(bodies: Spheres | None, exposures: Exposures, motions: Motions | None = None) -> Loss:
    """Return the loss of the background, with the bodies standing in it as they are; depth counts where it is known.

    Args:
        bodies: Visual spheres of the bodies, world frame, or None. Without them, pixels that masks give to bodies do
            not count.
        exposures: Gains of the photos, learned along.
        motions: Motions of the cameras, where they are to be learned along.
    """

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        view = view if motions is None else motions.moved(view)
        output = render_view(behind(bodies, spheres), view)
        exposures.follow(view, output.features[0].detach(), output.alpha[0].detach() > 0.5)
        picture = exposures.gain(view) * output.features[0]
        value = photometric(picture, view.image, None if bodies is not None else scene_weight(view))
        if motions is not None:
            value = value + motions.prior(view)
        if view.depth is not None:
            seen = output.alpha[0].detach() > 0.5
            value = value + DEPTH_WEIGHT * depth_error(output.depth[0], view.depth, seen, view.depth.clamp_min(1e-6))
        return value, (picture - view.image).detach().square().mean()

    return loss


def scene_weight(view: View) -> Tensor:
    """Return how much each pixel shows of what is no body, (H, W); 1 without a mask."""
    return torch.ones_like(view.image[..., 0]) if view.cover is None else 1 - view.cover.sum(0)


def cover_of(view: View) -> Tensor:
    """Return the share of each pixel that each body covers, (bodies, H, W), of a view that has a mask."""
    if view.cover is None:
        raise ValueError(f"{view.name} has no mask")
    return view.cover
