// Contacts where a block of threads simulates one environment (GATHERED): its warps take the pairs of bodies that may touch,
// and all contacts are in one list, which the threads share out anew in each part of a step. Possible contacts take no room,
// contacts that are there do: those beyond CROWD are counted, and such a rollout is of no use. Formulas are those of a single
// thread; see `touching.cuh`, `contact_shares.cuh`, `sweeps.cuh` and `collision.cuh`.
#if GATHERED
INLINE int lane_of_warp(const Lanes& lanes) { return lanes.lane & (WARP - 1); }

INLINE bool any_of_warp(bool mine) { return __any_sync(FULL, mine); }

// The greatest number of a warp, and the least index of those that have it.
INLINE void greatest_of_warp(Number& most, int& index) {
#pragma unroll
    for (int apart = WARP / 2; apart > 0; apart /= 2) {
        const Number other = __shfl_xor_sync(FULL, most, apart, WARP);
        const int at = __shfl_xor_sync(FULL, index, apart, WARP);
        if (other > most || (other == most && at < index)) {
            most = other;
            index = at;
        }
    }
}

// As `gap_along`, by a warp.
INLINE Number gap_along_by_warp(const Problem& problem, const Environment& env, int lane, int a, int b,
                                const Mat* rotations, const Number* axis) {
    Vec n = vec(Real(axis[0]), Real(axis[1]), Real(axis[2]));
    Number ends[2];
    INNER for (int side = 0; side < 2; side++) {
        const int body = side ? b : a;
        Hull hull = hull_of(problem, env, body);
        Vec within = transposed(rotations[body], side ? -n : n);
        Number x = plain(within.x), y = plain(within.y), z = plain(within.z), most = Number(-1e30);
        int which = 0;
        INNER for (int k = lane; k < hull.supports; k += WARP) {
            const Number* s = hull.support(k);
            most = greater(most, x * s[0] + y * s[1] + z * s[2] + s[3]);
        }
        greatest_of_warp(most, which);
        Vec origin = env.bodies[body].position - rotations[body] * env.constants[body].com;
        ends[side] = most + (side ? -plain(dot(n, origin)) : plain(dot(n, origin)));
    }
    return -ends[1] - ends[0];
}

// As `part_by`, by a warp: each lane takes every WARP-th face.
INLINE void part_by_warp(const Problem& problem, const Environment& env, int lane, int b, int other,
                         const Mat* rotations, Number sign, Number& most, Number* axis) {
    Hull hull = hull_of(problem, env, b), its = hull_of(problem, env, other);
    Vec origin = env.bodies[other].position - rotations[other] * env.constants[other].com - env.bodies[b].position;
    Vec shift = transposed(rotations[b], origin) + env.constants[b].com;
    const Number from[3] = {plain(shift.x), plain(shift.y), plain(shift.z)};
    Number best = Number(-1e30);
    int face = hull.faces;
    INNER for (int i = lane; i < hull.faces; i += WARP) {
        Vec within = transposed(rotations[other], rotations[b] * problem.geometry.vector(hull.row + 12LL * i));
        Number x = plain(within.x), y = plain(within.y), z = plain(within.z), least = Number(1e30);
        for (int k = 0; k < its.supports; k++) {
            const Number* s = its.support(k);
            least = lesser(least, x * s[0] + y * s[1] + z * s[2] - s[3]);
        }
        least += hull.affine(i, 0, from);
        if (!(least > best)) continue;
        best = least;
        face = i;
    }
    greatest_of_warp(best, face);
    if (!(best > most)) return;
    most = best;
    Vec normal = rotations[b] * problem.geometry.vector(hull.row + 12LL * face);
    axis[0] = sign * plain(normal.x);
    axis[1] = sign * plain(normal.y);
    axis[2] = sign * plain(normal.z);
}

