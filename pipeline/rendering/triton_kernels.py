"""Triton kernels of the renderer: rays, compositing and its derivative. CUDA, float32.

The torch path in `render` is their twin; `rasterize` puts them together with those of `binning`.
"""

# pyright: reportGeneralTypeIssues=false
# (The language of the kernels is Triton's; what looks like its functions raises outside of a kernel.)

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _multiply(a, b):
    return a * b


@triton.jit
def _add(a, b):
    return a + b


@triton.jit
def _pixels(tile, camera, Ks, rays, COLUMNS, WIDTH, HEIGHT, TILE: tl.constexpr):
    """Return the rays x, y (z = 1) of a tile's pixels, their places in the pictures, and which are in the picture."""
    pixel = tl.arange(0, TILE * TILE)
    u = (tile % COLUMNS) * TILE + pixel % TILE
    v = (tile // COLUMNS) * TILE + pixel // TILE
    place, shown = (camera * HEIGHT + v) * WIDTH + u, (u < WIDTH) & (v < HEIGHT)
    if rays is None:
        K = Ks + camera * 9
        x = (u + 0.5 - tl.load(K + 2)) / tl.load(K)
        y = (v + 0.5 - tl.load(K + 5)) / tl.load(K + 4)
    else:
        x = tl.load(rays + place * 2, mask=shown, other=0.0)
        y = tl.load(rays + place * 2 + 1, mask=shown, other=0.0)
    return x, y, place, shown


@triton.jit
def trace(
    Ks, distortion, rays, bounds, COLUMNS, ROWS, WIDTH, HEIGHT,
    TERMS: tl.constexpr, STEPS: tl.constexpr, LEAST: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    """Invert the distortion at the pixels of one tile, as `rays.undistort` does.

    Reads distortion (C, TERMS): k1, k2, p1, p2 [, k3]. Writes rays (C, H, W, 2): x, y on the plane z = 1; bounds
    (C, tiles, 4): least x, least y, minus greatest x, minus greatest y of the tile's rays.
    """
    program = tl.program_id(0)
    tiles = COLUMNS * ROWS
    camera = program // tiles
    u, v, place, shown = _pixels(program % tiles, camera, Ks, None, COLUMNS, WIDTH, HEIGHT, TILE)
    D = distortion + camera * TERMS
    k1, k2, p1, p2 = tl.load(D), tl.load(D + 1), tl.load(D + 2), tl.load(D + 3)
    k3 = tl.load(D + 4) if TERMS > 4 else 0.0
    x, y = u, v
    for _ in range(STEPS):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        off_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - u
        off_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - v
        xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
        xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
        yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        determinant = tl.maximum(xx * yy - xy * xy, LEAST)
        x -= (yy * off_x - xy * off_y) / determinant
        y -= (xx * off_y - xy * off_x) / determinant
    tl.store(rays + place * 2, x, mask=shown)
    tl.store(rays + place * 2 + 1, y, mask=shown)
    infinity = float("inf")
    here = bounds + program * 4
    tl.store(here, tl.min(tl.where(shown, x, infinity), 0))
    tl.store(here + 1, tl.min(tl.where(shown, y, infinity), 0))
    tl.store(here + 2, tl.min(tl.where(shown, -x, infinity), 0))
    tl.store(here + 3, tl.min(tl.where(shown, -y, infinity), 0))


@triton.jit
def _spheres(
    position, end, centres, log_opacities, features, rows, x, y, inverse, N, min_alpha,
    F: tl.constexpr, CHANNELS: tl.constexpr, BY_CAMERA: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Load the next spheres of a tile, and return what pixels see of them.

    Returns:
        row, valid (S,): place among the centres, and whether there is one; value, known (S, CHANNELS): features, and
        which there are; raw, alpha (S, P): before and after the thresholds; z, k (S,): depth and -1 / (2 s^2);
        a, b, c (S, P): offsets a, b of the centres from the rays at their depth, c = a y - b x.
    """
    slot = position + tl.arange(0, BLOCK)
    valid = slot < end
    row = tl.load(rows + slot, mask=valid, other=0)
    sphere = row % N
    px = tl.load(centres + row * 4, mask=valid, other=0.0)
    py = tl.load(centres + row * 4 + 1, mask=valid, other=0.0)
    z = tl.load(centres + row * 4 + 2, mask=valid, other=0.0)
    k = tl.load(centres + row * 4 + 3, mask=valid, other=0.0)
    log_opacity = tl.load(log_opacities + sphere, mask=valid, other=-1e4)
    a = px[:, None] - z[:, None] * x[None, :]
    b = py[:, None] - z[:, None] * y[None, :]
    c = a * y[None, :] - b * x[None, :]
    raw = tl.exp(k[:, None] * (a * a + b * b + c * c) * inverse[None, :] + log_opacity[:, None])
    alpha = tl.where(valid[:, None] & (raw >= min_alpha), tl.minimum(raw, 0.99), 0.0)
    channel = tl.arange(0, CHANNELS)
    known = valid[:, None] & (channel < F)[None, :]
    source = row if BY_CAMERA else sphere
    value = tl.load(features + source[:, None] * F + channel[None, :], mask=known, other=0.0)
    return row, valid, value, known, raw, alpha, z, k, a, b, c


@triton.jit
def composite_forward(
    centres, log_opacities, features, rows, starts, Ks, rays, out, out_left, out_depth, out_median,
    N, COLUMNS, ROWS, WIDTH, HEIGHT, min_alpha, min_transmittance,
    F: tl.constexpr, CHANNELS: tl.constexpr, BY_CAMERA: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Composite one tile front to back; CHANNELS is F filled up to a power of two.

    BY_CAMERA tells whether the features (N, F) are (C, N, F).
    """
    program = tl.program_id(0)
    tiles = COLUMNS * ROWS
    camera = program // tiles
    x, y, target, shown = _pixels(program % tiles, camera, Ks, rays, COLUMNS, WIDTH, HEIGHT, TILE)
    inverse = 1 / (1 + x * x + y * y)
    channel = tl.arange(0, CHANNELS)
    left = tl.where(shown, 1.0, 0.0)
    depth, median = tl.zeros_like(left), tl.zeros_like(left)
    color = tl.zeros((TILE * TILE, CHANNELS), tl.float32)
    position = tl.load(starts + program)
    end = tl.load(starts + program + 1)
    most = 1.0
    while (position < end) & (most > min_transmittance):
        _, _, value, _, _, alpha, z, _, _, _, _ = _spheres(
            position, end, centres, log_opacities, features, rows, x, y, inverse, N, min_alpha, F, CHANNELS, BY_CAMERA,
            BLOCK,
        )  # fmt: skip
        keep = 1 - alpha
        after = left[None, :] * tl.associative_scan(keep, 0, _multiply)
        before = after / keep
        weight = alpha * before
        depth += tl.sum(weight * z[:, None], 0)
        median += tl.sum(tl.where((after <= 0.5) & (before > 0.5), z[:, None], 0.0), 0)
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
    centres, log_opacities, features, rows, starts, Ks, rays, out, out_left, out_depth,
    grad_out, grad_alpha, grad_depth, gradients, N, COLUMNS, ROWS, WIDTH, HEIGHT, min_alpha, min_transmittance,
    F: tl.constexpr, CHANNELS: tl.constexpr, WIDE: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Differentiate one tile, front to back again; adds to rows of WIDE gradients: centre, k, log opacity, features."""
    program = tl.program_id(0)
    tiles = COLUMNS * ROWS
    camera = program // tiles
    x, y, target, shown = _pixels(program % tiles, camera, Ks, rays, COLUMNS, WIDTH, HEIGHT, TILE)
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
        row, valid, value, known, raw, alpha, z, k, a, b, c = _spheres(
            position, end, centres, log_opacities, features, rows, x, y, inverse, N, min_alpha, F, CHANNELS, False,
            BLOCK,
        )  # fmt: skip
        keep = 1 - alpha
        before = left[None, :] * tl.associative_scan(keep, 0, _multiply) / keep
        weight = alpha * before
        along = z[:, None] * by_depth[None, :] + tl.sum(value[:, None, :] * by_color[None, :, :], 2)
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
