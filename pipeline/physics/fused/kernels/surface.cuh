// Effects of the contact of one body with the ground; formulas of `physics/effects` and `physics/friction_ellipse.py`.
#if SURFACE
struct Surface {
    Real stribeck, slow_speed;       // additional friction at slow slip; velocity scale
    Real even, mixed;                // friction by direction
    Real spots[9], spot_m;           // friction by position: B-spline weights, knot spacing
    Real viscous, rolling, torsion;  // N s/m; m; m
    Real restitution, time, ratio;   // growth of the damping ratio with speed; contact time, ratio
    Real adhesion, reach;            // N; m
    bool spotted, twisting;          // whether friction depends on position; whether rolling or torsion has friction
    Real stiffness, damping;         // of a step, of a contact without speed
};

// The quadratic B-spline of width 3.
INLINE Real spline(Real x) {
    x = choose(plain(x) < Number(0), -x, x);
    Real far = at_least(Real(Number(1.5)) - x, Number(0));
    return choose(plain(x) < Number(0.5), Real(Number(0.75)) - x * x, Number(0.5) * far * far);
}

// Friction of a contact at (x, y) with slip velocity (u, v), both along the axes of the ground.
INLINE Real friction_at(const Surface& s, Real friction, Real x, Real y, Real u, Real v) {
    Real sum = friction;
    if (!absent(s.stribeck)) {
        Real speed = root(u * u + v * v + Real(Number(1e-24)));
        sum += s.stribeck * exponential(-(speed * reciprocal(s.slow_speed)));
    }
    if (!s.spotted) return at_least(sum, Number(0));
    Real each = reciprocal(s.spot_m);
    for (int i = 0; i < 3; i++) {
        Real along = spline(each * x - Real(Number(i - 1)));
        for (int j = 0; j < 3; j++) sum += s.spots[3 * i + j] * along * spline(each * y - Real(Number(j - 1)));
    }
    return at_least(sum, Number(0));
}

// Stiffness and damping of a step if the damping ratio grows with the speed, as in `coefficients` of
// `physics/contact_law.py`; `fast` is the size of the speed.
INLINE void damp(const Surface& s, Real step_s, Real fast, Real& stiffness, Real& damping) {
    Real ratio = s.ratio;
    Real grows = Real(Number(3.28)) + Number(1.16) * ratio;
    ratio += Number(0.375) * (Real(Number(1)) + ratio * grows) * s.restitution * fast;
    Real eta = step_s * reciprocal(s.time), gap = Real(Number(1)) - ratio * ratio;
    Flag below = plain(gap) > Number(0);
    Real safe = choose(below, gap, -gap);
    safe = choose(plain(safe) < Number(1e-12), Real(Number(1e-12)), safe);
    Real angle = root(safe) * eta, decay = exponential(-(ratio * eta)), sine, cosine;
    if (some(below)) sine_cosine(angle, sine, cosine);
    if (!every(below)) cosine = choose(below, cosine, Number(0.5) * (exponential(angle) + exponential(-angle)));
    Real trace = Number(2) * decay * cosine, determinant = decay * decay;
    stiffness = Real(Number(1)) + determinant - trace;
    damping = Number(0.5) * (Real(Number(3)) - trace - determinant) - stiffness;
}

// The same at a speed with a sign; where the ratio does not grow, those of the present step are stored already.
INLINE void response(const Surface& s, Real step_s, Real speed, Real& stiffness, Real& damping) {
    if (absent(s.restitution)) {
        stiffness = s.stiffness;
        damping = s.damping;
        return;
    }
    damp(s, step_s, choose(plain(speed) < Number(0), -speed, speed), stiffness, damping);
}

#if ELLIPTIC
// The friction matrix M = mean I + [[even, mixed], [mixed, -even]], as in `physics/friction_ellipse.py`.
struct Ellipse {
    Real mean, even, mixed;
};

INLINE Ellipse ellipse_of(const Surface& s, Real friction) {
    Real radius = root(s.even * s.even + s.mixed * s.mixed + Real(Number(1e-24)));
    Real high = at_least(friction + radius, Number(LEAST_FRICTION));
    Ellipse e = {friction, s.even, s.mixed};
    Flag flat = plain(friction - radius) < Number(FLATTEST) * plain(high);
    if (some(flat)) {
        Real scale = Number(0.5 * (1 - FLATTEST)) * high * reciprocal(radius);
        e.mean = choose(flat, Number(0.5 * (1 + FLATTEST)) * high, e.mean);
        e.even = choose(flat, scale * s.even, e.even);
        e.mixed = choose(flat, scale * s.mixed, e.mixed);
    }
    return e;
}

