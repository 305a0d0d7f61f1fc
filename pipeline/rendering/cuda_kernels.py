"""CUDA kernels that composite tiles, compiled at run time by NVRTC.

They do what the Triton kernels of the same names do, faster: a warp takes 8 x 8 pixels, leaves out what cannot reach
them before anything is computed, and adds up eight derivatives at a time in the way of a transposition.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from torch import Tensor

from .. import nvrtc

CHANNELS = 8
"""Channels that one launch composites."""

THREADS = 128
"""Of a block: four warps, one for each quarter of a tile."""

SOURCE = r"""
#define LOG2E 1.4426950408889634f
#define WARPS 4
#define FULL 0xffffffffu

struct View {
    const float* Ks;
    const float2* rays;  // x, y on the plane z = 1 of every pixel; only with RAYS, where cameras distort
    int columns, tile_rows, width, height;
};

struct Lists {
    const float4* centres;
    const float* log_opacities;
    const float4* spans;
    const float* features;
    const int* rows;
    int N;
};

struct Pixel {
    float x, y, dx, dy, inverse;
    int target;
    bool shown;
};

struct Patch {  // the 8 x 8 pixels of a warp: the ray at its middle, and its bounds in the unit of the spans
    float x0, y0, low_x, low_y, high_x, high_y;
};

__device__ __forceinline__ float2 ray_at(const View& view, int camera, float u, float v) {
    int column = min((int)u, view.width - 1), row = min((int)v, view.height - 1);
    return view.rays[(camera * view.height + row) * view.width + column];
}

// Sets the patch of a warp and the two pixels of each lane, and returns the tile.
__device__ __forceinline__ int look(const View& view, Patch& patch, Pixel* pixels) {
    int warp = threadIdx.x >> 5, lane = threadIdx.x & 31, tile = blockIdx.x, tiles = view.columns * view.tile_rows;
    int camera = tile / tiles, within = tile - camera * tiles;
    float left = (within % view.columns) * 16 + (warp & 1) * 8, top = (within / view.columns) * 16 + (warp >> 1) * 8;
#if RAYS
    float2 middle = ray_at(view, camera, left + 4.0f, top + 4.0f);
    patch.x0 = middle.x;
    patch.y0 = middle.y;
#else
    const float* K = view.Ks + camera * 9;
    patch.x0 = (left + 4.0f - K[2]) / K[0];
    patch.y0 = (top + 4.0f - K[5]) / K[4];
    patch.low_x = left + 0.5f;
    patch.low_y = top + 0.5f;
    patch.high_x = left + 7.5f;
    patch.high_y = top + 7.5f;
#endif
#pragma unroll
    for (int h = 0; h < 2; h++) {
        float u = left + (lane & 7), v = top + (lane >> 3) + 4 * h;
        Pixel& pixel = pixels[h];
#if RAYS
        float2 ray = ray_at(view, camera, u, v);
        pixel.x = ray.x;
        pixel.y = ray.y;
        pixel.dx = ray.x - middle.x;
        pixel.dy = ray.y - middle.y;
#else
        pixel.x = (u + 0.5f - K[2]) / K[0];
        pixel.y = (v + 0.5f - K[5]) / K[4];
        pixel.dx = (u + 0.5f - left - 4.0f) / K[0];
        pixel.dy = (v + 0.5f - top - 4.0f) / K[4];
#endif
        pixel.inverse = 1.0f / (1.0f + pixel.x * pixel.x + pixel.y * pixel.y);
        pixel.shown = u < view.width && v < view.height;
        pixel.target = (camera * view.height + (int)v) * view.width + (int)u;
    }
#if RAYS
    patch.low_x = fminf(pixels[0].x, pixels[1].x);
    patch.low_y = fminf(pixels[0].y, pixels[1].y);
    patch.high_x = fmaxf(pixels[0].x, pixels[1].x);
    patch.high_y = fmaxf(pixels[0].y, pixels[1].y);
    for (int apart = 16; apart > 0; apart >>= 1) {
        patch.low_x = fminf(patch.low_x, __shfl_xor_sync(FULL, patch.low_x, apart));
        patch.low_y = fminf(patch.low_y, __shfl_xor_sync(FULL, patch.low_y, apart));
        patch.high_x = fmaxf(patch.high_x, __shfl_xor_sync(FULL, patch.high_x, apart));
        patch.high_y = fmaxf(patch.high_y, __shfl_xor_sync(FULL, patch.high_y, apart));
    }
#endif
    return tile;
}

