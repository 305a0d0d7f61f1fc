"""Colours of spheres whose geometry is known: what the photos show where a sphere is seen."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .losses import cover_of
from .spheres import Spheres
from .views import View, render_view


def mean_colors(spheres: Spheres, views: Sequence[View], body: int | None = None) -> Tensor:
    """Return each sphere's mean colour over the pixels that show it, weighted by how much they do, shape (N, F).

    The derivative of sum(render * photo) by the colours is sum over pixels of weight * photo. A sphere that no photo
    shows takes the colour of the nearest ones that are seen.

    Args:
        spheres: The spheres, world frame.
        views: The photos; what stands in `image`, of any number of channels F, is taken as colours.
        body: Count only pixels of this body's mask; all where left out.
    """
    channels = views[0].image.shape[-1]
    features = torch.zeros(len(spheres), channels + 1, device=spheres.means.device, requires_grad=True)
    total = torch.zeros_like(features)
    for view in views:
        colored = Spheres(spheres.means, spheres.scales, spheres.opacities, features)
        image = render_view(colored, view).features[0]
        photo = torch.cat([view.image, torch.ones_like(view.image[..., :1])], -1)
        if body is not None:
            photo = photo * (cover_of(view)[body] > 0.95)[..., None]
        total += torch.autograd.grad((image * photo).sum(), features)[0]
    return spread_colors(spheres.means, total[:, :-1] / total[:, -1:].clamp_min(1e-6), total[:, -1])


def sphere_weights(spheres: Spheres, view: View) -> Tensor:
    """Return each sphere's weight in a photo, summed over its pixels [px], shape (N,)."""
    features = torch.zeros(len(spheres), 1, device=spheres.means.device, requires_grad=True)
    image = render_view(Spheres(spheres.means, spheres.scales, spheres.opacities, features), view).features[0]
    return torch.autograd.grad(image.sum(), features)[0][:, 0]


def spread_colors(means: Tensor, colors: Tensor, seen: Tensor, least: float = 0.5, neighbours: int = 4) -> Tensor:
    """Give spheres that are hardly seen the mean colour of the nearest ones that are.

    Args:
        means: Centres [m], shape (N, 3).
        colors: Colours, shape (N, F).
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
