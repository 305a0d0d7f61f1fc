"""Differentiable rendering of spherical Gaussians by one pure function, on any device.

The response of a sphere along a ray depends only on the distance from its centre to the ray, so it is evaluated
directly, without projection to an ellipse on the image plane:

    alpha_i(ray) = opacity_i exp(-dist(c_i, ray)^2 / (2 s_i^2))

Spheres are composited front to back in the order of their distance from the camera's centre, which does not change
when the camera rotates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..runtime import kernel_build
from . import raster_host, raster_reference
from .rasterize import Raster, rasterize
from .tiles import TiledScene, Tiles

MIN_ALPHA = 1 / 255
"""Threshold on alpha below which a sphere does not contribute to a pixel."""
MIN_TRANSMITTANCE = 1e-4
"""Threshold on the transmittance of a pixel below which spheres behind are skipped."""
_TILE = 8
"""Default side of a tile of the torch path [px]."""


@dataclass(frozen=True, kw_only=True)
class RenderOutput:
    """Images of C cameras."""

    features: Tensor
    """Composited features with the background behind them, shape (C, H, W, F)."""
    alpha: Tensor
    """Opacity of all spheres together in [0, 1), shape (C, H, W)."""
    weighted_depth: Tensor
    """Sum of depths along the optical axis [m] weighted by the contributions of the spheres to alpha, shape (C, H, W).
    """
    median_depth: Tensor | None = None
    """Depth of the sphere at which the transmittance falls to half [m], 0 where it does not, shape (C, H, W); without
    derivative. None where it was not requested.
    """
    pairs: Tensor | None = None
    """Number of pairs of tiles and spheres in the kernels of `rasterize`, to compare with the capacity, int32 on the
    device, shape (); None in the torch path.
    """
    alone: Tensor | None = None
    """Opacity of each group of spheres as if it were alone, shape (C, H, W, G); without derivative. None without
    groups.
    """

    @property
    def depth(self) -> Tensor:
        """Expected depth along the optical axis [m], shape (C, H, W); 0 where nothing is visible."""
        seen = self.alpha > 0
        return torch.where(seen, self.weighted_depth / torch.where(seen, self.alpha, 1.0), 0.0)


def render(
    means: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    background: Tensor | None = None,
    distortion: Tensor | None = None,
    *,
    min_alpha: float = MIN_ALPHA,
    min_transmittance: float = MIN_TRANSMITTANCE,
    tile_size: int = _TILE,
    median: bool = False,
    capacity: int | None = None,
    groups: Sequence[slice] = (),
    group_transmittance: float = MIN_TRANSMITTANCE,
) -> RenderOutput:
    """Render spheres into C cameras.

    Differentiable in means, scales, opacities, features, viewmats and background. A sphere is drawn if its centre lies
    in front of the camera by more than its scale, and its position is finite. float32 tensors on CUDA are rendered by
    the kernels of `rasterize`, those on a CPU by torch and the program of `raster_host`, all others (and where
    neither can run) by plain torch, with the same result.

    Args:
        means: Centres [m], world frame, shape (N, 3), or (C, N, 3) where they differ by camera (moving bodies).
        scales: Standard deviations s > 0 [m], shape (N,).
        opacities: Peak alphas in [0, 1], shape (N,).
        features: Colours or any other channels, shape (N, F), or (C, N, F) where they differ by camera; the latter have
            no derivative on CUDA.
        viewmats: T_cam_world, camera axes OpenCV, shape (C, 4, 4).
        Ks: Camera matrices [px], shape (C, 3, 3); the centre of the top-left pixel is (0.5, 0.5).
        width: Image width [px].
        height: Image height [px].
        background: Features behind everything, shape (F,) or (C, F); None for zero.
        distortion: OpenCV's k1, k2, p1, p2 [, k3], shape (k,) or (C, k); None for pinhole cameras.
        min_alpha: Threshold below which an alpha counts as 0; with 0 every sphere meets every pixel.
        min_transmittance: Threshold on a pixel's transmittance below which spheres behind are skipped.
        tile_size: Side of the tiles of the torch path [px]; affects only the speed.
        median: Whether to return the median depth.
        capacity: Maximum number of pairs of tiles and spheres in the kernels, see `rasterize.Raster`.
        groups: Groups of spheres whose opacity alone is also returned: G slices of the N spheres.
        group_transmittance: `min_transmittance` of the groups: below it the returned opacity of a group may be too low,
            but not below 1 minus this.

    Returns:
        Features, alpha and depth.
    """
    scene = _Scene(
        means=means,
        scales=scales,
        opacities=opacities,
        features=features,
        viewmats=viewmats,
        Ks=Ks,
        distortion=distortion,
        width=width,
        height=height,
        groups=groups,
    )
    if means.is_cuda and means.dtype == torch.float32 and kernel_build.available():
        drawn = _draw_by_kernels(scene, min_alpha, min_transmittance, group_transmittance, capacity)
        drawn = drawn if median else replace(drawn, median_depth=None)
    else:
        drawn = _draw_in_tiles(scene, min_alpha, min_transmittance, group_transmittance, tile_size, median)
    return drawn if background is None else _with_background(drawn, background)


@dataclass(frozen=True, kw_only=True)
class _Scene:
    """Spheres and cameras of a call of `render`, with the arguments of the same names there."""

    means: Tensor
    """Centres, world frame [m], shape (N, 3) or (C, N, 3)."""
    scales: Tensor
    """Standard deviations [m], shape (N,)."""
    opacities: Tensor
    """Peak alphas, shape (N,)."""
    features: Tensor
    """Features, shape (N, F) or (C, N, F)."""
    viewmats: Tensor
    """T_cam_world, shape (C, 4, 4)."""
    Ks: Tensor
    """Camera matrices [px], shape (C, 3, 3)."""
    distortion: Tensor | None
    """Distortion coefficients, shape (k,) or (C, k); None for pinhole cameras."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    groups: Sequence[slice]
    """Groups of spheres whose opacity alone is also rendered."""


