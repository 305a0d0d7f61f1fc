#if HOST
#define INLINE inline
#define EACH_BODY
#define EACH_SLOT
#define EACH_PAIR
#define EACH_LAW
#define SPREAD
#define KEEP_LOOP
#else
#define INLINE __device__ __forceinline__
#define EACH_BODY _Pragma("unroll")
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
#define DEEP (MESHES || HULLS)  // labels have gaps weighted by impulses, where slots may have nothing at the frame
#define PAIR_ROOM (PAIRS > 0 ? PAIRS : 1)  // C++ has no arrays without elements
// The touching contacts from `first` on, one after another (LISTED), or those that are on, each in its own slot, which
// keeps them in registers.
#if LISTED
#define EACH_CONTACT(list, first, count) for (int i = first; i < count; i++)
#else
#define EACH_CONTACT(list, first, count) EACH_SLOT for (int i = 0; i < SLOTS; i++) if (list[i].on)
#endif
