/* Numbers of several runs side by side, as many as fill a vector register, and their arithmetic.

   NODES, the size of most systems of equations, comes from the command line. */

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

static inline Lanes all(double value) { return (Lanes){0} + value; }
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

/* sums += rows @ values, rows `down` numbers apart and their entries `along`; four rows at a time
   keep the adders busy. */
static inline ALWAYS void product(Lanes *sums, const double *rows, int count, int down, int along,
                                  const Lanes *values, int size) {
    int r = 0;
    for (; r + 4 <= count; r += 4) {
        const double *row = rows + (ptrdiff_t)r * down;
        Lanes a = sums[r], b = sums[r + 1], c = sums[r + 2], d = sums[r + 3];
        for (int k = 0; k < size; k++, row += along) {
            a += row[0] * values[k];
            b += row[down] * values[k];
            c += row[2 * down] * values[k];
            d += row[3 * down] * values[k];
        }
        sums[r] = a, sums[r + 1] = b, sums[r + 2] = c, sums[r + 3] = d;
    }
    for (; r < count; r++)
        for (int k = 0; k < size; k++)
            sums[r] += rows[(ptrdiff_t)r * down + (ptrdiff_t)k * along] * values[k];
}

static void add_product(Lanes *sums, const double *rows, int count, const Lanes *values, int size) {
    product(sums, rows, count, size, 1, values, size);
}

/* Forces of (1 + m_i G_ij) r_j = -d_i, eliminated in place without pivots; see dynamics.py. */
static inline ALWAYS void eliminate(Lanes *matrix, Lanes *right, int size) {
#pragma GCC unroll 8
    for (int i = 0; i < size; i++) {
        Lanes inverse = 1 / matrix[i * size + i];
        matrix[i * size + i] = inverse;
#pragma GCC unroll 8
        for (int k = i + 1; k < size; k++) {
            Lanes factor = matrix[k * size + i] * inverse;
#pragma GCC unroll 8
            for (int j = i + 1; j < size; j++) matrix[k * size + j] -= factor * matrix[i * size + j];
            right[k] -= factor * right[i];
        }
    }
#pragma GCC unroll 8
    for (int j = size - 1; j >= 0; j--) {
        right[j] *= matrix[j * size + j];
#pragma GCC unroll 8
        for (int i = 0; i < j; i++) right[i] -= matrix[i * size + j] * right[j];
    }
}

static void solve(Lanes *matrix, Lanes *right, int size) {
    if (size != NODES) {
        eliminate(matrix, right, size);
        return;
    }
    Lanes own[NODES * NODES], forces[NODES]; /* one load: in registers */
    memcpy(own, matrix, sizeof own);
    memcpy(forces, right, sizeof forces);
    eliminate(own, forces, NODES);
    memcpy(right, forces, sizeof forces);
}
