// All contacts of a step: flight before them, which ones there are, and their impulses by projected Gauss-Seidel;
// formulas of `physics/rigid_body.py`, `physics/contact_detection.py` and `physics/impulse_solver.py`.
// Moves a free body over one step, given velocity and angular momentum at its end: the position is advanced by the mean
// velocity, the rotation by the angular velocity of the mean angular momentum at the midpoint.
INLINE void advance(Body& body, const Weight& c, Vec omega_start, Vec velocity, Vec spin, Real h) {
    Real half_h = Number(0.5) * h;
    Quat half = normalized(multiply(body.quat, quat_exp(half_h * omega_start)));
    Vec mean = Real(Number(0.5)) * (body.spin + spin);
    Vec omega = c.inverse_inertia * transposed(matrix(half), mean);
    body.quat = normalized(multiply(body.quat, quat_exp(h * omega)));
    body.position = body.position + half_h * (body.velocity + velocity);
    body.velocity = velocity;
    body.spin = spin;
}

#if EFFECTS
#if SURFACE
// Adds the impulse of the adhesion of the ground to a body's velocity and angular momentum.
INLINE void stick(const Problem& problem, const Environment& env, const Lanes& lanes, int b, const Mat& rotation,
                  Vec& velocity, Vec& spin) {
    const Surface& s = env.laws[0].surface;
    if (absent(s.adhesion)) return;
    Real sum = Real(0), most = Real(0), each = reciprocal(s.reach);
    Vec arms = none();
    for (int k = lanes.lane; k < low_count(b); k += LANES) {
        long long row = env.geometry + 4LL * problem.spheres[low_start(b) + k];
        Vec arm = rotation * (problem.geometry.vector(row) - env.constants[b].com);
        arm.z = arm.z - problem.geometry.at(row + 3);
        Real far = each * (env.bodies[b].position.z - env.ground + arm.z);
        far = at_most(at_least(far, Number(0)), Number(1));
        Real near = square(Real(Number(1)) - far * far);
        sum += near;
        arms = arms + near * arm;
        if (plain(near) > plain(most)) most = near;
    }
    sum = lanes.sum(sum);
    arms = lanes.sum(arms);
    most = -lanes.least(-most);
    // the weights are normalised to that of the lowest sphere: the force does not depend on the number of spheres
    Real pull = -(env.laws[0].step_s * s.adhesion * most * reciprocal(at_least(sum, Number(1e-12))));
    velocity.z += weight(env, b).inverse_mass * pull * sum;
    spin.x += pull * arms.y;
    spin.y -= pull * arms.x;
}
#endif

#if MAGNETS
// Height of the lowest sphere of a body that can touch the ground, at least 0.
__device__ Real height_of(const Problem& problem, const Environment& env, const Lanes& lanes, int b,
                          const Mat& rotation) {
    Real lowest = Real(Number(1e30));
    for (int k = lanes.lane; k < low_count(b); k += LANES) {
        long long row = env.geometry + 4LL * problem.spheres[low_start(b) + k];
        Vec arm = problem.geometry.vector(row) - env.constants[b].com;
        Real low = dot(rotation.z, arm) - problem.geometry.at(row + 3);
        if (plain(low) < plain(lowest)) lowest = low;
    }
    return at_least(env.bodies[b].position.z - env.ground + lanes.least(lowest), Number(0));
}
#endif

INLINE void apply(const Problem& problem, const Environment& env, const Lanes& lanes, int b, const Mat& rotation,
                  Vec omega, Vec& velocity, Vec& spin) {
    const Wrenches& w = env.wrenches;
    const Body& body = env.bodies[b];
    Real h = env.laws[0].step_s;
    Vec u = body.velocity - w.wind;
    // the tiny number keeps the derivative finite at rest
    Real drag = w.linear_drag + w.quadratic_drag * root(dot(u, u) + Real(Number(1e-24)));
    Vec a = w.acceleration - drag * u + w.magnus * cross(omega, u);
#if MAGNETS
    bool pulled = false;
    for (int i = 0; i < MAGNETS; i++) pulled = pulled || !absent(w.magnets[i]);
    Real height = pulled ? height_of(problem, env, lanes, b, rotation) : Real(0);
    for (int i = 0; i < MAGNETS; i++) {
        if (absent(w.magnets[i])) continue;
        a.z = a.z - w.magnets[i] * exponential(-height * reciprocal(w.magnet_ranges[i]));
    }
#endif
    velocity = velocity + h * a;
    spin = spin - h * w.spin_damping * body.spin;
#if TWISTED
    spin = spin + h * (rotation * solved(weight(env, b).inverse_inertia, transposed(rotation, w.twist)));
#endif
#if SURFACE
    stick(problem, env, lanes, b, rotation, velocity, spin);
#endif
}
#endif

#if RECORD
// Adds the impulse of a contact, and its point of action, to the sums since the last frame.
INLINE void note(Tally& tally, const Contact& c, const Law& law, Vec com) {
#if PAIRED
    Number along = plain(dot(c.impulse, c.normal)), across = size(c.impulse - Real(along) * c.normal);
#else
    Number along = plain(c.impulse.z), x = plain(c.impulse.x), y = plain(c.impulse.y), across = root(x * x + y * y);
#endif
    Vec point = com + c.arm;
#if PAIRED
    tally.facing[0] += along * plain(c.normal.x);
    tally.facing[1] += along * plain(c.normal.y);
    tally.facing[2] += along * plain(c.normal.z);
#endif
#if DEEP
    tally.depth += along * plain(c.gap);
#endif
    tally.impulse[0] += plain(c.impulse.x);
    tally.impulse[1] += plain(c.impulse.y);
    tally.impulse[2] += plain(c.impulse.z);
    tally.weighted[0] += along * plain(point.x);
    tally.weighted[1] += along * plain(point.y);
    tally.weighted[2] += along * plain(point.z);
    tally.weight += along;
#if ELLIPTIC
    if (size_in(c.ellipse, x, y) > Number(0.99) * along) tally.sliding += along;
#else
    if (across > Number(0.99) * plain(friction_of(law, c)) * along) tally.sliding += along;
#endif
}
#endif

// Whether a body may touch the ground in this step, by the sphere around its centre of mass.
INLINE bool near_ground(const Environment& env, int b, const Motion& m) {
    Number low = plain(env.bodies[b].position.z - env.ground) - env.constants[b].reach;
    Number rate = plain(m.velocity.z) - size(m.omega) * env.constants[b].reach;
    return low < Number(1e-6) || low + plain(env.laws[0].step_s) * rate < Number(1e-6);
}

#if PAIRED
// Two unit tangents of a contact, orthogonal to its normal, chosen in the world frame.
INLINE void tangents(const Environment& env, Vec normal, Vec& first, Vec& second) {
#if TURNED
    Vec n = transposed(env.turn, normal);
#else
    Vec n = normal;
#endif
    Number sign = plain(n.z) >= Number(0) ? Number(1) : Number(-1);
    Real a = -reciprocal(Real(sign) + n.z), b = n.x * n.y * a;
    first = vec(Real(1) + sign * (n.x * n.x * a), sign * b, -sign * n.x);
    second = vec(b, Real(sign) + n.y * n.y * a, -n.y);
#if TURNED
    first = env.turn * first;
    second = env.turn * second;
#endif
}

struct Facing {
    Vec normal, point;  // world frame; the normal points from body b of the pair to body a
    Real gap;
    Number sharp_gap;  // to the nearest sphere, without smoothing
};

#if !HULLS
struct Parting {};
#else
INLINE Hull hull_of(const Problem& problem, const Environment& env, int b) {
    Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(b), sphere_count(b)};
    Hull hull = {spheres,       env.geometry + 4LL * hull_start(b), face_count(b), edge_count(b),
                 support_count(b), ridge_count(b)};
    return hull;
}

