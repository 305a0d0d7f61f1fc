// One contact: what it asks for by its law, how bodies respond to its impulse, and the change of that in an iteration;
// formulas of `physics/contact_law.py` and `physics/impulse_solver.py`.
struct Law {  // of a pair of materials, in a step
    Real step_s, inverse_step, stiffness, damping, friction;
#if SURFACE
    Surface surface;
#endif
};

struct Response {  // of a body to impulses: inverse mass and inertia, 0 if it is not free
    Real inverse_mass;
    Sym inverse_inertia;  // world axes
#if LINKS
    const Column* columns;  // of a link of a chain, `depth` of them
    int depth;
#endif
};

struct Moving : Velocities, Response {};

// What is kept of each body in a step. Where lanes share one copy of it, responses are made when they are needed: those
// of most bodies are not, as they are links that nothing touches.
#if SHARED
typedef Velocities Motion;
typedef const Chain& Responses;
#define RESPONSES(env, motions) (env).chain
INLINE Response response(const Chain& chain, int b) {
    const int l = body_link(b);
    Response r = {Real(0), no_inertia(), 0, 0};
    if (is_free(b)) {
        r.inverse_mass = chain.free_masses[FREE(b)];
        r.inverse_inertia = chain.free_inertias[FREE(b)];
    } else if (l >= 0 && chain.known[l]) {
        r.columns = chain.room.collide.columns + column_start[l];
        r.depth = link_depth[l];
    }
    return r;
}
INLINE Moving moving(const Chain& chain, const Motion* motions, int b) {
    Moving all;
    static_cast<Velocities&>(all) = motions[b];
    static_cast<Response&>(all) = response(chain, b);
    return all;
}
#else
typedef Moving Motion;
typedef const Motion* Responses;
#define RESPONSES(env, motions) motions
INLINE const Moving& response(const Motion* motions, int b) { return motions[b]; }
INLINE const Moving& moving(const Motion* motions, const Motion*, int b) { return motions[b]; }
#endif

INLINE Real friction_of(const Law& law, const Contact& c) {
#if SURFACE || LAWS > 1
    return c.friction;
#else
    return law.friction;
#endif
}

INLINE Real mobility_trace(const Response& m, Vec arm) {
    return Number(3) * m.inverse_mass + trace(m.inverse_inertia) * dot(arm, arm) - dot(arm, m.inverse_inertia * arm);
}

#if LINKS
// Adds what a body's point moves along a direction by an impulse along it, and the sum of that over three directions.
INLINE void add_mobility(const Response& m, Vec arm, Vec normal, Real& inverse_mass, Real& trace_of) {
    Vec turn = cross(arm, normal);
    inverse_mass += m.inverse_mass + dot(turn, m.inverse_inertia * turn);
    trace_of += mobility_trace(m, arm);
    EACH_ABOVE(k, m.depth) {
        Vec moved = m.columns[k].linear + cross(m.columns[k].turning, arm);
        inverse_mass += square(dot(normal, moved));
        trace_of += dot(moved, moved);
    }
}

// Velocity and angular velocity of a body by an impulse along a direction, with its moment.
INLINE void response_of(const Response& m, Vec normal, Vec turn, Vec& linear, Vec& angular) {
    linear = m.inverse_mass * normal;
    angular = m.inverse_inertia * turn;
    EACH_ABOVE(k, m.depth) {
        Real along = dot(m.columns[k].linear, normal) + dot(m.columns[k].turning, turn);
        linear = linear + along * m.columns[k].linear;
        angular = angular + along * m.columns[k].turning;
    }
}
#endif

// Speed at which a gap has to change by the end of a step, given the gap [m or rad] and its speed without contact: that
// of a spring and a damper. The damper acts for the share of the step in which the gap is closed.
INLINE Real wanted_speed(Real gap, Real speed, Real step_s, Real inverse_step, Real stiffness, Real damping) {
    Real ahead = gap + step_s * speed, closed = Real(1);
    Flag apart = plain(gap) > Number(0);
    if (some(apart)) {
        Real way = step_s * choose(plain(speed) < Number(0), -speed, speed);
        Real share = at_most(at_least(-ahead * reciprocal(at_least(way, Number(1e-12))), Number(0)), Number(1));
        closed = choose(apart, share, closed);
    }
    return speed - damping * closed * speed - stiffness * at_most(ahead, Number(0)) * inverse_step;
}

// The same by the law of a contact.
INLINE Real aim(const Law& law, Real gap, Real speed) {
    Real stiffness = law.stiffness, damping = law.damping;
#if SURFACE
    response(law.surface, law.step_s, speed, stiffness, damping);
#endif
    return wanted_speed(gap, speed, law.step_s, law.inverse_step, stiffness, damping);
}

#if SURFACE && PAIRED
// The same of a contact that keeps what its law is at the speed at which it meets.
INLINE Real aim(const Law& law, const Contact& c, Real speed) {
    return wanted_speed(c.gap, speed, law.step_s, law.inverse_step, c.stiffness, c.damping);
}
#endif

