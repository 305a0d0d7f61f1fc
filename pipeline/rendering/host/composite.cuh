// Front-to-back compositing of tile lists on the CPU, see `composite_host`; C++14. SINGLE chooses the type of numbers.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <pthread.h>

// One library has the loops for several kinds of processor, and the loader takes those for this one: caches are shared.
#if defined(__x86_64__) && defined(__GLIBC__)
#define FOR_EACH_PROCESSOR __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define FOR_EACH_PROCESSOR
#endif
#define INLINE static inline __attribute__((always_inline))

#if SINGLE
typedef float Number;
typedef int32_t Word;
#define MANTISSA_BITS 23
#define EXPONENT_BIAS 127
#define LOWEST -87.0f
#define HIGHEST 88.0f
#define TERMS 7
#else
typedef double Number;
typedef int64_t Word;
#define MANTISSA_BITS 52
#define EXPONENT_BIAS 1023
#define LOWEST -708.0
#define HIGHEST 709.0
#define TERMS 13
#endif
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
    Number r = (x - whole * Number(0.693359375)) - whole * Number(-2.12194440054690583e-4), sum = INVERSE_FACTORIALS[TERMS];
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

struct Lists {  // see `TileLists`; M pairs, T tiles, P pixels
    const Number *coefficients;  // (M, 6)
    const Number *features;      // (M, channels)
    const Number *basis;         // (K, P, 6)
    const int64_t *frame, *starts, *counts;
    int tiles, pixels, channels;
    Number min_alpha, min_transmittance;
};

struct Results {
    Number *out, *left, *middle;  // (T, P, channels), (T, P) and (T, P), the last null where it is not asked for
};

struct Gradients {
    const Number *out, *alpha;         // with respect to the results, as those
    Number *coefficients, *features;  // with respect to the inputs, as those
};

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

// The scratch has `channels` rows of BLOCK sums.
INLINE void forward_block(const Lists& lists, Results& results, int64_t tile, int first, Number least, Number* sums) {
    Block block;
    alignas(64) Number middle[BLOCK] = {};
    open(lists, tile, first, block);
    memset(sums, 0, sizeof(Number) * BLOCK * lists.channels);
    for (int64_t i = 0; i < lists.counts[tile] && !finished(lists, block, i); i++) {
        int64_t row = lists.starts[tile] + i;
        if (!seen(lists.coefficients + 6 * row, least, block)) continue;
        shade(least, block);
        const Number* features = lists.features + row * lists.channels;
        Number last = features[lists.channels - 1];
        if (results.middle) {
            EACH_PIXEL(p) {
                Number after = block.left[p] - limited(block.alpha[p]) * block.left[p];
                middle[p] += block.left[p] > Number(0.5) && after <= Number(0.5) ? last : Number(0);
            }
        }
        EACH_PIXEL(p) {
            Number alpha = limited(block.alpha[p]);
            block.weight[p] = alpha * block.left[p];
            block.left[p] *= Number(1) - alpha;
        }
        for (int c = 0; c < lists.channels; c++) {
            Number feature = features[c], *sum = sums + c * BLOCK;
            EACH_PIXEL(p) sum[p] += block.weight[p] * feature;
        }
    }
    int64_t at = tile * lists.pixels + first;
    for (int p = 0; p < block.count; p++) {
        results.left[at + p] = block.left[p];
        if (results.middle) results.middle[at + p] = middle[p];
        for (int c = 0; c < lists.channels; c++) results.out[(at + p) * lists.channels + c] = sums[c * BLOCK + p];
    }
}

