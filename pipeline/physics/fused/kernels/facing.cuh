// Gap, normal and point of each possible contact of two bodies; formulas of `physics/contact_detection.py`.
#if PAIRED || (PUBLISHED && TURNED)
// Two unit tangents of a contact, orthogonal to its normal, chosen in the world frame.
INLINE void tangents(const Environment& env, Vec normal, Vec& first, Vec& second) {
#if TURNED
    Vec n = transposed(env.turn, normal);
#else
    Vec n = normal;
#endif
    Number sign = plain(n.z) >= Number(0) ? Number(1) : Number(-1);
    Real a = -reciprocal(Real(sign) + n.z), b = n.x * n.y * a;
    first = vec(Real(1) + sign * (n.x * n.x * a), sign * b, -sign * n.x);
    second = vec(b, Real(sign) + n.y * n.y * a, -n.y);
#if TURNED
    first = env.turn * first;
    second = env.turn * second;
#endif
}
#endif

#if PAIRED
struct Facing {
    Vec normal, point;  // world frame; the normal points from body b of the pair to body a
    Real gap;
    Number sharp_gap;  // to the nearest sphere, without smoothing
};

#if HULLS
INLINE Hull hull_of(const Problem& problem, const Environment& env, int b) {
    Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(b), sphere_count(b)};
    Hull hull = {spheres,       env.geometry + 4LL * hull_start(b), face_count(b), edge_count(b),
                 support_count(b), ridge_count(b)};
    return hull;
}

#if PACKED
const int SWARM_ROOM = 64;  // whole vectors

struct Plain {  // a rotation without derivatives
    Number at[3][3];
    explicit Plain(const Mat& R)
        : at{{plain(R.x.x), plain(R.x.y), plain(R.x.z)},
             {plain(R.y.x), plain(R.y.y), plain(R.y.z)},
             {plain(R.z.x), plain(R.z.y), plain(R.z.z)}} {}
};

struct Swarm {  // up to SWARM_ROOM spheres of a body: coordinates of their centres, and radii
    Number at[4][SWARM_ROOM];
    explicit Swarm(const Union& spheres) {
        const Number* rows = spheres.geometry.value + spheres.first;
        for (int i = 0; i < spheres.count; i++) {
            for (int k = 0; k < 4; k++) at[k][i] = rows[4 * i + k];
        }
    }
};
#endif

// Raises `most` to the greatest height that the spheres of another hull have over a plane of this one; sets `axis` to
// the normal of that plane, in the world frame, times `sign`.
INLINE void part_by(const Problem& problem, const Environment& env, int b, int other, const Mat* rotations,
                    Number sign, Number& most, Number* axis) {
    Hull hull = hull_of(problem, env, b), its = hull_of(problem, env, other);
    Vec origin = env.bodies[other].position - rotations[other] * env.constants[other].com - env.bodies[b].position;
    Vec shift = transposed(rotations[b], origin) + env.constants[b].com;
    Number from[3] = {plain(shift.x), plain(shift.y), plain(shift.z)};
#if PACKED
    const Plain R(rotations[b]), Q(rotations[other]);
    for (int i = 0; i < hull.faces; i += 8) {
        Eight own[3], normal[3], within[3], least = Eight{} + Number(1e30);
        for (int k = 0; k < 3; k++) own[k] = eight_at(hull.plane(k, i));
        for (int k = 0; k < 3; k++) normal[k] = R.at[k][0] * own[0] + R.at[k][1] * own[1] + R.at[k][2] * own[2];
        for (int k = 0; k < 3; k++) within[k] = Q.at[0][k] * normal[0] + Q.at[1][k] * normal[1] + Q.at[2][k] * normal[2];
        for (int k = 0; k < its.supports; k++) {
            const Number* s = its.support(k);
            least = lesser(within[0] * s[0] + within[1] * s[1] + within[2] * s[2] - s[3], least);
        }
        least += own[0] * from[0] + own[1] * from[1] + own[2] * from[2] - eight_at(hull.plane(3, i));
        for (int k = 0; k < 8; k++) {
            if (!(least[k] > most)) continue;
            most = least[k];
            for (int j = 0; j < 3; j++) axis[j] = sign * normal[j][k];
        }
    }
#else
    for (int i = 0; i < hull.faces; i++) {
        Vec normal = rotations[b] * problem.geometry.vector(hull.row + 12LL * i);
        Vec within = transposed(rotations[other], normal);
        Number x = plain(within.x), y = plain(within.y), z = plain(within.z), least = Number(1e30);
        const Number height = hull.affine(i, 0, from);
        for (int k = 0; k < its.supports; k++) {
            const Number* s = its.support(k);
            least = lesser(least, x * s[0] + y * s[1] + z * s[2] - s[3]);
#if HOST
            if (!(least + height > most)) break;
#endif
        }
        least += height;
        if (!(least > most)) continue;
        most = least;
        axis[0] = sign * plain(normal.x);
        axis[1] = sign * plain(normal.y);
        axis[2] = sign * plain(normal.z);
    }
#endif
}

