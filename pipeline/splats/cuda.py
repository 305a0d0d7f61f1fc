"""CUDA kernels that composite tiles, compiled at run time by NVRTC (no toolkit: it comes with torch's CUDA wheels).

They do what the Triton kernels of the same names do, faster: a warp takes 8 x 8 pixels, leaves out what cannot reach
them before anything is computed, and adds up eight derivatives at a time in the way of a transposition.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

CHANNELS = 8
"""Channels that one launch composites."""

THREADS = 128
"""Of a block: four warps, one for each quarter of a tile."""

SOURCE = r"""
#define LOG2E 1.4426950408889634f
#define WARPS 4
#define FULL 0xffffffffu

struct Pixel {
    float x, y, dx, dy, inverse;
    int target;
    bool shown;
};

struct Patch {  // the 8 x 8 pixels of a warp
    float x0, y0, left, top;
    int camera;
};

__device__ Patch patch_of(const float* Ks, int columns, int tile_rows, int& tile) {
    int warp = threadIdx.x >> 5, tiles = columns * tile_rows;
    tile = blockIdx.x;
    Patch patch;
    patch.camera = tile / tiles;
    int within = tile - patch.camera * tiles;
    patch.left = (within % columns) * 16 + (warp & 1) * 8;
    patch.top = (within / columns) * 16 + (warp >> 1) * 8;
    const float* K = Ks + patch.camera * 9;
    patch.x0 = (patch.left + 4.0f - K[2]) / K[0];
    patch.y0 = (patch.top + 4.0f - K[5]) / K[4];
    return patch;
}

__device__ Pixel pixel_of(const Patch& patch, const float* Ks, int half, int width, int height) {
    int lane = threadIdx.x & 31;
    const float* K = Ks + patch.camera * 9;
    float u = patch.left + (lane & 7), v = patch.top + (lane >> 3) + 4 * half;
    Pixel pixel;
    pixel.x = (u + 0.5f - K[2]) / K[0];
    pixel.y = (v + 0.5f - K[5]) / K[4];
    pixel.dx = (u + 0.5f - patch.left - 4.0f) / K[0];
    pixel.dy = (v + 0.5f - patch.top - 4.0f) / K[4];
    pixel.inverse = 1.0f / (1.0f + pixel.x * pixel.x + pixel.y * pixel.y);
    pixel.shown = u < width && v < height;
    pixel.target = (patch.camera * height + (int)v) * width + (int)u;
    return pixel;
}

