"""CUDA source: an environment stepped from its first frame to its last, its state in registers."""

from __future__ import annotations

ROLLOUT = r"""
struct Problem {
    Input table;     // (environments, TABLE_WIDTH): numbers of each environment, in the order in which `load` reads
    Input steps;     // (1 or environments, intervals, 4): step, stiffness, damping, time at the start
    Input geometry;  // (1 or environments, spheres, 4): centres in the body frame, radii
    Input drives;    // (1 or environments, samples, 14): time, position, quaternion, velocity, angular velocity
    const int* __restrict__ substeps;      // of each interval
    const int* __restrict__ spheres;       // of each contact: row of the geometry
    const int* __restrict__ drive_starts;  // of each driven body: row of its first sample
    const int* __restrict__ drive_last;    // (1 or environments, driven bodies): index of the last interval
    Number* __restrict__ frames;           // (environments, frames, bodies, 16)
    Number* __restrict__ frame_tangents;
    Number* __restrict__ labels;           // (environments, frames, contacts, 12)
    int environments, frame_count, sweeps;
    long long steps_stride, geometry_stride, drive_stride;
    int drive_last_stride;
};

struct Body {
    Vec position;  // of the centre of mass; of the frame's origin where the body is not free
    Quat quat;
    Vec velocity, spin;  // spin: angular momentum; angular velocity where the body is not free
};

// Accelerations of a free body in flight: a = -(c + k |u|) u + s omega x v + f - A exp(-height / l) n with
// u = v - wind, and angular acceleration -d omega.
struct Wrenches {
    Real linear_drag, quadratic_drag, magnus, spin_damping, magnet, magnet_range;
    Vec acceleration, wind;
};

struct Constants {
    Real inverse_mass;
    Sym inverse_inertia;  // body axes
    Vec com;              // in the body frame
    Number reach;         // of its spheres from the centre of mass
#if EFFECTS
    Wrenches wrenches;
#endif
};

struct Tally {  // contacts summed since the last frame
    Number impulse[3], weighted[3], weight, sliding;
};

struct Environment {
    long long index, geometry, steps, drives;
    int drive_last;
    Lanes lanes;
    Vec gravity;
    Real ground;
    Law law;
    Body bodies[BODIES];
    Constants constants[BODIES];
    int cursors[BODIES];
#if HELD
    Vec arms[SLOTS];  // of this lane's spheres, from the centre of mass, body axes
    Real radii[SLOTS];
#endif
#if RECORD
    Tally tallies[SLOTS];
#endif
};

INLINE void load(const Problem& problem, Environment& env) {
    const Input& table = problem.table;
    long long at = env.index * TABLE_WIDTH;
    env.gravity = table.vector(at);
    env.ground = table.at(at + 3);
    env.law.friction = table.at(at + 4);
    at += 5;
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        Body& body = env.bodies[b];
        Constants& c = env.constants[b];
        c.inverse_mass = table.at(at);
        Sym inertia = {table.at(at + 1), table.at(at + 2), table.at(at + 3),
                       table.at(at + 4), table.at(at + 5), table.at(at + 6)};
        c.inverse_inertia = inertia;
        c.com = table.vector(at + 7);
        body.position = table.vector(at + 10);
        Quat quat = {table.at(at + 13), table.at(at + 14), table.at(at + 15), table.at(at + 16)};
        body.quat = quat;
        body.velocity = table.vector(at + 17);
        body.spin = table.vector(at + 20);
        at += 23;
#if EFFECTS
        Wrenches& w = c.wrenches;
        w.linear_drag = table.at(at);
        w.quadratic_drag = table.at(at + 1);
        w.magnus = table.at(at + 2);
        w.spin_damping = table.at(at + 3);
        w.acceleration = table.vector(at + 4);
        w.wind = table.vector(at + 7);
        w.magnet = table.at(at + 10);
        w.magnet_range = table.at(at + 11);
        at += 12;
#endif
        c.reach = Number(0);
        const Number* sphere = problem.geometry.value + env.geometry + 4LL * sphere_start(b);
        for (int i = 0; i < sphere_count(b); i++, sphere += 4) {
            Number x = sphere[0] - plain(c.com.x), y = sphere[1] - plain(c.com.y), z = sphere[2] - plain(c.com.z);
            c.reach = greater(c.reach, root(x * x + y * y + z * z) + sphere[3]);
        }
        env.cursors[b] = 0;
    }
#if HELD
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        int contact = i * LANES + env.lanes.lane;
        long long row = env.geometry + 4LL * (contact < CONTACTS ? problem.spheres[contact] : 0);
        env.arms[i] = problem.geometry.vector(row) - env.constants[0].com;
        env.radii[i] = problem.geometry.at(row + 3);
    }
#endif
}

#if DRIVEN
// The commanded motion of a driven body at a time that never falls.
__device__ void drive(const Problem& problem, Environment& env, int b, Real time) {
    int number = drive_number(b), last = problem.drive_last[env.drive_last + number];
    long long start = env.drives + 14LL * problem.drive_starts[number];
    const Input& rows = problem.drives;
    int& cursor = env.cursors[b];
    while (cursor < last && rows.value[start + 14LL * (cursor + 1)] <= plain(time)) cursor++;
    Real first = rows.at(start), final = rows.at(start + 14LL * (last + 1));
    bool moving = plain(time) >= plain(first) && plain(time) <= plain(final);
    long long at = start + 14LL * cursor;
    Real held = plain(time) < plain(first) ? first : (plain(time) > plain(final) ? final : time);
    Real since = held - rows.at(at);
    Vec velocity = rows.vector(at + 8), omega = rows.vector(at + 11);
    Quat quat = {rows.at(at + 4), rows.at(at + 5), rows.at(at + 6), rows.at(at + 7)};
    Body& body = env.bodies[b];
    body.position = rows.vector(at + 1) + since * velocity;
    body.quat = multiply(quat_exp(since * omega), quat);
    body.velocity = moving ? velocity : none();
    body.spin = moving ? omega : none();
}
#endif

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

INLINE void step(const Problem& problem, Environment& env, Real time_after) {
    Mat rotations[BODIES];
    Motion motions[BODIES];
    Vec starts[BODIES], velocities[BODIES], spins[BODIES];
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        const Body& body = env.bodies[b];
        const Constants& c = env.constants[b];
        rotations[b] = matrix(body.quat);
        velocities[b] = body.velocity;
        spins[b] = starts[b] = body.spin;
        motions[b].omega = body.spin;
        motions[b].inverse_mass = Real(0);
        motions[b].inverse_inertia = no_inertia();
        if (is_free(b)) {
            starts[b] = c.inverse_inertia * transposed(rotations[b], body.spin);
            motions[b].omega = rotations[b] * starts[b];
            velocities[b] = body.velocity + env.law.step_s * env.gravity;
#if EFFECTS
            apply(c.wrenches, env, body, motions[b].omega, velocities[b], spins[b]);
            motions[b].omega = rotations[b] * (c.inverse_inertia * transposed(rotations[b], spins[b]));
#endif
            motions[b].inverse_mass = c.inverse_mass;
#if PAIRED
            motions[b].inverse_inertia = turned(rotations[b], c.inverse_inertia);
#endif
        }
        motions[b].velocity = velocities[b];
    }
#if PAIRS
    collide(problem, env, rotations, motions, velocities, spins);
#endif
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        if (is_free(b)) advance(env.bodies[b], env.constants[b], starts[b], velocities[b], spins[b], env.law.step_s);
#if DRIVEN
        if (drive_number(b) >= 0) drive(problem, env, b, time_after);
#endif
    }
}

INLINE void write_vector(const Problem& problem, long long at, Vec v) {
    write_row(problem.frames + at, plain(v.x), plain(v.y), plain(v.z), Number(0));
#if DUAL
    write_row(problem.frame_tangents + at, v.x.tangent, v.y.tangent, v.z.tangent, Number(0));
#endif
}

// Writes position, quaternion, velocity (of the body frame's origin) and angular velocity (body frame).
INLINE void write_frame(const Problem& problem, const Environment& env, int frame) {
    if (env.lanes.lane != 0 || env.lanes.idle) return;
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        const Body& body = env.bodies[b];
        const Constants& c = env.constants[b];
        Mat R = matrix(body.quat);
        Vec position = body.position, velocity = body.velocity, omega = transposed(R, body.spin);
        if (is_free(b)) {
            omega = c.inverse_inertia * omega;
            Vec arm = R * c.com;
            position = position - arm;
            velocity = velocity - cross(R * omega, arm);
        }
        long long at = 16 * ((env.index * problem.frame_count + frame) * BODIES + b);
        Quat q = body.quat;
        write_vector(problem, at, position);
        write_row(problem.frames + at + 4, plain(q.w), plain(q.x), plain(q.y), plain(q.z));
#if DUAL
        write_row(problem.frame_tangents + at + 4, q.w.tangent, q.x.tangent, q.y.tangent, q.z.tangent);
#endif
        write_vector(problem, at + 8, velocity);
        write_vector(problem, at + 12, omega);
    }
}

#if RECORD
INLINE void write_label(const Problem& problem, Environment& env, int frame, int contact, Tally& t, Vec normal,
                        Number gap, Vec point) {
    Number* to = problem.labels + 12 * ((env.index * problem.frame_count + frame) * CONTACTS + contact);
    bool acted = t.weight > Number(0);
    Number each = acted ? Number(1) / t.weight : Number(0);
    Number slides = acted && t.sliding > Number(0.5) * t.weight ? Number(1) : Number(0);
    write_row(to, t.impulse[0], t.impulse[1], t.impulse[2], gap);
    write_row(to + 4, acted ? each * t.weighted[0] : plain(point.x), acted ? each * t.weighted[1] : plain(point.y),
              acted ? each * t.weighted[2] : plain(point.z), slides);
    write_row(to + 8, plain(normal.x), plain(normal.y), plain(normal.z), Number(0));
    Tally zero = {};
    t = zero;
}

// Writes what each contact passed on since the last frame, and the geometry now; and starts the sums anew.
INLINE void write_labels(const Problem& problem, Environment& env, int frame) {
    if (env.lanes.idle) return;
    EACH_PAIR
    for (int p = 0; p < PAIRS; p++) {
        int start = contact_start(p), behind = (env.lanes.lane - start % LANES + LANES) % LANES;
        int a = pair_a(p), b = pair_b(p) < 0 ? a : pair_b(p);
        Vec position_b = env.bodies[b].position;
        Mat rotation_b = matrix(env.bodies[b].quat);
#if PAIRED
        Vec position_a = env.bodies[a].position;
        Mat rotation_a = matrix(env.bodies[a].quat);
#endif
        EACH_SLOT
        for (int s = 0; s < SLOTS; s++) {
            int k = behind + s * LANES;
            if (k >= contact_count(p)) continue;
            long long row = env.geometry + 4LL * problem.spheres[start + k];
            Real radius = problem.geometry.at(row + 3);
            Vec center = position_b + rotation_b * (problem.geometry.vector(row) - env.constants[b].com);
            Vec normal = vec(Real(0), Real(0), Real(1));
            Real gap = center.z - env.ground - radius;
            Vec point = vec(center.x, center.y, center.z - radius);
#if PAIRED
            if (pair_b(p) >= 0) {
                Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(a), sphere_count(a)};
                Vec up = transposed(rotation_a, normal), outward;
                Vec local = transposed(rotation_a, center - position_a) + env.constants[a].com;
                Real distance;
                union_distance(spheres, local, Number(1e30), up, distance, outward);
                gap = distance - radius;
                normal = -(rotation_a * outward);
                point = center + (radius + Number(0.5) * gap) * normal;
            }
            Tally& tally = env.tallies[(start + k) / LANES];
#else
            Tally& tally = env.tallies[s];
#endif
            write_label(problem, env, frame, start + k, tally, normal, plain(gap), point);
        }
    }
}
#endif

INLINE void write(const Problem& problem, Environment& env, int frame) {
    write_frame(problem, env, frame);
#if RECORD
    write_labels(problem, env, frame);
#endif
}

// Rolls one environment out; called by all of its lanes.
INLINE void roll(const Problem& problem, int index, Lanes lanes) {
    Environment env;
    env.index = index;
    env.lanes = lanes;
    env.steps = index * problem.steps_stride;
    env.geometry = index * problem.geometry_stride;
    env.drives = index * problem.drive_stride;
    env.drive_last = index * problem.drive_last_stride;
    load(problem, env);
#if DRIVEN
    for (int b = 0; b < BODIES; b++) {
        if (drive_number(b) >= 0) drive(problem, env, b, problem.steps.at(env.steps + 3));
    }
#endif
#if RECORD
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        Tally zero = {};
        env.tallies[i] = zero;
    }
#endif
    write(problem, env, 0);
    KEEP_LOOP
    for (int frame = 1; frame < problem.frame_count; frame++) {
        long long row = env.steps + 4LL * (frame - 1);
        env.law.step_s = problem.steps.at(row);
        env.law.inverse_step = reciprocal(env.law.step_s);
        env.law.stiffness = problem.steps.at(row + 1);
        env.law.damping = problem.steps.at(row + 2);
        Real start = problem.steps.at(row + 3);
        int substeps = problem.substeps[frame - 1];
        KEEP_LOOP
        for (int s = 1; s <= substeps; s++) step(problem, env, start + Number(s) * env.law.step_s);
        write(problem, env, frame);
    }
}

#define PARAMETERS                                                                                                   \
    const Number *table, const Number *table_t, const Number *steps, const Number *steps_t, const Number *geometry,  \
        const Number *geometry_t, const Number *drives, const Number *drives_t, const int *substeps,                 \
        const int *spheres, const int *drive_starts, const int *drive_last, Number *frames, Number *frame_tangents,  \
        Number *labels, int environments, int frame_count, int sweeps, int steps_stride, int geometry_stride,        \
        int drive_stride, int drive_last_stride
#define PROBLEM                                                                                                      \
    {                                                                                                                \
        {table, table_t}, {steps, steps_t}, {geometry, geometry_t}, {drives, drives_t}, substeps, spheres,           \
            drive_starts, drive_last, frames, frame_tangents, labels, environments, frame_count, sweeps,             \
            steps_stride, geometry_stride, drive_stride, drive_last_stride                                           \
    }

#if !HOST
extern "C" __global__ void __launch_bounds__(THREADS) rollout(PARAMETERS) {
    Problem problem = PROBLEM;
    int thread = blockIdx.x * THREADS + threadIdx.x, index = thread / LANES;
    Lanes lanes = {(int)threadIdx.x % LANES, index >= environments};
    roll(problem, lanes.idle ? environments - 1 : index, lanes);
}
#endif
"""
