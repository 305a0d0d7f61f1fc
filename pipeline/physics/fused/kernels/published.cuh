// Contacts by the paper's law: one explicit evaluation of the rows of a friction pyramid on every contact that is closed;
// formulas of `physics/paper_law.py`, distances of `physics/smooth_distance.py`.
#if PUBLISHED
const double NEGLIGIBLE = 40;  // exponent: exp(-40) is less than rounding
const double LINEAR = 20;      // exponent from which SoftPlus is taken as its argument, as in torch

#if HOST && !SINGLE && defined(__AVX__) && !defined(__clang__)
// The functions of SoftPlus to rounding, for a number or for vectors of them: half of the time of a rollout would be that of
// the library's, and vectors of rollouts have the bits of each alone.
#if WIDE
typedef Row Many;
typedef Marks ManyWhole;
#else
typedef double Many __attribute__((vector_size(32)));
typedef long long ManyWhole __attribute__((vector_size(32)));
#endif

// exp(-m) for m from 0 to NEGLIGIBLE: 2^n times the series of a remainder below log(2) / 2. Of several numbers at once, as
// each step of a series waits for the one before.
template <class V, class W, int N> INLINE void fading(const V* m, V* e) {
    static const double each[] = {1.0 / 6227020800, 1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880,
                                  1.0 / 40320, 1.0 / 5040, 1.0 / 720, 1.0 / 120, 1.0 / 24, 1.0 / 6, 1.0 / 2, 1.0, 1.0};
    const V rounding = V{} + 6755399441055744.0;  // 1.5 * 2^52: the last bits of a sum with it are the whole number
    V rest[N], powers[N];
    for (int n = 0; n < N; n++) {
        const V shifted = rounding - m[n] * 1.4426950408889634, whole = shifted - rounding;
        rest[n] = (-m[n] - whole * 6.93147180369123816490e-01) - whole * 1.90821492927058770002e-10;  // log(2) in two parts
        W bits;
        __builtin_memcpy(&bits, &shifted, sizeof bits);
        bits = (bits + 1023) << 52;
        __builtin_memcpy(&powers[n], &bits, sizeof bits);
        e[n] = V{} + each[0];
    }
    for (int k = 1; k < 14; k++) {
        for (int n = 0; n < N; n++) e[n] = e[n] * rest[n] + each[k];
    }
    for (int n = 0; n < N; n++) e[n] = e[n] * powers[n];
}

// log(1 + e) for e from 0 to 1: the series of 2 artanh of e / (2 + e), or of what 1 + e is to 2, which is nearer to 1.
template <class V, int N> INLINE void log_above_one(const V* e, V* found) {
    static const double each[] = {2.0 / 23, 2.0 / 21, 2.0 / 19, 2.0 / 17, 2.0 / 15, 2.0 / 13,
                                  2.0 / 11, 2.0 / 9, 2.0 / 7, 2.0 / 5, 2.0 / 3, 2.0};
    V z[N], z2[N];
    for (int n = 0; n < N; n++) {
        const auto high = e[n] > 0.41421356237309503;
        z[n] = (high ? e[n] - 1.0 : e[n]) / (high ? e[n] + 3.0 : e[n] + 2.0);
        z2[n] = z[n] * z[n];
        found[n] = V{} + each[0];
    }
    for (int k = 1; k < 12; k++) {
        for (int n = 0; n < N; n++) found[n] = found[n] * z2[n] + each[k];
    }
    for (int n = 0; n < N; n++) {
        const auto high = e[n] > 0.41421356237309503;
        found[n] = z[n] * found[n] + (high ? V{} + 0.6931471805599453 : V{});
    }
}

// The logistic function of x, and exp(-|x|).
template <class V, class W, int N> INLINE void logistic(const V* x, V* e, V* found) {
    V size[N];
    for (int n = 0; n < N; n++) {
        const V most = V{} + NEGLIGIBLE;
        size[n] = x[n] < 0.0 ? -x[n] : x[n];
        size[n] = size[n] < most ? size[n] : most;
    }
    fading<V, W, N>(size, e);
    for (int n = 0; n < N; n++) found[n] = (x[n] > 0.0 ? V{} + 1.0 : e[n]) / (e[n] + 1.0);
}

