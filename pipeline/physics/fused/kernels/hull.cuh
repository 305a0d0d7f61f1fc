// Distance from the hull of a body's spheres, and crossing edges of two hulls; formulas of `physics/hull.py` and
// `physics/edge_contact.py`.
#if PAIRED
#if HULLS
// On a CPU, eight numbers at once: g++ has vectors of any length, which it puts into those of the processor. Nothing is
// summed in another order, so that results have the bits of those that are computed one by one.
#if HOST && defined(__GNUC__) && !defined(__clang__)
#define PACKED 1
#pragma GCC diagnostic ignored "-Wpsabi"  // such vectors stay within this program
typedef Number Eight __attribute__((vector_size(8 * sizeof(Number))));
INLINE Eight eight_at(const Number* from) {
    Eight all;
    __builtin_memcpy(&all, from, sizeof(all));
    return all;
}
INLINE Eight lesser(Eight a, Eight b) { return a < b ? a : b; }
INLINE Eight greater(Eight a, Eight b) { return a > b ? a : b; }
#else
#define PACKED 0
#endif

struct Hull {  // of a body's spheres, in its frame: see physics/hull.py
    Union spheres;
    long long row;  // of the first face
    int faces, edges, supports, ridges;
    // value of affine function `k` of face `i`: height over the plane (0), barycentric coordinates of the foot (1, 2)
    INLINE Number affine(int i, int k, const Number* p) const {
        const Number* f = spheres.geometry.value + row + 4LL * (3 * i + k);
        Number sum = f[0] * p[0] + f[1] * p[1] + f[2] * p[2];
        return k == 0 ? sum - f[3] : sum + f[3];
    }
#if PACKED
    // The same of eight faces from face `i` on.
    INLINE Eight affine_of_eight(int i, int k, const Number* p) const {
        const Eight sum = eight_at(plane(4 * k, i)) * p[0] + eight_at(plane(4 * k + 1, i)) * p[1] +
                          eight_at(plane(4 * k + 2, i)) * p[2];
        const Eight last = eight_at(plane(4 * k + 3, i));
        return k == 0 ? sum - last : sum + last;
    }
#endif
    // Whether the foot of a point lies within a face, or beyond its border by at most `margin`.
    INLINE bool over(int i, const Number* p, Number margin) const {
        const Number *a = spheres.geometry.value + row + 12LL * i + 4, *b = a + 4;
        Number x = a[0] + b[0], y = a[1] + b[1], z = a[2] + b[2], second = affine(i, 1, p), third = affine(i, 2, p);
        return second >= -margin * root(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) &&
               third >= -margin * root(b[0] * b[0] + b[1] * b[1] + b[2] * b[2]) &&
               second + third <= Number(1) + margin * root(x * x + y * y + z * z);
    }
    // Whether two faces lie in one plane.
    INLINE bool same_plane(int i, int j) const {
        const Number *a = spheres.geometry.value + row + 12LL * i, *b = spheres.geometry.value + row + 12LL * j;
        Number x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2], h = a[3] - b[3];
        return x * x + y * y + z * z < Number(SAME_NORMAL * SAME_NORMAL) && h * h < Number(SAME_PLANE_M * SAME_PLANE_M);
    }
    INLINE bool over_flat(int face, const Number* p) const {
        for (int i = 0; i < faces; i++) {
            if (same_plane(i, face) && over(i, p, Number(OVERHANG_M))) return true;
        }
        return false;
    }
    // The sphere that supports the hull, number `k`.
    INLINE const Number* support(int k) const {
        const Number* index = spheres.geometry.value + row + 4LL * (3 * faces + edges + k);
        return spheres.geometry.value + spheres.first + 4LL * (int)index[0];
    }
    INLINE int sphere(int edge, int end) const {
        return (int)spheres.geometry.value[row + 4LL * (3 * faces + edge) + end];
    }
    // First row of an edge between faces in different planes: its spheres, then vectors away from it in both faces.
    INLINE long long ridge(int i) const { return row + 4LL * (3 * faces + edges + supports + 3 * i); }
    // Number of faces in the copy of their numbers below.
    INLINE int planes() const { return (faces + 7) / 8 * 8; }
    // Number `k` of 12 of the faces from face `i` on, as in `_hull_rows`.
    INLINE const Number* plane(int k, int i) const {
        return spheres.geometry.value + ridge(ridges) + (long long)k * planes() + i;
    }
};