// Returns the face of a body whose normal is nearest to `sign` times the axis; -1 where none is parallel to it.
INLINE int flat_face(const Problem& problem, const Environment& env, int b, const Mat& rotation, Number sign,
                     const Number* axis) {
    Hull hull = hull_of(problem, env, b);
    Vec at = transposed(rotation, vec(Real(sign * axis[0]), Real(sign * axis[1]), Real(sign * axis[2])));
    Number x = plain(at.x), y = plain(at.y), z = plain(at.z), most = Number(PARALLEL);
    int face = -1;
    for (int i = 0; i < hull.faces; i++) {
        const Number* n = problem.geometry.value + hull.row + 12LL * i;
        Number along = x * n[0] + y * n[1] + z * n[2];
        if (along > most) {
            most = along;
            face = i;
        }
    }
    return face;
}

#if PACKED
struct Fan {  // edges of one hull without derivatives, one vector of numbers after another
    Number along[3][NEAR_ROOM], inward[3][NEAR_ROOM], other[3][NEAR_ROOM], both[3][NEAR_ROOM];
    INLINE void put(int i, const Edge& edge) {
        const Vec vectors[4] = {edge.along, edge.inward, edge.other_inward, edge.inward + edge.other_inward};
        Number (*const arrays[4])[NEAR_ROOM] = {along, inward, other, both};
        for (int k = 0; k < 4; k++) {
            arrays[k][0][i] = plain(vectors[k].x);
            arrays[k][1][i] = plain(vectors[k].y);
            arrays[k][2][i] = plain(vectors[k].z);
        }
    }
    // Marks those of eight edges from edge `from` on that do not surely lean: as `surely_lean`.
    INLINE int upright(int from, const Edge& second, Number bound) const {
        Eight a[3], i[3], o[3], s[3];
        for (int k = 0; k < 3; k++) {
            s[k] = eight_at(both[k] + from);
            a[k] = eight_at(along[k] + from);
            i[k] = eight_at(inward[k] + from);
            o[k] = eight_at(other[k] + from);
        }
        const Number b[3] = {plain(second.along.x), plain(second.along.y), plain(second.along.z)};
        const Number si[3] = {plain(second.inward.x), plain(second.inward.y), plain(second.inward.z)};
        const Number so[3] = {plain(second.other_inward.x), plain(second.other_inward.y), plain(second.other_inward.z)};
        const Eight x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
        const Eight first = x * i[0] + y * i[1] + z * i[2], next = x * o[0] + y * o[1] + z * o[2];
        const Eight third = x * si[0] + y * si[1] + z * si[2], last = x * so[0] + y * so[1] + z * so[2];
        const Eight side = s[0] * x + s[1] * y + s[2] * z > Number(0) ? Eight{} - Number(1) : Eight{} + Number(1);
        const Eight most = greater(greater(side * first, side * next), -lesser(side * third, side * last));
        const Number least = bound + Number(1e-6);
        const auto leans = (most > Number(0)) & (most * most > least * least * (x * x + y * y + z * z));
        int marks = 0;
        for (int k = 0; k < 8; k++) marks |= (int)(leans[k] == 0) << k;
        return marks;
    }
};
#endif