// SoftPlus with a sharpness of 1, and its slope; the argument from LINEAR on.
template <class V, class W, int N> INLINE void soft_plus(const V* x, V* soft, V* slope) {
    V e[N];
    logistic<V, W, N>(x, e, slope);
    log_above_one<V, N>(e, soft);
    for (int n = 0; n < N; n++) {
        soft[n] = (x[n] > 0.0 ? x[n] : V{}) + soft[n];
        soft[n] = x[n] < -NEGLIGIBLE ? V{} : soft[n];
    }
}

INLINE Real sigmoid(Real x) {
#if WIDE
    Row e, value;
    logistic<Row, Marks, 1>(&x.of, &e, &value);
    return Wide(value);
#else
    double e, value;
    const double at = plain(x);
    logistic<double, long long, 1>(&at, &e, &value);
#if DUAL
    return Real(value, x.tangent * value * (1.0 - value));
#else
    return value;
#endif
#endif
}

// The soft maxima of the forces of all rows and 0; plain ones where they have no sharpness.
INLINE void soften(Real* forces, Number sharpness) {
    if (!some(sharpness > Number(0))) {
        for (int d = 0; d < PUBLISHED; d++) forces[d] = at_least(forces[d], Number(0));
        return;
    }
#if WIDE
    Row exponent[PUBLISHED], soft[PUBLISHED], slope[PUBLISHED];
    bool straight = true;
    for (int d = 0; d < PUBLISHED; d++) {
        exponent[d] = sharpness.of * forces[d].of;
        straight = straight && every(Flag(exponent[d] > LINEAR));
    }
    if (straight) return;
    soft_plus<Row, Marks, PUBLISHED>(exponent, soft, slope);
    for (int d = 0; d < PUBLISHED; d++) {
        forces[d] = choose(Flag(exponent[d] > LINEAR), forces[d], Wide(soft[d] / sharpness.of));
    }
#else
    for (int first = 0; first < PUBLISHED; first += 4) {
        Many exponent = Many{} - 2 * NEGLIGIBLE, soft, slope;
        const int count = PUBLISHED - first < 4 ? PUBLISHED - first : 4;
        bool straight = true;
        for (int k = 0; k < count; k++) {
            exponent[k] = sharpness * plain(forces[first + k]);
            straight = straight && exponent[k] > LINEAR;
        }
        if (straight) continue;
        soft_plus<Many, ManyWhole, 1>(&exponent, &soft, &slope);
        soft = soft / sharpness;
        for (int k = 0; k < count; k++) {
            Real& force = forces[first + k];
            if (exponent[k] > LINEAR) continue;
#if DUAL
            force = Real(soft[k], force.tangent * slope[k]);
#else
            force = soft[k];
#endif
        }
    }
#endif
}
#else
INLINE Real sigmoid(Real x) { return reciprocal(Real(1) + exponential(-x)); }

INLINE Real softened(Real force, Number sharpness) {
    if (!(sharpness > Number(0))) return at_least(force, Number(0));
    const Number exponent = sharpness * plain(force);
    if (exponent > Number(LINEAR)) return force;
    if (exponent < Number(-NEGLIGIBLE)) return Real(0);
    const Number power = exponential(exponent), soft = quotient(log_of_one_and(power), sharpness);
#if DUAL
    return Real(soft, force.tangent * quotient(power, Number(1) + power));
#else
    return soft;
#endif
}

// The soft maxima of the forces of all rows and 0; plain ones where they have no sharpness.
INLINE void soften(Real* forces, Number sharpness) {
    SPREAD
    for (int d = 0; d < PUBLISHED; d++) forces[d] = softened(forces[d], sharpness);
}
#endif

// The published clamp of a distance; the distance itself where it has none.
INLINE Real clamped(const Published& p, Real gap) {
    if (!some(p.clamp_per_m > Number(0))) return gap;
    const Real far = gap + Real(p.zero_m);
    return sigmoid(p.clamp_per_m * far) * (far + Real(p.clamp_depth_m)) - Real(p.clamp_depth_m);
}

