// The contacts of a step: of all pairs of a world, or of its only body with the ground.
struct Contacts {  // how many there are in the list of a lane
    int count;
#if PAIRED && !LINKS
    int ends[PAIR_ROOM], loaded;  // where the contacts of each pair end in the list, and how many pairs touch
#endif
};

#if PAIRED
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

// Finds the contacts of a body with the ground in its pair; returns how many touch.
INLINE int touch_ground_pair(const Problem& problem, Environment& env, const Own& own, int p, const Mat* rotations,
                             Motion* motions, Contact* list, Real* weights, int& count) {
    const int a = pair_a(p);
    if (!own.lanes.any(near_ground(env, a, motions[a]))) return 0;
#if LINKS
    if (body_link(a) >= 0) return touch_plane_link(problem, env, own, p, rotations, motions, list, weights, count);
#endif
    const int first = count;
    const Moving& all = moving(RESPONSES(env, motions), motions, a);
    touch_plane(problem, env, own, p, rotations[a], all, list, weights, count);
    return count - first;
}

// Finds the contacts of a pair, but those that are queued; returns how many touch.
INLINE int touch(const Problem& problem, Environment& env, Own& own, int p, const Mat* rotations, Motion* motions,
                 Contact* list, Real* weights, int& count) {
    const int b = pair_b(p);
#if !QUEUED
    if (b >= 0) {
#if SHARED
        if (!own.lanes.any(env.chain.room.collide.near[p])) return 0;
#endif
        return touch_pair(problem, env, own, p, rotations, motions, list, weights, count);
    }
#endif
#if FIXED
    if (b < -1) return touch_surface(problem, env, own, p, rotations, motions, list, weights, count);
#endif
    return b == -1 ? touch_ground_pair(problem, env, own, p, rotations, motions, list, weights, count) : 0;
}

#if QUEUED
// Finds the contacts of the pairs of two bodies.
INLINE void touch_queued(const Problem& problem, Environment& env, Own& own, const Mat* rotations, Motion* motions,
                         Contact* list, Real* weights, int& count) {
    const CollideRoom& room = env.chain.room.collide;
    Candidates queue;
    queue.few = queue.many = 0;
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
}
#endif

#if SHARED
// Counts of each group of bodies the pairs that touch.
INLINE void count_pairs(const CollideRoom& room, const Lanes& lanes, int* groups) {
    lanes.sync();
    DIVIDED(lanes, p, PAIRS) {
        if (!room.touched[p]) continue;
        Lanes::count_up(groups[group_of(pair_a(p))]);
        if (pair_b(p) >= 0 && group_of(pair_b(p)) >= 0) Lanes::count_up(groups[group_of(pair_b(p))]);
    }
    lanes.sync();
}
#endif

// Finds the contacts of a step; returns whether there are any in the warp.
INLINE bool find_contacts(const Problem& problem, Environment& env, Own& own, const Mat* rotations, Motion* motions,
                          Contact* list, Real* weights, Contacts& found) {
    ROOM(int, groups, BODIES, env.chain.room.collide);
    DIVIDED(own.lanes, b, BODIES) groups[b] = 0;
    found.count = 0;
#if !LINKS
    found.loaded = 0;
#endif
#if SHARED
    find_near_pairs(problem, env, own.lanes, rotations, motions);
    reveal_links(env.chain, own.lanes, env.bodies);
#endif
    EACH_PAIR
    for (int p = 0; p < PAIRS; p++) {
        const int touching = touch(problem, env, own, p, rotations, motions, list, weights, found.count);
#if SHARED
        if (touching > 0) env.chain.room.collide.touched[p] = true;
#else
        if (own.lanes.any(touching > 0) && own.lanes.sum(Number(touching)) > Number(0)) {
            const int a = pair_a(p), b = pair_b(p);
            groups[group_of(a)]++;
            if (b >= 0 && group_of(b) >= 0) groups[group_of(b)]++;
#if !LINKS
            found.loaded++;  // `Load` has no share of the joints of chains
#endif
        }
#endif
#if !LINKS
        found.ends[p] = found.count;
#endif
    }
#if QUEUED
    touch_queued(problem, env, own, rotations, motions, list, weights, found.count);
#endif
#if SHARED
    count_pairs(env.chain.room.collide, own.lanes, groups);
#endif
    split(list, found.count, groups);
    return own.lanes.any(found.count > 0);
}
#else
INLINE bool find_contacts(const Problem& problem, Environment& env, Own& own, const Mat* rotations, Motion* motions,
                          Contact* list, Real* weights, Contacts& found) {
    found.count = 0;
    if (!own.lanes.any(near_ground(env, 0, motions[0]))) return false;
    motions[0].inverse_inertia = turned(rotations[0], env.constants[0].inverse_inertia);
    touch_plane(problem, env, own, 0, rotations[0], motions[0], list, weights, found.count);
    return own.lanes.any(found.count > 0);
}
#endif
