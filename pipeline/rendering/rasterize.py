"""Renderer on CUDA: the sequence of kernels, and their derivative for torch.

Spheres are sorted by distance once, over all cameras; then pairs of tiles and spheres are written in that order and
sorted by tile with a stable sort. Keys of 16 bits need two passes of a radix sort; a key of tile and depth would need
six.
"""

# pyright: reportArgumentType=false, reportCallIssue=false
# (Triton annotates what is constant when it compiles; callers pass plain numbers, and num_warps in addition.)

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from ..runtime import kernel_build
from . import binning, cuda_kernels, triton_kernels
from .rays import LEAST_DETERMINANT, UNDISTORT_STEPS

TILE = 16
"""Side of a tile [px]."""
BLOCK = 16
"""Number of spheres of a tile that a Triton program processes together."""
_WARPS = TILE * TILE // 64


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
    kernels: Literal["auto", "cuda", "triton"] = "auto"
    """Kernels that composite: the CUDA ones (faster) or the Triton ones; auto takes the CUDA ones where cuda.core is
    installed to compile them.
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

    @property
    def compiled(self) -> bool:
        """Whether the CUDA kernels composite."""
        return self.kernels == "cuda" or (self.kernels == "auto" and kernel_build.available())


class _Lists(NamedTuple):
    """Spheres that each tile composites, nearest first."""

    centres: Tensor
    """See `binning.project`, shape (C, N, 4)."""
    log_opacities: Tensor
    """See `binning.project`, shape (N,)."""
    spans: Tensor
    """See `binning.project`, shape (C * N, 4)."""
    rows: Tensor
    """Row camera * N + sphere of each pair, shape (M,)."""
    starts: Tensor
    """First pair of each tile, shape (tiles + 1,)."""
    pairs: Tensor
    """Number of pairs that all tiles need, shape ()."""


class _Rays(NamedTuple):
    """Rays of distorting cameras, as `triton_kernels.trace` writes them; every field is None for pinhole cameras."""

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
        if raster.compiled:
            tensors = (*lists[:3], features, *lists[3:5], Ks, rays.rays, out, left, depth, median)
            for first in range(0, channels, cuda_kernels.CHANNELS):
                cuda_kernels.launch("composite_forward", tiles, tensors, (*numbers, *raster.thresholds), first)
        else:
            triton_kernels.composite_forward[(tiles,)](
                *lists[:2], features, *lists[3:5], Ks, rays.rays, out, left, depth, median,
                *numbers, *raster.thresholds,
                F=channels, CHANNELS=_filled(channels), BY_CAMERA=by_camera, TILE=TILE, BLOCK=BLOCK, num_warps=_WARPS,
            )  # fmt: skip
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
        rows = torch.zeros(cameras, count, cuda_kernels.gradient_width(channels), device=means.device)
        pictures = (out, left, depth, grad_out, grad_alpha, grad_depth, rows)
        if raster.compiled:
            tensors = (*lists[:3], features, *lists[3:5], Ks, rays, *pictures)
            cuda_kernels.launch("composite_backward", tiles, tensors, (*numbers, *raster.thresholds))
        else:
            triton_kernels.composite_backward[(tiles,)](
                *lists[:2], features, *lists[3:5], Ks, rays, *pictures, *numbers, *raster.thresholds,
                F=channels, CHANNELS=_filled(channels), WIDE=rows.shape[2], TILE=TILE, BLOCK=BLOCK, num_warps=_WARPS,
            )  # fmt: skip
        by_sphere = [torch.empty_like(value) for value in (means, scales, opacities, features)]
        group = min(16, _filled(cameras))
        block = max(32, 256 // group)
        if count:
            binning.project_backward[(-(-count // block),)](
                rows, viewmats, scales, opacities, *by_sphere, cameras, count,
                F=channels, WIDE=rows.shape[2], PER_CAMERA=means.dim() == 3, GROUP=group, BLOCK=block,
            )  # fmt: skip
        grad_viewmats = None
        if ctx.needs_input_grad[4]:
            by_centre = rows[..., :3]
            grad_viewmats = torch.zeros_like(viewmats)
            grad_viewmats[:, :3, :3] = by_centre.transpose(1, 2) @ means
            grad_viewmats[:, :3, 3] = by_centre.sum(1)
        return *by_sphere, grad_viewmats, None, None, None


def _filled(channels: int) -> int:
    """Return the next power of two, as Triton requires for the side of a tensor."""
    return 1 << (channels - 1).bit_length()


def _trace(Ks: Tensor, distortion: Tensor, raster: Raster) -> _Rays:
    cameras = Ks.shape[0]
    distortion = distortion.detach().to(Ks).expand(cameras, -1).contiguous()
    rays = Ks.new_empty(cameras, raster.height, raster.width, 2)
    bounds = Ks.new_empty(cameras, raster.rows, raster.columns, 4)
    triton_kernels.trace[(cameras * raster.columns * raster.rows,)](
        Ks, distortion, rays, bounds, raster.columns, raster.rows, raster.width, raster.height,
        TERMS=distortion.shape[1], STEPS=UNDISTORT_STEPS, LEAST=LEAST_DETERMINANT, TILE=TILE, num_warps=_WARPS,
    )  # fmt: skip
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
    binning.project[(cameras, max(1, -(-count // binning.PROJECT_BLOCK)))](
        means, scales, opacities, viewmats, Ks, *rays[1:], centres, log_opacities, distances, spans, counts,
        count, raster.width, raster.height, raster.columns, raster.rows, raster.min_alpha,
        PER_CAMERA=means.dim() == 3, HAS_LEAST=raster.min_alpha > 0, TILE=TILE, BLOCK=binning.PROJECT_BLOCK,
    )  # fmt: skip
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
        binning.emit[(-(-total // binning.EMIT_BLOCK),)](
            order, ends, spans, *rays[1:], keys, rows, total, count, capacity, raster.columns, raster.rows,
            TILE=TILE, BLOCK=binning.EMIT_BLOCK,
        )  # fmt: skip
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
