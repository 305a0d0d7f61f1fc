"""Anisotropic friction: the ellipse of admissible tangential impulses, and the projection onto it.

A contact with normal impulse N admits every tangential impulse j with |M^-1 j| <= N, where
M = mu I + [[a, b], [b, -a]]. A sliding contact takes the one that dissipates the most power (Moreau's maximum
dissipation; Goyal, Ruina & Papadopoulos, Wear 143, 1991): j = -N M^2 v / |M v|, which also has a sideways component. It
is the fixed point of the projection of j - s v onto the ellipse for any s > 0, since v is normal to the ellipse there
(derived).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

TINY = 1e-24
"""Constant added to squared lengths, so that their roots have a derivative where they vanish."""
FLATTEST = 0.1
"""Minimum ratio of the lower to the higher principal friction."""
LEAST = 1e-6
"""Minimum of the higher principal friction [1], so that M has an inverse."""
NEWTON_STEPS = 5
"""Newton steps of the projection: accurate to 1e-14 for principal frictions that differ by a factor of 3, to 1e-5 for a
factor of 10 (measured, float64).
"""
CLOSE = 1e-7
"""Relative error at which Newton's method ends; each step doubles the number of digits."""


@dataclass(frozen=True)
class Ellipse:
    """Friction matrix M = mean I + [[even, mixed], [mixed, -even]] of contacts."""

    mean: Tensor
    """Mean friction [1], shape (...)."""
    grain: Tensor
    """Components even and mixed [1], shape (..., 2)."""

    @staticmethod
    def of(friction: Tensor, anisotropy: Tensor) -> Ellipse:
        """Return the ellipse with the principal frictions mu + r and mu - r, r = |(a, b)|; see `FLATTEST`.

        Args:
            friction: mu (...) [1], at least 0.
            anisotropy: a and b (..., 2) [1] in the tangent axes.
        """
        radius = (anisotropy.square().sum(-1) + TINY).sqrt()
        high = (friction + radius).clamp_min(LEAST)
        flat = friction - radius < FLATTEST * high
        mean = torch.where(flat, 0.5 * (1 + FLATTEST) * high, friction)
        scale = torch.where(flat, 0.5 * (1 - FLATTEST) * high / radius, torch.ones_like(high))
        return Ellipse(mean, scale[..., None] * anisotropy)

    def nearest(self, wanted: Tensor, limit: Tensor) -> Tensor:
        """Project vectors (..., 2) onto the ellipses |M^-1 j| <= limit (...).

        j = M y, y = M (M^2 + t I)^-1 wanted, with the least t >= 0 for which |y| <= limit: Newton steps of 1/|y|, which
        is concave in t, from below (More & Sorensen 1983). The remaining excess of |y| over the limit is scaled away.
        """
        mean, even, mixed = self.mean[..., None], *self.grain.unsqueeze(-2).unbind(-1)
        square = self.grain.square().sum(-1, keepdim=True)

        def turned(w: Tensor) -> Tensor:
            x, y = w[..., :1], w[..., 1:]
            return torch.cat((even * x + mixed * y, mixed * x - even * y), -1)

        def length2(w: Tensor) -> Tensor:
            return w.square().sum(-1, keepdim=True) + TINY

        half_trace, root_det, twice = mean.square() + square, mean.square() - square, 2 * mean
        one, two = mean * wanted + turned(wanted), mean * turned(wanted) + square * wanted
        most = limit[..., None]
        high2 = (mean + (square + TINY).sqrt()).square()
        size = length2(one).sqrt()
        t = (size / torch.maximum(most, 1e-9 * size) - high2).clamp_min(0.0)
        for _ in range(NEWTON_STEPS):
            inverse, first = 1 / (t.square() + 2 * half_trace * t + root_det.square()), half_trace + t
            y = inverse * (first * one - twice * two)
            size2 = length2(y)
            size = size2.sqrt()
            bent = inverse * (first * size2 - twice * (y * turned(y)).sum(-1, keepdim=True))
            beyond = size / torch.maximum(most, 1e-9 * size) - 1
            t_before, t = t, (t + size2 / bent * beyond).clamp_min(0.0)
            # vectors inside stay, and the step after a small one changes only rounding
            if bool(((beyond.abs() < CLOSE) | ((t_before == 0) & (t == 0))).all()):
                break
        inverse, first = 1 / (t.square() + 2 * half_trace * t + root_det.square()), half_trace + t
        y = inverse * (first * one - twice * two)
        scale = (most / length2(y).sqrt()).clamp_max(1.0)
        return scale * (mean * y + turned(y))

    def along(self, direction: Tensor) -> Tensor:
        """Return the friction (...) [1] along directions (..., 2) of any length; 0 for a zero vector."""
        (x, y), (even, mixed) = direction.unbind(-1), self.grain.unbind(-1)
        det = self.mean.square() - self.grain.square().sum(-1)
        inverse = torch.stack((self.mean * x - even * x - mixed * y, self.mean * y - mixed * x + even * y), -1)
        return direction.norm(dim=-1) * det / (inverse.square().sum(-1) + TINY).sqrt()
