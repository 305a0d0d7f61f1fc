"""The renderer's CUDA kernels in plain torch: each reads and writes what its source in `rendering/cuda/` says.

With them the sequence of kernels in `rasterize` runs without a GPU, so that what it hands to each kernel is tested
where no CUDA device is. `launch` takes the place of `cuda_kernels.launch`, and is strict: tensors are contiguous, sizes
are those that the kernel is told, and blocks beyond the work are an error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from cgwm.pipeline.rendering.cuda_kernels import BACKWARD_THREADS, CHANNELS, TILE, gradient_width
from cgwm.pipeline.rendering.rays import LEAST_DETERMINANT, UNDISTORT_STEPS, undistort
from torch import Tensor

MAX_ALPHA = 0.99


def launch(
    name: str,
    device: torch.device,
    count: int,
    tensors: tuple[Tensor | None, ...],
    numbers: tuple[int | float, ...],
    **defines: int,
) -> None:
    """Run a kernel, see `cuda_kernels.launch`."""
    assert all(value is None or (value.is_contiguous() and value.device == device) for value in tensors)
    with torch.no_grad():
        KERNELS[name](count, tensors, numbers, defines)


def _ranges(span: Tensor, camera: int, grid: tuple[int, int], rays: tuple[Tensor | None, ...]) -> list[range]:
    """Return the columns and the rows of the tiles that a bound covers."""
    found = []
    for low, high, bounds, (least, most), count in (
        (span[0], span[2], rays[1], (0, 2), grid[0]),
        (span[1], span[3], rays[2], (1, 3), grid[1]),
    ):
        if bounds is None:
            first, last = max(math.floor(float(low) / TILE), 0), min(math.floor(float(high) / TILE) + 1, count)
            found.append(range(first, max(last, first)))
        else:
            assert bounds.shape[1] == count
            mine = bounds[camera]
            inside = torch.nonzero((mine[:, least] <= high) & (-mine[:, most] >= low))[:, 0].tolist()
            found.append(range(inside[0], inside[-1] + 1) if inside else range(0))
    return found


def _tiles(span: Tensor, camera: int, grid: tuple[int, int], rays: tuple[Tensor | None, ...]) -> Iterator[int]:
    """Yield the tiles, over all cameras, that a bound reaches."""
    columns, rows = _ranges(span, camera, grid, rays)
    for row in rows:
        for column in columns:
            if rays[0] is not None:
                x0, y0, x1, y1 = rays[0][camera, row, column].tolist()
                if not (x0 <= span[2] and -x1 >= span[0] and y0 <= span[3] and -y1 >= span[1]):
                    continue
            yield (camera * grid[1] + row) * grid[0] + column


def _tangents(x: float, z: float, reach: float) -> tuple[float, float]:
    """Return the bounds of x / z of the rays that pass a centre at a distance of at most `reach`."""
    if z <= reach:
        return -math.inf, math.inf
    middle, half = math.atan2(x, z), math.asin(reach / math.hypot(x, z))
    low, high = middle - half, middle + half
    return (-math.inf if low <= -math.pi / 2 else math.tan(low)), (math.inf if high >= math.pi / 2 else math.tan(high))


def _project(threads: int, tensors: Any, numbers: Any, defines: dict[str, int]) -> None:
    means, scales, opacities, viewmats, Ks, *bounds, centres, log_opacities, distances, spans, counts = tensors
    cameras, total, columns, rows, by_camera, min_alpha = numbers
    assert (
        threads == cameras * total and defines == {"RAYS": int(bounds[0] is not None)} and isinstance(min_alpha, float)
    )
    assert bool(by_camera) == (means.dim() == 3)
    for place in range(threads):
        camera, n = divmod(place, total)
        mean = means[camera, n] if by_camera else means[n]
        local = viewmats[camera, :3, :3] @ mean + viewmats[camera, :3, 3]
        x, y, z = local.tolist()
        scale, opacity = float(scales[n]), float(opacities[n])
        log_opacities[n] = math.log(max(opacity, 1e-12))
        centres[camera, n] = torch.tensor([x, y, z, -0.5 / scale**2])
        distances[place], counts[place] = math.inf, 0
        drawn = z > scale and opacity > min_alpha and math.isfinite(x + y + z)
        if not drawn:
            continue
        reach = scale * math.sqrt(max(2 * math.log(opacity / min_alpha), 0.0)) if min_alpha > 0 else 1e4 * scale
        across, down = _tangents(x, z, 1.0001 * reach), _tangents(y, z, 1.0001 * reach)
        if bounds[0] is None:
            fx, fy, cx, cy = (float(Ks[camera][at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
            sides = (
                across[0] * fx + cx - 0.5,
                down[0] * fy + cy - 0.5,
                across[1] * fx + cx + 0.5,
                down[1] * fy + cy + 0.5,
            )
            sides = tuple(min(max(side, -1e6), 1e6) for side in sides)
        else:
            sides = (across[0] - 1e-4, down[0] - 1e-4, across[1] + 1e-4, down[1] + 1e-4)
        spans[place] = torch.tensor(sides)
        counts[place] = sum(1 for _ in _tiles(spans[place], camera, (columns, rows), bounds))
        if counts[place]:
            distances[place] = local.norm()


def _emit(threads: int, tensors: Any, numbers: Any, defines: dict[str, int]) -> None:
    order, ends, spans, *bounds, keys, places = tensors
    total, each, capacity, columns, rows, wide = numbers
    assert threads == total == len(order) and len(keys) == len(places) == capacity
    assert defines == {"RAYS": int(bounds[0] is not None)} and keys.dtype == (torch.int32 if wide else torch.int16)
    assert ends.dtype == places.dtype == torch.int32
    for k, row in enumerate(order.tolist()):
        place, end = (int(ends[k - 1]) if k else 0), int(ends[k])
        tiles = list(_tiles(spans[row], row // each, (columns, rows), bounds)) if end > place else []
        assert len(tiles) == end - place
        for tile in tiles:
            if place < capacity:
                keys[place], places[place] = tile, row
            place += 1


def _pixels(
    tile: int, Ks: Tensor, rays: Tensor | None, size: tuple[int, int, int, int]
) -> tuple[int, Tensor, Tensor, Tensor]:
    """Return camera, rows, columns and rays (P, 2) of the pixels of a tile that are in the picture."""
    columns, tile_rows, width, height = size
    camera, within = divmod(tile, columns * tile_rows)
    v, u = torch.meshgrid(
        torch.arange(within // columns * TILE, min((within // columns + 1) * TILE, height)),
        torch.arange(within % columns * TILE, min((within % columns + 1) * TILE, width)),
        indexing="ij",
    )
    v, u = v.flatten(), u.flatten()
    if rays is not None:
        return camera, v, u, rays[camera, v, u].double()
    K = Ks[camera].double()
    return camera, v, u, torch.stack([(u + 0.5 - K[0, 2]) / K[0, 0], (v + 0.5 - K[1, 2]) / K[1, 1]], -1).double()


def _composited(
    points: Tensor, k: Tensor, log_opacity: Tensor, features: Tensor, at: Tensor, thresholds: tuple[float, float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return features (P, F), light that is left (P,), depth times alpha and median depth of a list of spheres (n)."""
    left = torch.ones(len(at), dtype=torch.float64)
    depth, median = torch.zeros_like(left), torch.zeros_like(left)
    out = torch.zeros(len(at), features.shape[-1], dtype=torch.float64)
    ray = torch.cat([at, torch.ones(len(at), 1)], 1).double()
    for point, own, opacity, feature in zip(points, k, log_opacity, features, strict=True):
        if float(left.detach().max()) <= thresholds[1]:
            break
        square = torch.linalg.cross(point.expand_as(ray), ray).square().sum(-1) / ray.square().sum(-1)
        raw = torch.exp(opacity + own * square)
        alpha = torch.where(raw >= thresholds[0], raw.clamp_max(MAX_ALPHA), 0.0)
        weight = alpha * left
        after = left - weight
        median = torch.where((left > 0.5) & (after <= 0.5), point[2].detach(), median)
        out, depth, left = out + weight[:, None] * feature, depth + weight * point[2], after
    return out, left, depth, median