__device__ bool reaches(const float4& span, const Patch& patch) {
    return span.x <= patch.left + 7.5f && span.z >= patch.left + 0.5f && span.y <= patch.top + 7.5f &&
           span.w >= patch.top + 0.5f;
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

extern "C" __global__ void __launch_bounds__(128) composite_forward(
    const float4* centres, const float* log_opacities, const float4* spans, const float* features, const int* rows,
    const int* starts, const float* Ks, float* out, float* out_left, float* out_depth, float* out_median,
    int N, int columns, int tile_rows, int width, int height, float min_alpha, float min_transmittance) {
    __shared__ float4 lows[WARPS][32], highs[WARPS][32];
    __shared__ float colors[WARPS][32][COUNT];
    int warp = threadIdx.x >> 5, lane = threadIdx.x & 31, tile;
    Patch patch = patch_of(Ks, columns, tile_rows, tile);
    Pixel pixels[2];
    float left[2], depth[2] = {0, 0}, median[2] = {0, 0}, sums[2][COUNT];
#pragma unroll
    for (int h = 0; h < 2; h++) {
        pixels[h] = pixel_of(patch, Ks, h, width, height);
        left[h] = pixels[h].shown ? 1.0f : 0.0f;
#pragma unroll
        for (int c = 0; c < COUNT; c++) sums[h][c] = 0;
    }
    int end = starts[tile + 1];
    for (int first = starts[tile]; first < end; first += 32) {
        if (__all_sync(FULL, fmaxf(left[0], left[1]) <= min_transmittance)) break;
        int row = first + lane < end ? rows[first + lane] : 0;
        bool hit = first + lane < end && reaches(spans[row], patch);
        unsigned mask = __ballot_sync(FULL, hit);
        if (hit) {
            int slot = __popc(mask & ((1u << lane) - 1)), sphere = row % N;
            float4 low, high;
            expand(centres[row], patch, low, high);
            low.w = log_opacities[sphere] * LOG2E;
            lows[warp][slot] = low;
            highs[warp][slot] = high;
#pragma unroll
            for (int c = 0; c < COUNT; c++) colors[warp][slot][c] = features[sphere * F + FIRST + c];
        }
        __syncwarp();
        int count = __popc(mask);
        for (int j = 0; j < count; j++) {
            float4 low = lows[warp][j], high = highs[warp][j];
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
                    for (int c = 0; c < COUNT; c++) sums[h][c] += weight * colors[warp][j][c];
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
    const int* starts, const float* Ks, const float* out, const float* out_left, const float* out_depth,
    const float* grad_out, const float* grad_alpha, const float* grad_depth, float* gradients,
    int N, int columns, int tile_rows, int width, int height, float min_alpha, float min_transmittance) {
    __shared__ float4 lows[WARPS][32], highs[WARPS][32], points[WARPS][32];
    __shared__ float colors[WARPS][32][F];
    __shared__ int places[WARPS][32];
    int warp = threadIdx.x >> 5, lane = threadIdx.x & 31, tile;
    Patch patch = patch_of(Ks, columns, tile_rows, tile);
    Pixel pixels[2];
    float left[2], rest[2], by_depth[2], by_color[2][F];
#pragma unroll
    for (int h = 0; h < 2; h++) {
        pixels[h] = pixel_of(patch, Ks, h, width, height);
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
        int row = first + lane < end ? rows[first + lane] : 0;
        bool hit = first + lane < end && reaches(spans[row], patch);
        unsigned mask = __ballot_sync(FULL, hit);
        if (hit) {
            int slot = __popc(mask & ((1u << lane) - 1)), sphere = row % N;
            float4 point = centres[row], low, high;
            expand(point, patch, low, high);
            low.w = log_opacities[sphere] * LOG2E;
            lows[warp][slot] = low;
            highs[warp][slot] = high;
            points[warp][slot] = point;
            places[warp][slot] = row;
#pragma unroll
            for (int c = 0; c < F; c++) colors[warp][slot][c] = features[sphere * F + c];
        }
        __syncwarp();
        int count = __popc(mask);
        for (int j = 0; j < count; j++) {
            float4 low = lows[warp][j], high = highs[warp][j];
            float raw[2] = {alpha_at(low, high, pixels[0]), alpha_at(low, high, pixels[1])};
            if (!__any_sync(FULL, fmaxf(raw[0], raw[1]) >= min_alpha)) continue;
            float4 point = points[warp][j];
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
                    along += colors[warp][j][c] * by_color[h][c];
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
            float* target = gradients + (long long)places[warp][j] * (GROUPS * VALUES);
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


@cache
def _core() -> Any:
    try:
        core = importlib.import_module("cuda.core")
    except ImportError:
        return None
    return core if hasattr(core, "Program") else None  # before 1.0 it was experimental by name


def available() -> bool:
    """Tell whether cuda.core is installed, which compiles and launches these kernels."""
    return _core() is not None


def gradient_width(channels: int) -> int:
    """Return the numbers in a row of the backward kernel's result: centre, k, log opacity, features, filled to 8."""
    return -(-(5 + channels) // 8) * 8


@cache
def _kernel(name: str, device: int, channels: int, first: int) -> Any:
    core = _core()
    core.Device(device).set_current()
    major, minor = torch.cuda.get_device_capability(device)
    defines = {"F": channels, "FIRST": first, "COUNT": min(CHANNELS, channels - first)}
    source = "".join(f"#define {key} {value}\n" for key, value in defines.items()) + SOURCE
    options = core.ProgramOptions(std="c++17", arch=f"sm_{major}{minor}")
    return core.Program(source, "c++", options).compile("cubin").get_kernel(name)


@cache
def _config(blocks: int) -> Any:
    return _core().LaunchConfig(grid=blocks, block=THREADS)


@cache
def _stream(handle: int) -> Any:
    return _core().Stream.from_handle(handle)


def launch(
    name: str, blocks: int, tensors: tuple[Tensor, ...], numbers: tuple[int | float, ...], first: int = 0
) -> None:
    """Launch a kernel of `SOURCE` on torch's current stream.

    Args:
        name: The kernel.
        blocks: One for each tile of 16 x 16 pixels.
        tensors: Its pointers, in order, contiguous; the fourth are the features (N, F).
        numbers: Its int32 and float32 arguments, in order.
        first: First channel of the forward kernel.
    """
    features = tensors[3]
    kernel = _kernel(name, features.device.index or 0, features.shape[1], first)
    words = [np.int32(number) if isinstance(number, int) else np.float32(number) for number in numbers]
    pointers = [tensor.data_ptr() for tensor in tensors]
    stream = _stream(torch.cuda.current_stream(features.device).cuda_stream)
    _core().launch(stream, _config(blocks), kernel, *pointers, *words)
