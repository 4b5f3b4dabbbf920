/* Functions of translated programs (runtime/c_writer.py), of one run and of those of a
 * register. */

#pragma once

#include <math.h>
#include <stdlib.h>

#include "registers.h"

static inline Mask whole(int64_t value) { return value - (Mask){0}; }
static inline Mask either(Mask which, Mask yes, Mask no) { return (yes & which) | (no & ~which); }
static inline int64_t within(int64_t index, int64_t most) {
    return index < 0 ? 0 : index > most ? most : index;
}

/* NaN if one of both is. */
static inline double larger(double a, double b) { return a > b || a != a ? a : b; }
static inline double smaller(double a, double b) { return a < b || a != a ? a : b; }
static inline Register largers(Register a, Register b) { return choose((a > b) | (a != a), a, b); }
static inline Register smallers(Register a, Register b) { return choose((a < b) | (a != a), a, b); }
static inline Register signs(Register x) {
    const Register one = choose(x < 0, broadcast(-1), broadcast(1));
    return choose((x < 0) | (x > 0), one, x);
}

#define EACH(name)                                                        \
    static inline Register each_##name(Register x) {                      \
        for (int l = 0; l < REGISTER_WIDTH; l++) x[l] = name(x[l]);       \
        return x;                                                         \
    }
EACH(sqrt) EACH(cbrt) EACH(exp) EACH(expm1) EACH(log) EACH(log1p) EACH(sin) EACH(cos) EACH(tan)
EACH(tanh) EACH(sinh) EACH(cosh) EACH(floor) EACH(ceil) EACH(asin) EACH(acos) EACH(atan)
EACH(round) EACH(rint)

#define EACH_PAIR(name)                                                   \
    static inline Register each_##name(Register x, Register y) {          \
        for (int l = 0; l < REGISTER_WIDTH; l++) x[l] = name(x[l], y[l]); \
        return x;                                                         \
    }
EACH_PAIR(pow) EACH_PAIR(fmod) EACH_PAIR(atan2)

#define NUMBER double
#define NAMED(name) name
#define SQUARE_ROOT sqrt
#define ZERO 0
#define ONE 1
#include "algebra.h"
#undef NUMBER
#undef NAMED
#undef SQUARE_ROOT
#undef ZERO
#undef ONE
#define NUMBER Register
#define NAMED(name) name##s
#define SQUARE_ROOT each_sqrt
#define ZERO broadcast(0)
#define ONE broadcast(1)
#include "algebra.h"

typedef double Lane __attribute__((may_alias));
typedef int64_t Place __attribute__((may_alias));
#include "decompose.h"
