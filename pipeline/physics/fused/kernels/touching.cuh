// The contacts of a pair: of two bodies, of a body with a fixed surface, of a link with the ground.
#if PAIRED
#if !QUEUED && !GATHERED
// Finds the contacts of two bodies and distributes the effective mass among them; returns how many touch.
__device__ int touch_pair(const Problem& problem, Environment& env, const Own& own, int p, const Mat* rotations,
                          Motion* motions, Contact* list, Real* weights, int& count) {
    int a = pair_a(p), b = pair_b(p), first = count, touching = 0;
    const Constants &ca = env.constants[a], &cb = env.constants[b];
    Reach reach;
    bool near = may_touch(env, p, rotations, motions, reach);
    Parting parting;
#if HULLS
    bool parts = false;
    if (near) {
        // nothing of one hull is nearer to the other one than the gap along any axis
        Number* parted = env.parted[p];
        const bool known = parted[0] != Number(0) || parted[1] != Number(0) || parted[2] != Number(0);
        if (known && gap_along(problem, env, a, b, rotations, parted) > reach.limit) near = false;
        parts = near && part(problem, env, p, rotations, reach.limit, parting) && parting.gap > reach.limit;
        if (parts) near = false;
    }
    own.lanes.sync();
    if (parts && own.lanes.writes()) {
        for (int k = 0; k < 3; k++) env.parted[p][k] = parting.axis[k];
    }
#endif
#if LINKS && !SHARED
    reveal(env, own.lanes, motions, a, near);
    reveal(env, own.lanes, motions, b, near);
#endif
    if (near) {
        const int start = contact_start(p), spheres_of_b = sphere_count(b), spheres_in_all = spheres_of_b + sphere_count(a);
#if HULLS && PACKED
        bool beside_all[2 * SWARM_ROOM];
        const bool marked = spheres_of_b <= SWARM_ROOM && sphere_count(a) <= SWARM_ROOM;
        INNER for (int side = 0; marked && side < 2; side++) {
            const int mine = side ? a : b;
            const Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(mine), sphere_count(mine)};
            mark_beside(side ? cb : ca, reach.frames[side], Swarm(spheres), spheres.count, reach.limit,
                        beside_all + side * SWARM_ROOM);
        }
#endif
        EACH_OWNED(own.lanes, start, contact_count(p), k) {
            if (k < spheres_in_all) {
                const bool second = k >= spheres_of_b;
#if HULLS && PACKED
                if (marked && beside_all[second ? SWARM_ROOM + k - spheres_of_b : k]) continue;
                if (!marked)
#endif
                {
                    const Number* sphere = problem.geometry.value + env.geometry + 4LL * problem.spheres[start + k];
                    if (beside(second ? cb : ca, reach.frames[second], sphere, reach.limit)) continue;
                }
            }
#if HOST && HULLS
            else if (parting.met_count == 0) break;
            else if (parting.never(k - spheres_in_all)) continue;
#endif
            const Vec before = own.warm ? own.before[(start + k) / LANES] : none();
            int found = make_contact(problem, env, own.warm, before, p, k, rotations, motions, reach.limit, reach.near,
                                     parting, nullptr, list[count], weights[count]);
            if (found == 2) touching++;
            if (found > 0) count++;
        }
    }
    if (own.lanes.any(count > first)) share_out_pair(SHOWN_TO(own.lanes, env), list, weights, first, count, motions);
    return touching;
}
#endif

#if FIXED
// Whether a body may touch a fixed surface in this step, in which none of its points moves farther than `margin`.
INLINE bool near_surface(const Problem& problem, const Environment& env, const Fixed& fixed, int p, const Motion& m,
                         Number& margin) {
    const int a = pair_a(p);
    Number h = plain(env.laws[0].step_s), reach = env.constants[a].reach;
    margin = h * (size(m.velocity) + size(m.omega) * reach) + Number(1e-6);  // up to rounding
    const Vec place = transposed(fixed.rotation, env.bodies[a].position - fixed.position);
    return least_distance(problem, fixed, -2 - pair_b(p), place) - reach < margin;
}

// Makes the contact of slot `k` of a body with a fixed surface; returns whether it touches.
INLINE bool meet_surface(const Problem& problem, const Environment& env, const Fixed& fixed, int p, int k,
                         const Mat* rotations, const Motion* motions, Number margin, Searched& searched, Contact& c,
                         Real& weight) {
    const int a = pair_a(p);
    const Motion& m = motions[a];
    Vec center;
    Real radius;
    Meeting meeting;
    if (!meet(problem, env, fixed, p, k, rotations[a], &m, searched, center, radius, meeting)) return false;
    Real gap = meeting.distance - radius;
    if (!(plain(gap) < margin)) return false;
    c.normal = meeting.outward;
    c.arm = center - env.bodies[a].position - radius * meeting.outward;
    c.arm_b = none();
    c.a = a;
    c.b = -2;
    c.slot = SLOT_OF(contact_start(p) + k);
    Real speed = dot(m.velocity + cross(m.omega, c.arm), c.normal);
#if LINKS
    Real inverse_mass = Real(0), mobility = Real(0);
    add_mobility(response(RESPONSES(env, motions), a), c.arm, c.normal, inverse_mass, mobility);
#else
    Vec turn = cross(c.arm, c.normal);
    Real inverse_mass = m.inverse_mass + dot(turn, m.inverse_inertia * turn);
    Real mobility = mobility_trace(m, c.arm);
#endif
    return prepare(c, env.laws[pair_law(p)], gap, speed, inverse_mass, mobility, weight);
}

