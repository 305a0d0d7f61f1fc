// Tiles that the bound of a sphere covers. The bound is a rectangle: of pixels for a pinhole camera, of x and y on the
// plane z = 1 for a distorting one (RAYS). The latter is compared with the bounds of the rays of each tile: no point is
// distorted, since the distortion folds back outside of the image.

#define TILE 16
#define FULL 0xffffffffu
#define INFINITY_F __int_as_float(0x7f800000)

// Bounds of the rays of each tile (C, rows, columns), of each column of tiles (C, columns), and of each row (C, rows):
// minimum x, minimum y, minus maximum x, minus maximum y. Null for pinhole cameras.
struct RayBounds {
    const float4* tiles;
    const float4* columns;
    const float4* rows;
};

struct Grid {  // number of columns and of rows of tiles
    int columns, rows;
};

struct TileSpan {
    int first_column, columns, first_row, rows;
};

__device__ __forceinline__ int2 pixel_range(float low, float high, int count) {
    int first = (int)fmaxf(floorf(low / TILE), 0.0f);
    return make_int2(first, max(min((int)floorf(high / TILE) + 1, count) - first, 0));
}

// The first column of tiles with rays from low to high, and the number up to the last one.
__device__ __forceinline__ int2 column_range(float low, float high, const float4* bounds, int count) {
    int first = count, last = -1;
    for (int k = 0; k < count; k++) {
        float4 bound = bounds[k];
        if (bound.x <= high && -bound.z >= low) {
            first = min(first, k);
            last = k;
        }
    }
    return make_int2(first, max(last - first + 1, 0));
}

__device__ __forceinline__ int2 row_range(float low, float high, const float4* bounds, int count) {
    int first = count, last = -1;
    for (int k = 0; k < count; k++) {
        float4 bound = bounds[k];
        if (bound.y <= high && -bound.w >= low) {
            first = min(first, k);
            last = k;
        }
    }
    return make_int2(first, max(last - first + 1, 0));
}

// span: left, top, right, bottom of the bound.
__device__ __forceinline__ TileSpan tile_span(const float4& span, int camera, const RayBounds& bounds,
                                              const Grid& grid) {
#if RAYS
    int2 columns = column_range(span.x, span.z, bounds.columns + camera * grid.columns, grid.columns);
    int2 rows = row_range(span.y, span.w, bounds.rows + camera * grid.rows, grid.rows);
#else
    int2 columns = pixel_range(span.x, span.z, grid.columns), rows = pixel_range(span.y, span.w, grid.rows);
#endif
    return {columns.x, columns.y, rows.x, rows.y};
}

// The index of the j-th tile of a span, over all cameras.
__device__ __forceinline__ int tile_of(const TileSpan& tiles, int j, int camera, const Grid& grid) {
    int row = tiles.first_row + j / tiles.columns, column = tiles.first_column + j % tiles.columns;
    return (camera * grid.rows + row) * grid.columns + column;
}

__device__ __forceinline__ bool meets_rays(const float4& span, const float4& bound) {
    return bound.x <= span.z && -bound.z >= span.x && bound.y <= span.w && -bound.w >= span.y;
}
