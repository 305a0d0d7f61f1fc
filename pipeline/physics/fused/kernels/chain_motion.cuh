#if LINKS
INLINE Vec rotated(Quat q, Vec v) {
    Vec axis = vec(q.x, q.y, q.z), twice = Number(2) * cross(axis, v);
    return v + q.w * twice + cross(axis, twice);
}

// Poses of the links of all chains from those of the roots and the joints' values.
INLINE void place_links(const Chain& chain, const Real* values, Vec* positions, Quat* quats) {
    for (int l = 0; l < LINKS; l++) {
        int parent = link_parent[l], kind = link_kind[l];
        if (parent < 0) continue;
        const Joint& j = chain.joints[l];
        Vec offset = j.position;
        Quat turn = j.quat;
        if (kind == 2) turn = multiply(turn, quat_exp(values[link_joint[l]] * j.axis));
        if (kind == 3) offset = offset + rotated(turn, values[link_joint[l]] * j.axis);
        positions[l] = positions[parent] + rotated(quats[parent], offset);
        quats[l] = multiply(quats[parent], turn);
    }
}

// Velocities of the links from those of the roots and the joints' speeds.
INLINE void move_links(const Vec* axes, const Vec* positions, const Real* speeds, Vec* linear, Vec* angular) {
    for (int l = 0; l < LINKS; l++) {
        int parent = link_parent[l], kind = link_kind[l];
        if (parent < 0) continue;
        linear[l] = linear[parent] + cross(angular[parent], positions[l] - positions[parent]);
        angular[l] = angular[parent];
        if (kind == 2) angular[l] = angular[l] + speeds[link_joint[l]] * axes[l];
        if (kind == 3) linear[l] = linear[l] + speeds[link_joint[l]] * axes[l];
    }
}

struct Spatial {  // angular and linear part, about the root's origin
    Vec turning, moving;
};
INLINE Real along(const Spatial& a, const Spatial& b) { return dot(a.turning, b.turning) + dot(a.moving, b.moving); }
INLINE Vec unit_vector(int k) { return vec(Real(k == 0 ? 1 : 0), Real(k == 1 ? 1 : 0), Real(k == 2 ? 1 : 0)); }

// A configuration of all chains: world axes, each chain about its root's origin.
struct Configuration {
    Vec origins[LINKS];
    Spatial joints[LINKS];
#if HEAVY
    Vec coms[LINKS];
    Sym inertias[LINKS];
#endif
};

INLINE Spatial column_of(const Configuration& at, int dof) {
    int link = dof_link[dof];
    if (link_kind[link] != 1) return at.joints[link];
    int k = dof - link_dof[link];
    Spatial linear = {none(), unit_vector(k)}, angular = {unit_vector(k - 3), none()};
    return k < 3 ? linear : angular;
}

INLINE void configure(const Chain& chain, const Vec* positions, const Quat* quats, Configuration& at) {
    for (int l = 0; l < LINKS; l++) {
        const Joint& j = chain.joints[l];
        at.origins[l] = positions[l] - positions[link_root[l]];
        Mat R = matrix(quats[l]);
        Vec axis = R * j.axis;
        Spatial turning = {axis, cross(at.origins[l], axis)}, moving = {none(), axis};
        at.joints[l] = link_kind[l] == 2 ? turning : moving;
#if HEAVY
        if (link_light[l]) continue;
        at.coms[l] = at.origins[l] + R * j.com;
        at.inertias[l] = turned(R, j.inertia);
#endif
    }
}

#if HEAVY
INLINE Spatial momentum(const Chain& chain, const Configuration& at, int l, const Spatial& motion) {
    Vec c = at.coms[l], linear = chain.joints[l].mass * (motion.moving + cross(motion.turning, c));
    Spatial p = {at.inertias[l] * motion.turning + cross(c, linear), linear};
    return p;
}

