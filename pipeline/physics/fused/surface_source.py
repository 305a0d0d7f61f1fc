"""CUDA source: effects of the contact between one body and the ground, by the formulas of `physics/effects`."""

from __future__ import annotations

SURFACE = r"""
#if SURFACE
struct Surface {
    Real stribeck, slow_speed;       // friction at slow slip, and how slow
    Real even, mixed;                // friction by the direction of the slip
    Real spots[9], spot_m;           // friction by the place: weights of B-splines, and their spacing
    Real viscous, rolling, torsion;  // N s/m; m; m
    Real restitution, time, ratio;   // how the damping ratio grows with the speed; of the contact
    Real adhesion, reach;            // N; m
};

// The quadratic B-spline of width 3.
INLINE Real spline(Real x) {
    if (plain(x) < Number(0)) x = -x;
    if (plain(x) < Number(0.5)) return Real(Number(0.75)) - x * x;
    Real far = at_least(Real(Number(1.5)) - x, Number(0));
    return Number(0.5) * far * far;
}

// Friction of a contact at a place (x, y) with a slip (u, v), both along the axes of an upright ground.
INLINE Real friction_at(const Surface& s, Real friction, Real x, Real y, Real u, Real v) {
    Real square = u * u + v * v, speed = root(square + Real(Number(1e-24)));
    Real sum = friction + s.stribeck * exponential(-(speed * reciprocal(s.slow_speed)));
    Real turned = s.even * (u * u - v * v) + s.mixed * (Number(2) * u * v);
    sum += turned * reciprocal(square + Real(Number(1e-6)));
    Real each = reciprocal(s.spot_m);
    for (int i = 0; i < 3; i++) {
        Real along = spline(each * x - Real(Number(i - 1)));
        for (int j = 0; j < 3; j++) sum += s.spots[3 * i + j] * along * spline(each * y - Real(Number(j - 1)));
    }
    return at_least(sum, Number(0));
}

// Stiffness and damping of a step where the damping ratio grows with the speed: `coefficients` of `physics/contact.py`.
INLINE void response(const Surface& s, Real step_s, Real speed, Real& stiffness, Real& damping) {
    Real fast = plain(speed) < Number(0) ? -speed : speed, ratio = s.ratio;
    Real grows = Real(Number(3.28)) + Number(1.16) * ratio;
    ratio += Number(0.375) * (Real(Number(1)) + ratio * grows) * s.restitution * fast;
    Real eta = step_s * reciprocal(s.time), gap = Real(Number(1)) - ratio * ratio;
    bool below = plain(gap) > Number(0);
    Real safe = below ? gap : -gap;
    if (plain(safe) < Number(1e-12)) safe = Real(Number(1e-12));
    Real angle = root(safe) * eta, decay = exponential(-(ratio * eta)), sine, cosine;
    if (below) {
        sine_cosine(angle, sine, cosine);
    } else {
        cosine = Number(0.5) * (exponential(angle) + exponential(-angle));
    }
    Real trace = Number(2) * decay * cosine, determinant = decay * decay;
    stiffness = Real(Number(1)) + determinant - trace;
    damping = Number(0.5) * (Real(Number(3)) - trace - determinant) - stiffness;
}

// A vector's factor that keeps its squared length below that of a limit.
INLINE Real shortened(Real square, Real limit) {
    return at_most(limit * inverse_root(square + Real(Number(1e-24))), Number(1));
}
#endif
"""
