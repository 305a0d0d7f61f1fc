"""Tiles of the images of cameras, and the spheres that each of them shows: culling by cones, for the torch path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .rays import pixel_rays

_BLOCK = 8
"""Number of tiles along the side of a block, the coarse level of culling."""


@dataclass(frozen=True, kw_only=True)
class Tiles:
    """Tiles of the images; cameras with equal K and distortion share their G rows."""

    basis: Tensor
    """See `TileLists`, shape (G * tiles, P, 6)."""
    rotations: Tensor
    """Rotations from camera axes to tile axes (rows), shape (G * tiles, 3, 3); the last row is the tile's axis."""
    half_angle: Tensor
    """Angle between the axis and the farthest pixel [rad], shape (G * tiles,)."""
    group: Tensor
    """Row group of each camera, shape (C,)."""
    columns: int
    """Number of tiles in a row."""
    rows: int
    """Number of rows of tiles."""
    size: int
    """Side of a tile [px]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""

    @property
    def count(self) -> int:
        """Number of tiles of one image."""
        return self.columns * self.rows

    def frame_of(self, tile_ids: Tensor) -> Tensor:
        """Return the rows of `basis` and `rotations` for tiles with the numbers camera * count + tile."""
        return self.group[tile_ids // self.count] * self.count + tile_ids % self.count

    @staticmethod
    @torch.no_grad()
    def make(Ks: Tensor, distortion: Tensor | None, width: int, height: int, size: int) -> Tiles:
        """Divide the images of cameras with matrices (C, 3, 3) into tiles of `size` [px]; see `render`."""
        camera_count = Ks.shape[0]
        keys = Ks.reshape(camera_count, 9)
        if distortion is not None:
            keys = torch.cat([keys, distortion.expand(camera_count, -1)], 1)
        unique, group = torch.unique(keys, dim=0, return_inverse=True)
        columns, rows = math.ceil(width / size), math.ceil(height / size)
        # Pixels beyond the border repeat the last one inside, so that a tile's cone is never wider than the image.
        u = (torch.arange(columns * size, device=Ks.device, dtype=Ks.dtype) + 0.5).clamp_max(width - 0.5)
        v = (torch.arange(rows * size, device=Ks.device, dtype=Ks.dtype) + 0.5).clamp_max(height - 0.5)
        pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
        rays = pixel_rays(pixels, unique[:, :9].reshape(-1, 3, 3), unique[:, 9:] if distortion is not None else None)
        rays = rays.reshape(-1, rows, size, columns, size, 3).transpose(2, 3).reshape(-1, size * size, 3)
        axis = torch.nn.functional.normalize(rays.mean(1), dim=1)
        rotations = _frames(axis)
        local = rays @ rotations.transpose(1, 2)
        sine = local[..., :2].norm(dim=-1)
        half_angle = torch.atan2(sine, local[..., 2]).amax(1)
        x, y = (local[..., :2] / local[..., 2:]).unbind(-1)
        one = torch.ones_like(x)
        basis = torch.stack([one, x, y, x * x, x * y, y * y], -1) / (1 + x * x + y * y)[..., None]
        return Tiles(
            basis=basis,
            rotations=rotations,
            half_angle=half_angle,
            group=group,
            columns=columns,
            rows=rows,
            size=size,
            width=width,
            height=height,
        )

    def to_image(self, values: Tensor, camera_count: int) -> Tensor:
        """Arrange tiles (C * tiles, P, F) as images (C, H, W, F)."""
        grid = values.reshape(camera_count, self.rows, self.columns, self.size, self.size, -1).transpose(2, 3)
        grid = grid.reshape(camera_count, self.rows * self.size, self.columns * self.size, -1)
        return grid[:, : self.height, : self.width]


@dataclass(frozen=True, kw_only=True)
class TiledScene:
    """Spheres in the axes of C cameras, and what of them is drawn in tiles; see `render` for what is not said here."""

    local: Tensor
    """Centres [m], camera axes, shape (C, N, 3)."""
    scales: Tensor
    """Standard deviations [m], shape (N,)."""
    opacities: Tensor
    """Peak alphas, shape (N,)."""
    features: Tensor
    """Shape (N, F) or (C, N, F)."""
    tiles: Tiles
    """The tiles."""
    groups: Sequence[slice]
    """Groups of spheres (G) whose opacity alone is also drawn."""
    median: bool
    """Whether the median depth is drawn."""
    min_alpha: float
    """Threshold below which an alpha counts as 0."""
    min_transmittance: float
    """Threshold on the transmittance below which spheres behind are skipped."""
    group_transmittance: float
    """The same for the groups."""


@dataclass(frozen=True, kw_only=True)
class TiledImages:
    """What T = C * tiles of P pixels show."""

    values: Tensor
    """Features and depth, not divided by alpha, shape (T, P, F + 1)."""
    alpha: Tensor
    """Shape (T, P)."""
    median: Tensor
    """Median depth, 0 where it was not requested, shape (T, P); without derivative."""
    alone: Tensor | None
    """Alpha of each group alone, shape (T, P, G); without derivative. None without groups."""


def _frames(axis: Tensor) -> Tensor:
    """Return rotations whose third row is `axis` (n, 3), a unit vector; shape (n, 3, 3)."""
    helper = torch.zeros_like(axis)
    helper[:, 1] = 1.0
    steep = axis[:, 1].abs() > 0.9
    helper[steep] = helper.new_tensor([1.0, 0.0, 0.0])
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, axis), dim=1)
    return torch.stack([first, torch.linalg.cross(axis, first), axis], 1)


@dataclass(frozen=True, kw_only=True)
class ViewCones:
    """Cones around what C cameras see of N spheres, each to where its alpha falls to a threshold."""

    direction: Tensor
    """Unit vectors to the centres, camera frames, shape (C, N, 3)."""
    half: Tensor
    """Half angles [rad], shape (C, N)."""
    order: Tensor
    """Spheres, nearest first, those that are not drawn last, shape (C, N)."""
    drawn: Tensor
    """Number of spheres that are drawn, shape (C,)."""

    @staticmethod
    def of(local: Tensor, scales: Tensor, opacities: Tensor, min_alpha: float) -> ViewCones:
        """Return the cones of spheres; arguments as of `tile_pairs`."""
        distance = local.norm(dim=2)
        drawn = (local[..., 2] > scales) & torch.isfinite(distance)
        if min_alpha > 0:
            drawn &= opacities > min_alpha
            reach = scales * (2 * (opacities / min_alpha).clamp_min(1.0).log()).sqrt()
            half = torch.asin((reach / distance).clamp_max(1.0))
        else:
            half = torch.full_like(distance, math.pi)
        order = torch.argsort(torch.where(drawn, distance, torch.inf), dim=1, stable=True)
        return ViewCones(direction=local / distance[..., None], half=half, order=order, drawn=drawn.sum(1))


def tile_pairs(
    local: Tensor, scales: Tensor, opacities: Tensor, tiles: Tiles, min_alpha: float
) -> tuple[Tensor, Tensor, Tensor]:
    """List the pairs of tiles and spheres that intersect, nearest first within a tile.

    A sphere intersects a tile if the cone around it (`ViewCones`) intersects the cone around the tile. Blocks of tiles
    are tested first, then their tiles.

    Args:
        local: Centres [m], camera frames, shape (C, N, 3).
        scales: Standard deviations [m], shape (N,).
        opacities: Peak alphas, shape (N,).
        tiles: The tiles.
        min_alpha: Threshold below which an alpha counts as 0; with 0 every sphere meets every tile.

    Returns:
        Tile number (camera * tiles + tile), camera and sphere of each pair, three arrays (M,).
    """
    cones = ViewCones.of(local, scales, opacities, min_alpha)
    axes = tiles.rotations[:, 2].reshape(-1, tiles.rows, tiles.columns, 3)
    half = tiles.half_angle.reshape(-1, tiles.rows, tiles.columns)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for camera in range(local.shape[0]):
        ranked = cones.order[camera, : int(cones.drawn[camera])]
        group = int(tiles.group[camera])
        tile, position = _meet(axes[group], half[group], cones.direction[camera, ranked], cones.half[camera, ranked])
        found.append((tile + camera * tiles.count, torch.full_like(tile, camera), ranked[position]))
    tile_ids, cameras, spheres = (torch.cat(parts) for parts in zip(*found, strict=True))
    return tile_ids, cameras, spheres


def _meet(axes: Tensor, half: Tensor, direction: Tensor, cone: Tensor) -> tuple[Tensor, Tensor]:
    """Return tile and sphere of every intersection of cones for one camera, spheres in ascending order within a tile.

    Args:
        axes: Tile axes, shape (rows, columns, 3).
        half: Tile half angles [rad], shape (rows, columns).
        direction: Unit vectors to the spheres, camera frame, shape (n, 3), nearest first.
        cone: Half angles of the spheres [rad], shape (n,).
    """
    rows, columns = half.shape
    tile_index = torch.arange(rows * columns, device=half.device).reshape(rows, columns)
    pad = (0, -columns % _BLOCK, 0, -rows % _BLOCK)
    blocks = torch.nn.functional.pad(tile_index, pad, value=-1)
    block_rows, block_columns = blocks.shape[0] // _BLOCK, blocks.shape[1] // _BLOCK
    blocks = blocks.reshape(block_rows, _BLOCK, block_columns, _BLOCK).transpose(1, 2).reshape(-1, _BLOCK**2)
    valid = blocks >= 0
    members = blocks.clamp_min(0)
    flat_axes, flat_half = axes.reshape(-1, 3), half.reshape(-1)
    block_axes = torch.nn.functional.normalize((flat_axes[members] * valid[..., None]).sum(1), dim=1)
    apart = _angle((flat_axes[members] * block_axes[:, None]).sum(-1)) + flat_half[members]
    block_half = torch.where(valid, apart, 0.0).amax(1)
    near = _angle(block_axes @ direction.T) <= block_half[:, None] + cone
    found: list[tuple[Tensor, Tensor]] = []
    for block, spheres in enumerate(near):
        chosen, tiles = spheres.nonzero()[:, 0], members[block, valid[block]]
        tile, place = _cones_meet(flat_axes[tiles], flat_half[tiles], direction[chosen], cone[chosen])
        found.append((tiles[tile], chosen[place]))
    tile_ids, spheres = (torch.cat(parts) for parts in zip(*found, strict=True))
    return tile_ids, spheres


def _cones_meet(axes: Tensor, half: Tensor, direction: Tensor, cone: Tensor) -> tuple[Tensor, Tensor]:
    """Return the intersecting cones, given axes (t, 3) and (n, 3) and half angles (t,) and (n,) up to pi.

    Cosines are compared, not angles: cos a >= cos(b + c) where b + c stays within pi.
    """
    limit = half.cos()[:, None] * cone.cos() - half.sin()[:, None] * cone.sin()
    limit = limit - 8 * torch.finfo(limit.dtype).eps  # culling must not lose visible spheres
    meets = (axes @ direction.T >= limit) | (half[:, None] + cone >= math.pi)
    tile, place = meets.nonzero(as_tuple=True)
    return tile, place


def _angle(cosine: Tensor) -> Tensor:
    """Return the angle [rad], rounded down, so that culling loses no visible sphere."""
    slack = 4 * torch.finfo(cosine.dtype).eps
    return torch.acos((cosine + slack).clamp(-1.0, 1.0))