// The edge of body b in the frame of body a.
INLINE Edge edge_in(const Parting& parting, const Hull& hull_b, int i) {
    return placed_edge(edge_of(hull_b, i), parting.turn, parting.shift);
}

// The near edge number `n` of body b in the frame of body a.
INLINE Edge near_edge(const Parting& parting, const Hull& hull_b, int n) {
#if HOST || GATHERED
    if (parting.near_b.count >= 0) return parting.placed_b[n];
#endif
    return edge_in(parting, hull_b, parting.near_b.edge(n));
}

// Whether an edge is farther than a margin from the box of a body's spheres, all in the frame of that body.
INLINE bool edge_beside(const Constants& body, Vec start, Vec along, Number margin) {
    const Number from[3] = {plain(start.x), plain(start.y), plain(start.z)};
    const Number over[3] = {plain(along.x), plain(along.y), plain(along.z)};
    for (int k = 0; k < 3; k++) {
        Number to = from[k] + over[k];
        if (lesser(from[k], to) > body.high[k] + margin || greater(from[k], to) < body.low[k] - margin) return true;
    }
    return false;
}

#if HOST
const int MARKED_ROOM = 64;
// Marks for each sphere of a hull the sides of a body's box beyond which it is, by more than a margin; `turn` and `shift`
// bring it into the frame of that body.
INLINE void mark_sides(const Constants& body, const Hull& hull, const Mat& turn, Vec shift, Number margin, int* sides) {
#if PACKED
    const Plain R(turn);
    const Number from[3] = {plain(shift.x), plain(shift.y), plain(shift.z)};
    Swarm swarm(hull.spheres);
    for (int i = 0; i < hull.spheres.count; i += 8) {
        const Eight x = eight_at(swarm.at[0] + i), y = eight_at(swarm.at[1] + i), z = eight_at(swarm.at[2] + i);
        const Eight far = eight_at(swarm.at[3] + i) + margin;
        decltype(x < y) marks = {};
        for (int k = 0; k < 3; k++) {
            const Eight at = from[k] + (R.at[k][0] * x + R.at[k][1] * y + R.at[k][2] * z);
            marks |= (at > body.high[k] + far) & 1 << 2 * k;
            marks |= (at < body.low[k] - far) & 1 << (2 * k + 1);
        }
        for (int k = 0; k < 8; k++) sides[i + k] = (int)marks[k];
    }
#else
    for (int i = 0; i < hull.spheres.count; i++) {
        const Vec center = shift + turn * hull.spheres.center(i);
        const Number at[3] = {plain(center.x), plain(center.y), plain(center.z)};
        const Number far = margin + plain(hull.spheres.radius(i));
        sides[i] = 0;
        for (int k = 0; k < 3; k++) {
            sides[i] |= (int)(at[k] > body.high[k] + far) << 2 * k | (int)(at[k] < body.low[k] - far) << (2 * k + 1);
        }
    }
#endif
}

// Lists the edges of a hull of which no side of a body's box has both ends beyond it.
INLINE void list_near(const Hull& hull, const int* sides, Near& near) {
    for (int i = 0; i < hull.ridges && near.count >= 0; i++) {
        const Number* row = hull.spheres.geometry.value + hull.ridge(i);
        if (!(sides[(int)row[0]] & sides[(int)row[1]])) near.add(i);
    }
}
#endif

