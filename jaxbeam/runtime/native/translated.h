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

#define POWER(name, type, one)                                    \
    static inline type name(type base, int exponent) {            \
        type product = one;                                       \
        for (int n = abs(exponent); n; n /= 2, base = base * base) \
            if (n % 2) product = product * base;                  \
        return exponent < 0 ? 1 / product : product;              \
    }
POWER(power, double, 1)
POWER(powers, Register, broadcast(1))

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

/* Lower Cholesky factor of a matrix by its lower half; NaN of one that is not positive. */
#define FACTOR(name, type, zero, root)                                                \
    static inline void name(type *factor, const type *matrix, int size) {             \
        for (int i = 0; i < size; i++)                                                \
            for (int j = 0; j < size; j++) {                                          \
                type sum = matrix[i * size + j];                                      \
                if (j > i) {                                                          \
                    factor[i * size + j] = zero;                                      \
                    continue;                                                         \
                }                                                                     \
                for (int k = 0; k < j; k++)                                           \
                    sum -= factor[i * size + k] * factor[j * size + k];               \
                factor[i * size + j] = i == j ? root(sum) : sum / factor[j * size + j]; \
            }                                                                         \
    }
FACTOR(factor, double, 0, sqrt)
FACTOR(factors, Register, broadcast(0), each_sqrt)

/* Solve a triangular system in place, of so many right sides; steps between the rows of them, and
 * between these. */
#define ELIMINATE(name, type)                                                                    \
    static inline void name(type *right, int row_step, int step, int count, const type *matrix,  \
                            int size, int lower, int transposed) {                               \
        const int down = lower != transposed;                                                    \
        for (int n = 0; n < size; n++) {                                                         \
            const int i = down ? n : size - 1 - n;                                               \
            for (int c = 0; c < count; c++) {                                                    \
                type sum = right[i * row_step + c * step];                                       \
                for (int m = 0; m < n; m++) {                                                    \
                    const int j = down ? m : size - 1 - m;                                       \
                    sum -= matrix[transposed ? j * size + i : i * size + j] *                    \
                           right[j * row_step + c * step];                                       \
                }                                                                                \
                right[i * row_step + c * step] = sum / matrix[i * size + i];                     \
            }                                                                                    \
        }                                                                                        \
    }
ELIMINATE(eliminate, double)
ELIMINATE(eliminates, Register)
