// Front-to-back compositing of the lists of tiles, and its derivatives.

// Pixels that are computed together, and partial sums over them: several vectors of the widest registers.
#define BLOCK 64
#define PARTS 16
#define EACH_PIXEL(p) for (int p = 0; p < BLOCK; p++)
// Spheres after which it is looked whether a block is finished.
#define CHUNK 32
#define MAX_ALPHA Number(0.99)

static const Number INVERSE_FACTORIALS[] = {
    1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040, 1.0 / 40320, 1.0 / 362880, 1.0 / 3628800,
    1.0 / 39916800, 1.0 / 479001600, 1.0 / 6227020800.0};

// exp(x) = 2^n exp(r) with |r| <= log(2) / 2, by the series of exp(r); exact to 2 units in the last place.
INLINE Number exponential(Number x) {
    x = x < LOWEST ? Number(LOWEST) : x > HIGHEST ? Number(HIGHEST) : x;
    Number turns = x * Number(1.4426950408889634);
    int n = (int)(turns + (turns < Number(0) ? Number(-0.5) : Number(0.5)));
    Number whole = (Number)n;
    Number r = (x - whole * Number(0.693359375)) - whole * Number(-2.12194440054690583e-4);  // log(2) in two parts
    Number sum = INVERSE_FACTORIALS[TERMS];
    for (int k = TERMS - 1; k >= 0; k--) sum = sum * r + INVERSE_FACTORIALS[k];
    Word bits = ((Word)n + EXPONENT_BIAS) << MANTISSA_BITS;
    Number power;
    memcpy(&power, &bits, sizeof power);
    return power * sum;
}

INLINE Number total(const Number* parts) {
    Number sum = 0;
    for (int k = 0; k < PARTS; k++) sum += parts[k];
    return sum;
}

// Sum over the pixels of products, in an order that does not depend on the processor.
INLINE Number product(const Number* a, const Number* b) {
    Number parts[PARTS] = {};
    for (int first = 0; first < BLOCK; first += PARTS) {
        for (int k = 0; k < PARTS; k++) parts[k] += a[first + k] * b[first + k];
    }
    return total(parts);
}

struct Lists {  // C cameras, N spheres, M pairs, T tiles, P pixels; K rows of tile frames
    const Number* centres;      // camera axes, (C * N, 3)
    const Number *scales, *log_opacities;  // (N)
    const Number* features;     // (N, channels), or (C * N, channels) where they differ by camera
    const Number* basis;        // monomials (1, x, y, x^2, x y, y^2) / (1 + x^2 + y^2) of the pixels, (K, P, 6)
    const Number* rotations;    // from camera to tile axes, (K, 3, 3)
    const int64_t *frame, *starts, *counts;  // row of a tile's frame; its first pair, and how many it has, (T)
    const int64_t* places;      // camera * N + sphere of each pair, nearest first, (M)
    int spheres, tiles, pixels, channels, by_camera;
    int first_sphere, end_sphere;  // others are not seen
    Number min_alpha, min_transmittance;

};

struct Results {  // the last of the channels + 1 of `out` is the depth
    Number *out, *left, *middle;  // (T, P, channels + 1), (T, P) and (T, P), the last null where it is not asked for
};

struct Gradients {
    const Number *out, *alpha;  // with respect to the results, as those
    Number* pairs;              // of each pair by centre, scale, logarithm of opacity, features, (M, 5 + channels)
};

// A sphere in the frame of a tile: its alpha is exp(basis . coefficients). In the frame of a tile, whose z axis is the
// ray through the tile's centre, the squared distance from a centre p to the ray (x, y, 1) is a quadratic polynomial,
//     dist^2 (1 + x^2 + y^2) = (px - pz x)^2 + (py - pz y)^2 + (px y - py x)^2        (derived: |p x d|^2 / |d|^2).
struct Seen {
    int64_t sphere;  // its number; negative where it is not asked for
    const Number* features;
    Number scale, depth;
    Number x, y, z, k;  // its place in the frame of the tile, and -1 / (2 scale^2)
    Number coefficients[6];
};

