"""Shadows of moving bodies on the ground: the colours of the ground's spheres under a lamp far away.

What a lamp does not see lies in the shadow: a body is rendered as the lamp sees it, and its opacity at a place of the
ground is the share of the lamp's light that it takes from there. Bodies do not shade each other, nor fixed bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...schemas import Ground, GroundShadow, ModelFile
from ..geometry.ground_spheres import NODE_WEIGHTS, NODES, dimmed, on_plane
from .posed_scene import Labelled
from .render import render

_PIXELS = 96
"""Side of a body's picture as the lamp sees it [px]."""
_FAR = 1000.0
"""Distance of the lamp, in radii of the body: its rays are parallel to 0.1 %."""
_MARGIN = 3.0
"""Standard deviations of a sphere that belong to the radius of its body."""
_LARGEST_M = 0.1
"""Largest scale of a sphere of the ground [m]; larger ones are backdrop."""
_FRAMES = 32
"""Frames at once, for the memory."""


def shadow_of(file: ModelFile) -> GroundShadow | None:
    """Return the shadow that bodies cast on the ground: as found in the photos, else from the light of the videos.

    A white ground of normal n has brightness 1 + sky n_z + lamp . n outside of the shadow, without the last term in it.
    None without a ground, or where neither photos nor videos tell the lamp, or it is below the ground.
    """
    if file.ground is None:
        return None
    up = np.asarray(file.ground.normal)
    found = file.ground_shadow
    if found is None and file.light is not None and np.linalg.norm(file.light.lamp) > 0:
        lamp = np.asarray(file.light.lamp)
        around = 1 + file.light.sky * up[2]
        left = float(np.clip(around / max(around + lamp @ up, 1e-9), 0, 1))
        x, y, z = map(float, lamp / np.linalg.norm(lamp))
        found = GroundShadow(to_lamp=(x, y, z), brightness_rgb=(left, left, left))
    return None if found is None or np.asarray(found.to_lamp) @ up <= 0 else found


class ShadedGround:
    """The spheres of the ground, which moving bodies shade.

    Args:
        shadow: The lamp, and the brightness in the shadow.
        ground: The ground.
        still: Spheres that do not move; those of the background on the ground are shaded.
    """

    def __init__(self, shadow: GroundShadow, ground: Ground, still: Labelled) -> None:
        normal = still.means.new_tensor(ground.normal)
        of_ground = on_plane(still.means, normal, ground.offset_m, still.scales, _LARGEST_M)
        self.rows = (of_ground & (still.labels == 0)).nonzero()[:, 0]
        """Which of the still spheres are shaded, shape (R,)."""
        self._to_lamp = still.means.new_tensor(shadow.to_lamp)
        self._factors = still.means.new_tensor(shadow.brightness_rgb)
        self._axes = _across(self._to_lamp)
        steps, weights = still.means.new_tensor(NODES), still.means.new_tensor(NODE_WEIGHTS)
        along = _across(normal)[:2]
        offsets = torch.cartesian_prod(steps, steps) @ along
        self._weights = torch.outer(weights, weights).flatten()
        self._nodes = still.means[self.rows, None] + still.scales[self.rows, None, None] * offsets

    @torch.no_grad()
    def dimming(self, placed: Sequence[tuple[int, Labelled]]) -> Tensor:
        """Return the factors (n, R, 3) of the colours of the rows, given moving spheres by body in n frames."""
        count = max((len(spheres.means) for _, spheres in placed), default=1)
        lit = self._nodes.new_ones(count, len(self.rows), len(self._weights))
        for _, spheres in placed:
            for first in range(0, count, _FRAMES):
                part = replace(spheres, means=spheres.means[first : first + _FRAMES])
                lit[first : first + _FRAMES] *= 1 - self._cover(part)
        return dimmed(1 - lit @ self._weights, self._factors)

    def shaded(self, still: Labelled, dimming: Tensor) -> Labelled:
        """Return the still spheres with the colours of the ground times factors (..., R, 3)."""
        colors = still.colors.clone()
        colors[..., self.rows, :] *= dimming
        return replace(still, colors=colors)

    @staticmethod
    def visible(dimming: Tensor) -> Tensor:
        """Return which factors (R, 3) change a colour, shape (R,)."""
        return (dimming < 1).any(-1)

    def _cover(self, body: Labelled) -> Tensor:
        """Return the share (n, R, 9) of the light that a body takes from each node in n frames."""
        centers = body.means.mean(1)
        radii = ((body.means - centers[:, None]).norm(dim=-1) + _MARGIN * body.scales).amax(1)
        viewmats = torch.eye(4).to(centers).repeat(len(centers), 1, 1)
        viewmats[:, :3, :3] = self._axes
        viewmats[:, :3, 3] = -centers @ self._axes.T
        viewmats[:, 2, 3] += _FAR * radii
        K = centers.new_tensor([[_FAR, 0, 1], [0, _FAR, 1], [0, 0, 2 / _PIXELS]]) * (_PIXELS / 2)
        seen = render(
            body.means, body.scales, body.opacities, body.opacities[:, None], viewmats,
            K.expand(len(centers), 3, 3), _PIXELS, _PIXELS,
        ).alpha  # fmt: skip
        local = torch.einsum("nij,rkj->nrki", viewmats[:, :3, :3], self._nodes) + viewmats[:, None, None, :3, 3]
        places = _FAR * local[..., :2] / local[..., 2:]  # -1 to 1 over the picture
        sampled = torch.nn.functional.grid_sample(seen[:, None], places, align_corners=False)
        return sampled[:, 0]


def _across(direction: Tensor) -> Tensor:
    """Return axes (3, 3) in rows, right-handed, whose third points against a unit vector (3,)."""
    helper = torch.eye(3).to(direction)[direction.abs().argmin()]
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, -direction), dim=0)
    return torch.stack([first, torch.linalg.cross(-direction, first), -direction])
