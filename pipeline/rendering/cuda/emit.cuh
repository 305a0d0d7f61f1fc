__device__ __forceinline__ void write_pair(void* keys, int* rows, int wide_keys, int place, int key, int row) {
    if (wide_keys) {
        ((int*)keys)[place] = key;
    } else {
        ((short*)keys)[place] = (short)key;
    }
    rows[place] = row;
}

// Writes a pair of tile key and sphere row for every tile that a sphere can reach, nearest spheres first; a lane for
// each sphere. Reads order (total): rows camera * N + sphere by distance; ends (total): the running sum of the tile
// counts in that order; spans and bounds as in `project`. Writes keys camera * tiles + tile and rows, both (capacity).
extern "C" __global__ void __launch_bounds__(128) emit(
    const long long* order, const int* ends, const float4* spans, const float4* tile_bounds,
    const float4* column_bounds, const float4* row_bounds, void* keys, int* rows, int total, int N, int capacity,
    int columns, int tile_rows, int wide_keys) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    bool inside = k < total;
    int end = ends[inside ? k : total - 1], place = !inside ? end : k > 0 ? ends[k - 1] : 0;
    int row = inside ? (int)order[k] : 0, camera = row / N;
    float4 span = spans[row];
    RayBounds bounds = {tile_bounds, column_bounds, row_bounds};
    Grid grid = {columns, tile_rows};
    TileSpan tiles = {0, 0, 0, 0};
    if (end > place) tiles = tile_span(span, camera, bounds, grid);
#if RAYS
    for (int j = 0; j < tiles.columns * tiles.rows; j++) {
        int key = tile_of(tiles, j, camera, grid);
        if (!meets_rays(span, bounds.tiles[key])) continue;
        if (place < capacity) write_pair(keys, rows, wide_keys, place, key, row);
        place++;
    }
#else
    // The pairs of a warp's spheres are contiguous, so its lanes share them evenly, however many tiles a sphere covers.
    int lane = threadIdx.x & 31, last = min(__shfl_sync(FULL, end, 31), capacity);
    for (int first = __shfl_sync(FULL, place, 0); first < last; first += 32) {
        int pair = first + lane, owner = 0;  // the lane whose sphere owns the pair
#pragma unroll
        for (int step = 16; step > 0; step >>= 1) {
            int other = __shfl_sync(FULL, end, owner + step - 1);
            if (other <= pair) owner += step;
        }
        int j = pair - __shfl_sync(FULL, place, owner), source = __shfl_sync(FULL, row, owner);
        TileSpan covered = {__shfl_sync(FULL, tiles.first_column, owner), __shfl_sync(FULL, tiles.columns, owner),
                            __shfl_sync(FULL, tiles.first_row, owner), 0};
        if (pair < last) write_pair(keys, rows, wide_keys, pair, tile_of(covered, j, source / N, grid), source);
    }
#endif
}