// Raises `most` to the greatest height that the spheres of another hull have over a plane of this one; sets `axis` to
// the normal of that plane, in the world frame, times `sign`.
INLINE void part_by(const Problem& problem, const Environment& env, int b, int other, const Mat* rotations,
                    Number sign, Number& most, Number* axis) {
    Hull hull = hull_of(problem, env, b), its = hull_of(problem, env, other);
    Vec origin = env.bodies[other].position - rotations[other] * env.constants[other].com - env.bodies[b].position;
    Vec shift = transposed(rotations[b], origin) + env.constants[b].com;
    Number from[3] = {plain(shift.x), plain(shift.y), plain(shift.z)};
    for (int i = 0; i < hull.faces; i++) {
        Vec normal = rotations[b] * problem.geometry.vector(hull.row + 12LL * i);
        Vec within = transposed(rotations[other], normal);
        Number x = plain(within.x), y = plain(within.y), z = plain(within.z), least = Number(1e30);
        for (int k = 0; k < its.supports; k++) {
            const Number* s = its.support(k);
            least = lesser(least, x * s[0] + y * s[1] + z * s[2] - s[3]);
        }
        least += hull.affine(i, 0, from);
        if (!(least > most)) continue;
        most = least;
        axis[0] = sign * plain(normal.x);
        axis[1] = sign * plain(normal.y);
        axis[2] = sign * plain(normal.z);
    }
}

// Returns the face of a body whose normal is nearest to `sign` times the axis; -1 where none is parallel to it.
INLINE int flat_face(const Problem& problem, const Environment& env, int b, const Mat& rotation, Number sign,
                     const Number* axis) {
    Hull hull = hull_of(problem, env, b);
    Vec at = transposed(rotation, vec(Real(sign * axis[0]), Real(sign * axis[1]), Real(sign * axis[2])));
    Number x = plain(at.x), y = plain(at.y), z = plain(at.z), most = Number(PARALLEL);
    int face = -1;
    for (int i = 0; i < hull.faces; i++) {
        const Number* n = problem.geometry.value + hull.row + 12LL * i;
        Number along = x * n[0] + y * n[1] + z * n[2];
        if (along > most) {
            most = along;
            face = i;
        }
    }
    return face;
}

const int NEAR_ROOM = 32;
struct Near {  // edges of a hull that are near another one; all of them where more are than there is room for
    int count, listed[NEAR_ROOM];
    INLINE int many(int ridges) const { return count < 0 ? ridges : count; }
    INLINE int edge(int i) const { return count < 0 ? i : listed[i]; }
    INLINE void add(int edge) {
        if (count == NEAR_ROOM) count = -1;
        if (count >= 0) listed[count++] = edge;
    }
    INLINE bool has(int edge) const {
        bool found = count < 0;
        for (int i = 0; i < count; i++) found = found || listed[i] == edge;
        return found;
    }
};

struct Parting {  // how two hulls part best
    int on_a, on_b;  // faces that lie flat on each other, -1 for none: parallel to the face that parts them best
    Number axis[3];  // normal of a face or of two edges along which the gap is largest, out of a
    Number gap;      // no point of one hull is nearer to the other one
    Mat turn;        // of the frame of b into that of a, with `shift`
    Vec shift;
    Near near_a, near_b;
};

// The edge of body b in the frame of body a.
INLINE Edge edge_in(const Parting& parting, const Hull& hull_b, int i) {
    return placed_edge(edge_of(hull_b, i), parting.turn, parting.shift);
}

// Whether an edge is farther than a margin from the box of a body's spheres, all in the frame of that body.
INLINE bool edge_beside(const Constants& body, Vec start, Vec along, Number margin) {
    const Number from[3] = {plain(start.x), plain(start.y), plain(start.z)};
    const Number over[3] = {plain(along.x), plain(along.y), plain(along.z)};
    for (int k = 0; k < 3; k++) {
        Number to = from[k] + over[k];
        if (lesser(from[k], to) > body.high[k] + margin || greater(from[k], to) < body.low[k] - margin) return true;
    }
    return false;
}

// Lists the edges of both hulls that are within a margin of the other body's box.
INLINE void find_near(const Environment& env, int a, int b, const Hull& hull_a, const Hull& hull_b, Number margin,
                      Parting& found) {
    found.near_a.count = found.near_b.count = 0;
    for (int i = 0; i < hull_a.ridges && found.near_a.count >= 0; i++) {
        Edge edge = edge_of(hull_a, i);
        Vec start = transposed(found.turn, edge.start - found.shift), along = transposed(found.turn, edge.along);
        Number thick = plain(edge.radius) + greater(plain(edge.widening), Number(0));
        if (!edge_beside(env.constants[b], start, along, margin + thick)) found.near_a.add(i);
    }
    for (int j = 0; j < hull_b.ridges && found.near_b.count >= 0; j++) {
        Edge edge = edge_in(found, hull_b, j);
        Number thick = plain(edge.radius) + greater(plain(edge.widening), Number(0));
        if (!edge_beside(env.constants[a], edge.start, edge.along, margin + thick)) found.near_b.add(j);
    }
}

// Gap between the hulls of two bodies along a unit vector of the world, out of a.
INLINE Number gap_along(const Problem& problem, const Environment& env, int a, int b, const Mat* rotations,
                        const Number* axis) {
    Vec n = vec(Real(axis[0]), Real(axis[1]), Real(axis[2]));
    Number ends[2];
    for (int side = 0; side < 2; side++) {
        int body = side ? b : a;
        Hull hull = hull_of(problem, env, body);
        Vec within = transposed(rotations[body], side ? -n : n);
        Number x = plain(within.x), y = plain(within.y), z = plain(within.z), most = Number(-1e30);
        for (int k = 0; k < hull.supports; k++) {
            const Number* s = hull.support(k);
            most = greater(most, x * s[0] + y * s[1] + z * s[2] + s[3]);
        }
        Vec origin = env.bodies[body].position - rotations[body] * env.constants[body].com;
        ends[side] = most + (side ? -plain(dot(n, origin)) : plain(dot(n, origin)));
    }
    return -ends[1] - ends[0];
}

// Finds how the hulls of two bodies part best; false where they are not compared. Where a face parts them by more than
// `limit`, edges are not looked at.
__device__ bool part(const Problem& problem, const Environment& env, int p, const Mat* rotations, Number limit,
                     Parting& found) {
    int a = pair_a(p), b = pair_b(p);
    found.on_a = found.on_b = -1;
    if (face_count(a) == 0 || face_count(b) == 0) return false;
    if (face_count(a) * support_count(b) + face_count(b) * support_count(a) > MOST_PLANES) return false;
    found.gap = Number(-1e30);
    found.axis[0] = found.axis[1] = Number(0);
    found.axis[2] = Number(1);
    part_by(problem, env, a, b, rotations, Number(1), found.gap, found.axis);
    part_by(problem, env, b, a, rotations, Number(-1), found.gap, found.axis);
    found.on_a = flat_face(problem, env, a, rotations[a], Number(1), found.axis);
    found.on_b = flat_face(problem, env, b, rotations[b], Number(-1), found.axis);
    if (contact_count(p) == sphere_count(a) + sphere_count(b) || found.gap > limit) return true;
    const Hull hull_a = hull_of(problem, env, a), hull_b = hull_of(problem, env, b);
    const Mat &R = rotations[a], &Q = rotations[b];
    Mat turn = {R.x.x * Q.x + R.y.x * Q.y + R.z.x * Q.z, R.x.y * Q.x + R.y.y * Q.y + R.z.y * Q.z,
                R.x.z * Q.x + R.y.z * Q.y + R.z.z * Q.z};
    found.turn = turn;
    found.shift = transposed(R, env.bodies[b].position - Q * env.constants[b].com - env.bodies[a].position);
    found.shift = found.shift + env.constants[a].com;
    find_near(env, a, b, hull_a, hull_b, limit + Number(SMOOTHING_M), found);
    Number most = found.gap;
    for (int n = 0; n < found.near_b.many(hull_b.ridges); n++) {
        Edge second = edge_in(found, hull_b, found.near_b.edge(n));
        for (int m = 0; m < found.near_a.many(hull_a.ridges); m++) {
            Crossing crossing;
            if (!cross_edges(edge_of(hull_a, found.near_a.edge(m)), second, crossing)) continue;
            if (crossing.lean > Number(0) || !(plain(crossing.gap) > most)) continue;
            most = plain(crossing.gap);
            Vec normal = rotations[a] * crossing.normal;
            found.axis[0] = plain(normal.x);
            found.axis[1] = plain(normal.y);
            found.axis[2] = plain(normal.z);
        }
    }
    if (!(most > found.gap)) return true;
    Number exact = gap_along(problem, env, a, b, rotations, found.axis);  // spheres beside the edges may protrude
    // where edges part the bodies, faces that part them worse are not what touches
    if (exact > found.gap + Number(FACE_SLACK_M)) found.on_a = found.on_b = -1;
    found.gap = greater(found.gap, exact);
    return true;
}

