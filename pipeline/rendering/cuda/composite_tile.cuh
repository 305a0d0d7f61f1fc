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

struct Pixel {  // inverse: 1 / (1 + x^2 + y^2)
    float x, y, inverse;
    int target;
    bool shown;
};

struct Patch {  // bounds of the 8 x 8 pixels of a warp, in the unit of the spans
    float low_x, low_y, high_x, high_y;
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
#if !RAYS
    const float* K = view.Ks + camera * 9;
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
#else
        pixel.x = (u + 0.5f - K[2]) / K[0];
        pixel.y = (v + 0.5f - K[5]) / K[4];
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

// A sphere in the form in which pixels evaluate it. The squared distance from its centre p to the ray (x, y, 1), times
// 1 + x^2 + y^2, is |p x (x, y, 1)|^2 = z^2 dx^2 + z^2 dy^2 + (py dx - px dy)^2 with dx = x - px / z, dy = y - py / z:
// a quadratic form without cancellation, however small the sphere is relative to a pixel.
struct Seen {
    float4 form;   // px / z, py / z, and the factors of dx^2 and of dx dy in the exponent of 2
    float4 other;  // the factor of dy^2, the logarithm of the opacity to base 2, z
};

__device__ Seen seen_from(const float4& p, float log_opacity) {
    float k = p.w * LOG2E, square = p.z * p.z;
    return {make_float4(p.x / p.z, p.y / p.z, k * (square + p.y * p.y), -2.0f * k * p.x * p.y),
            make_float4(k * (square + p.x * p.x), log_opacity * LOG2E, p.z, 0.0f)};
}

__device__ __forceinline__ float alpha_at(const Seen& seen, const Pixel& pixel) {
    float dx = pixel.x - seen.form.x, dy = pixel.y - seen.form.y;
    // in this order the two pixels of a lane, which have the same x without distortion, share the terms in dx alone
    float square = dy * (seen.other.x * dy + seen.form.w * dx) + seen.form.z * dx * dx;
    return exp2f(square * pixel.inverse + seen.other.y);
}

template <int CHANNELS>
struct Staged {  // up to 32 spheres that reach a patch
    Seen spheres[32];
    float colors[32][CHANNELS];
};

struct Sources {  // their rows in the input, needed only by the derivative
    float4 points[32];
    int places[32];
};

// Copies those of the next 32 spheres of a tile that reach the patch into shared memory, and returns their number.
template <int CHANNELS>
__device__ __forceinline__ int stage(const Lists& lists, const Patch& patch, int first, int end, int channel,
                                     Staged<CHANNELS>& staged, Sources* sources) {
    int lane = threadIdx.x & 31;
    int row = first + lane < end ? lists.rows[first + lane] : 0;
    bool hit = first + lane < end && reaches(lists.spans[row], patch);
    unsigned mask = __ballot_sync(FULL, hit);
    if (hit) {
        int slot = __popc(mask & ((1u << lane) - 1)), sphere = row % lists.N;
        float4 point = lists.centres[row];
        staged.spheres[slot] = seen_from(point, lists.log_opacities[sphere]);
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