#if !GATHERED
// Finds the contacts of a body with a fixed surface and distributes the effective mass among them; returns how many
// touch.
__device__ int touch_surface(const Problem& problem, Environment& env, const Own& own, int p, const Mat* rotations,
                             Motion* motions, Contact* list, Real* weights, int& count) {
    int a = pair_a(p), s = -2 - pair_b(p), first = count;
    Number margin;
    Fixed fixed = fixed_surface(problem, env, s);
    const bool near = near_surface(problem, env, fixed, p, motions[a], margin);
#if LINKS && !SHARED
    reveal(env, own.lanes, motions, a, near);
#endif
    if (near) {
        const int start = contact_start(p);
        Searched searched;
        searched.sphere = -1;
        EACH_OWNED(own.lanes, start, contact_count(p), k) {
            Contact& c = list[count];
            Real weight;
            if (!meet_surface(problem, env, fixed, p, k, rotations, motions, margin, searched, c, weight)) continue;
            if (own.warm) {
                Vec along = own.before[(start + k) / LANES], one, two;
                tangents(env, c.normal, one, two);
                c.impulse = along.x * c.normal + along.y * one + along.z * two;
            }
            weights[count++] = weight;
        }
    }
    if (own.lanes.any(count > first)) {
        share_out_pair(SHOWN_TO(own.lanes, env), list, weights, first, count, motions);
#if SURFACE
        surfaces(own.lanes, env.laws[0], motions[a], list, weights, first, count);
#endif
    }
    return count - first;
}
#endif
#endif

#if LINKS
// Makes the contact of slot `k` of a body with the ground; returns whether it touches.
INLINE bool meet_ground(const Problem& problem, const Environment& env, int p, int k, const Mat* rotations,
                        const Motion* motions, Contact& c, Real& weight) {
    const int a = pair_a(p), contact = contact_start(p) + k;
    const long long row = env.geometry + 4LL * problem.spheres[contact];
    Vec up = vec(Real(0), Real(0), Real(1));
    c.arm = rotations[a] * (problem.geometry.vector(row) - env.constants[a].com) - problem.geometry.at(row + 3) * up;
    c.normal = up;
    c.arm_b = none();
    c.a = a;
    c.b = -1;
    c.slot = SLOT_OF(contact);
    Real gap = env.bodies[a].position.z - env.ground + c.arm.z, inverse_mass = Real(0), mobility = Real(0);
    Real speed = relative_velocity(c, motions).z;
    add_mobility(response(RESPONSES(env, motions), a), c.arm, up, inverse_mass, mobility);
    return prepare(c, env.laws[pair_law(p)], gap, speed, inverse_mass, mobility, weight);
}

#if !GATHERED
// Finds the contacts of a link with the ground, and distributes the effective mass among them as between two bodies.
__device__ int touch_plane_link(const Problem& problem, Environment& env, const Own& own, int p, const Mat* rotations,
                                Motion* motions, Contact* list, Real* weights, int& count) {
    int first = count, start = contact_start(p);
#if !SHARED
    reveal(env, own.lanes, motions, pair_a(p), true);
#endif
    EACH_OWNED(own.lanes, start, contact_count(p), k) {
        Contact& c = list[count];
        if (!meet_ground(problem, env, p, k, rotations, motions, c, weights[count])) continue;
        c.impulse = own.before[(start + k) / LANES];
        count++;
    }
    if (own.lanes.any(count > first)) share_out_pair(SHOWN_TO(own.lanes, env), list, weights, first, count, motions);
    return count - first;
}
#endif
#endif

// Divides the effective mass of a body by the number of groups of contacts on it; `groups` counts them by body.
INLINE void split(Contact* list, int count, const int* groups) {
    INNER for (int i = 0; i < count; i++) {
        Contact& c = list[i];
        int most = groups[group_of(c.a)], other = c.b >= 0 ? group_of(c.b) : -1;
        if (other >= 0 && groups[other] > most) most = groups[other];
        Number share = most > 1 ? quotient(Number(1), Number(most)) : Number(1);
        c.stop_n = share * c.stop_n;
        c.stop_t = share * c.stop_t;
#if SURFACE && PAIRED
        c.across = share * c.across;
        c.about = share * c.about;
#endif
    }
}
#endif
