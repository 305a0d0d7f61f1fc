// Contacts of lanes that share an environment: slots that may have one wait until those of all pairs are known, and are then
// shared out evenly.
#if PAIRED && QUEUED
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
#endif
