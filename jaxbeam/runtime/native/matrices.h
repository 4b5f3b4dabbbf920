/* Products of small matrices, compiled once for all files that call them: matrices.c. */

#pragma once

#include "registers.h"

#pragma GCC visibility push(hidden)

/* sums (rows) += table (rows, size) values (size); the columns of the table are contiguous. */
void add_product(Register *sums, const double *table, int rows, const Register *values, int size);

/* sums (rows, columns) += left (rows, terms) right (terms, columns), all row by row. */
void add_matrix_product(Register *sums, const Register *left, int rows, const Register *right,
                        int terms, int columns);

#pragma GCC visibility pop
