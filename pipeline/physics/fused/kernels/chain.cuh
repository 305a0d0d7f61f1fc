// What is known of chains, and the memory in which the lanes of an environment work on them together.
#if LINKS
// Links of chains, joined in trees: numbers of each environment, in the order in which they are read from the table.
// The lists of the structure: link_body, link_parent (-1: root), link_kind (0: root that is fixed or driven, 1: free
// root, 2: hinge, 3: slide, 4: fixed joint), link_light (1: without mass, fixed to another, carries only such), link_dof
// (first coordinate of its own, -1: none), link_depth (coordinates that move it) and link_above (these, DEPTH a link);
// column_start (place of its first coordinate among those of all links) and column_link; dof_link, dof_joint (-1: none),
// dof_depth, dof_above (a coordinate and those above it); joint_dof; chain_root (a link), chain_joint (its first),
// chain_joints, chain_command (-1: none).
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

#if SHARED
// Numbers of the table, which are read where they are needed: there is no room for copies of them.
struct Joints {
    Input table;
    long long first;
    INLINE Joint operator[](int l) const;
};

struct Servos {
    Input table;
    long long first;
    INLINE Servo operator[](int j) const;
};
#endif

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
    Real masses[LINKS];
    Vec coms[LINKS];
    Sym inertias[LINKS];
#endif
};

#if SHARED
// Where the lanes of an environment work together, by parts of a step, which follow one another.
struct PlaceRoom {
    Vec positions[LINKS], linear[LINKS], angular[LINKS];
    Quat quats[LINKS];
};

#if HEAVY
struct MassRoom {  // in `add_mass`
    Real mass[LINKS];
    Vec moment[LINKS];
    Sym inertia[LINKS];
};

struct ForceRoom {  // in `bias_of`
    Spatial velocity[LINKS], force_on[LINKS];
};
#endif

struct KickRoom {  // in `kick`
#if HEAVY
    Configuration at[1];
    union {
        MassRoom mass;
        ForceRoom force;
        PlaceRoom place;
    };
    Real bias[DOFS], mean[DOFS], halfway[JOINTS + 1];
#else
    PlaceRoom place;
#endif
    Vec lift[CHAINS], twist[CHAINS], root_linear[CHAINS], root_angular[CHAINS];
    Real first[DOFS], own[DOFS], kept[DOFS], y[DOFS], moving[JOINTS + 1];
};

struct ContactRoom {  // where each lane shows a contact to the others
    Vec first[LANES], second[LANES], third[LANES];
    Real weight[LANES];
    int bodies[LANES];  // as `bodies_of`; -1 where the lane has none
#if RECORD && LAWS > 1
    Real friction[LANES];
#endif
};

#if QUEUED  // see `make_queued`
const int WAITING = 4 * LANES;
struct QueueRoom {  // where lanes leave slots of which another lane makes the contact
    int slots[WAITING];
    Vec before[WAITING];  // its impulse in the previous step
    Nearness known[WAITING];  // of its sphere's centre and the other body
};

struct MoveRoom {  // where lanes leave contacts for other lanes
    Contact contacts[LANES];
    Real weights[LANES];
};
#endif

#if GATHERED
struct CollideRoom {  // in `collide`
    Column columns[COLUMNS + 1];
    Contact list[CROWD];  // in the order in which threads found them
    Real weights[CROWD];
    short pairs[CROWD], order[CROWD];  // pair of each; places in the list by pair and number
    int gathered;                      // also of those that have no room in it
    union {
        Parting partings[LANES / WARP];  // of the pairs that warps are at
        struct {                         // what contacts show to each other, and to bodies, by their order
            Vec first[CROWD], second[CROWD], third[CROWD];
            Real weight[CROWD];
        };
    };
#if PATCHES
    Real totals[CROWD];
#endif
    Vec pushes[LINKS + FREES], moments[LINKS + FREES];  // on links and free bodies, by the contacts
    Velocities free[LINKS + FREES];                     // of the same without contact
    // of each of these that contacts may move: number of its contacts, and place of the first one in the list of all; these
    // are places by order, of body b with all bits changed
    short acting_start[LINKS + FREES], acting_first[LINKS + FREES], acting[2 * CROWD];
    Number limits[PAIR_ROOM], nears[PAIR_ROOM];  // see `Reach`
    bool near[PAIR_ROOM], touched[PAIR_ROOM];    // pairs that may touch, and those that do
    short nearby[PAIR_ROOM], nearby_count;       // the first ones
    int groups[BODIES];
    int reached[LINKS + FREES], reached_count;  // links that are known, then LINKS + numbers of the free bodies
};
#else
struct CollideRoom {  // in `collide`
    Column columns[COLUMNS + 1];
    union {
        struct {
            Vec pushes[LINKS + FREES], moments[LINKS + FREES];  // on links and free bodies, by the contacts
            Velocities free[LINKS + FREES];                     // of the same without contact
        };
#if QUEUED
        QueueRoom queue;
        MoveRoom moved;
#endif
    };
    ContactRoom contacts;
    Number limits[PAIR_ROOM], nears[PAIR_ROOM];  // see `Reach`
    bool near[PAIR_ROOM], touched[PAIR_ROOM];    // pairs that may touch, and those that do
    int groups[BODIES];
    int reached[LINKS + FREES], reached_count;  // links that are known, then LINKS + numbers of the free bodies
};
#endif

