// Words in which the other files are written, so that one source is the program of a thread of a GPU and of a CPU (HOST).
// Constants in capitals are those of `Structure` in `structure.py`, lists in small letters are functions or arrays of it.
//
// Loops over bodies, slots and laws are unrolled where the numbers of all rounds fit into registers: an array of registers
// has no places that are computed. SPREAD is always unrolled, KEEP_LOOP never: it would only be more code to fetch.
#if HOST
#if WIDE
#define INLINE inline __attribute__((always_inline))
#else
#define INLINE inline
#endif
#define EACH_BODY
#define EACH_SLOT
#define EACH_PAIR
#define EACH_LAW
#define SPREAD
#define KEEP_LOOP
#else
#define INLINE __device__ __forceinline__
#if SHARED
#define EACH_BODY
#else
#define EACH_BODY _Pragma("unroll")
#endif
#define EACH_PAIR _Pragma("unroll 1")
#define EACH_LAW _Pragma("unroll")
#define SPREAD _Pragma("unroll")
#if UNROLLED
#define EACH_SLOT _Pragma("unroll")
#else
#define EACH_SLOT _Pragma("unroll 1")
#endif
#define KEEP_LOOP _Pragma("unroll 1")
#endif
// What the lanes of an environment have in common. Where there is one copy for all of them (SHARED), each does every
// LANES-th part of the work, and waits for the others (`Lanes::sync`) before it reads what they wrote. Otherwise each
// has a copy of its own and does everything. ROOM names an array: in the one copy, or of this lane.
#if SHARED
#define DIVIDED(lanes, i, count) KEEP_LOOP for (int i = (lanes).lane; i < (count); i += LANES)
#define ROOM(Type, name, count, place) Type* const name = (place).name
#else
#define DIVIDED(lanes, i, count) for (int i = 0; i < (count); i++)
#define ROOM(Type, name, count, place) Type name[count]
#endif
// The lanes of an environment, and where they show contacts to each other.
#if SHARED
#define SHOWN_TO(lanes, env) lanes, (env).chain
#else
#define SHOWN_TO(lanes, env) lanes
#endif
// Place of a free body in the arrays of those that only free bodies need.
#if SHARED
#define FREE(b) free_number(b)
#else
#define FREE(b) (b)
#endif
// Loops of a few rounds, whose copies would not fit into the cache of instructions.
#if SHARED
#define INNER _Pragma("unroll 1")
#else
#define INNER
#endif
// The coordinates above one, or that move a link, and other short sums. Unrolled, their code would not fit into the cache
// of instructions: that takes a tenth more time.
#define EACH_ABOVE(k, depth) INNER for (int k = 0; k < (depth); k++)
// The links, without the root of the first chain where that is not free: eight lanes then do sixteen links in two rounds.
#if SHARED
#define MOVED_LINKS(lanes, l) KEEP_LOOP for (int l = FIRST_MOVED + (lanes).lane; l < LINKS; l += LANES)
#else
#define MOVED_LINKS(lanes, l) for (int l = FIRST_MOVED; l < LINKS; l++)
#endif
// Loops along the trees of the chains, from the roots or towards them: links, or coordinates. Lanes do those of one
// level at once.
#if SHARED
#define IN_LEVEL(lanes, x, starts, listed)                                                              \
    KEEP_LOOP for (int at_##x = starts[level] + (lanes).lane; at_##x < starts[level + 1]; at_##x += LANES) \
        for (int x = listed[at_##x], once_##x = 1; once_##x; once_##x = 0)
#define DOWN_LEVELS(lanes, count) KEEP_LOOP for (int level = 0; level < (count); level++, (lanes).sync())
#define UP_LEVELS(lanes, count) KEEP_LOOP for (int level = (count) - 1; level >= 0; level--, (lanes).sync())
#define DOWN_LINKS(lanes, l) DOWN_LEVELS(lanes, LEVELS) IN_LEVEL(lanes, l, level_start, level_link)
#define UP_LINKS(lanes, l) UP_LEVELS(lanes, LEVELS) IN_LEVEL(lanes, l, level_start, level_link)
// joints, one after another in each branch, which has no coordinate in common with another one
#define BRANCHES(lanes, j)                                                                              \
    DIVIDED(lanes, branch, BRANCH_COUNT)                                                                \
        KEEP_LOOP for (int at_j = branch_start[branch]; at_j < branch_start[branch + 1]; at_j++)        \
            for (int j = branch_joint[at_j], once_j = 1; once_j; once_j = 0)
#define DOWN_DOFS(lanes, d) DOWN_LEVELS(lanes, DEPTH) IN_LEVEL(lanes, d, rank_start, rank_dof)
#define UP_DOFS(lanes, d) UP_LEVELS(lanes, DEPTH) IN_LEVEL(lanes, d, rank_start, rank_dof)
#else
#define BRANCHES(lanes, j) for (int j = 0; j < JOINTS; j++)
#define DOWN_LINKS(lanes, l) for (int l = 0; l < LINKS; l++)
#define UP_LINKS(lanes, l) for (int l = LINKS - 1; l >= 0; l--)
#define DOWN_DOFS(lanes, d) for (int d = 0; d < DOFS; d++)
#define UP_DOFS(lanes, d) for (int d = DOFS - 1; d >= 0; d--)
#endif
#define DEEP (MESHES || HULLS)  // labels have gaps weighted by impulses, where slots may have nothing at the frame
// An impulse, or 0 in environments where the contact is not on.
#if WIDE
#define WHERE_ON(c, impulse) WHERE((c).on, impulse)
#define WHERE(on, impulse) choose(on, impulse, none())
#else
#define WHERE_ON(c, impulse) (impulse)
#define WHERE(on, impulse) (impulse)
#endif
#if QUEUED || GATHERED
#define SLOT_OF(contact) (contact)
#else
#define SLOT_OF(contact) ((contact) / LANES)
#endif
#define PAIR_ROOM (PAIRS > 0 ? PAIRS : 1)  // C++ has no arrays without elements
// The touching contacts from `first` on, one after another (LISTED), or those that are on, each in its own slot, which
// keeps them in registers.
#if LISTED
#define EACH_CONTACT(list, first, count) for (int i = first; i < count; i++)
#else
#define EACH_CONTACT(list, first, count) EACH_SLOT for (int i = 0; i < SLOTS; i++) if (list[i].on)
#endif