INLINE Edge edge_of(const Hull& hull, int i) {
    const Input& geometry = hull.spheres.geometry;
    long long row = hull.ridge(i);
    int first = (int)geometry.value[row], second = (int)geometry.value[row + 1];
    Vec start = hull.spheres.center(first);
    Real radius = hull.spheres.radius(first);
    Edge edge = {start, hull.spheres.center(second) - start, geometry.vector(row + 4), geometry.vector(row + 8),
                 radius, hull.spheres.radius(second) - radius};
    return edge;
}

INLINE Edge placed_edge(const Edge& edge, const Mat& rotation, Vec origin) {
    Edge placed = {origin + rotation * edge.start, rotation * edge.along, rotation * edge.inward,
                   rotation * edge.other_inward, edge.radius, edge.widening};
    return placed;
}

// Whether two edges lean by more than a bound, up to rounding, without the root that their normal needs: most do. Threads
// of a warp that compare other bodies would wait for those that do not.
INLINE bool surely_lean(const Edge& first, const Edge& second, Number bound) {
#if !HOST && !GATHERED
    return false;
#else
    const Vec over = cross(first.along, second.along);
    const Number side = plain(dot(first.inward + first.other_inward, over)) > Number(0) ? Number(-1) : Number(1);
    const Number most = greater(greater(side * plain(dot(over, first.inward)), side * plain(dot(over, first.other_inward))),
                                -lesser(side * plain(dot(over, second.inward)), side * plain(dot(over, second.other_inward))));
    const Number least = bound + Number(1e-6);
    return most > Number(0) && most * most > least * least * plain(dot(over, over));
#endif
}

// Whether the first edge, from its first to its second end, leaves the body of the second.
INLINE bool edge_leaves(const Edge& first, const Edge& second) {
    return plain(dot(second.inward + second.other_inward, first.along)) < Number(0);
}

// Returns false for edges that are nearly parallel.
INLINE bool cross_edges(const Edge& first, const Edge& second, Crossing& found) {
    Vec over = cross(first.along, second.along), apart = second.start - first.start;
    Real size2 = dot(over, over);
    Number lengths = plain(dot(first.along, first.along)) * plain(dot(second.along, second.along));
    if (plain(size2) <= Number(LEAST_CROSSING) * lengths) return false;
    Real each = inverse_root(size2), less = each * each;
    if (plain(dot(first.inward + first.other_inward, over)) > Number(0)) each = -each;
    found.normal = each * over;
    found.place = less * dot(cross(apart, second.along), over);
    Real other = less * dot(cross(apart, first.along), over);
    found.gap = dot(found.normal, apart) - first.radius - found.place * first.widening - second.radius -
                other * second.widening;
    found.lean = greater(greater(plain(dot(found.normal, first.inward)), plain(dot(found.normal, first.other_inward))),
                         -lesser(plain(dot(found.normal, second.inward)), plain(dot(found.normal, second.other_inward))));
    found.leaves = edge_leaves(first, second);
    found.within = plain(found.place) >= Number(0) && plain(found.place) <= Number(1) && plain(other) >= Number(0) &&
                   plain(other) <= Number(1);
    return true;
}

// Returns the distance of a point from the hull of two spheres, and the outward normal.
INLINE Real edge_distance(const Hull& hull, int edge, Vec at, Vec& outward) {
    int i = hull.sphere(edge, 0), j = hull.sphere(edge, 1);
    Vec start = hull.spheres.center(i), along = hull.spheres.center(j) - start, away = at - start;
    Real first = hull.spheres.radius(i), each = inverse_root(dot(along, along)), length = reciprocal(each);
    Vec axis = each * along;
    Real x = dot(away, axis);
    Vec across = away - x * axis;
    Real y = root(at_least(dot(across, across), Number(1e-30))), slope = each * (first - hull.spheres.radius(j));
    Real place = x - y * slope * inverse_root(at_least(Real(Number(1)) - slope * slope, Number(1e-12)));
    place = at_least(place, Number(0));
    if (plain(place) > plain(length)) place = length;
    Vec arm = away - place * axis;
    Real size = root(at_least(dot(arm, arm), Number(1e-30)));
    outward = reciprocal(size) * arm;
    return size - first + slope * place;
}