// As `flat_face`, by a warp.
INLINE int flat_face_by_warp(const Problem& problem, const Environment& env, int lane, int b, const Mat& rotation,
                             Number sign, const Number* axis) {
    Hull hull = hull_of(problem, env, b);
    Vec at = transposed(rotation, vec(Real(sign * axis[0]), Real(sign * axis[1]), Real(sign * axis[2])));
    Number x = plain(at.x), y = plain(at.y), z = plain(at.z), most = Number(PARALLEL);
    int face = -1;
    INNER for (int i = lane; i < hull.faces; i += WARP) {
        const Number* n = problem.geometry.value + hull.row + 12LL * i;
        Number along = x * n[0] + y * n[1] + z * n[2];
        if (along > most) {
            most = along;
            face = i;
        }
    }
    if (!any_of_warp(face >= 0)) return -1;
    if (face < 0) face = hull.faces;  // not the least index of those that are as parallel
    greatest_of_warp(most, face);
    return face;
}

// Appends the numbers that lanes have to a list with room for some, in the order of the lanes.
template <class T>
INLINE void list_by_warp(T* listed, int most, int lane, int& count, bool mine, int number) {
    const unsigned marks = __ballot_sync(FULL, mine);
    const int place = count + __popc(marks & ((1u << lane) - 1u));
    if (mine && place < most) listed[place] = number;
    count += __popc(marks);
}

// As `find_near`, by a warp.
INLINE void find_near_by_warp(const Environment& env, int lane, int a, int b, const Hull& hull_a, const Hull& hull_b,
                              Number margin, Parting& found) {
    int near_a = 0, near_b = 0;
    INNER for (int from = 0; from < hull_a.ridges; from += WARP) {
        const int i = from + lane;
        bool mine = i < hull_a.ridges;
        if (mine) {
            Edge edge = edge_of(hull_a, i);
            Vec start = transposed(found.turn, edge.start - found.shift), along = transposed(found.turn, edge.along);
            Number thick = plain(edge.radius) + greater(plain(edge.widening), Number(0));
            mine = !edge_beside(env.constants[b], start, along, margin + thick);
        }
        list_by_warp(found.near_a.listed, NEAR_ROOM, lane, near_a, mine, i);
    }
    INNER for (int from = 0; from < hull_b.ridges; from += WARP) {
        const int i = from + lane;
        bool mine = i < hull_b.ridges;
        if (mine) {
            Edge edge = edge_in(found, hull_b, i);
            Number thick = plain(edge.radius) + greater(plain(edge.widening), Number(0));
            mine = !edge_beside(env.constants[a], edge.start, edge.along, margin + thick);
        }
        list_by_warp(found.near_b.listed, NEAR_ROOM, lane, near_b, mine, i);
    }
    if (lane == 0) {
        found.near_a.count = near_a <= NEAR_ROOM ? near_a : -1;
        found.near_b.count = near_b <= NEAR_ROOM ? near_b : -1;
    }
    __syncwarp(FULL);
    for (int n = lane; n < found.near_b.count; n += WARP) found.placed_b[n] = edge_in(found, hull_b, found.near_b.edge(n));
    __syncwarp(FULL);
}

