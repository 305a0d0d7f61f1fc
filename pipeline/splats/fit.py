"""Fitting spheres to photos by gradient descent through the renderer."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from ...datasets.progress import progress
from ...schemas import NotConvergedError
from .render import RenderOutput, render
from .spheres import Spheres
from .views import View

DSSIM_WEIGHT = 0.2
"""Share of D-SSIM in the photometric loss, as in 3D Gaussian splatting (arXiv 2308.04079, equation 7)."""
_SSIM_WINDOW = 7
_MARGIN_PX = 6
_MAX_OPACITY = 0.995


@dataclass(frozen=True)
class Rates:
    """Adam's step sizes; 0 freezes a quantity.

    Attributes:
        means: In units of each sphere's own initial scale.
        log_scales: [1]
        logits: Of the opacities.
        colors: [1]
    """

    means: float = 0.0
    log_scales: float = 0.0
    logits: float = 0.0
    colors: float = 0.0


class Trainable:
    """Spheres in the coordinates that the optimiser moves in.

    Means move in units of the spheres' own scales, scales by their logarithm, opacities by their logit.
    """

    def __init__(self, spheres: Spheres, rates: Rates) -> None:
        self._start = spheres
        self.shift = torch.zeros_like(spheres.means)
        self.log_scale = torch.zeros_like(spheres.scales)
        self.logit = torch.logit(spheres.opacities / _MAX_OPACITY, 1e-4)
        self.colors = spheres.colors.clone()
        groups = [
            (self.shift, rates.means),
            (self.log_scale, rates.log_scales),
            (self.logit, rates.logits),
            (self.colors, rates.colors),
        ]
        for tensor, rate in groups:
            tensor.requires_grad_(rate > 0)
        self.groups = [{"params": [tensor], "lr": rate} for tensor, rate in groups if rate > 0]

    def spheres(self) -> Spheres:
        """Return the spheres as they are now, connected to what is optimised."""
        start = self._start
        return Spheres(
            start.means + self.shift * start.scales[:, None],
            start.scales * self.log_scale.exp(),
            _MAX_OPACITY * torch.sigmoid(self.logit),
            self.colors.clamp(0, 1),
        )

    def drift(self) -> Tensor:
        """Return how far the geometry is from its start: mean square of shifts and logarithms of scales [1]."""
        return self.shift.square().sum(1).mean() + self.log_scale.square().mean()


def render_view(spheres: Spheres, view: View, background: Tensor | None = None) -> RenderOutput:
    """Render spheres (world frame) as a view sees them."""
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


def camera_center(viewmat: Tensor) -> Tensor:
    """Return the centre of a camera, world frame, from T_cam_world (4, 4)."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def descend(
    trainable: Trainable,
    views: Sequence[View],
    loss: Callable[[Spheres, View, torch.Generator], Tensor],
    iterations: int,
    seed: int,
    what: str,
    drift_weight: float = 0.0,
) -> list[float]:
    """Run Adam, one view an iteration, with step sizes that fall to a tenth.

    Args:
        trainable: What moves.
        views: The photos; each round goes through all of them in a new order.
        loss: The loss of one view [1], given a generator for whatever is random in it.
        iterations: Number of steps.
        seed: Seed.
        what: Name of the stage, for the progress bar.
        drift_weight: Weight of `Trainable.drift`.

    Returns:
        The loss by iteration.

    Raises:
        NotConvergedError: If the loss or what moves is no longer finite.
    """
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(trainable.groups, eps=1e-12)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.1 ** (1 / max(iterations, 1)))
    losses: list[float] = []
    order: list[int] = []
    for step in progress(range(iterations), what):
        if not order:
            order = torch.randperm(len(views), generator=generator).tolist()
        value = loss(trainable.spheres(), views[order.pop()], generator)
        if drift_weight > 0:
            value = value + drift_weight * trainable.drift()
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        decay.step()
        losses.append(value.item())
        require_finite(losses[-1], what, f"{step + 1} of {iterations}")
    for group in trainable.groups:
        require_finite(float(group["params"][0].detach().sum()), what, f"{iterations} of {iterations}")
    return losses


def require_finite(value: float, what: str, step: str) -> None:
    """Check a loss, or a sum of what moves, at a step of a fit.

    Raises:
        NotConvergedError: If it is not finite.
    """
    if not math.isfinite(value):
        raise NotConvergedError(
            f"The fit of '{what}' diverged by step {step}: its loss or its spheres are not finite.",
            todo="check that cameras and photos belong together ('cgwm validate CAPTURE'), or try another --seed.",
        )


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


def body_windows(views: Sequence[View], body: int) -> list[View]:
    """Return the views' windows around a body's mask; views that do not show it are left out."""
    windows = []
    for view in views:
        if view.cover is None or not bool((view.cover[body] > 0.5).any()):
            continue
        rows, columns = (view.cover[body] > 0.5).nonzero(as_tuple=True)
        width, height = view.size
        left, top = max(int(columns.min()) - _MARGIN_PX, 0), max(int(rows.min()) - _MARGIN_PX, 0)
        right, bottom = min(int(columns.max()) + _MARGIN_PX, width - 1), min(int(rows.max()) + _MARGIN_PX, height - 1)
        windows.append(view.crop(left, top, right - left + 1, bottom - top + 1))
    return windows