// The impulse of a contact, given its gap, the speed at which the gap widens and the slip along its tangents; along the
// normal, then the tangents.
INLINE Vec pushed(const Published& p, const Law& law, Real gap, Real speed, Real one, Real two) {
    Real forces[PUBLISHED];
    const Real distance = clamped(p, gap);
    SPREAD
    for (int d = 0; d < PUBLISHED; d++) {
        const Real along = speed - law.friction * (Number(facet_x(d)) * one + Number(facet_y(d)) * two);
        forces[d] = -(law.stiffness * (law.step_s * along + distance)) - law.damping * along;
    }
    soften(forces, p.softplus_per_n);
    Vec sum = none();
    SPREAD
    for (int d = 0; d < PUBLISHED; d++) {
        const Real impulse = law.step_s * forces[d];
        sum.x += impulse;
        sum.y -= Number(facet_x(d)) * impulse;
        sum.z -= Number(facet_y(d)) * impulse;
    }
    sum.y = law.friction * sum.y;
    sum.z = law.friction * sum.z;
    return sum;
}

// Whether a contact acts: its gap is closed, or closes within the step.
INLINE Flag acts(const Law& law, Real gap, Real speed) {
    return (plain(gap) < Number(0)) | (plain(gap) + plain(law.step_s) * plain(speed) < Number(0));
}

struct Acting {  // impulse of the contacts of a pair on a, and its moments about both centres of mass
    Vec linear, angular_a, angular_b;
};

#if HOST && !SINGLE && defined(__AVX__) && !defined(__clang__) && !WIDE && LANES == 1 && (PAIRED || DUAL)
#define ABREAST 1  // spheres of a body, in places of vectors: where rollouts are not
#else
#define ABREAST 0
#endif

#if ABREAST
typedef double Lot __attribute__((vector_size(64)));
typedef long long LotWhole __attribute__((vector_size(64)));

struct Part {  // numbers of eight spheres, with their derivatives
    Lot value;
#if DUAL
    Lot tangent;
#define PART(value, tangent) {value, tangent}
#else
#define PART(value, tangent) {value}
#endif
};
INLINE Part part(Real x) {
#if DUAL
    Part p = {Lot{} + x.value, Lot{} + x.tangent};
#else
    Part p = {Lot{} + x};
#endif
    return p;
}
INLINE Part operator+(const Part& a, const Part& b) { Part p = PART(a.value + b.value, a.tangent + b.tangent); return p; }
INLINE Part operator-(const Part& a, const Part& b) { Part p = PART(a.value - b.value, a.tangent - b.tangent); return p; }
INLINE Part operator*(const Part& a, const Part& b) {
    Part p = PART(a.value * b.value, a.tangent * b.value + a.value * b.tangent);
    return p;
}
INLINE Real sum_of(const Part& p) {
    Real sum = Real(0);
    for (int k = 0; k < 8; k++) {
#if DUAL
        sum += Real(p.value[k], p.tangent[k]);
#else
        sum += p.value[k];
#endif
    }
    return sum;
}
INLINE bool any_of(LotWhole marks) {
    long long found = 0;
    for (int k = 0; k < 8; k++) found |= marks[k];
    return found != 0;
}

