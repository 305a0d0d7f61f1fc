// What is known of two hulls: edges, how these cross, and how the hulls part best.
#if PAIRED
#if !HULLS
struct Parting {};
#else
struct Edge {  // between two faces of a hull, in any frame: see physics/edge_contact.py
    Vec start, along, inward, other_inward;
    Real radius, widening;
};

struct Crossing {  // the common normal of two edges, out of the first body
    Vec normal;
    Real gap, place;
    Number lean;  // by how much the normal leans towards a face of either edge
    bool within;  // whether its feet lie within the edges
    bool leaves;  // whether the first edge, from its first to its second end, leaves the other body
};

#define MARKED (HOST && !GATHERED)  // whether lists of edges have marks, and more room
#define NOTED (HOST || GATHERED)    // whether edges that may be a contact are kept
const int NEAR_ROOM = MARKED ? 64 : 32;
struct Near {  // edges of a hull that are near another one; all of them where more are than there is room for
    int count, listed[NEAR_ROOM];
#if MARKED
    unsigned long long marks;  // of the listed edges by their number modulo 64
#endif
    INLINE void clear() {
        count = 0;
#if MARKED
        marks = 0;
#endif
    }
    INLINE int many(int ridges) const { return count < 0 ? ridges : count; }
    INLINE int edge(int i) const { return count < 0 ? i : listed[i]; }
    INLINE void add(int edge) {
        if (count == NEAR_ROOM) count = -1;
        if (count >= 0) listed[count++] = edge;
#if MARKED
        marks |= 1ULL << (edge & 63);
#endif
    }
    INLINE bool has(int edge) const {
#if MARKED
        if (count >= 0 && !(marks >> (edge & 63) & 1)) return false;
#endif
        bool found = count < 0;
        for (int i = 0; i < count; i++) found = found || listed[i] == edge;
        return found;
    }
};

#if NOTED
const int MET_ROOM = MARKED ? 64 : 32;
struct Met {  // edges of two hulls that may be a contact, without derivatives
    int edge, other;  // of a, and the number of the near edge of b
    bool leaves;      // as `edge_leaves`
    Number gap, normal[3];
};
#endif

struct Parting {  // how two hulls part best
    int on_a, on_b;  // faces that lie flat on each other, -1 for none: parallel to the face that parts them best
    Number axis[3];  // normal of a face or of two edges along which the gap is largest, out of a
    Number gap;      // no point of one hull is nearer to the other one
    Mat turn;        // of the frame of b into that of a, with `shift`
    Vec shift;
    Near near_a, near_b;
#if HOST || GATHERED
    Edge placed_b[NEAR_ROOM];  // the near edges of b in the frame of a, where there is room for them
#endif
#if NOTED
    Met met[MET_ROOM];  // on a CPU sorted by the near edge of b
    int met_count;      // -1: there are more than there is room for
#if MARKED
    unsigned long long marks;  // of their edges of a by the number modulo 64
    // Whether a slot of edges has surely no contact.
    INLINE bool never(int slot) const { return met_count >= 0 && !(marks >> (slot / 2 & 63) & 1); }
#endif
    INLINE void meet(int edge, int other, const Crossing& crossing) {
#if MARKED
        if (met_count == MET_ROOM) met_count = -1;
        if (met_count < 0) return;
        const int place = met_count++;
        marks |= 1ULL << (edge & 63);
#else
        const int place = Lanes::count_up(met_count);
        if (place >= MET_ROOM) return;
#endif
        Met& one = met[place];
        one.edge = edge;
        one.other = other;
        one.leaves = crossing.leaves;
        one.gap = plain(crossing.gap);
        one.normal[0] = plain(crossing.normal.x);
        one.normal[1] = plain(crossing.normal.y);
        one.normal[2] = plain(crossing.normal.z);
    }
#endif
};
#endif
#endif