// Adds the mass matrix to A, by composite bodies: mass, first moment and inertia of each link and all that it carries,
// about the root's origin.
INLINE void add_mass(const Chain& chain, const Configuration& at, Real* A) {
    Real mass[LINKS];
    Vec moment[LINKS];
    Sym inertia[LINKS];
    for (int l = 0; l < LINKS; l++) {
        if (link_light[l]) continue;
        Vec c = at.coms[l];
        mass[l] = chain.joints[l].mass;
        moment[l] = mass[l] * c;
        Sym S = at.inertias[l];
        Real m = mass[l];
        Sym about = {S.xx + m * (c.y * c.y + c.z * c.z), S.yy + m * (c.x * c.x + c.z * c.z),
                     S.zz + m * (c.x * c.x + c.y * c.y), S.xy - m * c.x * c.y, S.xz - m * c.x * c.z,
                     S.yz - m * c.y * c.z};
        inertia[l] = about;
    }
    for (int l = LINKS - 1; l >= 0; l--) {
        int parent = link_parent[l];
        if (parent < 0 || link_light[l]) continue;
        mass[parent] += mass[l];
        moment[parent] = moment[parent] + moment[l];
        Sym &to = inertia[parent], from = inertia[l];
        to.xx += from.xx;
        to.yy += from.yy;
        to.zz += from.zz;
        to.xy += from.xy;
        to.xz += from.xz;
        to.yz += from.yz;
    }
    for (int d = 0; d < DOFS; d++) {
        int l = dof_link[d];
        Spatial S = column_of(at, d);
        Spatial F = {inertia[l] * S.turning + cross(moment[l], S.moving),
                     mass[l] * S.moving + cross(S.turning, moment[l])};
        for (int k = 0; k < dof_depth[d]; k++) A[d * DEPTH + k] += along(column_of(at, dof_above[d * DEPTH + k]), F);
    }
}

