"""Rendering in tiles on the CPU by a compiled program, the twin of `raster_reference` in a fifth of its time or less.

Pixels of a block are computed side by side in the vectors of the processor, tiles by several threads, and nothing of
the size of the pairs of tiles and spheres is written but their list. The derivatives of pairs are added up in the order
of the list, so that results do not depend on the number of threads.
"""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from ..runtime import kernel_build
from ..runtime.resources import kernel_threads
from .tiles import TiledImages, TiledScene, Tiles, ViewCones

PAIRS_PER_THREAD = 2000
"""Minimum number of pairs of tiles and spheres per thread: a tenth of a millisecond, several times what a thread costs.
"""
SPHERES_PER_THREAD = 4000
"""Minimum number of pairs of cameras and spheres per thread in culling, by the same measure."""


def supported(like: Tensor) -> bool:
    """Return whether the program runs here for tensors of this type and device."""
    on_host = like.device.type == "cpu" and like.dtype in (torch.float32, torch.float64)
    return on_host and unavailable(like.dtype == torch.float32) is None


@cache
def unavailable(single: bool) -> str | None:
    """Return why the program does not run here in single or double precision; None where it does.

    Where there is a compiler, the log says once why.
    """
    reason = kernel_build.host_failure(lambda: _library(single))
    if reason is not None and kernel_build.compiler() is not None:
        text = "the renderer's program for the CPU does not run: %s. PyTorch renders instead, five times slower."
        logging.getLogger("cgwm").warning(text, reason)
    return reason


def draw(scene: TiledScene) -> TiledImages:
    """Draw a scene by the program."""
    centres = scene.local.reshape(-1, 3)
    log_opacities = scene.opacities.clamp_min(1e-12).log()
    spheres = (centres, scene.scales, log_opacities, scene.features)
    with torch.no_grad():
        lists = _Lists.of(scene)
    values, alpha, middle = _Composite.apply(*spheres, lists, scene.median)  # type: ignore[misc]
    alone = None
    if scene.groups:
        with torch.no_grad():
            single = replace(lists, min_transmittance=scene.group_transmittance)
            blank = scene.features[..., :0]
            members = [range(len(scene.scales))[group] for group in scene.groups]
            lefts = [_composited(centres, *spheres[1:3], blank, single, False, one)[1] for one in members]
            alone = 1 - torch.stack(lefts, 2)
    return TiledImages(values=values, alpha=alpha, median=middle, alone=alone)