// Finds the contact of one slot of edges: where an edge of a comes over b, or where it leaves it.
__device__ bool face_edges(const Problem& problem, const Environment& env, int p, int slot, const Mat* rotations,
                           Number limit, const Parting& parting, Facing& facing) {
    int a = pair_a(p);
    if (!parting.near_a.has(slot / 2)) return false;
    const Hull hull_b = hull_of(problem, env, pair_b(p));
    Edge first = edge_of(hull_of(problem, env, a), slot / 2);
    Vec axis = vec(Real(parting.axis[0]), Real(parting.axis[1]), Real(parting.axis[2]));
    axis = transposed(rotations[a], axis);
    // its normals are orthogonal to it
    Number along = plain(dot(axis, first.along)), length2 = plain(dot(first.along, first.along));
    if (along * along > Number(1 - PARALLEL * PARALLEL) * length2) return false;
    Number least = limit;
    int other = -1;
    for (int n = 0; n < parting.near_b.many(hull_b.ridges); n++) {
        Crossing crossing;
        int j = parting.near_b.edge(n);
        if (!cross_edges(first, edge_in(parting, hull_b, j), crossing)) continue;
        if (!crossing.within || crossing.leaves != (slot % 2 == 1)) continue;
        if (crossing.lean > Number(OUT_OF_FACE) || !(plain(dot(crossing.normal, axis)) > Number(PARALLEL))) continue;
        if (!(plain(crossing.gap) < least)) continue;
        least = plain(crossing.gap);
        other = j;
    }
    if (other < 0) return false;
    Crossing crossing;
    cross_edges(first, edge_in(parting, hull_b, other), crossing);
    Vec point = first.start + crossing.place * first.along +
                (first.radius + crossing.place * first.widening + Number(0.5) * crossing.gap) * crossing.normal;
    facing.gap = crossing.gap;
    facing.sharp_gap = plain(crossing.gap);
    facing.normal = -(rotations[a] * crossing.normal);
    facing.point = env.bodies[a].position + rotations[a] * (point - env.constants[a].com);
    return true;
}
#endif

// Finds gap, normal and point of one slot of a pair of bodies: first come the spheres of b against the union of a, then
// those of a against the union of b, then edges. Returns false if the gap exceeds `limit`. `known` is what is known of the
// sphere's centre and the other body, if that was sought before.
__device__ bool face(const Problem& problem, const Environment& env, int p, int k, const Mat* rotations, Number limit,
                     const Parting& parting, const Nearness* known, Facing& facing) {
#if HULLS
    int spheres_in_all = sphere_count(pair_a(p)) + sphere_count(pair_b(p));
    if (k >= spheres_in_all) {
        return face_edges(problem, env, p, k - spheres_in_all, rotations, limit, parting, facing);
    }
#endif
    bool second = k >= sphere_count(pair_b(p));
    int mine = second ? pair_a(p) : pair_b(p), other = second ? pair_b(p) : pair_a(p);
    Vec position = env.bodies[other].position;
    long long row = env.geometry + 4LL * problem.spheres[contact_start(p) + k];
    Vec center = env.bodies[mine].position + rotations[mine] * (problem.geometry.vector(row) - env.constants[mine].com);
    Real radius = problem.geometry.at(row + 3);
    Number around = size(center - position) - env.constants[other].reach - plain(radius) - Number(SMOOTHING_M);
    if (!(around < limit)) return false;
    Vec up = vec(Real(0), Real(0), Real(1));
#if TURNED
    up = env.turn * up;
#endif
    Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(other), sphere_count(other)};
    Vec local = transposed(rotations[other], center - position) + env.constants[other].com, outward;
    Real distance;
    Number nearest = Number(0);
    Number reached = limit + plain(radius);
#if HULLS
    if (face_count(other) > 0) {
        Hull hull = hull_of(problem, env, other);
        if (!distance_to_hull(hull, local, second ? parting.on_b : parting.on_a, reached, distance, nearest, outward)) return false;
    } else
#endif
    {
        up = transposed(rotations[other], up);
        if (!union_distance(spheres, local, reached, up, known, distance, nearest, outward)) return false;
    }
    outward = rotations[other] * outward;
    facing.gap = distance - radius;
    facing.sharp_gap = nearest - plain(radius);
    facing.normal = second ? outward : -outward;
    facing.point = center - (radius + Number(0.5) * facing.gap) * outward;
    return true;
}

struct Frame {  // of one body in that of another: x -> turn x + shift, without derivatives
    Number turn[9], shift[3];
};

INLINE Frame frame_in(const Environment& env, int body, int other, const Mat* rotations) {
    const Mat &R = rotations[body], &Q = rotations[other];
    const Number rows[9] = {plain(R.x.x), plain(R.x.y), plain(R.x.z), plain(R.y.x), plain(R.y.y),
                            plain(R.y.z), plain(R.z.x), plain(R.z.y), plain(R.z.z)};
    const Number columns[9] = {plain(Q.x.x), plain(Q.y.x), plain(Q.z.x), plain(Q.x.y), plain(Q.y.y),
                               plain(Q.z.y), plain(Q.x.z), plain(Q.y.z), plain(Q.z.z)};
    Vec away = env.bodies[body].position - R * env.constants[body].com - env.bodies[other].position;
    Vec at = transposed(Q, away) + env.constants[other].com;
    Frame frame = {{}, {plain(at.x), plain(at.y), plain(at.z)}};
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            Number sum = Number(0);
            for (int k = 0; k < 3; k++) sum += columns[3 * i + k] * rows[3 * k + j];
            frame.turn[3 * i + j] = sum;
        }
    }
    return frame;
}

// Whether a sphere is farther than `limit` from the box of another body's spheres, by more than rounding.
INLINE bool beside(const Constants& other, const Frame& frame, const Number* sphere, Number limit) {
    Number far2 = Number(0), bound = Number(1 + 1e-5) * (limit + sphere[3] + Number(SMOOTHING_M));
    for (int i = 0; i < 3; i++) {
        const Number* row = frame.turn + 3 * i;
        Number x = row[0] * sphere[0] + row[1] * sphere[1] + row[2] * sphere[2] + frame.shift[i];
        Number out = greater(other.low[i] - x, x - other.high[i]);
        if (out > Number(0)) far2 += out * out;
    }
    return far2 > bound * bound;
}

// Whether the box of a body's spheres is beyond a side of that of another body by more than a margin.
INLINE bool boxes_apart(const Constants& ours, const Constants& other, const Frame& frame, Number margin) {
    for (int i = 0; i < 3; i++) {
        Number middle = frame.shift[i], half = margin;
        for (int j = 0; j < 3; j++) {
            Number along = frame.turn[3 * i + j];
            middle += Number(0.5) * along * (ours.low[j] + ours.high[j]);
            half += Number(0.5) * (along < Number(0) ? -along : along) * (ours.high[j] - ours.low[j]);
        }
        if (middle - half > other.high[i] || middle + half < other.low[i]) return true;
    }
    return false;
}

struct Reach {  // how far the points of two bodies may come in a step
    Number near, limit;
    Frame frames[2];  // of b in a, of a in b
};

// Whether two bodies may touch in this step, by the spheres around their centres of mass and the boxes of their spheres.
INLINE bool may_touch(const Environment& env, int p, const Mat* rotations, const Motion* motions, Reach& reach) {
    int a = pair_a(p), b = pair_b(p);
    const Constants &ca = env.constants[a], &cb = env.constants[b];
    const Motion &ma = motions[a], &mb = motions[b];
    // points at a gap g approach at V + W g / 2 at most, so those beyond h V / (1 - h W / 2) cannot touch in this step
    Number spins = size(ma.omega) + size(mb.omega), h = plain(env.laws[0].step_s);
    Number V = size(ma.velocity - mb.velocity) + size(ma.omega) * (ca.reach + Number(SMOOTHING_M)) +
               size(mb.omega) * (cb.reach + Number(SMOOTHING_M));
    reach.near = Number(1e-9 + SMOOTHING_M) + h * (size(ma.velocity - mb.velocity) + size(ma.omega) * ca.reach +
                                                   size(mb.omega) * cb.reach);
    Number left = Number(1) - Number(0.5) * h * spins;
    reach.limit = left > Number(0.01) ? quotient(h * V, left) + Number(1e-6) : Number(1e30);
    Number apart = size(env.bodies[a].position - env.bodies[b].position);
    if (!(apart - ca.reach - cb.reach - Number(SMOOTHING_M) < reach.limit)) return false;
    const Number margin = Number(1 + 1e-5) * (reach.limit + Number(SMOOTHING_M));
    INNER
    for (int side = 0; side < 2; side++) {
        reach.frames[side] = frame_in(env, side ? a : b, side ? b : a, rotations);
        if (boxes_apart(side ? ca : cb, side ? cb : ca, reach.frames[side], margin)) return false;
    }
    return true;
}