INLINE Seen seen_from(const Lists& lists, int64_t place, const Number* turn) {
    Seen s;
    int64_t sphere = place % lists.spheres;
    s.sphere = sphere < lists.first_sphere || sphere >= lists.end_sphere ? -1 : sphere;
    if (s.sphere < 0) return s;
    const Number* c = lists.centres + 3 * place;
    Number log_opacity = lists.log_opacities[sphere];
    s.features = lists.features + (lists.by_camera ? place : sphere) * lists.channels;
    s.scale = lists.scales[sphere];
    s.depth = c[2];
    s.x = turn[0] * c[0] + turn[1] * c[1] + turn[2] * c[2];
    s.y = turn[3] * c[0] + turn[4] * c[1] + turn[5] * c[2];
    s.z = turn[6] * c[0] + turn[7] * c[1] + turn[8] * c[2];
    s.k = Number(-0.5) / (s.scale * s.scale);
    Number kx = s.k * s.x, ky = s.k * s.y, xx = kx * s.x, yy = ky * s.y, zz = s.k * s.z * s.z;
    s.coefficients[0] = xx + yy + log_opacity;
    s.coefficients[1] = Number(-2) * kx * s.z;
    s.coefficients[2] = Number(-2) * ky * s.z;
    s.coefficients[3] = zz + yy + log_opacity;
    s.coefficients[4] = Number(-2) * kx * s.y;
    s.coefficients[5] = zz + xx + log_opacity;
    return s;
}

// Adds the derivatives by centre, scale and logarithm of the opacity to five numbers, from those by the coefficients.
INLINE void add_slopes(const Number* turn, const Seen& s, const Number* g, Number* to) {
    Number x = s.x, y = s.y, z = s.z, twice = Number(2) * s.k;
    Number by_x = twice * ((g[0] + g[5]) * x - g[1] * z - g[4] * y);
    Number by_y = twice * ((g[0] + g[3]) * y - g[2] * z - g[4] * x);
    Number by_z = twice * ((g[3] + g[5]) * z - g[1] * x - g[2] * y);
    for (int axis = 0; axis < 3; axis++) to[axis] += turn[axis] * by_x + turn[3 + axis] * by_y + turn[6 + axis] * by_z;
    Number by_k = (g[0] + g[5]) * x * x + (g[0] + g[3]) * y * y + (g[3] + g[5]) * z * z -
                  Number(2) * (g[1] * x * z + g[2] * y * z + g[4] * x * y);
    to[3] += by_k / (s.scale * s.scale * s.scale);
    to[4] += g[0] + g[3] + g[5];
}

// Up to BLOCK pixels of a tile. Those that are missing start with a transmittance of 0, so that nothing is seen there.
struct Block {
    int64_t tile;
    int first, count;
    alignas(64) Number basis[6][BLOCK];
    alignas(64) Number left[BLOCK];
    alignas(64) Number alpha[BLOCK];
    alignas(64) Number weight[BLOCK];
    alignas(64) Number exponent[BLOCK];
};

INLINE void open(const Lists& lists, int64_t tile, int first, Block& block) {
    block.tile = tile;
    block.first = first;
    block.count = lists.pixels - first < BLOCK ? lists.pixels - first : BLOCK;
    const Number* rows = lists.basis + (lists.frame[tile] * lists.pixels + first) * 6;
    EACH_PIXEL(p) {
        bool there = p < block.count;
        for (int k = 0; k < 6; k++) block.basis[k][p] = there ? rows[6 * p + k] : Number(0);
        block.left[p] = there ? Number(1) : Number(0);
    }
}

// Whether no sphere from the `passed`-th on is seen.
INLINE bool finished(const Lists& lists, const Block& block, int64_t passed) {
    if (passed % CHUNK != 0 || passed == 0 || !(lists.min_transmittance > Number(0))) return false;
    int open = 0;
    EACH_PIXEL(p) open |= block.left[p] > lists.min_transmittance;
    return !open;
}

// Computes exponents of a sphere, and returns whether any pixel sees it; `least` is the logarithm of `min_alpha`.
INLINE bool seen(const Number* coefficients, Number least, Block& block) {
    Number a = coefficients[0], b = coefficients[1], c = coefficients[2], d = coefficients[3], e = coefficients[4],
           f = coefficients[5];
    int any = 0;
    EACH_PIXEL(p) {
        Number x = a * block.basis[0][p] + b * block.basis[1][p] + c * block.basis[2][p] + d * block.basis[3][p] +
                   e * block.basis[4][p] + f * block.basis[5][p];
        block.exponent[p] = x;
        any |= x > least;
    }
    return any;
}

// Computes alphas, not limited to MAX_ALPHA.
INLINE void shade(Number least, Block& block) {
    EACH_PIXEL(p) block.alpha[p] = exponential(block.exponent[p]);
    EACH_PIXEL(p) block.alpha[p] = block.exponent[p] > least ? block.alpha[p] : Number(0);
}

