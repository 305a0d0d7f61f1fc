"""Spherical Gaussians as torch tensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...datasets.shapes.ply import Splats
from .spherical_harmonics import rotated, seen_colors


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spherical Gaussians as tensors, with the fields of :class:`cgwm.datasets.shapes.ply.Splats`."""

    means: Tensor
    """Centres [m], shape (N, 3)."""
    scales: Tensor
    """Standard deviations s [m], shape (N,)."""
    opacities: Tensor
    """Peak alphas in [0, 1], shape (N,)."""
    colors: Tensor
    """sRGB values in [0, 1], shape (N, 3); with harmonics the mean over all directions."""
    harmonics: Tensor | None = None
    """Spherical harmonics from degree 1 on, shape (N, K, 3), in the frame of the centres; None for equal colours from
    all sides.
    """

    def __len__(self) -> int:
        return self.means.shape[0]

    @staticmethod
    def from_numpy(splats: Splats, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Spheres:
        """Convert spheres from arrays to tensors."""
        arrays = (splats.means, splats.scales, splats.opacities, splats.colors)
        tensors = [torch.as_tensor(np.ascontiguousarray(array), dtype=dtype, device=device) for array in arrays]
        if splats.harmonics is not None:
            tensors.append(torch.as_tensor(np.ascontiguousarray(splats.harmonics), dtype=dtype, device=device))
        return Spheres(*tensors)

    def to_numpy(self) -> Splats:
        """Convert the spheres to arrays on the CPU."""
        tensors = (self.means, self.scales, self.opacities, self.colors)
        higher = None if self.harmonics is None else self.harmonics.detach().cpu().numpy()
        return Splats(*(tensor.detach().cpu().numpy() for tensor in tensors), harmonics=higher)

    def seen_from(self, eye: Tensor) -> Spheres:
        """Return the spheres with their colours as seen by a camera at `eye` (3,) [m], world frame."""
        if self.harmonics is None:
            return self
        colors = seen_colors(self.colors, self.harmonics, self.means.detach(), eye.to(self.means))
        return Spheres(self.means, self.scales, self.opacities, colors)

    def moved(self, T_to_from: Tensor) -> Spheres:
        """Return the spheres in another frame, given the rigid transform to it, shape (4, 4)."""
        means = self.means @ T_to_from[:3, :3].T + T_to_from[:3, 3]
        higher = None if self.harmonics is None else rotated(self.harmonics, T_to_from[:3, :3])
        return Spheres(means, self.scales, self.opacities, self.colors, higher)

    @staticmethod
    def joined(parts: list[Spheres]) -> Spheres:
        """Concatenate the spheres of several sets, in order."""
        return Spheres(
            means=torch.cat([part.means for part in parts]),
            scales=torch.cat([part.scales for part in parts]),
            opacities=torch.cat([part.opacities for part in parts]),
            colors=torch.cat([part.colors for part in parts]),
            harmonics=_joined_harmonics(parts),
        )


def _joined_harmonics(parts: list[Spheres]) -> Tensor | None:
    terms = max((part.harmonics.shape[1] for part in parts if part.harmonics is not None), default=0)
    if terms == 0:
        return None
    filled = []
    for part in parts:
        higher = part.harmonics if part.harmonics is not None else part.colors.new_zeros(len(part), 0, 3)
        filled.append(torch.nn.functional.pad(higher, (0, 0, 0, terms - higher.shape[1])))
    return torch.cat(filled)
