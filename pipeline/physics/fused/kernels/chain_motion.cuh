// How chains move: poses of links, equations of motion (composite bodies, recursive Newton-Euler), servos, limits and dry
// friction of joints; formulas of `physics/chains/dynamics.py` and `physics/chains/joint_rows.py`.
#if LINKS
INLINE Vec rotated(Quat q, Vec v) {
    Vec axis = vec(q.x, q.y, q.z), twice = Number(2) * cross(axis, v);
    return v + q.w * twice + cross(axis, twice);
}

// Poses of the links of all chains from those of the roots and the joints' values.
INLINE void place_links(const Chain& chain, const Lanes& lanes, const Real* values, Vec* positions, Quat* quats) {
    MOVED_LINKS(lanes, l) {  // each in its parent's frame
        int kind = link_kind[l];
        if (link_parent[l] < 0) continue;
        const Joint j = chain.joints[l];
        positions[l] = j.position;
        quats[l] = j.quat;
        if (kind == 2) quats[l] = multiply(j.quat, quat_exp(values[link_joint[l]] * j.axis));
        if (kind == 3) positions[l] = positions[l] + rotated(j.quat, values[link_joint[l]] * j.axis);
    }
    lanes.sync();
    DOWN_LINKS(lanes, l) {
        int parent = link_parent[l];
        if (parent < 0) continue;
        positions[l] = positions[parent] + rotated(quats[parent], positions[l]);
        quats[l] = multiply(quats[parent], quats[l]);
    }
}

// Velocities of the links from those of the roots and the joints' speeds.
INLINE void move_links(const Lanes& lanes, const Vec* axes, const Vec* positions, const Real* speeds, Vec* linear,
                       Vec* angular) {
    DOWN_LINKS(lanes, l) {
        int parent = link_parent[l], kind = link_kind[l];
        if (parent < 0) continue;
        linear[l] = linear[parent] + cross(angular[parent], positions[l] - positions[parent]);
        angular[l] = angular[parent];
        if (kind == 2) angular[l] = angular[l] + speeds[link_joint[l]] * axes[l];
        if (kind == 3) linear[l] = linear[l] + speeds[link_joint[l]] * axes[l];
    }
}

INLINE Real along(const Spatial& a, const Spatial& b) { return dot(a.turning, b.turning) + dot(a.moving, b.moving); }
INLINE Vec unit_vector(int k) { return vec(Real(k == 0 ? 1 : 0), Real(k == 1 ? 1 : 0), Real(k == 2 ? 1 : 0)); }

INLINE Spatial column_of(const Configuration& at, int dof) {
    int link = dof_link[dof];
    if (link_kind[link] != 1) return at.joints[link];
    int k = dof - link_dof[link];
    Spatial linear = {none(), unit_vector(k)}, angular = {unit_vector(k - 3), none()};
    return k < 3 ? linear : angular;
}

INLINE void configure(const Chain& chain, const Lanes& lanes, const Vec* positions, const Quat* quats,
                      Configuration& at) {
    MOVED_LINKS(lanes, l) {
        const Joint j = chain.joints[l];
        Vec origin = positions[l] - positions[link_root[l]];
        Mat R = matrix(quats[l]);
        Vec axis = R * j.axis;
        Spatial turning = {axis, cross(origin, axis)}, moving = {none(), axis};
        at.joints[l] = link_kind[l] == 2 ? turning : moving;
#if HEAVY
        if (link_light[l]) continue;
        at.masses[l] = j.mass;
        at.coms[l] = origin + R * j.com;
        at.inertias[l] = turned(R, j.inertia);
#endif
    }
    lanes.sync();
}

#if HEAVY
INLINE Spatial momentum(const Configuration& at, int l, const Spatial& motion) {
    Vec c = at.coms[l], linear = at.masses[l] * (motion.moving + cross(motion.turning, c));
    Spatial p = {at.inertias[l] * motion.turning + cross(c, linear), linear};
    return p;
}