// Makes the contact of slot `k` of a pair of bodies: 2 where it touches, 1 where it just opened, whose impulse of the
// previous step acts until the first iteration, 0 for none.
INLINE int make_contact(const Problem& problem, const Environment& env, bool warm, Vec before, int p, int k,
                        const Mat* rotations, const Motion* motions, Number limit, Number near, const Parting& parting,
                        const Nearness* known, Contact& c, Real& weight) {
    int a = pair_a(p), b = pair_b(p), found = 2;
#if !LINKS
    const Motion &ma = motions[a], &mb = motions[b];
#endif
    Facing facing;
    if (!face(problem, env, p, k, rotations, limit, parting, known, facing)) return 0;
    c.normal = facing.normal;
    c.arm = facing.point - env.bodies[a].position;
    c.arm_b = facing.point - env.bodies[b].position;
    c.a = a;
    c.b = b;
    c.slot = SLOT_OF(contact_start(p) + k);
    Real speed = dot(relative_velocity(c, motions), c.normal);
#if LINKS
    Real inverse_mass = Real(0), mobility = Real(0);
    INNER
    for (int side = 0; side < 2; side++) {
        add_mobility(response(RESPONSES(env, motions), side ? b : a), side ? c.arm_b : c.arm, c.normal, inverse_mass, mobility);
    }
#else
    Vec turn_a = cross(c.arm, c.normal), turn_b = cross(c.arm_b, c.normal);
    Real inverse_mass = ma.inverse_mass + dot(turn_a, ma.inverse_inertia * turn_a) + mb.inverse_mass +
                        dot(turn_b, mb.inverse_inertia * turn_b);
    Real mobility = mobility_trace(ma, c.arm) + mobility_trace(mb, c.arm_b);
#endif
    if (!prepare(c, env.laws[pair_law(p)], facing.gap, speed, inverse_mass, mobility, weight)) {
        if (!warm || !(plain(before.x) > Number(0)) || !(facing.sharp_gap < near)) return 0;
        c.target = Real(Number(-1e30));
        c.stop_n = c.stop_t = Real(1);
        found = 1;
    }
    if (warm) {
        Vec one, two;
        tangents(env, c.normal, one, two);
        c.impulse = before.x * c.normal + before.y * one + before.z * two;
    }
    return found;
}

#if QUEUED
// Slots of a lane that may have a contact: from the front those against few spheres, from the back those against many, so
// that all lanes come to these at the same time.
const int LONG = 16;
struct Candidates {
    int slots[SLOTS], few, many;
    INLINE void add(int p, int k, bool longer) { slots[longer ? SLOTS - ++many : few++] = p << 16 | k; }
};

// Lists the slots of this lane of a pair of bodies that may meet. Contacts are made later: those of all pairs together, as
// each pair alone would leave most lanes idle.
INLINE void queue_pair(const Problem& problem, const Environment& env, const Own& own, int p, const Mat* rotations,
                       Candidates& queue) {
    int a = pair_a(p), b = pair_b(p), start = contact_start(p);
    const CollideRoom& room = env.chain.room.collide;
    const Number limit = room.limits[p];
    const int spheres_of_b = sphere_count(b);
    KEEP_LOOP
    for (int second = 0; second < 2; second++) {  // spheres of b, then those of a
        const Frame frame = frame_in(env, second ? a : b, second ? b : a, rotations);
        const Constants& other = env.constants[second ? b : a];
        const int first = start + (second ? spheres_of_b : 0), count = sphere_count(second ? a : b);
        const bool longer = sphere_count(second ? b : a) > LONG;
        const Number* spheres = problem.geometry.value + env.geometry + 4LL * sphere_start(second ? a : b);
        EACH_OWNED(own.lanes, first, count, k) {
            AlignedRow row = row_of(spheres + 4LL * k);
            const Number sphere[4] = {row.a, row.b, row.c, row.d};
            if (!beside(other, frame, sphere, limit)) queue.add(p, first - start + k, longer);
        }
    }
}

// Whether the sphere of a slot meets the other body in this step, and what is then known of both.
INLINE bool meets(const Problem& problem, const Environment& env, int p, int k, const Mat* rotations, Number limit,
                  Nearness& known) {
    const bool second = k >= sphere_count(pair_b(p));
    const int mine = second ? pair_a(p) : pair_b(p), other = second ? pair_b(p) : pair_a(p);
    const long long row = env.geometry + 4LL * problem.spheres[contact_start(p) + k];
    Vec center = env.bodies[mine].position + rotations[mine] * (problem.geometry.vector(row) - env.constants[mine].com);
    Vec local = transposed(rotations[other], center - env.bodies[other].position) + env.constants[other].com;
    const Number point[3] = {plain(local.x), plain(local.y), plain(local.z)};
    Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(other), sphere_count(other)};
    known.nearest = nearest_in(spheres, point, &known.members);
    return known.nearest - Number(SMOOTHING_M) <= limit + plain(problem.geometry.at(row + 3));
}

// Leaves the slots of this lane from the place `from` of all that wait on, those against many spheres first.
INLINE void leave_slots(Environment& env, const Own& own, const Candidates& queue, int many_before, int few_before,
                        int from) {
    QueueRoom& room = env.chain.room.collide.queue;
    KEEP_LOOP
    for (int i = 0; i < queue.many + queue.few; i++) {
        const bool longer = i < queue.many;
        const int place = (longer ? many_before + i : few_before + i - queue.many) - from;
        if (place < 0 || place >= WAITING) continue;
        const int slot = queue.slots[longer ? SLOTS - 1 - i : i - queue.many];
        room.slots[place] = slot;
        room.before[place] = own.warm ? own.before[(contact_start(slot >> 16) + (slot & 0xffff)) / LANES] : none();
    }
    own.lanes.sync();
}

// Keeps those of the first `end` slots that meet another body; returns how many these are.
INLINE int keep_meeting(const Problem& problem, Environment& env, const Lanes& lanes, const Mat* rotations, int end) {
    CollideRoom& all = env.chain.room.collide;
    QueueRoom& room = all.queue;
    int slots[WAITING / LANES], met = 0, together;
    Vec before[WAITING / LANES];
    Nearness known[WAITING / LANES];
    KEEP_LOOP
    for (int i = lanes.lane; i < end; i += LANES) {
        slots[met] = room.slots[i];
        before[met] = room.before[i];
        const int p = slots[met] >> 16;
        if (meets(problem, env, p, slots[met] & 0xffff, rotations, all.limits[p], known[met])) met++;
    }
    const int place = lanes.before(met, together);
    lanes.sync();
    KEEP_LOOP
    for (int i = 0; i < met; i++) {
        room.slots[place + i] = slots[i];
        room.before[place + i] = before[i];
        room.known[place + i] = known[i];
    }
    lanes.sync();
    return together;
}

// Gives each lane one of the contacts from `first` on, where there are not more than lanes, which takes one round in each
// iteration.
INLINE void spread_contacts(Environment& env, const Lanes& lanes, Contact* list, Real* weights, int first, int& count) {
    int all;
    const int offset = lanes.before(count - first, all);
    const bool few = all <= LANES;
    MoveRoom& room = env.chain.room.collide.moved;
    for (int i = first; i < count && few; i++) {
        room.contacts[offset + i - first] = list[i];
        room.weights[offset + i - first] = weights[i];
    }
    lanes.sync();
    if (few) {
        count = first;
        if (lanes.lane < all) {
            list[count] = room.contacts[lanes.lane];
            weights[count++] = room.weights[lanes.lane];
        }
    }
    lanes.sync();
}

