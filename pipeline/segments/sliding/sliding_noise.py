"""Noise of tracks without flights, from what fits of single rolls and slides on fixed surfaces leave of them.

The fits leave errors of the tracks and, slowly growing with time, of the model; polynomials of windows take the latter.
What coarse triangles of a curved surface do to a body is not noise, but as unknown: it counts as errors that last.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ...geometry.rotation import quat_conjugate, quat_multiply
from ...trajectories.correlated_noise import estimate_noise_model
from ...trajectories.flight_noise import flight_noise
from ...trajectories.innovations import NoiseModel
from ...trajectories.segmentation import Segment
from ...trajectories.track_noise import Noise
from ..segments import Segments


def noise_of_fit(segments: Segments) -> tuple[Noise, NoiseModel]:
    """Return the noise of fitted segments on fixed surfaces and its correlation in time.

    Args:
        segments: With fitted states, and what carries them.
    """
    seen, rollout = segments.observations, segments.rollout()
    assert seen.carried is not None
    places = list(seen.free)
    away = (seen.position_m - rollout.position_m[:, :, places])[:, :, 0]
    turns = quat_multiply(quat_conjugate(rollout.quat_wxyz[:, :, places]), seen.quat_wxyz)
    along, both = _tangents(seen.carried, seen.seen[:, :, 0])
    away = torch.cat(((along * away[:, :, None]).sum(-1), torch.zeros_like(away[..., :1])), -1)
    away[..., 1] *= both[:, None]
    axes = torch.stack((torch.ones_like(both), both, torch.zeros_like(both)), -1)
    left = replace(seen, position_m=away[:, :, None], quat_wxyz=turns, measured_axes=axes[:, None], carried=None)
    items = [Segment(k, 0, length - 1) for k, length in enumerate(segments.lengths)]
    model, correlated = estimate_noise_model(left, items, segments.noise)
    white = flight_noise(left, items)
    return Noise(*(c or w or n for c, w, n in zip(correlated, white, segments.noise, strict=True))), model


def _tangents(carried: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Return two directions along surfaces (B, T, 2, 3), which turn with these, and whether the second is one (B,).

    They are nearest to the axes of the world along which the surfaces carry least.

    Args:
        carried: Directions in which they carry (B, T, 3, 3), as rows.
        seen: 1 for measured frames (B, T).
    """
    across = carried.mT @ carried
    order = (across.diagonal(dim1=-2, dim2=-1) * seen[..., None]).sum(1).argsort(-1)
    axes = torch.eye(3).to(carried)[order[:, :2]][:, None]
    along = axes - axes @ across
    first = torch.nn.functional.normalize(along[:, :, 0], dim=-1)
    second = along[:, :, 1] - (along[:, :, 1] * first).sum(-1, keepdim=True) * first
    number = carried.square().sum((-1, -2))
    both = ((number < 1.5) | (seen == 0)).all(1).to(carried)
    return torch.stack((first, torch.nn.functional.normalize(second, dim=-1)), 2), both