#if EFFECTS
// Force and its moment about the root's origin that effects exert on a link; see `apply` for free bodies.
INLINE Spatial pushed(const Wrenches& w, const Chain& chain, const Configuration& at, int l, const Spatial& motion) {
    Vec c = at.coms[l], omega = motion.turning, u = motion.moving + cross(omega, c) - w.wind;
    Real drag = w.linear_drag + w.quadratic_drag * root(dot(u, u) + Real(Number(1e-24)));
    Vec force = chain.joints[l].mass * (w.acceleration - drag * u + w.magnus * cross(omega, u));
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
INLINE void bias_of(const Environment& env, const Configuration& at, const Vec* root_linear, const Vec* root_angular,
                    const Vec* root_lift, const Vec* root_twist, const Real* speed, Real* bias) {
    const Chain& chain = env.chain;
    Spatial velocity[LINKS], change[LINKS], force[LINKS];
    for (int d = 0; d < DOFS; d++) bias[d] = Real(0);
    for (int l = 0; l < LINKS; l++) {
        int parent = link_parent[l], dof = link_dof[l];
        if (link_light[l]) continue;
        if (parent < 0) {
            Vec v = root_linear[l], w = root_angular[l];
            if (link_kind[l] == 1) {
                v = vec(speed[dof], speed[dof + 1], speed[dof + 2]);
                w = vec(speed[dof + 3], speed[dof + 4], speed[dof + 5]);
            }
            Spatial V = {w, v}, A = {root_twist[l], root_lift[l] - cross(w, v)};
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
        Spatial P = momentum(chain, at, l, velocity[l]), F = momentum(chain, at, l, change[l]);
        Vec w = velocity[l].turning, v = velocity[l].moving;
        force[l].turning = F.turning + cross(w, P.turning) + cross(v, P.moving);
        force[l].moving = F.moving + cross(w, P.moving);
#if EFFECTS
        Spatial push = pushed(env.wrenches, chain, at, l, velocity[l]);
        force[l].turning = force[l].turning - push.turning;
        force[l].moving = force[l].moving - push.moving;
#endif
    }
    for (int l = LINKS - 1; l >= 0; l--) {
        int parent = link_parent[l], dof = link_dof[l];
        if (link_light[l]) continue;
        if (dof >= 0 && link_kind[l] != 1) bias[dof] = along(at.joints[l], force[l]);
        if (link_kind[l] == 1) {
            Vec f = force[l].moving, n = force[l].turning;
            Real numbers[6] = {f.x, f.y, f.z, n.x, n.y, n.z};
            for (int k = 0; k < 6; k++) bias[dof + k] = numbers[k];
        }
        if (parent >= 0) {
            force[parent].turning = force[parent].turning + force[l].turning;
            force[parent].moving = force[parent].moving + force[l].moving;
        }
    }
}
#endif

// Replaces A, given by rows of each coordinate and those above it, by the rows of the inverse of L, A = L^T L; L has the
// pattern of A (Featherstone, "Efficient factorization of the joint-space inertia matrix for branched kinematic trees",
// 2005).
INLINE void factor(Real* A) {
    for (int d = DOFS - 1; d >= 0; d--) {
        int last = dof_depth[d] - 1;
        Real* row = A + d * DEPTH;
        Real over = inverse_root(row[last]);
        row[last] = over;  // 1 / L_dd
        for (int k = 0; k < last; k++) row[k] = over * row[k];
        for (int i = 0; i < last; i++) {
            Real* to = A + dof_above[d * DEPTH + i] * DEPTH;
            for (int k = 0; k <= i; k++) to[k] -= row[i] * row[k];
        }
    }
    for (int d = 0; d < DOFS; d++) {
        int last = dof_depth[d] - 1;
        Real* row = A + d * DEPTH;
        Real inverse[DEPTH];
        for (int k = 0; k < last; k++) {
            Real sum = Real(0);
            for (int i = k; i < last; i++) sum += row[i] * A[dof_above[d * DEPTH + i] * DEPTH + k];
            inverse[k] = -(row[last] * sum);
        }
        for (int k = 0; k < last; k++) row[k] = inverse[k];
    }
}

// x = inverse(A) b
INLINE void solve_mass(const Real* inverse, const Real* b, Real* x) {
    Real y[DOFS];
    for (int d = 0; d < DOFS; d++) y[d] = Real(0);
    for (int d = 0; d < DOFS; d++) {
        for (int k = 0; k < dof_depth[d]; k++) y[dof_above[d * DEPTH + k]] += inverse[d * DEPTH + k] * b[d];
    }
    for (int d = 0; d < DOFS; d++) {
        Real sum = Real(0);
        for (int k = 0; k < dof_depth[d]; k++) sum += inverse[d * DEPTH + k] * y[dof_above[d * DEPTH + k]];
        x[d] = sum;
    }
}

// Target of a joint at a time, from the pieces of its chain's command: rows of 14 numbers, each with the time of the
// knot and the coefficients of two joints.
INLINE Real target_of(const Problem& problem, Environment& env, int c, int joint, Real time, bool first) {
    int number = chain_command[c], rows = (chain_joints[c] + 1) / 2;
    long long start = env.drives + 14LL * problem.drive_starts[number];
    const Input& input = problem.drives;
    int& cursor = env.chain.cursors[c];
    if (first) {
        int last = problem.drive_last[env.drive_last + number];
        while (cursor < last && input.value[start + 14LL * rows * (cursor + 1)] <= plain(time)) cursor++;
    }
    long long at = start + 14LL * rows * cursor;
    Real since = at_least(time - input.at(at), Number(0));
    at += 14LL * (joint / 2) + 1 + 5 * (joint % 2);
    Real value = input.at(at + 4);
    for (int k = 3; k >= 0; k--) value = value * since + input.at(at + k);
    return value;
}

// Speed that a limit of a joint asks for, as `prepare` does for a contact.
INLINE Real limit_target(Real gap, Real speed, Real h, Real stiffness, Real damping) {
    Real ahead = gap + h * speed;
    if (!(plain(gap) < Number(0) || plain(ahead) < Number(0))) return Real(Number(-1e30));
    Real closed = Real(1);
    if (plain(gap) > Number(0)) {
        Real way = h * (plain(speed) < Number(0) ? -speed : speed);
        closed = at_most(at_least(-ahead * reciprocal(at_least(way, Number(1e-12))), Number(0)), Number(1));
    }
    return speed - damping * closed * speed - stiffness * at_most(ahead, Number(0)) * reciprocal(h);
}

// Generalised velocity of the chains after the forces of a step, without contact, and the roots of A; then the
// velocities of the links at their poses of the start.
INLINE void kick(const Problem& problem, Environment& env, Real time_after, const Mat* rotations, Motion* motions,
                 Vec* velocities) {
    Chain& chain = env.chain;
    Real h = env.laws[0].step_s, half_h = Number(0.5) * h;
    Vec positions[LINKS], linear[LINKS], angular[LINKS], lift[LINKS], twist[LINKS];
    Quat quats[LINKS];
    Real speed[DOFS], force[DOFS], own[DOFS], still[DOFS];
#if HEAVY
    Real halfway[JOINTS + 1];
#endif
    for (int d = 0; d < DOFS; d++) force[d] = own[d] = still[d] = Real(0);
    for (int c = 0; c < CHAINS; c++) {
        int l = chain_root[c], b = link_body[l], dof = link_dof[l];
        Body& root = env.bodies[b];
        lift[l] = -env.gravity;
        twist[l] = none();
        linear[l] = root.velocity;
        angular[l] = root.spin;
#if DRIVEN
        if (drive_number(b) >= 0) {
            Body now = root;
            drive(problem, env, b, time_after);
            Real over = reciprocal(h);
            lift[l] = lift[l] + over * (root.velocity - now.velocity);
            twist[l] = over * (root.spin - now.spin);
            root = now;
        }
#endif
        positions[l] = root.position + half_h * root.velocity;
        quats[l] = normalized(multiply(quat_exp(half_h * root.spin), root.quat));
        if (dof >= 0) {
            Real numbers[6] = {root.velocity.x, root.velocity.y, root.velocity.z, root.spin.x, root.spin.y, root.spin.z};
            for (int k = 0; k < 6; k++) speed[dof + k] = numbers[k];
        }
        for (int i = 0; i < chain_joints[c]; i++) {
            int j = chain_joint[c] + i, d = joint_dof[j];
            const Servo& s = chain.servos[j];
            speed[d] = chain.speeds[j];
#if HEAVY
            halfway[j] = chain.values[j] + half_h * chain.speeds[j];
#endif
            still[d] = s.armature;
            own[d] = s.armature + h * s.damping;
            if (chain_command[c] < 0) continue;
            Real error = target_of(problem, env, c, i, time_after, i == 0) - chain.values[j];
            Real wanted = s.stiffness * error, pushed = wanted - h * s.stiffness * chain.speeds[j];
            Number size = plain(pushed) < Number(0) ? -plain(pushed) : plain(pushed);
            if (size > plain(s.torque_limit)) {
                force[d] = plain(pushed) < Number(0) ? -s.torque_limit : s.torque_limit;
            } else {
                own[d] = own[d] + h * h * s.stiffness;
                force[d] = wanted;
            }
        }
    }
    Real* A = chain.inverse;
    for (int d = 0; d < DOFS; d++) {
        for (int k = 0; k < dof_depth[d]; k++) A[d * DEPTH + k] = Real(0);
    }
    Real kept[DOFS], right[DOFS];
#if HEAVY
    place_links(chain, halfway, positions, quats);
    Configuration at;
    configure(chain, positions, quats, at);
    add_mass(chain, at, A);
#endif
    for (int d = 0; d < DOFS; d++) kept[d] = still[d] * speed[d] + h * force[d];
#if HEAVY
    for (int d = 0; d < DOFS; d++) {
        int last = dof_depth[d] - 1;
        for (int k = 0; k < last; k++) {
            int up = dof_above[d * DEPTH + k];
            kept[d] += A[d * DEPTH + k] * speed[up];
            kept[up] += A[d * DEPTH + k] * speed[d];
        }
        kept[d] += A[d * DEPTH + last] * speed[d];
    }
#endif
    for (int d = 0; d < DOFS; d++) A[d * DEPTH + dof_depth[d] - 1] += own[d];
    factor(A);
#if HEAVY
    Real bias[DOFS], mean[DOFS];
    for (int d = 0; d < DOFS; d++) mean[d] = speed[d];
    for (int pass = 0; pass < 2; pass++) {
        bias_of(env, at, linear, angular, lift, twist, mean, bias);
        for (int d = 0; d < DOFS; d++) right[d] = kept[d] - h * bias[d];
        solve_mass(A, right, chain.speed);
        for (int d = 0; d < DOFS; d++) mean[d] = Number(0.5) * (speed[d] + chain.speed[d]);
    }
#else
    for (int d = 0; d < DOFS; d++) right[d] = kept[d];
    solve_mass(A, right, chain.speed);
#endif
    // the links at the start of the step, with the velocities without contact
    for (int l = 0; l < LINKS; l++) {
        int b = link_body[l];
        positions[l] = env.bodies[b].position;
        chain.axes[l] = rotations[b] * chain.joints[l].axis;
        chain.known[l] = false;
    }
    Real moving[JOINTS + 1];
    for (int j = 0; j < JOINTS; j++) moving[j] = chain.speed[joint_dof[j]];
    for (int c = 0; c < CHAINS; c++) {
        int l = chain_root[c], d = link_dof[l];
        if (d < 0) continue;
        linear[l] = vec(chain.speed[d], chain.speed[d + 1], chain.speed[d + 2]);
        angular[l] = vec(chain.speed[d + 3], chain.speed[d + 4], chain.speed[d + 5]);
    }
    move_links(chain.axes, positions, moving, linear, angular);
    for (int l = 0; l < LINKS; l++) {
        int b = link_body[l];
        velocities[b] = motions[b].velocity = linear[l];
        motions[b].omega = angular[l];
        motions[b].columns = chain.columns + l * DEPTH;
        motions[b].depth = 0;
    }
    for (int d = 0; d < DOFS; d++) chain.moved[d] = Real(0);
    // limits: critically damped, with a natural time of LIMIT_TIME_S; see `coefficients`
    Real eta = Number(1 / LIMIT_TIME_S) * h, decay = exponential(-eta), twice = decay * decay;
    Real stiffness = Real(1) + twice - Number(2) * decay;
    Real damping = Number(0.5) * (Real(3) - Number(2) * decay - twice) - stiffness;
    chain.active = false;
    for (int j = 0; j < JOINTS; j++) {
        if (!chain.acts[j]) continue;
        const Servo& s = chain.servos[j];
        chain.lower[j] = limit_target(chain.values[j] - s.lower, moving[j], h, stiffness, damping);
        chain.upper[j] = limit_target(s.upper - chain.values[j], -moving[j], h, stiffness, damping);
        bool warm = false;
        for (int i = 0; i < 3; i++) warm = warm || plain(chain.impulses[3 * j + i]) != Number(0);
        if (warm || plain(s.friction) > Number(0) || plain(chain.lower[j]) > Number(-1e29) ||
            plain(chain.upper[j]) > Number(-1e29)) {
            chain.active = true;
        }
    }
}

// Makes the columns of a link that contact may move, at the pose of the start of the step.
INLINE void reveal(Environment& env, Motion* motions, int b) {
    int l = body_link(b);
    if (l < 0 || env.chain.known[l]) return;
    Chain& chain = env.chain;
    int depth = link_depth[l];
    Vec origin = env.bodies[b].position;
    Column* columns = chain.columns + l * DEPTH;
    for (int k = 0; k < depth; k++) columns[k].linear = columns[k].turning = none();
    for (int i = 0; i < depth; i++) {
        int d = link_above[l * DEPTH + i], from = dof_link[d], kind = link_kind[from];
        Column own;
        own.turning = none();
        if (kind == 1) {
            int k = d - link_dof[from];
            own.linear = k < 3 ? unit_vector(k) : cross(unit_vector(k - 3), origin - env.bodies[link_body[from]].position);
            if (k >= 3) own.turning = unit_vector(k - 3);
        } else if (kind == 2) {
            own.turning = chain.axes[from];
            own.linear = cross(own.turning, origin - env.bodies[link_body[from]].position);
        } else {
            own.linear = chain.axes[from];
        }
        for (int k = 0; k <= i; k++) {
            Real part = chain.inverse[d * DEPTH + k];
            columns[k].linear = columns[k].linear + part * own.linear;
            columns[k].turning = columns[k].turning + part * own.turning;
        }
    }
    chain.known[l] = true;
    motions[b].depth = depth;
}

// Adds an impulse and its moment about the link's origin to the mass-weighted motion of its chain.
INLINE void push_link(Chain& chain, int l, Vec impulse, Vec moment) {
    const Column* columns = chain.columns + l * DEPTH;
    for (int k = 0; k < link_depth[l]; k++) {
        chain.moved[link_above[l * DEPTH + k]] += dot(columns[k].linear, impulse) + dot(columns[k].turning, moment);
    }
}

// One pass over the limits and the dry friction of the joints, one after another.
INLINE void sweep_joints(Chain& chain, Real h) {
    for (int j = 0; j < JOINTS; j++) {
        if (!chain.acts[j]) continue;
        int d = joint_dof[j], depth = dof_depth[d];
        const Real* row = chain.inverse + d * DEPTH;
        Real speed = chain.speed[d], mobility = Real(0);
        for (int k = 0; k < depth; k++) {
            speed += row[k] * chain.moved[dof_above[d * DEPTH + k]];
            mobility += row[k] * row[k];
        }
        Real mass = reciprocal(mobility), *old = chain.impulses + 3 * j;
        Real below = at_least(old[0] + mass * (chain.lower[j] - speed), Number(0));
        speed += (below - old[0]) * mobility;
        Real above = at_least(old[1] + mass * (chain.upper[j] + speed), Number(0));
        speed -= (above - old[1]) * mobility;
        Real rubbed = old[2] - mass * speed, most = h * chain.servos[j].friction;
        if (plain(rubbed) > plain(most)) rubbed = most;
        if (plain(rubbed) < -plain(most)) rubbed = -most;
        Real change = (below - old[0]) - (above - old[1]) + (rubbed - old[2]);
        old[0] = below;
        old[1] = above;
        old[2] = rubbed;
        for (int k = 0; k < depth; k++) chain.moved[dof_above[d * DEPTH + k]] += change * row[k];
    }
}

// Mass-weighted motion of the chains under the impulses of their joints.
INLINE void push_joints(Chain& chain) {
    for (int d = 0; d < DOFS; d++) chain.moved[d] = Real(0);
    for (int j = 0; j < JOINTS; j++) {
        if (!chain.acts[j]) continue;
        int d = joint_dof[j];
        Real sum = chain.impulses[3 * j] - chain.impulses[3 * j + 1] + chain.impulses[3 * j + 2];
        for (int k = 0; k < dof_depth[d]; k++) {
            chain.moved[dof_above[d * DEPTH + k]] += sum * chain.inverse[d * DEPTH + k];
        }
    }
}

// Velocities that a link gains by the mass-weighted motion of its chain.
INLINE void gain(const Chain& chain, int l, Vec& linear, Vec& angular) {
    const Column* columns = chain.columns + l * DEPTH;
    for (int k = 0; k < link_depth[l]; k++) {
        Real moved = chain.moved[link_above[l * DEPTH + k]];
        linear = linear + moved * columns[k].linear;
        angular = angular + moved * columns[k].turning;
    }
}

// Moves the links to where the roots and the joints put them, with their velocities.
INLINE void spread(Environment& env) {
    const Chain& chain = env.chain;
    Vec positions[LINKS], linear[LINKS], angular[LINKS], axes[LINKS];
    Quat quats[LINKS];
    for (int c = 0; c < CHAINS; c++) {
        int l = chain_root[c];
        const Body& root = env.bodies[link_body[l]];
        positions[l] = root.position;
        quats[l] = root.quat;
        linear[l] = root.velocity;
        angular[l] = root.spin;
    }
    place_links(chain, chain.values, positions, quats);
    for (int l = 0; l < LINKS; l++) axes[l] = rotated(quats[l], chain.joints[l].axis);
    move_links(axes, positions, chain.speeds, linear, angular);
    for (int l = 0; l < LINKS; l++) {
        Body& body = env.bodies[link_body[l]];
        body.position = positions[l];
        body.quat = quats[l];
        body.velocity = linear[l];
        body.spin = angular[l];
    }
}

// Moves the chains to the end of the step, in which impulses changed their motion.
INLINE void settle(const Problem& problem, Environment& env, Real time_after) {
    Chain& chain = env.chain;
    Real h = env.laws[0].step_s, half_h = Number(0.5) * h;
    Real speed[DOFS];
    for (int d = 0; d < DOFS; d++) {
        speed[d] = chain.speed[d];
        for (int k = 0; k < dof_depth[d]; k++) {
            speed[d] += chain.inverse[d * DEPTH + k] * chain.moved[dof_above[d * DEPTH + k]];
        }
    }
    for (int j = 0; j < JOINTS; j++) {
        Real after = speed[joint_dof[j]];
        chain.values[j] = chain.values[j] + half_h * (chain.speeds[j] + after);
        chain.speeds[j] = after;
    }
    for (int c = 0; c < CHAINS; c++) {
        int l = chain_root[c], b = link_body[l], d = link_dof[l];
        Body& root = env.bodies[b];
#if DRIVEN
        if (drive_number(b) >= 0) drive(problem, env, b, time_after);
#endif
        if (d >= 0) {
            Vec velocity = vec(speed[d], speed[d + 1], speed[d + 2]), omega = vec(speed[d + 3], speed[d + 4], speed[d + 5]);
            root.position = root.position + half_h * (root.velocity + velocity);
            root.quat = normalized(multiply(quat_exp(half_h * root.spin), root.quat));
            root.quat = normalized(multiply(quat_exp(half_h * omega), root.quat));
            root.velocity = velocity;
            root.spin = omega;
        }
    }
    spread(env);
}
#endif
