"""Rendering in tiles in torch: the spheres of each tile, and their coefficients in its frame, for compositing."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from .composite_reference import TileLists, composite
from .tiles import TiledImages, TiledScene, tile_pairs


def draw(scene: TiledScene) -> TiledImages:
    """Draw a scene by operations of torch."""
    local, scales, opacities, features = scene.local, scene.scales, scene.opacities, scene.features
    tiles, camera_count = scene.tiles, local.shape[0]
    with torch.no_grad():
        tile_ids, cameras, spheres = tile_pairs(local, scales, opacities, tiles, scene.min_alpha)
        counts = torch.bincount(tile_ids, minlength=tiles.count * camera_count)
    order = torch.argsort(tile_ids, stable=True)
    tile_ids, cameras, spheres = tile_ids[order], cameras[order], spheres[order]
    flat = cameras * scales.shape[0] + spheres
    centres = local.reshape(-1, 3).index_select(0, flat)
    frame = tiles.frame_of(tile_ids)
    coefficients = _coefficients(
        (tiles.rotations[frame] @ centres[:, :, None])[:, :, 0],
        scales.index_select(0, spheres),
        opacities.index_select(0, spheres),
    )
    seen = features.index_select(0, spheres) if features.dim() == 2 else features.flatten(0, 1).index_select(0, flat)
    channels = torch.cat([seen, centres[:, 2:]], 1)
    every_tile = torch.arange(counts.shape[0], device=local.device)
    lists = TileLists(
        basis=tiles.basis,
        frame=tiles.frame_of(every_tile),
        starts=counts.cumsum(0) - counts,
        counts=counts,
        min_alpha=scene.min_alpha,
        min_transmittance=scene.min_transmittance,
    )
    values, alpha, middle = composite(coefficients, channels, lists, scene.median)
    alone = None
    if scene.groups:
        with torch.no_grad():
            single = replace(lists, min_transmittance=scene.group_transmittance)
            members = [(spheres >= group.start) & (spheres < group.stop) for group in scene.groups]
            alone = torch.stack([_alone(coefficients, tile_ids, chosen, single) for chosen in members], 2)
    return TiledImages(values=values, alpha=alpha, median=middle, alone=alone)


def _alone(coefficients: Tensor, tile_ids: Tensor, chosen: Tensor, lists: TileLists) -> Tensor:
    """Return the alpha (T, P) of a subset of the pairs, as if the other pairs did not exist."""
    counts = torch.bincount(tile_ids[chosen], minlength=lists.counts.shape[0])
    subset = replace(lists, starts=counts.cumsum(0) - counts, counts=counts)
    return composite(coefficients[chosen], coefficients[chosen, :1], subset)[1]


def _coefficients(centres: Tensor, scales: Tensor, opacities: Tensor) -> Tensor:
    """Return the exponent's coefficients of (1, x, y, x^2, xy, y^2) / (1 + x^2 + y^2), shape (M, 6).

    The logarithm of the opacity is added to the coefficients of 1, x^2 and y^2, whose quotients sum to 1.
    """
    px, py, pz = centres.unbind(1)
    k = -0.5 / (scales * scales)
    log_opacity = opacities.clamp_min(1e-12).log()
    kx, ky, kz = k * px, k * py, k * pz
    xx, yy, zz = kx * px, ky * py, kz * pz
    return torch.stack(
        [
            xx + yy + log_opacity,
            -2 * kx * pz,
            -2 * ky * pz,
            zz + yy + log_opacity,
            -2 * kx * py,
            zz + xx + log_opacity,
        ],
        1,
    )