// Lists the edges of both hulls that are within a margin of the other body's box.
INLINE void find_near(const Environment& env, int a, int b, const Hull& hull_a, const Hull& hull_b, Number margin,
                      Parting& found) {
    found.near_a.clear();
    found.near_b.clear();
#if HOST
    int sides[MARKED_ROOM];
    const Mat& t = found.turn;
    const Mat back = {vec(t.x.x, t.y.x, t.z.x), vec(t.x.y, t.y.y, t.z.y), vec(t.x.z, t.y.z, t.z.z)};
    if (hull_a.spheres.count <= MARKED_ROOM && hull_b.spheres.count <= MARKED_ROOM) {
        mark_sides(env.constants[b], hull_a, back, -(back * found.shift), margin, sides);
        list_near(hull_a, sides, found.near_a);
        mark_sides(env.constants[a], hull_b, t, found.shift, margin, sides);
        list_near(hull_b, sides, found.near_b);
        return;
    }
#endif
    for (int i = 0; i < hull_a.ridges && found.near_a.count >= 0; i++) {
        Edge edge = edge_of(hull_a, i);
        Vec start = transposed(found.turn, edge.start - found.shift), along = transposed(found.turn, edge.along);
        Number thick = plain(edge.radius) + greater(plain(edge.widening), Number(0));
        if (!edge_beside(env.constants[b], start, along, margin + thick)) found.near_a.add(i);
    }
    for (int j = 0; j < hull_b.ridges && found.near_b.count >= 0; j++) {
        Edge edge = edge_in(found, hull_b, j);
        Number thick = plain(edge.radius) + greater(plain(edge.widening), Number(0));
        if (!edge_beside(env.constants[a], edge.start, edge.along, margin + thick)) found.near_b.add(j);
    }
}

// Gap between the hulls of two bodies along a unit vector of the world, out of a.
INLINE Number gap_along(const Problem& problem, const Environment& env, int a, int b, const Mat* rotations,
                        const Number* axis) {
    Vec n = vec(Real(axis[0]), Real(axis[1]), Real(axis[2]));
    Number ends[2];
    for (int side = 0; side < 2; side++) {
        int body = side ? b : a;
        Hull hull = hull_of(problem, env, body);
        Vec within = transposed(rotations[body], side ? -n : n);
        Number x = plain(within.x), y = plain(within.y), z = plain(within.z), most = Number(-1e30);
        for (int k = 0; k < hull.supports; k++) {
            const Number* s = hull.support(k);
            most = greater(most, x * s[0] + y * s[1] + z * s[2] + s[3]);
        }
        Vec origin = env.bodies[body].position - rotations[body] * env.constants[body].com;
        ends[side] = most + (side ? -plain(dot(n, origin)) : plain(dot(n, origin)));
    }
    return -ends[1] - ends[0];
}

// Raises `most` to the gap along the common normal of two edges, the second of them number `n` of the near ones of b, and
// sets the axis to it. On a CPU, edges that may be a contact are noted.
INLINE void part_by_edges(const Edge& first, const Edge& second, int edge, int n, Number limit, const Mat& rotation,
                          Parting& found, Number& most) {
    Crossing crossing;
    if (!cross_edges(first, second, crossing)) return;
#if NOTED
    if (crossing.lean > Number(OUT_OF_FACE)) return;
    if (crossing.within && plain(crossing.gap) < limit) found.meet(edge, n, crossing);
#endif
    if (crossing.lean > Number(0) || !(plain(crossing.gap) > most)) return;
    most = plain(crossing.gap);
    Vec normal = rotation * crossing.normal;
    found.axis[0] = plain(normal.x);
    found.axis[1] = plain(normal.y);
    found.axis[2] = plain(normal.z);
}

