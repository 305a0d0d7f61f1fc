// Distances of spheres from fixed surfaces; formulas of `physics/surfaces/fixed_surface.py` and `physics/surfaces/surface_mesh.py`.
#if FIXED
// A fixed surface: its pose in the kernel's frame, and its size as in `physics/surfaces/fixed_surface.py`.
struct Fixed {
    Vec position, size;
    Mat rotation;
};

INLINE Fixed fixed_surface(const Problem& problem, const Environment& env, int s) {
    long long at = env.surfaces + SURFACE_WIDTH * s;
    const Input& rows = problem.surfaces;
    Quat quat = {rows.at(at + 3), rows.at(at + 4), rows.at(at + 5), rows.at(at + 6)};
    Fixed fixed = {rows.vector(at), rows.vector(at + 7), matrix(quat)};
    return fixed;
}

// Distance of a point to the corner x, y, z <= 0 of half spaces, and the normal there.
INLINE Real corner_distance(Vec past, Vec& outward) {
    Vec out = vec(at_least(past.x, Number(0)), at_least(past.y, Number(0)), at_least(past.z, Number(0)));
    Real size2 = dot(out, out);
    if (plain(size2) > Number(0)) {
        Real size = root(size2);
        outward = reciprocal(size) * out;
        return size;
    }
    Number x = plain(past.x), y = plain(past.y), z = plain(past.z);
    if (x >= y && x >= z) {
        outward = vec(Real(1), Real(0), Real(0));
        return past.x;
    }
    outward = y >= z ? vec(Real(0), Real(1), Real(0)) : vec(Real(0), Real(0), Real(1));
    return y >= z ? past.y : past.z;
}

// Signed distance of a point in the frame of a half space, box or cylinder, and the normal there.
INLINE Real shape_distance(int kind, Vec size, Vec at, Vec& outward) {
    if (kind == HALF_SPACE_KIND) {
        outward = vec(Real(0), Real(0), Real(1));
        return at.z;
    }
    Number x = plain(at.x) < Number(0) ? Number(-1) : Number(1), y = plain(at.y) < Number(0) ? Number(-1) : Number(1),
           z = plain(at.z) < Number(0) ? Number(-1) : Number(1);
    if (kind == BOX_KIND) {
        Real distance = corner_distance(vec(x * at.x - size.x, y * at.y - size.y, z * at.z - size.z), outward);
        outward = vec(x * outward.x, y * outward.y, z * outward.z);
        return distance;
    }
    Real radius = root(at.x * at.x + at.y * at.y);
    Vec flat;
    Real distance = corner_distance(vec(Real(Number(-1e30)), radius - size.y, z * at.z - size.z), flat);
    bool off = plain(radius) > Number(0);
    Real each = off ? reciprocal(radius) : Real(0);
    outward = vec(flat.y * (off ? each * at.x : Real(1)), flat.y * each * at.y, z * flat.z);
    return distance;
}

struct Meeting {  // of a sphere's centre with a surface, in the frame of the surface
    Real distance;
    Vec outward;
};

struct Searched {  // the sphere of a pair whose contacts with a mesh were found last, and these contacts
    int sphere;
#if MESHES
    int count, features[MESH_CONTACTS];
    bool inside;
#endif
};

#if MESHES
#define FEATURES 7
#define FLAT Number(FLAT_SINE)