INLINE Real share_of(Real size, Real limit) {
    return size * reciprocal(choose(plain(limit) >= Number(1e-9) * plain(size), limit, Number(1e-9) * size));
}

// Projects an impulse onto the ellipse |M^-1 j| <= limit.
INLINE void put_in(const Ellipse& e, Real limit, Real& x, Real& y) {
    const Real tiny = Real(Number(1e-24));
#if HOST
    // where the contact sticks, a predicted branch takes roots and divisions out of the chain of iterations
    Number mean = plain(e.mean), even = plain(e.even), mixed = plain(e.mixed);
    Number along = mean * plain(x) - even * plain(x) - mixed * plain(y);
    Number across = mean * plain(y) - mixed * plain(x) + even * plain(y);
    Number most = plain(limit) * (mean * mean - even * even - mixed * mixed);
    Flag done = along * along + across * across < Number(1 - 1e-6) * most * most - Number(1e-24);
    if (every(done)) return;
    Flag round_one = (plain(e.even) == Number(0)) & (plain(e.mixed) == Number(0)) & !done;
#if DUAL
    round_one = false;  // its derivative by the direction is not 0
#endif
    if (some(round_one)) {
        Real scale = at_most(limit * e.mean * inverse_root(x * x + y * y + tiny), Number(1));
        x = choose(round_one, scale * x, x);
        y = choose(round_one, scale * y, y);
        done = done | round_one;
    }
    if (every(done)) return;
#else
    Flag done = false;
#endif
    Real square = e.even * e.even + e.mixed * e.mixed, twice = Number(2) * e.mean;
    Real half_trace = e.mean * e.mean + square, root_det = e.mean * e.mean - square;
    Real turned_x = e.even * x + e.mixed * y, turned_y = e.mixed * x - e.even * y;
    Real one_x = e.mean * x + turned_x, one_y = e.mean * y + turned_y;
    Real two_x = e.mean * turned_x + square * x, two_y = e.mean * turned_y + square * y;
    Real high = e.mean + root(square + tiny), u, v;
    Real t = at_least(share_of(root(one_x * one_x + one_y * one_y + tiny), limit) - high * high, Number(0));
    Flag close = false;  // the last step was so small that another one would change only rounding
    for (int round = 0;; round++) {
        Real inverse = reciprocal(t * t + Number(2) * half_trace * t + root_det * root_det), first = half_trace + t;
        u = inverse * (first * one_x - twice * two_x);
        v = inverse * (first * one_y - twice * two_y);
        Real size2 = u * u + v * v + tiny;
        Flag ends = (close | Flag(round == NEWTON_STEPS)) & !done;
        if (some(ends)) {
            Real scale = at_most(limit * inverse_root(size2), Number(1));
            x = choose(ends, scale * (e.mean * u + e.even * u + e.mixed * v), x);
            y = choose(ends, scale * (e.mean * v + e.mixed * u - e.even * v), y);
            done = done | ends;
            if (every(done)) return;
        }
        Real bent = e.even * (u * u - v * v) + Number(2) * e.mixed * u * v;
        bent = inverse * (first * size2 - twice * bent);
        Real beyond = share_of(root(size2), limit) - Real(Number(1));
        done = done | ((plain(t) == Number(0)) & (plain(beyond) <= Number(0)));  // it lies in the ellipse
        if (every(done)) return;
        close = (plain(beyond) < Number(CLOSE)) & (plain(beyond) > Number(-CLOSE));
        t = at_least(t + size2 * reciprocal(bent) * beyond, Number(0));
    }
}

// Length of M^-1 j.
INLINE Number size_in(const Ellipse& e, Number x, Number y) {
    Number m = plain(e.mean), a = plain(e.even), b = plain(e.mixed);
    Number u = m * x - a * x - b * y, v = m * y - b * x + a * y;
    return root(u * u + v * v) / (m * m - a * a - b * b);
}
#endif

// The factor, at most 1, that limits a vector of the given squared length to a maximum length.
INLINE Real shortened(Real square, Real limit) {
    return at_most(limit * inverse_root(square + Real(Number(1e-24))), Number(1));
}
#endif