// As `part`, by a warp: `found` is what its lanes have in common.
__device__ bool part_by_warp(const Problem& problem, const Environment& env, int lane, int p, const Mat* rotations,
                             Number limit, Parting& found) {
    const int a = pair_a(p), b = pair_b(p);
    Number gap = Number(-1e30), axis[3] = {Number(0), Number(0), Number(1)};
    const bool compared = face_count(a) != 0 && face_count(b) != 0 &&
                          face_count(a) * support_count(b) + face_count(b) * support_count(a) <= MOST_PLANES;
    int on_a = -1, on_b = -1;
    if (compared) {
        part_by_warp(problem, env, lane, a, b, rotations, Number(1), gap, axis);
        part_by_warp(problem, env, lane, b, a, rotations, Number(-1), gap, axis);
        on_a = flat_face_by_warp(problem, env, lane, a, rotations[a], Number(1), axis);
        on_b = flat_face_by_warp(problem, env, lane, b, rotations[b], Number(-1), axis);
    }
    const bool edges = compared && contact_count(p) > sphere_count(a) + sphere_count(b) && !(gap > limit);
    const Hull hull_a = hull_of(problem, env, a), hull_b = hull_of(problem, env, b);
    __syncwarp(FULL);
    if (lane == 0) found.met_count = 0;
    if (edges && lane == 0) {
        const Mat &R = rotations[a], &Q = rotations[b];
        Mat turn = {R.x.x * Q.x + R.y.x * Q.y + R.z.x * Q.z, R.x.y * Q.x + R.y.y * Q.y + R.z.y * Q.z,
                    R.x.z * Q.x + R.y.z * Q.y + R.z.z * Q.z};
        found.turn = turn;
        found.shift = transposed(R, env.bodies[b].position - Q * env.constants[b].com - env.bodies[a].position);
        found.shift = found.shift + env.constants[a].com;
    }
    __syncwarp(FULL);
    if (edges) {
        find_near_by_warp(env, lane, a, b, hull_a, hull_b, limit + Number(SMOOTHING_M), found);
        const int many_a = found.near_a.many(hull_a.ridges), many_b = found.near_b.many(hull_b.ridges);
        Number most = gap, normal[3] = {Number(0), Number(0), Number(0)};
        int which = many_a * many_b;
        INNER for (int m = lane; m < many_a; m += WARP) {
            const Edge first = edge_of(hull_a, found.near_a.edge(m));
            KEEP_LOOP
            for (int n = 0; n < many_b; n++) {
                Crossing crossing;
                const Edge second = near_edge(found, hull_b, n);
                if (surely_lean(first, second, Number(OUT_OF_FACE)) || !cross_edges(first, second, crossing)) continue;
                if (crossing.lean > Number(OUT_OF_FACE)) continue;
                if (crossing.within && plain(crossing.gap) < limit) found.meet(found.near_a.edge(m), n, crossing);
                if (crossing.lean > Number(0) || !(plain(crossing.gap) > most)) continue;
                most = plain(crossing.gap);
                which = n * many_a + m;
                normal[0] = plain(crossing.normal.x);
                normal[1] = plain(crossing.normal.y);
                normal[2] = plain(crossing.normal.z);
            }
        }
        const int own = which;
        greatest_of_warp(most, which);
        if (most > gap) {
            const int lane_with = __ffs(__ballot_sync(FULL, own == which)) - 1;
            for (int k = 0; k < 3; k++) normal[k] = __shfl_sync(FULL, normal[k], lane_with, WARP);
            Vec turned = rotations[a] * vec(Real(normal[0]), Real(normal[1]), Real(normal[2]));
            axis[0] = plain(turned.x);
            axis[1] = plain(turned.y);
            axis[2] = plain(turned.z);
            const Number exact = gap_along_by_warp(problem, env, lane, a, b, rotations, axis);
            if (exact > gap + Number(FACE_SLACK_M)) on_a = on_b = -1;
            gap = greater(gap, exact);
        }
    }
    __syncwarp(FULL);
    if (lane == 0) {
        if (found.met_count > MET_ROOM) found.met_count = -1;
        found.on_a = on_a;
        found.on_b = on_b;
        found.gap = gap;
        for (int k = 0; k < 3; k++) found.axis[k] = axis[k];
    }
    __syncwarp(FULL);
    return compared;
}

// The impulse of a contact in the previous step; they are sorted by number.
INLINE Vec before_of(const Environment& env, int contact) {
    int low = 0, high = env.kept_count;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (env.kept_slots[middle] < contact) low = middle + 1;
        else high = middle;
    }
    return low < env.kept_count && env.kept_slots[low] == contact ? env.kept[low] : none();
}

// Adds a contact to the list.
INLINE void gather(Environment& env, const Contact& c, Real weight, int p) {
    CollideRoom& room = env.chain.room.collide;
    const int place = Lanes::count_up(room.gathered);
    if (place >= CROWD) return;
    room.list[place] = c;
    room.weights[place] = weight;
    room.pairs[place] = p;
}

// The slot of two edges, among those of edges.
INLINE int slot_of(const Met& met) { return 2 * met.edge + met.leaves; }

// Makes the contact of slot `k` of two bodies, if they touch there.
__device__ void touch_slot(const Problem& problem, Environment& env, int p, int k, const Mat* rotations,
                           const Motion* motions, const Parting& parting, int edge) {
    CollideRoom& room = env.chain.room.collide;
    Contact c;
    Real weight;
    const int found = make_contact(problem, env, env.kept_count > 0, before_of(env, contact_start(p) + k), p, k, rotations,
                                   motions, room.limits[p], room.nears[p], parting, nullptr, c, weight, edge);
    if (found == 2) room.touched[p] = true;
    if (found > 0) gather(env, c, weight, p);
}

