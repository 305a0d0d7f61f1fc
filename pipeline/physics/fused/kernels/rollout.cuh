// An environment from its first frame to its last, what is written of it, and the entry of the kernel.
// One step: the bodies' velocities without contact, contacts and their impulses, then the motion to the end of the step.
INLINE void step(const Problem& problem, Environment& env, Own& own, Real time_after) {
    const Lanes& lanes = own.lanes;
    ROOM(Mat, rotations, BODIES, env.room);
    ROOM(Motion, motions, BODIES, env.room);
    ROOM(Vec, starts, FREES, env.room);
    ROOM(Vec, velocities, FREES, env.room);
    ROOM(Vec, spins, FREES, env.room);
    EACH_BODY
    DIVIDED(lanes, b, BODIES) {
        const Body& body = env.bodies[b];
        rotations[b] = matrix(body.quat);
        Vec velocity = body.velocity, start = body.spin, spin = body.spin;
        motions[b].omega = body.spin;
#if !SHARED
        motions[b].inverse_mass = Real(0);
        motions[b].inverse_inertia = no_inertia();
#endif
#if LINKS && !SHARED
        motions[b].columns = 0;
        motions[b].depth = 0;
#endif
        if (is_free(b)) {
            const Weight& c = weight(env, b);
            start = c.inverse_inertia * transposed(rotations[b], body.spin);
            motions[b].omega = rotations[b] * start;
            velocity = body.velocity + env.laws[0].step_s * env.gravity;
#if EFFECTS
            apply(problem, env, lanes, b, rotations[b], motions[b].omega, velocity, spin);
            motions[b].omega = rotations[b] * (c.inverse_inertia * transposed(rotations[b], spin));
#endif
#if SHARED
            env.chain.free_masses[FREE(b)] = c.inverse_mass;
            env.chain.free_inertias[FREE(b)] = turned(rotations[b], c.inverse_inertia);
#else
            motions[b].inverse_mass = c.inverse_mass;
#endif
#if PAIRED && !SHARED
            motions[b].inverse_inertia = turned(rotations[b], c.inverse_inertia);
#endif
        }
        motions[b].velocity = velocity;
        if (SHARED && !is_free(b)) continue;
        velocities[FREE(b)] = velocity;
        starts[FREE(b)] = start;
        spins[FREE(b)] = spin;
    }
    lanes.sync();
#if LINKS
    kick(problem, env, lanes, time_after, rotations, motions);
#endif
#if PAIRS || LINKS
    collide(problem, env, own, rotations, motions, velocities, spins);
#endif
    lanes.sync();
    EACH_BODY
    DIVIDED(lanes, b, BODIES) {
        if (is_free(b)) {
            int f = FREE(b);
            advance(env.bodies[b], weight(env, b), starts[f], velocities[f], spins[f], env.laws[0].step_s);
        }
#if DRIVEN
        if (drive_number(b) >= 0 && body_link(b) < 0) drive(problem, env, b, time_after);
#endif
    }
#if LINKS
    settle(problem, env, lanes, time_after);
#endif
}

INLINE void write_vector(const Problem& problem, Place at, Vec v) {
    write_row(problem.frames + at, plain(v.x), plain(v.y), plain(v.z), Number(0));
#if DUAL
    write_row(problem.frame_tangents + at, v.x.tangent, v.y.tangent, v.z.tangent, Number(0));
#endif
}

