"""Spherical Gaussians as torch tensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...datasets.ply import Splats
from .harmonics import seen_colors


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spherical Gaussians; the same fields as :class:`cgwm.datasets.ply.Splats`, as tensors.

    Attributes:
        means: Centres [m], shape (N, 3).
        scales: Standard deviations s [m], shape (N,).
        opacities: Peak alphas in [0, 1], shape (N,).
        colors: sRGB values in [0, 1], shape (N, 3); with harmonics their mean over all directions.
        harmonics: Of degree 1 and higher, shape (N, K, 3), of spheres that never turn; None: the same from all sides.
    """

    means: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    harmonics: Tensor | None = None

    def __len__(self) -> int:
        return self.means.shape[0]

    @staticmethod
    def from_numpy(splats: Splats, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Spheres:
        """Return the spheres as tensors."""
        arrays = (splats.means, splats.scales, splats.opacities, splats.colors)
        tensors = [torch.as_tensor(np.ascontiguousarray(array), dtype=dtype, device=device) for array in arrays]
        if splats.harmonics is not None:
            tensors.append(torch.as_tensor(np.ascontiguousarray(splats.harmonics), dtype=dtype, device=device))
        return Spheres(*tensors)

    def to_numpy(self) -> Splats:
        """Return the spheres as arrays on the CPU."""
        tensors = (self.means, self.scales, self.opacities, self.colors)
        higher = None if self.harmonics is None else self.harmonics.detach().cpu().numpy()
        return Splats(*(tensor.detach().cpu().numpy() for tensor in tensors), harmonics=higher)

    def seen_from(self, eye: Tensor) -> Spheres:
        """Return the spheres with the colours that they show to a camera at `eye` (3,), world frame."""
        if self.harmonics is None:
            return self
        colors = seen_colors(self.colors, self.harmonics, self.means.detach(), eye.to(self.means))
        return Spheres(self.means, self.scales, self.opacities, colors)

    def moved(self, T_to_from: Tensor) -> Spheres:
        """Return the spheres in another frame: a rigid transform, shape (4, 4), turns them exactly."""
        if self.harmonics is not None:
            raise ValueError("colours that depend on the direction cannot be turned")
        means = self.means @ T_to_from[:3, :3].T + T_to_from[:3, 3]
        return Spheres(means, self.scales, self.opacities, self.colors)

    @staticmethod
    def joined(parts: list[Spheres]) -> Spheres:
        """Return all spheres of several sets, in their order."""
        return Spheres(
            torch.cat([part.means for part in parts]),
            torch.cat([part.scales for part in parts]),
            torch.cat([part.opacities for part in parts]),
            torch.cat([part.colors for part in parts]),
            _joined_harmonics(parts),
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
