/* result = first x second', square matrices. */
static void product_with_transposed(real *result, const real *first, const real *second, int size)
{
    int i, j, k;
    for (i = 0; i < size; i++)
        for (j = 0; j < size; j++) {
            real sum = 0;
            for (k = 0; k < size; k++) sum += first[i * size + k] * second[j * size + k];
            result[i * size + j] = sum;
        }
}
