// The minimum and maximum x / z of the rays that pass a centre at a distance of at most `reach`, in the xz plane.
__device__ __forceinline__ float2 tangents(float x, float z, float reach) {
    float front = z * z - reach * reach;
    if (z <= reach || front <= 0.0f) return make_float2(-INFINITY_F, INFINITY_F);
    float root = reach * sqrtf(fmaxf(x * x + front, 0.0f));
    // The product of the two is (x^2 - reach^2) / front; dividing it by the larger one gives the other accurately.
    float numerator = x * z + (x < 0.0f ? -root : root);
    float one = numerator / front, other = (x * x - reach * reach) / numerator;
    return make_float2(fminf(one, other), fmaxf(one, other));
}

__device__ __forceinline__ float in_pixels(float value) { return fminf(fmaxf(value, -1e6f), 1e6f); }

// Transforms spheres into camera frames, and counts the tiles that each can reach; a thread for each sphere and camera.
// means are (N, 3), or (C, N, 3) where they differ by camera. Writes centres (C, N): x, y, z [m] and -1 / (2 s^2);
// log_opacities (N); distances (C, N), infinite where a sphere is not drawn; spans (C, N): left, top, right, bottom of
// its bound, in pixels, or on z = 1 with RAYS; counts (C, N) of tiles.
extern "C" __global__ void __launch_bounds__(128) project(
    const float* means, const float* scales, const float* opacities, const float* viewmats, const float* Ks,
    const float4* tile_bounds, const float4* column_bounds, const float4* row_bounds, float4* centres,
    float* log_opacities, float* distances, float4* spans, int* counts, int cameras, int N, int columns, int tile_rows,
    int means_by_camera, float min_alpha) {
    int row = blockIdx.x * blockDim.x + threadIdx.x;
    if (row >= cameras * N) return;
    int camera = row / N, n = row - camera * N;
    const float* V = viewmats + camera * 16;
    const float* mean = means + (long long)(means_by_camera ? row : n) * 3;
    float wx = mean[0], wy = mean[1], wz = mean[2], s = scales[n], opacity = opacities[n];
    float x = V[0] * wx + V[1] * wy + V[2] * wz + V[3];
    float y = V[4] * wx + V[5] * wy + V[6] * wz + V[7];
    float z = V[8] * wx + V[9] * wy + V[10] * wz + V[11];
    float distance = sqrtf(x * x + y * y + z * z), log_opacity = logf(fmaxf(opacity, 1e-12f));
    float reach = min_alpha > 0.0f ? s * sqrtf(fmaxf(2.0f * (log_opacity - logf(min_alpha)), 0.0f)) : s * 1e4f;
    reach = reach * 1.0001f + 1e-9f;  // margin, so that rounding does not cull visible spheres
    float2 across = tangents(x, z, reach), down = tangents(y, z, reach);
#if RAYS
    float4 span = make_float4(across.x - 1e-5f * (1.0f + fabsf(across.x)), down.x - 1e-5f * (1.0f + fabsf(down.x)),
                              across.y + 1e-5f * (1.0f + fabsf(across.y)), down.y + 1e-5f * (1.0f + fabsf(down.y)));
#else
    const float* K = Ks + camera * 9;
    float4 span = make_float4(in_pixels(across.x * K[0] + K[2] - 0.5f), in_pixels(down.x * K[4] + K[5] - 0.5f),
                              in_pixels(across.y * K[0] + K[2] + 0.5f), in_pixels(down.y * K[4] + K[5] + 0.5f));
#endif
    int count = 0;
    // comparisons with NaN are false, so spheres at undefined positions are not drawn
    if (z > s && opacity > min_alpha && distance < 1e30f) {
        RayBounds bounds = {tile_bounds, column_bounds, row_bounds};
        Grid grid = {columns, tile_rows};
        TileSpan tiles = tile_span(span, camera, bounds, grid);
        count = tiles.columns * tiles.rows;
#if RAYS
        int candidates = count;
        count = 0;
        for (int j = 0; j < candidates; j++) {
            if (meets_rays(span, bounds.tiles[tile_of(tiles, j, camera, grid)])) count++;
        }
#endif
    }
    centres[row] = make_float4(x, y, z, -0.5f / (s * s));
    spans[row] = span;
    distances[row] = count > 0 ? distance : INFINITY_F;
    counts[row] = count;
    if (camera == 0) log_opacities[n] = log_opacity;
}
