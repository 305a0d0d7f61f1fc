// Which bodies may touch in a step, and the contact of a slot; formulas of `physics/contact_detection.py`.
// Whether a body may touch the ground in this step, by the sphere around its centre of mass.
INLINE Flag near_ground(const Environment& env, int b, const Motion& m) {
    Number low = plain(env.bodies[b].position.z - env.ground) - env.constants[b].reach;
    Number rate = plain(m.velocity.z) - size(m.omega) * env.constants[b].reach;
    return (low < Number(1e-6)) | (low + plain(env.laws[0].step_s) * rate < Number(1e-6));
}

#if PAIRED
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

#if HULLS && PACKED
// Marks the spheres of a body that are beside another body: as `beside`.
INLINE void mark_beside(const Constants& other, const Frame& frame, const Swarm& swarm, int count, Number limit,
                        bool* marks) {
    for (int i = 0; i < count; i += 8) {
        const Eight x = eight_at(swarm.at[0] + i), y = eight_at(swarm.at[1] + i), z = eight_at(swarm.at[2] + i);
        const Eight bound = Number(1 + 1e-5) * (limit + eight_at(swarm.at[3] + i) + Number(SMOOTHING_M));
        Eight far2 = {};
        for (int k = 0; k < 3; k++) {
            const Number* row = frame.turn + 3 * k;
            const Eight at = row[0] * x + row[1] * y + row[2] * z + frame.shift[k];
            const Eight out = greater(other.low[k] - at, at - other.high[k]);
            far2 += out > Number(0) ? out * out : Eight{};
        }
        const auto far = far2 > bound * bound;
        for (int k = 0; k < 8; k++) marks[i + k] = far[k] != 0;
    }
}
#endif

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

INLINE Number sum_of_sides(Vec v) {
    const Number x = plain(v.x), y = plain(v.y), z = plain(v.z);
    return (x < Number(0) ? -x : x) + (y < Number(0) ? -y : y) + (z < Number(0) ? -z : z);
}

// Whether two bodies are surely farther apart than they may come in a step, without roots: sides add up to no less than
// the size, and 1 / (1 - x) is at most 1 + 2 x for x up to 1/2.
INLINE bool far_apart(const Constants& ca, const Constants& cb, const Motion& ma, const Motion& mb, Vec between, Number h) {
    const Number spin_a = sum_of_sides(ma.omega), spin_b = sum_of_sides(mb.omega), x = Number(0.5) * h * (spin_a + spin_b);
    const Number reach_a = ca.reach + Number(SMOOTHING_M), reach_b = cb.reach + Number(SMOOTHING_M);
    const Number most = h * (sum_of_sides(ma.velocity - mb.velocity) + spin_a * reach_a + spin_b * reach_b);
    const Number far = Number(1 + 1e-4) * (reach_a + reach_b + most * (Number(1) + Number(2) * x)) + Number(2e-6);
    return x < Number(0.5) && plain(dot(between, between)) > far * far;
}

// Whether the ball around a body's centre of mass is beyond a side of the box of another body by more than a margin.
INLINE bool ball_apart(const Constants& ours, const Constants& other, const Mat& rotation, Vec between, Number margin) {
    const Vec place = transposed(rotation, between) + other.com;
    const Number at[3] = {plain(place.x), plain(place.y), plain(place.z)}, bound = ours.reach + margin;
    for (int i = 0; i < 3; i++) {
        if (at[i] - bound > other.high[i] || at[i] + bound < other.low[i]) return true;
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
#if HOST
    const Vec between = env.bodies[a].position - env.bodies[b].position;
    if (far_apart(ca, cb, ma, mb, between, plain(env.laws[0].step_s))) return false;
#endif
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
#if HOST
    if (ball_apart(cb, ca, rotations[a], -between, margin) || ball_apart(ca, cb, rotations[b], between, margin)) return false;
#endif
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
                        const Nearness* known, Contact& c, Real& weight, int edge = -1) {
    int a = pair_a(p), b = pair_b(p), found = 2;
#if !LINKS
    const Motion &ma = motions[a], &mb = motions[b];
#endif
    Facing facing;
    if (!face(problem, env, p, k, rotations, limit, parting, known, facing, edge)) return 0;
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
#endif
