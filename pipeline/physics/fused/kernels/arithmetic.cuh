// Numbers (values, or values with derivatives), vectors, rotations, and exchanges between the threads of an environment.
#define FULL 0xffffffffu
#if WIDE
typedef Wide Number;
#elif SINGLE
typedef float Number;
#else
typedef double Number;
#endif
#if !WIDE
typedef Number Stored;  // a number in an array of the inputs or results
#endif

__device__ inline float lesser(float a, float b) { return a < b ? a : b; }
__device__ inline double lesser(double a, double b) { return a < b ? a : b; }
__device__ inline float greater(float a, float b) { return a > b ? a : b; }
__device__ inline double greater(double a, double b) { return a > b ? a : b; }
__device__ inline float exponential(float x) { return expf(x); }
__device__ inline double exponential(double x) { return exp(x); }
__device__ inline float logarithm(float x) { return logf(x); }
__device__ inline double logarithm(double x) { return log(x); }
__device__ inline float log_of_one_and(float x) { return log1pf(x); }
__device__ inline double log_of_one_and(double x) { return log1p(x); }
__device__ inline double reciprocal(double x) { return 1.0 / x; }
__device__ inline double root(double x) { return sqrt(x); }
#if HOST
inline float reciprocal(float x) { return 1.0f / x; }
inline float inverse_root(float x) { return 1.0f / sqrtf(x); }
inline double inverse_root(double x) { return 1.0 / sqrt(x); }
inline float root(float x) { return sqrtf(x); }
inline void sine_cosine(float x, float& s, float& c) { s = sinf(x); c = cosf(x); }
inline void sine_cosine(double x, double& s, double& c) { s = sin(x); c = cos(x); }
#else
// Accurate to 2 units in the last place, and one instruction each: the exact functions branch and take ten times as long,
// and those that scale numbers below 1e-38 (`.ftz` takes them as 0) are eight instructions, of which there are hundreds.
__device__ inline float reciprocal(float x) {
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
__device__ inline float inverse_root(float x) {
    float y;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
__device__ inline double inverse_root(double x) { return rsqrt(x); }
__device__ inline float root(float x) {  // 0 of negative numbers
    float y;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(fmaxf(x, 0.0f)));
    return y;
}
__device__ inline void sine_cosine(float x, float& s, float& c) { s = __sinf(x); c = __cosf(x); }
__device__ inline void sine_cosine(double x, double& s, double& c) { sincos(x, &s, &c); }
#endif

// A quotient. In single precision on a GPU, even one exact division in a kernel is a call, for which a tenth of the code is
// added around it.
__device__ inline double quotient(double a, double b) { return a / b; }
#if HOST
inline float quotient(float a, float b) { return a / b; }
#else
__device__ inline float quotient(float a, float b) { return a * reciprocal(b); }
#endif

// A value and its directional derivative (dual number): the same source computes values and forward derivatives.
template <class T>
struct Dual {
    T value, tangent;
    Dual() = default;
    __device__ Dual(T v) : value(v), tangent(0) {}
    __device__ Dual(T v, T t) : value(v), tangent(t) {}
    __device__ friend Dual operator-(Dual a) { return Dual(-a.value, -a.tangent); }
    __device__ friend Dual operator+(Dual a, Dual b) { return Dual(a.value + b.value, a.tangent + b.tangent); }
    __device__ friend Dual operator-(Dual a, Dual b) { return Dual(a.value - b.value, a.tangent - b.tangent); }
    __device__ friend Dual operator*(Dual a, Dual b) {
        return Dual(a.value * b.value, a.tangent * b.value + a.value * b.tangent);
    }
    __device__ friend Dual operator*(T a, Dual b) { return Dual(a * b.value, a * b.tangent); }
    __device__ friend Dual operator*(Dual a, T b) { return Dual(a.value * b, a.tangent * b); }
    __device__ Dual& operator+=(Dual b) { return *this = *this + b; }
    __device__ Dual& operator-=(Dual b) { return *this = *this - b; }
};

template <class T> __device__ inline Dual<T> reciprocal(Dual<T> x) {
    T inverse = reciprocal(x.value);
    return Dual<T>(inverse, -x.tangent * inverse * inverse);
}
template <class T> __device__ inline Dual<T> inverse_root(Dual<T> x) {
    T inverse = inverse_root(x.value);
    return Dual<T>(inverse, T(-0.5) * x.tangent * inverse * inverse * inverse);
}
template <class T> __device__ inline Dual<T> root(Dual<T> x) {
    T value = root(x.value);
    return Dual<T>(value, value > T(0) ? T(0.5) * x.tangent * reciprocal(value) : T(0));
}
template <class T> __device__ inline Dual<T> exponential(Dual<T> x) {
    T value = exponential(x.value);
    return Dual<T>(value, x.tangent * value);
}
template <class T> __device__ inline Dual<T> logarithm(Dual<T> x) {
    return Dual<T>(logarithm(x.value), x.tangent * reciprocal(x.value));
}
template <class T> __device__ inline void sine_cosine(Dual<T> x, Dual<T>& s, Dual<T>& c) {
    sine_cosine(x.value, s.value, c.value);
    s.tangent = x.tangent * c.value;
    c.tangent = -x.tangent * s.value;
}

#if DUAL
typedef Dual<Number> Real;
__device__ inline Number plain(Real x) { return x.value; }
#else
typedef Number Real;
__device__ inline Number plain(Real x) { return x; }
#endif
// Whether a number that multiplies a term is 0, so that the term need not be computed; with derivatives it is needed.
__device__ inline bool absent(Real x) {
#if HOST && !DUAL
    return every(x == Number(0));
#else
    return false;
#endif
}
#if !WIDE
__device__ inline Real choose(bool condition, Real yes, Real no) { return condition ? yes : no; }
#endif
__device__ inline Real at_least(Real x, Number low) { return choose(plain(x) >= low, x, Real(low)); }
__device__ inline Real at_most(Real x, Number high) { return choose(plain(x) <= high, x, Real(high)); }
__device__ inline Real square(Real x) { return x * x; }

struct Vec {
    Real x, y, z;
};
__device__ inline Vec vec(Real x, Real y, Real z) { Vec v = {x, y, z}; return v; }
#if WIDE
inline Vec choose(Flag condition, Vec yes, Vec no) {
    return vec(choose(condition, yes.x, no.x), choose(condition, yes.y, no.y), choose(condition, yes.z, no.z));
}
#endif
__device__ inline Vec none() { return vec(Real(0), Real(0), Real(0)); }
__device__ inline Vec operator+(Vec a, Vec b) { return vec(a.x + b.x, a.y + b.y, a.z + b.z); }
__device__ inline Vec operator-(Vec a, Vec b) { return vec(a.x - b.x, a.y - b.y, a.z - b.z); }
__device__ inline Vec operator-(Vec a) { return vec(-a.x, -a.y, -a.z); }
__device__ inline Vec operator*(Real s, Vec a) { return vec(s * a.x, s * a.y, s * a.z); }
__device__ inline Real dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
__device__ inline Vec cross(Vec a, Vec b) {
    return vec(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
__device__ inline Number size(Vec a) {
    Number x = plain(a.x), y = plain(a.y), z = plain(a.z);
    return root(x * x + y * y + z * z);
}

struct Velocities {  // of a body
    Vec velocity, omega;
};

struct Quat {
    Real w, x, y, z;
};
__device__ inline Quat multiply(Quat a, Quat b) {
    Quat q = {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
              a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
    return q;
}
__device__ inline Quat normalized(Quat q) {
    Real norm2 = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z;
#if HOST && !SINGLE
    Real off = norm2 - Real(1);
    Flag near = (plain(off) < Number(1e-6)) & (plain(off) > Number(-1e-6));
    Real s = Real(1) - off * (Real(0.5) - Number(0.375) * off);  // a series, exact to rounding, without root and division
    if (!every(near)) s = choose(near, s, inverse_root(norm2));
#else
    Real s = inverse_root(norm2);
#endif
    Quat unit = {s * q.w, s * q.x, s * q.y, s * q.z};
    return unit;
}
__device__ inline Quat quat_exp(Vec v) {
    Real angle2 = dot(v, v), cosine, sinc;
#if SINGLE
    if (plain(angle2) < Number(1)) {  // exact to single precision, without a square root
        Real half2 = Number(0.25) * angle2;
        cosine = Real(1) + half2 * (Real(Number(-1.0 / 2)) + half2 * (Real(Number(1.0 / 24)) + half2 *
                 (Real(Number(-1.0 / 720)) + half2 * Number(1.0 / 40320))));
        sinc = Real(Number(0.5)) + half2 * (Real(Number(-1.0 / 12)) + half2 * (Real(Number(1.0 / 240)) + half2 *
               (Real(Number(-1.0 / 10080)) + half2 * Number(1.0 / 725760))));
#elif WIDE
    Real half2 = Number(0.25) * angle2;
    cosine = Real(1) + half2 * (Real(Number(-1.0 / 2)) + half2 * (Real(Number(1.0 / 24)) + half2 *
             (Real(Number(-1.0 / 720)) + half2 * (Real(Number(1.0 / 40320)) + half2 * Number(-1.0 / 3628800)))));
    sinc = Real(Number(0.5)) + half2 * (Real(Number(-1.0 / 12)) + half2 * (Real(Number(1.0 / 240)) + half2 *
           (Real(Number(-1.0 / 10080)) + half2 * (Real(Number(1.0 / 725760)) +
                                                  half2 * Number(-1.0 / 79833600)))));
    Flag small = plain(angle2) < Number(0.04);
    if (!every(small)) {
        Real half = Number(0.5) * root(angle2), sine, exact;
        sine_cosine(half, sine, exact);
        sinc = choose(small, sinc, sine * reciprocal(Number(2) * half));
        cosine = choose(small, cosine, exact);
#elif HOST
    if (plain(angle2) < Number(0.04)) {  // exact to double precision, in a third of the time of a sine
        Real half2 = Number(0.25) * angle2;
        cosine = Real(1) + half2 * (Real(Number(-1.0 / 2)) + half2 * (Real(Number(1.0 / 24)) + half2 *
                 (Real(Number(-1.0 / 720)) + half2 * (Real(Number(1.0 / 40320)) + half2 * Number(-1.0 / 3628800)))));
        sinc = Real(Number(0.5)) + half2 * (Real(Number(-1.0 / 12)) + half2 * (Real(Number(1.0 / 240)) + half2 *
               (Real(Number(-1.0 / 10080)) + half2 * (Real(Number(1.0 / 725760)) +
                                                      half2 * Number(-1.0 / 79833600)))));
#else
    if (plain(angle2) < Number(1e-8)) {  // the series is exact to double precision
        cosine = Real(1) - Number(0.125) * angle2;
        sinc = Real(Number(0.5)) - Number(1.0 / 48) * angle2;
#endif
#if !WIDE
    } else {
        Real half = Number(0.5) * root(angle2), sine;
        sine_cosine(half, sine, cosine);
        sinc = sine * reciprocal(Number(2) * half);
#endif
    }
    Quat q = {cosine, sinc * v.x, sinc * v.y, sinc * v.z};
    return q;
}

struct Mat {
    Vec x, y, z;  // rows
};
__device__ inline Mat matrix(Quat q) {
    Real x2 = q.x + q.x, y2 = q.y + q.y, z2 = q.z + q.z;
    Real xx = q.x * x2, yy = q.y * y2, zz = q.z * z2, xy = q.x * y2, xz = q.x * z2, yz = q.y * z2;
    Real wx = q.w * x2, wy = q.w * y2, wz = q.w * z2;
    Mat R = {vec(Real(1) - yy - zz, xy - wz, xz + wy), vec(xy + wz, Real(1) - xx - zz, yz - wx),
             vec(xz - wy, yz + wx, Real(1) - xx - yy)};
    return R;
}
__device__ inline Vec operator*(const Mat& R, Vec v) { return vec(dot(R.x, v), dot(R.y, v), dot(R.z, v)); }
__device__ inline Vec transposed(const Mat& R, Vec v) { return v.x * R.x + v.y * R.y + v.z * R.z; }

struct Sym {
    Real xx, yy, zz, xy, xz, yz;
};
__device__ inline Vec operator*(const Sym& S, Vec v) {
    return vec(S.xx * v.x + S.xy * v.y + S.xz * v.z, S.xy * v.x + S.yy * v.y + S.yz * v.z,
               S.xz * v.x + S.yz * v.y + S.zz * v.z);
}
__device__ inline Real trace(const Sym& S) { return S.xx + S.yy + S.zz; }
__device__ inline Sym turned(const Mat& R, const Sym& S) {  // R S R^T
    Vec x = S * R.x, y = S * R.y, z = S * R.z;
    Sym T = {dot(R.x, x), dot(R.y, y), dot(R.z, z), dot(R.x, y), dot(R.x, z), dot(R.y, z)};
    return T;
}
// Solves S x = v by cofactors.
__device__ inline Vec solved(const Sym& S, Vec v) {
    Sym minors = {S.yy * S.zz - S.yz * S.yz, S.xx * S.zz - S.xz * S.xz, S.xx * S.yy - S.xy * S.xy,
                  S.xz * S.yz - S.xy * S.zz, S.xy * S.yz - S.xz * S.yy, S.xy * S.xz - S.yz * S.xx};
    Real each = reciprocal(S.xx * minors.xx + S.xy * minors.xy + S.xz * minors.xz);
    return each * (minors * v);
}
__device__ inline Sym no_inertia() {
    Sym S = {Real(0), Real(0), Real(0), Real(0), Real(0), Real(0)};
    return S;
}

// An input that may carry a derivative.
struct Input {
    const Stored* __restrict__ value;
    const Stored* __restrict__ tangent;  // null: constant
#if WIDE
    Real at(Place place) const {
        Row row;
        for (int k = 0; k < WIDE; k++) row[k] = value[place.of[k]];
        return Real(row);
    }
#else
    __device__ Real at(long long index) const {
#if DUAL
        return Real(value[index], tangent ? tangent[index] : Number(0));
#else
        return value[index];
#endif
    }
#endif
    __device__ Vec vector(Place index) const { return vec(at(index), at(index + 1), at(index + 2)); }
};

#if !WIDE
struct alignas(16) AlignedRow {
    Number a, b, c, d;
};

// Writes four numbers in one store.
__device__ inline void write_row(Number* to, Number a, Number b, Number c, Number d) {
    AlignedRow row = {a, b, c, d};
    *reinterpret_cast<AlignedRow*>(to) = row;
}
#endif

// The LANES neighbouring threads that simulate one environment; all of them hold the same state, or share one copy of
// it (SHARED). At every exchange between threads the whole warp takes part, even if only some of its environments need
// it: in a divergent warp an exchange takes ten times as long. Where a block simulates one environment (GATHERED), its warps
// wait for each other, but exchange nothing by way of registers.
struct Lanes {
    int lane;
    bool idle;  // surplus lanes without an environment, which must not write results
    // Whether this lane writes what there is one copy of.
    __device__ bool writes() const { return !SHARED || lane == 0; }
    // Waits for the other lanes, whose writes into the one copy then are there. The whole warp takes part here, too.
    __device__ void sync() const {
#if GATHERED
        __syncthreads();
#elif SHARED
        __syncwarp(FULL);
#endif
    }
    // Whether the condition holds in any environment of the warp; with LANES = 1, without exchanges, in this one.
    __device__ bool any(bool mine) const {
#if LANES == 1
        return mine;
#else
        return __any_sync(FULL, mine);
#endif
    }
#if WIDE
    bool any(Flag mine) const { return some(mine); }
#endif
    // Sum of the numbers of the lanes before this one, and of all.
    __device__ int before(int mine, int& all) const {
        int sum = mine;
#if LANES > 1
#pragma unroll
        for (int apart = 1; apart < LANES; apart *= 2) {
            const int other = from(sum, (lane - apart) & (LANES - 1));
            if (lane >= apart) sum += other;
        }
#endif
        all = from(sum, LANES - 1);
        return sum - mine;
    }
    // Adds one to a number that other lanes may raise at the same time, and returns what it was.
    __device__ static int count_up(int& number) {
#if HOST
        return number++;
#else
        return atomicAdd(&number, 1);
#endif
    }
    __device__ int from(int mine, int source) const {
#if LANES == 1
        return mine;
#else
        return __shfl_sync(FULL, mine, source, LANES);
#endif
    }
    __device__ Number from(Number mine, int source) const {
#if LANES == 1
        return mine;
#else
        return __shfl_sync(FULL, mine, source, LANES);
#endif
    }
    __device__ Number sum(Number mine) const {
#if LANES > 1
#pragma unroll
        for (int apart = LANES / 2; apart > 0; apart /= 2) mine += __shfl_xor_sync(FULL, mine, apart, LANES);
#endif
        return mine;
    }
    __device__ Real least(Real mine) const {
#if LANES > 1
#pragma unroll
        for (int apart = LANES / 2; apart > 0; apart /= 2) {
            Real other = swapped(mine, apart);
            if (plain(other) < plain(mine)) mine = other;
        }
#endif
        return mine;
    }
#if LANES > 1
    __device__ Number swapped(Number mine, int apart) const { return __shfl_xor_sync(FULL, mine, apart, LANES); }
#if DUAL
    __device__ Real swapped(Real mine, int apart) const {
        return Real(swapped(mine.value, apart), swapped(mine.tangent, apart));
    }
#endif
#endif
#if DUAL
    __device__ Real from(Real mine, int source) const {
        return Real(from(mine.value, source), from(mine.tangent, source));
    }
    __device__ Real sum(Real mine) const { return Real(sum(mine.value), sum(mine.tangent)); }
#endif
    __device__ Vec from(Vec mine, int source) const {
        return vec(from(mine.x, source), from(mine.y, source), from(mine.z, source));
    }
    __device__ Vec sum(Vec mine) const { return vec(sum(mine.x), sum(mine.y), sum(mine.z)); }
};

// The contacts of a pair that belong to a lane, `k` counts from its first one: every LANES-th. Where those of a body that
// is a grid of spheres wait in a queue, the order of the lanes changes from group to group, or few lanes had all those
// of one side.
#if QUEUED
__device__ inline int owned(const Lanes& lanes, int group) { return group * LANES + (lanes.lane + group) % LANES; }
__device__ inline int owner(int contact) { return (contact - contact / LANES + LANES * CONTACTS) % LANES; }
#define EACH_OWNED(lanes, start, count, k)                                                    \
    KEEP_LOOP for (int group = (start) / LANES, k; group * LANES < (start) + (count); group++) \
        if ((k = owned(lanes, group) - (start)) >= 0 && k < (count))
#else
#define EACH_OWNED(lanes, start, count, k) \
    for (int k = ((lanes).lane - (start) % LANES + LANES) % LANES; k < (count); k += LANES)
#endif
