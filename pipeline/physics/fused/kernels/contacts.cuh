// One contact: its law, and the distances from which it comes; formulas of `physics/contact_law.py`,
// `physics/impulse_solver.py`, `physics/smooth_distance.py`, `physics/hull.py` and `physics/edge_contact.py`.
struct Law {  // of a pair of materials, in a step
    Real step_s, inverse_step, stiffness, damping, friction;
#if SURFACE
    Surface surface;
#endif
};

struct Response {  // of a body to impulses: inverse mass and inertia, 0 if it is not free
    Real inverse_mass;
    Sym inverse_inertia;  // world axes
#if LINKS
    const Column* columns;  // of a link of a chain, `depth` of them
    int depth;
#endif
};

struct Moving : Velocities, Response {};

// What is kept of each body in a step. Where lanes share one copy of it, responses are made when they are needed: those
// of most bodies are not, as they are links that nothing touches.
#if SHARED
typedef Velocities Motion;
typedef const Chain& Responses;
#define RESPONSES(env, motions) (env).chain
INLINE Response response(const Chain& chain, int b) {
    const int l = body_link(b);
    Response r = {Real(0), no_inertia(), 0, 0};
    if (is_free(b)) {
        r.inverse_mass = chain.free_masses[FREE(b)];
        r.inverse_inertia = chain.free_inertias[FREE(b)];
    } else if (l >= 0 && chain.known[l]) {
        r.columns = chain.room.collide.columns + column_start[l];
        r.depth = link_depth[l];
    }
    return r;
}
INLINE Moving moving(const Chain& chain, const Motion* motions, int b) {
    Moving all;
    static_cast<Velocities&>(all) = motions[b];
    static_cast<Response&>(all) = response(chain, b);
    return all;
}
#else
typedef Moving Motion;
typedef const Motion* Responses;
#define RESPONSES(env, motions) motions
INLINE const Moving& response(const Motion* motions, int b) { return motions[b]; }
INLINE const Moving& moving(const Motion* motions, const Motion*, int b) { return motions[b]; }
#endif

INLINE Real friction_of(const Law& law, const Contact& c) {
#if SURFACE || LAWS > 1
    return c.friction;
#else
    return law.friction;
#endif
}

INLINE Real mobility_trace(const Response& m, Vec arm) {
    return Number(3) * m.inverse_mass + trace(m.inverse_inertia) * dot(arm, arm) - dot(arm, m.inverse_inertia * arm);
}

#if LINKS
// Adds what a body's point moves along a direction by an impulse along it, and the sum of that over three directions.
INLINE void add_mobility(const Response& m, Vec arm, Vec normal, Real& inverse_mass, Real& trace_of) {
    Vec turn = cross(arm, normal);
    inverse_mass += m.inverse_mass + dot(turn, m.inverse_inertia * turn);
    trace_of += mobility_trace(m, arm);
    EACH_ABOVE(k, m.depth) {
        Vec moved = m.columns[k].linear + cross(m.columns[k].turning, arm);
        inverse_mass += square(dot(normal, moved));
        trace_of += dot(moved, moved);
    }
}

// Velocity and angular velocity of a body by an impulse along a direction, with its moment.
INLINE void response_of(const Response& m, Vec normal, Vec turn, Vec& linear, Vec& angular) {
    linear = m.inverse_mass * normal;
    angular = m.inverse_inertia * turn;
    EACH_ABOVE(k, m.depth) {
        Real along = dot(m.columns[k].linear, normal) + dot(m.columns[k].turning, turn);
        linear = linear + along * m.columns[k].linear;
        angular = angular + along * m.columns[k].turning;
    }
}
#endif

// Speed at which a gap has to change by the end of a step, given the gap [m or rad] and its speed without contact: that
// of a spring and a damper. The damper acts for the share of the step in which the gap is closed.
INLINE Real wanted_speed(Real gap, Real speed, Real step_s, Real inverse_step, Real stiffness, Real damping) {
    Real ahead = gap + step_s * speed, closed = Real(1);
    if (plain(gap) > Number(0)) {
        Real way = step_s * (plain(speed) < Number(0) ? -speed : speed);
        closed = at_most(at_least(-ahead * reciprocal(at_least(way, Number(1e-12))), Number(0)), Number(1));
    }
    return speed - damping * closed * speed - stiffness * at_most(ahead, Number(0)) * inverse_step;
}

// The same by the law of a contact.
INLINE Real aim(const Law& law, Real gap, Real speed) {
    Real stiffness = law.stiffness, damping = law.damping;
#if SURFACE
    response(law.surface, law.step_s, speed, stiffness, damping);
#endif
    return wanted_speed(gap, speed, law.step_s, law.inverse_step, stiffness, damping);
}