// Adds the mass matrix to A, by composite bodies: mass, first moment and inertia of each link and all that it carries,
// about the root's origin.
INLINE void add_mass(Chain& chain, const Lanes& lanes, const Configuration& at, Real* A) {
    ROOM(Real, mass, LINKS, chain.room.kick.mass);
    ROOM(Vec, moment, LINKS, chain.room.kick.mass);
    ROOM(Sym, inertia, LINKS, chain.room.kick.mass);
    MOVED_LINKS(lanes, l) {
        if (link_light[l]) continue;
        Vec c = at.coms[l];
        mass[l] = at.masses[l];
        moment[l] = mass[l] * c;
        Sym S = at.inertias[l];
        Real m = mass[l];
        Sym about = {S.xx + m * (c.y * c.y + c.z * c.z), S.yy + m * (c.x * c.x + c.z * c.z),
                     S.zz + m * (c.x * c.x + c.y * c.y), S.xy - m * c.x * c.y, S.xz - m * c.x * c.z,
                     S.yz - m * c.y * c.z};
        inertia[l] = about;
    }
    lanes.sync();
    UP_LINKS(lanes, parent) {
        if (parent < FIRST_MOVED) continue;
        Sym& to = inertia[parent];
        INNER for (int i = child_start[parent]; i < child_start[parent + 1]; i++) {
            int l = link_child[i];
            mass[parent] += mass[l];
            moment[parent] = moment[parent] + moment[l];
            Sym from = inertia[l];
            to.xx += from.xx;
            to.yy += from.yy;
            to.zz += from.zz;
            to.xy += from.xy;
            to.xz += from.xz;
            to.yz += from.yz;
        }
    }
    DIVIDED(lanes, d, DOFS) {
        int l = dof_link[d];
        Spatial S = column_of(at, d);
        Spatial F = {inertia[l] * S.turning + cross(moment[l], S.moving),
                     mass[l] * S.moving + cross(S.turning, moment[l])};
        EACH_ABOVE(k, dof_depth[d]) A[d * DEPTH + k] += along(column_of(at, dof_above[d * DEPTH + k]), F);
    }
    lanes.sync();
}

#if EFFECTS
// Force and its moment about the root's origin that effects exert on a link; see `apply` for free bodies.
INLINE Spatial pushed(const Wrenches& w, const Configuration& at, int l, const Spatial& motion) {
    Vec c = at.coms[l], omega = motion.turning, u = motion.moving + cross(omega, c) - w.wind;
    Vec force = at.masses[l] * (w.acceleration + blown(w, omega, u));
    Vec torque = -(w.spin_damping * (at.inertias[l] * omega));
#if TWISTED
    torque = torque + at.inertias[l] * w.twist;
#endif
    Spatial all = {torque + cross(c, force), force};
    return all;
}
#endif

// Forces that keep the generalised velocity: Coriolis, centrifugal, against gravity, and against effects; recursive
// Newton-Euler.
INLINE void bias_of(Environment& env, const Lanes& lanes, const Configuration& at, const Vec* root_linear,
                    const Vec* root_angular, const Vec* root_lift, const Vec* root_twist, const Real* speed, Real* bias) {
    Chain& chain = env.chain;
    ROOM(Spatial, velocity, LINKS, chain.room.kick.force);
    ROOM(Spatial, force_on, LINKS, chain.room.kick.force);
    Spatial* const change = force_on;  // of the velocity, until the force is known
    DOWN_LINKS(lanes, l) {
        int parent = link_parent[l], dof = link_dof[l];
        if (link_light[l]) continue;
        if (parent < 0) {
            const int c = link_chain[l];
            Vec v = root_linear[c], w = root_angular[c];
            if (link_kind[l] == 1) {
                v = vec(speed[dof], speed[dof + 1], speed[dof + 2]);
                w = vec(speed[dof + 3], speed[dof + 4], speed[dof + 5]);
            }
            Spatial V = {w, v}, A = {root_twist[c], root_lift[c] - cross(w, v)};
            velocity[l] = V;
            change[l] = A;
        } else {
            velocity[l] = velocity[parent];
            change[l] = change[parent];
            if (dof >= 0) {
                Vec turning = speed[dof] * at.joints[l].turning, moving = speed[dof] * at.joints[l].moving;
                const Spatial& V = velocity[parent];
                change[l].turning = change[l].turning + cross(V.turning, turning);
                change[l].moving = change[l].moving + cross(V.turning, moving) + cross(V.moving, turning);
                velocity[l].turning = velocity[l].turning + turning;
                velocity[l].moving = velocity[l].moving + moving;
            }
        }
    }
    MOVED_LINKS(lanes, l) {
        if (link_light[l]) continue;
        Spatial P = momentum(at, l, velocity[l]), F = momentum(at, l, change[l]);
        Vec w = velocity[l].turning, v = velocity[l].moving;
        force_on[l].turning = F.turning + cross(w, P.turning) + cross(v, P.moving);
        force_on[l].moving = F.moving + cross(w, P.moving);
#if EFFECTS
        Spatial push = pushed(env.wrenches, at, l, velocity[l]);
        force_on[l].turning = force_on[l].turning - push.turning;
        force_on[l].moving = force_on[l].moving - push.moving;
#endif
    }
    lanes.sync();
    UP_LINKS(lanes, l) {
        int dof = link_dof[l];
        if (link_light[l] || l < FIRST_MOVED) continue;
        Spatial& all = force_on[l];
        INNER for (int i = child_start[l]; i < child_start[l + 1]; i++) {
            const Spatial& carried = force_on[link_child[i]];
            all.turning = all.turning + carried.turning;
            all.moving = all.moving + carried.moving;
        }
        if (dof >= 0 && link_kind[l] != 1) bias[dof] = along(at.joints[l], all);
        if (link_kind[l] == 1) {
            Vec f = all.moving, n = all.turning;
            Real numbers[6] = {f.x, f.y, f.z, n.x, n.y, n.z};
            INNER for (int k = 0; k < 6; k++) bias[dof + k] = numbers[k];
        }
    }
}
#endif

