// What an environment consists of, read from the kernel's inputs, and the motion of driven bodies.
// What the kernel is given; units are m, kg, s and rad. `Packed` in `packing.py` says more.
struct Problem {
    Input table;     // (environments, TABLE_WIDTH): numbers of each environment, in the order in which `load` reads
    Input steps;     // (1 or environments, intervals, STEP_WIDTH): step, stiffness and damping (without unit; of the
                     // paper's law with), time at the start; then stiffness and damping of each further law
    Input geometry;  // (1 or environments, spheres, 4): centres in the body frame, radii
    Input surfaces;  // (1 or environments, FIXED, SURFACE_WIDTH): position, quaternion, size
    Input drives;    // (1 or environments, samples, SAMPLE_WIDTH): time, position, quaternion, velocity, angular velocity
    const int* __restrict__ substeps;      // of each interval
    const int* __restrict__ spheres;       // of each contact: row of the geometry
    const int* __restrict__ drive_starts;  // of each driven body: row of its first sample
    const int* __restrict__ drive_last;    // (1 or environments, driven bodies): index of the last interval
    const Stored* __restrict__ mesh_numbers;  // of each mesh, see `TriangleMesh`
    const int* __restrict__ mesh_indices;
    Stored* __restrict__ frames;           // (environments, frames, bodies, FRAME_WIDTH)
    Stored* __restrict__ frame_tangents;
    Stored* __restrict__ labels;           // (environments, frames, contacts, LABEL_WIDTH)
    Stored* carried;                       // (environments, LANES, CARRIED_WIDTH): see `resume`
    int environments, frame_count, sweeps;
    long long steps_stride, geometry_stride, drive_stride;
    int drive_last_stride;
    long long surface_stride;
};

struct Body {
    Vec position;  // of the centre of mass; of the frame's origin where the body is not free
    Quat quat;
    Vec velocity, spin;  // spin: angular momentum; angular velocity where the body is not free
};

// Accelerations of the free bodies in flight: a = -(c + k |u|) u + (s omega + q) x u + f - A exp(-height / l) n
// with u = v - wind and the height of the lowest sphere, summed over the magnets, and alpha = twist - d omega.
struct Wrenches {
    Real linear_drag, quadratic_drag, magnus, spin_damping;
    Vec acceleration, wind;
#if TWISTED
    Vec twist;
#endif
#if LIFTED
    Vec lift;  // q
#endif
#if MAGNETS
    Real magnets[MAGNETS], magnet_ranges[MAGNETS];
#endif
};

// Acceleration by drag and lift at a velocity u in the air; the tiny number keeps the derivative finite at rest.
INLINE Vec blown(const Wrenches& w, Vec omega, Vec u) {
    Real drag = w.linear_drag + w.quadratic_drag * root(dot(u, u) + Real(Number(1e-24)));
    Vec turning = w.magnus * omega;
#if LIFTED
    turning = turning + w.lift;
#endif
    return cross(turning, u) - drag * u;
}

struct Weight {
    Real inverse_mass;
    Sym inverse_inertia;  // body axes
};

