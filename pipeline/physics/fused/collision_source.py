"""CUDA source: flight, and the contacts of a step with their impulses.

Its formulas are those of `physics/motion.py` and `physics/rollout.py`.
"""

from __future__ import annotations

COLLISION = r"""
// Moves a free body over a step in which its velocity and angular momentum went to the given ones: positions follow
// the mean velocity, the rotation what the mean angular momentum gives half-way through.
INLINE void advance(Body& body, const Constants& c, Vec omega_start, Vec velocity, Vec spin, Real h) {
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
INLINE void apply(const Wrenches& w, const Environment& env, const Body& body, Vec omega, Vec& velocity, Vec& spin) {
    Real h = env.law.step_s;
    Vec u = body.velocity - w.wind;
    Real drag = w.linear_drag + w.quadratic_drag * root(dot(u, u));
    Real height = body.position.z - env.ground;
    Vec a = w.acceleration - drag * u + w.magnus * cross(omega, body.velocity);
    a.z = a.z - w.magnet * exponential(-height * reciprocal(w.magnet_range));
    velocity = velocity + h * a;
    spin = spin - h * w.spin_damping * body.spin;
}
#endif

#if RECORD
// Adds a contact's impulse and where it acted to its sums.
INLINE void note(Tally& tally, const Contact& c, const Law& law, Vec com) {
#if PAIRED
    Number along = plain(dot(c.impulse, c.normal)), across = size(c.impulse - Real(along) * c.normal);
#else
    Number along = plain(c.impulse.z), x = plain(c.impulse.x), y = plain(c.impulse.y), across = root(x * x + y * y);
#endif
    Vec point = com + c.arm;
    tally.impulse[0] += plain(c.impulse.x);
    tally.impulse[1] += plain(c.impulse.y);
    tally.impulse[2] += plain(c.impulse.z);
    tally.weighted[0] += along * plain(point.x);
    tally.weighted[1] += along * plain(point.y);
    tally.weighted[2] += along * plain(point.z);
    tally.weight += along;
    if (across > Number(0.99) * plain(friction_of(law)) * along) tally.sliding += along;
}
#endif

// Whether a body may touch the ground in this step, by the sphere around its centre of mass.
INLINE bool near_ground(const Environment& env, int b, const Motion& m) {
    Number low = plain(env.bodies[b].position.z - env.ground) - env.constants[b].reach;
    Number rate = plain(m.velocity.z) - size(m.omega) * env.constants[b].reach;
    return low < Number(1e-6) || low + plain(env.law.step_s) * rate < Number(1e-6);
}

#if PAIRED
// Finds the contacts of the spheres of body b with the union of body a, and shares the mass out among them.
__device__ void touch_pair(const Problem& problem, const Environment& env, int p, const Mat* rotations,
                           const Motion* motions, Contact* list, Real* weights, int& count) {
    int a = pair_a(p), b = pair_b(p), first = count;
    const Constants &ca = env.constants[a], &cb = env.constants[b];
    const Motion &ma = motions[a], &mb = motions[b];
    Vec com_a = env.bodies[a].position, com_b = env.bodies[b].position;
    // no point of a gap g nears faster than V + W g / 2, so what is further than h V / (1 - h W / 2) cannot touch
    Number spins = size(ma.omega) + size(mb.omega), h = plain(env.law.step_s);
    Number V = size(ma.velocity - mb.velocity) + size(ma.omega) * (ca.reach + Number(SMOOTHING_M)) +
               size(mb.omega) * (cb.reach + Number(SMOOTHING_M));
    Number left = Number(1) - Number(0.5) * h * spins;
    Number limit = left > Number(0.01) ? h * V / left + Number(1e-6) : Number(1e30);
    Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(a), sphere_count(a)};
    Vec up = transposed(rotations[a], vec(Real(0), Real(0), Real(1)));
    if (size(com_a - com_b) - ca.reach - cb.reach - Number(SMOOTHING_M) < limit) {
        int start = contact_start(p), behind = (env.lanes.lane - start % LANES + LANES) % LANES;
        for (int k = behind; k < contact_count(p); k += LANES) {
            long long row = env.geometry + 4LL * problem.spheres[start + k];
            Vec arm = rotations[b] * (problem.geometry.vector(row) - cb.com);
            Real radius = problem.geometry.at(row + 3);
            Vec center = com_b + arm;
            if (!(size(center - com_a) - ca.reach - plain(radius) - Number(SMOOTHING_M) < limit)) continue;
            Vec outward;
            Real distance, weight;
            Vec local = transposed(rotations[a], center - com_a) + ca.com;
            if (!union_distance(spheres, local, limit + plain(radius), up, distance, outward)) continue;
            Contact& c = list[count];
            Real gap = distance - radius;
            c.normal = -(rotations[a] * outward);
            Vec point = center + (radius + Number(0.5) * gap) * c.normal;
            c.arm = point - com_a;
            c.arm_b = point - com_b;
            c.a = a;
            c.b = b;
            c.slot = (start + k) / LANES;
            Real speed = dot(relative_velocity(c, motions), c.normal);
            Vec turn_a = cross(c.arm, c.normal), turn_b = cross(c.arm_b, c.normal);
            Real inverse_mass = ma.inverse_mass + dot(turn_a, ma.inverse_inertia * turn_a) + mb.inverse_mass +
                                dot(turn_b, mb.inverse_inertia * turn_b);
            Real mobility = mobility_trace(ma, c.arm) + mobility_trace(mb, c.arm_b);
            if (prepare(c, env.law, gap, speed, inverse_mass, mobility, weight)) weights[count++] = weight;
        }
    }
    if (env.lanes.any(count > first)) share_out_pair(env.lanes, list, weights, first, count, motions);
}
#endif

// Finds the contacts of a body with the ground; they go to the list, or to their slot where that is the only pair.
INLINE void touch_plane(const Problem& problem, const Environment& env, int p, const Mat& rotation,
                        const Motion& motion, Contact* list, Real* weights, int& count) {
    int a = pair_a(p), first = count;
    Moments moments = {Real(0), Real(0), Real(0), Real(0), Real(0), Real(0)};
    Real height = env.bodies[a].position.z - env.ground;
#if PAIRED
    int start = contact_start(p), behind = (env.lanes.lane - start % LANES + LANES) % LANES;
    for (int k = behind; k < contact_count(p); k += LANES) {
        int contact = start + k, i = count;
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        int contact = i * LANES + env.lanes.lane;
        list[i].on = false;
        weights[i] = Real(0);
        if (contact >= CONTACTS) continue;
#endif
#if HELD
        Vec arm = rotation * env.arms[i];
        Real radius = env.radii[i];
#else
        long long row = env.geometry + 4LL * problem.spheres[contact];
        Vec arm = rotation * (problem.geometry.vector(row) - env.constants[a].com);
        Real radius = problem.geometry.at(row + 3);
#endif
        bool touches = touch_ground(list[i], env.law, motion, arm, height, radius, weights[i]);
        if (touches) {
            add_row(moments, list[i], weights[i]);
            count++;
        }
#if PAIRED
        if (touches) {
            list[i].normal = vec(Real(0), Real(0), Real(1));
            list[i].arm_b = none();
            list[i].a = a;
            list[i].b = -1;
            list[i].slot = contact / LANES;
        }
#else
        list[i].on = touches;
#endif
    }
    if (!env.lanes.any(count > first)) return;
    moments = sum_rows(env.lanes, moments);
#if PAIRED
    for (int i = first; i < count; i++) share_out(list[i], crowd(moments, motion, list[i]), weights[i]);
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        if (list[i].on) share_out(list[i], crowd(moments, motion, list[i]), weights[i]);
    }
#endif
}

// Finds the contacts of a step and their impulses, and adds these to the bodies' velocities and angular momenta.
INLINE void collide(const Problem& problem, Environment& env, const Mat* rotations, Motion* motions, Vec* velocities,
                    Vec* spins) {
    Contact list[SLOTS];
    Real weights[SLOTS];
    int count = 0;
#if PAIRED
    for (int p = 0; p < PAIRS; p++) {
        int a = pair_a(p);
        if (pair_b(p) >= 0) {
            touch_pair(problem, env, p, rotations, motions, list, weights, count);
        } else if (env.lanes.any(near_ground(env, a, motions[a]))) {
            touch_plane(problem, env, p, rotations[a], motions[a], list, weights, count);
        }
    }
    if (!env.lanes.any(count > 0)) return;
#else
    if (!env.lanes.any(near_ground(env, 0, motions[0]))) return;
    motions[0].inverse_inertia = turned(rotations[0], env.constants[0].inverse_inertia);
    touch_plane(problem, env, 0, rotations[0], motions[0], list, weights, count);
    if (!env.lanes.any(count > 0)) return;
#endif
    Vec free_velocities[BODIES], free_omegas[BODIES], linear[BODIES], angular[BODIES];
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        free_velocities[b] = motions[b].velocity;
        free_omegas[b] = motions[b].omega;
    }
    int sweep = 0;
    do {
        EACH_BODY
        for (int b = 0; b < BODIES; b++) linear[b] = angular[b] = none();
#if PAIRED
        for (int i = 0; i < count; i++) {
            Contact& c = list[i];
            c.impulse = swept(c, env.law, relative_velocity(c, motions));
            linear[c.a] = linear[c.a] + c.impulse;
            angular[c.a] = angular[c.a] + cross(c.arm, c.impulse);
            if (c.b >= 0) {
                linear[c.b] = linear[c.b] - c.impulse;
                angular[c.b] = angular[c.b] - cross(c.arm_b, c.impulse);
            }
        }
#else
        EACH_SLOT
        for (int i = 0; i < SLOTS; i++) {
            Contact& c = list[i];
            if (!c.on) continue;
            c.impulse = swept(c, env.law, motions[0].velocity + cross(motions[0].omega, c.arm));
            linear[0] = linear[0] + c.impulse;
            angular[0] = angular[0] + cross(c.arm, c.impulse);
        }
#endif
        EACH_BODY
        for (int b = 0; b < BODIES; b++) {
            if (!is_free(b)) continue;
            linear[b] = env.lanes.sum(linear[b]);
            angular[b] = env.lanes.sum(angular[b]);
            motions[b].velocity = free_velocities[b] + motions[b].inverse_mass * linear[b];
            motions[b].omega = free_omegas[b] + motions[b].inverse_inertia * angular[b];
        }
    } while (++sweep < problem.sweeps);
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        if (!is_free(b)) continue;
        velocities[b] = motions[b].velocity;
        spins[b] = spins[b] + angular[b];
    }
#if RECORD
#if PAIRED
    for (int i = 0; i < count; i++) {
        const Contact& c = list[i];
        note(env.tallies[c.slot], c, env.law, env.bodies[c.a].position);
    }
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        if (list[i].on) note(env.tallies[i], list[i], env.law, env.bodies[0].position);
    }
#endif
#endif
}
"""
