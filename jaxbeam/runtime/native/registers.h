/* Vector registers that hold one number of each of several runs, and their arithmetic. */

#pragma once

#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* Compilers split wider vectors into scalars, or worse. */
#if defined __AVX512F__
enum { REGISTER_WIDTH = 8 };
#elif defined __AVX2__
enum { REGISTER_WIDTH = 4 };
#else
enum { REGISTER_WIDTH = 2 };
#endif

#define ALWAYS_INLINE __attribute__((always_inline))
#if defined _WIN32
#define EXPORTED __declspec(dllexport) /* and nothing else, not even the runtime of C */
#else
#define EXPORTED
#endif

typedef double Register __attribute__((vector_size(8 * REGISTER_WIDTH)));
typedef int64_t Mask __attribute__((vector_size(8 * REGISTER_WIDTH)));

static inline Register broadcast(double value) {
    return value - (Register){0}; /* with + instead, the compiler keeps the addition */
}
static inline Register choose(Mask which, Register yes, Register no) {
    return (Register)(((Mask)yes & which) | ((Mask)no & ~which));
}
#if defined __AVX2__
/* One instruction; NaN is handled as in the other branch. The header with the compiler's own names
 * of it, immintrin.h, takes 0.15 s to compile in each file. */
#define EXTREME(instruction, a, b)                                                   \
    Register result;                                                                 \
    __asm__(instruction " %2, %1, %0" : "=v"(result) : "v"(a), "v"(b));              \
    return result
static inline Register maximum(Register a, Register b) { EXTREME("vmaxpd", a, b); }
static inline Register minimum(Register a, Register b) { EXTREME("vminpd", a, b); }
#else
static inline Register maximum(Register a, Register b) { return choose(a > b, a, b); }
static inline Register minimum(Register a, Register b) { return choose(a < b, a, b); }
#endif
static inline Register absolute(Register a) { return (Register)((Mask)a & INT64_MAX); }
static inline int any(Mask mask) {
    int64_t sum = 0;
    for (int l = 0; l < REGISTER_WIDTH; l++) sum |= mask[l];
    return sum != 0;
}

/* Load and store the first `count` numbers of a register; memory need not be aligned. */
typedef double Unaligned __attribute__((vector_size(8 * REGISTER_WIDTH), aligned(8), may_alias));
static inline Register load(const double *from, int count) {
    if (count == REGISTER_WIDTH) return *(const Unaligned *)from;
    Register values = {0};
    memcpy(&values, from, 8 * (size_t)count);
    return values;
}
static inline Register load_full(const double *from) { return load(from, REGISTER_WIDTH); }
static inline void store(double *to, Register values, int count) {
    if (count == REGISTER_WIDTH) *(Unaligned *)to = values;
    else memcpy(to, &values, 8 * (size_t)count);
}

/* Solve (1 + m_i G_ij) r_j = -d_i in place by elimination without pivoting: model/contact.py,
 * `solve_contact_forces`. The first r are `given`, of which the matrix needs no rows. */
static inline ALWAYS_INLINE void solve_contact_system(Register *matrix, Register *right, int size,
                                                      int given) {
#pragma GCC unroll 8
    for (int i = given; i < size; i++) {
        Register *row = matrix + i * size;
        for (int k = 0; k < given; k++) right[i] -= row[k] * right[k];
#pragma GCC unroll 8
        for (int k = given; k < i; k++) {
            Register factor = row[k] * matrix[k * size + k]; /* the diagonal has been inverted */
#pragma GCC unroll 8
            for (int j = k + 1; j < size; j++) row[j] -= factor * matrix[k * size + j];
            right[i] -= factor * right[k];
        }
        row[i] = 1 / row[i];
    }
#pragma GCC unroll 8
    for (int j = size - 1; j >= given; j--) {
        right[j] *= matrix[j * size + j];
#pragma GCC unroll 8
        for (int i = given; i < j; i++) right[i] -= matrix[i * size + j] * right[j];
    }
}