#if SHARED
struct Constants {
#else
struct Constants : Weight {
#endif
    Vec com;              // in the body frame
    Number reach;         // of its spheres from the centre of mass
#if PAIRED
    Number low[3], high[3];  // box of its spheres, in the body frame
#endif
};

struct Tally {  // sums over the contacts since the last frame
    Number impulse[3], weighted[3], weight, sliding;
#if PAIRED
    Number facing[3];  // normal, weighted by the impulse along it
#endif
#if DEEP
    Number depth;  // gap, weighted likewise
#endif
};

struct Own {  // what each lane of an environment keeps for itself
    Lanes lanes;
#if HELD
    Vec arms[SLOTS];  // of this lane's spheres, from the centre of mass, body axes
    Real radii[SLOTS];
#endif
#if GATHERED
    int frame;  // the next one
#else
    // impulses of this lane's contacts in the previous step: ground contacts in the kernel's frame, others along
    // normal and tangents
    Vec before[SLOTS];
    bool warm;  // whether any of them is not zero
#if PAIRED
    int kept[SLOTS], kept_count;  // the slots that may not be zero
#endif
#if RECORD
    Tally tallies[SLOTS];
#endif
#endif
};

#if SHARED
// Where the lanes of an environment work together within a step.
struct StepRoom {
    Mat rotations[BODIES];
    Motion motions[BODIES];
    Vec starts[FREES], velocities[FREES], spins[FREES];
};
#endif

#if PUBLISHED
struct Published {  // numbers of the paper's law that its contacts have in common; 0 for none
    Number softplus_per_n, sharpness_per_m, clamp_depth_m, clamp_per_m, zero_m;
};
#endif

struct Common {  // what the lanes of an environment have in common
    Place index, geometry, steps, drives, surfaces;
    int drive_last;
    Vec gravity;
    Real ground;
    Law laws[LAWS];
#if PUBLISHED
    Published published;
#endif
#if EFFECTS
    Wrenches wrenches;
#endif
#if TURNED
    Mat turn;  // from the world's frame, in which tangents are chosen, into the kernel's
#endif
    Body bodies[BODIES];
    Constants constants[BODIES];
#if SHARED
    Weight weights[FREES];
#endif
#if DRIVEN
    int cursors[BODIES];
#endif
#if LINKS
    Chain chain;
#endif
#if HULLS
    Number parted[PAIR_ROOM][3];  // of each pair, an axis that parted its hulls in an earlier step; zero for none
#endif
#if GATHERED
    // numbers of the contacts of the previous step, increasing, and their impulses: those of the ground in the kernel's frame,
    // others along normal and tangents
    int kept_slots[CROWD], kept_count;
    Vec kept[CROWD];
    int lost;  // contacts until now for which there was no room
#endif
#if SHARED
    StepRoom room;
#endif
};

#if SHARED
typedef Common Environment;
static_assert(sizeof(Environment) <= SHARED_BYTES, "shared_bytes of structure.py counts less than there is");
#else
struct Environment : Common {  // one object, as the compiler allots registers by the order of what is in it
    Own own;
};
#endif

// Inverse mass and inertia of a free body.
#if SHARED
INLINE const Weight& weight(const Environment& env, int b) { return env.weights[FREE(b)]; }
#else
INLINE const Weight& weight(const Environment& env, int b) { return env.constants[b]; }
#endif

// Reads the numbers of an environment at the start.
INLINE void load(const Problem& problem, Environment& env, Own& own) {
    const Input& table = problem.table;
    Place at = env.index * TABLE_WIDTH;
    env.gravity = table.vector(at);
    env.ground = table.at(at + 3);
    at += 4;
    EACH_LAW
    for (int l = 0; l < LAWS; l++) env.laws[l].friction = table.at(at++);
#if TURNED
    Quat turn = {table.at(at), table.at(at + 1), table.at(at + 2), table.at(at + 3)};
    env.turn = matrix(turn);
    at += 4;
#endif
#if PUBLISHED
    Number* const numbers = &env.published.softplus_per_n;
    for (int i = 0; i < PUBLISHED_COLUMNS; i++) numbers[i] = plain(table.at(at++));
#endif
#if EFFECTS
    Wrenches& w = env.wrenches;
    w.linear_drag = table.at(at);
    w.quadratic_drag = table.at(at + 1);
    w.magnus = table.at(at + 2);
    w.spin_damping = table.at(at + 3);
    w.acceleration = table.vector(at + 4);
    w.wind = table.vector(at + 7);
    at += 10;
#if TWISTED
    w.twist = table.vector(at);
    at += 3;
#endif
#if LIFTED
    w.lift = table.vector(at);
    at += 3;
#endif
#if MAGNETS
    for (int i = 0; i < MAGNETS; i++, at += 2) {
        w.magnets[i] = table.at(at);
        w.magnet_ranges[i] = table.at(at + 1);
    }
#endif
#endif
#if SURFACE
    Surface& s = env.laws[0].surface;
    s.stribeck = table.at(at);
    s.slow_speed = table.at(at + 1);
    s.even = table.at(at + 2);
    s.mixed = table.at(at + 3);
    for (int i = 0; i < 9; i++) s.spots[i] = table.at(at + 4 + i);
    s.spot_m = table.at(at + 13);
    s.viscous = table.at(at + 14);
    s.rolling = table.at(at + 15);
    s.torsion = table.at(at + 16);
    s.restitution = table.at(at + 17);
    s.time = table.at(at + 18);
    s.ratio = table.at(at + 19);
    s.adhesion = table.at(at + 20);
    s.reach = table.at(at + 21);
    s.spotted = false;
    for (int i = 0; i < 9; i++) s.spotted = s.spotted || !absent(s.spots[i]);
    s.twisting = !absent(s.rolling) || !absent(s.torsion);
    at += 22;
#endif
#if LINKS
    at = load_chain(table, at, own.lanes, env.chain);
#endif
    const Place bodies = at;
    EACH_BODY
    DIVIDED(own.lanes, b, BODIES) {
        Body& body = env.bodies[b];
        Constants& c = env.constants[b];
        at = bodies + BODY_COLUMNS * b;
        Sym inertia = {table.at(at + 1), table.at(at + 2), table.at(at + 3),
                       table.at(at + 4), table.at(at + 5), table.at(at + 6)};
#if SHARED
        if (is_free(b)) {
            env.weights[FREE(b)].inverse_mass = table.at(at);
            env.weights[FREE(b)].inverse_inertia = inertia;
        }
#else
        c.inverse_mass = table.at(at);
        c.inverse_inertia = inertia;
#endif
        c.com = table.vector(at + 7);
        body.position = table.vector(at + 10);
        Quat quat = {table.at(at + 13), table.at(at + 14), table.at(at + 15), table.at(at + 16)};
        body.quat = quat;
        body.velocity = table.vector(at + 17);
        body.spin = table.vector(at + 20);
        c.reach = Number(0);
#if PAIRED
        for (int k = 0; k < 3; k++) {
            c.low[k] = Number(1e30);
            c.high[k] = Number(-1e30);
        }
#endif
        Place row = env.geometry + 4LL * sphere_start(b);
        for (int i = 0; i < sphere_count(b); i++, row += 4) {
            const Number sphere[4] = {plain(problem.geometry.at(row)), plain(problem.geometry.at(row + 1)),
                                      plain(problem.geometry.at(row + 2)), plain(problem.geometry.at(row + 3))};
            Number x = sphere[0] - plain(c.com.x), y = sphere[1] - plain(c.com.y), z = sphere[2] - plain(c.com.z);
            c.reach = greater(c.reach, root(x * x + y * y + z * z) + sphere[3]);
#if PAIRED
            for (int k = 0; k < 3; k++) {
                c.low[k] = lesser(c.low[k], sphere[k] - sphere[3]);
                c.high[k] = greater(c.high[k], sphere[k] + sphere[3]);
            }
#endif
        }
#if DRIVEN
        env.cursors[b] = 0;
#endif
    }
#if GATHERED
    if (own.lanes.writes()) env.kept_count = env.lost = 0;
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) own.before[i] = none();
    own.warm = false;
#if PAIRED
    own.kept_count = 0;
#endif
#endif
#if HULLS
    DIVIDED(own.lanes, p, PAIRS) {
        for (int k = 0; k < 3; k++) env.parted[p][k] = Number(0);
    }
#endif
    own.lanes.sync();
#if HELD
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        int contact = i * LANES + own.lanes.lane;
        Place row = env.geometry + 4LL * (contact < CONTACTS ? problem.spheres[contact] : 0);
        own.arms[i] = problem.geometry.vector(row) - env.constants[0].com;
        own.radii[i] = problem.geometry.at(row + 3);
    }