// The scratch has `channels` rows of BLOCK derivatives. Adds to the derivatives of a tile's pairs, which are its own.
INLINE void backward_block(const Lists& lists, const Results& results, Gradients& gradients, int64_t tile, int first,
                           Number least, Number* by_color) {
    Block block;
    // what lies behind a sphere contributes: first the whole pixel, from which each sphere that is passed is taken
    alignas(64) Number rest[BLOCK] = {}, along[BLOCK], gradient[BLOCK];
    open(lists, tile, first, block);
    memset(by_color, 0, sizeof(Number) * BLOCK * lists.channels);
    int64_t at = tile * lists.pixels + first;
    for (int p = 0; p < block.count; p++) {
        for (int c = 0; c < lists.channels; c++) {
            Number by = gradients.out[(at + p) * lists.channels + c];
            by_color[c * BLOCK + p] = by;
            rest[p] += by * results.out[(at + p) * lists.channels + c];
        }
        rest[p] -= gradients.alpha[at + p] * results.left[at + p];
    }
    for (int64_t i = 0; i < lists.counts[tile] && !finished(lists, block, i); i++) {
        int64_t row = lists.starts[tile] + i;
        if (!seen(lists.coefficients + 6 * row, least, block)) continue;
        shade(least, block);
        const Number* features = lists.features + row * lists.channels;
        EACH_PIXEL(p) along[p] = Number(0);
        for (int c = 0; c < lists.channels; c++) {
            Number feature = features[c];
            const Number* by = by_color + c * BLOCK;
            EACH_PIXEL(p) along[p] += by[p] * feature;
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
        for (int c = 0; c < lists.channels; c++) {
            gradients.features[row * lists.channels + c] += product(block.weight, by_color + c * BLOCK);
        }
        for (int k = 0; k < 6; k++) gradients.coefficients[row * 6 + k] += product(gradient, block.basis[k]);
    }
}

struct Queue {
    const Lists& lists;
    Results& results;
    Gradients* gradients;  // null: forward
    int next;
};

#define SHARE 4  // tiles that a thread takes at once

FOR_EACH_PROCESSOR
void forward_tiles(Queue& queue, int first, int end, Number* scratch) {
    Number least = queue.lists.min_alpha > Number(0) ? (Number)std::log(queue.lists.min_alpha) : Number(-INFINITY);
    for (int tile = first; tile < end; tile++) {
        for (int p = 0; p < queue.lists.pixels; p += BLOCK) {
            forward_block(queue.lists, queue.results, tile, p, least, scratch);
        }
    }
}

FOR_EACH_PROCESSOR
void backward_tiles(Queue& queue, int first, int end, Number* scratch) {
    Number least = queue.lists.min_alpha > Number(0) ? (Number)std::log(queue.lists.min_alpha) : Number(-INFINITY);
    for (int tile = first; tile < end; tile++) {
        for (int p = 0; p < queue.lists.pixels; p += BLOCK) {
            backward_block(queue.lists, queue.results, *queue.gradients, tile, p, least, scratch);
        }
    }
}

static void* work(void* shared) {
    Queue& queue = *static_cast<Queue*>(shared);
    Number* scratch = new Number[BLOCK * queue.lists.channels];
    for (int first; (first = __atomic_fetch_add(&queue.next, SHARE, __ATOMIC_RELAXED)) < queue.lists.tiles;) {
        int end = first + SHARE < queue.lists.tiles ? first + SHARE : queue.lists.tiles;
        (queue.gradients ? backward_tiles : forward_tiles)(queue, first, end, scratch);
    }
    delete[] scratch;
    return nullptr;
}

static void share_out(int threads, Queue& queue) {
    pthread_t* others = new pthread_t[threads];
    int count = 0;  // where the system gives no more threads, those that there are do the work
    while (count + 1 < threads && pthread_create(&others[count], nullptr, work, &queue) == 0) count++;
    work(&queue);
    while (count > 0) pthread_join(others[--count], nullptr);
    delete[] others;
}

#define LISTS                                                                                                      \
    const Number *coefficients, const Number *features, const Number *basis, const int64_t *frame,                 \
        const int64_t *starts, const int64_t *counts, int tiles, int pixels, int channels, double min_alpha,       \
        double min_transmittance
#define GIVEN                                                                                             \
    {                                                                                                     \
        coefficients, features, basis, frame, starts, counts, tiles, pixels, channels, (Number)min_alpha, \
            (Number)min_transmittance                                                                     \
    }

extern "C" void composite_forward(int threads, LISTS, Number* out, Number* left, Number* middle) {
    const Lists lists = GIVEN;
    Results results = {out, left, middle};
    Queue queue = {lists, results, nullptr, 0};
    share_out(threads, queue);
}

extern "C" void composite_backward(int threads, LISTS, Number* out, Number* left, const Number* grad_out,
                                   const Number* grad_alpha, Number* grad_coefficients, Number* grad_features) {
    const Lists lists = GIVEN;
    Results results = {out, left, nullptr};
    Gradients gradients = {grad_out, grad_alpha, grad_coefficients, grad_features};
    Queue queue = {lists, results, &gradients, 0};
    share_out(threads, queue);
}