// Makes the contacts of all slots that wait, which the lanes share out evenly, and distributes the effective mass among
// them. Which ones meet is found before: to make a contact takes long, and few do.
INLINE void make_queued(const Problem& problem, Environment& env, const Own& own, const Mat* rotations,
                        const Motion* motions, const Candidates& queue, Contact* list, Real* weights, int& count) {
    CollideRoom& room = env.chain.room.collide;
    const int first = count;
    int turn = 0, many, few;
    const int many_before = own.lanes.before(queue.many, many);
    const int few_before = many + own.lanes.before(queue.few, few);
    KEEP_LOOP
    for (int from = 0; own.lanes.any(from < many + few); from += WAITING) {
        leave_slots(env, own, queue, many_before, few_before, from);
        const int waiting = many + few - from < WAITING ? many + few - from : WAITING;
        const int end = keep_meeting(problem, env, own.lanes, rotations, waiting);
        KEEP_LOOP
        for (int i = (own.lanes.lane - turn) & (LANES - 1); i < end; i += LANES) {
            const int p = room.queue.slots[i] >> 16, k = room.queue.slots[i] & 0xffff;
            const Vec before = room.queue.before[i];
            Parting parting;
            int found = make_contact(problem, env, plain(before.x) > Number(0), before, p, k, rotations, motions,
                                     room.limits[p], room.nears[p], parting, &room.queue.known[i], list[count],
                                     weights[count]);
            if (found == 2) room.touched[p] = true;
            if (found > 0) count++;
        }
        turn = (turn + end) & (LANES - 1);
        own.lanes.sync();
    }
    if (!own.lanes.any(count > first)) return;
    spread_contacts(env, own.lanes, list, weights, first, count);
    share_out_pair(SHOWN_TO(own.lanes, env), list, weights, first, count, motions);
}
#else
// Finds the contacts of two bodies and distributes the effective mass among them; returns how many touch.
__device__ int touch_pair(const Problem& problem, Environment& env, const Own& own, int p, const Mat* rotations,
                          Motion* motions, Contact* list, Real* weights, int& count) {
    int a = pair_a(p), b = pair_b(p), first = count, touching = 0;
    const Constants &ca = env.constants[a], &cb = env.constants[b];
    Reach reach;
    bool near = may_touch(env, p, rotations, motions, reach);
    Parting parting;
#if HULLS
    bool parts = false;
    if (near) {
        // nothing of one hull is nearer to the other one than the gap along any axis
        Number* parted = env.parted[p];
        const bool known = parted[0] != Number(0) || parted[1] != Number(0) || parted[2] != Number(0);
        if (known && gap_along(problem, env, a, b, rotations, parted) > reach.limit) near = false;
        parts = near && part(problem, env, p, rotations, reach.limit, parting) && parting.gap > reach.limit;
        if (parts) near = false;
    }
    own.lanes.sync();
    if (parts && own.lanes.writes()) {
        for (int k = 0; k < 3; k++) env.parted[p][k] = parting.axis[k];
    }
#endif
#if LINKS && !SHARED
    reveal(env, own.lanes, motions, a, near);
    reveal(env, own.lanes, motions, b, near);
#endif
    if (near) {
        const int start = contact_start(p), spheres_of_b = sphere_count(b), spheres_in_all = spheres_of_b + sphere_count(a);
        EACH_OWNED(own.lanes, start, contact_count(p), k) {
            if (k < spheres_in_all) {
                const bool second = k >= spheres_of_b;
                const Number* sphere = problem.geometry.value + env.geometry + 4LL * problem.spheres[start + k];
                if (beside(second ? cb : ca, reach.frames[second], sphere, reach.limit)) continue;
            }
            const Vec before = own.warm ? own.before[(start + k) / LANES] : none();
            int found = make_contact(problem, env, own.warm, before, p, k, rotations, motions, reach.limit, reach.near,
                                     parting, nullptr, list[count], weights[count]);
            if (found == 2) touching++;
            if (found > 0) count++;
        }
    }
    if (own.lanes.any(count > first)) share_out_pair(SHOWN_TO(own.lanes, env), list, weights, first, count, motions);
    return touching;
}
#endif

#if FIXED
// Whether a body may touch a fixed surface in this step, in which none of its points moves farther than `margin`.
INLINE bool near_surface(const Problem& problem, const Environment& env, const Fixed& fixed, int p, const Motion& m,
                         Number& margin) {
    const int a = pair_a(p);
    Number h = plain(env.laws[0].step_s), reach = env.constants[a].reach;
    margin = h * (size(m.velocity) + size(m.omega) * reach) + Number(1e-6);  // up to rounding
    const Vec place = transposed(fixed.rotation, env.bodies[a].position - fixed.position);
    return least_distance(problem, fixed, -2 - pair_b(p), place) - reach < margin;
}

// Finds the contacts of a body with a fixed surface and distributes the effective mass among them; returns how many
// touch.
__device__ int touch_surface(const Problem& problem, Environment& env, const Own& own, int p, const Mat* rotations,
                             Motion* motions, Contact* list, Real* weights, int& count) {
    int a = pair_a(p), s = -2 - pair_b(p), first = count;
    const Motion& m = motions[a];
    Vec com = env.bodies[a].position;
    Number margin;
    Fixed fixed = fixed_surface(problem, env, s);
    const bool near = near_surface(problem, env, fixed, p, m, margin);
#if LINKS && !SHARED
    reveal(env, own.lanes, motions, a, near);
#endif
    if (near) {
        const int start = contact_start(p);
        Searched searched;
        searched.sphere = -1;
        EACH_OWNED(own.lanes, start, contact_count(p), k) {
            Vec center;
            Real radius, weight;
            Meeting meeting;
            if (!meet(problem, env, fixed, p, k, rotations[a], margin, searched, center, radius, meeting)) continue;
            Real gap = meeting.distance - radius;
            if (!(plain(gap) < margin)) continue;
            Contact& c = list[count];
            c.normal = meeting.outward;
            c.arm = center - com - radius * meeting.outward;
            c.arm_b = none();
            c.a = a;
            c.b = -2;
            c.slot = SLOT_OF(start + k);
            Real speed = dot(m.velocity + cross(m.omega, c.arm), c.normal);
#if LINKS
            Real inverse_mass = Real(0), mobility = Real(0);
            add_mobility(response(RESPONSES(env, motions), a), c.arm, c.normal, inverse_mass, mobility);
#else
            Vec turn = cross(c.arm, c.normal);
            Real inverse_mass = m.inverse_mass + dot(turn, m.inverse_inertia * turn);
            Real mobility = mobility_trace(m, c.arm);
#endif
            if (!prepare(c, env.laws[pair_law(p)], gap, speed, inverse_mass, mobility, weight)) continue;
            if (own.warm) {
                Vec along = own.before[(start + k) / LANES], one, two;
                tangents(env, c.normal, one, two);
                c.impulse = along.x * c.normal + along.y * one + along.z * two;
            }
            weights[count++] = weight;
        }
    }
    if (own.lanes.any(count > first)) share_out_pair(SHOWN_TO(own.lanes, env), list, weights, first, count, motions);
    return count - first;
}
#endif

#if LINKS
// Finds the contacts of a link with the ground, and distributes the effective mass among them as between two bodies.
__device__ int touch_plane_link(const Problem& problem, Environment& env, const Own& own, int p, const Mat* rotations,
                                Motion* motions, Contact* list, Real* weights, int& count) {
    int a = pair_a(p), first = count, start = contact_start(p);
#if !SHARED
    reveal(env, own.lanes, motions, a, true);
#endif
    Vec up = vec(Real(0), Real(0), Real(1));
    EACH_OWNED(own.lanes, start, contact_count(p), k) {
        long long row = env.geometry + 4LL * problem.spheres[start + k];
        Contact& c = list[count];
        c.arm = rotations[a] * problem.geometry.vector(row) - problem.geometry.at(row + 3) * up;
        c.normal = up;
        c.arm_b = none();
        c.a = a;
        c.b = -1;
        c.slot = SLOT_OF(start + k);
        Real gap = env.bodies[a].position.z - env.ground + c.arm.z, inverse_mass = Real(0), mobility = Real(0);
        Real speed = relative_velocity(c, motions).z;
        add_mobility(response(RESPONSES(env, motions), a), c.arm, up, inverse_mass, mobility);
        if (!prepare(c, env.laws[pair_law(p)], gap, speed, inverse_mass, mobility, weights[count])) continue;
        c.impulse = own.before[(start + k) / LANES];
        count++;
    }
    if (own.lanes.any(count > first)) share_out_pair(SHOWN_TO(own.lanes, env), list, weights, first, count, motions);
    return count - first;
}
#endif

