"""A body in the light of another pose: photos show each side of it in one light, a motion shows it in others.

Spheres carry the colours of the photos. In another pose a sphere's colour is multiplied by L(n) / L(n_photo), with
L(n) = 1 + sky n_z + max(0, lamp . n) the brightness of a white matt surface of normal n (world frame) in a room with
one lamp: four numbers, which a short motion determines (eight spherical harmonics, the general form of soft light,
fitted the frames better and other poses worse). Shadows that bodies cast and highlights are not in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...schemas import BodyModel, Light
from ..physics.rotation import quat_to_matrix

DARKEST = 0.2
"""L is at least this: the light from below that a floor sends back."""


def light_terms(normals: Tensor, lamp: Tensor) -> Tensor:
    """Return what the numbers of a light (lamp, sky) are multiplied by (..., 4) at unit normals (..., 3), world frame.

    L - 1 is linear in them on each side of the lamp's terminator, whose place `lamp` (3,) tells.
    """
    return torch.cat((normals * (normals @ lamp > 0).to(normals)[..., None], normals[..., 2:]), -1)


def brightness(light: Light, normals: Tensor) -> Tensor:
    """Return L (N,) at unit normals (N, 3), world frame."""
    return _brightness(_numbers(light, normals), normals)


def _numbers(light: Light, like: Tensor) -> Tensor:
    return torch.tensor((*light.lamp, light.sky), dtype=like.dtype, device=like.device)


def _brightness(numbers: Tensor, normals: Tensor) -> Tensor:
    return (1 + light_terms(normals, numbers[:3]) @ numbers).clamp_min(DARKEST)


@dataclass(frozen=True, eq=False)
class Relighting:
    """What turns the colours of a body's photos into those of another pose.

    Attributes:
        numbers: The light's lamp and sky, shape (4,).
        normals: Of the body's spheres, body frame, shape (N, 3).
        in_photos: L at the normals of the photos, shape (N,).
    """

    numbers: Tensor
    normals: Tensor
    in_photos: Tensor

    @staticmethod
    def of(light: Light, body: BodyModel, normals: Tensor) -> Relighting:
        """Prepare a body, given its spheres' normals (N, 3) in the body frame."""
        rotation = quat_to_matrix(torch.tensor(body.photo_pose.quat_wxyz).to(normals))
        numbers = _numbers(light, normals)
        return Relighting(numbers, normals, _brightness(numbers, normals @ rotation.T))

    def factors(self, quat_wxyz: Tensor) -> Tensor:
        """Return the factors (N,) of the colours at an orientation (4,)."""
        return self.turned(quat_to_matrix(quat_wxyz))

    def turned(self, rotation: Tensor) -> Tensor:
        """Return the factors (N,) of the colours at an orientation (3, 3), or (n, N) at n of them (n, 3, 3)."""
        return _brightness(self.numbers, self.normals @ rotation.mT) / self.in_photos