INLINE Number limited(Number alpha) { return alpha > MAX_ALPHA ? MAX_ALPHA : alpha; }

// The scratch has a row of BLOCK sums for each channel, and one for the depth.
INLINE void forward_block(const Lists& lists, Results& results, int64_t tile, int first, Number least, Number* sums) {
    Block block;
    alignas(64) Number middle[BLOCK] = {};
    open(lists, tile, first, block);
    int width = lists.channels + 1;
    memset(sums, 0, sizeof(Number) * BLOCK * width);
    const Number* turn = lists.rotations + 9 * lists.frame[tile];
    for (int64_t i = 0; i < lists.counts[tile] && !finished(lists, block, i); i++) {
        int64_t place = lists.places[lists.starts[tile] + i];
        Seen sphere = seen_from(lists, place, turn);
        if (sphere.sphere < 0 || !seen(sphere.coefficients, least, block)) continue;
        shade(least, block);
        if (results.middle) {
            EACH_PIXEL(p) {
                Number after = block.left[p] - limited(block.alpha[p]) * block.left[p];
                middle[p] += block.left[p] > Number(0.5) && after <= Number(0.5) ? sphere.depth : Number(0);
            }
        }
        EACH_PIXEL(p) {
            Number alpha = limited(block.alpha[p]);
            block.weight[p] = alpha * block.left[p];
            block.left[p] *= Number(1) - alpha;
        }
        for (int c = 0; c < width; c++) {
            Number value = c < lists.channels ? sphere.features[c] : sphere.depth, *sum = sums + c * BLOCK;
            EACH_PIXEL(p) sum[p] += block.weight[p] * value;
        }
    }
    int64_t at = tile * lists.pixels + first;
    for (int p = 0; p < block.count; p++) {
        results.left[at + p] = block.left[p];
        if (results.middle) results.middle[at + p] = middle[p];
        for (int c = 0; c < width; c++) results.out[(at + p) * width + c] = sums[c * BLOCK + p];
    }
}

// The scratch has a row of BLOCK derivatives for each channel, and one for the depth. Adds to the derivatives of a
// tile's pairs, which are its own.
INLINE void backward_block(const Lists& lists, const Results& results, Gradients& gradients, int64_t tile, int first,
                           Number least, Number* by_value) {
    Block block;
    // what lies behind a sphere contributes: first the whole pixel, from which each sphere that is passed is taken
    alignas(64) Number rest[BLOCK] = {}, along[BLOCK], gradient[BLOCK];
    open(lists, tile, first, block);
    int width = lists.channels + 1;
    memset(by_value, 0, sizeof(Number) * BLOCK * width);
    int64_t at = tile * lists.pixels + first;
    for (int p = 0; p < block.count; p++) {
        for (int c = 0; c < width; c++) {
            Number by = gradients.out[(at + p) * width + c];
            by_value[c * BLOCK + p] = by;
            rest[p] += by * results.out[(at + p) * width + c];
        }
        rest[p] -= gradients.alpha[at + p] * results.left[at + p];
    }
    const Number* turn = lists.rotations + 9 * lists.frame[tile];
    for (int64_t i = 0; i < lists.counts[tile] && !finished(lists, block, i); i++) {
        int64_t pair = lists.starts[tile] + i, place = lists.places[pair];
        Seen sphere = seen_from(lists, place, turn);
        if (sphere.sphere < 0 || !seen(sphere.coefficients, least, block)) continue;
        shade(least, block);
        EACH_PIXEL(p) along[p] = sphere.depth * by_value[lists.channels * BLOCK + p];
        for (int c = 0; c < lists.channels; c++) {
            Number value = sphere.features[c];
            const Number* by = by_value + c * BLOCK;
            EACH_PIXEL(p) along[p] += by[p] * value;
        }
        EACH_PIXEL(p) {
            // d out / d alpha_i = T_i f_i - sum_(j > i) w_j f_j / (1 - alpha_i), and d alpha / d exponent = alpha
            Number alpha = limited(block.alpha[p]), weight = alpha * block.left[p], keep = Number(1) - alpha;
            rest[p] -= weight * along[p];
            Number slope = (along[p] * block.left[p] - rest[p] / keep) * alpha;
            gradient[p] = block.alpha[p] > MAX_ALPHA ? Number(0) : slope;
            block.weight[p] = weight;
            block.left[p] *= keep;
        }
        Number by_coefficients[6], *to = gradients.pairs + pair * (5 + lists.channels);
        for (int k = 0; k < 6; k++) by_coefficients[k] = product(gradient, block.basis[k]);
        add_slopes(turn, sphere, by_coefficients, to);
        to[2] += product(block.weight, by_value + lists.channels * BLOCK);
        for (int c = 0; c < lists.channels; c++) to[5 + c] += product(block.weight, by_value + c * BLOCK);
    }
}

