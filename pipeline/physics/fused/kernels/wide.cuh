// Numbers of WIDE environments at once, one in each place of a vector of the processor. A program of them takes every branch
// that one of its environments needs, and `choose` takes each environment's result. Each has the bits of a program of its
// own: what does not concern it adds 0 to it.
#if WIDE
typedef double Row __attribute__((vector_size(8 * WIDE)));
typedef double Quad __attribute__((vector_size(32)));
typedef long long Marks __attribute__((vector_size(8 * WIDE)));  // all bits where a condition holds

struct Flag {  // a condition in each environment
    Marks of;
    Flag() = default;
    Flag(Marks marks) : of(marks) {}
    Flag(bool all) : of(Marks{} - (long long)all) {}
    friend inline Flag operator&(Flag a, Flag b) { return Flag(a.of & b.of); }
    friend inline Flag operator|(Flag a, Flag b) { return Flag(a.of | b.of); }
    friend inline Flag operator!(Flag a) { return Flag(~a.of); }
};
inline int bits_of(Flag condition) {
    union { Marks marks; Quad quads[WIDE / 4]; } all = {condition.of};
    int bits = 0;
    for (int k = 0; k < WIDE / 4; k++) bits |= __builtin_ia32_movmskpd256(all.quads[k]) << 4 * k;
    return bits;
}
inline bool some(Flag condition) { return bits_of(condition) != 0; }
inline bool every(Flag condition) { return bits_of(condition) == (1 << WIDE) - 1; }

struct Wide {
    Row of;
    Wide() = default;
    Wide(Row row) : of(row) {}
    Wide(double one) { for (int k = 0; k < WIDE; k++) of[k] = one; }
    friend inline Wide operator-(Wide a) { return Wide(-a.of); }
    friend inline Wide operator+(Wide a, Wide b) { return Wide(a.of + b.of); }
    friend inline Wide operator-(Wide a, Wide b) { return Wide(a.of - b.of); }
    friend inline Wide operator*(Wide a, Wide b) { return Wide(a.of * b.of); }
    friend inline Wide operator/(Wide a, Wide b) { return Wide(a.of / b.of); }
    inline Wide& operator+=(Wide b) { of += b.of; return *this; }
    inline Wide& operator-=(Wide b) { of -= b.of; return *this; }
    friend inline Flag operator<(Wide a, Wide b) { return Flag(a.of < b.of); }
    friend inline Flag operator>(Wide a, Wide b) { return Flag(a.of > b.of); }
    friend inline Flag operator<=(Wide a, Wide b) { return Flag(a.of <= b.of); }
    friend inline Flag operator>=(Wide a, Wide b) { return Flag(a.of >= b.of); }
    friend inline Flag operator==(Wide a, Wide b) { return Flag(a.of == b.of); }
};
inline Wide choose(Flag condition, Wide yes, Wide no) { return Wide(condition.of ? yes.of : no.of); }
inline Wide lesser(Wide a, Wide b) { return choose(a < b, a, b); }
inline Wide greater(Wide a, Wide b) { return choose(a > b, a, b); }
inline Wide reciprocal(Wide x) { return Wide(1.0) / x; }
inline Wide root(Wide x) {
    Row y;
    for (int k = 0; k < WIDE; k++) y[k] = __builtin_sqrt(x.of[k]);
    return Wide(y);
}
inline Wide inverse_root(Wide x) { return Wide(1.0) / root(x); }
inline Wide exponential(Wide x) {
    for (int k = 0; k < WIDE; k++) x.of[k] = exp(x.of[k]);
    return x;
}
inline void sine_cosine(Wide x, Wide& s, Wide& c) {
    for (int k = 0; k < WIDE; k++) {
        s.of[k] = sin(x.of[k]);
        c.of[k] = cos(x.of[k]);
    }
}

struct Place {  // where the numbers of each environment begin in an array
    long long of[WIDE];
    friend inline Place operator+(Place a, long long b) { for (int k = 0; k < WIDE; k++) a.of[k] += b; return a; }
    friend inline Place operator*(Place a, long long b) { for (int k = 0; k < WIDE; k++) a.of[k] *= b; return a; }
    friend inline Place operator*(long long a, Place b) { return b * a; }
    inline Place& operator+=(long long b) { return *this = *this + b; }
    inline Place operator++(int) { Place before = *this; *this += 1; return before; }
};
struct Target {  // where numbers of each environment are written
    double* array;
    Place place;
    friend inline Target operator+(Target a, long long b) { a.place += b; return a; }
};
inline Target operator+(double* array, Place place) { Target to = {array, place}; return to; }
inline void write_row(Target to, Wide a, Wide b, Wide c, Wide d) {
    for (int k = 0; k < WIDE; k++) {
        double* row = to.array + to.place.of[k];
        row[0] = a.of[k];
        row[1] = b.of[k];
        row[2] = c.of[k];
        row[3] = d.of[k];
    }
}
typedef double Stored;
#else
typedef bool Flag;
typedef long long Place;
__device__ inline bool some(bool condition) { return condition; }
__device__ inline bool every(bool condition) { return condition; }
#endif