// Finds how the hulls of two bodies part best; false where they are not compared. Where a face parts them by more than
// `limit`, edges are not looked at.
__device__ bool part(const Problem& problem, const Environment& env, int p, const Mat* rotations, Number limit,
                     Parting& found) {
    int a = pair_a(p), b = pair_b(p);
    found.on_a = found.on_b = -1;
#if NOTED
    found.met_count = -1;
#endif
    if (face_count(a) == 0 || face_count(b) == 0) return false;
    if (face_count(a) * support_count(b) + face_count(b) * support_count(a) > MOST_PLANES) return false;
    found.gap = Number(-1e30);
    found.axis[0] = found.axis[1] = Number(0);
    found.axis[2] = Number(1);
    part_by(problem, env, a, b, rotations, Number(1), found.gap, found.axis);
    part_by(problem, env, b, a, rotations, Number(-1), found.gap, found.axis);
    found.on_a = flat_face(problem, env, a, rotations[a], Number(1), found.axis);
    found.on_b = flat_face(problem, env, b, rotations[b], Number(-1), found.axis);
    if (contact_count(p) == sphere_count(a) + sphere_count(b) || found.gap > limit) return true;
    const Hull hull_a = hull_of(problem, env, a), hull_b = hull_of(problem, env, b);
    const Mat &R = rotations[a], &Q = rotations[b];
    Mat turn = {R.x.x * Q.x + R.y.x * Q.y + R.z.x * Q.z, R.x.y * Q.x + R.y.y * Q.y + R.z.y * Q.z,
                R.x.z * Q.x + R.y.z * Q.y + R.z.z * Q.z};
    found.turn = turn;
    found.shift = transposed(R, env.bodies[b].position - Q * env.constants[b].com - env.bodies[a].position);
    found.shift = found.shift + env.constants[a].com;
    find_near(env, a, b, hull_a, hull_b, limit + Number(SMOOTHING_M), found);
#if MARKED
    for (int n = 0; n < found.near_b.count; n++) found.placed_b[n] = edge_in(found, hull_b, found.near_b.edge(n));
    found.met_count = 0;
    found.marks = 0;
#endif
#if PACKED
    Edge placed_a[NEAR_ROOM];
    Fan fan;
    for (int m = 0; m < found.near_a.count; m++) {
        placed_a[m] = edge_of(hull_a, found.near_a.edge(m));
        fan.put(m, placed_a[m]);
    }
#endif
    Number most = found.gap;
    for (int n = 0; n < found.near_b.many(hull_b.ridges); n++) {
        Edge second = near_edge(found, hull_b, n);
#if PACKED
        if (found.near_a.count >= 0) {
            for (int from = 0; from < found.near_a.count; from += 8) {
                for (int marks = fan.upright(from, second, Number(OUT_OF_FACE)); marks != 0; marks &= marks - 1) {
                    const int m = from + __builtin_ctz(marks);
                    if (m >= found.near_a.count) break;
                    part_by_edges(placed_a[m], second, found.near_a.edge(m), n, limit, rotations[a], found, most);
                }
            }
            continue;
        }
#endif
        for (int m = 0; m < found.near_a.many(hull_a.ridges); m++) {
            const Edge first = edge_of(hull_a, found.near_a.edge(m));
#if HOST
            if (surely_lean(first, second, Number(OUT_OF_FACE))) continue;
#endif
            part_by_edges(first, second, found.near_a.edge(m), n, limit, rotations[a], found, most);
        }
    }
    if (!(most > found.gap)) return true;
    Number exact = gap_along(problem, env, a, b, rotations, found.axis);  // spheres beside the edges may protrude
    // where edges part the bodies, faces that part them worse are not what touches
    if (exact > found.gap + Number(FACE_SLACK_M)) found.on_a = found.on_b = -1;
    found.gap = greater(found.gap, exact);
    return true;
}

