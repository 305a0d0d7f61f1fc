// What the programs of the renderer on the CPU have in common, see `raster_host`; C++14. SINGLE chooses the numbers.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <pthread.h>

#define INLINE static inline __attribute__((always_inline))

#if SINGLE
typedef float Number;
typedef int32_t Word;
#define MANTISSA_BITS 23
#define EXPONENT_BIAS 127
#define LOWEST -87.0f
#define HIGHEST 88.0f
#define TERMS 7
#else
typedef double Number;
typedef int64_t Word;
#define MANTISSA_BITS 52
#define EXPONENT_BIAS 1023
#define LOWEST -708.0
#define HIGHEST 709.0
#define TERMS 13
#endif
template <class T>
struct Array {  // zeros at first
    T* const values;
    Array(int64_t count) : values(new T[count]()) {}
    Array(const Array&) = delete;
    ~Array() { delete[] values; }
};

// Calls `work` with the same argument in several threads, of which each takes what is left to do.
static void in_threads(int threads, void* (*work)(void*), void* shared) {
    pthread_t* others = new pthread_t[threads];
    int count = 0;  // where the system gives no more threads, those that there are do the work
    while (count + 1 < threads && pthread_create(&others[count], nullptr, work, shared) == 0) count++;
    work(shared);
    while (count > 0) pthread_join(others[--count], nullptr);
    delete[] others;
}
