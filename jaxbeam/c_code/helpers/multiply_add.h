/* result += sign x matrix x vector, the matrix row after row; sign is 1 or -1. */
static void multiply_add(real *result, real sign, const real *matrix, const real *vector, int rows,
                         int columns)
{
    int i, j;
    for (i = 0; i < rows; i++) {
        real sum = 0;
        for (j = 0; j < columns; j++) sum += matrix[i * columns + j] * vector[j];
        result[i] += sign * sum;
    }
}