// Sets the target velocity of a contact and returns whether it touches. `stop_n` and `stop_t` temporarily hold its
// effective mass and its tangential mobility, until `share_out` replaces them. `weight` is its weight among redundant
// contacts.
INLINE Flag prepare(Contact& c, const Law& law, Real gap, Real speed, Real inverse_mass, Real mobility, Real& weight) {
    Real ahead = gap + law.step_s * speed;
    weight = Real(0);
#if LAWS > 1
    c.friction = law.friction;
#endif
    Flag touches = (plain(gap) < Number(0)) | (plain(ahead) < Number(0));
#if LINKS
    touches = touches & (plain(inverse_mass) > Number(IMMOVABLE));
#endif
    if (!some(touches)) return touches;
    Real depth = choose(plain(ahead) < plain(gap), -ahead, -gap);
    weight = choose(touches, at_most(at_least(Number(1.0 / ONSET_M) * depth, Number(0)), Number(1)), weight);
#if SURFACE && PAIRED
    response(law.surface, law.step_s, speed, c.stiffness, c.damping);
#endif
    c.target = aim(law, gap, speed);
    c.stop_n = reciprocal(inverse_mass);
    c.stop_t = mobility - inverse_mass;
#if LINKS
    Real least = Number(LEAST_ACROSS) * inverse_mass;
    c.stop_t = choose(plain(c.stop_t) > plain(least), c.stop_t, least);
#endif
    c.impulse = none();
#if PAIRED
    c.gap = gap;
#endif
    return touches;
}

// Distributes the effective mass among redundant contacts; `total` is the sum of their weights times their redundancy.
INLINE void share_out(Contact& c, Real total, Real weight) {
    const Real tiny = Real(Number(1e-9));
    Real share = (weight + tiny) * reciprocal(choose(plain(total) > plain(weight), total, weight) + tiny);
    c.stop_t = share * reciprocal(c.stop_t);
    c.stop_n = share * c.stop_n;
}

// Returns the impulse of a contact after one iteration of projected Gauss-Seidel, given the relative velocity.
INLINE Vec swept(const Contact& c, const Law& law, Vec relative) {
#if PAIRED
    Real speed = dot(relative, c.normal), before = dot(c.impulse, c.normal);
    Vec wanted = (c.impulse - before * c.normal) - c.stop_t * (relative - speed * c.normal);
#if SURFACE
    wanted = wanted - c.steady;
#endif
    Real wanted2 = dot(wanted, wanted);
#else
    Real speed = relative.z, before = c.impulse.z;
    Real x = c.impulse.x - c.stop_t * relative.x, y = c.impulse.y - c.stop_t * relative.y;
#if SURFACE
    x -= c.steady_x;
    y -= c.steady_y;
#endif
#if !ELLIPTIC
    Real wanted2 = x * x + y * y;
#endif
#endif
    Real along = at_least(before + c.stop_n * (c.target - speed), Number(0));
#if ELLIPTIC
    put_in(c.ellipse, along, x, y);
    return vec(x + c.steady_x, y + c.steady_y, along);
#else
    Real most = friction_of(law, c) * along;
#if HOST
    // where the contact sticks, a predicted branch takes the root and the division out of the chain of iterations
    Flag sticks = plain(wanted2) < Number(1 - 1e-6) * plain(most) * plain(most) - Number(1e-24);
#else
    const Flag sticks = false;
#endif
    // the tiny number keeps the derivative of a contact without impulses finite
    Real scale = Real(1);
    if (!every(sticks)) scale = choose(sticks, scale, most * inverse_root(wanted2 + Real(Number(1e-24))));
    scale = at_most(scale, Number(1));
#if PAIRED && SURFACE
    return along * c.normal + scale * wanted + c.steady;
#elif PAIRED
    return along * c.normal + scale * wanted;
#elif SURFACE
    return vec(scale * x + c.steady_x, scale * y + c.steady_y, along);
#else
    return vec(scale * x, scale * y, along);
#endif
#endif
}

// Weighted moments of the Jacobian rows of contacts with one plane; a row is (1, arm_y, -arm_x), its metric (1/m,
// inverse inertia).
struct Moments {
    Real w, x, y, xx, xy, yy;
};
INLINE void add_row(Moments& m, const Contact& c, Real w) {
    Real x = c.arm.y, y = -c.arm.x, wx = w * x, wy = w * y;
    m.w += w;
    m.x += wx;
    m.y += wy;
    m.xx += wx * x;
    m.xy += wx * y;
    m.yy += wy * y;
}
INLINE Moments sum_rows(const Lanes& lanes, const Moments& m) {
    Moments s = {lanes.sum(m.w), lanes.sum(m.x), lanes.sum(m.y), lanes.sum(m.xx), lanes.sum(m.xy), lanes.sum(m.yy)};
    return s;
}
INLINE Real crowd(const Moments& m, const Moving& a, const Contact& c) {
    const Sym& J = a.inverse_inertia;
    Real x = c.arm.y, y = -c.arm.x;
    Real w = a.inverse_mass, u = J.xx * x + J.xy * y, v = J.xy * x + J.yy * y;
    Real linear = w * m.w + Number(2) * (u * m.x + v * m.y);
    return c.stop_n * (w * linear + u * u * m.xx + Number(2) * u * v * m.xy + v * v * m.yy);
}

