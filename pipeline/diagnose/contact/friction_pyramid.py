"""A law of friction that engines have and no surface, so that it is no candidate: the friction pyramid.

An engine that limits the tangential impulse along each of two axes by itself admits a square of impulses, the base of a
friction pyramid, instead of a disc: a body that slides between the axes is braked more and turns towards one of them.
A few slides along few directions look so on a ground with a grain, too, whose friction is an ellipse. No surface has
corners in its friction, but data of an engine do.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from ...physics.contact_law import Touch
from ...physics.effects.effect import Effect, Values
from ...physics.impulse_solver import tangent_axes

FLATTEST = 0.02
"""Smallest share of the slip along an axis that is told from none: it keeps the ellipse from degenerating."""


class FrictionPyramid(Effect):
    """Friction -N mu (sign v_x, sign v_y) on the ground, in its axes."""

    name = "friction_pyramid"
    summary = "Friction limited along each of two axes by itself, as in engines with a friction pyramid."
    formula = "force = -N mu (sign v_x, sign v_y), v the slip in the ground's axes; at rest at most N mu along each"
    parameters = ()
    phase = "contact"
    needs = ("ground", "contact")
    reveals = "slides along the axes and between them: those between are braked more, and turn towards an axis"
    source = "the square that a linear complementarity problem admits along two axes (Stewart & Trinkle 1996)"

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the ellipse whose friction is that of the square at the slip that it has.

        Derived: the ellipse with the principal frictions m_x = mu sqrt(s / |v_x|) and m_y = mu sqrt(s / |v_y|), where
        s = |v_x| + |v_y|, has M^2 v / |M v| = mu (sign v_x, sign v_y).
        """
        if not touch.ground:
            return touch
        slip = (tangent_axes(touch.normal)[..., 1:, :] @ touch.slip_m_s[..., None]).squeeze(-1).abs() + 1e-9
        share = (slip / slip.sum(-1, keepdim=True)).clamp_min(FLATTEST)
        principal = share.rsqrt()
        mean, half = principal.mean(-1), 0.5 * (principal[..., 0] - principal[..., 1])
        grain = touch.friction[..., None] * torch.stack((half, torch.zeros_like(half)), -1)
        return replace(touch, friction=touch.friction * mean, anisotropy=grain)