#endif
}

#if CARRIED
// Restores the state at the end of the last launch, if there was one since the last reset: position, orientation,
// velocity and spin of each body, the impulses of this lane's contacts, whether any is not zero, and values, speeds and
// impulses of the joints. There is a row of every lane, so that launches need no synchronisation; where contacts are in
// one list, one row of all lanes with their number, and of each its number and impulse.
#define CARRIED_ROW(env, own) (GATHERED ? (env).index : (env).index * LANES + (own).lanes.lane)
INLINE void resume(const Problem& problem, Environment& env, Own& own) {
    const Number* row = problem.carried + CARRIED_ROW(env, own) * CARRIED_WIDTH;
    if (*row++ == Number(0)) return;
    EACH_BODY
    for (int b = 0; b < BODIES; b++, row += MOTION_COLUMNS) {
        if (!own.lanes.writes()) continue;
        Body& body = env.bodies[b];
        body.position = vec(row[0], row[1], row[2]);
        Quat quat = {row[3], row[4], row[5], row[6]};
        body.quat = quat;
        body.velocity = vec(row[7], row[8], row[9]);
        body.spin = vec(row[10], row[11], row[12]);
    }
#if GATHERED
    const int count = (int)*row++;
    DIVIDED(own.lanes, i, count) {
        env.kept_slots[i] = (int)row[4 * i];
        env.kept[i] = vec(row[4 * i + 1], row[4 * i + 2], row[4 * i + 3]);
    }
    if (own.lanes.writes()) env.kept_count = count;
    row += 4 * CROWD;
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) own.before[i] = vec(row[3 * i], row[3 * i + 1], row[3 * i + 2]);
    row += 3 * SLOTS;
    own.warm = *row++ > Number(0);