struct Queue {
    const Lists& lists;
    Results& results;
    Gradients* gradients;  // null: forward
    int next;
};

#define SHARE 4  // tiles that a thread takes at once

INLINE Number least_exponent(const Lists& lists) {
    return lists.min_alpha > Number(0) ? (Number)std::log(lists.min_alpha) : -std::numeric_limits<Number>::infinity();
}

static void forward_tiles(Queue& queue, int first, int end, Number* scratch) {
    Number least = least_exponent(queue.lists);
    for (int tile = first; tile < end; tile++) {
        for (int p = 0; p < queue.lists.pixels; p += BLOCK) {
            forward_block(queue.lists, queue.results, tile, p, least, scratch);
        }
    }
}

static void backward_tiles(Queue& queue, int first, int end, Number* scratch) {
    Number least = least_exponent(queue.lists);
    for (int tile = first; tile < end; tile++) {
        for (int p = 0; p < queue.lists.pixels; p += BLOCK) {
            backward_block(queue.lists, queue.results, *queue.gradients, tile, p, least, scratch);
        }
    }
}

static void* composite_tiles(void* shared) {
    Queue& queue = *static_cast<Queue*>(shared);
    int tiles = queue.lists.tiles;
    Array<Number> scratch(BLOCK * (queue.lists.channels + 1));
    for (int first; (first = __atomic_fetch_add(&queue.next, SHARE, __ATOMIC_RELAXED)) < tiles;) {
        int end = first + SHARE < tiles ? first + SHARE : tiles;
        (queue.gradients ? backward_tiles : forward_tiles)(queue, first, end, scratch.values);
    }
    return nullptr;
}

#define LISTS                                                                                                       \
    const Number *centres, const Number *scales, const Number *log_opacities, const Number *features,               \
        const Number *basis, const Number *rotations, const int64_t *frame, const int64_t *starts,                  \
        const int64_t *counts, const int64_t *places, int spheres, int tiles, int pixels, int channels,             \
        int by_camera, int first_sphere, int end_sphere, double min_alpha, double min_transmittance
#define GIVEN                                                                                                       \
    {                                                                                                               \
        centres, scales, log_opacities, features, basis, rotations, frame, starts, counts, places, spheres, tiles,  \
            pixels, channels, by_camera, first_sphere, end_sphere, (Number)min_alpha, (Number)min_transmittance     \
    }

extern "C" void composite_forward(int threads, LISTS, Number* out, Number* left, Number* middle) {
    const Lists lists = GIVEN;
    Results results = {out, left, middle};
    Queue queue = {lists, results, nullptr, 0};
    in_threads(threads, composite_tiles, &queue);
}

// Adds to the derivatives by centres (C * N, 3), scales, logarithms of opacities and features, and the pairs are
// added up one after another, so that the sums do not depend on the number of threads.
extern "C" void composite_backward(int threads, LISTS, Number* out, Number* left, const Number* grad_out,
                                   const Number* grad_alpha, int pairs, Number* by_centre, Number* by_scale,
                                   Number* by_opacity, Number* by_feature) {
    const Lists lists = GIVEN;
    Results results = {out, left, nullptr};
    int width = 5 + channels;
    Array<Number> by_pair((int64_t)pairs * width);
    Gradients gradients = {grad_out, grad_alpha, by_pair.values};
    Queue queue = {lists, results, &gradients, 0};
    in_threads(threads, composite_tiles, &queue);
    for (int64_t pair = 0; pair < pairs; pair++) {
        const Number* from = by_pair.values + pair * width;
        int64_t place = places[pair], sphere = place % spheres, row = by_camera ? place : sphere;
        for (int axis = 0; axis < 3; axis++) by_centre[3 * place + axis] += from[axis];
        by_scale[sphere] += from[3];
        by_opacity[sphere] += from[4];
        for (int c = 0; c < channels; c++) by_feature[row * channels + c] += from[5 + c];
    }
}