// Sets the target velocity of a contact and returns whether it touches. `stop_n` and `stop_t` temporarily hold its
// effective mass and its tangential mobility, until `share_out` replaces them. `weight` is its weight among redundant
// contacts.
INLINE bool prepare(Contact& c, const Law& law, Real gap, Real speed, Real inverse_mass, Real mobility, Real& weight) {
    Real ahead = gap + law.step_s * speed;
    weight = Real(0);
#if LAWS > 1
    c.friction = law.friction;
#endif
    if (!(plain(gap) < Number(0) || plain(ahead) < Number(0))) return false;
    Real depth = plain(ahead) < plain(gap) ? -ahead : -gap;
    weight = at_most(at_least(Number(1.0 / ONSET_M) * depth, Number(0)), Number(1));
    c.target = aim(law, gap, speed);
    c.stop_n = reciprocal(inverse_mass);
    c.stop_t = mobility - inverse_mass;
    c.impulse = none();
#if PAIRED
    c.gap = gap;
#endif
    return true;
}

// Distributes the effective mass among redundant contacts; `total` is the sum of their weights times their redundancy.
INLINE void share_out(Contact& c, Real total, Real weight) {
    const Real tiny = Real(Number(1e-9));
    Real share = (weight + tiny) * reciprocal((plain(total) > plain(weight) ? total : weight) + tiny);
    c.stop_t = share * reciprocal(c.stop_t);
    c.stop_n = share * c.stop_n;
}

// Returns the impulse of a contact after one iteration of projected Gauss-Seidel, given the relative velocity.
INLINE Vec swept(const Contact& c, const Law& law, Vec relative) {
#if PAIRED
    Real speed = dot(relative, c.normal), before = dot(c.impulse, c.normal);
    Vec wanted = (c.impulse - before * c.normal) - c.stop_t * (relative - speed * c.normal);
    Real wanted2 = dot(wanted, wanted);
#else
    Real speed = relative.z, before = c.impulse.z;
    Real x = c.impulse.x - c.stop_t * relative.x, y = c.impulse.y - c.stop_t * relative.y;
#if SURFACE
    x -= c.steady_x;
    y -= c.steady_y;
#endif
#if !ELLIPTIC
    Real wanted2 = x * x + y * y;
#endif
#endif
    Real along = at_least(before + c.stop_n * (c.target - speed), Number(0));
#if ELLIPTIC
    put_in(c.ellipse, along, x, y);
    return vec(x + c.steady_x, y + c.steady_y, along);
#else
    Real most = friction_of(law, c) * along;
#if HOST
    // where the contact sticks, a predicted branch takes the root and the division out of the chain of iterations
    bool sticks = plain(wanted2) < Number(1 - 1e-6) * plain(most) * plain(most) - Number(1e-24);
#else
    const bool sticks = false;
#endif
    // the tiny number keeps the derivative of a contact without impulses finite
    Real scale = sticks ? Real(1) : most * inverse_root(wanted2 + Real(Number(1e-24)));
    scale = at_most(scale, Number(1));
#if PAIRED
    return along * c.normal + scale * wanted;
#elif SURFACE
    return vec(scale * x + c.steady_x, scale * y + c.steady_y, along);
#else
    return vec(scale * x, scale * y, along);
#endif
#endif
}

// Weighted moments of the Jacobian rows of contacts with one plane; a row is (1, arm_y, -arm_x), its metric (1/m,
// inverse inertia).
struct Moments {
    Real w, x, y, xx, xy, yy;
};
INLINE void add_row(Moments& m, const Contact& c, Real w) {
    Real x = c.arm.y, y = -c.arm.x, wx = w * x, wy = w * y;
    m.w += w;
    m.x += wx;
    m.y += wy;
    m.xx += wx * x;
    m.xy += wx * y;
    m.yy += wy * y;
}
INLINE Moments sum_rows(const Lanes& lanes, const Moments& m) {
    Moments s = {lanes.sum(m.w), lanes.sum(m.x), lanes.sum(m.y), lanes.sum(m.xx), lanes.sum(m.xy), lanes.sum(m.yy)};
    return s;
}
INLINE Real crowd(const Moments& m, const Moving& a, const Contact& c) {
    const Sym& J = a.inverse_inertia;
    Real x = c.arm.y, y = -c.arm.x;
    Real w = a.inverse_mass, u = J.xx * x + J.xy * y, v = J.xy * x + J.yy * y;
    Real linear = w * m.w + Number(2) * (u * m.x + v * m.y);
    return c.stop_n * (w * linear + u * u * m.xx + Number(2) * u * v * m.xy + v * v * m.yy);
}