// Prepares a contact with the ground, whose normal is z; `arm` is the lever arm of the sphere's centre.
INLINE Flag touch_ground(Contact& c, const Law& law, const Moving& a, Vec arm, Real height, Real radius,
                         Real& weight) {
    const Sym& J = a.inverse_inertia;
    c.arm = vec(arm.x, arm.y, arm.z - radius);
    Real gap = height + c.arm.z, speed = a.velocity.z + a.omega.x * c.arm.y - a.omega.y * c.arm.x;
    Real x = c.arm.y, y = -c.arm.x;
    Real inverse_mass = a.inverse_mass + J.xx * x * x + Number(2) * J.xy * x * y + J.yy * y * y;
    return prepare(c, law, gap, speed, inverse_mass, mobility_trace(a, c.arm), weight);
}

#if SURFACE
#if PAIRED
// Sets the effects of a surface on a contact with it: friction at its slip, and viscous drag, which is distributed among
// all contacts of the pair by weight. `total` is the sum of their weights, `touching` their number.
INLINE void surface(Contact& c, const Law& law, const Moving& a, Real weight, Real total, Real touching) {
    const Surface& s = law.surface;
    Vec slip = a.velocity + cross(a.omega, c.arm);
    slip = slip - dot(slip, c.normal) * c.normal;
    c.friction = friction_at(s, law.friction, Real(0), Real(0), root(dot(slip, slip) + Real(Number(1e-24))), Real(0));
    Real drag = law.step_s * s.viscous * weight * reciprocal(at_least(total, Number(0.02)));
    c.steady = -(drag * reciprocal(Real(Number(1)) + drag * reciprocal(c.stop_t))) * slip;
    Real turns = dot(c.normal, a.inverse_inertia * c.normal);
    c.about = reciprocal(turns * touching);
    c.across = reciprocal((trace(a.inverse_inertia) - turns) * touching);
    c.turning = none();
}

// Angular impulse of rolling and torsional friction after one iteration.
INLINE Vec turned_by(const Contact& c, const Law& law, const Moving& a) {
    Real spin = dot(a.omega, c.normal), twist = dot(c.turning, c.normal), along = dot(c.impulse, c.normal);
    Vec roll = (c.turning - twist * c.normal) - c.across * (a.omega - spin * c.normal);
    twist = twist - c.about * spin;
    roll = shortened(dot(roll, roll), law.surface.rolling * along) * roll;
    return roll + (shortened(twist * twist, law.surface.torsion * along) * twist) * c.normal;
}

// Sets these effects on the contacts of a pair from `first` to `count`.
INLINE void surfaces(const Lanes& lanes, const Law& law, const Moving& a, Contact* list, const Real* weights, int first,
                     int count) {
    Real total = Real(0), touching = Real(lanes.sum(Number(count - first)));
    EACH_CONTACT(list, first, count) total += weights[i];
    total = lanes.sum(total);
    EACH_CONTACT(list, first, count) surface(list[i], law, a, weights[i], total, touching);
}
#else
// Sets the effects of the surface on a ground contact: local friction, and viscous drag, which is distributed among all
// contacts by weight; `total` is the sum of their weights.
INLINE void surface(Contact& c, const Law& law, const Moving& a, Vec com, Real weight, Real total) {
    const Surface& s = law.surface;
    Real u = a.velocity.x + a.omega.y * c.arm.z - a.omega.z * c.arm.y;
    Real v = a.velocity.y + a.omega.z * c.arm.x - a.omega.x * c.arm.z;
    c.friction = friction_at(s, law.friction, com.x + c.arm.x, com.y + c.arm.y, u, v);
#if ELLIPTIC
    c.ellipse = ellipse_of(s, c.friction);
#endif
    Real drag = law.step_s * s.viscous * weight * reciprocal(at_least(total, Number(0.02)));
    drag = -(drag * reciprocal(Real(Number(1)) + drag * reciprocal(c.stop_t)));
    c.steady_x = drag * u;
    c.steady_y = drag * v;
    c.turning = none();
}

// Angular impulse of rolling and torsional friction after one iteration. `across` and `about` are the reciprocals of
// the mobility about horizontal axes and about the normal, times the number of contacts that act on the same spin.
INLINE Vec turned_by(const Contact& c, const Law& law, const Moving& a, Real across, Real about) {
    Real x = c.turning.x - across * a.omega.x, y = c.turning.y - across * a.omega.y;
    Real z = c.turning.z - about * a.omega.z;
    Real roll = shortened(x * x + y * y, law.surface.rolling * c.impulse.z);
    return vec(roll * x, roll * y, shortened(z * z, law.surface.torsion * c.impulse.z) * z);
}
#endif
#endif
