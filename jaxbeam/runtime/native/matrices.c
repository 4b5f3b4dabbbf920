#include "matrices.h"

/* sums += table values for up to 8 rows of a table whose columns are contiguous, `stride` numbers
 * apart. Eight independent sums hide the latency of the additions. */
static inline ALWAYS_INLINE void add_rows(Register *sums, const double *table, int stride,
                                          const Register *values, int size, int rows) {
    Register sum[8];
#pragma GCC unroll 8
    for (int r = 0; r < rows; r++) sum[r] = sums[r];
    for (int k = 0; k < size; k++, table += stride)
#pragma GCC unroll 8
        for (int r = 0; r < rows; r++) sum[r] += table[r] * values[k];
#pragma GCC unroll 8
    for (int r = 0; r < rows; r++) sums[r] = sum[r];
}

void add_product(Register *sums, const double *table, int rows, const Register *values, int size) {
    int r = 0;
    for (; r + 8 <= rows; r += 8) add_rows(sums + r, table + r, rows, values, size, 8);
    if (r + 6 <= rows) add_rows(sums + r, table + r, rows, values, size, 6), r += 6;
    if (r + 4 <= rows) add_rows(sums + r, table + r, rows, values, size, 4), r += 4;
    if (r + 2 <= rows) add_rows(sums + r, table + r, rows, values, size, 2), r += 2;
    if (r < rows) add_rows(sums + r, table + r, rows, values, size, 1);
}

/* A tile of sums += left right, of up to four rows and columns: its sums stay in registers. */
static inline ALWAYS_INLINE void add_tile(Register *sums, const Register *left, int terms,
                                          const Register *right, int width, int rows, int columns) {
    Register sum[16];
#pragma GCC unroll 4
    for (int i = 0; i < rows; i++)
#pragma GCC unroll 4
        for (int j = 0; j < columns; j++) sum[i * 4 + j] = sums[i * width + j];
    for (int k = 0; k < terms; k++)
#pragma GCC unroll 4
        for (int j = 0; j < columns; j++) {
            const Register factor = right[k * width + j];
#pragma GCC unroll 4
            for (int i = 0; i < rows; i++) sum[i * 4 + j] += left[i * terms + k] * factor;
        }
#pragma GCC unroll 4
    for (int i = 0; i < rows; i++)
#pragma GCC unroll 4
        for (int j = 0; j < columns; j++) sums[i * width + j] = sum[i * 4 + j];
}

/* Up to four rows of sums += left right. */
static inline ALWAYS_INLINE void add_rows_product(Register *sums, const Register *left, int terms,
                                                  const Register *right, int width, int rows) {
    int j = 0;
    for (; j + 4 <= width; j += 4) add_tile(sums + j, left, terms, right + j, width, rows, 4);
    const int rest = width - j;
    sums += j, right += j;
    if (rest == 3) add_tile(sums, left, terms, right, width, rows, 3);
    if (rest == 2) add_tile(sums, left, terms, right, width, rows, 2);
    if (rest == 1) add_tile(sums, left, terms, right, width, rows, 1);
}

void add_matrix_product(Register *sums, const Register *left, int rows, const Register *right,
                        int terms, int columns) {
    int i = 0;
    for (; i + 4 <= rows; i += 4)
        add_rows_product(sums + i * columns, left + i * terms, terms, right, columns, 4);
    const int rest = rows - i;
    sums += i * columns, left += i * terms;
    if (rest == 3) add_rows_product(sums, left, terms, right, columns, 3);
    if (rest == 2) add_rows_product(sums, left, terms, right, columns, 2);
    if (rest == 1) add_rows_product(sums, left, terms, right, columns, 1);
}