// Replaces A, given by rows of each coordinate and those above it, by the rows of the inverse of L, A = L^T L; L has the
// pattern of A (Featherstone, "Efficient factorization of the joint-space inertia matrix for branched kinematic trees",
// 2005).
INLINE void factor(const Lanes& lanes, Real* A) {
    UP_DOFS(lanes, d) {
        int last = dof_depth[d] - 1;
        Real* row = A + d * DEPTH;
        INNER for (int i = below_start[d + 1] - 1; i >= below_start[d]; i--) {
            const Real* from = A + dof_below[i] * DEPTH;
            EACH_ABOVE(k, last + 1) row[k] -= from[last] * from[k];
        }
        Real over = inverse_root(row[last]);
        row[last] = over;  // 1 / L_dd
        EACH_ABOVE(k, last) row[k] = over * row[k];
    }
    DOWN_DOFS(lanes, d) {
        int last = dof_depth[d] - 1;
        Real* row = A + d * DEPTH;
        INNER for (int k = 0; k < last; k++) {
            Real sum = Real(0);
            INNER for (int i = k; i < last; i++) sum += row[i] * A[dof_above[d * DEPTH + i] * DEPTH + k];
            row[k] = -(row[last] * sum);
        }
    }
}

// x = inverse(A) b
INLINE void solve_mass(Chain& chain, const Lanes& lanes, const Real* b, Real* x) {
    const Real* inverse = chain.inverse;
    ROOM(Real, y, DOFS, chain.room.kick);
    DIVIDED(lanes, d, DOFS) {
        int last = dof_depth[d] - 1;
        Real sum = inverse[d * DEPTH + last] * b[d];
        INNER for (int i = below_start[d]; i < below_start[d + 1]; i++) {
            sum += inverse[dof_below[i] * DEPTH + last] * b[dof_below[i]];
        }
        y[d] = sum;
    }
    lanes.sync();
    DIVIDED(lanes, d, DOFS) {
        Real sum = Real(0);
        EACH_ABOVE(k, dof_depth[d]) sum += inverse[d * DEPTH + k] * y[dof_above[d * DEPTH + k]];
        x[d] = sum;
    }
    lanes.sync();
}

// Target of a joint at a time, from the pieces of its chain's command: rows of SAMPLE_WIDTH numbers, each with the time of the
// knot and the coefficients of two joints.
INLINE Real target_of(const Problem& problem, const Environment& env, int c, int joint, Real time) {
    int number = chain_command[c], rows = (chain_joints[c] + 1) / 2;
    long long start = env.drives + SAMPLE_WIDTH * problem.drive_starts[number];
    const Input& input = problem.drives;
    long long at = start + SAMPLE_WIDTH * rows * env.chain.cursors[c];
    Real since = at_least(time - input.at(at), Number(0));
    at += SAMPLE_WIDTH * (joint / 2) + 1 + 5 * (joint % 2);
    Real value = input.at(at + 4);
    INNER for (int k = 3; k >= 0; k--) value = value * since + input.at(at + k);
    return value;
}

// Speed that a limit of a joint asks for, as `prepare` does for a contact; -1e30 where the joint does not reach it.
INLINE Real limit_target(Real gap, Real speed, Real h, Real stiffness, Real damping) {
    if (!(plain(gap) < Number(0) || plain(gap + h * speed) < Number(0))) return Real(Number(-1e30));
    return wanted_speed(gap, speed, h, reciprocal(h), stiffness, damping);
}

