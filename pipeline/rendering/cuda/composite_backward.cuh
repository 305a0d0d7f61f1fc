#define VALUES 8
#define GROUPS ((5 + F + VALUES - 1) / VALUES)

// Sums values over the lanes of a warp: each step halves the number of values per lane and the distance of the lanes.
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

// Adds up the derivatives of a loss by each sphere in each camera's frame, from those by the pixels; a block for each tile,
// a warp for 8 x 8 of its pixels. Spheres come from the nearest to the farthest, as in `composite_forward`. Writes
// gradients (C, N, GROUPS * VALUES).
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
        // Colour of everything behind a sphere: starts at the whole pixel; each sphere that is passed is removed.
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
            Seen seen = staged.spheres[j];
            float raw[2] = {alpha_at(seen, pixels[0]), alpha_at(seen, pixels[1])};
            if (!__any_sync(FULL, fmaxf(raw[0], raw[1]) >= min_alpha)) continue;
            float4 point = sources.points[j];
            // derivatives by the centre (3), by -1 / (2 s^2), by the logarithm of the opacity, then by the features
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
                // the centre times the ray, as a cross product, is (b, -a, c): its square is the squared distance
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