// Divides the effective mass of a body by the number of groups of contacts on it; `groups` counts them by body.
INLINE void split(Contact* list, int count, const int* groups) {
    INNER for (int i = 0; i < count; i++) {
        Contact& c = list[i];
        int most = groups[group_of(c.a)], other = c.b >= 0 ? group_of(c.b) : -1;
        if (other >= 0 && groups[other] > most) most = groups[other];
        Number share = most > 1 ? quotient(Number(1), Number(most)) : Number(1);
        c.stop_n = share * c.stop_n;
        c.stop_t = share * c.stop_t;
    }
}
#endif

#if PAIRED && !LINKS
struct Load {  // what the contacts of a pair do to their bodies: change of a's velocity and, with the sign of a, of b's
    Vec linear_a, linear_b, turn_a, turn_b;
};

struct Pushed {  // impulse of the contacts of a pair on a, and their moments about both centres of mass
    Vec linear, angular_a, angular_b;
};

// Sums the impulses of the contacts from `first` to `end`, which belong to one pair, over the lanes.
INLINE Pushed pushed_by(const Lanes& lanes, const Contact* list, int first, int end, int b) {
    Pushed sum = {none(), none(), none()};
    const bool both = b >= 0 && is_free(b);
    for (int i = first; i < end; i++) {
        const Contact& c = list[i];
        sum.linear = sum.linear + c.impulse;
        sum.angular_a = sum.angular_a + cross(c.arm, c.impulse);
        if (both) sum.angular_b = sum.angular_b + cross(c.arm_b, c.impulse);
    }
    sum.linear = lanes.sum(sum.linear);
    sum.angular_a = lanes.sum(sum.angular_a);
    if (both) sum.angular_b = lanes.sum(sum.angular_b);
    return sum;
}

INLINE Load load_of(const Pushed& pushed, int a, int b, const Motion* motions) {
    Load load = {motions[a].inverse_mass * pushed.linear, none(), motions[a].inverse_inertia * pushed.angular_a, none()};
    if (b >= 0 && is_free(b)) {
        load.linear_b = motions[b].inverse_mass * pushed.linear;
        load.turn_b = motions[b].inverse_inertia * pushed.angular_b;
    }
    return load;
}

// Aims the contacts of a pair at what they ask for under the present impulses of all other pairs: a contact so carries
// the load that others put on its bodies, and not only their weight. `load` is that of the pair itself.
INLINE void aim_under_load(const Law& law, Contact* list, int first, int end, const Load& load,
                           const Motion* motions) {
    for (int i = first; i < end; i++) {
        Contact& c = list[i];
        if (plain(c.target) < Number(-1e29)) continue;
        Vec own = load.linear_a + cross(load.turn_a, c.arm);
        if (c.b >= 0) own = own + load.linear_b + cross(load.turn_b, c.arm_b);
        c.target = aim(law, c.gap, dot(relative_velocity(c, motions) - own, c.normal));
    }
}
#endif

#if SHARED
// Lists the bodies that contacts may move: links that are known, then the free bodies, which come after all links.
INLINE void list_reached(Environment& env, const Lanes& lanes) {
    CollideRoom& room = env.chain.room.collide;
    if (lanes.writes()) {
        int count = 0;
        KEEP_LOOP
        for (int l = 0; l < LINKS; l++) {
            if (env.chain.known[l]) room.reached[count++] = l;
        }
        KEEP_LOOP
        for (int b = 0; b < BODIES; b++) {
            if (is_free(b)) room.reached[count++] = LINKS + FREE(b);
        }
        room.reached_count = count;
    }
    lanes.sync();
}

// The body of a place in the list of those that contacts may move.
INLINE int body_at(int place) { return place < LINKS ? link_body[place] : free_body(place - LINKS); }

// Changes the impulses of the contacts by one iteration where it is asked for, and sums up what they do to each body that
// they may move. In each round every lane shows one contact; each of these bodies is summed up by one lane.
INLINE void sweep_contacts(Environment& env, const Lanes& lanes, Contact* list, int count, const Motion* motions,
                           bool changes) {
    CollideRoom& all = env.chain.room.collide;
    ContactRoom& room = all.contacts;
    DIVIDED(lanes, r, all.reached_count) all.pushes[all.reached[r]] = all.moments[all.reached[r]] = none();
    KEEP_LOOP
    for (int i = 0; lanes.any(i < count); i++) {
        room.bodies[lanes.lane] = -1;
        if (i < count) {
            Contact& c = list[i];
            if (changes) c.impulse = swept(c, env.laws[0], relative_velocity(c, motions));
            room.first[lanes.lane] = c.impulse;
            room.second[lanes.lane] = cross(c.arm, c.impulse);
            if (c.b >= 0) room.third[lanes.lane] = cross(c.arm_b, c.impulse);
            room.bodies[lanes.lane] = bodies_of(c);
        }
        lanes.sync();
        DIVIDED(lanes, r, all.reached_count) {
            const int place = all.reached[r], body = body_at(place);
            Vec push = all.pushes[place], moment = all.moments[place];
            KEEP_LOOP
            for (int shown = 0; shown < LANES; shown++) {
                const int bodies = room.bodies[shown];
                if (bodies >> 16 == body) {
                    push = push + room.first[shown];
                    moment = moment + room.second[shown];
                } else if ((bodies & 0xffff) == body) {
                    push = push - room.first[shown];
                    moment = moment - room.third[shown];
                }
            }
            all.pushes[place] = push;
            all.moments[place] = moment;
        }
        lanes.sync();
    }
}

// Moves the bodies that contacts may move by their impulses; `joints`: after one pass over the joints. In the last
// iteration the moments are added to the angular momenta.
INLINE void move_bodies(Environment& env, const Lanes& lanes, Motion* motions, Vec* spins, bool joints, bool last) {
    Chain& chain = env.chain;
    const CollideRoom& room = chain.room.collide;
    push_chains(chain, lanes);
    if (joints && chain.active) sweep_joints(chain, lanes);
    lanes.sync();
    DIVIDED(lanes, r, room.reached_count) {
        const int place = room.reached[r];
        Velocities m = room.free[place];
        if (place < LINKS) {
            gain(chain, place, m.velocity, m.omega);
        } else {
            const int f = place - LINKS;
            m.velocity = m.velocity + chain.free_masses[f] * room.pushes[place];
            m.omega = m.omega + chain.free_inertias[f] * room.moments[place];
            if (last) spins[f] = spins[f] + room.moments[place];
        }
        motions[body_at(place)] = m;
    }
    lanes.sync();
}
#endif

// Discards the impulses of the previous step.
INLINE void forget(Own& own) {
    if (!own.warm) return;
#if PAIRED
    INNER for (int i = 0; i < own.kept_count; i++) own.before[own.kept[i]] = none();
    own.kept_count = 0;
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) own.before[i] = none();
#endif
    own.warm = false;
}

#if QUEUED
// As `keep`, and notes the impulses of labels: the lane that made a contact shows it to that of its slot.
INLINE void keep_shown(Environment& env, Own& own, const Contact* list, int count, int sweeps) {
    ContactRoom& room = env.chain.room.collide.contacts;
    forget(own);
    int kept = 0;
    KEEP_LOOP
    for (int i = 0; own.lanes.any(i < count); i++) {
        const int lane = own.lanes.lane;
        room.bodies[lane] = -1;
        if (i < count) {
            const Contact& c = list[i];
            room.first[lane] = c.impulse;
            room.second[lane] = c.normal;
            room.bodies[lane] = c.slot << 1 | (c.b == -1);
#if RECORD
            room.third[lane] = env.bodies[c.a].position + c.arm;
            room.weight[lane] = c.gap;
#if LAWS > 1
            room.friction[lane] = c.friction;
#endif
#endif
        }
        own.lanes.sync();
        KEEP_LOOP
        for (int shown = 0; shown < LANES; shown++) {
            const int contact = room.bodies[shown] >> 1, slot = contact / LANES;
            if (contact < 0 || owner(contact) != lane) continue;
            const Vec impulse = room.first[shown], normal = room.second[shown];
            Vec one, two;
            tangents(env, normal, one, two);
            Vec along = vec(dot(impulse, normal), dot(impulse, one), dot(impulse, two));
            if (sweeps > 1) {  // a single iteration starts at zero
                own.before[slot] = room.bodies[shown] & 1 ? impulse : along;
                own.kept[kept++] = slot;
            }
#if RECORD
            Contact c;
            c.impulse = impulse;
            c.normal = normal;
            c.arm = room.third[shown];
            c.gap = room.weight[shown];
#if LAWS > 1
            c.friction = room.friction[shown];
#endif
            note(own.tallies[slot], c, env.laws[0], none());
#endif
        }
        own.lanes.sync();
    }
    own.kept_count = kept;
    own.warm = kept > 0;
}
#endif

