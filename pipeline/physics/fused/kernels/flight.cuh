// Bodies without contact: effects in flight, and the motion over a step; formulas of `physics/rigid_body.py` and
// `physics/effects`.
// Moves a free body over one step, given velocity and angular momentum at its end: the position is advanced by the mean
// velocity, the rotation by the angular velocity of the mean angular momentum at the midpoint; by the paper's law (PUBLISHED)
// both by those at the end.
INLINE void advance(Body& body, const Weight& c, Vec omega_start, Vec velocity, Vec spin, Real h) {
    Real half_h = Number(0.5) * h;
    Quat half = normalized(multiply(body.quat, quat_exp(half_h * omega_start)));
#if PUBLISHED
    const Vec mean = spin, way = h * velocity;
#else
    const Vec mean = Real(Number(0.5)) * (body.spin + spin), way = half_h * (body.velocity + velocity);
#endif
    Vec omega = c.inverse_inertia * transposed(matrix(half), mean);
    body.quat = normalized(multiply(body.quat, quat_exp(h * omega)));
    body.position = body.position + way;
    body.velocity = velocity;
    body.spin = spin;
}

#if EFFECTS
#if SURFACE
// Adds the impulse of the adhesion of the ground to a body's velocity and angular momentum.
INLINE void stick(const Problem& problem, const Environment& env, const Lanes& lanes, int b, const Mat& rotation,
                  Vec& velocity, Vec& spin) {
    const Surface& s = env.laws[0].surface;
    if (absent(s.adhesion)) return;
    Real sum = Real(0), most = Real(0), each = reciprocal(s.reach);
    Vec arms = none();
    for (int k = lanes.lane; k < low_count(b); k += LANES) {
        Place row = env.geometry + 4LL * problem.spheres[low_start(b) + k];
        Vec arm = rotation * (problem.geometry.vector(row) - env.constants[b].com);
        arm.z = arm.z - problem.geometry.at(row + 3);
        Real far = each * (env.bodies[b].position.z - env.ground + arm.z);
        far = at_most(at_least(far, Number(0)), Number(1));
        Real near = square(Real(Number(1)) - far * far);
        sum += near;
        arms = arms + near * arm;
        most = choose(plain(near) > plain(most), near, most);
    }
    sum = lanes.sum(sum);
    arms = lanes.sum(arms);
    most = -lanes.least(-most);
    // the weights are normalised to that of the lowest sphere: the force does not depend on the number of spheres
    Real pull = -(env.laws[0].step_s * s.adhesion * most * reciprocal(at_least(sum, Number(1e-12))));
    velocity.z += weight(env, b).inverse_mass * pull * sum;
    spin.x += pull * arms.y;
    spin.y -= pull * arms.x;
}
#endif

#if MAGNETS
// Height of the lowest sphere of a body that can touch the ground, at least 0.
__device__ Real height_of(const Problem& problem, const Environment& env, const Lanes& lanes, int b,
                          const Mat& rotation) {
    Real lowest = Real(Number(1e30));
    for (int k = lanes.lane; k < low_count(b); k += LANES) {
        Place row = env.geometry + 4LL * problem.spheres[low_start(b) + k];
        Vec arm = problem.geometry.vector(row) - env.constants[b].com;
        Real low = dot(rotation.z, arm) - problem.geometry.at(row + 3);
        lowest = choose(plain(low) < plain(lowest), low, lowest);
    }
    return at_least(env.bodies[b].position.z - env.ground + lanes.least(lowest), Number(0));
}
#endif

INLINE void apply(const Problem& problem, const Environment& env, const Lanes& lanes, int b, const Mat& rotation,
                  Vec omega, Vec& velocity, Vec& spin) {
    const Wrenches& w = env.wrenches;
    const Body& body = env.bodies[b];
    Real h = env.laws[0].step_s;
    Vec a = w.acceleration + blown(w, omega, body.velocity - w.wind);
#if MAGNETS
    bool pulled = false;
    for (int i = 0; i < MAGNETS; i++) pulled = pulled || !absent(w.magnets[i]);
    Real height = pulled ? height_of(problem, env, lanes, b, rotation) : Real(0);
    for (int i = 0; i < MAGNETS; i++) {
        if (absent(w.magnets[i])) continue;
        a.z = a.z - w.magnets[i] * exponential(-height * reciprocal(w.magnet_ranges[i]));
    }
#endif
    velocity = velocity + h * a;
    spin = spin - h * w.spin_damping * body.spin;
#if TWISTED
    spin = spin + h * (rotation * solved(weight(env, b).inverse_inertia, transposed(rotation, w.twist)));
#endif
#if SURFACE
    stick(problem, env, lanes, b, rotation, velocity, spin);
#endif
}
#endif
