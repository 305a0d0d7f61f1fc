// Which spheres each tile shows: cones around both that intersect, first for blocks of tiles, then for their tiles.
#define SIDE 8  // tiles along the side of a block

struct Cones {  // columns of `count` numbers each
    int count;
    const Number *x, *y, *z, *half, *cosine, *sine;
};

struct Scene {  // C cameras of K kinds, whose tiles are alike; N spheres
    const Number *cones;     // x, y, z of unit vectors in camera axes, half angle, its cosine and sine, (C, 6, N)
    const int64_t *order;    // spheres in the order of `cones`, nearest first, (C, N)
    const int64_t *drawn;    // how many of them are drawn, (C)
    const int64_t *kind;     // (C)
    const Number *axes;      // of the tiles, (K, rows * columns, 3)
    const Number *halves;    // half angles of the tiles, (K, rows * columns)
    int cameras, spheres, rows, columns;
};

struct Found {
    int64_t *counts;        // pairs of each tile, (C * rows * columns)
    const int64_t *starts;  // first pair of each tile; null: pairs are only counted
    int64_t *places;        // camera * N + sphere of each pair
};

struct Cone {
    Number x, y, z, half, cosine, sine;
};

INLINE Cone cone_of(Number x, Number y, Number z, Number half) {
    return {x, y, z, half, (Number)std::cos(half), (Number)std::sin(half)};
}

// Marks which of some cones meet another one, rounded so that no visible sphere is lost. Cosines are compared, not
// angles: cos a >= cos(b + c) where b + c stays within pi.
INLINE void mark(const Cone cone, const Cones of, uint8_t* __restrict meets) {
    const Number slack = Number(8) * std::numeric_limits<Number>::epsilon(), straight = Number(3.141592653589793);
    const Number *x = of.x, *y = of.y, *z = of.z, *half = of.half, *cosine = of.cosine, *sine = of.sine;
    for (int i = 0; i < of.count; i++) {
        Number limit = cone.cosine * cosine[i] - cone.sine * sine[i] - slack;
        Number along = cone.x * x[i] + cone.y * y[i] + cone.z * z[i];
        meets[i] = (along >= limit) | (cone.half + half[i] >= straight);
    }
}

// Cone around the tiles of a block.
INLINE Cone around(const Number* axes, const Number* halves, const int* tiles, int count) {
    const Number slack = Number(4) * std::numeric_limits<Number>::epsilon();
    Number x = 0, y = 0, z = 0, half = 0;
    for (int t = 0; t < count; t++) {
        x += axes[3 * tiles[t]];
        y += axes[3 * tiles[t] + 1];
        z += axes[3 * tiles[t] + 2];
    }
    Number size = std::sqrt(x * x + y * y + z * z);
    for (int t = 0; t < count; t++) {
        const Number* axis = axes + 3 * tiles[t];
        Number cosine = (axis[0] * x + axis[1] * y + axis[2] * z) / size - slack;
        Number apart = std::acos(cosine < Number(-1) ? Number(-1) : cosine) + halves[tiles[t]];
        half = apart > half ? apart : half;
    }
    return cone_of(x / size, y / size, z / size, half);
}

struct Room {  // of a thread
    Array<Number> near;  // cones of the spheres that may meet a block
    Array<int64_t> places;
    Array<uint8_t> meets;
    Room(int64_t spheres) : near(6 * spheres), places(spheres), meets(spheres) {}
};

INLINE int count_marks(const uint8_t* meets, int count) {
    int sum = 0;
    for (int i = 0; i < count; i++) sum += meets[i];
    return sum;
}

// Copies the marked cones and their places, and returns how many there are.
INLINE int keep(const Cones& of, const int64_t* order, int64_t first, Room& room) {
    int count = 0, rows = of.count;
    Number* near = room.near.values;
    for (int i = 0; i < of.count; i++) {
        if (!room.meets.values[i]) continue;
        const Number* columns[] = {of.x, of.y, of.z, of.half, of.cosine, of.sine};
        for (int k = 0; k < 6; k++) near[k * rows + count] = columns[k][i];
        room.places.values[count++] = first + order[i];
    }
    return count;
}

static void cull_block(const Scene& scene, Found& found, int camera, int block, Room& room) {
    int wide = (scene.columns + SIDE - 1) / SIDE, top = block / wide * SIDE, left = block % wide * SIDE;
    int tiles[SIDE * SIDE], count = 0, all = scene.rows * scene.columns;
    for (int row = top; row < top + SIDE && row < scene.rows; row++) {
        for (int column = left; column < left + SIDE && column < scene.columns; column++) {
            tiles[count++] = row * scene.columns + column;
        }
    }
    const Number *axes = scene.axes + scene.kind[camera] * all * 3, *halves = scene.halves + scene.kind[camera] * all;
    int64_t N = scene.spheres;
    const Number* given = scene.cones + camera * 6 * N;
    int drawn = (int)scene.drawn[camera];
    Cones cones = {drawn, given, given + N, given + 2 * N, given + 3 * N, given + 4 * N, given + 5 * N};
    uint8_t* meets = room.meets.values;
    mark(around(axes, halves, tiles, count), cones, meets);
    const Number* near = room.near.values;
    int64_t rows = cones.count;
    Cones some = {0, near, near + rows, near + 2 * rows, near + 3 * rows, near + 4 * rows, near + 5 * rows};
    some.count = keep(cones, scene.order + camera * N, camera * N, room);
    for (int t = 0; t < count; t++) {
        const Number* axis = axes + 3 * tiles[t];
        int64_t tile = (int64_t)camera * all + tiles[t];
        mark(cone_of(axis[0], axis[1], axis[2], halves[tiles[t]]), some, meets);
        if (!found.starts) {
            found.counts[tile] = count_marks(meets, some.count);
            continue;
        }
        int64_t* to = found.places + found.starts[tile];
        for (int i = 0; i < some.count; i++) {
            if (meets[i]) *to++ = room.places.values[i];
        }
    }
}

struct CullQueue {
    const Scene& scene;
    Found& found;
    int next;
};

static void* cull_blocks(void* shared) {
    CullQueue& queue = *static_cast<CullQueue*>(shared);
    const Scene& scene = queue.scene;
    int blocks = (scene.rows + SIDE - 1) / SIDE * ((scene.columns + SIDE - 1) / SIDE);
    Room room(scene.spheres);
    for (int task; (task = __atomic_fetch_add(&queue.next, 1, __ATOMIC_RELAXED)) < scene.cameras * blocks;) {
        cull_block(scene, queue.found, task / blocks, task % blocks, room);
    }
    return nullptr;
}

extern "C" void cull(int threads, const Number* cones, const int64_t* order, const int64_t* drawn, const int64_t* kind,
                     const Number* axes, const Number* halves, int cameras, int spheres, int rows, int columns,
                     int64_t* counts, const int64_t* starts, int64_t* places) {
    const Scene scene = {cones, order, drawn, kind, axes, halves, cameras, spheres, rows, columns};
    Found found = {counts, starts, places};
    CullQueue queue = {scene, found, 0};
    in_threads(threads, cull_blocks, &queue);
}
