"""Spherical Gaussians as torch tensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...datasets.ply import Splats


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spherical Gaussians; the same fields as :class:`cgwm.datasets.ply.Splats`, as tensors.

    Attributes:
        means: Centres [m], shape (N, 3).
        scales: Standard deviations s [m], shape (N,).
        opacities: Peak alphas in [0, 1], shape (N,).
        colors: sRGB values in [0, 1], shape (N, 3).
    """

    means: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    @staticmethod
    def from_numpy(splats: Splats, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Spheres:
        """Return the spheres as tensors."""
        arrays = (splats.means, splats.scales, splats.opacities, splats.colors)
        return Spheres(*(torch.as_tensor(np.ascontiguousarray(array), dtype=dtype, device=device) for array in arrays))

    def to_numpy(self) -> Splats:
        """Return the spheres as arrays on the CPU."""
        tensors = (self.means, self.scales, self.opacities, self.colors)
        return Splats(*(tensor.detach().cpu().numpy() for tensor in tensors))

    def moved(self, T_to_from: Tensor) -> Spheres:
        """Return the spheres in another frame: a rigid transform, shape (4, 4), turns them exactly."""
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
        )
