/* Numbers of several runs side by side, as many as fill a vector register, and their arithmetic.

   NODES, the size of most systems of equations, comes from the command line. */

#pragma once

#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* Wider than a register, compilers make of them what they would of single numbers, or worse. */
#if defined __AVX512F__
#include <immintrin.h>
#define REGISTER(name) _mm512_##name##_pd
enum { WIDE = 8 };
#elif defined __AVX2__
#include <immintrin.h>
#define REGISTER(name) _mm256_##name##_pd
enum { WIDE = 4 };
#else
enum { WIDE = 2 };
#endif

#define ALWAYS __attribute__((always_inline))

typedef double Lanes __attribute__((vector_size(8 * WIDE)));
typedef int64_t Mask __attribute__((vector_size(8 * WIDE)));

static inline Lanes all(double value) { return value - (Lanes){0}; } /* + would ask for a sum */
static inline Lanes either(Mask which, Lanes yes, Lanes no) {
    return (Lanes)(((Mask)yes & which) | ((Mask)no & ~which));
}
#ifdef REGISTER /* in one instruction, where there is one that treats what is no number alike */
static inline Lanes greater(Lanes a, Lanes b) { return REGISTER(max)(a, b); }
static inline Lanes less(Lanes a, Lanes b) { return REGISTER(min)(a, b); }
#else
static inline Lanes greater(Lanes a, Lanes b) { return either(a > b, a, b); }
static inline Lanes less(Lanes a, Lanes b) { return either(a < b, a, b); }
#endif
static inline Lanes absolute(Lanes a) { return (Lanes)((Mask)a & INT64_MAX); }
static inline int any(Mask mask) {
    int64_t sum = 0;
    for (int l = 0; l < WIDE; l++) sum |= mask[l];
    return sum != 0;
}

/* The lanes of a group lie side by side; of the last group, `many` are there. */
typedef double Loose __attribute__((vector_size(8 * WIDE), aligned(8), may_alias));
static inline Lanes load(const double *from, int many) {
    if (many == WIDE) return *(const Loose *)from;
    Lanes lanes = {0};
    memcpy(&lanes, from, 8 * (size_t)many);
    return lanes;
}
static inline Lanes whole(const double *from) { return load(from, WIDE); }
static inline void store(double *to, Lanes lanes, int many) {
    if (many == WIDE) *(Loose *)to = lanes;
    else memcpy(to, &lanes, 8 * (size_t)many);
}

/* sums += table @ values for so many rows, which lie side by side in the table, `apart` numbers from
   those for the next value. Eight sums at a time keep the adders busy. */
static inline ALWAYS void add_rows(Lanes *sums, const double *table, int apart, const Lanes *values,
                                   int size, int rows) {
    Lanes sum[8];
    for (int r = 0; r < rows; r++) sum[r] = sums[r];
    for (int k = 0; k < size; k++, table += apart)
        for (int r = 0; r < rows; r++) sum[r] += table[r] * values[k];
    for (int r = 0; r < rows; r++) sums[r] = sum[r];
}

static inline ALWAYS void add_product(Lanes *sums, const double *table, int rows, const Lanes *values,
                                      int size) {
    int r = 0;
    for (; r + 8 <= rows; r += 8) add_rows(sums + r, table + r, rows, values, size, 8);
    if (r + 6 <= rows) add_rows(sums + r, table + r, rows, values, size, 6), r += 6;
    if (r + 4 <= rows) add_rows(sums + r, table + r, rows, values, size, 4), r += 4;
    if (r + 2 <= rows) add_rows(sums + r, table + r, rows, values, size, 2), r += 2;
    if (r < rows) add_rows(sums + r, table + r, rows, values, size, 1);
}

/* Forces of (1 + m_i G_ij) r_j = -d_i, eliminated in place without pivots, row by row; see
   dynamics.py. */
static inline ALWAYS void eliminate(Lanes *matrix, Lanes *right, int size) {
#pragma GCC unroll 8
    for (int i = 0; i < size; i++) {
        Lanes *row = matrix + i * size;
#pragma GCC unroll 8
        for (int k = 0; k < i; k++) {
            Lanes factor = row[k] * matrix[k * size + k]; /* the pivots are inverses by now */
#pragma GCC unroll 8
            for (int j = k + 1; j < size; j++) row[j] -= factor * matrix[k * size + j];
            right[i] -= factor * right[k];
        }
        row[i] = 1 / row[i];
    }
#pragma GCC unroll 8
    for (int j = size - 1; j >= 0; j--) {
        right[j] *= matrix[j * size + j];
#pragma GCC unroll 8
        for (int i = 0; i < j; i++) right[i] -= matrix[i * size + j] * right[j];
    }
}
