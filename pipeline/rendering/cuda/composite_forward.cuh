// Draws the spheres of each tile over each other, from the nearest to the farthest; a block for each tile, a warp for 8 x 8
// of its pixels. Writes features out (C, H, W, F), the share of light that passes all spheres, and mean and median depth
// (C, H, W) [m]. COUNT of the features from FIRST on are drawn in a pass; the first one writes the rest.
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
            Seen seen = staged.spheres[j];
#pragma unroll
            for (int h = 0; h < 2; h++) {
                float raw = alpha_at(seen, pixels[h]);
                if (raw >= min_alpha) {
                    float alpha = fminf(raw, 0.99f), weight = alpha * left[h], after = left[h] - weight;
                    if (FIRST == 0) {
                        depth[h] += weight * seen.other.z;
                        if (left[h] > 0.5f && after <= 0.5f) median[h] = seen.other.z;
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