struct Point {
    Number x, y, z;
};
INLINE Point operator-(Point a, Point b) { Point p = {a.x - b.x, a.y - b.y, a.z - b.z}; return p; }
INLINE Number dot(Point a, Point b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Point cross(Point a, Point b) {
    Point p = {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    return p;
}
INLINE Point scaled(Number s, Point a) { Point p = {s * a.x, s * a.y, s * a.z}; return p; }
INLINE Point point(const Number* at) { Point p = {at[0], at[1], at[2]}; return p; }
INLINE Point off_side(Point arm, Point side) { return arm - scaled(dot(arm, side) / dot(side, side), side); }

// A triangle mesh as `SurfaceMesh.numbers` and `SurfaceMesh.indices` of `physics/surfaces/surface_mesh.py` write it.
struct TriangleMesh {
    Point low, high, near_low;
    Number cell, near_cell, near_reach;
    int cells[3], near_cells[3], solid;
    const Number *corners, *pseudonormals, *prisms, *ways;
    const int *way_start, *way_count, *first_cells, *starts, *triangles, *near_starts, *near_triangles;
};

INLINE TriangleMesh triangle_mesh(const Problem& problem, int s) {
    const Number* numbers = problem.mesh_numbers + mesh_number_start(s);
    const int* indices = problem.mesh_indices + mesh_index_start(s);
    TriangleMesh m;
    m.low = point(numbers);
    m.high = point(numbers + 3);
    m.cell = numbers[6];
    m.near_low = point(numbers + 7);
    m.near_cell = numbers[10];
    m.near_reach = numbers[11];
    for (int k = 0; k < 3; k++) {
        m.cells[k] = indices[k];
        m.near_cells[k] = indices[6 + k];
    }
    int count = indices[3];
    m.solid = indices[4];
    m.corners = numbers + 12;
    m.pseudonormals = m.corners + 9LL * count;
    m.prisms = m.pseudonormals + 21LL * count;
    m.ways = m.prisms + 16LL * count;
    m.way_start = indices + 11;
    m.way_count = m.way_start + 7LL * count;
    m.first_cells = m.way_count + 7LL * count;
    m.starts = m.first_cells + 3LL * count;
    m.triangles = m.starts + indices[5];
    m.near_starts = m.triangles + indices[9];
    m.near_triangles = m.near_starts + indices[10];
    return m;
}

// The feature of triangle abc nearest to p, and the offset from there to p; see `_closest` in `surface_mesh.py`.
__device__ int closest(const Number* corners, Point p, Point& offset) {
    Point a = point(corners), b = point(corners + 3), c = point(corners + 6);
    Point ab = b - a, ac = c - a, pa = p - a, pb = p - b, pc = p - c;
    Number d1 = dot(ab, pa), d2 = dot(ac, pa), d3 = dot(ab, pb), d4 = dot(ac, pb), d5 = dot(ab, pc), d6 = dot(ac, pc);
    offset = pa;
    if (d1 <= 0 && d2 <= 0) return 4;
    offset = pb;
    if (d3 >= 0 && d4 <= d3) return 5;
    offset = pc;
    if (d6 >= 0 && d5 <= d6) return 6;
    if (d1 * d4 - d3 * d2 <= 0 && d1 >= 0 && d3 <= 0) {
        offset = off_side(pa, ab);
        return 1;
    }
    if (d5 * d2 - d1 * d6 <= 0 && d2 >= 0 && d6 <= 0) {
        offset = off_side(pa, ac);
        return 3;
    }
    if (d3 * d6 - d5 * d4 <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) {
        offset = off_side(pb, c - b);
        return 2;
    }
    Point normal = cross(ab, ac);
    offset = scaled(dot(normal, pa) / dot(normal, normal), normal);
    return 0;
}

// Whether the distance to the mesh has a local minimum at a feature that this triangle counts for.
INLINE bool is_minimal(const TriangleMesh& m, int feature, Point offset, Number far) {
    int many = m.way_count[feature];
    if (many < 0) return false;
    const Number* way = m.ways + 3LL * m.way_start[feature];
    for (int k = 0; k < many; k++, way += 3) {
        if (dot(offset, point(way)) > FLAT * far) return false;
    }
    return true;
}

// Whether the distance from a point to the mesh has no minimum within reach at a triangle, since the point is beside it:
// see `mesh_overhangs.py`.
INLINE bool is_beside(const TriangleMesh& m, int triangle, Point p, Number reach) {
    const Number *corners = m.corners + 9LL * triangle, *prism = m.prisms + 16LL * triangle;
    Point a = p - point(corners);
    Number height = dot(a, point(prism)), high = height < Number(0) ? -height : height;
    if (!(high < reach)) return true;
    int below = height < Number(0), open = (int)prism[14 + below];
    Number slack = Number(1e-5) * reach, most = prism[12 + below] * high + slack;
    if (!open) {
        return dot(a, point(prism + 3)) > most || dot(a, point(prism + 9)) > most ||
               dot(p - point(corners + 3), point(prism + 6)) > most;
    }
    Number out[3] = {dot(a, point(prism + 3)), dot(p - point(corners + 3), point(prism + 6)), dot(a, point(prism + 9))};
    bool beyond = false;
    for (int k = 0; k < 3; k++) {
        if (!(open >> k & 1)) beyond = beyond || out[k] > most;
        else if (!(out[k] < -slack)) return false;
    }
    return beyond;
}

INLINE int cell_of(Number at, Number low, Number cell, int count) {
    Number k = floor((at - low) / cell);
    return k < Number(0) ? 0 : (k > Number(count - 1) ? count - 1 : (int)k);
}

// How far a point is outside of the box of a mesh along each axis, 0 within.
INLINE Point beyond_box(const TriangleMesh& m, Point p) {
    Point low = m.low - p, high = p - m.high;
    Point out = {greater(greater(low.x, high.x), Number(0)), greater(greater(low.y, high.y), Number(0)),
                 greater(greater(low.z, high.z), Number(0))};
    return out;
}

// The contacts of a sphere with a mesh that are found first, by distance, and the nearest place.
struct Nearest {
    Number distances[MESH_CONTACTS], keys[MESH_CONTACTS], distance, along;
    int feature;
};

// Adds what a sphere about p touches of a triangle.
INLINE void look_at(const TriangleMesh& m, int triangle, Point p, Number reach, Searched& found, Nearest& nearest) {
    if (is_beside(m, triangle, p, reach)) return;
    Point offset;
    int feature = FEATURES * triangle + closest(m.corners + 9LL * triangle, p, offset);
    Number far = root(dot(offset, offset));
    if (!(far < reach)) return;
    if (m.solid) {
        Number along = dot(offset, point(m.pseudonormals + 3LL * feature));
        bool equal = far == nearest.distance, behind = along < Number(0), was = nearest.along < Number(0);
        bool first = behind == was ? feature < nearest.feature : behind;
        if (far < nearest.distance || (equal && first)) {
            nearest.distance = far;
            nearest.along = along;
            nearest.feature = feature;
        }
        if (behind) return;  // the far side of a wall
    }
    if (!is_minimal(m, feature, offset, far)) return;
    int place = found.count;
    while (place > 0 && (far < nearest.distances[place - 1] ||
                         (far == nearest.distances[place - 1] && feature < found.features[place - 1]))) place--;
    if (place == MESH_CONTACTS) return;
    if (found.count < MESH_CONTACTS) found.count++;
    for (int q = found.count - 1; q > place; q--) {
        nearest.distances[q] = nearest.distances[q - 1];
        nearest.keys[q] = nearest.keys[q - 1];
        found.features[q] = found.features[q - 1];
    }
    nearest.distances[place] = far;
    Point order = {Number(ORDER_X), Number(ORDER_Y), Number(ORDER_Z)};
    nearest.keys[place] = dot(offset, order) / greater(far, Number(1e-15));
    found.features[place] = feature;
}

// Looks at the triangles that a sphere about p may touch within the reach of the grid of centres.
INLINE void look_nearby(const TriangleMesh& m, Point p, Number reach, Searched& found, Nearest& nearest) {
    Point from = scaled(Number(1) / m.near_cell, p - m.near_low);
    if (from.x < Number(0) || from.y < Number(0) || from.z < Number(0)) return;
    if (!(from.x < Number(m.near_cells[0]) && from.y < Number(m.near_cells[1]) && from.z < Number(m.near_cells[2]))) return;
    int cell = ((int)from.x * m.near_cells[1] + (int)from.y) * m.near_cells[2] + (int)from.z;
    for (int entry = m.near_starts[cell]; entry < m.near_starts[cell + 1]; entry++) {
        look_at(m, m.near_triangles[entry], p, reach, found, nearest);
    }
}

// Looks at all triangles within reach.
INLINE void look_around(const TriangleMesh& m, Point p, Number reach, Searched& found, Nearest& nearest) {
    int from[3] = {cell_of(p.x - reach, m.low.x, m.cell, m.cells[0]), cell_of(p.y - reach, m.low.y, m.cell, m.cells[1]),
                   cell_of(p.z - reach, m.low.z, m.cell, m.cells[2])};
    int to[3] = {cell_of(p.x + reach, m.low.x, m.cell, m.cells[0]), cell_of(p.y + reach, m.low.y, m.cell, m.cells[1]),
                 cell_of(p.z + reach, m.low.z, m.cell, m.cells[2])};
    for (int i = from[0]; i <= to[0]; i++)
    for (int j = from[1]; j <= to[1]; j++)
    for (int k = from[2]; k <= to[2]; k++) {
        int cell = (i * m.cells[1] + j) * m.cells[2] + k;
        for (int entry = m.starts[cell]; entry < m.starts[cell + 1]; entry++) {
            int triangle = m.triangles[entry];
            // a triangle in several cells counts in the first one of those that are looked at
            const int* first = m.first_cells + 3LL * triangle;
            if ((i > from[0] && first[0] < i) || (j > from[1] && first[1] < j) || (k > from[2] && first[2] < k)) continue;
            look_at(m, triangle, p, reach, found, nearest);
        }
    }
}

// Finds the contacts of a sphere with a mesh; see `SurfaceMesh.features`.
__device__ void find(const TriangleMesh& m, Point p, Number radius, Number margin, Searched& found) {
    Number reach = (m.solid ? greater(radius, m.cell) : radius) + margin;
    found.count = 0;
    found.inside = false;
    Point outside = beyond_box(m, p);
    if (!(dot(outside, outside) < reach * reach)) return;
    Nearest nearest;
    nearest.distance = Number(1e30);
    nearest.along = Number(0);
    nearest.feature = 0;
    if (reach < m.near_reach) look_nearby(m, p, reach, found, nearest);
    else look_around(m, p, reach, found, nearest);
    if (m.solid && nearest.along < Number(0)) {
        found.inside = true;
        found.count = 1;
        found.features[0] = nearest.feature;
        return;
    }
    for (int i = 1; i < found.count; i++) {  // so that each contact keeps its slot
        for (int j = i; j > 0 && nearest.keys[j] < nearest.keys[j - 1]; j--) {
            Number key = nearest.keys[j];
            int feature = found.features[j];
            nearest.keys[j] = nearest.keys[j - 1];
            found.features[j] = found.features[j - 1];
            nearest.keys[j - 1] = key;
            found.features[j - 1] = feature;
        }
    }
}

INLINE Vec constant(Point p) { return vec(Real(p.x), Real(p.y), Real(p.z)); }

// Signed distance of a point to a feature, and the normal there.
__device__ Meeting feature_distance(const TriangleMesh& m, int number, bool inside, Vec at) {
    const Number* corners = m.corners + 9LL * (number / FEATURES);
    int feature = number % FEATURES, k = feature > 3 ? feature - 4 : feature > 0 ? feature - 1 : 0;
    Point place = point(corners + 3 * k);
    Vec arm = at - constant(place);
    Meeting meeting;
    if (feature == 0) {
        Point normal = cross(point(corners + 3) - place, point(corners + 6) - place);
        normal = scaled(Number(1) / root(dot(normal, normal)), normal);
        meeting.distance = dot(arm, constant(normal));
        meeting.outward = constant(normal);
        if (!m.solid && plain(meeting.distance) < Number(0)) {
            meeting.distance = -meeting.distance;
            meeting.outward = -meeting.outward;
        }
        return meeting;
    }
    if (feature < 4) {
        Point side = point(corners + 3 * ((k + 1) % 3)) - place;
        Vec along = constant(scaled(Number(1) / root(dot(side, side)), side));
        arm = arm - dot(arm, along) * along;
    }
    Real size = root(dot(arm, arm));
    Number sign = inside ? Number(-1) : Number(1);
    bool apart = plain(size) > Number(0);
    meeting.distance = sign * size;
    meeting.outward = sign * (apart ? reciprocal(size) * arm : vec(Real(0), Real(0), Real(1)));
    return meeting;
}

#endif

// A lower bound of the distance of a point, in the frame of the surface; exact but for meshes.
INLINE Number least_distance(const Problem& problem, const Fixed& fixed, int s, Vec at) {
#if MESHES
    if (surface_kind(s) == MESH_KIND) {
        Point p = {plain(at.x), plain(at.y), plain(at.z)}, outside = beyond_box(triangle_mesh(problem, s), p);
        return root(dot(outside, outside));
    }
#endif
    Vec outward;
    return plain(shape_distance(surface_kind(s), fixed.size, at, outward));
}

// Finds one slot of a body with a surface: the distance of the sphere's centre and the normal, in the kernel's frame.
// Returns false for a slot of a mesh without a contact within a step; without a motion, without one at all.
__device__ bool meet(const Problem& problem, const Environment& env, const Fixed& fixed, int p, int k,
                     const Mat& rotation, const Motion* motion, Searched& searched, Vec& center, Real& radius,
                     Meeting& meeting) {
    int a = pair_a(p), s = -2 - pair_b(p);
    long long row = env.geometry + 4LL * problem.spheres[contact_start(p) + k];
    const Vec arm = rotation * (problem.geometry.vector(row) - env.constants[a].com);
    center = env.bodies[a].position + arm;
    radius = problem.geometry.at(row + 3);
    Vec at = transposed(fixed.rotation, center - fixed.position);
#if MESHES
    if (surface_kind(s) == MESH_KIND) {
        TriangleMesh m = triangle_mesh(problem, s);
        if (k / MESH_CONTACTS != searched.sphere) {
            Point local = {plain(at.x), plain(at.y), plain(at.z)};
            // no gap of the sphere changes by more in a step, up to rounding
            Number margin = Number(0);
            if (motion) margin = plain(env.laws[0].step_s) * size(motion->velocity + cross(motion->omega, arm)) + Number(1e-6);
            find(m, local, plain(radius), margin, searched);
            searched.sphere = k / MESH_CONTACTS;
        }
        int number = k % MESH_CONTACTS;
        if (number >= searched.count) return false;
        meeting = feature_distance(m, searched.features[number], searched.inside, at);
        meeting.outward = fixed.rotation * meeting.outward;
        return true;
    }
#endif
    meeting.distance = shape_distance(surface_kind(s), fixed.size, at, meeting.outward);
    meeting.outward = fixed.rotation * meeting.outward;
    return true;
}
#endif