// Moves on in the command of a chain to the piece of a time.
INLINE void seek(const Problem& problem, Environment& env, int c, Real time) {
    int number = chain_command[c], rows = (chain_joints[c] + 1) / 2, last = problem.drive_last[env.drive_last + number];
    long long start = env.drives + SAMPLE_WIDTH * problem.drive_starts[number];
    int& cursor = env.chain.cursors[c];
    while (cursor < last && problem.drives.value[start + SAMPLE_WIDTH * rows * (cursor + 1)] <= plain(time)) cursor++;
}

// Sets the velocities of a link in a step, in which no contact is known to move it yet.
INLINE void carry(const Chain& chain, int l, Vec linear, Vec angular, Motion& motion) {
    motion.velocity = linear;
    motion.omega = angular;
#if !SHARED
    motion.columns = chain.columns + l * DEPTH;
    motion.depth = 0;
#endif
}

// Generalised velocity of the chains after the forces of a step, without contact, and the roots of A; then the
// velocities of the links at their poses of the start.
INLINE void kick(const Problem& problem, Environment& env, const Lanes& lanes, Real time_after, const Mat* rotations,
                 Motion* motions) {
    Chain& chain = env.chain;
    Real h = env.laws[0].step_s, half_h = Number(0.5) * h;
    ROOM(Vec, positions, LINKS, chain.room.kick.place);
    ROOM(Vec, linear, LINKS, chain.room.kick.place);
    ROOM(Vec, angular, LINKS, chain.room.kick.place);
    ROOM(Quat, quats, LINKS, chain.room.kick.place);
    ROOM(Vec, lift, CHAINS, chain.room.kick);
    ROOM(Vec, twist, CHAINS, chain.room.kick);
    ROOM(Vec, root_linear, CHAINS, chain.room.kick);
    ROOM(Vec, root_angular, CHAINS, chain.room.kick);
    ROOM(Real, first, DOFS, chain.room.kick);
    ROOM(Real, own, DOFS, chain.room.kick);
    ROOM(Real, kept, DOFS, chain.room.kick);
#if HEAVY
    ROOM(Real, halfway, JOINTS + 1, chain.room.kick);
#endif
    DIVIDED(lanes, d, DOFS) own[d] = kept[d] = Real(0);
    lanes.sync();
    DIVIDED(lanes, c, CHAINS) {
        int l = chain_root[c], b = link_body[l], dof = link_dof[l];
        Body& root = env.bodies[b];
        lift[c] = -env.gravity;
        twist[c] = none();
        root_linear[c] = root.velocity;
        root_angular[c] = root.spin;
#if DRIVEN
        if (drive_number(b) >= 0) {
            Body now = root;
            drive(problem, env, b, time_after);
            Real over = reciprocal(h);
            lift[c] = lift[c] + over * (root.velocity - now.velocity);
            twist[c] = over * (root.spin - now.spin);
            root = now;
        }
#endif
        positions[l] = root.position + half_h * root.velocity;
        quats[l] = normalized(multiply(quat_exp(half_h * root.spin), root.quat));
        if (dof >= 0) {
            Real numbers[6] = {root.velocity.x, root.velocity.y, root.velocity.z, root.spin.x, root.spin.y, root.spin.z};
            INNER for (int k = 0; k < 6; k++) first[dof + k] = numbers[k];
        }
        if (chain_command[c] >= 0) seek(problem, env, c, time_after);
    }
    lanes.sync();
    DIVIDED(lanes, j, JOINTS) {
        int d = joint_dof[j], c = joint_chain[j];
        const Servo s = chain.servos[j];
        first[d] = chain.speeds[j];
#if HEAVY
        halfway[j] = chain.values[j] + half_h * chain.speeds[j];
#endif
        own[d] = s.armature + h * s.damping;
        Real force = Real(0);
        if (chain_command[c] >= 0) {
            Real error = target_of(problem, env, c, j - chain_joint[c], time_after) - chain.values[j];
            Real wanted = s.stiffness * error, pushed = wanted - h * s.stiffness * chain.speeds[j];
            Number size = plain(pushed) < Number(0) ? -plain(pushed) : plain(pushed);
            if (size > plain(s.torque_limit)) {
                force = plain(pushed) < Number(0) ? -s.torque_limit : s.torque_limit;
            } else {
                own[d] = own[d] + h * h * s.stiffness;
                force = wanted;
            }
        }
        kept[d] = s.armature * first[d] + h * force;
    }
    Real* A = chain.inverse;
    DIVIDED(lanes, d, DOFS) {
        INNER for (int k = 0; k < dof_depth[d]; k++) A[d * DEPTH + k] = Real(0);
    }
    lanes.sync();
#if HEAVY
    place_links(chain, lanes, halfway, positions, quats);
    ROOM(Configuration, at, 1, chain.room.kick);
    configure(chain, lanes, positions, quats, at[0]);
    add_mass(chain, lanes, at[0], A);
#endif
#if HEAVY
    DIVIDED(lanes, d, DOFS) {
        int last = dof_depth[d] - 1;
        EACH_ABOVE(k, last + 1) kept[d] += A[d * DEPTH + k] * first[dof_above[d * DEPTH + k]];
        INNER for (int i = below_start[d]; i < below_start[d + 1]; i++) {
            kept[d] += A[dof_below[i] * DEPTH + last] * first[dof_below[i]];
        }
    }
    lanes.sync();
#endif
    DIVIDED(lanes, d, DOFS) A[d * DEPTH + dof_depth[d] - 1] += own[d];
    lanes.sync();
    factor(lanes, A);
#if HEAVY
    ROOM(Real, bias, DOFS, chain.room.kick);
    ROOM(Real, mean, DOFS, chain.room.kick);
    DIVIDED(lanes, d, DOFS) mean[d] = first[d];
    lanes.sync();
    KEEP_LOOP
    for (int pass = 0; pass < 2; pass++) {
        bias_of(env, lanes, at[0], root_linear, root_angular, lift, twist, mean, bias);
        DIVIDED(lanes, d, DOFS) bias[d] = kept[d] - h * bias[d];
        lanes.sync();
        solve_mass(chain, lanes, bias, chain.speed);
        DIVIDED(lanes, d, DOFS) mean[d] = Number(0.5) * (first[d] + chain.speed[d]);
        lanes.sync();
    }
#else
    solve_mass(chain, lanes, kept, chain.speed);
#endif
    // the links at the start of the step, with the velocities without contact
    MOVED_LINKS(lanes, l) {
        positions[l] = env.bodies[link_body[l]].position;
        chain.axes[l] = rotations[link_body[l]] * chain.joints[l].axis;
        chain.known[l] = false;
    }
    ROOM(Real, moving, JOINTS + 1, chain.room.kick);
    DIVIDED(lanes, j, JOINTS) moving[j] = chain.speed[joint_dof[j]];
    DIVIDED(lanes, c, CHAINS) {
        int l = chain_root[c], b = link_body[l], d = link_dof[l];
        positions[l] = env.bodies[b].position;
        linear[l] = d < 0 ? root_linear[c] : vec(chain.speed[d], chain.speed[d + 1], chain.speed[d + 2]);
        angular[l] = d < 0 ? root_angular[c] : vec(chain.speed[d + 3], chain.speed[d + 4], chain.speed[d + 5]);
        chain.known[l] = false;
        carry(chain, l, linear[l], angular[l], motions[b]);
    }
    lanes.sync();
    move_links(lanes, chain.axes, positions, moving, linear, angular);
    MOVED_LINKS(lanes, l) carry(chain, l, linear[l], angular[l], motions[link_body[l]]);
    DIVIDED(lanes, d, DOFS) chain.moved[d] = Real(0);
    // limits: critically damped, with a natural time of LIMIT_TIME_S; see `coefficients`
    Real eta = Number(1 / LIMIT_TIME_S) * h, decay = exponential(-eta), twice = decay * decay;
    Real stiffness = Real(1) + twice - Number(2) * decay;
    Real damping = Number(0.5) * (Real(3) - Number(2) * decay - twice) - stiffness;
    if (lanes.writes()) chain.active = false;
    lanes.sync();
    DIVIDED(lanes, j, JOINTS) {
        chain.busy[j] = false;
        if (!chain.acts[j]) continue;
        const Servo s = chain.servos[j];
        chain.lower[j] = limit_target(chain.values[j] - s.lower, moving[j], h, stiffness, damping);
        chain.upper[j] = limit_target(s.upper - chain.values[j], -moving[j], h, stiffness, damping);
        bool warm = false;
        INNER for (int i = 0; i < 3; i++) warm = warm || plain(chain.impulses[3 * j + i]) != Number(0);
        chain.most[j] = h * s.friction;
        if (warm || plain(s.friction) > Number(0) || plain(chain.lower[j]) > Number(-1e29) ||
            plain(chain.upper[j]) > Number(-1e29)) {
            chain.busy[j] = chain.active = true;
            const Real* row = chain.inverse + joint_dof[j] * DEPTH;
            Real mobility = Real(0);
            EACH_ABOVE(k, dof_depth[joint_dof[j]]) mobility += row[k] * row[k];
            chain.mobility[j] = mobility;
            chain.masses[j] = reciprocal(mobility);
        }
    }
    lanes.sync();
}

