#if HOST
#define INLINE inline
#define EACH_BODY
#define EACH_SLOT
#define EACH_PAIR
#define KEEP_LOOP
#else
#define INLINE __device__ __forceinline__
#define EACH_BODY _Pragma("unroll")
#define EACH_PAIR _Pragma("unroll 1")
#if UNROLLED
#define EACH_SLOT _Pragma("unroll")
#else
#define EACH_SLOT _Pragma("unroll 1")
#endif
#define KEEP_LOOP _Pragma("unroll 1")
#endif
