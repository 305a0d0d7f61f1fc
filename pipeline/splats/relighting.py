"""A body in the light of another pose: photos show each side of it in one light, a motion shows it in others.

Spheres carry the colours of the photos. In another pose a sphere's colour is multiplied by L(n) / L(n_photo), with
L(n) = 1 + coefficients . Y(n) the brightness of a white surface of normal n (world frame) in a light that is the same
everywhere: spherical harmonics of degree 1 and 2, which hold 98 % of a distant light on a matt surface (Ramamoorthi &
Hanrahan 2001). Shadows that bodies cast and highlights are not in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...schemas import BodyModel, Light
from ..physics.rotation import quat_to_matrix

DARKEST, BRIGHTEST = 0.2, 3.0
"""L is kept within these: a fit to few orientations says little about the others."""


def light_basis(normals: Tensor) -> Tensor:
    """Return the real spherical harmonics of degree 1 and 2 (N, 8) at unit normals (N, 3), each of largest value 1."""
    x, y, z = normals.unbind(-1)
    return torch.stack((x, y, z, 2 * x * y, 2 * y * z, 2 * x * z, (3 * z * z - 1) / 2, x * x - y * y), -1)


def brightness(light: Light, normals: Tensor) -> Tensor:
    """Return L (N,) at unit normals (N, 3), world frame."""
    coefficients = torch.tensor(light.coefficients, dtype=normals.dtype, device=normals.device)
    return (1 + light_basis(normals) @ coefficients).clamp(DARKEST, BRIGHTEST)


@dataclass(frozen=True, eq=False)
class Relighting:
    """What turns the colours of a body's photos into those of another pose.

    Attributes:
        light: The light.
        normals: Of the body's spheres, body frame, shape (N, 3).
        in_photos: L at the normals of the photos, shape (N,).
    """

    light: Light
    normals: Tensor
    in_photos: Tensor

    @staticmethod
    def of(light: Light, body: BodyModel, normals: Tensor) -> Relighting:
        """Prepare a body, given its spheres' normals (N, 3) in the body frame."""
        rotation = quat_to_matrix(torch.tensor(body.photo_pose.quat_wxyz).to(normals))
        return Relighting(light, normals, brightness(light, normals @ rotation.T))

    def factors(self, quat_wxyz: Tensor) -> Tensor:
        """Return the factors (N,) of the colours at an orientation (4,)."""
        return self.turned(quat_to_matrix(quat_wxyz))

    def turned(self, rotation: Tensor) -> Tensor:
        """Return the factors (N,) of the colours at an orientation (3, 3)."""
        return brightness(self.light, self.normals @ rotation.T) / self.in_photos
