// Iterations over the impulses of contacts, what is kept of them for the next step, and what labels say of them.
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

#if GATHERED && RECORD
// The sums of a contact until a frame, in the row of its label, which is written at that frame.
INLINE Tally& tally_of(const Problem& problem, const Environment& env, int frame, int contact) {
    static_assert(sizeof(Tally) == LABEL_WIDTH * sizeof(Number), "a label has the room of a tally");
    const long long row = (env.index * problem.frame_count + frame) * CONTACTS + contact;
    return *reinterpret_cast<Tally*>(problem.labels + LABEL_WIDTH * row);
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
#if SURFACE
        sum.angular_a = sum.angular_a + c.turning;
#endif
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
        Real speed = dot(relative_velocity(c, motions) - own, c.normal);
#if SURFACE
        c.target = aim(law, c, speed);
#else
        c.target = aim(law, c.gap, speed);
#endif
    }
}
#endif

#if SHARED
#if !GATHERED
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
#endif

// The body of a place in the list of those that contacts may move.
INLINE int body_at(int place) { return place < LINKS ? link_body[place] : free_body(place - LINKS); }

#if !GATHERED
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

#endif

// Moves the bodies that contacts may move by their impulses; `joints`: after one pass over the joints. In the last
// iteration the moments are added to the angular momenta.
INLINE void move_bodies(Environment& env, const Lanes& lanes, Motion* motions, Vec* spins, bool joints, bool last) {
    Chain& chain = env.chain;
    const CollideRoom& room = chain.room.collide;
    push_chains(chain, lanes);
    if (joints && chain.active) sweep_joints(chain, lanes);
    lanes.sync();
#if GATHERED  // each number by one lane
    DIVIDED(lanes, part, 6 * room.reached_count) {
        const int place = room.reached[part / 6], k = part % 6, axis = k < 3 ? k : k - 3;
        const Velocities& free = room.free[place];
        Real sum = (&(k < 3 ? free.velocity : free.omega).x)[axis];
        if (place < LINKS) {
            const Column* columns = room.columns + column_start[place];
            EACH_ABOVE(i, link_depth[place]) {
                const Real moved = chain.moved[link_above[place * DEPTH + i]];
                sum = sum + moved * (&(k < 3 ? columns[i].linear : columns[i].turning).x)[axis];
            }
        } else {
            const int f = place - LINKS;
            const Vec gained = k < 3 ? chain.free_masses[f] * room.pushes[place] : chain.free_inertias[f] * room.moments[place];
            sum = sum + (&gained.x)[axis];
            if (last && k >= 3) (&spins[f].x)[axis] = (&spins[f].x)[axis] + (&room.moments[place].x)[axis];
        }
        Velocities& m = motions[body_at(place)];
        (&(k < 3 ? m.velocity : m.omega).x)[axis] = sum;
    }
#else
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
#endif
    lanes.sync();
}
#endif

#if !GATHERED
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
#endif