// The edge of a hull that is nearest to the point of one lane.
INLINE int nearest_edge_by_warp(const Hull& hull, int lane, int whose, const Number* point) {
    Number p[3], nearest = Number(-1e30);
    for (int k = 0; k < 3; k++) p[k] = __shfl_sync(FULL, point[k], whose, WARP);
    int edge = hull.edges;
    INNER for (int i = lane; i < hull.edges; i += WARP) {
        const Number away = -plain_edge_distance(hull, i, p);
        if (!(away > nearest)) continue;
        nearest = away;
        edge = i;
    }
    greatest_of_warp(nearest, edge);
    return edge;
}

// Finds the contacts of two bodies, by a warp.
INLINE void touch_pair(const Problem& problem, Environment& env, const Lanes& lanes, int p, const Mat* rotations,
                       const Motion* motions) {
    const int a = pair_a(p), b = pair_b(p), lane = lane_of_warp(lanes);
    CollideRoom& room = env.chain.room.collide;
    const Number limit = room.limits[p];
    Parting& parting = room.partings[lanes.lane / WARP];
    Number* parted = env.parted[p];
    const bool known = parted[0] != Number(0) || parted[1] != Number(0) || parted[2] != Number(0);
    // nothing of one hull is nearer to the other one than the gap along any axis
    if (known && gap_along_by_warp(problem, env, lane, a, b, rotations, parted) > limit) return;
    if (part_by_warp(problem, env, lane, p, rotations, limit, parting) && parting.gap > limit) {
        if (lane < 3) parted[lane] = parting.axis[lane];
        return;
    }
    const int start = contact_start(p), spheres_of_b = sphere_count(b), spheres_in_all = spheres_of_b + sphere_count(a);
    Frame frames[2];
    INNER for (int side = 0; side < 2; side++) frames[side] = frame_in(env, side ? a : b, side ? b : a, rotations);
    KEEP_LOOP
    for (int from = 0; from < spheres_in_all; from += WARP) {
        const int k = from + lane;
        const bool second = k >= spheres_of_b;
        Number point[3] = {Number(0), Number(0), Number(0)};
        bool mine = k < spheres_in_all, asks = false;
        if (mine) {
            const long long row = env.geometry + 4LL * problem.spheres[start + k];
            const int own = second ? a : b, other = second ? b : a;
            mine = !beside(env.constants[other], frames[second], problem.geometry.value + row, limit);
            if (mine && face_count(other) > 0) {
                Vec place = env.bodies[own].position +
                            rotations[own] * (problem.geometry.vector(row) - env.constants[own].com);
                place = transposed(rotations[other], place - env.bodies[other].position) + env.constants[other].com;
                point[0] = plain(place.x);
                point[1] = plain(place.y);
                point[2] = plain(place.z);
                asks = nears_edge(hull_of(problem, env, other), point, second ? parting.on_b : parting.on_a,
                                  limit + plain(problem.geometry.at(row + 3)));
            }
        }
        // the nearest edge is sought by all lanes, for one point after another
        int edge = -1;
        KEEP_LOOP
        for (unsigned marks = __ballot_sync(FULL, asks); marks != 0; marks &= marks - 1) {
            const int whose = __ffs(marks) - 1;
            const int nearest = nearest_edge_by_warp(hull_of(problem, env, from + whose >= spheres_of_b ? b : a), lane, whose, point);
            if (lane == whose) edge = nearest;
        }
        if (mine) touch_slot(problem, env, p, k, rotations, motions, parting, edge);
    }
    // of edges, those that met have contacts, or, where these are more than there is room for, those that are near
    const int slots = contact_count(p) - spheres_in_all, met = parting.met_count;
    const int many = slots == 0 ? 0 : met >= 0 ? met : 2 * parting.near_a.many(slots / 2);
    KEEP_LOOP
    for (int i = lane; i < many; i += WARP) {
        int slot = met >= 0 ? slot_of(parting.met[i]) : 2 * parting.near_a.edge(i / 2) + i % 2;
        for (int before = 0; before < (met >= 0 ? i : 0); before++) {
            if (slot_of(parting.met[before]) == slot) slot = -1;
        }
        if (slot >= 0) touch_slot(problem, env, p, spheres_in_all + slot, rotations, motions, parting, -1);
    }
    __syncwarp(FULL);  // before the next pair overwrites how these two part
}