def _rows(lists: tuple[Tensor, ...], tile: int) -> Tensor:
    return lists[4][int(lists[5][tile]) : int(lists[5][tile + 1])].long()


def _forward(blocks: int, tensors: Any, numbers: Any, defines: dict[str, int]) -> None:
    centres, log_opacities, _, features, _, starts, Ks, rays, out, out_left, out_depth, out_median = tensors
    each, columns, tile_rows, width, height, *thresholds = numbers
    first, count = defines["FIRST"], defines["COUNT"]
    assert blocks == len(Ks) * columns * tile_rows == len(starts) - 1 and (rays is not None) == bool(defines["RAYS"])
    assert defines["F"] == features.shape[-1] and 0 < count <= CHANNELS and defines["BY_CAMERA"] == features.dim() - 2
    assert columns == -(-width // TILE) and tile_rows == -(-height // TILE)
    for tile in range(blocks):
        camera, v, u, at = _pixels(tile, Ks, rays, (columns, tile_rows, width, height))
        rows = _rows(tensors, tile)
        point, sphere = centres.flatten(0, 1)[rows].double(), rows % each
        colour = features.flatten(0, 1)[rows] if defines["BY_CAMERA"] else features[sphere]
        some = colour[:, first : first + count].double()
        found = _composited(point[:, :3], point[:, 3], log_opacities[sphere].double(), some, at, tuple(thresholds))
        out[camera, v, u, first : first + count] = found[0].to(out)
        if first == 0:
            for target, value in zip((out_left, out_depth, out_median), found[1:], strict=True):
                target[camera, v, u] = value.to(target)


def _backward(blocks: int, tensors: Any, numbers: Any, defines: dict[str, int]) -> None:
    centres, log_opacities, _, features, _, starts, Ks, rays, out, left, _, *by, gradients = tensors
    each, columns, tile_rows, width, height, *thresholds = numbers
    width_of_rows = gradient_width(features.shape[-1])
    assert gradients.shape == (len(Ks), each, width_of_rows) and not gradients.any() and features.dim() == 2
    assert blocks == len(Ks) * columns * tile_rows == len(starts) - 1 and (rays is not None) == bool(defines["RAYS"])
    assert (defines["F"], defines["FIRST"], defines["BY_CAMERA"]) == (features.shape[-1], 0, 0)
    assert 0 < defines["COUNT"] <= CHANNELS and out.shape[:3] == left.shape
    for tile in range(blocks):
        camera, v, u, at = _pixels(tile, Ks, rays, (columns, tile_rows, width, height))
        rows = _rows(tensors, tile)
        point, sphere = centres.flatten(0, 1)[rows].double(), rows % each
        leaves = [point[:, :3], point[:, 3], log_opacities[sphere].double(), features[sphere].double()]
        leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
        with torch.enable_grad():
            found = _composited(*leaves, at, tuple(thresholds))  # type: ignore[arg-type]
            asked = [value[camera, v, u].double() for value in by]
            loss = (found[0] * asked[0]).sum() + ((1 - found[1]) * asked[1]).sum() + (found[2] * asked[2]).sum()
            slopes = torch.autograd.grad(loss, leaves, allow_unused=True) if len(rows) else [None] * 4
        if not len(rows):
            continue
        known = [torch.zeros_like(leaf) if slope is None else slope for leaf, slope in zip(leaves, slopes, strict=True)]
        flat = torch.cat([known[0], known[1][:, None], known[2][:, None], known[3]], 1)
        gradients.flatten(0, 1)[:, : flat.shape[1]].index_add_(0, rows, flat.to(gradients))


def _project_backward(blocks: int, tensors: Any, numbers: Any, defines: dict[str, int]) -> None:
    gradients, viewmats, scales, opacities, by_means, by_scales, by_opacities, by_features = tensors
    cameras, each, by_camera = numbers
    group = defines["GROUP"]
    spheres = BACKWARD_THREADS // group
    assert group & (group - 1) == 0 and min(cameras, 16) <= group <= 16 and group < 2 * cameras
    assert 0 <= blocks * spheres - each < spheres and defines["F"] == by_features.shape[1]
    assert gradients.shape[:2] == (cameras, each) and by_means.dim() == 2 + by_camera
    means = torch.einsum("cji,cnj->cni", viewmats[:, :3, :3].double(), gradients[..., :3].double())
    by_means.copy_(means if by_camera else means.sum(0))
    sums = gradients.double().sum(0)
    by_scales.copy_(sums[:, 3] / scales.double() ** 3)
    by_opacities.copy_(torch.where(opacities > 1e-12, sums[:, 4] / opacities.double(), 0.0))
    by_features.copy_(sums[:, 5 : 5 + by_features.shape[1]])


def _trace(blocks: int, tensors: Any, numbers: Any, defines: dict[str, int]) -> None:
    Ks, distortion, rays, bounds = tensors
    columns, tile_rows, width, height, terms, steps, least = numbers
    assert blocks == len(Ks) * columns * tile_rows and not defines and rays.shape == (len(Ks), height, width, 2)
    assert distortion.shape == (len(Ks), terms) and (steps, least) == (UNDISTORT_STEPS, LEAST_DETERMINANT)
    assert bounds.shape == (len(Ks), tile_rows, columns, 4) and isinstance(least, float)
    for tile in range(blocks):
        camera, v, u, at = _pixels(tile, Ks, None, (columns, tile_rows, width, height))
        found = undistort(at[None], distortion[[camera]].double())[0].to(rays)
        rays[camera, v, u] = found
        least_of = torch.cat([found.amin(0), (-found).amin(0)])
        bounds.flatten(0, 2)[tile] = least_of


KERNELS = {
    "project": _project,
    "emit": _emit,
    "composite_forward": _forward,
    "composite_backward": _backward,
    "project_backward": _project_backward,
    "trace": _trace,
}