// Prepares a contact with the ground, whose normal is z; `arm` is the lever arm of the sphere's centre.
INLINE bool touch_ground(Contact& c, const Law& law, const Moving& a, Vec arm, Real height, Real radius,
                         Real& weight) {
    const Sym& J = a.inverse_inertia;
    c.arm = vec(arm.x, arm.y, arm.z - radius);
    Real gap = height + c.arm.z, speed = a.velocity.z + a.omega.x * c.arm.y - a.omega.y * c.arm.x;
    Real x = c.arm.y, y = -c.arm.x;
    Real inverse_mass = a.inverse_mass + J.xx * x * x + Number(2) * J.xy * x * y + J.yy * y * y;
    return prepare(c, law, gap, speed, inverse_mass, mobility_trace(a, c.arm), weight);
}

#if SURFACE
// Sets the effects of the surface on a ground contact: local friction, and viscous drag, which is distributed among all
// contacts by weight; `total` is the sum of their weights.
INLINE void surface(Contact& c, const Law& law, const Moving& a, Vec com, Real weight, Real total) {
    const Surface& s = law.surface;
    Real u = a.velocity.x + a.omega.y * c.arm.z - a.omega.z * c.arm.y;
    Real v = a.velocity.y + a.omega.z * c.arm.x - a.omega.x * c.arm.z;
    c.friction = friction_at(s, law.friction, com.x + c.arm.x, com.y + c.arm.y, u, v);
#if ELLIPTIC
    c.ellipse = ellipse_of(s, c.friction);
#endif
    Real drag = law.step_s * s.viscous * weight * reciprocal(at_least(total, Number(0.02)));
    drag = -(drag * reciprocal(Real(Number(1)) + drag * reciprocal(c.stop_t)));
    c.steady_x = drag * u;
    c.steady_y = drag * v;
    c.turning = none();
}

// Angular impulse of rolling and torsional friction after one iteration. `across` and `about` are the reciprocals of
// the mobility about horizontal axes and about the normal, times the number of contacts that act on the same spin.
INLINE Vec turned_by(const Contact& c, const Law& law, const Moving& a, Real across, Real about) {
    Real x = c.turning.x - across * a.omega.x, y = c.turning.y - across * a.omega.y;
    Real z = c.turning.z - about * a.omega.z;
    Real roll = shortened(x * x + y * y, law.surface.rolling * c.impulse.z);
    return vec(roll * x, roll * y, shortened(z * z, law.surface.torsion * c.impulse.z) * z);
}
#endif

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

#if HULLS
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
};

