/* result = first x second, matrices row after row. */
static void matrix_product(real *result, const real *first, const real *second, int rows, int inner,
                           int columns)
{
    int i, j, k;
    for (i = 0; i < rows; i++)
        for (j = 0; j < columns; j++) {
            real sum = 0;
            for (k = 0; k < inner; k++) sum += first[i * inner + k] * second[k * columns + j];
            result[i * columns + j] = sum;
        }
}
