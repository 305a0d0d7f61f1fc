"""Renderer of labelled images of a moving model: colour, depth, instance masks and amodal masks.

Colour, depth and masks come from one pass of the renderer. The depth of a pixel is the expected depth of the surface
that its mask names, so that no depth lies between an object and the background. Amodal masks are rendered from the
spheres of each body alone.

On a CUDA device many frames of all cameras are rendered at once, in full. On the CPU the background and fixed bodies
are rendered once per camera, and in each frame only the tiles that moving bodies can reach are rendered again, with all
spheres in them: outside, moving bodies contribute nothing, so the result equals that of rendering the full image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import groupby, pairwise

import numpy as np
import torch
from torch import Tensor

from ...datasets.capture.cameras import Camera
from ...datasets.io.processors import processors
from ...datasets.models.model import Model
from ...datasets.rollouts.chunks import CHUNK_FRAMES
from ...datasets.rollouts.rollouts import FrameBlock, amodal_dtype
from ...schemas import Exposure, GroundShadow, Light
from .ground_shadow import ShadedGround
from .posed_scene import Labelled, LabelledModel
from .render import RenderOutput, render
from .screen_bounds import TILE, Box, inside, reach, spans

SOLID_ALPHA = 0.5
"""Threshold on alpha above which a pixel shows a surface, and has a depth and a label."""
NUMBERS_AT_ONCE = 100_000_000
"""Maximum size of the largest arrays of one call on a GPU: features of spheres, and of pixels."""
_SIGNED = {1: torch.uint8, 2: torch.int16, 4: torch.int32, 8: torch.int64}
"""Torch integer types with the bits of the amodal masks' types, by size in bytes."""


@dataclass(frozen=True)
class _Pictures:
    """Labels of n views, as in `FrameBlock`."""

    image: Tensor
    """Colours, uint8 RGB, shape (n, H, W, 3)."""
    depth: Tensor
    """Depth [m], 0 without a surface, shape (n, H, W)."""
    mask: Tensor
    """Label of the visible body, uint8, shape (n, H, W)."""
    amodal: Tensor
    """Bits of the bodies that each pixel would show alone, in a torch type of the same size, shape (n, H, W)."""
    visible_px: Tensor
    """Visible pixels of each body, shape (n, B)."""
    amodal_px: Tensor
    """Amodal pixels of each body, shape (n, B)."""


@dataclass(frozen=True)
class _Plate:
    """What a camera sees of all that never moves; made once per camera on the CPU."""

    labels: _Pictures
    """Labels of one view."""
    reaches: Tensor
    """`spans` of the spheres that never move [px], shape (N, 4)."""


@dataclass(frozen=True, kw_only=True)
class _View:
    """A camera with its view of the background and the fixed bodies."""

    camera: Camera
    """The camera."""
    viewmat: Tensor
    """T_cam_world, shape (4, 4)."""
    K: Tensor
    """Camera matrix [px], shape (3, 3)."""
    still: Labelled
    """Background and fixed bodies, in the colours that the camera sees."""
    alone: Tensor
    """Whether each fixed body would be visible alone, shape (H, W, B)."""
    plate: _Plate | None
    """Rendering of what never moves; on the CPU only."""


