"""Renderer on CUDA: the sequence of kernels, and their derivative for torch.

The torch path in `render` is their twin. Spheres are sorted by distance once, over all cameras; then pairs of tiles and
spheres are written in that order and sorted by tile with a stable sort. Keys of 16 bits need two passes of a radix
sort; a key of tile and depth would need six.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .cuda_kernels import BACKWARD_THREADS, CHANNELS, TILE, gradient_width, launch
from .rays import LEAST_DETERMINANT, UNDISTORT_STEPS


@dataclass(frozen=True)
class Raster:
    """Size and thresholds of a rendering."""

    width: int
    """Width of the images [px]."""
    height: int
    """Height of the images [px]."""
    min_alpha: float
    """Threshold below which an alpha counts as 0."""
    min_transmittance: float
    """Threshold on a pixel's transmittance below which spheres behind are skipped."""
    capacity: int | None = None
    """Maximum number of pairs of tiles and spheres; None counts them, which waits for the device. With a capacity
    nothing waits, so that a CUDA graph can capture the call; pairs beyond it are lost, and the caller compares the
    number of pairs that `rasterize` returns.
    """

    @property
    def columns(self) -> int:
        """Number of tiles in a row."""
        return -(-self.width // TILE)

    @property
    def rows(self) -> int:
        """Number of rows of tiles."""
        return -(-self.height // TILE)

    @property
    def thresholds(self) -> tuple[float, float]:
        """Thresholds on alpha and on transmittance, for the kernels."""
        return float(self.min_alpha), float(self.min_transmittance)


class _Lists(NamedTuple):
    """Spheres that each tile composites, nearest first."""

    centres: Tensor
    """See `cuda/project.cuh`, shape (C, N, 4)."""
    log_opacities: Tensor
    """See `cuda/project.cuh`, shape (N,)."""
    spans: Tensor
    """See `cuda/project.cuh`, shape (C * N, 4)."""
    rows: Tensor
    """Row camera * N + sphere of each pair, shape (M,)."""
    starts: Tensor
    """First pair of each tile, shape (tiles + 1,)."""
    pairs: Tensor
    """Number of pairs that all tiles need, shape ()."""


class _Rays(NamedTuple):
    """Rays of distorting cameras, as `cuda/trace.cuh` writes them; every field is None for pinhole cameras."""

    rays: Tensor | None = None
    """Rays (x, y) on the plane z = 1, shape (C, H, W, 2)."""
    tiles: Tensor | None = None
    """Bounds of the rays in each tile, shape (C, rows, columns, 4)."""
    columns: Tensor | None = None
    """Bounds of the rays in each column of tiles, shape (C, columns, 4)."""
    rows: Tensor | None = None
    """Bounds of the rays in each row of tiles, shape (C, rows, 4)."""


def rasterize(
    means: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    raster: Raster,
    distortion: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Render to features (C, H, W, F), alpha (C, H, W), depth times alpha, median depth, and the number of pairs ().

    Shapes as in `render.render`; all float32 on one CUDA device. The last two results have no derivative.

    Raises:
        ValueError: If a derivative is requested with features that differ by camera.
    """
    arguments = (means, scales, opacities, features, viewmats, Ks, raster, distortion)
    return _Rasterize.apply(*arguments)  # type: ignore[return-value]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        raster: Raster,
        distortion: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        means, scales, opacities, features, viewmats, Ks = (
            value.contiguous() for value in (means, scales, opacities, features, viewmats, Ks)
        )
        rays = _Rays() if distortion is None else _trace(Ks, distortion, raster)
        by_camera = features.dim() == 3
        if by_camera and any(ctx.needs_input_grad[:5]):
            raise ValueError("features that differ by camera have no derivative on CUDA")
        lists = _bin(means, scales, opacities, viewmats, Ks, rays, raster)
        cameras, channels = viewmats.shape[0], features.shape[-1]
        shape = (cameras, raster.height, raster.width)
        out = features.new_empty(*shape, channels)
        left, depth, median = (features.new_empty(shape) for _ in range(3))
        tiles = cameras * raster.columns * raster.rows
        numbers = (scales.shape[0], raster.columns, raster.rows, raster.width, raster.height)
        tensors = (*lists[:3], features, *lists[3:5], Ks, rays.rays, out, left, depth, median)
        kind = {"RAYS": int(distortion is not None), "BY_CAMERA": int(by_camera)}
        for first in range(0, channels, CHANNELS):
            part = {"F": channels, "FIRST": first, "COUNT": min(CHANNELS, channels - first)}
            launch("composite_forward", means.device, tiles, tensors, (*numbers, *raster.thresholds), **part, **kind)
        ctx.save_for_backward(means, scales, opacities, features, viewmats, Ks, rays.rays, out, left, depth, *lists)
        ctx.raster = raster
        ctx.mark_non_differentiable(median, lists.pairs)
        return out, 1 - left, depth, median, lists.pairs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, scales, opacities, features, viewmats, Ks, rays, out, left, depth, *parts = ctx.saved_tensors
        lists, raster = _Lists(*parts), ctx.raster
        grad_out, grad_alpha, grad_depth = (gradient.contiguous() for gradient in gradients[:3])
        count, channels, cameras = scales.shape[0], features.shape[1], viewmats.shape[0]
        tiles = cameras * raster.columns * raster.rows
        numbers = (count, raster.columns, raster.rows, raster.width, raster.height)
        rows = torch.zeros(cameras, count, gradient_width(channels), device=means.device)
        pictures = (out, left, depth, grad_out, grad_alpha, grad_depth, rows)
        tensors = (*lists[:3], features, *lists[3:5], Ks, rays, *pictures)
        part = {"F": channels, "FIRST": 0, "COUNT": min(CHANNELS, channels), "RAYS": int(rays is not None)}
        thresholds = raster.thresholds
        launch("composite_backward", means.device, tiles, tensors, (*numbers, *thresholds), **part, BY_CAMERA=0)
        by_sphere = [torch.empty_like(value) for value in (means, scales, opacities, features)]
        if count:
            group = min(16, 1 << (cameras - 1).bit_length())
            blocks = -(-count // (BACKWARD_THREADS // group))
            tensors = (rows, viewmats, scales, opacities, *by_sphere)
            sizes = (cameras, count, int(means.dim() == 3))
            launch("project_backward", means.device, blocks, tensors, sizes, F=channels, GROUP=group)
        grad_viewmats = None
        if ctx.needs_input_grad[4]:
            by_centre = rows[..., :3]
            grad_viewmats = torch.zeros_like(viewmats)
            grad_viewmats[:, :3, :3] = by_centre.transpose(1, 2) @ means
            grad_viewmats[:, :3, 3] = by_centre.sum(1)
        return *by_sphere, grad_viewmats, None, None, None


def _trace(Ks: Tensor, distortion: Tensor, raster: Raster) -> _Rays:
    cameras = Ks.shape[0]
    distortion = distortion.detach().to(Ks).expand(cameras, -1).contiguous()
    rays = Ks.new_empty(cameras, raster.height, raster.width, 2)
    bounds = Ks.new_empty(cameras, raster.rows, raster.columns, 4)
    numbers = (raster.columns, raster.rows, raster.width, raster.height, distortion.shape[1], UNDISTORT_STEPS)
    blocks = cameras * raster.columns * raster.rows
    launch("trace", Ks.device, blocks, (Ks, distortion, rays, bounds), (*numbers, float(LEAST_DETERMINANT)))
    return _Rays(rays, bounds, bounds.amin(1), bounds.amin(2))


def _bin(
    means: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor, rays: _Rays, raster: Raster
) -> _Lists:
    cameras, count = viewmats.shape[0], scales.shape[0]
    total, tiles = cameras * count, cameras * raster.columns * raster.rows
    device = means.device
    centres = torch.empty(cameras, count, 4, device=device)
    log_opacities = torch.empty(count, device=device)
    distances = torch.empty(total, device=device)
    spans = torch.empty(total, 4, device=device)
    counts = torch.empty(total, device=device, dtype=torch.int32)
    grid, rays_there = (raster.columns, raster.rows), int(rays.rays is not None)
    tensors = (means, scales, opacities, viewmats, Ks, *rays[1:], centres, log_opacities, distances, spans, counts)
    numbers = (cameras, count, *grid, int(means.dim() == 3), float(raster.min_alpha))
    if total:
        launch("project", device, total, tensors, numbers, RAYS=rays_there)
    order = torch.argsort(distances)
    ends = counts.gather(0, order).cumsum(0, dtype=torch.int32)
    pairs = ends[-1] if total else torch.zeros((), device=device, dtype=torch.int32)
    capacity = int(pairs) if raster.capacity is None else raster.capacity
    key_type = torch.int16 if tiles < 2**15 else torch.int32
    keys = torch.empty(capacity, device=device, dtype=key_type)
    rows = torch.empty(capacity, device=device, dtype=torch.int32)
    if raster.capacity is not None:
        keys.fill_(torch.iinfo(key_type).max)  # unused entries sort behind all tiles
    if total:
        wide_keys = int(key_type == torch.int32)
        numbers = (total, count, capacity, *grid, wide_keys)
        launch("emit", device, total, (order, ends, spans, *rays[1:], keys, rows), numbers, RAYS=rays_there)
    keys, place = torch.sort(keys, stable=True)
    starts = torch.searchsorted(keys, torch.arange(tiles + 1, device=device, dtype=key_type), out_int32=True)
    return _Lists(
        centres=centres,
        log_opacities=log_opacities,
        spans=spans,
        rows=rows.gather(0, place),
        starts=starts,
        pairs=pairs,
    )
