// The contacts of a body with the ground; formulas of `physics/impulse_solver.py`.
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
#if SURFACE
    Real total = Real(0);
    EACH_CONTACT(list, first, count) total += weights[i];
    total = own.lanes.sum(total);
    EACH_CONTACT(list, first, count) surface(list[i], env.laws[0], motion, env.bodies[a].position, weights[i], total);
#endif
}
