"""Colours of bodies that depend on the direction of view, where held-out photos show that they do.

A body's spheres have the colours that they show on average. What photos show beyond that, such as highlights, is
described by spherical harmonics of degree 1 to 3 in the body's frame, which turn with it: right where the gloss belongs
to the surface (velvet, foil, print); that of a lamp it repeats for the poses of the photos only. The mean colours stay
as they are, so that whatever ignores the harmonics sees what it saw before. A body that turns is seen from directions
from which no photo shows it: there its colours are the mean ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...geometry.directions import fibonacci_directions
from ...geometry.spheres import Spheres
from ...geometry.spherical_harmonics import harmonics, term_count
from ..photos.views import SURELY_COVERED, View, camera_center, render_view
from .colors import VISIBLE_PX
from .losses import cover_of

LEAST_GAIN_DB = 0.1
"""Least gain of PSNR inside the masks of photos that took no part, for which colours depend on the direction."""
LEAST_VIEWS = 12
"""Fewest photos from which it is told."""
_HELD_BACK = 4
"""Every so many photos one takes no part."""
_RIDGES_PX = (2.0, 10.0, 50.0)
"""Weights of the prior that there is no gloss, in pixels that show a sphere."""
_DIRECTIONS = 96
"""Directions, evenly spread, in which there is no gloss where no photo shows a sphere from there."""
_SEEN_WITHIN = 0.9
"""Cosine of the angle to a photo's direction within which a direction counts as seen (26 degrees)."""
_SWEEPS = 3
"""Sweeps of the final fit: spheres overlap, so that each explains a part of what is left."""


def fit_gloss(
    spheres: Spheres, views: Sequence[View], body: int, seed: int
) -> tuple[Spheres, dict[str, float | int | None]]:
    """Add harmonics to the colours of a body if photos that took no part in their fit are repeated better with them.

    Args:
        spheres: Visual spheres of the body, world frame.
        views: Photos of it, or windows of them.
        body: Its index in the masks.
        seed: Seed of the choice of those that take no part.

    Returns:
        The spheres, and the degree (0: none) with the gain on those photos [dB].
    """
    order = np.random.default_rng(seed).permutation(len(views))
    held, used = [views[k] for k in order[::_HELD_BACK]], [views[k] for k in order if k not in order[::_HELD_BACK]]
    if len(views) < LEAST_VIEWS:
        return spheres, {"degree": 0, "gain_db": None}
    observed = _Observed.of(spheres, used, body)
    before = _psnr_db(spheres, held, body)
    best = (LEAST_GAIN_DB, 0, 0.0)
    for degree in (1, 2, 3):
        for ridge in _RIDGES_PX:
            candidate = replace(spheres, harmonics=observed.solved(degree, ridge))
            gain = _psnr_db(candidate, held, body) - before
            best = max(best, (gain, degree, ridge))
    gain, degree, ridge = best
    if not degree:
        return spheres, {"degree": 0, "gain_db": None}
    higher = spheres.colors.new_zeros(len(spheres), term_count(degree) - 1, 3)
    for _ in range(_SWEEPS):
        higher = higher + _Observed.of(replace(spheres, harmonics=higher), views, body).solved(degree, ridge)
    return replace(spheres, harmonics=higher), {"degree": degree, "gain_db": round(gain, 3)}


class _Observed:
    """What photos show beyond the colours of spheres: by photo and sphere."""

    def __init__(self, directions: Tensor, residuals: Tensor, weights: Tensor) -> None:
        self.directions, self.residuals, self.weights = directions, residuals, weights

    @staticmethod
    def of(spheres: Spheres, views: Sequence[View], body: int) -> _Observed:
        """Measure the mean residual (view, N, 3) of each sphere, its weight [px] (view, N), and its direction."""
        directions, residuals, weights = [], [], []
        for view in views:
            eye = camera_center(view.viewmat)
            seen = spheres.seen_from(eye)
            features = torch.cat([seen.colors, torch.ones_like(seen.colors[:, :1])], 1).detach().requires_grad_()
            picture = render_view(Spheres(seen.means, seen.scales, seen.opacities, features), view).features[0]
            inside = view.weighted((cover_of(view)[body] > SURELY_COVERED).to(picture))[..., None]
            left = (view.image - picture[..., :3]).detach() * inside
            (found,) = torch.autograd.grad((picture * torch.cat([left, inside], -1)).sum(), features)
            residuals.append(found[:, :3] / found[:, 3:].clamp_min(1e-6))
            weights.append(found[:, 3])
            directions.append(normalize(spheres.means.detach() - eye.to(spheres.means), dim=-1))
        return _Observed(torch.stack(directions), torch.stack(residuals), torch.stack(weights))

    def solved(self, degree: int, ridge_px: float) -> Tensor:
        """Return the harmonics from degree 1 on (N, K, 3) that explain the residuals best, with a prior of zero."""
        views, count = self.weights.shape
        basis = harmonics(self.directions.reshape(-1, 3), degree)[:, 1:].reshape(views, count, -1)
        weighted = basis * self.weights[..., None]
        normal = torch.einsum("vnk,vnl->nkl", weighted, basis)
        right = torch.einsum("vnk,vnc->nkc", weighted, self.residuals)
        prior = ridge_px * torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
        return torch.linalg.solve(normal + prior + self._unseen(degree), right)

    def _unseen(self, degree: int) -> Tensor:
        """Return the normal matrix (N, K, K) of no gloss in directions from which no photo shows a sphere.

        All of these directions together weigh as much as the photos, where no direction was seen.
        """
        ways = torch.tensor(fibonacci_directions(_DIRECTIONS)).to(self.directions)
        near = self.directions.new_full((self.weights.shape[1], _DIRECTIONS), -1.0)
        for direction, weight in zip(self.directions, self.weights, strict=True):
            cosine = torch.where(weight[:, None] > VISIBLE_PX, direction @ ways.T, -1.0)
            near = torch.maximum(near, cosine)
        weight = (near < _SEEN_WITHIN).to(ways) * self.weights.sum(0)[:, None] / _DIRECTIONS
        basis = harmonics(ways, degree)[:, 1:]
        return torch.einsum("nd,dk,dl->nkl", weight, basis, basis)


@torch.no_grad()
def _psnr_db(spheres: Spheres, views: Sequence[View], body: int) -> float:
    """Return the PSNR inside the masks of a body, over all pixels of some photos."""
    total, count = 0.0, 0
    for view in views:
        inside = cover_of(view)[body] > SURELY_COVERED
        inside = inside if view.seen is None else inside & view.seen
        away = (render_view(spheres, view).features[0][..., :3].clamp(0, 1) - view.image)[inside]
        total, count = total + float(away.square().sum()), count + away.numel()
    return -10 * float(np.log10(max(total, 1e-12) / max(count, 1)))