def silhouette_loss(body: int) -> Callable[[Spheres, View, torch.Generator], Tensor]:
    """Return the loss of stage I's geometry: the mean difference of alpha and mask, where no other body is before."""

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> Tensor:
        alpha = render_view(spheres, view).alpha[0]
        cover = _cover(view)
        others = cover.sum(0) - cover[body]
        return ((alpha - cover[body]).abs() * (1 - others)).mean()

    return loss


def body_loss(body: int) -> Callable[[Spheres, View, torch.Generator], Tensor]:
    """Return the loss of a body's appearance before a random background, which alpha has to hide or to show."""

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> Tensor:
        background = torch.rand(3, generator=generator).to(view.image)
        output = render_view(spheres, view, background)
        cover = _cover(view)
        mine = cover[body][..., None]
        others = (cover.sum(0) - cover[body])[..., None]
        # Mixed pixels of the border show both; what the body's share of them looks like is not known.
        target = torch.where(mine > 0.95, view.image, mine * output.features[0].detach() + (1 - mine) * background)
        sure = (1 - others[..., 0]) * ((mine[..., 0] > 0.95) | (mine[..., 0] < 0.05))
        edge = ((output.alpha[0] - mine[..., 0]).abs() * (1 - others[..., 0])).mean()
        return photometric(output.features[0], target, sure) + 0.5 * edge

    return loss


def behind(bodies: Spheres | None, spheres: Spheres) -> Spheres:
    """Return the bodies, if there are any, and the spheres of the background behind them."""
    return spheres if bodies is None else Spheres.joined([bodies, spheres])


def scene_loss(bodies: Spheres | None) -> Callable[[Spheres, View, torch.Generator], Tensor]:
    """Return the loss of the background, with the bodies standing in it as they are."""

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> Tensor:
        return photometric(render_view(behind(bodies, spheres), view).features[0], view.image)

    return loss


def mean_colors(spheres: Spheres, views: Sequence[View], body: int | None = None) -> Tensor:
    """Return each sphere's mean colour over the pixels that show it, weighted by how much they do, shape (N, 3).

    The derivative of sum(render * photo) by the colours is sum over pixels of weight * photo. A sphere that no photo
    shows takes the colour of the nearest ones that are seen.

    Args:
        spheres: The spheres, world frame.
        views: The photos.
        body: Count only pixels of this body's mask; all where left out.
    """
    features = torch.zeros(len(spheres), 4, device=spheres.means.device, requires_grad=True)
    total = torch.zeros_like(features)
    for view in views:
        colored = Spheres(spheres.means, spheres.scales, spheres.opacities, features)
        image = render_view(colored, view).features[0]
        photo = torch.cat([view.image, torch.ones_like(view.image[..., :1])], -1)
        if body is not None:
            photo = photo * (_cover(view)[body] > 0.95)[..., None]
        total += torch.autograd.grad((image * photo).sum(), features)[0]
    return spread_colors(spheres.means, total[:, :3] / total[:, 3:].clamp_min(1e-6), total[:, 3])


def sphere_weights(spheres: Spheres, view: View) -> Tensor:
    """Return each sphere's weight in a photo, summed over its pixels [px], shape (N,)."""
    features = torch.zeros(len(spheres), 1, device=spheres.means.device, requires_grad=True)
    image = render_view(Spheres(spheres.means, spheres.scales, spheres.opacities, features), view).features[0]
    return torch.autograd.grad(image.sum(), features)[0][:, 0]


def spread_colors(means: Tensor, colors: Tensor, seen: Tensor, least: float = 0.5, neighbours: int = 4) -> Tensor:
    """Give spheres that are hardly seen the mean colour of the nearest ones that are.

    Args:
        means: Centres [m], shape (N, 3).
        colors: Colours, shape (N, 3).
        seen: Total weight over all pixels of all photos [px], shape (N,).
        least: Spheres with less weight than this are not seen.
        neighbours: Number of seen spheres that are averaged.
    """
    known = (seen >= least).nonzero()[:, 0]
    unknown = (seen < least).nonzero()[:, 0]
    if known.shape[0] == 0 or unknown.shape[0] == 0:
        return colors.clamp(0, 1)
    result = colors.clone()
    for part in unknown.split(512):
        away = torch.cdist(means[part], means[known])
        nearest = away.topk(min(neighbours, known.shape[0]), largest=False).indices
        result[part] = colors[known[nearest]].mean(1)
    return result.clamp(0, 1)


@torch.no_grad()
def psnr(image: Tensor, target: Tensor, chosen: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio [dB] of values in [0, 1], over chosen pixels (H, W) or all."""
    square = (image - target).square().mean(-1)
    error = square.mean() if chosen is None else square[chosen].mean()
    return float(-10 * torch.log10(error.clamp_min(1e-10)))


def _cover(view: View) -> Tensor:
    if view.cover is None:
        raise ValueError(f"{view.name} has no mask")
    return view.cover
