"""Relighting of a body in poses other than that of the photos.

Spheres have the colours of the photos. In another pose the colour of a sphere is multiplied by L(n) / L(n_photo), with
L(n) = 1 + sky n_z + max(0, lamp . n) the brightness of a white matt surface of normal n (world frame) in a room with
one lamp: four parameters, which a short motion determines (eight spherical harmonics, the general form of soft light,
fitted the frames better and other poses worse). Cast shadows and highlights are not modelled.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...schemas import BodyModel, Light
from ..geometry.rotation import quat_to_matrix

DARKEST = 0.2
"""Minimum of L [1], for the light that a floor reflects."""


def light_terms(normals: Tensor, lamp: Tensor) -> Tensor:
    """Return the factors (..., 4) of a light's parameters (lamp, sky) at unit normals (..., 3), world frame.

    L - 1 is linear in the parameters on each side of the lamp's terminator, which `lamp` (3,) determines.
    """
    return torch.cat((normals * (normals @ lamp > 0).to(normals)[..., None], normals[..., 2:]), -1)


def _numbers(light: Light, like: Tensor) -> Tensor:
    return torch.tensor((*light.lamp, light.sky), dtype=like.dtype, device=like.device)


def _brightness(numbers: Tensor, normals: Tensor) -> Tensor:
    return (1 + light_terms(normals, numbers[:3]) @ numbers).clamp_min(DARKEST)


@dataclass(frozen=True, eq=False)
class Relighting:
    """Factors that turn the colours of a body's photos into those of another pose."""

    numbers: Tensor
    """The light's lamp and sky, shape (4,)."""
    normals: Tensor
    """Unit normals of the body's spheres, body frame, shape (N, 3)."""
    in_photos: Tensor
    """L at the normals in the pose of the photos, shape (N,)."""

    @staticmethod
    def of(light: Light, body: BodyModel, normals: Tensor) -> Relighting:
        """Prepare the relighting of a body, given the normals (N, 3) of its spheres in the body frame."""
        rotation = quat_to_matrix(torch.tensor(body.photo_pose.quat_wxyz).to(normals))
        numbers = _numbers(light, normals)
        return Relighting(numbers, normals, _brightness(numbers, normals @ rotation.T))

    def factors(self, quat_wxyz: Tensor) -> Tensor:
        """Return the factors (N,) of the colours at an orientation (4,)."""
        return self.turned(quat_to_matrix(quat_wxyz))

    def brightness(self, normals: Tensor) -> Tensor:
        """Return the brightness L (...) at unit normals (..., 3), world frame."""
        return _brightness(self.numbers, normals)

    def turned(self, rotation: Tensor) -> Tensor:
        """Return the factors (N,) of the colours at an orientation (3, 3), or (n, N) at n of them (n, 3, 3)."""
        return _brightness(self.numbers, self.normals @ rotation.mT) / self.in_photos