def _draw_by_kernels(
    scene: _Scene, min_alpha: float, min_transmittance: float, group_transmittance: float, capacity: int | None
) -> RenderOutput:
    """Render on CUDA, by the kernels of `rasterize`, without a background."""
    raster = Raster(
        width=scene.width,
        height=scene.height,
        min_alpha=min_alpha,
        min_transmittance=min_transmittance,
        capacity=capacity,
    )
    means, scales, opacities = scene.means, scene.scales, scene.opacities
    values, alpha, depth, middle, pairs = rasterize(
        means, scales, opacities, scene.features, scene.viewmats, scene.Ks, raster, scene.distortion
    )
    single = replace(raster, min_transmittance=group_transmittance, capacity=None)
    alphas = [
        rasterize(
            means[..., group, :], scales[group], opacities[group], opacities[group, None], scene.viewmats, scene.Ks,
            single, scene.distortion,
        )[1]
        for group in scene.groups
    ]  # fmt: skip
    return RenderOutput(
        features=values,
        alpha=alpha,
        weighted_depth=depth,
        median_depth=middle,
        pairs=pairs,
        alone=torch.stack(alphas, -1).detach() if scene.groups else None,
    )


def _draw_in_tiles(
    scene: _Scene,
    min_alpha: float,
    min_transmittance: float,
    group_transmittance: float,
    tile_size: int,
    median: bool,
) -> RenderOutput:
    """Render in tiles, by the program of `raster_host` where it runs, else in torch, without a background."""
    cameras = scene.viewmats.shape[0]
    tiles = Tiles.make(scene.Ks, scene.distortion, scene.width, scene.height, tile_size)
    given = TiledScene(
        local=scene.means @ scene.viewmats[:, :3, :3].transpose(1, 2) + scene.viewmats[:, None, :3, 3],
        scales=scene.scales,
        opacities=scene.opacities,
        features=scene.features,
        tiles=tiles,
        groups=scene.groups,
        median=median,
        min_alpha=min_alpha,
        min_transmittance=min_transmittance,
        group_transmittance=group_transmittance,
    )
    twin = raster_host if raster_host.supported(given.local) else raster_reference
    drawn = twin.draw(given)
    image = tiles.to_image(torch.cat([drawn.values, drawn.alpha[:, :, None]], 2), cameras)
    return RenderOutput(
        features=image[..., :-2],
        alpha=image[..., -1],
        weighted_depth=image[..., -2],
        median_depth=tiles.to_image(drawn.median[:, :, None], cameras)[..., 0] if median else None,
        alone=None if drawn.alone is None else tiles.to_image(drawn.alone, cameras),
    )


def _with_background(drawn: RenderOutput, background: Tensor) -> RenderOutput:
    """Return a rendering with features (F,) or (C, F) behind it."""
    behind = background.expand(drawn.features.shape[0], -1)[:, None, None, :]
    return replace(drawn, features=drawn.features + (1 - drawn.alpha)[..., None] * behind)