// The same without derivatives, for the choice of the nearest edge.
INLINE Number plain_edge_distance(const Hull& hull, int edge, const Number* p) {
    const Number *s = hull.spheres.geometry.value + hull.spheres.first + 4LL * hull.sphere(edge, 0),
                 *e = hull.spheres.geometry.value + hull.spheres.first + 4LL * hull.sphere(edge, 1);
    Number ax = e[0] - s[0], ay = e[1] - s[1], az = e[2] - s[2], qx = p[0] - s[0], qy = p[1] - s[1], qz = p[2] - s[2];
    Number length2 = ax * ax + ay * ay + az * az, length = root(length2), x = (qx * ax + qy * ay + qz * az) / length;
    Number y = root(greater(qx * qx + qy * qy + qz * qz - x * x, Number(1e-30))), slope = (s[3] - e[3]) / length;
    Number place = x - y * slope / root(greater(Number(1) - slope * slope, Number(1e-12)));
    place = lesser(greater(place, Number(0)), length);
    return root(greater((x - place) * (x - place) + y * y, Number(1e-30))) - s[3] + slope * place;
}

// Finds the greatest height of a point over the planes of a hull, and the greatest over the faces in which its foot lies, and
// that face. Of a point beyond a plane by more than `limit` only the first is of use.
INLINE void over_faces(const Hull& hull, const Number* p, Number limit, Number& most, Number& best, int& face) {
    most = best = Number(-1e30);
    face = 0;
#if PACKED
    Eight above = Eight{} + most;
    for (int i = 0; i < hull.faces; i += 8) above = greater(hull.affine_of_eight(i, 0, p), above);
    for (int k = 0; k < 8; k++) most = greater(most, above[k]);
    if (most > limit) return;
    for (int i = 0; i < hull.faces; i += 8) {
        const Eight height = hull.affine_of_eight(i, 0, p), second = hull.affine_of_eight(i, 1, p),
                    third = hull.affine_of_eight(i, 2, p);
        const auto beside = (second < Number(0)) | (third < Number(0)) | (second + third > Number(1));
        const Eight over = beside ? Eight{} + Number(-1e30) : height;
        for (int k = 0; k < 8; k++) {
            if (!(over[k] > best)) continue;
            best = over[k];
            face = i + k;
        }
    }
#else
    for (int i = 0; i < hull.faces; i++) {
        Number height = hull.affine(i, 0, p);
        most = greater(most, height);
        if (!(height > best)) continue;
        Number second = hull.affine(i, 1, p), third = hull.affine(i, 2, p);
        if (second < Number(0) || third < Number(0) || second + third > Number(1)) continue;
        best = height;
        face = i;
    }
#endif
}

// Whether the distance of a point from a hull that is no more than `limit` is that from an edge.
INLINE bool nears_edge(const Hull& hull, const Number* p, int flat, Number limit) {
    if (flat >= 0 && hull.over_flat(flat, p)) return false;
    Number most, best;
    int face;
    over_faces(hull, p, limit, most, best, face);
    return !(most > limit) && !(best > Number(0) || best >= most - Number(SAME_PLANE_M));
}

// As `union_distance`, for the hull of the spheres; `nearest` is the distance without derivatives. Over the flat side of
// the face `flat`, if it is not -1, the distance is that to its plane. `edge` is the nearest one, -1 where it is to be sought.
__device__ bool distance_to_hull(const Hull& hull, Vec at, int flat, int edge, Number limit, Real& distance,
                                 Number& nearest, Vec& outward) {
    const Number p[3] = {plain(at.x), plain(at.y), plain(at.z)};
    const Input& geometry = hull.spheres.geometry;
    if (flat >= 0 && hull.over_flat(flat, p)) {
        nearest = hull.affine(flat, 0, p);
        if (nearest > limit) return false;
        outward = geometry.vector(hull.row + 12LL * flat);
        distance = dot(outward, at) - geometry.at(hull.row + 12LL * flat + 3);
        return true;
    }
    Number most, best;
    int face;
    over_faces(hull, p, limit, most, best, face);
    if (most > limit) return false;  // no point of the hull is nearer than any of its planes
    if (best > Number(0) || best >= most - Number(SAME_PLANE_M)) {
        long long row = hull.row + 12LL * face;
        outward = geometry.vector(row);
        distance = dot(outward, at) - geometry.at(row + 3);
        nearest = best;
        return true;
    }
    if (edge >= 0) {
        nearest = plain_edge_distance(hull, edge, p);
    } else {
        nearest = Number(1e30);
        edge = 0;
        for (int i = 0; i < hull.edges; i++) {
            Number away = plain_edge_distance(hull, i, p);
            if (away < nearest) {
                nearest = away;
                edge = i;
            }
        }
    }
    if (nearest > limit) return false;
    distance = edge_distance(hull, edge, at, outward);
    return true;
}
#endif
#endif
