// All contacts of a step and their impulses, by projected Gauss-Seidel; formulas of `physics/impulse_solver.py`.
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

#if !GATHERED && !PUBLISHED
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
        if (every(plain(height) + plain(dot(rotation.z, held)) - plain(radius) > far)) continue;
#endif
        Flag touches = touch_ground(list[i], env.laws[pair_law(p)], motion, rotation * held, height, radius, weights[i]);
        if (some(touches)) {
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
#if WIDE
            list[i].on = touches;
#endif
            list[i].impulse = WHERE_ON(list[i], own.before[contact / LANES]);
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
#if SURFACE && PAIRED
    surfaces(own.lanes, env.laws[0], motion, list, weights, first, count);
#elif SURFACE
    Real total = Real(0);
    EACH_CONTACT(list, first, count) total += weights[i];
    total = own.lanes.sum(total);
    EACH_CONTACT(list, first, count) surface(list[i], env.laws[0], motion, env.bodies[a].position, weights[i], total);
#endif
}

#endif

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

#if !GATHERED && !PUBLISHED
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
#if SURFACE && !PAIRED
#if WIDE
    Real touching = Real(0);
    EACH_CONTACT(list, 0, count) touching += choose(list[i].on, Real(1), Real(0));
#else
    Real touching = Real(own.lanes.sum(Number(count)));
#endif
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
#if SURFACE
            if (env.laws[0].surface.twisting) {
                if (sweep >= 0) c.turning = turned_by(c, env.laws[0], motions[c.a]);
                angular[c.a] = angular[c.a] + c.turning;
            }
#endif
            if (c.b >= 0) {
                linear[c.b] = linear[c.b] - c.impulse;
                angular[c.b] = angular[c.b] - cross(c.arm_b, c.impulse);
            }
        }
#else
        EACH_CONTACT(list, 0, count) {
            Contact& c = list[i];
            Vec slip = motions[0].velocity + cross(motions[0].omega, c.arm);
            if (sweep >= 0) c.impulse = WHERE_ON(c, swept(c, env.laws[0], slip));
            linear[0] = linear[0] + c.impulse;
            angular[0] = angular[0] + cross(c.arm, c.impulse);
#if SURFACE
            if (env.laws[0].surface.twisting) {
                if (sweep >= 0) c.turning = WHERE_ON(c, turned_by(c, env.laws[0], motions[0], across, about));
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
#endif