struct Edge {  // between two faces of a hull, in any frame: see physics/edge_contact.py
    Vec start, along, inward, other_inward;
    Real radius, widening;
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

struct Crossing {  // the common normal of two edges, out of the first body
    Vec normal;
    Real gap, place;
    Number lean;  // by how much the normal leans towards a face of either edge
    bool within;  // whether its feet lie within the edges
    bool leaves;  // whether the first edge, from its first to its second end, leaves the other body
};

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
    found.leaves = plain(dot(second.inward + second.other_inward, first.along)) < Number(0);
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

// As `union_distance`, for the hull of the spheres; `nearest` is the distance without derivatives. Over the flat side of
// the face `flat`, if it is not -1, the distance is that to its plane.
__device__ bool distance_to_hull(const Hull& hull, Vec at, int flat, Number limit, Real& distance, Number& nearest,
                                 Vec& outward) {
    const Number p[3] = {plain(at.x), plain(at.y), plain(at.z)};
    const Input& geometry = hull.spheres.geometry;
    if (flat >= 0 && hull.over_flat(flat, p)) {
        nearest = hull.affine(flat, 0, p);
        if (nearest > limit) return false;
        outward = geometry.vector(hull.row + 12LL * flat);
        distance = dot(outward, at) - geometry.at(hull.row + 12LL * flat + 3);
        return true;
    }
    Number most = Number(-1e30), best = Number(-1e30);
    int face = 0;
    for (int i = 0; i < hull.faces; i++) {
        Number height = hull.affine(i, 0, p);
        most = greater(most, height);
        if (!(height > best)) continue;
        Number second = hull.affine(i, 1, p), third = hull.affine(i, 2, p);
        if (second < Number(0) || third < Number(0) || second + third > Number(1)) continue;
        best = height;
        face = i;
    }
    if (most > limit) return false;  // no point of the hull is nearer than any of its planes
    if (best > Number(0) || best >= most - Number(SAME_PLANE_M)) {
        long long row = hull.row + 12LL * face;
        outward = geometry.vector(row);
        distance = dot(outward, at) - geometry.at(row + 3);
        nearest = best;
        return true;
    }
    nearest = Number(1e30);
    int edge = 0;
    for (int i = 0; i < hull.edges; i++) {
        Number away = plain_edge_distance(hull, i, p);
        if (away < nearest) {
            nearest = away;
            edge = i;
        }
    }
    if (nearest > limit) return false;
    distance = edge_distance(hull, edge, at, outward);
    return true;
}
#endif

INLINE Vec relative_velocity(const Contact& c, const Motion* bodies) {
    Vec velocity = bodies[c.a].velocity + cross(bodies[c.a].omega, c.arm);
    if (c.b >= 0) velocity = velocity - bodies[c.b].velocity - cross(bodies[c.b].omega, c.arm_b);
    return velocity;
}

#if SHARED
// Both bodies of a contact in one number.
INLINE int bodies_of(const Contact& c) { return c.a << 16 | (c.b & 0xffff); }
#endif

// What a contact with a unit impulse along its normal does to both bodies: velocity of a relative to b, and rotations.
INLINE void unit_response(const Contact& c, Responses bodies, Vec& normal, Vec& turn_a, Vec& turn_b) {
#if LINKS
    Vec other = none();
    response_of(response(bodies, c.a), c.normal, cross(c.arm, c.normal), normal, turn_a);
    if (c.b >= 0) response_of(response(bodies, c.b), c.normal, cross(c.arm_b, c.normal), other, turn_b);
    normal = normal + other;
#else
    normal = c.normal;
    turn_a = bodies[c.a].inverse_inertia * cross(c.arm, normal);
    if (c.b >= 0) turn_b = bodies[c.b].inverse_inertia * cross(c.arm_b, normal);
#endif
}

#if !SHARED
// Distributes the effective mass among the touching contacts of a pair: those from `first` on in every lane's list.
__device__ void share_out_pair(const Lanes& lanes, Contact* list, const Real* weights, int first, int end,
                               const Motion* bodies) {
    Real totals[SLOTS];
    for (int i = first; i < end; i++) totals[i] = Real(0);
    for (int source = 0; source < LANES; source++) {
        int theirs = lanes.from(end - first, source);
        for (int j = 0; lanes.any(j < theirs); j++) {
            Vec normal = none(), turn_a = none(), turn_b = none();
            Real weight = Real(0);
            if (source == lanes.lane && j < theirs) {
                const Contact& c = list[first + j];
                unit_response(c, bodies, normal, turn_a, turn_b);
                weight = weights[first + j] * c.stop_n;
            }
            normal = lanes.from(normal, source);
            turn_a = lanes.from(turn_a, source);
            turn_b = lanes.from(turn_b, source);
            weight = lanes.from(weight, source);
            for (int i = first; i < end; i++) {
                const Contact& c = list[i];
#if LINKS
                Real mass = Real(1);
#else
                Real mass = bodies[c.a].inverse_mass;
                if (c.b >= 0) mass += bodies[c.b].inverse_mass;
#endif
                Real along = mass * dot(c.normal, normal) + dot(cross(c.arm, c.normal), turn_a);
                if (c.b >= 0) along += dot(cross(c.arm_b, c.normal), turn_b);
                totals[i] += weight * along * along;
            }
        }
    }
    for (int i = first; i < end; i++) share_out(list[i], list[i].stop_n * totals[i], weights[i]);
}
#else
// The same; contacts may be of several pairs of bodies. In each round every lane shows one contact.
__device__ void share_out_pair(const Lanes& lanes, Chain& chain, Contact* list, const Real* weights, int first, int end,
                               const Motion*) {
    ContactRoom& room = chain.room.collide.contacts;
    Real totals[LIST_ROOM];
    INNER for (int i = first; i < end; i++) totals[i] = Real(0);
    KEEP_LOOP
    for (int j = first; lanes.any(j < end); j++) {
        room.bodies[lanes.lane] = -1;
        if (j < end) {
            const Contact& c = list[j];
            Vec normal = none(), turn_a = none(), turn_b = none();
            unit_response(c, chain, normal, turn_a, turn_b);
            room.first[lanes.lane] = normal;
            room.second[lanes.lane] = turn_a;
            room.third[lanes.lane] = turn_b;
            room.weight[lanes.lane] = weights[j] * c.stop_n;
            room.bodies[lanes.lane] = bodies_of(c);
        }
        lanes.sync();
        KEEP_LOOP
        for (int shown = 0; shown < LANES; shown++) {
            if (room.bodies[shown] < 0) continue;
            KEEP_LOOP
            for (int i = first; i < end; i++) {
                const Contact& c = list[i];
                if (bodies_of(c) != room.bodies[shown]) continue;
                Real along = dot(c.normal, room.first[shown]) + dot(cross(c.arm, c.normal), room.second[shown]);
                if (c.b >= 0) along += dot(cross(c.arm_b, c.normal), room.third[shown]);
                totals[i] += room.weight[shown] * along * along;
            }
        }
        lanes.sync();
    }
    INNER for (int i = first; i < end; i++) share_out(list[i], list[i].stop_n * totals[i], weights[i]);
}
#endif
#endif
