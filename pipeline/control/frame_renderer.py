"""Renderer of single frames of a model in a given state, which a CUDA graph can capture.

`LabelRenderer` renders whole rollouts with depth and masks to the host; this renders the colours of one state and
keeps them on the device.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...datasets.capture.cameras import Camera
from ...datasets.models.model import Model
from ...schemas import InputDataError, UsageError
from ..physics.state import State
from ..rendering.posed_scene import LabelledModel
from ..rendering.render import render
from ..runtime import kernel_build


class FrameRenderer:
    """Renderer of all spheres of a model for one camera: static background, moving bodies at the poses of a state.

    Args:
        model: A model with visual spheres.
        camera: The camera.
        device: Device of the renderer.

    Raises:
        InputDataError: If no body has visual spheres.
    """

    def __init__(self, model: Model, camera: Camera, device: str) -> None:
        scene = LabelledModel(model, device)
        if not scene.moving and not scene.fixed:
            raise InputDataError(
                f"{model.root}: no body of the model has visual spheres, so there is nothing to see.",
                todo="fit it from photos: cgwm fit CAPTURE --out MODEL.",
            )
        self._moving, self._still = scene.moving, scene.still(camera)
        everything = [*(part.spheres for part in self._moving), self._still]
        self._scales = torch.cat([spheres.scales for spheres in everything])
        self._opacities = torch.cat([spheres.opacities for spheres in everything])
        self._eye = scene.tensor(camera.center)[None]
        tensor = scene.tensor
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
        positions, quats = state.position_m.float(), state.quat_wxyz.float()
        placed = [part.placed(positions[:, part.body], quats[:, part.body]).view(0) for part in self._moving]
        seen = [*(spheres.seen_from(self._eye) for spheres in placed), self._still]
        picture = render(
            torch.cat([spheres.means for spheres in seen]),
            self._scales,
            self._opacities,
            torch.cat([spheres.colors for spheres in seen]),
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
