"""Triton kernels of the renderer: projection, binning, compositing and its derivative. CUDA, float32.

The torch path in `render` is their twin; `rasterize` puts them together.
"""

# pyright: reportGeneralTypeIssues=false
# (The language of the kernels is Triton's; what looks like its functions raises outside of a kernel.)

from __future__ import annotations

import triton
import triton.language as tl

PROJECT_BLOCK = 256
EMIT_BLOCK = 128


@triton.jit
def _multiply(a, b):
    return a * b


@triton.jit
def _add(a, b):
    return a + b


@triton.jit
def _range(low, high, COUNT, TILE: tl.constexpr):
    """Return the first tile from low to high [px], and how many of them."""
    first = tl.maximum(tl.floor(low / TILE), 0.0).to(tl.int32)
    return first, tl.maximum(tl.minimum(tl.floor(high / TILE).to(tl.int32) + 1, COUNT) - first, 0)


@triton.jit
def project(  # noqa: PLR0915
    means, scales, opacities, viewmats, Ks, centres, log_opacities, distances, spans, counts,
    N, WIDTH, HEIGHT, COLUMNS, ROWS, min_alpha,
    PER_CAMERA: tl.constexpr, HAS_LEAST: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Move spheres into camera frames, and find the tiles that each can reach.

    Writes centres (C, N, 4): x, y, z [m] and -1 / (2 s^2); log_opacities (N,); distances (C, N), inf where a sphere
    is not drawn; spans (C, N, 4): left, top, right, bottom of what it reaches [px]; counts (C, N) of tiles.
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
    reach = reach * 1.0001 + 1e-9  # rounding must not lose what is visible
    drawn = inside & (z > s) & (opacity > min_alpha) & (distance < 1e30)
    K = Ks + camera * 9
    fx, cx, fy, cy = tl.load(K), tl.load(K + 2), tl.load(K + 4), tl.load(K + 5)
    # The rays that pass a centre within the reach lie between two tangents, in the xz plane and in the yz plane.
    front = z * z - reach * reach
    wide = (z <= reach) | (front <= 0)
    front = tl.where(wide, 1.0, front)
    root_x = reach * tl.sqrt(tl.maximum(x * x + front, 0.0))
    root_y = reach * tl.sqrt(tl.maximum(y * y + front, 0.0))
    left = (x * z - root_x) / front * fx + cx
    right = (x * z + root_x) / front * fx + cx
    top = (y * z - root_y) / front * fy + cy
    bottom = (y * z + root_y) / front * fy + cy
    left = tl.where(wide, 0.0, tl.minimum(tl.maximum(left - 0.5, -1e6), 1e6))
    right = tl.where(wide, WIDTH, tl.minimum(tl.maximum(right + 0.5, -1e6), 1e6))
    top = tl.where(wide, 0.0, tl.minimum(tl.maximum(top - 0.5, -1e6), 1e6))
    bottom = tl.where(wide, HEIGHT, tl.minimum(tl.maximum(bottom + 0.5, -1e6), 1e6))
    _, columns = _range(left, right, COLUMNS, TILE)
    _, rows = _range(top, bottom, ROWS, TILE)
    count = tl.where(drawn, columns * rows, 0)
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
    order, ends, spans, keys, rows, TOTAL, N, CAPACITY, COLUMNS, ROWS, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write a pair of tile key and sphere row for every tile that a sphere can reach, spheres nearest first.

    Reads order: rows (camera * N + sphere) by distance, int64 (TOTAL,); ends: the running sum of the tile counts in
    that order; spans: as `project` writes them. Writes (CAPACITY,) keys: camera * tiles + tile; and rows.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = k < TOTAL
    row = tl.load(order + k, mask=inside, other=0)
    end = tl.load(ends + k, mask=inside, other=0)
    left = tl.load(spans + row * 4, mask=inside, other=0.0)
    top = tl.load(spans + row * 4 + 1, mask=inside, other=0.0)
    right = tl.load(spans + row * 4 + 2, mask=inside, other=0.0)
    first_column, columns = _range(left, right, COLUMNS, TILE)
    first_row = tl.maximum(tl.floor(top / TILE), 0.0).to(tl.int32)
    start = tl.load(ends + k - 1, mask=inside & (k > 0), other=0)
    count = end - start
    camera = (row // N).to(tl.int32)
    base = camera * (COLUMNS * ROWS)
    columns = tl.maximum(columns, 1)
    most = tl.max(count, 0)
    j = 0
    while j < most:
        active = inside & (j < count) & (start + j < CAPACITY)
        key = base + (first_row + j // columns) * COLUMNS + first_column + j % columns
        tl.store(keys + start + j, key.to(keys.dtype.element_ty), mask=active)
        tl.store(rows + start + j, row.to(tl.int32), mask=active)
        j += 1


@triton.jit
def _pixels(tile, camera, Ks, COLUMNS, WIDTH, HEIGHT, TILE: tl.constexpr):
    pixel = tl.arange(0, TILE * TILE)
    u = (tile % COLUMNS) * TILE + pixel % TILE
    v = (tile // COLUMNS) * TILE + pixel // TILE
    K = Ks + camera * 9
    x = (u + 0.5 - tl.load(K + 2)) / tl.load(K)
    y = (v + 0.5 - tl.load(K + 5)) / tl.load(K + 4)
    return x, y, (camera * HEIGHT + v) * WIDTH + u, (u < WIDTH) & (v < HEIGHT)


@triton.jit
def _alphas(centres, log_opacities, row, sphere, valid, x, y, inverse, min_alpha):
    """Return the alphas (S, P) of spheres at pixels, raw and after the thresholds; depth and k (S,); a, b, c (S, P).

    a, b: offsets of the centres from the rays at their depth; c = a y - b x.
    """
    px = tl.load(centres + row * 4, mask=valid, other=0.0)
    py = tl.load(centres + row * 4 + 1, mask=valid, other=0.0)
    pz = tl.load(centres + row * 4 + 2, mask=valid, other=0.0)
    k = tl.load(centres + row * 4 + 3, mask=valid, other=0.0)
    log_opacity = tl.load(log_opacities + sphere, mask=valid, other=-1e4)
    a = px[:, None] - pz[:, None] * x[None, :]
    b = py[:, None] - pz[:, None] * y[None, :]
    c = a * y[None, :] - b * x[None, :]
    raw = tl.exp(k[:, None] * (a * a + b * b + c * c) * inverse[None, :] + log_opacity[:, None])
    alpha = tl.where(valid[:, None] & (raw >= min_alpha), tl.minimum(raw, 0.99), 0.0)
    return raw, alpha, pz, k, a, b, c


@triton.jit
def composite_forward(
    centres, log_opacities, features, rows, starts, Ks, out, out_left, out_depth, out_median,
    N, COLUMNS, ROWS, WIDTH, HEIGHT, min_alpha, min_transmittance,
    F: tl.constexpr, CHANNELS: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Composite one tile front to back; CHANNELS is F filled up to a power of two."""
    program = tl.program_id(0)
    tiles = COLUMNS * ROWS
    camera = program // tiles
    x, y, target, shown = _pixels(program % tiles, camera, Ks, COLUMNS, WIDTH, HEIGHT, TILE)
    inverse = 1 / (1 + x * x + y * y)
    channel = tl.arange(0, CHANNELS)
    left = tl.where(shown, 1.0, 0.0)
    depth, median = tl.zeros_like(left), tl.zeros_like(left)
    color = tl.zeros((TILE * TILE, CHANNELS), tl.float32)
    position = tl.load(starts + program)
    end = tl.load(starts + program + 1)
    most = 1.0
    while (position < end) & (most > min_transmittance):
        slot = position + tl.arange(0, BLOCK)
        valid = slot < end
        row = tl.load(rows + slot, mask=valid, other=0)
        sphere = row % N
        _, alpha, pz, _, _, _, _ = _alphas(centres, log_opacities, row, sphere, valid, x, y, inverse, min_alpha)
        keep = 1 - alpha
        after = left[None, :] * tl.associative_scan(keep, 0, _multiply)
        before = after / keep
        weight = alpha * before
        depth += tl.sum(weight * pz[:, None], 0)
        median += tl.sum(tl.where((after <= 0.5) & (before > 0.5), pz[:, None], 0.0), 0)
        known = valid[:, None] & (channel < F)[None, :]
        value = tl.load(features + sphere[:, None] * F + channel[None, :], mask=known, other=0.0)
        color += tl.sum(weight[:, :, None] * value[:, None, :], 0)
        left *= tl.reduce(keep, 0, _multiply)
        most = tl.max(left, 0)
        position += BLOCK
    tl.store(out_left + target, left, mask=shown)
    tl.store(out_depth + target, depth, mask=shown)
    tl.store(out_median + target, median, mask=shown)
    tl.store(out + target[:, None] * F + channel[None, :], color, mask=shown[:, None] & (channel < F)[None, :])


@triton.jit
def composite_backward(
    centres, log_opacities, features, rows, starts, Ks, out, out_left, out_depth, grad_out, grad_alpha, grad_depth,
    gradients, N, COLUMNS, ROWS, WIDTH, HEIGHT, min_alpha, min_transmittance,
    F: tl.constexpr, CHANNELS: tl.constexpr, WIDE: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Differentiate one tile, front to back again; adds to rows of WIDE gradients: centre, k, log opacity, features."""
    program = tl.program_id(0)
    tiles = COLUMNS * ROWS
    camera = program // tiles
    x, y, target, shown = _pixels(program % tiles, camera, Ks, COLUMNS, WIDTH, HEIGHT, TILE)
    inverse = 1 / (1 + x * x + y * y)
    channel = tl.arange(0, CHANNELS)
    left = tl.where(shown, 1.0, 0.0)
    drawn = shown[:, None] & (channel < F)[None, :]
    by_color = tl.load(grad_out + target[:, None] * F + channel[None, :], mask=drawn, other=0.0)
    by_depth = tl.load(grad_depth + target, mask=shown, other=0.0)
    # What lies behind a sphere, seen through it: starts at everything, and loses each sphere as it is passed.
    rest = tl.sum(by_color * tl.load(out + target[:, None] * F + channel[None, :], mask=drawn, other=0.0), 1)
    rest += by_depth * tl.load(out_depth + target, mask=shown, other=0.0)
    by_alpha = tl.load(grad_alpha + target, mask=shown, other=0.0)
    rest -= by_alpha * tl.load(out_left + target, mask=shown, other=0.0)
    position = tl.load(starts + program)
    end = tl.load(starts + program + 1)
    most = 1.0
    while (position < end) & (most > min_transmittance):
        slot = position + tl.arange(0, BLOCK)
        valid = slot < end
        row = tl.load(rows + slot, mask=valid, other=0)
        sphere = row % N
        raw, alpha, pz, k, a, b, c = _alphas(centres, log_opacities, row, sphere, valid, x, y, inverse, min_alpha)
        keep = 1 - alpha
        before = left[None, :] * tl.associative_scan(keep, 0, _multiply) / keep
        weight = alpha * before
        known = valid[:, None] & (channel < F)[None, :]
        value = tl.load(features + sphere[:, None] * F + channel[None, :], mask=known, other=0.0)
        along = pz[:, None] * by_depth[None, :] + tl.sum(value[:, None, :] * by_color[None, :, :], 2)
        hidden = rest[None, :] - tl.associative_scan(weight * along, 0, _add)
        exponent = tl.where(raw > 0.99, 0.0, (along * before - hidden / keep) * alpha)
        factor = 2 * k[:, None] * inverse[None, :] * exponent
        by_a = factor * (a + c * y[None, :])
        by_b = factor * (b - c * x[None, :])
        by_z = weight * by_depth[None, :] - by_a * x[None, :] - by_b * y[None, :]
        by_k = exponent * (a * a + b * b + c * c) * inverse[None, :]
        here = gradients + row * WIDE
        tl.atomic_add(here, tl.sum(by_a, 1), mask=valid, sem="relaxed")
        tl.atomic_add(here + 1, tl.sum(by_b, 1), mask=valid, sem="relaxed")
        tl.atomic_add(here + 2, tl.sum(by_z, 1), mask=valid, sem="relaxed")
        tl.atomic_add(here + 3, tl.sum(by_k, 1), mask=valid, sem="relaxed")
        tl.atomic_add(here + 4, tl.sum(exponent, 1), mask=valid, sem="relaxed")
        # not over the middle axis: Triton makes a matrix product in tf32 of that
        by_value = tl.sum(weight[:, None, :] * tl.trans(by_color)[None, :, :], 2)
        tl.atomic_add(here[:, None] + 5 + channel[None, :], by_value, mask=known, sem="relaxed")
        rest -= tl.sum(weight * along, 0)
        left *= tl.reduce(keep, 0, _multiply)
        most = tl.max(left, 0)
        position += BLOCK
