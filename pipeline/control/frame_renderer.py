"""Renderer of single frames of a model in a given state, which a CUDA graph can capture.

`LabelRenderer` renders whole rollouts with depth and masks to the host; this renders the colours of one state and
keeps them on the device.
"""

from __future__ import annotations

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ...datasets.capture.cameras import Camera
from ...datasets.models.model import Model
from ...schemas import InputDataError, UsageError
from ..geometry.rotation import quat_to_matrix
from ..geometry.spheres import Spheres
from ..physics.world import State
from ..rendering.relighting import Relighting
from ..rendering.render import render
from ..runtime import kernel_build


class FrameRenderer:
    """Renderer of all spheres of a model for one camera: static background, bodies at the poses of a state.

    Args:
        model: A model with visual spheres.
        camera: The camera.
        device: Device of the renderer.

    Raises:
        InputDataError: If no body has visual spheres.
    """

    def __init__(self, model: Model, camera: Camera, device: str) -> None:
        def tensor(values: ArrayLike) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self._bodies: list[tuple[int, Spheres, Relighting | None]] = []
        light = model.file.light
        for index, body in enumerate(model.file.bodies):
            if body.name in model.body_splats:
                splats, relighting = model.body_splats[body.name], None
                if light is not None and splats.normals is not None:
                    relighting = Relighting.of(light, body, tensor(splats.normals))
                self._bodies.append((index, Spheres.from_numpy(splats, device=device), relighting))
        scene = [] if model.scene is None else [Spheres.from_numpy(model.scene, device=device)]
        self._still = [spheres.seen_from(tensor(camera.center)) for spheres in scene]
        if not self._bodies:
            raise InputDataError(
                f"{model.root}: no body of the model has visual spheres, so there is nothing to see.",
                todo="fit it from photos: cgwm fit CAPTURE --out MODEL.",
            )
        everything = [*(spheres for _, spheres, _ in self._bodies), *self._still]
        self._scales = torch.cat([spheres.scales for spheres in everything])
        self._opacities = torch.cat([spheres.opacities for spheres in everything])
        self._viewmats, self._Ks = tensor(camera.T_cam_world)[None], tensor(camera.K)[None]
        self._size = (camera.width, camera.height)
        self._distortion = tensor(camera.distortion) if camera.distortion.any() else None

    def of(self, state: State, capacity: int | None = None) -> tuple[Tensor, Tensor]:
        """Render a state; return the frame, uint8 RGB (H, W, 3), and the number of pairs (), 0 without the kernels.

        Args:
            state: State of all bodies (1, nb, ...), on the device.
            capacity: Maximum number of pairs of tiles and spheres: with it the call does not wait for the device, and
                further pairs are lost.

        Raises:
            UsageError: If the kernels are missing on a CUDA device.
        """
        positions, rotations = state.position_m[0].float(), quat_to_matrix(state.quat_wxyz[0]).float()
        means, colors = [], []
        for index, spheres, relighting in self._bodies:
            means.append(spheres.means @ rotations[index].T + positions[index])
            color = spheres.colors
            if relighting is not None:
                color = (color * relighting.turned(rotations[index])[:, None]).clamp(0, 1)
            colors.append(color)
        means += [spheres.means for spheres in self._still]
        colors += [spheres.colors for spheres in self._still]
        picture = render(
            torch.cat(means),
            self._scales,
            self._opacities,
            torch.cat(colors),
            self._viewmats,
            self._Ks,
            *self._size,
            distortion=self._distortion,
            capacity=capacity,
        )
        if picture.pairs is None and self._scales.is_cuda:
            reason = kernel_build.unavailable()
            raise UsageError(f"the renderer's CUDA kernels cannot run: {reason}.", todo="see 'cgwm doctor'.")
        frame = (picture.features[0].clamp(0, 1) * 255).round().to(torch.uint8)
        return frame, self._scales.new_zeros(()) if picture.pairs is None else picture.pairs