#if PAIRED
    for (int i = 0; i < SLOTS; i++) own.kept[i] = i;
    own.kept_count = SLOTS;
#endif
#endif
#if LINKS
    for (int j = 0; j < JOINTS && own.lanes.writes(); j++, row += 5) {
        env.chain.values[j] = row[0];
        env.chain.speeds[j] = row[1];
        for (int k = 0; k < 3; k++) env.chain.impulses[3 * j + k] = row[2 + k];
    }
#endif
    own.lanes.sync();
}

// Stores the state that `resume` reads in the next launch.
INLINE void suspend(const Problem& problem, const Environment& env, const Own& own) {
    if (own.lanes.idle || (GATHERED && own.lanes.lane != 0)) return;
    Number* row = problem.carried + CARRIED_ROW(env, own) * CARRIED_WIDTH;
    *row++ = Number(1);
    EACH_BODY
    for (int b = 0; b < BODIES; b++, row += MOTION_COLUMNS) {
        const Body& body = env.bodies[b];
        Number numbers[MOTION_COLUMNS] = {body.position.x, body.position.y, body.position.z, body.quat.w, body.quat.x,
                              body.quat.y, body.quat.z, body.velocity.x, body.velocity.y, body.velocity.z,
                              body.spin.x, body.spin.y, body.spin.z};
        for (int k = 0; k < MOTION_COLUMNS; k++) row[k] = numbers[k];
    }
#if GATHERED
    *row++ = Number(env.kept_count);
    for (int i = 0; i < env.kept_count; i++) {
        row[4 * i] = Number(env.kept_slots[i]);
        row[4 * i + 1] = env.kept[i].x;
        row[4 * i + 2] = env.kept[i].y;
        row[4 * i + 3] = env.kept[i].z;
    }
    row += 4 * CROWD;
#else
    EACH_SLOT
    for (int i = 0; i < SLOTS; i++) {
        row[3 * i] = own.before[i].x;
        row[3 * i + 1] = own.before[i].y;
        row[3 * i + 2] = own.before[i].z;
    }
    row += 3 * SLOTS;
    *row++ = own.warm ? Number(1) : Number(0);
#endif
#if LINKS
    for (int j = 0; j < JOINTS; j++, row += 5) {
        row[0] = env.chain.values[j];
        row[1] = env.chain.speeds[j];
        for (int k = 0; k < 3; k++) row[2 + k] = env.chain.impulses[3 * j + k];
    }
#endif
}
#endif

#if DRIVEN
// The commanded motion of a driven body; times must not decrease from call to call.
__device__ void drive(const Problem& problem, Environment& env, int b, Real time) {
    int number = drive_number(b), last = problem.drive_last[env.drive_last + number];
    long long start = env.drives + SAMPLE_WIDTH * problem.drive_starts[number];
    const Input& rows = problem.drives;
    int& cursor = env.cursors[b];
    while (cursor < last && rows.value[start + SAMPLE_WIDTH * (cursor + 1)] <= plain(time)) cursor++;
    Real first = rows.at(start), final = rows.at(start + SAMPLE_WIDTH * (last + 1));
    bool moving = plain(time) >= plain(first) && plain(time) <= plain(final);
    long long at = start + SAMPLE_WIDTH * cursor;
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