#if FIXED
// As `touch_surface`, by a warp.
INLINE void touch_surface(const Problem& problem, Environment& env, const Lanes& lanes, int p, const Mat* rotations,
                          const Motion* motions) {
    const int a = pair_a(p), start = contact_start(p);
    const Motion& m = motions[a];
    Number margin;
    Fixed fixed = fixed_surface(problem, env, -2 - pair_b(p));
    if (!near_surface(problem, env, fixed, p, m, margin)) return;
    Searched searched;
    searched.sphere = -1;
    KEEP_LOOP
    for (int k = lane_of_warp(lanes); k < contact_count(p); k += WARP) {
        Contact c;
        Real weight;
        if (!meet_surface(problem, env, fixed, p, k, rotations, motions, margin, searched, c, weight)) continue;
        if (env.kept_count > 0) {
            Vec along = before_of(env, start + k), one, two;
            tangents(env, c.normal, one, two);
            c.impulse = along.x * c.normal + along.y * one + along.z * two;
        }
        env.chain.room.collide.touched[p] = true;
        gather(env, c, weight, p);
    }
}
#endif

// As `touch_plane_link` and `touch_plane`, by a warp.
INLINE void touch_plane(const Problem& problem, Environment& env, const Lanes& lanes, int p, const Mat* rotations,
                         const Motion* motions) {
    const int start = contact_start(p);
    KEEP_LOOP
    for (int k = lane_of_warp(lanes); k < contact_count(p); k += WARP) {
        Contact c;
        Real weight;
        if (!meet_ground(problem, env, p, k, rotations, motions, c, weight)) continue;
        c.impulse = before_of(env, start + k);
#if PATCHES
        if (area_start(p) >= 0) weight = problem.geometry.value[env.geometry + 4LL * area_start(p) + k] * weight;
#endif
        env.chain.room.collide.touched[p] = true;
        gather(env, c, weight, p);
    }
}

// Finds the contacts of all pairs that may touch. Returns their number; `order` then has them by pair and number.
INLINE int gather_all(const Problem& problem, Environment& env, const Lanes& lanes, const Mat* rotations,
                      const Motion* motions) {
    CollideRoom& room = env.chain.room.collide;
    if (lanes.lane < WARP) {
        int count = 0;
        KEEP_LOOP
        for (int from = 0; from < PAIRS; from += WARP) {
            const int p = from + lanes.lane;
            list_by_warp(room.nearby, PAIRS, lanes.lane, count, p < PAIRS && room.near[p], p);
        }
        if (lanes.writes()) {
            room.nearby_count = count;
            room.gathered = 0;
        }
    }
    lanes.sync();
    KEEP_LOOP
    for (int i = lanes.lane / WARP; i < room.nearby_count; i += LANES / WARP) {
        const int p = room.nearby[i], b = pair_b(p);
        if (b >= 0) {
            touch_pair(problem, env, lanes, p, rotations, motions);
#if FIXED
        } else if (b < -1) {
            touch_surface(problem, env, lanes, p, rotations, motions);
#endif
        } else {
            touch_plane(problem, env, lanes, p, rotations, motions);
        }
    }
    lanes.sync();
    const int count = room.gathered < CROWD ? room.gathered : CROWD;
    if (lanes.writes()) env.lost += room.gathered - count;
    DIVIDED(lanes, i, count) {
        const int slot = room.list[i].slot;
        int rank = 0;
        for (int j = 0; j < count; j++) rank += room.list[j].slot < slot;
        room.order[rank] = i;
    }
    lanes.sync();
    return count;
}