__device__ bool reaches(const float4& span, const Patch& patch) {
    return span.x <= patch.high_x && span.z >= patch.low_x && span.y <= patch.high_y && span.w >= patch.low_y;
}

// The squared distance from a centre to the ray (x0 + dx, y0 + dy, 1), times 1 + x^2 + y^2, is quadratic in (dx, dy):
// (a - z dx)^2 + (b - z dy)^2 + (c - py dx + px dy)^2 with a = px - z x0, b = py - z y0, c = a y0 - b x0.
__device__ void expand(const float4& p, const Patch& patch, float4& low, float4& high) {
    float a = p.x - p.z * patch.x0, b = p.y - p.z * patch.y0, c = a * patch.y0 - b * patch.x0;
    float k = p.w * LOG2E;
    low.x = k * (a * a + b * b + c * c);
    low.y = -2.0f * k * (a * p.z + c * p.y);
    low.z = -2.0f * k * (b * p.z - c * p.x);
    high.x = k * (p.z * p.z + p.y * p.y);
    high.y = -2.0f * k * p.x * p.y;
    high.z = k * (p.z * p.z + p.x * p.x);
    high.w = p.z;
}

__device__ float alpha_at(const float4& low, const float4& high, const Pixel& pixel) {
    float square = low.x + pixel.dx * (low.y + pixel.dx * high.x + pixel.dy * high.y) +
                   pixel.dy * (low.z + pixel.dy * high.z);
    return exp2f(square * pixel.inverse + low.w);
}

template <int CHANNELS>
struct Staged {  // up to 32 spheres that reach a patch
    float4 lows[32], highs[32];
    float colors[32][CHANNELS];
};

struct Sources {  // where they come from, which only the derivative needs
    float4 points[32];
    int places[32];
};

// Puts those of the next 32 spheres of a tile that reach the patch into shared memory, and returns how many they are.
template <int CHANNELS>
__device__ __forceinline__ int stage(const Lists& lists, const Patch& patch, int first, int end, int channel,
                                     Staged<CHANNELS>& staged, Sources* sources) {
    int lane = threadIdx.x & 31;
    int row = first + lane < end ? lists.rows[first + lane] : 0;
    bool hit = first + lane < end && reaches(lists.spans[row], patch);
    unsigned mask = __ballot_sync(FULL, hit);
    if (hit) {
        int slot = __popc(mask & ((1u << lane) - 1)), sphere = row % lists.N;
        float4 point = lists.centres[row], low, high;
        expand(point, patch, low, high);
        low.w = lists.log_opacities[sphere] * LOG2E;
        staged.lows[slot] = low;
        staged.highs[slot] = high;
        if (sources != nullptr) {
            sources->points[slot] = point;
            sources->places[slot] = row;
        }
#pragma unroll
        for (int c = 0; c < CHANNELS; c++) {
            staged.colors[slot][c] = lists.features[(BY_CAMERA ? row : sphere) * F + channel + c];
        }
    }
    __syncwarp();
    return __popc(mask);
}