// Stores the impulses of a step as the start of the next one's iterations; a single iteration starts at zero.
INLINE void keep(const Environment& env, Own& own, const Contact* list, int count, int sweeps) {
    if (sweeps < 2) return;
#if PAIRED
    forget(own);
    INNER for (int i = 0; i < count; i++) {
        const Contact& c = list[i];
        Vec one, two;
        tangents(env, c.normal, one, two);
        Vec along = vec(dot(c.impulse, c.normal), dot(c.impulse, one), dot(c.impulse, two));
        own.before[c.slot] = c.b == -1 ? c.impulse : along;
        own.kept[i] = c.slot;
    }
    own.kept_count = count;
#elif LISTED
    forget(own);
    for (int i = 0; i < count; i++) own.before[list[i].slot] = list[i].impulse;
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) own.before[i] = list[i].on ? list[i].impulse : none();
#endif
    own.warm = count > 0;
}

#if PATCHES
// Distributes the effective mass among the contacts of a patch in proportion to their areas: `_share_by_area` of
// impulse_solver.
INLINE void share_by_area(const Lanes& lanes, const Moments& moments, const Moving& motion, Contact* list,
                          const Real* weights, int first, int count) {
    Real spread = Real(0), mobility = Real(0);
    EACH_CONTACT(list, first, count) {
        Real each = weights[i] * reciprocal(list[i].stop_n);
        mobility += each;
        spread += each * crowd(moments, motion, list[i]);
    }
    Real bound = lanes.sum(spread) * reciprocal(lanes.sum(mobility) + Real(Number(LEAST_MOBILITY)));
    EACH_CONTACT(list, first, count) share_out(list[i], list[i].stop_n * bound, weights[i]);
}
#endif

