#if LINKS
// Links of chains, joined in trees: numbers of each environment, in the order in which they are read from the table.
// The lists of the structure: link_body, link_parent (-1: root), link_kind (0: root that is fixed or driven, 1: free
// root, 2: hinge, 3: slide, 4: fixed joint), link_light (1: without mass, fixed to another, carries only such), link_dof
// (first coordinate of its own, -1: none), link_depth (coordinates that move it) and link_above (these, DEPTH a link);
// dof_link, dof_depth, dof_above (a coordinate and those above it); joint_dof; chain_root (a link), chain_joint (its
// first), chain_joints, chain_command (-1: none).
struct Joint {
    Vec position, axis;  // origin in the parent's frame at value 0, axis in the link's
    Quat quat;
    Real mass;
    Sym inertia;  // about the centre of mass, link axes
    Vec com;
};

struct Servo {
    Real lower, upper, stiffness, damping, armature, friction, torque_limit;
};

struct Column {  // velocity of a link's origin and its angular velocity by one mass-weighted coordinate
    Vec linear, turning;
};

struct Spatial {  // angular and linear part, about the root's origin
    Vec turning, moving;
};

// A configuration of all chains: world axes, each chain about its root's origin.
struct Configuration {
    Spatial joints[LINKS];
#if HEAVY
    Vec coms[LINKS];
    Sym inertias[LINKS];
#endif
};

#if SHARED
// Where the lanes of an environment work together on the motion of the chains.
struct PlaceRoom {  // in `kick` and `spread`
    Vec positions[LINKS], linear[LINKS], angular[LINKS];
    Quat quats[LINKS];
};

struct ContactRoom {  // where each lane shows a contact to the others
    Vec first[LANES], second[LANES], third[LANES];
    Real weight[LANES];
    int bodies[LANES];  // as `bodies_of`; -1 where the lane has none
};

struct FreeRoom {  // in `collide`
    Vec free_velocities[BODIES], free_omegas[BODIES];
    ContactRoom contacts;
};

struct ChainRoom {
    union {
        PlaceRoom place;
        FreeRoom free;
    };
    Vec lift[CHAINS], twist[CHAINS];
    Real first[DOFS], own[DOFS], kept[DOFS], bias[DOFS], mean[DOFS], y[DOFS];
    Real halfway[JOINTS + 1], moving[JOINTS + 1];
    Column single[DEPTH];
};

#if HEAVY
struct MassRoom {  // in `add_mass`
    Real mass[LINKS];
    Vec moment[LINKS];
    Sym inertia[LINKS];
};

struct ForceRoom {  // in `bias_of`
    Spatial velocity[LINKS], change[LINKS], force_on[LINKS];
};

struct KickRoom {
    Configuration at[1];
    union {
        MassRoom mass;
        ForceRoom force;
    };
};
#endif
#endif

struct Chain {
    Joint joints[LINKS];
    Servo servos[JOINTS + 1];
    Real values[JOINTS + 1], speeds[JOINTS + 1];
    Real impulses[3 * JOINTS + 1];  // of the previous step: lower limit, upper limit, dry friction
    int cursors[CHAINS];
    // of the step
    Real speed[DOFS], inverse[DOFS * DEPTH];  // without contact; rows of the inverse of L, A = L^T L
    Real moved[DOFS];                         // what impulses change, mass-weighted
    Real lower[JOINTS + 1], upper[JOINTS + 1];
    Vec axes[LINKS];
#if SHARED
    union {
#if HEAVY
        KickRoom before;
#endif
        struct {  // when the motion without contact is known
            Column columns[LINKS * DEPTH];
            Vec pushes[LINKS + FREES], moments[LINKS + FREES];  // on the reached bodies, by the contacts
        };
    };
#else
    Column columns[LINKS * DEPTH];
#endif
    bool known[LINKS], active;
#if SHARED
    int reached[LINKS + FREES], reached_links, reached_count;  // bodies of the links that are known, and free ones
#endif
    bool acts[JOINTS + 1];
#if SHARED
    ChainRoom room;
#endif
};

// Reads the chains from the column `first` of the table on, and returns the column after them.
INLINE long long load_chain(const Input& table, long long first, const Lanes& lanes, Chain& chain) {
    DIVIDED(lanes, l, LINKS) {
        long long at = first + 20 * l;
        Joint& j = chain.joints[l];
        j.position = table.vector(at);
        Quat quat = {table.at(at + 3), table.at(at + 4), table.at(at + 5), table.at(at + 6)};
        j.quat = quat;
        j.axis = table.vector(at + 7);
        j.mass = table.at(at + 10);
        Sym inertia = {table.at(at + 11), table.at(at + 12), table.at(at + 13),
                       table.at(at + 14), table.at(at + 15), table.at(at + 16)};
        j.inertia = inertia;
        j.com = table.vector(at + 17);
    }
    first += 20 * LINKS;
    DIVIDED(lanes, k, JOINTS) {
        long long at = first + 9 * k;
        Servo& s = chain.servos[k];
        s.lower = table.at(at);
        s.upper = table.at(at + 1);
        s.stiffness = table.at(at + 2);
        s.damping = table.at(at + 3);
        s.armature = table.at(at + 4);
        s.friction = table.at(at + 5);
        s.torque_limit = table.at(at + 6);
        chain.values[k] = table.at(at + 7);
        chain.speeds[k] = table.at(at + 8);
        for (int i = 0; i < 3; i++) chain.impulses[3 * k + i] = Real(0);
        chain.acts[k] = plain(s.lower) > Number(-1e30) || plain(s.upper) < Number(1e30) || plain(s.friction) > Number(0);
    }
    for (int c = 0; c < CHAINS; c++) chain.cursors[c] = 0;
    return first + 9 * JOINTS;
}
#endif