// Velocity of a point that a link carries, and its angular velocity, by one coordinate alone.
INLINE Column single_column(const Chain& chain, const Body* bodies, int d, Vec point) {
    int from = dof_link[d], kind = link_kind[from];
    Vec arm = point - bodies[link_body[from]].position;
    if (kind == 1) {
        int k = d - link_dof[from];
        Column linear = {unit_vector(k), none()}, turning = {cross(unit_vector(k - 3), arm), unit_vector(k - 3)};
        return k < 3 ? linear : turning;
    }
    Vec axis = chain.axes[from];
    Column hinge = {cross(axis, arm), axis}, slide = {axis, none()};
    return kind == 2 ? hinge : slide;
}

// Sum of the impulses of a joint: of its lower and upper limit, and of its dry friction.
INLINE Real joint_impulse(const Chain& chain, int j) {
    return chain.impulses[3 * j] - chain.impulses[3 * j + 1] + chain.impulses[3 * j + 2];
}

#if SHARED
// Makes the columns of all links that contact may move, at the pose of the start of the step.
INLINE void reveal_links(Chain& chain, const Lanes& lanes, const Body* bodies) {
    DIVIDED(lanes, column, COLUMNS) {
        const int l = column_link[column], k = column - column_start[l], depth = link_depth[l];
        if (!chain.known[l]) continue;
        const Vec origin = bodies[link_body[l]].position;
        Column sum = {none(), none()};
        INNER for (int i = k; i < depth; i++) {
            const int d = link_above[l * DEPTH + i];
            const Column single = single_column(chain, bodies, d, origin);
            Real part = chain.inverse[d * DEPTH + k];
            sum.linear = sum.linear + part * single.linear;
            sum.turning = sum.turning + part * single.turning;
        }
        chain.room.collide.columns[column] = sum;
    }
    lanes.sync();
}

