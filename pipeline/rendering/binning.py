"""Triton kernels that assign spheres to tiles: projection, its derivative, and pairs of tiles and spheres.

The bound of a sphere is a rectangle: of pixels for a pinhole camera, of x and y on the plane z = 1 for a distorting
one. The latter is compared with the bounds of the rays of each tile: no point is distorted, since the distortion folds
back outside of the image.
"""

# pyright: reportGeneralTypeIssues=false
# (The language of the kernels is Triton's; what looks like its functions raises outside of a kernel.)

from __future__ import annotations

import triton
import triton.language as tl

PROJECT_BLOCK = 256
"""Number of spheres per program of `project`."""
EMIT_BLOCK = 128
"""Number of spheres per program of `emit`."""


@triton.jit
def _tangents(x, z, reach):
    """Return the minimum and maximum x / z of the rays that pass a centre within the reach, in the xz plane."""
    front = z * z - reach * reach
    wide = (z <= reach) | (front <= 0)
    front = tl.where(wide, 1.0, front)
    root = reach * tl.sqrt(tl.maximum(x * x + front, 0.0))
    # The product of the two is (x^2 - reach^2) / front, so that neither has to be a difference of nearly equal numbers.
    numerator = x * z + tl.where(x < 0, -root, root)
    one, other = numerator / front, (x * x - reach * reach) / numerator
    infinity = float("inf")
    return tl.where(wide, -infinity, tl.minimum(one, other)), tl.where(wide, infinity, tl.maximum(one, other))


@triton.jit
def _range(low, high, COUNT, TILE: tl.constexpr):
    """Return the first tile from low to high [px], and the number of tiles."""
    first = tl.maximum(tl.floor(low / TILE), 0.0).to(tl.int32)
    return first, tl.maximum(tl.minimum(tl.floor(high / TILE).to(tl.int32) + 1, COUNT) - first, 0)


@triton.jit
def _range_of_rays(low, high, bounds, COUNT):
    """Return the first column (or row) of tiles with rays from low to high, and the number up to the last one.

    Reads bounds (COUNT, 4): the minimum coordinate of a column's rays, and two places further minus the maximum.
    """
    first = tl.full(low.shape, 0, tl.int32) + COUNT
    last = tl.full(low.shape, -1, tl.int32)
    k = 0
    while k < COUNT:
        met = (tl.load(bounds + k * 4) <= high) & (-tl.load(bounds + k * 4 + 2) >= low)
        first = tl.where(met, tl.minimum(first, k), first)
        last = tl.where(met, k, last)
        k += 1
    return first, tl.maximum(last - first + 1, 0)


@triton.jit
def _rectangle(left, top, right, bottom, camera, column_bounds, row_bounds, COLUMNS, ROWS, TILE: tl.constexpr):
    """Return the tiles that cover a span: first column, number of columns, first row, number of rows."""
    if column_bounds is None:
        first_column, columns = _range(left, right, COLUMNS, TILE)
        first_row, rows = _range(top, bottom, ROWS, TILE)
    else:
        first_column, columns = _range_of_rays(left, right, column_bounds + camera * COLUMNS * 4, COLUMNS)
        first_row, rows = _range_of_rays(top, bottom, row_bounds + camera * ROWS * 4 + 1, ROWS)
    return first_column, columns, first_row, rows


@triton.jit
def _meets(left, top, right, bottom, bounds, tile, active):
    """Return which spans meet the rays of their tiles; bounds (tiles, 4): minimum x and y, minus maximum x and y."""
    at = bounds + tile * 4
    met = (tl.load(at, mask=active, other=0.0) <= right) & (-tl.load(at + 2, mask=active, other=0.0) >= left)
    met &= (tl.load(at + 1, mask=active, other=0.0) <= bottom) & (-tl.load(at + 3, mask=active, other=0.0) >= top)
    return active & met