struct Parts {
    Part x, y, z;
    INLINE Parts() : x(part(Real(0))), y(x), z(x) {}
    INLINE Parts(const Part& x, const Part& y, const Part& z) : x(x), y(y), z(z) {}
    INLINE explicit Parts(const Vec& v) : x(part(v.x)), y(part(v.y)), z(part(v.z)) {}
};
INLINE Parts operator+(const Parts& a, const Parts& b) { return Parts(a.x + b.x, a.y + b.y, a.z + b.z); }
INLINE Parts operator-(const Parts& a, const Parts& b) { return Parts(a.x - b.x, a.y - b.y, a.z - b.z); }
INLINE Parts operator*(const Part& s, const Parts& a) { return Parts(s * a.x, s * a.y, s * a.z); }
INLINE Part dot(const Parts& a, const Parts& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Parts cross(const Parts& a, const Parts& b) {
    return Parts(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
INLINE Vec sum_of(const Parts& p) { return vec(sum_of(p.x), sum_of(p.y), sum_of(p.z)); }

// As `clamped`.
INLINE Part clamped(const Published& p, const Part& gap) {
    if (!(p.clamp_per_m > 0)) return gap;
    const Part far = gap + part(Real(p.zero_m)), deep = far + part(Real(p.clamp_depth_m));
    const Lot x = p.clamp_per_m * far.value;
    Lot e, value;
    logistic<Lot, LotWhole, 1>(&x, &e, &value);
    const Part inside = PART(value, p.clamp_per_m * far.tangent * value * (1.0 - value));
    return inside * deep - part(Real(p.clamp_depth_m));
}

// As `soften`.
INLINE void soften(Part* forces, double sharpness) {
    if (!(sharpness > 0)) {
        for (int d = 0; d < PUBLISHED; d++) {
            const LotWhole pushes = forces[d].value >= 0.0;
            Part p = PART(pushes ? forces[d].value : Lot{}, pushes ? forces[d].tangent : Lot{});
            forces[d] = p;
        }
        return;
    }
    Lot exponent[PUBLISHED], soft[PUBLISHED], slope[PUBLISHED];
    for (int d = 0; d < PUBLISHED; d++) exponent[d] = sharpness * forces[d].value;
    soft_plus<Lot, LotWhole, PUBLISHED>(exponent, soft, slope);
    for (int d = 0; d < PUBLISHED; d++) {
        const LotWhole linear = exponent[d] > LINEAR;
        Part p = PART(linear ? forces[d].value : soft[d] / sharpness, linear ? forces[d].tangent : forces[d].tangent * slope[d]);
        forces[d] = p;
    }
}

const int ABREAST_ROOM = (CONTACTS + 7) / 8 * 8 + 8;
struct Closed {  // what is kept of the contacts that act, one after another: arms, velocities and gaps
    double value[7][ABREAST_ROOM];
#if DUAL
    double tangent[7][ABREAST_ROOM];
#endif
    int count;
    // Adds those of eight spheres that are marked.
    INLINE void add(const Part* numbers, LotWhole marks) {
        for (int j = 0; j < 8; j++) {
            if (!marks[j]) continue;
            for (int i = 0; i < 7; i++) {
                value[i][count] = numbers[i].value[j];
#if DUAL
                tangent[i][count] = numbers[i].tangent[j];
#endif
            }
            count++;
        }
    }
    INLINE Part at(int i, int k) const {
        Part p;
        __builtin_memcpy(&p.value, value[i] + k, sizeof p.value);
#if DUAL
        __builtin_memcpy(&p.tangent, tangent[i] + k, sizeof p.tangent);
#endif
        return p;
    }
};

// Adds the impulses of a body's spheres with the ground.
INLINE void push_ground(const Problem& problem, const Environment& env, const Own&, int p, const Mat& rotation,
                        const Motion& m, Acting& sum) {
    const int a = pair_a(p), start = contact_start(p), count = contact_count(p);
    const Law& law = env.laws[0];
    Vec up = vec(Real(0), Real(0), Real(1)), first = vec(Real(1), Real(0), Real(0)), second = vec(Real(0), Real(1), Real(0));
#if TURNED
    tangents(env, up, first, second);
#endif
    // no point of the body sinks further in this step, up to rounding
    const double fall = size(m.velocity) + size(m.omega) * env.constants[a].reach;
    const double far = plain(law.step_s) * fall + 1e-6;
    const Parts x(rotation.x), y(rotation.y), z(rotation.z), com(env.constants[a].com), v(m.velocity), omega(m.omega);
    const Parts one(first), two(second);
    const Part height = part(env.bodies[a].position.z - env.ground), h = part(law.step_s), friction = part(law.friction);
    const Part stiffness = part(law.stiffness), damping = part(law.damping);
    const LotWhole places = {0, 1, 2, 3, 4, 5, 6, 7};
    Closed closed;
    closed.count = 0;
    for (int k = 0; k < count; k += 8) {
        Part at[4];
        for (int c = 0; c < 4; c++) at[c] = part(Real(0));
        for (int j = 0; j < 8; j++) {
            const Place row = env.geometry + 4LL * problem.spheres[start + (k + j < count ? k + j : count - 1)];
            for (int c = 0; c < 4; c++) {
                const Real number = problem.geometry.at(row + c);
#if DUAL
                at[c].value[j] = number.value;
                at[c].tangent[j] = number.tangent;
#else
                at[c].value[j] = number;
#endif
            }
        }
        const Parts held = Parts(at[0], at[1], at[2]) - com;
        const Part low = dot(z, held) - at[3], gap = height + low;
        if (!any_of(gap.value <= far)) continue;
        const Parts arm(dot(x, held), dot(y, held), low), velocity = v + cross(omega, arm);
        const LotWhole acting = (gap.value < 0.0) | (gap.value + h.value * velocity.z.value < 0.0);
        const Part numbers[7] = {arm.x, arm.y, arm.z, velocity.x, velocity.y, velocity.z, gap};
        closed.add(numbers, acting & (places < (long long)(count - k)));
    }
    Parts linear, angular;
    for (int k = 0; k < closed.count; k += 8) {
        for (int j = closed.count; j < k + 8; j++) {  // any finite numbers
            for (int i = 0; i < 7; i++) closed.value[i][j] = 0.0;
#if DUAL
            for (int i = 0; i < 7; i++) closed.tangent[i][j] = 0.0;
#endif
        }
        const LotWhole on = places < (long long)(closed.count - k);
        const Parts arm(closed.at(0, k), closed.at(1, k), closed.at(2, k));
        const Parts velocity(closed.at(3, k), closed.at(4, k), closed.at(5, k));
        const Part distance = clamped(env.published, closed.at(6, k));
        const Part along_one = dot(velocity, one), along_two = dot(velocity, two);
        Part forces[PUBLISHED];
        for (int d = 0; d < PUBLISHED; d++) {
            const Part facing = part(Real(facet_x(d))), other = part(Real(facet_y(d)));
            const Part along = velocity.z - friction * (facing * along_one + other * along_two);
            forces[d] = part(Real(0)) - stiffness * (h * along + distance) - damping * along;
        }
        soften(forces, env.published.softplus_per_n);
        Part normal = part(Real(0)), across = normal, beside = normal;
        for (int d = 0; d < PUBLISHED; d++) {
            const Part all = h * forces[d];
            const Part impulse = PART(on ? all.value : Lot{}, on ? all.tangent : Lot{});
            normal = normal + impulse;
            across = across - part(Real(facet_x(d))) * impulse;
            beside = beside - part(Real(facet_y(d))) * impulse;
        }
        const Parts impulse = normal * Parts(up) + (friction * across) * one + (friction * beside) * two;
        linear = linear + impulse;
        angular = angular + cross(arm, impulse);
    }
    sum.linear = sum.linear + sum_of(linear);
    sum.angular_a = sum.angular_a + sum_of(angular);
}
#else
// Adds the impulses of a body's spheres with the ground.
INLINE void push_ground(const Problem& problem, const Environment& env, const Own& own, int p, const Mat& rotation,
                        const Motion& m, Acting& sum) {
    const int a = pair_a(p), start = contact_start(p);
    const Law& law = env.laws[0];
    const Real height = env.bodies[a].position.z - env.ground;
#if TURNED
    const Vec up = vec(Real(0), Real(0), Real(1));
    Vec one, two;
    tangents(env, up, one, two);
#endif
    // no point of the body sinks further in this step, up to rounding
    const Number fall = size(m.velocity) + size(m.omega) * env.constants[a].reach;
    const Number far = plain(law.step_s) * fall + Number(1e-6);
    EACH_OWNED(own.lanes, start, contact_count(p), k) {
        const Place row = env.geometry + 4LL * problem.spheres[start + k];
        const Vec held = problem.geometry.vector(row) - env.constants[a].com;
        const Real radius = problem.geometry.at(row + 3);
        if (every(plain(height) + plain(dot(rotation.z, held)) - plain(radius) > far)) continue;
        Vec arm = rotation * held;
        arm.z = arm.z - radius;
        const Real gap = height + arm.z;
        const Vec velocity = m.velocity + cross(m.omega, arm);
        const Flag on = acts(law, gap, velocity.z);
        if (!some(on)) continue;
#if TURNED
        const Vec along = pushed(env.published, law, gap, velocity.z, dot(velocity, one), dot(velocity, two));
        const Vec impulse = along.x * up + along.y * one + along.z * two;
#else
        const Vec along = pushed(env.published, law, gap, velocity.z, velocity.x, velocity.y);
        const Vec impulse = WHERE(on, vec(along.y, along.z, along.x));
#endif
        sum.linear = sum.linear + impulse;
        sum.angular_a = sum.angular_a + cross(arm, impulse);
    }
}
#endif

#if PAIRED
// Bound on how far the smooth distance from a body lies below that of its nearest sphere.
INLINE Number softness(const Published& p, int b) {
    return quotient(logarithm(Number(sphere_count(b))), p.sharpness_per_m);
}

// Distance of a point from the spheres of a body by the logarithm of a sum of exponentials, and the outward normal, all
// in the frame of that body. Where the normal is undefined it is `up`. Returns whether the distance may be below `limit`.
// TOGETHER: all lanes of the warp ask, those of an environment for the same point, and divide the spheres among them.
template <bool TOGETHER>
INLINE bool soft_distance(const Lanes& lanes, const Published& p, const Union& spheres, Vec at, Number limit, Vec up,
                          Real& distance, Vec& outward) {
    const Number point[3] = {plain(at.x), plain(at.y), plain(at.z)}, width = quotient(Number(NEGLIGIBLE), p.sharpness_per_m);
    const int own = TOGETHER ? lanes.lane : 0, apart = TOGETHER ? LANES : 1;
    Number nearest = Number(1e30);
    if (TOGETHER) {
        KEEP_LOOP
        for (int i = own; i < spheres.count; i += apart) {
            nearest = lesser(nearest, root(square_to(spheres, i, point)) - plain_radius(spheres, i));
        }
        nearest = plain(lanes.least(Real(nearest)));
    } else {
        nearest = nearest_in(spheres, point);
    }
    const bool far = nearest - quotient(logarithm(Number(spheres.count)), p.sharpness_per_m) > limit;
    if (far && !TOGETHER) return false;
    Real total = Real(0);
    Vec gradient = none();
    KEEP_LOOP
    for (int i = own; i < spheres.count; i += apart) {
        if (!below(square_to(spheres, i, point), plain_radius(spheres, i), nearest + width)) continue;
        const Vec away = at - spheres.center(i);
        const Real length = root(dot(away, away));
        const Real power = exponential(-(p.sharpness_per_m * (length - spheres.radius(i) - Real(nearest))));
        total += power;
        gradient = gradient + power * reciprocal(at_least(length, Number(1e-12))) * away;
    }
    if (TOGETHER) {
        total = lanes.sum(total);
        gradient = lanes.sum(gradient);
    }
    distance = Real(nearest) - quotient(Number(1), p.sharpness_per_m) * logarithm(total);
    gradient = reciprocal(total) * gradient;
    const Real norm2 = dot(gradient, gradient);
    outward = plain(norm2) > Number(1e-16) ? inverse_root(norm2) * gradient : up;
    return !far;
}

// Adds the impulse of a sphere of a (side 1) or b (side 0) with the other body, given its distance from that.
INLINE void push_point(const Environment& env, int p, int side, const Motion* motions, Vec center, Real radius,
                       Real distance, Vec outward, Acting& sum) {
    const int a = pair_a(p), b = pair_b(p);
    const Law& law = env.laws[0];
    const Motion &ma = motions[a], &mb = motions[b];
    const Real gap = distance - radius;
    const Vec normal = side ? outward : -outward;
    const Vec point = center - (radius + Number(0.5) * gap) * outward;
    const Vec arm_a = point - env.bodies[a].position, arm_b = point - env.bodies[b].position;
    const Vec velocity = ma.velocity + cross(ma.omega, arm_a) - mb.velocity - cross(mb.omega, arm_b);
    const Real speed = dot(velocity, normal);
    if (!acts(law, gap, speed)) return;
    Vec one, two;
    tangents(env, normal, one, two);
    const Vec along = pushed(env.published, law, gap, speed, dot(velocity, one), dot(velocity, two));
    const Vec impulse = along.x * normal + along.y * one + along.z * two;
    sum.linear = sum.linear + impulse;
    sum.angular_a = sum.angular_a + cross(arm_a, impulse);
    sum.angular_b = sum.angular_b + cross(arm_b, impulse);
}

// Adds the impulses between two bodies: of the spheres of b with the union of a, then of those of a with that of b.
INLINE void push_pair(const Problem& problem, const Environment& env, const Own& own, int p, const Mat* rotations,
                      const Motion* motions, Acting& sum) {
    const int a = pair_a(p), b = pair_b(p), of_b = sphere_count(b);
    const Law& law = env.laws[0];
    const Constants &ca = env.constants[a], &cb = env.constants[b];
    const Motion &ma = motions[a], &mb = motions[b];
    const Number soft = greater(softness(env.published, a), softness(env.published, b)), h = plain(law.step_s);
    // points at a gap g approach at V + W g / 2 at most, so those beyond h V / (1 - h W / 2) cannot touch in this step
    const Number spin_a = size(ma.omega), spin_b = size(mb.omega), left = Number(1) - Number(0.5) * h * (spin_a + spin_b);
    const Number V = size(ma.velocity - mb.velocity) + spin_a * (ca.reach + soft) + spin_b * (cb.reach + soft);
    const Number limit = left > Number(0.01) ? quotient(h * V, left) + Number(1e-6) : Number(1e30);
    const bool near = size(env.bodies[a].position - env.bodies[b].position) - ca.reach - cb.reach - soft < limit;
    if (!own.lanes.any(near)) return;
    Vec up = vec(Real(0), Real(0), Real(1));
#if TURNED
    up = env.turn * up;
#endif
    KEEP_LOOP
    for (int side = 0; side < 2; side++) {
        const int mine = side ? a : b, other = side ? b : a, first = contact_start(p) + (side ? of_b : 0);
        const Union spheres = {problem.geometry, env.geometry + 4LL * sphere_start(other), sphere_count(other)};
        const Frame frame = frame_in(env, mine, other, rotations);
        const bool may = near && !boxes_apart(env.constants[mine], env.constants[other], frame, Number(1 + 1e-5) * (limit + soft));
        const Vec local_up = transposed(rotations[other], up);
        Real distance;
        Vec outward;
#define QUERY(k)                                                                                                        \
    const Place row = env.geometry + 4LL * problem.spheres[first + (k)];                                               \
    const Real radius = problem.geometry.at(row + 3);                                                                  \
    const Vec held = rotations[mine] * (problem.geometry.vector(row) - env.constants[mine].com);                       \
    const Vec center = env.bodies[mine].position + held;                                                               \
    const Vec local = transposed(rotations[other], center - env.bodies[other].position) + env.constants[other].com;    \
    const Number limit_here = limit + plain(radius);
#if LANES > 1
        if (sphere_count(mine) < LANES) {
            if (!own.lanes.any(may)) continue;
            KEEP_LOOP
            for (int k = 0; k < sphere_count(mine); k++) {
                QUERY(k)
                const bool there = soft_distance<true>(own.lanes, env.published, spheres, local, limit_here, local_up, distance, outward);
                if (may && there && own.lanes.lane == 0) push_point(env, p, side, motions, center, radius, distance, rotations[other] * outward, sum);
            }
            continue;
        }
#endif
        if (!may) continue;
        EACH_OWNED(own.lanes, first, sphere_count(mine), k) {
            if (beside(env.constants[other], frame, problem.geometry.value + env.geometry + 4LL * problem.spheres[first + k], limit + soft)) continue;
            QUERY(k)
            if (!soft_distance<false>(own.lanes, env.published, spheres, local, limit_here, local_up, distance, outward)) continue;
            push_point(env, p, side, motions, center, radius, distance, rotations[other] * outward, sum);
        }
    }
}
#undef QUERY
#endif

// Adds the impulses of all contacts of a step to the bodies' velocities and angular momenta.
INLINE void collide(const Problem& problem, Environment& env, Own& own, const Mat* rotations, Motion* motions,
                    Vec* velocities, Vec* spins) {
    Vec linear[BODIES], angular[BODIES];
    EACH_BODY
    for (int b = 0; b < BODIES; b++) linear[b] = angular[b] = none();
    EACH_PAIR
    for (int p = 0; p < PAIRS; p++) {
        const int a = pair_a(p), b = pair_b(p);
        Acting sum = {none(), none(), none()};
#if PAIRED
        if (b >= 0) push_pair(problem, env, own, p, rotations, motions, sum);
#endif
        if (b < 0 && some(near_ground(env, a, motions[a]))) push_ground(problem, env, own, p, rotations[a], motions[a], sum);
        linear[a] = linear[a] + own.lanes.sum(sum.linear);
        angular[a] = angular[a] + own.lanes.sum(sum.angular_a);
        if (b < 0 || !is_free(b)) continue;
        linear[b] = linear[b] - own.lanes.sum(sum.linear);
        angular[b] = angular[b] - own.lanes.sum(sum.angular_b);
    }
    EACH_BODY
    for (int b = 0; b < BODIES; b++) {
        if (!is_free(b)) continue;
        velocities[b] = velocities[b] + motions[b].inverse_mass * linear[b];
        spins[b] = spins[b] + angular[b];
    }
}
#endif