// The same of a coordinate; those of a free root have no joint.
INLINE Real dof_impulse(const Chain& chain, int d) {
    const int j = dof_joint[d];
    return j < 0 ? Real(0) : joint_impulse(chain, j);
}

#if GATHERED
INLINE Number of_other(Number mine, int apart) { return __shfl_xor_sync(FULL, mine, apart, WARP); }
#if DUAL
INLINE Real of_other(Real mine, int apart) {
    return Real(of_other(mine.value, apart), of_other(mine.tangent, apart));
}
#endif
const int SHARERS = 16;  // lanes that sum up one coordinate
#endif

// Mass-weighted motion of the chains under the impulses of their joints and on their links; each coordinate is summed
// up by one lane, or by some where few links are touched and many moved.
INLINE void push_chains(Chain& chain, const Lanes& lanes) {
    const CollideRoom& room = chain.room.collide;
#if GATHERED
    const int parts = (DOFS * SHARERS + WARP - 1) / WARP * WARP;  // whole warps
    KEEP_LOOP
    for (int part = lanes.lane; part < parts; part += LANES) {
        const int d = part / SHARERS < DOFS ? part / SHARERS : DOFS - 1, share = part % SHARERS, last = dof_depth[d] - 1;
        Real sum = Real(0);
        const int joints = chain.active ? 1 + below_start[d + 1] - below_start[d] : 0;
        INNER for (int i = share; i < joints; i += SHARERS) {
            const int from = i == 0 ? d : dof_below[below_start[d] + i - 1];
            sum += chain.inverse[from * DEPTH + last] * dof_impulse(chain, from);
        }
        INNER for (int r = share; r < room.reached_count; r += SHARERS) {
            const int l = room.reached[r];
            if (l >= LINKS || link_depth[l] <= last || link_above[l * DEPTH + last] != d) continue;
            const Column& column = room.columns[column_start[l] + last];
            sum += dot(column.linear, room.pushes[l]) + dot(column.turning, room.moments[l]);
        }
        for (int apart = SHARERS / 2; apart > 0; apart /= 2) sum += of_other(sum, apart);
        if (share == 0 && part / SHARERS < DOFS) chain.moved[d] = sum;
    }
#else
    DIVIDED(lanes, d, DOFS) {
        const int last = dof_depth[d] - 1;
        Real sum = chain.active ? chain.inverse[d * DEPTH + last] * dof_impulse(chain, d) : Real(0);
        if (chain.active) {
            INNER for (int i = below_start[d]; i < below_start[d + 1]; i++) {
                sum += chain.inverse[dof_below[i] * DEPTH + last] * dof_impulse(chain, dof_below[i]);
            }
        }
        INNER for (int i = moved_start[d]; i < moved_start[d + 1]; i++) {
            const int l = moved_link[i];
            if (!chain.known[l]) continue;
            const Column& column = room.columns[column_start[l] + last];
            sum += dot(column.linear, room.pushes[l]) + dot(column.turning, room.moments[l]);
        }
        chain.moved[d] = sum;
    }
#endif
    lanes.sync();
}
#else
// Makes the columns of a link that contact may move, where it is wanted, at the pose of the start of the step.
INLINE void reveal(Environment& env, const Lanes& lanes, Motion* motions, int b, bool wanted) {
    int l = body_link(b);
    if (l < 0) return;
    Chain& chain = env.chain;
    if (chain.known[l]) wanted = false;
    if (!lanes.any(wanted)) return;
    int depth = wanted ? link_depth[l] : 0;
    Vec origin = env.bodies[b].position;
    Column* columns = chain.columns + l * DEPTH;
    Column single[DEPTH];  // each coordinate alone
    for (int i = 0; i < depth; i++) single[i] = single_column(chain, env.bodies, link_above[l * DEPTH + i], origin);
    for (int k = 0; k < depth; k++) {
        Column sum = {none(), none()};
        for (int i = k; i < depth; i++) {
            Real part = chain.inverse[link_above[l * DEPTH + i] * DEPTH + k];
            sum.linear = sum.linear + part * single[i].linear;
            sum.turning = sum.turning + part * single[i].turning;
        }
        columns[k] = sum;
    }
    if (wanted) {
        chain.known[l] = true;
        motions[b].depth = depth;
    }
}