// Finds the contact of one slot of edges: where an edge of a comes over b, or where it leaves it.
__device__ bool face_edges(const Problem& problem, const Environment& env, int p, int slot, const Mat* rotations,
                           Number limit, const Parting& parting, Facing& facing) {
    int a = pair_a(p);
#if NOTED
    const bool listed = parting.met_count >= 0;
#if MARKED
    if (parting.never(slot)) return false;
#endif
#else
    const bool listed = false;
#endif
    if (!listed && !parting.near_a.has(slot / 2)) return false;
    const Hull hull_b = hull_of(problem, env, pair_b(p));
    Edge first = edge_of(hull_of(problem, env, a), slot / 2);
    Vec axis = vec(Real(parting.axis[0]), Real(parting.axis[1]), Real(parting.axis[2]));
    axis = transposed(rotations[a], axis);
    // its normals are orthogonal to it
    Number along = plain(dot(axis, first.along)), length2 = plain(dot(first.along, first.along));
    if (along * along > Number(1 - PARALLEL * PARALLEL) * length2) return false;
    Number least = limit;
    int other = -1;
#if NOTED
    for (int i = 0; i < parting.met_count; i++) {
        const Met& one = parting.met[i];
        if (one.edge != slot / 2 || one.leaves != (slot % 2 == 1) || !(one.gap < least)) continue;
        const Number* n = one.normal;
        if (!(n[0] * plain(axis.x) + n[1] * plain(axis.y) + n[2] * plain(axis.z) > Number(PARALLEL))) continue;
        least = one.gap;
        other = parting.near_b.edge(one.other);
    }
#endif
    for (int n = 0; n < (listed ? 0 : parting.near_b.many(hull_b.ridges)); n++) {
        Crossing crossing;
        const Edge second = near_edge(parting, hull_b, n);
        if (edge_leaves(first, second) != (slot % 2 == 1) || surely_lean(first, second, Number(OUT_OF_FACE))) continue;
        if (!cross_edges(first, second, crossing) || !crossing.within) continue;
        if (crossing.lean > Number(OUT_OF_FACE) || !(plain(dot(crossing.normal, axis)) > Number(PARALLEL))) continue;
        if (!(plain(crossing.gap) < least)) continue;
        least = plain(crossing.gap);
        other = parting.near_b.edge(n);
    }
    if (other < 0) return false;
    Crossing crossing;
    cross_edges(first, edge_in(parting, hull_b, other), crossing);
    Vec point = first.start + crossing.place * first.along +
                (first.radius + crossing.place * first.widening + Number(0.5) * crossing.gap) * crossing.normal;
    facing.gap = crossing.gap;
    facing.sharp_gap = plain(crossing.gap);
    facing.normal = -(rotations[a] * crossing.normal);
    facing.point = env.bodies[a].position + rotations[a] * (point - env.constants[a].com);
    return true;
}
#endif

// Finds gap, normal and point of one slot of a pair of bodies: first come the spheres of b against the union of a, then
// those of a against the union of b, then edges. Returns false if the gap exceeds `limit`. `known` is what is known of the
// sphere's centre and the other body, and `edge` the edge of that body's hull that is nearest, if these were sought before.
__device__ bool face(const Problem& problem, const Environment& env, int p, int k, const Mat* rotations, Number limit,
                     const Parting& parting, const Nearness* known, Facing& facing, int edge = -1) {
#if HULLS
    int spheres_in_all = sphere_count(pair_a(p)) + sphere_count(pair_b(p));
    if (k >= spheres_in_all) {
        return face_edges(problem, env, p, k - spheres_in_all, rotations, limit, parting, facing);
    }
#endif
    bool second = k >= sphere_count(pair_b(p));
    int mine = second ? pair_a(p) : pair_b(p), other = second ? pair_b(p) : pair_a(p);
    Vec position = env.bodies[other].position;
    long long row = env.geometry + 4LL * problem.spheres[contact_start(p) + k];
    Vec center = env.bodies[mine].position + rotations[mine] * (problem.geometry.vector(row) - env.constants[mine].com);
    Real radius = problem.geometry.at(row + 3);
    Number around = size(center - position) - env.constants[other].reach - plain(radius) - Number(SMOOTHING_M);
    if (!(around < limit)) return false;
    Vec up = vec(Real(0), Real(0), Real(1));
#if TURNED
    up = env.turn * up;
#endif
    Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(other), sphere_count(other)};
    Vec local = transposed(rotations[other], center - position) + env.constants[other].com, outward;
    Real distance;
    Number nearest = Number(0);
    Number reached = limit + plain(radius);
#if HULLS
    if (face_count(other) > 0) {
        Hull hull = hull_of(problem, env, other);
        const int flat = second ? parting.on_b : parting.on_a;
        if (!distance_to_hull(hull, local, flat, edge, reached, distance, nearest, outward)) return false;
    } else
#endif
    {
        up = transposed(rotations[other], up);
        if (!union_distance(spheres, local, reached, up, known, distance, nearest, outward)) return false;
    }
    outward = rotations[other] * outward;
    facing.gap = distance - radius;
    facing.sharp_gap = nearest - plain(radius);
    facing.normal = second ? outward : -outward;
    facing.point = center - (radius + Number(0.5) * facing.gap) * outward;
    return true;
}
#endif