// Distributes the effective mass among the contacts of each pair.
INLINE void share_out_pairs(Environment& env, const Lanes& lanes, int count) {
    CollideRoom& room = env.chain.room.collide;
    DIVIDED(lanes, r, count) {
        const int i = room.order[r];
        const Contact& c = room.list[i];
        Vec normal = none(), turn_a = none(), turn_b = none();
        unit_response(c, env.chain, normal, turn_a, turn_b);
        room.first[r] = normal;
        room.second[r] = turn_a;
        room.third[r] = turn_b;
        room.weight[r] = room.weights[i];
#if PATCHES
        if (area_start(room.pairs[i]) < 0)
#endif
        room.weight[r] = room.weights[i] * c.stop_n;
    }
    lanes.sync();
    DIVIDED(lanes, r, count) {
        const int i = room.order[r], p = room.pairs[i];
        Contact& c = room.list[i];
        int first = r;
        while (first > 0 && room.pairs[room.order[first - 1]] == p) first--;
        const Vec turn_a = cross(c.arm, c.normal), turn_b = cross(c.arm_b, c.normal);
        Real total = Real(0);
        KEEP_LOOP
        for (int other = first; other < count && room.pairs[room.order[other]] == p; other++) {
            Real along = dot(c.normal, room.first[other]) + dot(turn_a, room.second[other]);
            if (c.b >= 0) along += dot(turn_b, room.third[other]);
            total += room.weight[other] * along * along;
        }
#if PATCHES
        room.totals[r] = total;
        if (area_start(p) >= 0) continue;
#endif
        share_out(c, c.stop_n * total, room.weights[i]);
    }
    lanes.sync();
#if PATCHES  // in proportion to areas, as `share_by_area`
    DIVIDED(lanes, r, count) {
        const int i = room.order[r], p = room.pairs[i];
        if (area_start(p) < 0) continue;
        int first = r;
        while (first > 0 && room.pairs[room.order[first - 1]] == p) first--;
        Real spread = Real(0), mobility = Real(Number(LEAST_MOBILITY));
        for (int other = first; other < count && room.pairs[room.order[other]] == p; other++) {
            const int j = room.order[other];
            spread += room.weights[j] * room.totals[other];
            mobility += room.weights[j] * reciprocal(room.list[j].stop_n);
        }
        room.weight[r] = spread * reciprocal(mobility);
    }
    lanes.sync();
    DIVIDED(lanes, r, count) {
        const int i = room.order[r];
        Contact& c = room.list[i];
        if (area_start(room.pairs[i]) >= 0) share_out(c, c.stop_n * room.weight[r], room.weights[i]);
    }
    lanes.sync();
#endif
}

// As `list_reached`, by a warp.
INLINE void list_reached_by_warp(Environment& env, const Lanes& lanes) {
    CollideRoom& room = env.chain.room.collide;
    if (lanes.lane < WARP) {
        int count = 0;
        KEEP_LOOP
        for (int from = 0; from < LINKS + FREES; from += WARP) {
            const int place = from + lanes.lane;
            const bool mine = place < LINKS ? env.chain.known[place] : place < LINKS + FREES && is_free(free_body(place - LINKS));
            list_by_warp(room.reached, LINKS + FREES, lanes.lane, count, mine, place);
        }
        if (lanes.writes()) room.reached_count = count;
    }
    lanes.sync();
}

// Lists the contacts of each body that they may move.
INLINE void list_acting(Environment& env, const Lanes& lanes, int count) {
    CollideRoom& room = env.chain.room.collide;
    DIVIDED(lanes, r, room.reached_count) {
        const int body = body_at(room.reached[r]);
        int found = 0;
        for (int i = 0; i < count; i++) found += (room.list[i].a == body) + (room.list[i].b == body);
        room.acting_start[r] = found;
    }
    lanes.sync();
    DIVIDED(lanes, r, room.reached_count) {
        const int body = body_at(room.reached[r]);
        int at = 0;
        for (int i = 0; i < r; i++) at += room.acting_start[i];
        room.acting_first[r] = at;
        KEEP_LOOP
        for (int i = 0; i < count; i++) {
            const Contact& c = room.list[room.order[i]];
            if (c.a == body) room.acting[at++] = i;
            else if (c.b == body) room.acting[at++] = ~i;
        }
    }
    lanes.sync();
}