// Adds an impulse and its moment about the link's origin to the mass-weighted motion of its chain.
INLINE void push_link(Chain& chain, int l, Vec impulse, Vec moment) {
    const Column* columns = chain.columns + l * DEPTH;
    for (int k = 0; k < link_depth[l]; k++) {
        chain.moved[link_above[l * DEPTH + k]] += dot(columns[k].linear, impulse) + dot(columns[k].turning, moment);
    }
}

// Mass-weighted motion of the chains under the impulses of their joints.
INLINE void push_joints(Chain& chain) {
    for (int d = 0; d < DOFS; d++) chain.moved[d] = Real(0);
    if (!chain.active) return;  // all impulses are zero
    for (int j = 0; j < JOINTS; j++) {
        if (!chain.busy[j]) continue;
        int d = joint_dof[j];
        Real sum = joint_impulse(chain, j);
        for (int k = 0; k < dof_depth[d]; k++) {
            chain.moved[dof_above[d * DEPTH + k]] += sum * chain.inverse[d * DEPTH + k];
        }
    }
}
#endif

// Changes the impulses of a joint by one iteration at its present speed; returns the sum of the changes.
INLINE Real sweep_joint(Chain& chain, int j, Real speed) {
    const Real mobility = chain.mobility[j], mass = chain.masses[j];
    Real* old = chain.impulses + 3 * j;
    Real below = at_least(old[0] + mass * (chain.lower[j] - speed), Number(0));
    speed += (below - old[0]) * mobility;
    Real above = at_least(old[1] + mass * (chain.upper[j] + speed), Number(0));
    speed -= (above - old[1]) * mobility;
    Real rubbed = old[2] - mass * speed, most = chain.most[j];
    if (plain(rubbed) > plain(most)) rubbed = most;
    if (plain(rubbed) < -plain(most)) rubbed = -most;
    Real change = (below - old[0]) - (above - old[1]) + (rubbed - old[2]);
    old[0] = below;
    old[1] = above;
    old[2] = rubbed;
    return change;
}

// One pass over the limits and the dry friction of the joints, one after another in each branch.
#if GATHERED && SERIAL  // each coordinate of a branch is moved by all before it: they stay in registers
INLINE void sweep_joints(Chain& chain, const Lanes& lanes) {
    DIVIDED(lanes, branch, BRANCH_COUNT) {
        const int first = branch_start[branch], count = branch_start[branch + 1] - first;
        Real moved[DEPTH];
        SPREAD for (int k = 0; k < DEPTH; k++) {
            moved[k] = k < count ? chain.moved[joint_dof[branch_joint[first + k]]] : Real(0);
        }
        SPREAD for (int k = 0; k < DEPTH; k++) {
            if (k >= count) continue;
            const int j = branch_joint[first + k], d = joint_dof[j];
            if (!chain.busy[j]) continue;
            Real row[DEPTH], speed = chain.speed[d];
            SPREAD for (int i = 0; i <= k; i++) row[i] = chain.inverse[d * DEPTH + i];
            SPREAD for (int i = 0; i <= k; i++) speed += row[i] * moved[i];
            const Real change = sweep_joint(chain, j, speed);
            SPREAD for (int i = 0; i <= k; i++) moved[i] += change * row[i];
        }
        SPREAD for (int k = 0; k < DEPTH; k++) {
            if (k < count) chain.moved[joint_dof[branch_joint[first + k]]] = moved[k];
        }
    }
}
#else
INLINE void sweep_joints(Chain& chain, const Lanes& lanes) {
    BRANCHES(lanes, j) {
        if (!chain.busy[j]) continue;
        int d = joint_dof[j], depth = dof_depth[d];
        const Real* row = chain.inverse + d * DEPTH;
        Real speed = chain.speed[d];
        EACH_ABOVE(k, depth) speed += row[k] * chain.moved[dof_above[d * DEPTH + k]];
        const Real change = sweep_joint(chain, j, speed);
        EACH_ABOVE(k, depth) chain.moved[dof_above[d * DEPTH + k]] += change * row[k];
    }
}
#endif