// Finds the contacts of a body with the ground. They are appended to the list (LISTED), or each is stored in its own
// slot.
INLINE void touch_plane(const Problem& problem, const Environment& env, const Own& own, int p, const Mat& rotation,
                        const Moving& motion, Contact* list, Real* weights, int& count) {
    int a = pair_a(p), first = count;
    Moments moments = {Real(0), Real(0), Real(0), Real(0), Real(0), Real(0)};
    Real height = env.bodies[a].position.z - env.ground;
#if CULLED
    // no point of the body sinks further in this step, up to rounding
    Number fall = size(motion.velocity) + size(motion.omega) * env.constants[a].reach;
    Number far = plain(env.laws[0].step_s) * fall + Number(1e-6);
#endif
#if PAIRED
    const int start = contact_start(p);
    EACH_OWNED(own.lanes, start, contact_count(p), k) {
        int contact = start + k, i = count;
#else
    EACH_SLOT
    for (int k = 0; k < SLOTS; k++) {
        int contact = k * LANES + own.lanes.lane;
#if LISTED
        int i = count;
#else
        int i = k;
        list[i].on = false;
        weights[i] = Real(0);
#endif
        if (contact >= CONTACTS) continue;
#endif
#if HELD
        Vec held = own.arms[k];
        Real radius = own.radii[k];
#else
        long long row = env.geometry + 4LL * problem.spheres[contact];
        Vec held = problem.geometry.vector(row) - env.constants[a].com;
        Real radius = problem.geometry.at(row + 3);
#endif
#if CULLED
        if (plain(height) + plain(dot(rotation.z, held)) - plain(radius) > far) continue;
#endif
        bool touches = touch_ground(list[i], env.laws[pair_law(p)], motion, rotation * held, height, radius, weights[i]);
        if (touches) {
#if PATCHES
            if (area_start(p) >= 0) {
                weights[i] = problem.geometry.value[env.geometry + 4LL * area_start(p) + contact - contact_start(p)] * weights[i];
                add_row(moments, list[i], weights[i]);
            } else
#endif
            add_row(moments, list[i], weights[i] * list[i].stop_n);
            count++;
#if PAIRED
            list[i].normal = vec(Real(0), Real(0), Real(1));
            list[i].arm_b = none();
            list[i].a = a;
            list[i].b = -1;
#endif
#if LISTED
            list[i].slot = SLOT_OF(contact);
            list[i].impulse = own.before[contact / LANES];
#endif
        }
#if !LISTED
        list[i].on = touches;
        list[i].impulse = own.before[i];
#endif
    }
    if (!own.lanes.any(count > first)) return;
    moments = sum_rows(own.lanes, moments);
#if PATCHES
    if (area_start(p) >= 0) {
        share_by_area(own.lanes, moments, motion, list, weights, first, count);
    } else
#endif
    EACH_CONTACT(list, first, count) share_out(list[i], crowd(moments, motion, list[i]), weights[i]);
#if SURFACE
    Real total = Real(0);
    EACH_CONTACT(list, first, count) total += weights[i];
    total = own.lanes.sum(total);
    EACH_CONTACT(list, first, count) surface(list[i], env.laws[0], motion, env.bodies[a].position, weights[i], total);
#endif
}

#if SHARED
// Finds the pairs that may touch in this step, and marks the links that belong to them.
INLINE void find_near_pairs(const Problem& problem, Environment& env, const Lanes& lanes, const Mat* rotations,
                            const Motion* motions) {
    CollideRoom& room = env.chain.room.collide;
    DIVIDED(lanes, p, PAIRS) {
        const int a = pair_a(p), b = pair_b(p);
        bool near = false;
        if (b >= 0) {
            Reach reach;
            near = may_touch(env, p, rotations, motions, reach);
            room.limits[p] = reach.limit;
            room.nears[p] = reach.near;
        } else if (b == -1) {
            near = near_ground(env, a, motions[a]);
        } else {
#if FIXED
            Number margin;
            near = near_surface(problem, env, fixed_surface(problem, env, -2 - b), p, motions[a], margin);
#endif
        }
        room.near[p] = near;
        room.touched[p] = false;
        if (near && body_link(a) >= 0) env.chain.known[body_link(a)] = true;
        if (near && b >= 0 && body_link(b) >= 0) env.chain.known[body_link(b)] = true;
    }
    lanes.sync();
}
#endif

// Finds the contacts of a step and their impulses, and adds these to the bodies' velocities and angular momenta.
INLINE void collide(const Problem& problem, Environment& env, Own& own, const Mat* rotations, Motion* motions,
                    Vec* velocities, Vec* spins) {
#if HOST && LANES == 1 && SLOTS > 2048
    static thread_local Contact list[LIST_ROOM];  // too large for a stack
    static thread_local Real weights[LIST_ROOM];
#else
    Contact list[LIST_ROOM];
    Real weights[LIST_ROOM];
#endif
    int count = 0;
#if PAIRED
    ROOM(int, groups, BODIES, env.chain.room.collide);
    DIVIDED(own.lanes, b, BODIES) groups[b] = 0;
#if !LINKS
    int ends[PAIR_ROOM], loaded = 0;
#endif
#if SHARED
    find_near_pairs(problem, env, own.lanes, rotations, motions);
    reveal_links(env.chain, own.lanes, env.bodies);
    CollideRoom& room = env.chain.room.collide;
#endif
#if QUEUED
    Candidates queue;
    queue.few = queue.many = 0;
#endif
    EACH_PAIR
    for (int p = 0; p < PAIRS; p++) {
        int a = pair_a(p), b = pair_b(p), touching = 0;
        if (b >= 0) {
#if !QUEUED
#if SHARED
            if (!own.lanes.any(room.near[p])) continue;
#endif
            touching = touch_pair(problem, env, own, p, rotations, motions, list, weights, count);
#endif
#if FIXED
        } else if (b < -1) {
            touching = touch_surface(problem, env, own, p, rotations, motions, list, weights, count);
#endif
        } else if (own.lanes.any(near_ground(env, a, motions[a]))) {
#if LINKS
            if (body_link(a) >= 0) {
                touching = touch_plane_link(problem, env, own, p, rotations, motions, list, weights, count);
            } else
#endif
            {
            touching = -count;
            const Moving& all = moving(RESPONSES(env, motions), motions, a);
            touch_plane(problem, env, own, p, rotations[a], all, list, weights, count);
            touching += count;
            }
        }
#if SHARED
        if (touching > 0) room.touched[p] = true;
#else
        if (own.lanes.any(touching > 0) && own.lanes.sum(Number(touching)) > Number(0)) {
            groups[group_of(a)]++;
            if (b >= 0 && group_of(b) >= 0) groups[group_of(b)]++;
#if !LINKS
            loaded++;  // `Load` has no share of the joints of chains
#endif
        }
#endif
#if !LINKS
        ends[p] = count;
#endif
    }
#if QUEUED
    // environments of a warp each go to their own next pair, or each would wait for the pairs of all others
    int next = -1;
    KEEP_LOOP
    while (true) {
        do next++;
        while (next < PAIRS && !(room.near[next] && pair_b(next) >= 0));
        if (next >= PAIRS) break;
        queue_pair(problem, env, own, next, rotations, queue);
    }
    make_queued(problem, env, own, rotations, motions, queue, list, weights, count);
#endif
#if SHARED
    own.lanes.sync();
    DIVIDED(own.lanes, p, PAIRS) {
        if (!room.touched[p]) continue;
        Lanes::count_up(groups[group_of(pair_a(p))]);
        if (pair_b(p) >= 0 && group_of(pair_b(p)) >= 0) Lanes::count_up(groups[group_of(pair_b(p))]);
    }
    own.lanes.sync();
#endif
    split(list, count, groups);
#if !LINKS
    Pushed pushed[PAIR_ROOM];
#endif
    if (!own.lanes.any(count > 0)) {
        forget(own);
#if LINKS
        if (!own.lanes.any(env.chain.active)) return;
#else
        return;
#endif
    }
#else
    if (!own.lanes.any(near_ground(env, 0, motions[0]))) {
        forget(own);
        return;
    }
    motions[0].inverse_inertia = turned(rotations[0], env.constants[0].inverse_inertia);
    touch_plane(problem, env, own, 0, rotations[0], motions[0], list, weights, count);
    if (!own.lanes.any(count > 0)) {
        forget(own);
        return;
    }
#endif
#if !SHARED
    Vec linear[BODIES], angular[BODIES], free_velocities[BODIES], free_omegas[BODIES];
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        free_velocities[b] = motions[b].velocity;
        free_omegas[b] = motions[b].omega;
    }
#endif
#if SURFACE
    Real touching = Real(own.lanes.sum(Number(count)));
    const Sym& J = motions[0].inverse_inertia;
    Real across = reciprocal((J.xx + J.yy) * touching), about = reciprocal(J.zz * touching);
#endif
    // warm start: the impulses of the previous step
    int sweep = own.lanes.any(own.warm) ? -1 : 0;
#if LINKS
    // a single iteration starts at zero
    if (problem.sweeps < 2) {
        DIVIDED(own.lanes, k, 3 * JOINTS) env.chain.impulses[k] = Real(0);
    }
    if (own.lanes.any(env.chain.active)) sweep = -1;
#if SHARED
    list_reached(env, own.lanes);
    DIVIDED(own.lanes, r, room.reached_count) room.free[room.reached[r]] = motions[body_at(room.reached[r])];
    own.lanes.sync();
#else
    // links that are touched, and the bodies that are no links or such ones
    int reached[LINKS], reached_count = 0, touched[BODIES], touched_count = 0;
    for (int b = 0; b < BODIES; b++) {
        int l = body_link(b);
        if (l >= 0 && !env.chain.known[l]) continue;
        if (l >= 0) reached[reached_count++] = l;
        touched[touched_count++] = b;
    }
#endif
#endif
#if PAIRED && !LINKS
    const int first_sweep = sweep;
    const bool loads_count = own.lanes.any(loaded > 1);  // the whole warp takes part in the sums of `pushed_by`
    bool active[PAIR_ROOM];
    for (int p = 0, first = 0; p < PAIRS; first = ends[p++]) active[p] = own.lanes.any(ends[p] > first);
#endif
    do {
#if SHARED
        sweep_contacts(env, own.lanes, list, count, motions, sweep >= 0);
        move_bodies(env, own.lanes, motions, spins, sweep >= 0, sweep + 1 >= problem.sweeps);
#else
#if LINKS
        for (int i = 0; i < touched_count; i++) linear[touched[i]] = angular[touched[i]] = none();
#else
        EACH_BODY
        for (int b = 0; b < BODIES; b++) linear[b] = angular[b] = none();
#endif
#if PAIRED && !LINKS
        if (loaded > 1 && sweep != first_sweep) {
            for (int p = 0, first = 0; p < PAIRS; first = ends[p++]) {
                if (!active[p]) continue;
                Load load = load_of(pushed[p], pair_a(p), pair_b(p), motions);
                aim_under_load(env.laws[pair_law(p)], list, first, ends[p], load, motions);
            }
        }
#endif
#if PAIRED
        for (int i = 0; i < count; i++) {
            Contact& c = list[i];
            if (sweep >= 0) c.impulse = swept(c, env.laws[0], relative_velocity(c, motions));
            linear[c.a] = linear[c.a] + c.impulse;
            angular[c.a] = angular[c.a] + cross(c.arm, c.impulse);
            if (c.b >= 0) {
                linear[c.b] = linear[c.b] - c.impulse;
                angular[c.b] = angular[c.b] - cross(c.arm_b, c.impulse);
            }
        }
#else
        EACH_CONTACT(list, 0, count) {
            Contact& c = list[i];
            if (sweep >= 0) c.impulse = swept(c, env.laws[0], motions[0].velocity + cross(motions[0].omega, c.arm));
            linear[0] = linear[0] + c.impulse;
            angular[0] = angular[0] + cross(c.arm, c.impulse);
#if SURFACE
            if (env.laws[0].surface.twisting) {
                if (sweep >= 0) c.turning = turned_by(c, env.laws[0], motions[0], across, about);
                angular[0] = angular[0] + c.turning;
            }
#endif
        }
#endif
#if LINKS
        push_joints(env.chain);
        for (int i = 0; i < reached_count; i++) {
            int l = reached[i], b = link_body[l];
            push_link(env.chain, l, linear[b], angular[b]);
        }
        if (sweep >= 0 && env.chain.active) sweep_joints(env.chain, own.lanes);
        for (int i = 0; i < reached_count; i++) {
            int l = reached[i], b = link_body[l];
            motions[b].velocity = free_velocities[b];
            motions[b].omega = free_omegas[b];
            gain(env.chain, l, motions[b].velocity, motions[b].omega);
        }
#endif
#if PAIRED && !LINKS
        if (loads_count) {  // sums by pair, of which those by body are made without further exchanges
            for (int b = 0; b < BODIES; b++) linear[b] = angular[b] = none();
            for (int p = 0, first = 0; p < PAIRS; first = ends[p++]) {
                if (!active[p]) continue;
                int a = pair_a(p), b = pair_b(p);
                pushed[p] = pushed_by(own.lanes, list, first, ends[p], b);
                linear[a] = linear[a] + pushed[p].linear;
                angular[a] = angular[a] + pushed[p].angular_a;
                if (b < 0) continue;
                linear[b] = linear[b] - pushed[p].linear;
                angular[b] = angular[b] - pushed[p].angular_b;
            }
        }
#else
        const bool loads_count = false;
#endif
        EACH_BODY
        for (int b = 0; b < BODIES; b++) {
            if (!is_free(b)) continue;
            if (!loads_count) {
                linear[b] = own.lanes.sum(linear[b]);
                angular[b] = own.lanes.sum(angular[b]);
            }
            motions[b].velocity = free_velocities[b] + motions[b].inverse_mass * linear[b];
            motions[b].omega = free_omegas[b] + motions[b].inverse_inertia * angular[b];
        }
#endif
    } while (++sweep < problem.sweeps);
#if QUEUED
    keep_shown(env, own, list, count, problem.sweeps);
#else
    keep(env, own, list, count, problem.sweeps);
#endif
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        if (!is_free(b) || !own.lanes.writes()) continue;
        velocities[FREE(b)] = motions[b].velocity;
#if !SHARED
        spins[b] = spins[b] + angular[b];
#endif
    }
    own.lanes.sync();
#if RECORD && !QUEUED
#if PAIRED
    for (int i = 0; i < count; i++) note(own.tallies[list[i].slot], list[i], env.laws[0], env.bodies[list[i].a].position);
#elif LISTED
    for (int i = 0; i < count; i++) note(own.tallies[list[i].slot], list[i], env.laws[0], env.bodies[0].position);
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        if (list[i].on) note(own.tallies[i], list[i], env.laws[0], env.bodies[0].position);
    }
#endif
#endif
}
