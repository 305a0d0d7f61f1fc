"""Colours of spheres of known geometry, averaged over the photos."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...geometry.spheres import Spheres
from ..photos.views import SURELY_COVERED, View, render_view
from .losses import cover_of

VISIBLE_PX = 0.5
"""Least weight of a visible sphere in all photos together [px]."""


def mean_colors(spheres: Spheres, views: Sequence[View], body: int | None = None) -> Tensor:
    """Return the mean colour of each sphere over the pixels that show it, weighted by its contribution, shape (N, F).

    A sphere that no photo shows gets the mean colour of the nearest visible ones. Arguments as of `observed_colors`.
    """
    colors, seen = observed_colors(spheres, views, body)
    return spread_colors(spheres.means, colors, seen)


def observed_colors(spheres: Spheres, views: Sequence[View], body: int | None = None) -> tuple[Tensor, Tensor]:
    """Return the mean colour of each sphere over the pixels that show it (N, F), and its weight in them [px] (N,).

    The derivative of sum(render * photo) by the colours is sum over pixels of weight * photo.

    Args:
        spheres: The spheres, world frame.
        views: The photos; the channels of `image`, of any number F, are taken as colours.
        body: Use only the pixels in the mask of this body; None uses all.
    """
    channels = views[0].image.shape[-1]
    features = torch.zeros(len(spheres), channels + 1, device=spheres.means.device, requires_grad=True)
    total = torch.zeros_like(features)
    for view in views:
        colored = Spheres(spheres.means, spheres.scales, spheres.opacities, features)
        image = render_view(colored, view).features[0]
        photo = torch.cat([view.image, torch.ones_like(view.image[..., :1])], -1)
        photo = photo if view.seen is None else photo * view.seen[..., None]
        if body is not None:
            photo = photo * (cover_of(view)[body] > SURELY_COVERED)[..., None]
        total += torch.autograd.grad((image * photo).sum(), features)[0]
    return total[:, :-1] / total[:, -1:].clamp_min(1e-6), total[:, -1]


def sphere_weights(spheres: Spheres, view: View) -> Tensor:
    """Return each sphere's weight in a photo, summed over its pixels [px], shape (N,)."""
    features = torch.zeros(len(spheres), 1, device=spheres.means.device, requires_grad=True)
    image = render_view(Spheres(spheres.means, spheres.scales, spheres.opacities, features), view).features[0]
    return torch.autograd.grad(image.sum(), features)[0][:, 0]


def spread_colors(
    means: Tensor, colors: Tensor, seen: Tensor, least: float = VISIBLE_PX, neighbours: int = 4
) -> Tensor:
    """Return the colours, with those of hardly visible spheres replaced by the mean of the nearest visible ones.

    Args:
        means: Centres [m], shape (N, 3).
        colors: Colours, shape (N, F).
        seen: Total weight over all pixels of all photos [px], shape (N,).
        least: Minimum weight of a visible sphere [px].
        neighbours: Number of visible spheres that are averaged.
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