@triton.jit
def project(  # noqa: PLR0915
    means, scales, opacities, viewmats, Ks, tile_bounds, column_bounds, row_bounds,
    centres, log_opacities, distances, spans, counts,
    N, WIDTH, HEIGHT, COLUMNS, ROWS, min_alpha,
    PER_CAMERA: tl.constexpr, HAS_LEAST: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Transform spheres into camera frames, and count the tiles that each can reach.

    Reads the bounds of `triton_kernels.trace` of each tile, of each column and of each row of tiles; None for pinhole
    cameras. Writes centres (C, N, 4): x, y, z [m] and -1 / (2 s^2); log_opacities (N,); distances (C, N), inf where a
    sphere is not drawn; spans (C, N, 4): left, top, right, bottom of its bound, in pixels, or on z = 1 with bounds;
    counts (C, N) of tiles.
    """
    camera = tl.program_id(0)
    n = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = n < N
    view = viewmats + camera * 16
    source = means + (camera * N + n if PER_CAMERA else n) * 3
    wx = tl.load(source, mask=inside, other=0.0)
    wy = tl.load(source + 1, mask=inside, other=0.0)
    wz = tl.load(source + 2, mask=inside, other=0.0)
    x = tl.load(view) * wx + tl.load(view + 1) * wy + tl.load(view + 2) * wz + tl.load(view + 3)
    y = tl.load(view + 4) * wx + tl.load(view + 5) * wy + tl.load(view + 6) * wz + tl.load(view + 7)
    z = tl.load(view + 8) * wx + tl.load(view + 9) * wy + tl.load(view + 10) * wz + tl.load(view + 11)
    s = tl.load(scales + n, mask=inside, other=1.0)
    opacity = tl.load(opacities + n, mask=inside, other=0.0)
    distance = tl.sqrt(x * x + y * y + z * z)
    log_opacity = tl.log(tl.maximum(opacity, 1e-12))
    if HAS_LEAST:
        reach = s * tl.sqrt(tl.maximum(2 * (log_opacity - tl.log(min_alpha)), 0.0))
    else:
        reach = s * 1e4
    reach = reach * 1.0001 + 1e-9  # rounding must not lose visible spheres
    # (comparisons with NaN are false, so spheres at undefined positions are not drawn)
    drawn = inside & (z > s) & (opacity > min_alpha) & (distance < 1e30)
    left, right = _tangents(x, z, reach)
    top, bottom = _tangents(y, z, reach)
    if tile_bounds is None:
        K = Ks + camera * 9
        fx, cx, fy, cy = tl.load(K), tl.load(K + 2), tl.load(K + 4), tl.load(K + 5)
        left = tl.minimum(tl.maximum(left * fx + cx - 0.5, -1e6), 1e6)
        right = tl.minimum(tl.maximum(right * fx + cx + 0.5, -1e6), 1e6)
        top = tl.minimum(tl.maximum(top * fy + cy - 0.5, -1e6), 1e6)
        bottom = tl.minimum(tl.maximum(bottom * fy + cy + 0.5, -1e6), 1e6)
    else:
        left -= 1e-5 * (1 + tl.abs(left))
        right += 1e-5 * (1 + tl.abs(right))
        top -= 1e-5 * (1 + tl.abs(top))
        bottom += 1e-5 * (1 + tl.abs(bottom))
    first_column, columns, first_row, rows = _rectangle(
        left, top, right, bottom, camera, column_bounds, row_bounds, COLUMNS, ROWS, TILE
    )
    count = tl.where(drawn, columns * rows, 0)
    if tile_bounds is not None:
        candidates, most = count, tl.max(count, 0)
        count = tl.full((BLOCK,), 0, tl.int32)
        columns = tl.maximum(columns, 1)
        j = 0
        while j < most:
            tile = (camera * ROWS + first_row + j // columns) * COLUMNS + first_column + j % columns
            count += _meets(left, top, right, bottom, tile_bounds, tile, j < candidates).to(tl.int32)
            j += 1
    row = camera * N + n
    tl.store(centres + row * 4, x, mask=inside)
    tl.store(centres + row * 4 + 1, y, mask=inside)
    tl.store(centres + row * 4 + 2, z, mask=inside)
    tl.store(centres + row * 4 + 3, -0.5 / (s * s), mask=inside)
    tl.store(spans + row * 4, left, mask=inside)
    tl.store(spans + row * 4 + 1, top, mask=inside)
    tl.store(spans + row * 4 + 2, right, mask=inside)
    tl.store(spans + row * 4 + 3, bottom, mask=inside)
    tl.store(distances + row, tl.where(count > 0, distance, float("inf")), mask=inside)
    tl.store(counts + row, count, mask=inside)
    tl.store(log_opacities + n, log_opacity, mask=inside & (camera == 0))


@triton.jit
def emit(
    order, ends, spans, tile_bounds, column_bounds, row_bounds, keys, rows,
    TOTAL, N, CAPACITY, COLUMNS, ROWS, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write a pair of tile key and sphere row for every tile that a sphere can reach, nearest spheres first.

    Reads order: rows (camera * N + sphere) by distance, int64 (TOTAL,); ends: the running sum of the tile counts in
    that order; spans and bounds: as in `project`. Writes (CAPACITY,) keys: camera * tiles + tile; and rows.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = k < TOTAL
    row = tl.load(order + k, mask=inside, other=0)
    end = tl.load(ends + k, mask=inside, other=0)
    place = tl.load(ends + k - 1, mask=inside & (k > 0), other=0)
    left = tl.load(spans + row * 4, mask=inside, other=0.0)
    top = tl.load(spans + row * 4 + 1, mask=inside, other=0.0)
    right = tl.load(spans + row * 4 + 2, mask=inside, other=0.0)
    bottom = tl.load(spans + row * 4 + 3, mask=inside, other=0.0)
    camera = (row // N).to(tl.int32)
    first_column, columns, first_row, tile_rows = _rectangle(
        left, top, right, bottom, camera, column_bounds, row_bounds, COLUMNS, ROWS, TILE
    )
    candidates = end - place
    if tile_bounds is not None:
        candidates = tl.where(candidates > 0, columns * tile_rows, 0)
    columns = tl.maximum(columns, 1)
    base = camera * (COLUMNS * ROWS)
    most = tl.max(candidates, 0)
    j = 0
    while j < most:
        active = inside & (j < candidates)
        key = base + (first_row + j // columns) * COLUMNS + first_column + j % columns
        if tile_bounds is not None:
            active = _meets(left, top, right, bottom, tile_bounds, key, active)
        kept = active & (place < CAPACITY)
        tl.store(keys + place, key.to(keys.dtype.element_ty), mask=kept)
        tl.store(rows + place, row.to(tl.int32), mask=kept)
        place += active.to(tl.int32)
        j += 1


@triton.jit
def _summed(gradients, column, n, inside, CAMERAS, N, WIDE: tl.constexpr, GROUP: tl.constexpr):
    """Return one column of the rows of gradients (C, N, WIDE), summed over cameras."""
    total = tl.zeros(n.shape, tl.float32)
    camera = tl.arange(0, GROUP)
    first = 0
    while first < CAMERAS:
        place = ((first + camera)[:, None].to(tl.int64) * N + n[None, :]) * WIDE + column
        valid = (first + camera < CAMERAS)[:, None] & inside[None, :]
        total += tl.sum(tl.load(gradients + place, mask=valid, other=0.0), 0)
        first += GROUP
    return total


@triton.jit
def project_backward(
    gradients, viewmats, scales, opacities, by_means, by_scales, by_opacities, by_features, CAMERAS, N,
    F: tl.constexpr, WIDE: tl.constexpr, PER_CAMERA: tl.constexpr, GROUP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Convert derivatives by centres in camera frames, k, log opacities and features to those by the inputs.

    Reads the rows (C, N, WIDE) of `composite_backward`, GROUP cameras at a time. Writes by_means (N, 3), or
    (C, N, 3) where they differ by camera; by_scales (N,); by_opacities (N,); by_features (N, F).
    """
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = n < N
    camera = tl.arange(0, GROUP)
    sum_x, sum_y, sum_z = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    first = 0
    while first < CAMERAS:
        there = first + camera < CAMERAS
        valid = there[:, None] & inside[None, :]
        row = (first + camera)[:, None].to(tl.int64) * N + n[None, :]
        x = tl.load(gradients + row * WIDE, mask=valid, other=0.0)
        y = tl.load(gradients + row * WIDE + 1, mask=valid, other=0.0)
        z = tl.load(gradients + row * WIDE + 2, mask=valid, other=0.0)
        view = viewmats + (first + camera) * 16
        xx, xy, xz = tl.load(view, there, 0.0), tl.load(view + 1, there, 0.0), tl.load(view + 2, there, 0.0)
        yx, yy, yz = tl.load(view + 4, there, 0.0), tl.load(view + 5, there, 0.0), tl.load(view + 6, there, 0.0)
        zx, zy, zz = tl.load(view + 8, there, 0.0), tl.load(view + 9, there, 0.0), tl.load(view + 10, there, 0.0)
        by_x = xx[:, None] * x + yx[:, None] * y + zx[:, None] * z
        by_y = xy[:, None] * x + yy[:, None] * y + zy[:, None] * z
        by_z = xz[:, None] * x + yz[:, None] * y + zz[:, None] * z
        if PER_CAMERA:
            tl.store(by_means + row * 3, by_x, mask=valid)
            tl.store(by_means + row * 3 + 1, by_y, mask=valid)
            tl.store(by_means + row * 3 + 2, by_z, mask=valid)
        else:
            sum_x += tl.sum(by_x, 0)
            sum_y += tl.sum(by_y, 0)
            sum_z += tl.sum(by_z, 0)
        first += GROUP
    if not PER_CAMERA:
        tl.store(by_means + n * 3, sum_x, mask=inside)
        tl.store(by_means + n * 3 + 1, sum_y, mask=inside)
        tl.store(by_means + n * 3 + 2, sum_z, mask=inside)
    s = tl.load(scales + n, mask=inside, other=1.0)
    opacity = tl.load(opacities + n, mask=inside, other=1.0)
    by_k = _summed(gradients, 3, n, inside, CAMERAS, N, WIDE, GROUP)
    by_log = _summed(gradients, 4, n, inside, CAMERAS, N, WIDE, GROUP)
    tl.store(by_scales + n, by_k / (s * s * s), mask=inside)
    tl.store(by_opacities + n, tl.where(opacity > 1e-12, by_log / opacity, 0.0), mask=inside)
    for f in range(F):
        by_feature = _summed(gradients, 5 + f, n, inside, CAMERAS, N, WIDE, GROUP)
        tl.store(by_features + n * F + f, by_feature, mask=inside)
