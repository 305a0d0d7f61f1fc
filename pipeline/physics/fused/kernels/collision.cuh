// All contacts of a step and their impulses, by projected Gauss-Seidel; formulas of `physics/impulse_solver.py`. Iteration
// -1 is the warm start, by the impulses of the previous step.
#if SHARED
// Finds the impulses of contacts and joints; bodies are those of all lanes.
INLINE void find_impulses(const Problem& problem, Environment& env, Own& own, Contact* list, const Contacts& found,
                          int sweep, Motion* motions, Vec* spins) {
    CollideRoom& room = env.chain.room.collide;
    list_reached(env, own.lanes);
    DIVIDED(own.lanes, r, room.reached_count) room.free[room.reached[r]] = motions[body_at(room.reached[r])];
    own.lanes.sync();
    do {
        sweep_contacts(env, own.lanes, list, found.count, motions, sweep >= 0);
        move_bodies(env, own.lanes, motions, spins, sweep >= 0, sweep + 1 >= problem.sweeps);
    } while (++sweep < problem.sweeps);
}
#elif LINKS
INLINE void find_impulses(const Problem& problem, Environment& env, Own& own, Contact* list, const Contacts& found,
                          int sweep, Motion* motions, Vec* spins) {
    Sums sums;
    begin(sums, motions);
    Reached reached;
    list_reached(env, reached);
    do {
        for (int i = 0; i < reached.body_count; i++) {
            sums.linear[reached.bodies[i]] = sums.angular[reached.bodies[i]] = none();
        }
        sweep_list(env, list, found.count, motions, sweep >= 0, sums);
        move_links(env, own.lanes, reached, sums, sweep >= 0, motions);
        move_free(own.lanes, false, sums, motions);
    } while (++sweep < problem.sweeps);
    turn_free(sums, spins);
}
#elif PAIRED
INLINE void find_impulses(const Problem& problem, Environment& env, Own& own, Contact* list, const Contacts& found,
                          int sweep, Motion* motions, Vec* spins) {
    Sums sums;
    begin(sums, motions);
    Loads loads;
    begin(loads, own.lanes, found);
    const int first = sweep;
    do {
        EACH_BODY
        for (int b = 0; b < BODIES; b++) sums.linear[b] = sums.angular[b] = none();
        if (found.loaded > 1 && sweep != first) aim_pairs(env, list, found, loads, motions);
        sweep_list(env, list, found.count, motions, sweep >= 0, sums);
        if (loads.count) sum_pairs(own.lanes, list, found, loads, sums);
        move_free(own.lanes, loads.count, sums, motions);
    } while (++sweep < problem.sweeps);
    turn_free(sums, spins);
}
#else
INLINE void find_impulses(const Problem& problem, Environment& env, Own& own, Contact* list, const Contacts& found,
                          int sweep, Motion* motions, Vec* spins) {
    Sums sums;
    begin(sums, motions);
#if SURFACE
    const Turning each = turning(own.lanes, list, found.count, motions[0]);
#else
    const Turning each = {Real(0), Real(0)};
#endif
    do {
        EACH_BODY
        for (int b = 0; b < BODIES; b++) sums.linear[b] = sums.angular[b] = none();
        sweep_body(env, list, found.count, motions[0], sweep >= 0, each, sums);
        move_free(own.lanes, false, sums, motions);
    } while (++sweep < problem.sweeps);
    turn_free(sums, spins);
}
#endif

#if RECORD && !QUEUED
// Adds the impulses of a step to the sums of labels.
INLINE void note_contacts(const Environment& env, Own& own, const Contact* list, int count) {
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
    Contacts found;
    if (!find_contacts(problem, env, own, rotations, motions, list, weights, found)) {
        forget(own);
#if LINKS
        if (!own.lanes.any(env.chain.active)) return;
#else
        return;
#endif
    }
    int sweep = own.lanes.any(own.warm) ? -1 : 0;
#if LINKS
    // a single iteration starts at zero
    if (problem.sweeps < 2) {
        DIVIDED(own.lanes, k, 3 * JOINTS) env.chain.impulses[k] = Real(0);
    }
    if (own.lanes.any(env.chain.active)) sweep = -1;
#endif
    find_impulses(problem, env, own, list, found, sweep, motions, spins);
#if QUEUED
    keep_shown(env, own, list, found.count, problem.sweeps);
#else
    keep(env, own, list, found.count, problem.sweeps);
#endif
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        if (is_free(b) && own.lanes.writes()) velocities[FREE(b)] = motions[b].velocity;
    }
    own.lanes.sync();
#if RECORD && !QUEUED
    note_contacts(env, own, list, found.count);
#endif
}