extern "C" __global__ void __launch_bounds__(128) composite_forward(
    const float4* centres, const float* log_opacities, const float4* spans, const float* features, const int* rows,
    const int* starts, const float* Ks, const float2* rays, float* out, float* out_left, float* out_depth,
    float* out_median, int N, int columns, int tile_rows, int width, int height, float min_alpha,
    float min_transmittance) {
    __shared__ Staged<COUNT> shared[WARPS];
    Staged<COUNT>& staged = shared[threadIdx.x >> 5];
    Lists lists = {centres, log_opacities, spans, features, rows, N};
    View view = {Ks, rays, columns, tile_rows, width, height};
    Patch patch;
    Pixel pixels[2];
    int tile = look(view, patch, pixels);
    float left[2], depth[2] = {0, 0}, median[2] = {0, 0}, sums[2][COUNT];
#pragma unroll
    for (int h = 0; h < 2; h++) {
        left[h] = pixels[h].shown ? 1.0f : 0.0f;
#pragma unroll
        for (int c = 0; c < COUNT; c++) sums[h][c] = 0;
    }
    int end = starts[tile + 1];
    for (int first = starts[tile]; first < end; first += 32) {
        if (__all_sync(FULL, fmaxf(left[0], left[1]) <= min_transmittance)) break;
        int count = stage(lists, patch, first, end, FIRST, staged, nullptr);
        for (int j = 0; j < count; j++) {
            float4 low = staged.lows[j], high = staged.highs[j];
#pragma unroll
            for (int h = 0; h < 2; h++) {
                float raw = alpha_at(low, high, pixels[h]);
                if (raw >= min_alpha) {
                    float alpha = fminf(raw, 0.99f), weight = alpha * left[h], after = left[h] - weight;
                    if (FIRST == 0) {
                        depth[h] += weight * high.w;
                        if (left[h] > 0.5f && after <= 0.5f) median[h] = high.w;
                    }
                    left[h] = after;
#pragma unroll
                    for (int c = 0; c < COUNT; c++) sums[h][c] += weight * staged.colors[j][c];
                }
            }
        }
        __syncwarp();
    }
#pragma unroll
    for (int h = 0; h < 2; h++) {
        if (!pixels[h].shown) continue;
        int target = pixels[h].target;
        if (FIRST == 0) {
            out_left[target] = left[h];
            out_depth[target] = depth[h];
            out_median[target] = median[h];
        }
#pragma unroll
        for (int c = 0; c < COUNT; c++) out[target * F + FIRST + c] = sums[h][c];
    }
}

#define VALUES 8
#define GROUPS ((5 + F + VALUES - 1) / VALUES)

// Adds values over the lanes: each step halves the values and the lanes that hold them apart.
__device__ float transposed_sum(float* values, int lane) {
#pragma unroll
    for (int step = 0; step < 3; step++) {
        int apart = 16 >> step, half = 4 >> step;
        bool upper = lane & apart;
#pragma unroll
        for (int i = 0; i < half; i++) {
            float give = upper ? values[i] : values[i + half], keep = upper ? values[i + half] : values[i];
            values[i] = keep + __shfl_xor_sync(FULL, give, apart);
        }
    }
    values[0] += __shfl_xor_sync(FULL, values[0], 2);
    return values[0] + __shfl_xor_sync(FULL, values[0], 1);
}

