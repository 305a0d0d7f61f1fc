// How the contacts of a pair of bodies share the effective mass; formulas of `physics/impulse_solver.py`.
#if PAIRED
INLINE Vec relative_velocity(const Contact& c, const Motion* bodies) {
    Vec velocity = bodies[c.a].velocity + cross(bodies[c.a].omega, c.arm);
    if (c.b >= 0) velocity = velocity - bodies[c.b].velocity - cross(bodies[c.b].omega, c.arm_b);
    return velocity;
}

#if SHARED
// Both bodies of a contact in one number.
INLINE int bodies_of(const Contact& c) { return c.a << 16 | (c.b & 0xffff); }
#endif

// What a contact with a unit impulse along its normal does to both bodies: velocity of a relative to b, and rotations.
INLINE void unit_response(const Contact& c, Responses bodies, Vec& normal, Vec& turn_a, Vec& turn_b) {
#if LINKS
    Vec other = none();
    response_of(response(bodies, c.a), c.normal, cross(c.arm, c.normal), normal, turn_a);
    if (c.b >= 0) response_of(response(bodies, c.b), c.normal, cross(c.arm_b, c.normal), other, turn_b);
    normal = normal + other;
#else
    normal = c.normal;
    turn_a = bodies[c.a].inverse_inertia * cross(c.arm, normal);
    if (c.b >= 0) turn_b = bodies[c.b].inverse_inertia * cross(c.arm_b, normal);
#endif
}

#if !SHARED
// Distributes the effective mass among the touching contacts of a pair: those from `first` on in every lane's list.
__device__ void share_out_pair(const Lanes& lanes, Contact* list, const Real* weights, int first, int end,
                               const Motion* bodies) {
    Real totals[SLOTS];
    for (int i = first; i < end; i++) totals[i] = Real(0);
    for (int source = 0; source < LANES; source++) {
        int theirs = lanes.from(end - first, source);
        for (int j = 0; lanes.any(j < theirs); j++) {
            Vec normal = none(), turn_a = none(), turn_b = none();
            Real weight = Real(0);
            if (source == lanes.lane && j < theirs) {
                const Contact& c = list[first + j];
                unit_response(c, bodies, normal, turn_a, turn_b);
                weight = weights[first + j] * c.stop_n;
            }
            normal = lanes.from(normal, source);
            turn_a = lanes.from(turn_a, source);
            turn_b = lanes.from(turn_b, source);
            weight = lanes.from(weight, source);
            for (int i = first; i < end; i++) {
                const Contact& c = list[i];
#if LINKS
                Real mass = Real(1);
#else
                Real mass = bodies[c.a].inverse_mass;
                if (c.b >= 0) mass += bodies[c.b].inverse_mass;
#endif
                Real along = mass * dot(c.normal, normal) + dot(cross(c.arm, c.normal), turn_a);
                if (c.b >= 0) along += dot(cross(c.arm_b, c.normal), turn_b);
                totals[i] += weight * along * along;
            }
        }
    }
    for (int i = first; i < end; i++) share_out(list[i], list[i].stop_n * totals[i], weights[i]);
}
#elif !GATHERED
// The same; contacts may be of several pairs of bodies. In each round every lane shows one contact.
__device__ void share_out_pair(const Lanes& lanes, Chain& chain, Contact* list, const Real* weights, int first, int end,
                               const Motion*) {
    ContactRoom& room = chain.room.collide.contacts;
    Real totals[LIST_ROOM];
    INNER for (int i = first; i < end; i++) totals[i] = Real(0);
    KEEP_LOOP
    for (int j = first; lanes.any(j < end); j++) {
        room.bodies[lanes.lane] = -1;
        if (j < end) {
            const Contact& c = list[j];
            Vec normal = none(), turn_a = none(), turn_b = none();
            unit_response(c, chain, normal, turn_a, turn_b);
            room.first[lanes.lane] = normal;
            room.second[lanes.lane] = turn_a;
            room.third[lanes.lane] = turn_b;
            room.weight[lanes.lane] = weights[j] * c.stop_n;
            room.bodies[lanes.lane] = bodies_of(c);
        }
        lanes.sync();
        KEEP_LOOP
        for (int shown = 0; shown < LANES; shown++) {
            if (room.bodies[shown] < 0) continue;
            KEEP_LOOP
            for (int i = first; i < end; i++) {
                const Contact& c = list[i];
                if (bodies_of(c) != room.bodies[shown]) continue;
                Real along = dot(c.normal, room.first[shown]) + dot(cross(c.arm, c.normal), room.second[shown]);
                if (c.b >= 0) along += dot(cross(c.arm_b, c.normal), room.third[shown]);
                totals[i] += room.weight[shown] * along * along;
            }
        }
        lanes.sync();
    }
    INNER for (int i = first; i < end; i++) share_out(list[i], list[i].stop_n * totals[i], weights[i]);
}
#endif
#endif