// Writes position, quaternion, velocity (of the body frame's origin) and angular velocity (body frame).
INLINE void write_frame(const Problem& problem, const Environment& env, const Lanes& lanes, int frame) {
    if ((!SHARED && lanes.lane != 0) || lanes.idle) return;
    EACH_BODY
    DIVIDED(lanes, b, BODIES) {
        const Body& body = env.bodies[b];
        const Constants& c = env.constants[b];
        Mat R = matrix(body.quat);
        Vec position = body.position, velocity = body.velocity, omega = transposed(R, body.spin);
        if (is_free(b)) {
            omega = weight(env, b).inverse_inertia * omega;
            Vec arm = R * c.com;
            position = position - arm;
            velocity = velocity - cross(R * omega, arm);
        }
        Place at = FRAME_WIDTH * ((env.index * problem.frame_count + frame) * BODIES + b);
        Quat q = body.quat;
        write_vector(problem, at, position);
#if GATHERED
        if (b == 0) problem.frames[at + 3] = Number(env.lost);  // a place that is not used otherwise
#endif
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
    Number* to = problem.labels + LABEL_WIDTH * ((env.index * problem.frame_count + frame) * CONTACTS + contact);
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

// Writes the impulse of each contact since the last frame and its present geometry, and resets the sums.
INLINE void write_labels(const Problem& problem, Environment& env, Own& own, int frame) {
    if (own.lanes.idle) return;
#if GATHERED
    Mat* const rotations = env.room.rotations;
    DIVIDED(own.lanes, b, BODIES) rotations[b] = matrix(env.bodies[b].quat);
    own.lanes.sync();
    KEEP_LOOP
    for (int p = own.lanes.lane / WARP; p < PAIRS; p += LANES / WARP) {
#else
    Mat rotations[BODIES];
    EACH_BODY
    for (int b = 0; b < BODIES; b++) rotations[b] = matrix(env.bodies[b].quat);
    EACH_PAIR
    for (int p = 0; p < PAIRS; p++) {
#endif
        int start = contact_start(p), a = pair_a(p);
#if !QUEUED && !GATHERED
        int behind = (own.lanes.lane - start % LANES + LANES) % LANES;
#endif
#if FIXED
        Searched searched;
        searched.sphere = -1;
#endif
#if PAIRED
#if GATHERED
        Parting& parting = env.chain.room.collide.partings[own.lanes.lane / WARP];
        if (pair_b(p) >= 0) part_by_warp(problem, env, lane_of_warp(own.lanes), p, rotations, Number(1e30), parting);
#else
        Parting parting;
#endif
#if HULLS && !GATHERED
        if (pair_b(p) >= 0) part(problem, env, p, rotations, Number(1e30), parting);
#endif
#endif
#if GATHERED
        KEEP_LOOP
        for (int k = lane_of_warp(own.lanes); k < contact_count(p); k += WARP) {
#else
        EACH_SLOT
        for (int s = 0; s < SLOTS; s++) {
#endif
#if QUEUED
            int k = owned(own.lanes, start / LANES + s) - start;
            if (k < 0) continue;
#elif !GATHERED
            int k = behind + s * LANES;
#endif
            if (k >= contact_count(p)) continue;
            Vec normal = vec(Real(0), Real(0), Real(1)), point;
            Real gap;
#if DEEP
            bool empty = false;  // whether nothing meets in this slot
#endif
#if PAIRED
            if (pair_b(p) >= 0) {
                Facing facing;
                if (face(problem, env, p, k, rotations, Number(1e30), parting, nullptr, facing)) {
                    gap = facing.gap;
                    normal = facing.normal;
                    point = facing.point;
                } else {
#if DEEP
                    empty = true;
#endif
                    gap = Real(Number(FAR_M));
                    point = none();
#if TURNED
                    normal = env.turn * normal;
#endif
                }
            } else
#endif
#if FIXED
            if (pair_b(p) < -1) {
                Vec center;
                Real radius;
                Meeting meeting;
                const Mat& turn = rotations[a];
                Fixed fixed = fixed_surface(problem, env, -2 - pair_b(p));
                if (meet(problem, env, fixed, p, k, turn, nullptr, searched, center, radius, meeting)) {
                    gap = meeting.distance - radius;
                    normal = meeting.outward;
                    point = center - radius * normal;
                } else {
                    gap = Real(Number(FAR_M));
                    point = none();
#if TURNED
                    normal = env.turn * normal;
#endif
                }
            } else
#endif
            {
                long long row = env.geometry + 4LL * problem.spheres[start + k];
                Real radius = problem.geometry.at(row + 3);
                Vec arm = rotations[a] * (problem.geometry.vector(row) - env.constants[a].com);
                point = env.bodies[a].position + arm - vec(Real(0), Real(0), radius);
                gap = point.z - env.ground;
            }
#if GATHERED
            Tally tally = tally_of(problem, env, frame, start + k);
#elif PAIRED
            Tally& tally = own.tallies[(start + k) / LANES];
#else
            Tally& tally = own.tallies[s];
#endif
#if PAIRED
            // at the frame, the slot may have another contact than that which acted
            Vec facing = vec(Real(tally.facing[0]), Real(tally.facing[1]), Real(tally.facing[2]));
            facing = Real(Number(1) / greater(size(facing), Number(1e-30))) * facing;
            Number pushed = tally.impulse[0] * plain(normal.x) + tally.impulse[1] * plain(normal.y) +
                            tally.impulse[2] * plain(normal.z);
            bool turned = tally.weight > Number(0) && pushed < Number(0);
            if (turned) normal = facing;
#endif
#if DEEP
#if MESHES
            empty = empty || (pair_b(p) < -1 && surface_kind(-2 - pair_b(p)) == MESH_KIND);
#endif
            if (empty && tally.weight > Number(0)) {
                normal = facing;
                gap = Real(tally.depth / tally.weight);
            }
#endif
            write_label(problem, env, frame, start + k, tally, normal, plain(gap), point);
        }
#if GATHERED
        __syncwarp(FULL);  // before the next pair overwrites how these two part
#endif
    }
#if GATHERED
    own.lanes.sync();
#endif
}

#if GATHERED
// Sets the sums until a frame to zero.
INLINE void clear_labels(const Problem& problem, const Environment& env, Own& own, int frame) {
    own.frame = frame;
    const Tally zero = {};
    DIVIDED(own.lanes, contact, CONTACTS) {
        if (frame < problem.frame_count) tally_of(problem, env, frame, contact) = zero;
    }
    own.lanes.sync();
}
#endif
#endif

INLINE void write(const Problem& problem, Environment& env, Own& own, int frame) {
    write_frame(problem, env, own.lanes, frame);
#if RECORD
    write_labels(problem, env, own, frame);
#if GATHERED
    clear_labels(problem, env, own, frame + 1);
#endif
#endif
}

// Simulates one environment; called by all of its lanes.
INLINE void roll(const Problem& problem, Place index, Lanes lanes, Environment& env) {
#if SHARED
    Own own;
#else
    Own& own = env.own;
#endif
    own.lanes = lanes;
    // all lanes write the same numbers
    env.index = index;
    env.steps = index * problem.steps_stride;
    env.geometry = index * problem.geometry_stride;
    env.surfaces = index * problem.surface_stride;
    env.drives = index * problem.drive_stride;
#if !WIDE  // joints have commands, too, where no body is driven
    env.drive_last = index * problem.drive_last_stride;
#endif
    lanes.sync();
    load(problem, env, own);
#if CARRIED
    resume(problem, env, own);
#endif
#if DRIVEN
    for (int b = 0; b < BODIES; b++) {
        if (drive_number(b) >= 0 && lanes.writes()) drive(problem, env, b, problem.steps.at(env.steps + 3));
    }
    lanes.sync();
#endif
#if LINKS
    spread(env, lanes);
#endif
#if RECORD && GATHERED
    clear_labels(problem, env, own, 0);
#elif RECORD
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        Tally zero = {};
        own.tallies[i] = zero;
    }
#endif
    write(problem, env, own, 0);
    KEEP_LOOP
    for (int frame = 1; frame < problem.frame_count; frame++) {
        Place row = env.steps + (long long)STEP_WIDTH * (frame - 1);
        Real step_s = problem.steps.at(row), inverse_step = reciprocal(step_s);
        EACH_LAW
        for (int l = 0; l < LAWS; l++) {
            if (!lanes.writes()) continue;
            Law& law = env.laws[l];
            law.step_s = step_s;
            law.inverse_step = inverse_step;
            law.stiffness = problem.steps.at(row + (l ? 2 + 2 * l : 1));
            law.damping = problem.steps.at(row + (l ? 3 + 2 * l : 2));
        }
#if SURFACE
        Surface& surface = env.laws[0].surface;
        damp(surface, step_s, Real(0), surface.stiffness, surface.damping);
#endif
        lanes.sync();
        Real start = problem.steps.at(row + 3);
        int substeps = problem.substeps[frame - 1];
        KEEP_LOOP
        for (int s = 1; s <= substeps; s++) step(problem, env, own, start + Number(s) * step_s);
        write(problem, env, own, frame);
    }
#if CARRIED
    suspend(problem, env, own);
#endif
}

#define PARAMETERS                                                                                                   \
    const Stored *table, const Stored *table_t, const Stored *steps, const Stored *steps_t, const Stored *geometry,  \
        const Stored *geometry_t, const Stored *surfaces, const Stored *surfaces_t, const Stored *drives,            \
        const Stored *drives_t, const int *substeps, const int *spheres, const int *drive_starts,                    \
        const int *drive_last, const Stored *mesh_numbers, const int *mesh_indices, Stored *frames,                  \
        Stored *frame_tangents, Stored *labels, Stored *carried, int environments, int frame_count, int sweeps,      \
        int steps_stride, int geometry_stride, int surface_stride, int drive_stride, int drive_last_stride
#define PROBLEM                                                                                                      \
    {                                                                                                                \
        {table, table_t}, {steps, steps_t}, {geometry, geometry_t}, {surfaces, surfaces_t}, {drives, drives_t},      \
            substeps, spheres, drive_starts, drive_last, mesh_numbers, mesh_indices, frames, frame_tangents, labels, \
            carried, environments, frame_count, sweeps, steps_stride, geometry_stride, drive_stride,                 \
            drive_last_stride, surface_stride                                                                        \
    }

#if !HOST
extern "C" __global__ void __launch_bounds__(THREADS) rollout(PARAMETERS) {
#if GATHERED
    extern __shared__ __align__(16) unsigned char memory[];  // of the size that the launch asks for
    Environment& env = *reinterpret_cast<Environment*>(memory);
    copy_lists();
#elif SHARED
    __shared__ Environment copies[THREADS / LANES];
    Environment& env = copies[threadIdx.x / LANES];
    copy_lists();
#else
    Environment env;
#endif
    Problem problem = PROBLEM;
    int thread = blockIdx.x * THREADS + threadIdx.x, index = thread / LANES;
    Lanes lanes = {(int)threadIdx.x % LANES, index >= environments};
    roll(problem, lanes.idle ? environments - 1 : index, lanes, env);
}
#endif