@dataclass(frozen=True, kw_only=True)
class _Lists:
    """Spheres that each of T tiles composites, nearest first; K rows of frames of tiles, M pairs."""

    tiles: Tiles
    """The tiles."""
    frame: Tensor
    """Row of the frame of each tile, shape (T,)."""
    starts: Tensor
    """First pair of each tile, shape (T,)."""
    counts: Tensor
    """Number of pairs of each tile, shape (T,)."""
    places: Tensor
    """camera * N + sphere of each pair, shape (M,)."""
    min_alpha: float
    """Threshold below which an alpha counts as 0."""
    min_transmittance: float
    """Transmittance of all pixels of a block at which it is finished."""

    @staticmethod
    def of(scene: TiledScene) -> _Lists:
        """Find the spheres that the tiles of a scene show, see `tile_pairs`."""
        tiles, cameras = scene.tiles, scene.local.shape[0]
        cones = ViewCones.of(scene.local, scene.scales, scene.opacities, scene.min_alpha)
        half = cones.half.gather(1, cones.order)
        direction = cones.direction.movedim(2, 1).gather(2, cones.order[:, None].expand(-1, 3, -1))
        columns = torch.cat([direction, torch.stack([half, half.cos(), half.sin()], 1)], 1)
        counts = torch.empty(cameras * tiles.count, dtype=torch.int64)
        tensors = (columns, cones.order, cones.drawn, tiles.group, tiles.rotations[:, 2], tiles.half_angle)
        given = [x.contiguous() for x in tensors]
        sizes = (cameras, scene.local.shape[1], tiles.rows, tiles.columns)
        threads = _threads(half.numel() // SPHERES_PER_THREAD)
        single = scene.local.dtype == torch.float32
        _call(single, "cull", threads, *given, *sizes, counts, None, None)
        starts = counts.cumsum(0) - counts
        places = torch.empty(int(counts.sum()), dtype=torch.int64)
        _call(single, "cull", threads, *given, *sizes, counts, starts, places)
        return _Lists(
            tiles=tiles,
            frame=tiles.frame_of(torch.arange(len(counts))),
            starts=starts,
            counts=counts,
            places=places,
            min_alpha=scene.min_alpha,
            min_transmittance=scene.min_transmittance,
        )

    @property
    def threads(self) -> int:
        """Number of threads that composite them."""
        return _threads(len(self.places) // PAIRS_PER_THREAD)

    def arguments(self, spheres: Sequence[Tensor], members: range) -> list[Tensor | int | float]:
        """Return the arguments LISTS of the program for spheres (centres, scales, log_opacities, features)."""
        _, scales, _, features = spheres
        tiles, count, pixels = self.tiles, len(self.counts), self.tiles.basis.shape[1]
        tensors = (*spheres, tiles.basis, tiles.rotations, self.frame, self.starts, self.counts, self.places)
        sizes = (len(scales), count, pixels, features.shape[-1], int(features.dim() == 3), members.start, members.stop)
        return [*(x.contiguous() for x in tensors), *sizes, float(self.min_alpha), float(self.min_transmittance)]


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, centres: Tensor, scales: Tensor, log_opacities: Tensor, features: Tensor, lists: _Lists, median: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        spheres = (centres, scales, log_opacities, features)
        out, left, middle = _composited(*spheres, lists, median, range(len(scales)))
        ctx.save_for_backward(*spheres, out, left)
        ctx.lists = lists
        ctx.mark_non_differentiable(middle)
        return out, 1 - left, middle

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *spheres, out, left = ctx.saved_tensors
        lists: _Lists = ctx.lists
        found = [torch.zeros_like(x, memory_format=torch.contiguous_format) for x in spheres]
        pairs = len(lists.places)
        given = lists.arguments(spheres, range(len(spheres[1])))
        by_results = (gradient.contiguous() for gradient in gradients[:2])
        single = out.dtype == torch.float32
        _call(single, "composite_backward", lists.threads, *given, out, left, *by_results, pairs, *found)
        return *found, None, None


def _composited(
    centres: Tensor,
    scales: Tensor,
    log_opacities: Tensor,
    features: Tensor,
    lists: _Lists,
    median: bool,
    members: range,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return features and depth (T, P, F + 1), transmittance (T, P) and median depth (T, P) of some of the spheres."""
    shape = (len(lists.counts), lists.tiles.basis.shape[1])
    out = features.new_empty(*shape, features.shape[-1] + 1)
    left, middle = features.new_empty(shape), features.new_zeros(shape)
    given = lists.arguments((centres, scales, log_opacities, features), members)
    single = features.dtype == torch.float32
    _call(single, "composite_forward", lists.threads, *given, out, left, middle if median else None)
    return out, left, middle


def _threads(most: int) -> int:
    return max(1, min(kernel_threads(), most))


def _call(single: bool, name: str, *values: Tensor | int | float | None) -> None:
    """Call a function of the program; tensors are contiguous, and None is a null pointer."""
    getattr(_library(single), name)(*map(_word, values))


def _word(value: Tensor | int | float | None) -> Any:
    """Return an argument as the program takes it; the sizes of tensors and numbers are 32 bits."""
    if isinstance(value, int):
        return ctypes.c_int(value)
    if isinstance(value, float):
        return ctypes.c_double(value)
    return ctypes.c_void_p(None if value is None else value.data_ptr())


@cache
def _library(single: bool) -> ctypes.CDLL:
    parts = [kernel_build.source_file(__name__, f"host/{name}.cuh") for name in ("common", "cull", "composite")]
    flags = (*kernel_build.HOST_FLAGS, *kernel_build.vector_flags())
    return kernel_build.host_library("\n".join([f"#define SINGLE {int(single)}", *parts]), flags)