struct SettleRoom {  // in `settle` and `spread`
    PlaceRoom place;
    Real first[DOFS];
};
#endif

struct Chain {
#if SHARED
    Joints joints;
    Servos servos;
#else
    Joint joints[LINKS];
    Servo servos[JOINTS + 1];
#endif
    Real values[JOINTS + 1], speeds[JOINTS + 1];
    Real impulses[3 * JOINTS + 1];  // of the previous step: lower limit, upper limit, dry friction
    int cursors[CHAINS];
    // of the step
    Real speed[DOFS], inverse[DOFS * DEPTH];  // without contact; rows of the inverse of L, A = L^T L
    Real moved[DOFS];                         // what impulses change, mass-weighted
    Real lower[JOINTS + 1], upper[JOINTS + 1], most[JOINTS + 1];  // speeds of the limits, impulse of dry friction
    Real mobility[JOINTS + 1], masses[JOINTS + 1];                // of the joints that may have impulses
    Vec axes[LINKS];
#if SHARED
    Real free_masses[FREES];  // inverse, and of inertia in world axes
    Sym free_inertias[FREES];
    union {
        KickRoom kick;
        CollideRoom collide;
        SettleRoom settle;
    } room;
#else
    Column columns[LINKS * DEPTH];
#endif
    bool known[LINKS], active;
    bool acts[JOINTS + 1], busy[JOINTS + 1];  // joints that may have impulses, and those that may in this step
};

INLINE Joint joint_at(const Input& table, long long at) {
    Quat quat = {table.at(at + 3), table.at(at + 4), table.at(at + 5), table.at(at + 6)};
    Sym inertia = {table.at(at + 11), table.at(at + 12), table.at(at + 13),
                   table.at(at + 14), table.at(at + 15), table.at(at + 16)};
    Joint joint = {table.vector(at), table.vector(at + 7), quat, table.at(at + 10), inertia, table.vector(at + 17)};
    return joint;
}

INLINE Servo servo_at(const Input& table, long long at) {
    Servo servo = {table.at(at),     table.at(at + 1), table.at(at + 2), table.at(at + 3),
                   table.at(at + 4), table.at(at + 5), table.at(at + 6)};
    return servo;
}

#if SHARED
INLINE Joint Joints::operator[](int l) const { return joint_at(table, first + LINK_COLUMNS * l); }
INLINE Servo Servos::operator[](int j) const { return servo_at(table, first + JOINT_COLUMNS * j); }
#endif

// Reads the chains from the column `first` of the table on, and returns the column after them.
INLINE long long load_chain(const Input& table, long long first, const Lanes& lanes, Chain& chain) {
#if SHARED
    if (lanes.writes()) {
        Joints joints = {table, first};
        Servos servos = {table, first + LINK_COLUMNS * LINKS};
        chain.joints = joints;
        chain.servos = servos;
    }
#else
    for (int l = 0; l < LINKS; l++) chain.joints[l] = joint_at(table, first + LINK_COLUMNS * l);
#endif
    first += LINK_COLUMNS * LINKS;
    DIVIDED(lanes, k, JOINTS) {
        long long at = first + JOINT_COLUMNS * k;
        Servo s = servo_at(table, at);
#if !SHARED
        chain.servos[k] = s;
#endif
        chain.values[k] = table.at(at + 7);
        chain.speeds[k] = table.at(at + 8);
        for (int i = 0; i < 3; i++) chain.impulses[3 * k + i] = Real(0);
        chain.acts[k] = plain(s.lower) > Number(-1e30) || plain(s.upper) < Number(1e30) || plain(s.friction) > Number(0);
    }
    for (int c = 0; c < CHAINS; c++) chain.cursors[c] = 0;
    return first + JOINT_COLUMNS * JOINTS;
}
#endif
