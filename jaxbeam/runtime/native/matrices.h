/* Products of small matrices whose entries are registers. */

#pragma once

#include "registers.h"

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

/* sums (rows, columns) += left (rows, terms) right (terms, columns), all row by row. */
static void add_matrix_product(Register *sums, const Register *left, int rows,
                               const Register *right, int terms, int columns) {
    int i = 0;
    for (; i + 4 <= rows; i += 4)
        add_rows_product(sums + i * columns, left + i * terms, terms, right, columns, 4);
    const int rest = rows - i;
    sums += i * columns, left += i * terms;
    if (rest == 3) add_rows_product(sums, left, terms, right, columns, 3);
    if (rest == 2) add_rows_product(sums, left, terms, right, columns, 2);
    if (rest == 1) add_rows_product(sums, left, terms, right, columns, 1);
}