// As `sweep_contacts`; each number of the sum of a body is made by one lane.
INLINE void sweep_gathered(Environment& env, const Lanes& lanes, int count, const Motion* motions, bool changes) {
    CollideRoom& room = env.chain.room.collide;
    DIVIDED(lanes, r, count) {
        Contact& c = room.list[room.order[r]];
        if (changes) c.impulse = swept(c, env.laws[0], relative_velocity(c, motions));
        room.first[r] = c.impulse;
        room.second[r] = cross(c.arm, c.impulse);
        if (c.b >= 0) room.third[r] = cross(c.arm_b, c.impulse);
    }
    lanes.sync();
    DIVIDED(lanes, part, 6 * room.reached_count) {
        const int r = part / 6, k = part % 6, place = room.reached[r];
        const Vec *const mine = k < 3 ? room.first : room.second, *const other = k < 3 ? room.first : room.third;
        const int axis = k < 3 ? k : k - 3, from = room.acting_first[r];
        Real sum = Real(0);
        KEEP_LOOP
        for (int i = from; i < from + room.acting_start[r]; i++) {
            const int at = room.acting[i];
            sum = at >= 0 ? sum + (&mine[at].x)[axis] : sum - (&other[~at].x)[axis];
        }
        (&(k < 3 ? room.pushes : room.moments)[place].x)[axis] = sum;
    }
    lanes.sync();
}

// As `keep`, and notes the impulses of labels.
INLINE void keep_gathered(const Problem& problem, Environment& env, Own& own, int count) {
    const CollideRoom& room = env.chain.room.collide;
    DIVIDED(own.lanes, r, count) {
        const Contact& c = room.list[room.order[r]];
        Vec one, two;
        tangents(env, c.normal, one, two);
        Vec along = vec(dot(c.impulse, c.normal), dot(c.impulse, one), dot(c.impulse, two));
        env.kept_slots[r] = c.slot;
        env.kept[r] = c.b == -1 ? c.impulse : along;
#if RECORD
        note(tally_of(problem, env, own.frame, c.slot), c, env.laws[0], env.bodies[c.a].position);
#endif
    }
    if (own.lanes.writes()) env.kept_count = problem.sweeps < 2 ? 0 : count;  // a single iteration starts at zero
    own.lanes.sync();
}

// Finds the contacts of a step and their impulses, and adds these to the bodies' velocities and angular momenta.
INLINE void collide(const Problem& problem, Environment& env, Own& own, const Mat* rotations, Motion* motions,
                    Vec* velocities, Vec* spins) {
    const Lanes& lanes = own.lanes;
    CollideRoom& room = env.chain.room.collide;
    DIVIDED(lanes, b, BODIES) room.groups[b] = 0;
    find_near_pairs(problem, env, lanes, rotations, motions);
    reveal_links(env.chain, lanes, env.bodies);
    const int count = gather_all(problem, env, lanes, rotations, motions);
    if (count > 0) {
        share_out_pairs(env, lanes, count);
        DIVIDED(lanes, p, PAIRS) {
            if (!room.touched[p]) continue;
            Lanes::count_up(room.groups[group_of(pair_a(p))]);
            if (pair_b(p) >= 0 && group_of(pair_b(p)) >= 0) Lanes::count_up(room.groups[group_of(pair_b(p))]);
        }
        lanes.sync();
        DIVIDED(lanes, i, count) split(&room.list[i], 1, room.groups);
    } else {
        lanes.sync();
        if (lanes.writes()) env.kept_count = 0;
        lanes.sync();
        if (!env.chain.active) return;
    }
    int sweep = env.kept_count > 0 || env.chain.active ? -1 : 0;
    lanes.sync();
    if (problem.sweeps < 2) {  // a single iteration starts at zero
        DIVIDED(lanes, k, 3 * JOINTS) env.chain.impulses[k] = Real(0);
    }
    list_reached_by_warp(env, lanes);
    DIVIDED(lanes, r, room.reached_count) room.free[room.reached[r]] = motions[body_at(room.reached[r])];
    list_acting(env, lanes, count);
    do {
        sweep_gathered(env, lanes, count, motions, sweep >= 0);
        move_bodies(env, lanes, motions, spins, sweep >= 0, sweep + 1 >= problem.sweeps);
    } while (++sweep < problem.sweeps);
    keep_gathered(problem, env, own, count);
    DIVIDED(lanes, b, BODIES) {
        if (is_free(b)) velocities[FREE(b)] = motions[b].velocity;
    }
    lanes.sync();
}
#endif