extern "C" __global__ void __launch_bounds__(128) composite_backward(
    const float4* centres, const float* log_opacities, const float4* spans, const float* features, const int* rows,
    const int* starts, const float* Ks, const float2* rays, const float* out, const float* out_left,
    const float* out_depth, const float* grad_out, const float* grad_alpha, const float* grad_depth, float* gradients,
    int N, int columns, int tile_rows, int width, int height, float min_alpha, float min_transmittance) {
    __shared__ Staged<F> shared[WARPS];
    __shared__ Sources shared_sources[WARPS];
    int warp = threadIdx.x >> 5, lane = threadIdx.x & 31;
    Staged<F>& staged = shared[warp];
    Sources& sources = shared_sources[warp];
    Lists lists = {centres, log_opacities, spans, features, rows, N};
    View view = {Ks, rays, columns, tile_rows, width, height};
    Patch patch;
    Pixel pixels[2];
    int tile = look(view, patch, pixels);
    float left[2], rest[2], by_depth[2], by_color[2][F];
#pragma unroll
    for (int h = 0; h < 2; h++) {
        bool shown = pixels[h].shown;
        int target = pixels[h].target;
        left[h] = shown ? 1.0f : 0.0f;
        by_depth[h] = shown ? grad_depth[target] : 0.0f;
        // What lies behind a sphere, seen through it: starts at everything, and loses each sphere as it is passed.
        rest[h] = shown ? out_depth[target] * by_depth[h] - grad_alpha[target] * out_left[target] : 0.0f;
#pragma unroll
        for (int c = 0; c < F; c++) {
            by_color[h][c] = shown ? grad_out[target * F + c] : 0.0f;
            rest[h] += shown ? out[target * F + c] * by_color[h][c] : 0.0f;
        }
    }
    int end = starts[tile + 1];
    for (int first = starts[tile]; first < end; first += 32) {
        if (__all_sync(FULL, fmaxf(left[0], left[1]) <= min_transmittance)) break;
        int count = stage(lists, patch, first, end, 0, staged, &sources);
        for (int j = 0; j < count; j++) {
            float4 low = staged.lows[j], high = staged.highs[j];
            float raw[2] = {alpha_at(low, high, pixels[0]), alpha_at(low, high, pixels[1])};
            if (!__any_sync(FULL, fmaxf(raw[0], raw[1]) >= min_alpha)) continue;
            float4 point = sources.points[j];
            float values[GROUPS * VALUES];
#pragma unroll
            for (int i = 0; i < GROUPS * VALUES; i++) values[i] = 0;
#pragma unroll
            for (int h = 0; h < 2; h++) {
                if (raw[h] < min_alpha) continue;
                const Pixel& at = pixels[h];
                float alpha = fminf(raw[h], 0.99f), weight = alpha * left[h];
                float along = point.z * by_depth[h];
#pragma unroll
                for (int c = 0; c < F; c++) {
                    along += staged.colors[j][c] * by_color[h][c];
                    values[5 + c] += weight * by_color[h][c];
                }
                rest[h] -= weight * along;
                float grad = raw[h] > 0.99f ? 0.0f : (along * left[h] - __fdividef(rest[h], 1.0f - alpha)) * alpha;
                left[h] -= weight;
                float a = point.x - point.z * at.x, b = point.y - point.z * at.y, c = a * at.y - b * at.x;
                float factor = 2.0f * point.w * at.inverse * grad;
                float by_a = factor * (a + c * at.y), by_b = factor * (b - c * at.x);
                values[0] += by_a;
                values[1] += by_b;
                values[2] += weight * by_depth[h] - by_a * at.x - by_b * at.y;
                values[3] += grad * (a * a + b * b + c * c) * at.inverse;
                values[4] += grad;
            }
            float* target = gradients + (long long)sources.places[j] * (GROUPS * VALUES);
#pragma unroll
            for (int g = 0; g < GROUPS; g++) {
                float sum = transposed_sum(values + g * VALUES, lane);
                if ((lane & 3) == 0) atomicAdd(target + g * VALUES + (lane >> 2), sum);
            }
        }
        __syncwarp();
    }
}
"""


def gradient_width(channels: int) -> int:
    """Return the numbers in a row of the backward kernel's result: centre, k, log opacity, features, filled to 8."""
    return -(-(5 + channels) // 8) * 8


@cache
def _kernel(name: str, device: int, channels: int, first: int, rays: bool, by_camera: bool) -> Any:
    defines = {"F": channels, "FIRST": first, "COUNT": min(CHANNELS, channels - first), "RAYS": int(rays)}
    defines["BY_CAMERA"] = int(by_camera)
    source = "".join(f"#define {key} {value}\n" for key, value in defines.items()) + SOURCE
    return nvrtc.compiled(source, name, device)


def launch(
    name: str, blocks: int, tensors: tuple[Tensor | None, ...], numbers: tuple[int | float, ...], first: int = 0
) -> None:
    """Launch a kernel of `SOURCE` on torch's current stream.

    Args:
        name: The kernel.
        blocks: One for each tile of 16 x 16 pixels.
        tensors: Its pointers, in order, contiguous; the fourth are the features (N, F) or (C, N, F), the eighth the
            rays or None.
        numbers: Its int32 and float32 arguments, in order.
        first: First channel of the forward kernel.
    """
    features = tensors[3]
    assert features is not None
    rays, by_camera = tensors[7] is not None, features.dim() == 3
    kernel = _kernel(name, features.device.index or 0, features.shape[-1], first, rays, by_camera)
    words = [np.int32(number) if isinstance(number, int) else np.float32(number) for number in numbers]
    nvrtc.launch(kernel, features.device, blocks, THREADS, tensors, *words)
