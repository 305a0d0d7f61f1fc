"""A friction that changes at a line across the ground, which no candidate says: oil, a carpet's edge, a wet spot.

What slides over such a line is braked otherwise late in its way than early, when it is slower: a friction that changes
with the speed of the slip looks so. Slides of several speeds tell the two: at one place they are not equally fast.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ...physics.contact_law import Touch
from ...physics.effects.effect import Effect, EffectParameter, Values
from ...segments.candidates import Candidate, Variant, variants_of
from ...segments.segments import Segments
from ..thresholds import THRESHOLDS

LIMITS = THRESHOLDS.sliding


class FrictionStep(Effect):
    """mu + d / (1 + exp(-(p . n - s) / w)) on the ground."""

    name = "friction_step"
    summary = "Friction that is another one beyond a line."
    formula = "mu(p) = mu + d / (1 + exp(-(p . n - s) / w)), n along the ground"
    parameters = (EffectParameter(name="d", unit="1", scale=0.1, limit=2.0),)
    phase = "contact"
    needs = ("ground", "contact")
    reveals = "slides of several speeds over the line"
    source = "a step, smooth over a width"

    def __init__(self, axis: Tensor, place_m: float, width_m: float) -> None:
        """Make the effect for a line across an axis n (3,) at a place s, with a width w."""
        self.axis, self.place_m, self.width_m = axis, place_m, width_m

    def contact(self, values: Values, touch: Touch) -> Touch:
        """Return the contact with the friction of its side of the line."""
        if not touch.ground:
            return touch
        beyond = (touch.position @ self.axis.to(touch.position) - self.place_m) / self.width_m
        return replace(touch, friction=touch.friction + values["d"][:, None] * torch.sigmoid(beyond))


def lines_across(segments: Segments) -> list[Variant]:
    """Return lines across the main direction of slides, near the one that parts strong braking from weak.

    Args:
        segments: The slides with fitted states.
    """
    places, braking = _braking(segments)
    kept = braking > LIMITS.line_slides * torch.quantile(braking, 0.9) if len(braking) else braking > 0
    places, braking = places[kept], braking[kept]
    if len(places) < 2 * LIMITS.line_pieces:
        return []
    axis = torch.linalg.svd(places - places.mean(0), full_matrices=False).Vh[0]
    along, order = torch.sort(places @ axis)
    level = braking[order]
    count = torch.arange(LIMITS.line_pieces, len(level) - LIMITS.line_pieces + 1)
    before, every = level.cumsum(0)[count - 1], level.sum()
    explained = before.square() / count + (every - before).square() / (len(level) - count)
    last = int(count[explained.argmax()])
    place, span = float(along[last - 1 : last + 1].mean()), float(along[-1] - along[0])
    lines = [FrictionStep(axis, place + share * span, LIMITS.line_width * span) for share in LIMITS.line_places]
    return variants_of([Candidate(one.name, one) for one in lines], segments.world.gravity[0, :1])


def _braking(segments: Segments) -> tuple[Tensor, Tensor]:
    """Return where pieces of slides are (n, 3) [m], and how fast each becomes slower (n) [m/s2]."""
    observed = segments.observations
    where, size = [], []
    for k, length in enumerate(segments.lengths):
        seen = observed.seen[k, :length, 0] > 0
        if int(seen.sum()) < LIMITS.line_pieces:
            continue
        times = observed.times_s[k, :length][seen]
        place = observed.position_m[k, :length, 0][seen]
        since = times - times.mean()
        basis = torch.stack((torch.ones_like(since), since, since.square()), -1)
        fit = torch.linalg.lstsq(basis, place).solution
        speed = fit[1].norm().clamp_min(1e-9)
        where.append(place.mean(0))
        size.append(-2 * (fit[2] @ fit[1]) / speed)
    if not where:
        return observed.position_m.new_zeros(0, 3), observed.position_m.new_zeros(0)
    return torch.stack(where), torch.stack(size)
