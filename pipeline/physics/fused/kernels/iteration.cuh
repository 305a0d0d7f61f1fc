// Iterations over the impulses of the contacts of a step where each lane keeps all bodies, and what these do to them.
#if !SHARED
struct Sums {  // impulse and moment of the contacts of each body, and how it would move without them
    Vec linear[BODIES], angular[BODIES], velocities[BODIES], omegas[BODIES];
};

INLINE void begin(Sums& sums, const Motion* motions) {
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        sums.velocities[b] = motions[b].velocity;
        sums.omegas[b] = motions[b].omega;
    }
}

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
        c.target = aim(law, c.gap, dot(relative_velocity(c, motions) - own, c.normal));
    }
}

struct Loads {  // of the pairs that touch
    Pushed pushed[PAIR_ROOM];
    bool active[PAIR_ROOM];  // whether a lane of the warp has contacts of the pair
    bool count;              // whether any pair of the warp bears on another one; the whole warp takes part in sums
};

INLINE void begin(Loads& loads, const Lanes& lanes, const Contacts& found) {
    loads.count = lanes.any(found.loaded > 1);
    for (int p = 0, first = 0; p < PAIRS; first = found.ends[p++]) loads.active[p] = lanes.any(found.ends[p] > first);
}

// Aims the contacts of each pair at what they ask for under the impulses of the iteration before.
INLINE void aim_pairs(const Environment& env, Contact* list, const Contacts& found, const Loads& loads,
                      const Motion* motions) {
    for (int p = 0, first = 0; p < PAIRS; first = found.ends[p++]) {
        if (!loads.active[p]) continue;
        Load load = load_of(loads.pushed[p], pair_a(p), pair_b(p), motions);
        aim_under_load(env.laws[pair_law(p)], list, first, found.ends[p], load, motions);
    }
}

// Sums up the impulses by pair, of which those by body are made without further exchanges.
INLINE void sum_pairs(const Lanes& lanes, const Contact* list, const Contacts& found, Loads& loads, Sums& sums) {
    for (int b = 0; b < BODIES; b++) sums.linear[b] = sums.angular[b] = none();
    for (int p = 0, first = 0; p < PAIRS; first = found.ends[p++]) {
        if (!loads.active[p]) continue;
        int a = pair_a(p), b = pair_b(p);
        loads.pushed[p] = pushed_by(lanes, list, first, found.ends[p], b);
        sums.linear[a] = sums.linear[a] + loads.pushed[p].linear;
        sums.angular[a] = sums.angular[a] + loads.pushed[p].angular_a;
        if (b < 0) continue;
        sums.linear[b] = sums.linear[b] - loads.pushed[p].linear;
        sums.angular[b] = sums.angular[b] - loads.pushed[p].angular_b;
    }
}
#endif

#if LINKS
struct Reached {  // links that are touched, and the bodies that are no links or such ones
    int links[LINKS], link_count, bodies[BODIES], body_count;
};

INLINE void list_reached(const Environment& env, Reached& reached) {
    reached.link_count = reached.body_count = 0;
    for (int b = 0; b < BODIES; b++) {
        int l = body_link(b);
        if (l >= 0 && !env.chain.known[l]) continue;
        if (l >= 0) reached.links[reached.link_count++] = l;
        reached.bodies[reached.body_count++] = b;
    }
}

// Moves the links by the impulses of contacts and joints; `joints`: after one pass over the joints.
INLINE void move_links(Environment& env, const Lanes& lanes, const Reached& reached, const Sums& sums, bool joints,
                       Motion* motions) {
    push_joints(env.chain);
    for (int i = 0; i < reached.link_count; i++) {
        int l = reached.links[i], b = link_body[l];
        push_link(env.chain, l, sums.linear[b], sums.angular[b]);
    }
    if (joints && env.chain.active) sweep_joints(env.chain, lanes);
    for (int i = 0; i < reached.link_count; i++) {
        int l = reached.links[i], b = link_body[l];
        motions[b].velocity = sums.velocities[b];
        motions[b].omega = sums.omegas[b];
        gain(env.chain, l, motions[b].velocity, motions[b].omega);
    }
}
#endif

#if PAIRED
// Changes the impulses of the contacts by one iteration where it is asked for, and adds them up by body.
INLINE void sweep_list(const Environment& env, Contact* list, int count, const Motion* motions, bool changes,
                       Sums& sums) {
    for (int i = 0; i < count; i++) {
        Contact& c = list[i];
        if (changes) c.impulse = swept(c, env.laws[0], relative_velocity(c, motions));
        sums.linear[c.a] = sums.linear[c.a] + c.impulse;
        sums.angular[c.a] = sums.angular[c.a] + cross(c.arm, c.impulse);
        if (c.b >= 0) {
            sums.linear[c.b] = sums.linear[c.b] - c.impulse;
            sums.angular[c.b] = sums.angular[c.b] - cross(c.arm_b, c.impulse);
        }
    }
}
#else
struct Turning {  // moments per angular velocity that each of the touching contacts may take, across the normal and about it
    Real across, about;
};

#if SURFACE
INLINE Turning turning(const Lanes& lanes, const Contact* list, int count, const Motion& motion) {
#if WIDE
    Real touching = Real(0);
    EACH_CONTACT(list, 0, count) touching += choose(list[i].on, Real(1), Real(0));
#else
    Real touching = Real(lanes.sum(Number(count)));
#endif
    const Sym& J = motion.inverse_inertia;
    Turning each = {reciprocal((J.xx + J.yy) * touching), reciprocal(J.zz * touching)};
    return each;
}
#endif

// The same for the only body.
INLINE void sweep_body(const Environment& env, Contact* list, int count, const Motion& motion, bool changes,
                       const Turning& each, Sums& sums) {
    EACH_CONTACT(list, 0, count) {
        Contact& c = list[i];
        Vec slip = motion.velocity + cross(motion.omega, c.arm);
        if (changes) c.impulse = WHERE_ON(c, swept(c, env.laws[0], slip));
        sums.linear[0] = sums.linear[0] + c.impulse;
        sums.angular[0] = sums.angular[0] + cross(c.arm, c.impulse);
#if SURFACE
        if (env.laws[0].surface.twisting) {
            if (changes) c.turning = WHERE_ON(c, turned_by(c, env.laws[0], motion, each.across, each.about));
            sums.angular[0] = sums.angular[0] + c.turning;
        }
#endif
    }
}
#endif

// Moves the free bodies by the sums, over all lanes; `summed`: they are so already.
INLINE void move_free(const Lanes& lanes, bool summed, Sums& sums, Motion* motions) {
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        if (!is_free(b)) continue;
        if (!summed) {
            sums.linear[b] = lanes.sum(sums.linear[b]);
            sums.angular[b] = lanes.sum(sums.angular[b]);
        }
        motions[b].velocity = sums.velocities[b] + motions[b].inverse_mass * sums.linear[b];
        motions[b].omega = sums.omegas[b] + motions[b].inverse_inertia * sums.angular[b];
    }
}

// Adds the moments of the last iteration to the angular momenta of the free bodies.
INLINE void turn_free(const Sums& sums, Vec* spins) {
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        if (is_free(b)) spins[b] = spins[b] + sums.angular[b];
    }
}
#endif
