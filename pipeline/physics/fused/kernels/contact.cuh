struct Contact {  // world frame, impulse on body a
    Vec arm, impulse;
    Real target, stop_n, stop_t;
#if LAWS > 1
    Real friction;
#endif
#if SURFACE
    Real friction;
#if PAIRED
    Vec steady;                // fixed impulse (viscosity)
    Real stiffness, damping;   // of its law, at the speed at which it meets
    Real across, about;        // angular mass that it may stop across its normal and about it
#else
    Real steady_x, steady_y;  // fixed impulses (viscosity)
#endif
    Vec turning;  // angular impulse of rolling and torsional friction
#if ELLIPTIC
    Ellipse ellipse;  // replaces the friction coefficient
#endif
#endif
#if PAIRED
    Vec normal, arm_b;
    Real gap;
    int a, b;  // b: -1 for the ground, -2 for a fixed surface
#endif
#if LISTED
    int slot;  // `SLOT_OF` its number
#if WIDE
    Flag on;
#endif
#else
    bool on;
#endif
};

#if PAIRED
struct Nearness {  // what is known of a point and the spheres of a body
    Number nearest;    // distance of the nearest one
    unsigned members;  // one bit for each, or for several, of those that may take part in the smooth distance
};
#endif