class LabelRenderer:
    """Renderer of the labels of a model for a set of cameras without distortion.

    Args:
        model: A model with visual spheres.
        cameras: The cameras by name.
        device: Device on which to render.
        shadow: Shadow that moving bodies cast on the ground; None for none.
    """

    def __init__(
        self,
        model: Model,
        cameras: Mapping[str, Camera],
        device: str = "cpu",
        shadow: GroundShadow | None = None,
    ):
        self._scene = LabelledModel(model, device)
        self._together = torch.device(device).type == "cuda"
        self._amodal_dtype = amodal_dtype(self._scene.bodies)
        self._threads = ThreadPoolExecutor(processors(), "cgwm-render")
        self._ground, self._shadow = model.file.ground, shadow
        self._shaded: ShadedGround | None = None
        self.set_cameras(cameras)

    def set_cameras(self, cameras: Mapping[str, Camera]) -> None:
        """Replace the cameras."""
        self._views = {name: self._view(camera) for name, camera in cameras.items()}

    def set_light(self, light: Light | None) -> None:
        """Set the light that shades moving bodies; None keeps the colours of the photos."""
        self._scene.set_light(light)

    def set_shadow(self, shadow: GroundShadow | None) -> None:
        """Set the shadow that moving bodies cast on the ground; None for none."""
        if shadow != self._shadow:
            self._shadow, self._shaded = shadow, None

    @torch.no_grad()
    def blocks(
        self,
        position_m: np.ndarray,
        quat_wxyz: np.ndarray,
        wait: bool = True,
        exposures: Mapping[str, Exposure] | None = None,
    ) -> Iterator[FrameBlock]:
        """Render a rollout, and yield it in chunks of frames of one camera each.

        Args:
            position_m: Body frame origins [m], world, shape (T, B, 3).
            quat_wxyz: T_world_body, shape (T, B, 4).
            wait: Whether to wait for the device; otherwise the reader of a block calls its `ready` first.
            exposures: Exposures of some cameras; the others show the model's colours.
        """
        if self._shaded is None and self._shadow is not None and self._ground is not None and self._views:
            # any camera serves: spheres that never move lie where they lie
            self._shaded = ShadedGround(self._shadow, self._ground, next(iter(self._views.values())).still)
        at_once = self._frames_at_once() if self._together else CHUNK_FRAMES
        for first in range(0, len(position_m), at_once):
            placed = self._scene.placed(position_m[first : first + at_once], quat_wxyz[first : first + at_once])
            count = len(position_m[first : first + at_once])
            pictures = self._all_at_once(placed, count) if self._together else self._one_by_one(placed, count)
            for name, exposure in (exposures or {}).items():
                pictures[name] = replace(pictures[name], image=_exposed(pictures[name].image, exposure))
            ready = None
            if self._together:
                pictures, ready = _to_host(pictures)
                if wait:
                    ready()
            # cut by numpy: each call of torch would release the interpreter lock, and wait to get it back
            whole = {name: self._arrays(picture) for name, picture in pictures.items()}
            for start in range(0, count, CHUNK_FRAMES):
                for name, arrays in whole.items():
                    rows = {key: values[start : start + CHUNK_FRAMES] for key, values in arrays.items()}
                    yield FrameBlock(name, first + start, **rows, ready=ready)

    def _arrays(self, picture: _Pictures) -> dict[str, np.ndarray]:
        arrays = {field.name: getattr(picture, field.name).numpy() for field in fields(_Pictures)}
        return {**arrays, "amodal": arrays["amodal"].view(self._amodal_dtype)}

    def _frames_at_once(self) -> int:
        spheres = max(len(view.still) for view in self._views.values()) + self._scene.moving_count
        pixels = max(view.camera.width * view.camera.height for view in self._views.values())
        numbers = max(spheres, pixels) * (5 + 2 * self._scene.bodies) * len(self._views)
        return max(1, NUMBERS_AT_ONCE // (numbers * CHUNK_FRAMES)) * CHUNK_FRAMES

    @torch.no_grad()
    def _view(self, camera: Camera) -> _View:
        viewmat, K = self._scene.tensor(camera.T_cam_world), self._scene.tensor(camera.K)
        still, whole = self._scene.still(camera), Box(0, 0, camera.width, camera.height)
        alone = torch.zeros(1, camera.height, camera.width, self._scene.bodies, dtype=torch.bool, device=K.device)
        for body, spheres in self._scene.fixed:
            picture = _rendered(spheres, spheres.opacities[:, None], viewmat[None], K[None], whole)
            alone[..., body] = picture.alpha > SOLID_ALPHA
        if self._together:
            return _View(camera=camera, viewmat=viewmat, K=K, still=still, alone=alone[0], plate=None)
        labels = self._labels([], still, viewmat[None], K[None], whole, alone)
        return _View(
            camera=camera,
            viewmat=viewmat,
            K=K,
            still=still,
            alone=alone[0],
            plate=_Plate(labels, spans(still, viewmat, K)),
        )

    def _all_at_once(self, placed: Sequence[tuple[int, Labelled]], count: int) -> dict[str, _Pictures]:
        """Return the labels of `count` frames for each camera; cameras of equal size are rendered in one call."""
        found: dict[str, _Pictures] = {}
        dimming = torch.ones(0) if self._shaded is None else self._shaded.dimming(placed)
        order = sorted(self._views, key=lambda name: _size(self._views[name].camera))
        for size, group in groupby(order, key=lambda name: _size(self._views[name].camera)):
            names = list(group)
            views = [self._views[name] for name in names]
            viewmats = torch.stack([view.viewmat for view in views]).repeat_interleave(count, 0)
            Ks = torch.stack([view.K for view in views]).repeat_interleave(count, 0)
            still = replace(
                views[0].still,
                colors=torch.stack([view.still.colors for view in views]).repeat_interleave(count, 0),
            )
            if self._shaded is not None:
                still = self._shaded.shaded(still, dimming.repeat(len(views), 1, 1))
            eyes = torch.stack([self._scene.tensor(view.camera.center) for view in views])
            moving = [(body, spheres.seen_from(eyes)) for body, spheres in placed]
            alone = torch.stack([view.alone for view in views]).repeat_interleave(count, 0)
            labels = self._labels(moving, still, viewmats, Ks, Box(0, 0, *size), alone)
            for number, name in enumerate(names):
                rows = slice(number * count, (number + 1) * count)
                found[name] = _Pictures(*(getattr(labels, field.name)[rows] for field in fields(_Pictures)))
        return {name: found[name] for name in self._views}

    def _one_by_one(self, placed: Sequence[tuple[int, Labelled]], count: int) -> dict[str, _Pictures]:
        """Return the labels of `count` frames for each camera: the plate, redrawn where moving bodies reach."""
        names = [field.name for field in fields(_Pictures)]
        made: dict[str, dict[str, Tensor]] = {}
        plates = {
            camera: view.plate for camera, view in self._views.items() if view.plate is not None
        }  # on the CPU all
        for camera, plate in plates.items():
            made[camera] = {name: getattr(plate.labels, name).repeat_interleave(count, 0) for name in names}
        tasks = [(camera, frame) for camera in plates for frame in range(count)]
        shades = [None] * count if self._shaded is None else [*self._shaded.dimming(placed)]
        crops = self._threads.map(
            lambda task: self._crop(self._views[task[0]], plates[task[0]], placed, task[1], shades[task[1]]), tasks
        )
        for (camera, frame), crop in zip(tasks, crops, strict=True):
            if crop is not None:
                for name in ("image", "depth", "mask", "amodal"):
                    made[camera][name][frame][crop[0].place] = getattr(crop[1], name)[0]
        for arrays in made.values():
            arrays["visible_px"], arrays["amodal_px"] = self._pixels(arrays["mask"], arrays["amodal"])
        return {camera: _Pictures(**arrays) for camera, arrays in made.items()}

    @torch.no_grad()
    def _crop(
        self,
        view: _View,
        plate: _Plate,
        placed: Sequence[tuple[int, Labelled]],
        frame: int,
        dimming: Tensor | None,
    ) -> tuple[Box, _Pictures] | None:
        """Return the box that moving bodies can reach in one frame, and its labels; None where they reach no pixel.

        The factors `dimming` (R, 3) are those of the spheres of the ground that bodies shade.
        """
        eye = self._scene.tensor(view.camera.center)[None]
        moving = [(body, spheres.view(frame).seen_from(eye)) for body, spheres in placed]
        bodies = Labelled.joined([self._scene.none, *(spheres for _, spheres in moving)])
        reaches, still = spans(bodies, view.viewmat, view.K), view.still
        if dimming is not None and self._shaded is not None:
            still = self._shaded.shaded(still, dimming)
            reaches = torch.cat([reaches, plate.reaches[self._shaded.rows[self._shaded.visible(dimming)]]])
        box = reach(reaches, view.camera.width, view.camera.height)
        if box is None:
            return None
        near = still.rows(inside(plate.reaches, box))
        viewmats, Ks = view.viewmat[None], box.camera_matrix(view.K)[None]
        return box, self._labels(moving, near, viewmats, Ks, box, view.alone[box.place][None])

    def _labels(
        self,
        moving: Sequence[tuple[int, Labelled]],
        still: Labelled,
        viewmats: Tensor,
        Ks: Tensor,
        box: Box,
        alone: Tensor,
    ) -> _Pictures:
        """Render the labels of n views of all spheres.

        Args:
            moving: Moving spheres by body, of one view or of n.
            still: Spheres that do not move.
            viewmats: T_cam_world, shape (n, 4, 4).
            Ks: Camera matrices [px], shape (n, 3, 3).
            box: The part of the image to render.
            alone: Whether each fixed body would be visible alone, shape (n, H, W, B).
        """
        spheres = Labelled.joined([*(part for _, part in moving), still])
        ends = np.cumsum([0, *(len(part) for _, part in moving)]).tolist()
        kinds = 1 + self._scene.bodies
        one_hot = torch.eye(kinds, device=viewmats.device)[spheres.labels]
        if spheres.means.dim() == 2:
            weighted = one_hot * (spheres.means @ viewmats[0, 2, :3] + viewmats[0, 2, 3])[:, None]
            features = torch.cat([spheres.colors, one_hot, weighted], -1)
        else:
            depth = spheres.means @ viewmats[:, 2, :3, None] + viewmats[:, 2, 3, None, None]
            one_hot = one_hot.expand(len(viewmats), -1, -1)
            features = torch.cat([spheres.colors, one_hot, one_hot * depth], -1)
        picture = _rendered(spheres, features, viewmats, Ks, box, [slice(*pair) for pair in pairwise(ends)])
        color, weight, weighted_depth = picture.features.split([3, kinds, kinds], dim=-1)
        # Of equal weights the first counts, and a solid pixel has a weight above 0.
        solid = picture.alpha > SOLID_ALPHA
        most, surface = weight.max(-1)
        label = torch.where(solid, surface, 0)
        nearest = weighted_depth.gather(-1, surface[..., None])[..., 0]
        depth = torch.where(solid, nearest / most.clamp_min(1e-6), 0.0)
        whole = torch.zeros_like(label)
        seen = {body: alone[..., body] for body in range(self._scene.bodies)}
        if picture.alone is not None:
            seen |= {body: picture.alone[..., number] > SOLID_ALPHA for number, (body, _) in enumerate(moving)}
        for body, there in seen.items():
            whole |= (there | (label == body + 1)).to(whole.dtype) << body
        mask, amodal = label.to(torch.uint8), whole.to(_SIGNED[self._amodal_dtype.itemsize])
        image = (color.clamp(0, 1) * 255).round().to(torch.uint8)
        return _Pictures(image, depth, mask, amodal, *self._pixels(mask, amodal))

    def _pixels(self, mask: Tensor, amodal: Tensor) -> tuple[Tensor, Tensor]:
        """Return the number of pixels (n, B) of each body in masks and in amodal masks (n, H, W)."""
        bodies = range(self._scene.bodies)
        visible = [(mask == body + 1).flatten(1).sum(1) for body in bodies]
        whole = [((amodal >> body) & 1).flatten(1).sum(1) for body in bodies]
        return tuple(torch.stack(counts, 1).to(torch.int32) for counts in (visible, whole))  # type: ignore[return-value]


def _exposed(image: Tensor, exposure: Exposure) -> Tensor:
    """Apply an exposure to images, clipped to black and white."""
    if exposure == Exposure():
        return image
    gain, offset = (torch.tensor(three, device=image.device) for three in (exposure.gain_rgb, exposure.offset_rgb))
    return (image * gain + 255 * offset).clamp(0, 255).round().to(torch.uint8)


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def _rendered(
    spheres: Labelled, features: Tensor, viewmats: Tensor, Ks: Tensor, box: Box, groups: Sequence[slice] = ()
) -> RenderOutput:
    if len(spheres) == 0:
        nothing = viewmats.new_zeros(len(viewmats), box.height, box.width)
        return RenderOutput(
            features=nothing[..., None].expand(-1, -1, -1, features.shape[-1]), alpha=nothing, weighted_depth=nothing
        )
    return render(
        spheres.means, spheres.scales, spheres.opacities, features, viewmats, Ks, box.width, box.height,
        tile_size=TILE, groups=groups, group_transmittance=0.99 * (1 - SOLID_ALPHA),
    )  # fmt: skip


def _to_host(pictures: dict[str, _Pictures]) -> tuple[dict[str, _Pictures], Callable[[], None]]:
    """Start to copy images from the device into pinned memory, and return a function that waits for the copies."""
    names = [field.name for field in fields(_Pictures)]
    copied: dict[str, _Pictures] = {}
    for camera, picture in pictures.items():
        there = [getattr(picture, name) for name in names]
        here = [torch.empty(x.shape, dtype=x.dtype, pin_memory=True).copy_(x, non_blocking=True) for x in there]
        copied[camera] = _Pictures(*here)
    done = torch.cuda.Event()
    done.record()
    return copied, done.synchronize
