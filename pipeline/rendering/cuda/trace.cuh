#define TILE 16
#define FULL 0xffffffffu
#define INFINITY_F __int_as_float(0x7f800000)

// Inverts the distortion at the pixels of one tile, as `rays.undistort` does; a block for each tile, a thread for each
// pixel. Reads distortion (C, terms): k1, k2, p1, p2 [, k3]. Writes rays (C, H, W): x, y on the plane z = 1; bounds
// (C, tiles): minimum x, minimum y, minus maximum x, minus maximum y of the tile's rays.
extern "C" __global__ void __launch_bounds__(256) trace(
    const float* Ks, const float* distortion, float2* rays, float4* bounds, int columns, int tile_rows, int width,
    int height, int terms, int steps, float least_determinant) {
    __shared__ float4 shared[8];
    int tiles = columns * tile_rows, camera = blockIdx.x / tiles, tile = blockIdx.x - camera * tiles;
    int column = (tile % columns) * TILE + threadIdx.x % TILE, row = (tile / columns) * TILE + threadIdx.x / TILE;
    bool shown = column < width && row < height;
    const float* K = Ks + camera * 9;
    const float* D = distortion + camera * terms;
    float u = (column + 0.5f - K[2]) / K[0], v = (row + 0.5f - K[5]) / K[4];
    float k1 = D[0], k2 = D[1], p1 = D[2], p2 = D[3], k3 = terms > 4 ? D[4] : 0.0f;
    float x = u, y = v;
    for (int step = 0; step < steps; step++) {
        float r2 = x * x + y * y;
        float radial = 1.0f + r2 * (k1 + r2 * (k2 + r2 * k3));
        float slope = 2.0f * (k1 + r2 * (2.0f * k2 + r2 * 3.0f * k3));
        float off_x = x * radial + 2.0f * p1 * x * y + p2 * (r2 + 2.0f * x * x) - u;
        float off_y = y * radial + p1 * (r2 + 2.0f * y * y) + 2.0f * p2 * x * y - v;
        float xx = radial + x * x * slope + 2.0f * p1 * y + 6.0f * p2 * x;
        float xy = x * y * slope + 2.0f * p1 * x + 2.0f * p2 * y;
        float yy = radial + y * y * slope + 6.0f * p1 * y + 2.0f * p2 * x;
        float determinant = fmaxf(xx * yy - xy * xy, least_determinant);
        x -= (yy * off_x - xy * off_y) / determinant;
        y -= (xx * off_y - xy * off_x) / determinant;
    }
    if (shown) rays[(long long)(camera * height + row) * width + column] = make_float2(x, y);
    float4 least = shown ? make_float4(x, y, -x, -y) : make_float4(INFINITY_F, INFINITY_F, INFINITY_F, INFINITY_F);
    for (int apart = 16; apart > 0; apart >>= 1) {
        least.x = fminf(least.x, __shfl_xor_sync(FULL, least.x, apart));
        least.y = fminf(least.y, __shfl_xor_sync(FULL, least.y, apart));
        least.z = fminf(least.z, __shfl_xor_sync(FULL, least.z, apart));
        least.w = fminf(least.w, __shfl_xor_sync(FULL, least.w, apart));
    }
    if (threadIdx.x % 32 == 0) shared[threadIdx.x / 32] = least;
    __syncthreads();
    if (threadIdx.x > 0) return;
    for (int warp = 1; warp < 8; warp++) {
        float4 other = shared[warp];
        least = make_float4(fminf(least.x, other.x), fminf(least.y, other.y), fminf(least.z, other.z),
                            fminf(least.w, other.w));
    }
    bounds[blockIdx.x] = least;
}
