// Distance from the union of a body's spheres; formulas of `physics/smooth_distance.py`.
#if PAIRED
struct Union {  // the spheres of a body, in its frame
    Input geometry;
    long long first;
    int count;
    INLINE Vec center(int i) const { return geometry.vector(first + 4LL * i); }
    INLINE Real radius(int i) const { return geometry.at(first + 4LL * i + 3); }
};

INLINE Number square_to(const Union& spheres, int i, const Number* point) {
    const Number* s = spheres.geometry.value + spheres.first + 4LL * i;
    Number x = point[0] - s[0], y = point[1] - s[1], z = point[2] - s[2];
    return x * x + y * y + z * z;
}

INLINE Number plain_radius(const Union& spheres, int i) {
    return spheres.geometry.value[spheres.first + 4LL * i + 3];
}

// Centre and radius of a sphere; for lanes that share an environment by one load.
INLINE AlignedRow row_of(const Number* sphere) {
#if HOST || !SHARED
    AlignedRow row = {sphere[0], sphere[1], sphere[2], sphere[3]};
    return row;
#else
    return *reinterpret_cast<const AlignedRow*>(sphere);
#endif
}

// Whether a sphere, the square of whose distance is given, has a gap below `limit`, without a square root.
INLINE bool below(Number far2, Number radius, Number limit) {
    Number reach = limit + radius;
    return reach > Number(0) && far2 < reach * reach;
}

// Squared distances and radii of a group of spheres, whose computation does not wait for that of the others.
const int AT_ONCE = 4;
INLINE void squares_to(const Union& spheres, int first, const Number* point, Number* squares, Number* radii) {
    SPREAD
    for (int k = 0; k < AT_ONCE; k++) {
        int i = first + k < spheres.count ? first + k : first;
        AlignedRow s = row_of(spheres.geometry.value + spheres.first + 4LL * i);
        Number x = point[0] - s.a, y = point[1] - s.b, z = point[2] - s.c;
        squares[k] = x * x + y * y + z * z;
        radii[k] = s.d;
    }
}

// The first members of a union that take part, which a GPU keeps in registers.
const int HELD_MEMBERS = QUEUED && !HOST ? 4 : 0;

// How many times the spheres of a union are halved until each of 32 bits stands for so many of them.
INLINE int halvings(int count) {
    int times = 0;
    INNER
    while (count > 32 << times) times++;
    return times;
}

// Distance of a point from the nearest sphere of a union, in its frame; where `members` is given, those are found, too.
INLINE Number nearest_in(const Union& spheres, const Number* point, unsigned* members = nullptr) {
    Number nearest = Number(1e30), squares[AT_ONCE], radii[AT_ONCE];
    if (members) *members = 0;
    const int times = members ? halvings(spheres.count) : 0;
    INNER
    for (int first = 0; first < spheres.count; first += AT_ONCE) {
        squares_to(spheres, first, point, squares, radii);
        if (members) {
            SPREAD
            for (int k = 0; k < AT_ONCE; k++) {
                const bool may = first + k < spheres.count && below(squares[k], radii[k], nearest + Number(SMOOTHING_M));
                *members |= (unsigned)may << ((first + k) >> times);
            }
        }
        SPREAD
        for (int k = 0; k < AT_ONCE; k++) {
#if HOST || !SHARED || !SINGLE
            if (first + k >= spheres.count) break;
            if (below(squares[k], radii[k], nearest)) nearest = root(squares[k]) - radii[k];
#else
            nearest = lesser(nearest, root(squares[k]) - radii[k]);  // branches would part the lanes
#endif
        }
    }
    return nearest;
}

#if QUEUED
INLINE int lowest_bit(unsigned bits) {
#if HOST
    return __builtin_ctz(bits);
#else
    return __ffs(bits) - 1;
#endif
}
#endif