// Velocities that a link gains by the mass-weighted motion of its chain.
INLINE void gain(const Chain& chain, int l, Vec& linear, Vec& angular) {
#if SHARED
    const Column* columns = chain.room.collide.columns + column_start[l];
#else
    const Column* columns = chain.columns + l * DEPTH;
#endif
    EACH_ABOVE(k, link_depth[l]) {
        Real moved = chain.moved[link_above[l * DEPTH + k]];
        linear = linear + moved * columns[k].linear;
        angular = angular + moved * columns[k].turning;
    }
}

// Moves the links to where the roots and the joints put them, with their velocities.
INLINE void spread(Environment& env, const Lanes& lanes) {
    Chain& chain = env.chain;
    ROOM(Vec, positions, LINKS, chain.room.settle.place);
    ROOM(Vec, linear, LINKS, chain.room.settle.place);
    ROOM(Vec, angular, LINKS, chain.room.settle.place);
    ROOM(Quat, quats, LINKS, chain.room.settle.place);
    ROOM(Vec, axes, LINKS, chain);
    DIVIDED(lanes, c, CHAINS) {
        int l = chain_root[c];
        const Body& root = env.bodies[link_body[l]];
        positions[l] = root.position;
        quats[l] = root.quat;
        linear[l] = root.velocity;
        angular[l] = root.spin;
    }
    lanes.sync();
    place_links(chain, lanes, chain.values, positions, quats);
    MOVED_LINKS(lanes, l) axes[l] = rotated(quats[l], chain.joints[l].axis);
    lanes.sync();
    move_links(lanes, axes, positions, chain.speeds, linear, angular);
    MOVED_LINKS(lanes, l) {
        Body& body = env.bodies[link_body[l]];
        body.position = positions[l];
        body.quat = quats[l];
        body.velocity = linear[l];
        body.spin = angular[l];
    }
    lanes.sync();
}

// Moves the chains to the end of the step, in which impulses changed their motion.
INLINE void settle(const Problem& problem, Environment& env, const Lanes& lanes, Real time_after) {
    Chain& chain = env.chain;
    Real h = env.laws[0].step_s, half_h = Number(0.5) * h;
    ROOM(Real, first, DOFS, chain.room.settle);
    DIVIDED(lanes, d, DOFS) {
        Real sum = chain.speed[d];
        EACH_ABOVE(k, dof_depth[d]) sum += chain.inverse[d * DEPTH + k] * chain.moved[dof_above[d * DEPTH + k]];
        first[d] = sum;
    }
    lanes.sync();
    DIVIDED(lanes, j, JOINTS) {
        Real after = first[joint_dof[j]];
        chain.values[j] = chain.values[j] + half_h * (chain.speeds[j] + after);
        chain.speeds[j] = after;
    }
    DIVIDED(lanes, c, CHAINS) {
        int l = chain_root[c], b = link_body[l], d = link_dof[l];
        Body& root = env.bodies[b];
#if DRIVEN
        if (drive_number(b) >= 0) drive(problem, env, b, time_after);
#endif
        if (d >= 0) {
            Vec velocity = vec(first[d], first[d + 1], first[d + 2]), omega = vec(first[d + 3], first[d + 4], first[d + 5]);
            root.position = root.position + half_h * (root.velocity + velocity);
            root.quat = normalized(multiply(quat_exp(half_h * root.spin), root.quat));
            root.quat = normalized(multiply(quat_exp(half_h * omega), root.quat));
            root.velocity = velocity;
            root.spin = omega;
        }
    }
    lanes.sync();
    spread(env, lanes);
}
#endif