// Returns whether the union is nearer than `limit`; then also its smooth distance and the outward normal. Where that is
// undefined, between opposite spheres, it is `up`. All in the frame of the union; `nearest` is the distance of its nearest
// sphere, which is sought unless it is known.
__device__ bool union_distance(const Union& spheres, Vec at, Number limit, Vec up, const Nearness* known, Real& distance,
                               Number& nearest, Vec& outward) {
    const Number width = Number(SMOOTHING_M);
    Number point[3] = {plain(at.x), plain(at.y), plain(at.z)};
    nearest = known ? known->nearest : nearest_in(spheres, point);
    if (nearest - width > limit) return false;
    // only spheres within the width of the nearest one take part: they are found once
    const int most = 64;
    int members[most], found = 0, kept[HELD_MEMBERS + 1];
    Number gaps[most], held[HELD_MEMBERS + 1];
    SPREAD
    for (int q = 0; q < HELD_MEMBERS; q++) {
        kept[q] = 0;
        held[q] = Number(1e30);
    }
#if QUEUED
    const int times = halvings(spheres.count);
    INNER
    for (unsigned rest = known ? known->members : ~0u; rest != 0; rest &= rest - 1) {
        const int from = lowest_bit(rest) << times;
        INNER
        for (int i = from; i < from + (1 << times) && i < spheres.count; i++) {
            const AlignedRow s = row_of(spheres.geometry.value + spheres.first + 4LL * i);
            const Number x = point[0] - s.a, y = point[1] - s.b, z = point[2] - s.c;
            const Number gap = root(x * x + y * y + z * z) - s.d - nearest;
            if (!(gap < width)) continue;
            SPREAD
            for (int q = 0; q < HELD_MEMBERS; q++) {
                kept[q] = found == q ? i : kept[q];
                held[q] = found == q ? gap : held[q];
            }
            if (found >= HELD_MEMBERS && found < most) {
                members[found] = i;
                gaps[found] = gap;
            }
            found++;
        }
    }
#else
    Number squares[AT_ONCE], radii[AT_ONCE];
    for (int first = 0; first < spheres.count; first += AT_ONCE) {
        squares_to(spheres, first, point, squares, radii);
        for (int k = 0; k < AT_ONCE && first + k < spheres.count; k++) {
            if (!below(squares[k], radii[k], nearest + width)) continue;
            Number gap = root(squares[k]) - radii[k] - nearest;
            if (!(gap < width)) continue;
            if (found < most) {
                members[found] = first + k;
                gaps[found] = gap;
            }
            found++;
        }
    }
#endif
    bool few = found <= most;
    const int listed = few ? HELD_MEMBERS : 0;
    if (!few) {
        SPREAD
        for (int q = 0; q < HELD_MEMBERS; q++) held[q] = Number(1e30);
    }
    Vec aways[HELD_MEMBERS + 1];
    Real lengths[HELD_MEMBERS + 1], radii_held[HELD_MEMBERS + 1];
    SPREAD
    for (int q = 0; q < HELD_MEMBERS; q++) {
        aways[q] = at - spheres.center(kept[q]);
        radii_held[q] = spheres.radius(kept[q]);
        lengths[q] = root(dot(aways[q], aways[q]));
    }
#define EACH_MEMBER INNER for (int m = listed; m < (few ? found : spheres.count); m++)
#define MEMBER                                                                                     \
    int i = few ? members[m] : m;                                                                  \
    Number gap = few ? gaps[m] : root(square_to(spheres, i, point)) - plain_radius(spheres, i) - nearest;
    // solve sum over spheres of max(0, t - x)^2 = width^2 for t: Newton from above, where the sum is convex and rising
    Number t = width;
    INNER
    for (int round = 0; round < 40; round++) {
        Number squares = Number(0), sum = Number(0);
        SPREAD
        for (int q = 0; q < HELD_MEMBERS; q++) {
            Number below = greater(t - held[q], Number(0));
            squares += below * below;
            sum += below;
        }
        EACH_MEMBER {
            MEMBER
            Number below = t - gap;
            if (below > Number(0)) {
                squares += below * below;
                sum += below;
            }
        }
        Number down = quotient(squares - width * width, Number(2) * sum);
        if (!(down > Number(SINGLE ? 1e-6 : 1e-13) * width)) break;
        t -= down;
    }
    // once the set of active spheres is known: the closed form and its derivative
    Real first = Real(0), second = Real(0);
    Number count = Number(0);
    SPREAD
    for (int q = 0; q < HELD_MEMBERS; q++) {
        if (!(held[q] < t)) continue;
        Real x = lengths[q] - radii_held[q] - Real(nearest);
        first += x;
        second += x * x;
        count += Number(1);
    }
    EACH_MEMBER {
        MEMBER
        if (!(gap < t)) continue;
        Vec away = at - spheres.center(i);
        Real x = root(dot(away, away)) - spheres.radius(i) - Real(nearest);
        first += x;
        second += x * x;
        count += Number(1);
    }
    Real inside = at_least(first * first - count * (second - Real(width * width)), Number(0));
    Real solved = reciprocal(Real(count)) * (first + root(inside));
    Real cubes = Real(0);
    Vec gradient = none();
    SPREAD
    for (int q = 0; q < HELD_MEMBERS; q++) {
        if (!(held[q] < t)) continue;
        Real a = Number(1 / SMOOTHING_M) * (solved - (lengths[q] - radii_held[q] - Real(nearest)));
        a = at_least(a, Number(0));
        cubes += a * a * a;
        gradient = gradient + a * a * reciprocal(at_least(lengths[q], Number(1e-12))) * aways[q];
    }
    EACH_MEMBER {
        MEMBER
        if (!(gap < t)) continue;
        Vec away = at - spheres.center(i);
        Real length = root(dot(away, away));
        Real a = Number(1 / SMOOTHING_M) * (solved - (length - spheres.radius(i) - Real(nearest)));
        a = at_least(a, Number(0));
        cubes += a * a * a;
        gradient = gradient + a * a * reciprocal(at_least(length, Number(1e-12))) * away;
    }
    distance = Real(nearest) + solved - Number(SMOOTHING_M / 3) * (cubes + Real(2));
    Real norm2 = dot(gradient, gradient);
    outward = plain(norm2) > Number(1e-16) ? inverse_root(norm2) * gradient : up;
    return true;
}
#endif
